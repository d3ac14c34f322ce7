"""Simulation of rigid bodies without a material: gravity, contacts, motion."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np

from warp_lcp.contacts.inverse_kinematics import InverseKinematics
from warp_lcp.contacts.kinematics import KinematicSimulation
from warp_lcp.contacts.methods import RegistryContactMethod
from warp_lcp.contacts.scene import ContactScene
from warp_lcp.material.particle_assembly import make_bodies, placed_solids
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.scene.scene import Scene
from warp_lcp.simulation import NoStopwatch, Part, SimulationFailed, Stopwatch, Surface
from warp_lcp.solvers.registry import METHODS

COLUMNS = (
    "kinetic_energy",
    "potential_energy",
    "max_speed",
    "solver",
    "solve_status",
    "solve_iterations",
    "solve_residual",
)


class ContactSimulation:
    """Simulation of rigid bodies, moved by `RigidBodies`.

    Velocities are those of the middle of the last step: v' = v + g (dt + dt_before) / 2 + M^-1 J'
    r, x' = x + dt v'.

    Args:
        scene: the scene.
        bodies: the bodies of the scene.
        method: solver for the impulses of their contacts.

    Attributes:
        time: time of the state [s].
        step_count: number of steps.
        watch: measures the stages of a step.
    """

    def __init__(
        self, scene: ContactScene, bodies: RigidBodies, method: RegistryContactMethod
    ) -> None:
        self.scene, self.bodies, self._method = scene, bodies, method
        bodies.material = False
        self.time, self.step_count, self._last_dt = 0.0, 0, 0.0
        self.gravity = np.array([*scene.physics.gravity, 0.0][:3])
        self.watch: Stopwatch = NoStopwatch()

    def stable_dt(self) -> float:
        """Return the longest step [s] by the CFL number.

        In it the fastest body moves by `time.cfl` sizes of the smallest one.
        """
        speed = self.bodies.top_speed(self.scene.time.dt_max, float(np.linalg.norm(self.gravity)))
        size = min(shape.size for shape in self.bodies.shapes)
        return self.scene.time.cfl * size / speed if speed > 0.0 else np.inf

    def step(self, dt: float) -> dict[str, float | int | str | None]:
        """Advance by dt [s] and return a row of the log.

        Raises:
            SimulationFailed: a body is not finite.
        """
        with self.watch.stage("contacts"):
            self.bodies.begin_step(self.time, dt, self.gravity, 0.5 * (self._last_dt + dt))
            self.bodies.solve_contacts()
            status = self._method.status.name  # before the solve for overlaps
        with self.watch.stage("motion"):
            self.bodies.end_step(dt)
        if trouble := self.bodies.stop_reason(self.scene.domain.size, self.scene.endless):
            raise SimulationFailed(f"step {self.step_count + 1}: {trouble}")
        self.bodies.leave()
        self.time, self.step_count, self._last_dt = self.time + dt, self.step_count + 1, dt
        return self._row(dt, status)

    def columns(self) -> tuple[str, ...]:
        """Return the names of the log's columns.

        Energies [J; J/m in 2-D] are those of the middle of the step, like the velocities;
        potential_energy is 0 at the origin. max_speed: largest speed of a point of a body [m/s].
        solve_residual: residual of the contact problem as the method solves it, relative to that of
        no impulses; empty, like the columns before it, without contacts. For the bodies' columns
        see `RigidBodies.columns`.
        """
        return (*COLUMNS, *self.bodies.columns())

    def frame(self) -> list[Part]:
        """Return the surfaces of the bodies."""
        surface = self.bodies.surfaces()
        return [Surface("bodies", surface.points, surface.corners, surface.fields)]

    def state(self) -> dict[str, np.ndarray]:
        """Return everything that `restore` needs."""
        clock = np.array([self.time, self._last_dt])
        return {"clock": clock, "step_count": np.array(self.step_count), **self.bodies.state()}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from `state`.

        Raises:
            ValueError: the state belongs to other bodies.
        """
        missing = {"clock", "step_count", "bodies"} - set(state)
        if missing:
            raise ValueError(
                "the state does not belong to a scene of bodies alone: it lacks "
                f"{', '.join(sorted(missing))}"
            )
        self.bodies.restore(state)
        self.time, self._last_dt = (float(value) for value in state["clock"])
        self.step_count = int(state["step_count"])

    def notes(self) -> list[str]:
        """Return facts for the start of a run, and settings that look like mistakes."""
        sides = " x ".join(f"{side:g}" for side in self.scene.domain.size)
        count = len(self.bodies.bodies)
        room = "an unbounded domain" if self.scene.domain.boundless else f"{sides} m"
        return [
            f"{count} rigid {'body' if count == 1 else 'bodies'} in {room}",
            *self.scene.notes(),
        ]

    def _row(self, dt: float, status: str) -> dict[str, float | int | str | None]:
        """Return a row of the log.

        Energies are in J, in 2-D in J/m. The potential energy is that at x - dt v / 2: it is -m x.g
        at the current positions, plus dt m v.g / 2.
        """
        bodies, solved = self.bodies, self.bodies.contacts > 0 or bool(self.bodies.joints)
        momentum = bodies.bodies.momentum.sum(axis=0)
        # Potential energy half a step earlier.
        energy = bodies.potential_energy(self.gravity) + 0.5 * dt * float(momentum @ self.gravity)
        model_row: dict[str, float | int | str | None] = {
            "kinetic_energy": bodies.kinetic_energy(),
            "potential_energy": energy,
            "max_speed": bodies.top_speed(0.0),
            "solver": self.scene.solver.method if solved else None,
            "solve_status": status if solved else None,
            "solve_iterations": bodies.contact_iterations if solved else None,
            "solve_residual": float(bodies.contact_residual) if solved else None,
        }
        return model_row | bodies.row()


class ContactSimulator:
    """Simulator plug-in for rigid bodies without a material."""

    name = "contacts"
    summary = "rigid bodies that stack, slide, topple and bounce"
    scene_model = ContactScene

    def create(
        self, scene: Scene, *, device: str, folder: Path
    ) -> ContactSimulation | KinematicSimulation:
        """Build a simulation of `scene`.

        Args:
            scene: a ContactScene.
            device: a Warp device's name, for methods other than the default one, which runs on the
                CPU.
            folder: folder of the files that the scene names.

        Raises:
            ValueError: the scene cannot be simulated; the message names the key and what is
                allowed.
        """
        if not isinstance(scene, ContactScene):
            raise ValueError("scene.simulator: contacts needs a scene of rigid bodies")
        solver = scene.solver
        method = RegistryContactMethod(
            solver.method,
            directions=solver.directions,
            tolerance=solver.tolerance,
            most=solver.max_iterations,
            device=device,
        )
        bodies = make_bodies(
            scene, placed_solids(scene, folder), partial(RigidBodies, solver=method)
        )
        assert bodies is not None  # a scene has at least one body
        if scene.target:
            solve = InverseKinematics(
                method=METHODS[solver.method](),
                tolerance=solver.tolerance,
                max_iterations=solver.max_iterations,
                curvature=True,
                device=device,
            )
            return KinematicSimulation(
                bodies, scene.targets(), solve, solver.method, scene.time.dt_max
            )
        return ContactSimulation(scene, bodies, method)
