"""Energy balance of a simulation.

Sources, outlets, moving walls and periodic axes add or remove energy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from warp_lcp.fluids.simulator import LiquidSimulation
from warp_lcp.granular.simulator import SandSimulation
from warp_lcp.material.boundary import CutBoundary
from warp_lcp.operators.grid_poisson import SOLID
from warp_lcp.rigid.body import RigidBody


@dataclass(frozen=True)
class EnergyStep:
    """Energies [J; J/m in 2-D] of a step.

    Attributes:
        before: kinetic and potential energy at its begin, bodies included.
        after: the same at its end.
        given: energy from outside: of particles that sources add and outlets remove, of walls
            that the scene moves, and of particles that pass a periodic side.
        displaced: potential energy added by the density correction; part of `after`.
    """

    before: float
    after: float
    given: float
    displaced: float

    @property
    def gained(self) -> float:
        """Energy gained without a source; negative values are dissipation."""
        return self.after - self.before - self.given


class EnergyBalance:
    """Step a simulation and record its energy balance.

    Energies are computed in float64 from particles and bodies. A particle's velocity is that of the
    middle of its step. For the kinetic energy at the end, gravity's work in half a step more is
    added. Its power is that of the mean velocity V; the change of V in the step counts as far as it
    is free fall. Moving walls do the work of the pressure's impulses at their faces. Their work on
    spray that they hit is not in `given`.

    Args:
        simulation: particle simulation; it stays wrapped, since its parts are observed.
    """

    def __init__(self, simulation: LiquidSimulation | SandSimulation) -> None:
        self.simulation = simulation
        self._dt, self._given, self._displaced, self._carried = (
            simulation.last_dt,
            0.0,
            0.0,
            np.zeros(3),
        )
        self._watch("carry", simulation, None, self._note_momentum)
        exchange = self._exchange("_given")
        for part, names in (
            (simulation.sources, ("emit",)),
            (simulation.outlets, ("apply", "remove_departed")),
        ):
            for name in names if part is not None else ():
                self._watch(name, part, *exchange)
        if simulation.boundary.sides is not None:
            self._watch("carry", simulation.boundary.sides, *exchange)
        apart = getattr(simulation, "rearrangement", None) or getattr(
            simulation, "correction", None
        )
        if apart is not None:
            self._watch("apply", apart, *self._exchange("_displaced"))
        projection = getattr(simulation, "projection", None)
        if projection is not None and simulation.boundary.velocity:
            self._watch("project", projection, None, self._note_walls)
        self.now = self.energy()

    def energy(self) -> float:
        """Return kinetic and potential energy of particles and bodies [J; J/m].

        The gain of free fall is not included.
        """
        return self._material() + self._energy_of_bodies()

    def height(self) -> float:
        """Return the potential energy of material and bodies [J; J/m], >= 0.

        Heights are above the lowest corner of the domain.
        """
        s = self.simulation
        gravity, size = self._gravity(), np.zeros(3)
        size[: s.grid.dimension] = s.scene.domain.size
        lowest = float(np.minimum(-gravity * size, 0.0).sum())
        mass, moment = self._moments()
        own = -float(gravity @ moment) - mass * lowest
        return own + sum(
            -b.properties.mass * (float(gravity @ b.position) + lowest) for b in self._bodies()
        )

    def total(self) -> float:
        """Return the sum of kinetic and potential energy [J; J/m].

        Heights are above the lowest corner of the domain.
        """
        bodies = self.simulation.bodies
        motion = (
            self.now
            - self._potential()
            - (bodies.potential_energy(self.simulation.gravity) if bodies is not None else 0.0)
        )
        return max(motion, 0.0) + self.height()

    def set_back(self, state: dict[str, np.ndarray], energy: float) -> None:
        """Reset the simulation to a state.

        Args:
            state: state of the simulation.
            energy: value of `now` at that state.
        """
        self.simulation.restore(state)
        self._dt, self.now = self.simulation.last_dt, energy

    def step(self, dt: float) -> EnergyStep:
        """Step by dt [s] and return the energy balance."""
        s = self.simulation
        before, momentum, self._dt = self.now, self._momentum(), dt
        bodies = self._bodies()
        moving = [body.velocity.copy() for body in bodies]
        self._given = self._displaced = 0.0
        self._carried = momentum
        s.step(dt)
        gained = self._free_fall(s.particle_mass * s.particles.count, self._carried - momentum)
        for body, old in zip(bodies, moving, strict=True):
            gained += self._free_fall(
                body.properties.mass, body.properties.mass * (body.velocity - old)
            )
        self.now = self.energy() + gained
        return EnergyStep(before, self.now, self._given, self._displaced)

    def _free_fall(self, mass: float, change: np.ndarray) -> float:
        """Return the kinetic energy that free fall adds in half a step more.

        The rate of fall is that of the momentum change in the step.
        """
        g = self.simulation.gravity
        rate = float(g @ change) / self.simulation.kick_dt
        return 0.125 * self._dt**2 * min(max(rate, 0.0), mass * float(g @ g))

    def _material(self) -> float:
        s = self.simulation
        velocity = s.particles.velocity.numpy().astype(np.float64)
        motion = 0.5 * s.particle_mass * float(np.square(velocity).sum())
        return motion + 0.5 * self._dt * float(s.gravity @ self._momentum()) + self._potential()

    def _bodies(self) -> Sequence[RigidBody]:
        return [] if self.simulation.bodies is None else self.simulation.bodies.bodies

    def _energy_of_bodies(self) -> float:
        s = self.simulation
        if s.bodies is None:
            return 0.0
        power = sum(
            body.properties.mass * float(s.gravity @ body.velocity) for body in s.bodies.bodies
        )
        return (
            s.bodies.kinetic_energy()
            + 0.5 * self._dt * power
            + s.bodies.potential_energy(s.gravity)
        )

    def _potential(self) -> float:
        return -float(self.simulation.gravity @ self._moments()[1])

    def _gravity(self) -> np.ndarray:
        """Return gravity [m/s^2] without its components along periodic axes.

        A periodic axis has no lowest place.
        """
        s = self.simulation
        axes = [axis in s.scene.endless for axis in range(3)]
        return np.where(axes, 0.0, s.gravity)

    def _moments(self) -> tuple[float, np.ndarray]:
        s = self.simulation
        position = s.particles.position.numpy().astype(np.float64)
        return s.particle_mass * len(position), s.particle_mass * position.sum(axis=0)

    def _momentum(self) -> np.ndarray:
        s = self.simulation
        return np.asarray(
            s.particle_mass * s.particles.velocity.numpy().astype(np.float64).sum(axis=0)
        )

    def _note_momentum(self) -> None:
        self._carried = self._momentum()

    def _note_walls(self) -> None:
        """Record the work of the pressure's impulses on walls and sources.

        The impulse of a cell is rho dx^d times the pressure. The flow of sources pushes back.
        """
        s = self.simulation
        assert isinstance(s, LiquidSimulation), "has a projection"
        flow = s.scene.physics.density * s.grid.cell_volume * s.projection.pressure.numpy()
        self._given -= float((flow * wall_outflow(s)).sum())

    def _exchange(self, account: str) -> tuple[Callable[[], None], Callable[[], None]]:
        depth = 0  # outlets call methods of their own parts

        def before() -> None:
            nonlocal depth
            if depth == 0:
                setattr(self, account, getattr(self, account) - self._material())
            depth += 1

        def after() -> None:
            nonlocal depth
            depth -= 1
            if depth == 0:
                setattr(self, account, getattr(self, account) + self._material())

        return before, after

    def _watch(
        self,
        name: str,
        part: object,
        before: Callable[[], None] | None,
        after: Callable[[], None] | None,
    ) -> None:
        """Call functions before and after a method of a part."""
        method = getattr(part, name)

        def watched(*given: object, **named: object) -> object:
            if before is not None:
                before()
            result = method(*given, **named)
            if after is not None:
                after()
            return result

        setattr(part, name, watched)


def wall_outflow(simulation: LiquidSimulation) -> np.ndarray:
    """Return the outflow of each cell [m/s] into moving walls and sources.

    It is in the stored shape, and bodies do not count. On a face of the open fraction a_f it is s_f
    (1 - a_f) u_s,f, s_f = +-1 outward. A source's cells are SOLID and their faces closed.
    """
    boundary, kind = simulation.boundary, simulation.projection.kind.numpy()
    bodies = simulation.bodies.numbers if simulation.bodies is not None else []
    result = np.zeros(simulation.grid.shape)
    for axis, field in enumerate(boundary.velocity):
        along = 2 - axis
        if boundary.open:
            wall = np.where(
                np.isin(cast(CutBoundary, boundary).cut.wall[axis].numpy(), bodies),
                0.0,
                field.numpy(),
            )
            passes = (1.0 - boundary.open[axis].numpy()) * wall
        else:
            passes = np.where(
                (kind == SOLID) | (np.roll(kind, 1, along) == SOLID), field.numpy(), 0.0
            ).astype(np.float64)
        result += np.roll(passes, -1, along) - passes
    return result
