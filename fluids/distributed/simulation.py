"""Liquid on the ranks of MPI: the domain is cut into boxes, one a rank, and particles belong to the rank whose box they are in.

A step is that of one process on the part of the grid around a rank's box. What another rank knows comes in where the chain of dependence
needs it: particles a cell from the cut before they are brought to the faces; velocities and weights of the faces; density, surface and
kinds of cells; the pressure, whose LCP is one of all ranks; projected velocities, and again while they are continued into air and walls.
All of it is computed by the same kernels from the same numbers in the same order as by one process, so that runs on any number of ranks
differ by the rounding in the solver and in sums over all particles alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.distributed.density_correction import SharedCrowding, SharedDensityCorrection
from warp_lcp.distributed.particles import SharedParticles
from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.fluids.distributed.extension import Refill, too_far
from warp_lcp.fluids.distributed.pressure import DistributedPressure
from warp_lcp.fluids.distributed.probes import SharedProbes
from warp_lcp.fluids.distributed.state import CELLS, Piece, piece_of, take_pieces
from warp_lcp.fluids.distributed.surface import SharedSurface
from warp_lcp.fluids.distributed.tension import SharedSurfaceTension
from warp_lcp.fluids.models import make_surface, make_tension, pressure_settings
from warp_lcp.fluids.pressure import PressureProjection
from warp_lcp.fluids.scene import LiquidScene
from warp_lcp.fluids.simulator import LiquidSimulation
from warp_lcp.fluids.surface import FreeSurface
from warp_lcp.fluids.surface_tension import SurfaceTension
from warp_lcp.grid.particles import ParticleTotals
from warp_lcp.grid.staggered import Window
from warp_lcp.material.particle_assembly import Parts
from warp_lcp.material.particle_log import Row
from warp_lcp.material.particle_rearrangement import Rearrangement
from warp_lcp.material.particle_state import signature
from warp_lcp.material.sources import Outlets
from warp_lcp.simulation import SimulationFailed, StepFailed


class DistributedLiquid(LiquidSimulation):
    """A rank's part of a liquid in progress; implements `warp_lcp.simulation.Simulation`.

    Making it, `stable_dt`, `step`, `mark` and `restore_pieces` are collective and give every rank the same numbers, or raise the same error
    on all: rows of the log are of the whole liquid. `frame` shows this rank's particles and cells, with positions and cells' numbers of the
    whole domain; `frame`, `piece_state`, `columns` and `notes` ask nobody.

    Args:
        scene: what to simulate.
        part: where this rank works.
        parts: the solids that meet it, and sources.
        particles: this rank's.
        more: solids, outlets and notes, as of the base class.
    """

    shared = True
    particles: SharedParticles
    projection: DistributedPressure

    def __init__(self, scene: LiquidScene, part: Subdomain, parts: Parts, particles: SharedParticles, **more: Any) -> None:
        """Allocate the fields and find the liquid's cells."""
        self.part = part
        self._dt = 0.0
        super().__init__(scene, part.grid, parts, particles, **more)
        self.probes = SharedProbes(part, scene.probe, self.gravity, part.dimension) if scene.probe else None
        self._everyone = int(part.ranks.sum(particles.count))

    def _surface(self) -> FreeSurface:
        part = self.part
        return SharedSurface(part, make_surface(self.scene, self.grid, self.boundary, lambda _, density: part.fill(density), part.owned))

    def _tension(self) -> SurfaceTension | None:
        return make_tension(self.scene, self.grid, self.boundary, self.surface, partial(SharedSurfaceTension, self.part))

    def _pressure(self) -> PressureProjection:
        solver = wl.METHODS[self.scene.solver.method](precision=self.scene.solver.precision)
        return DistributedPressure(self.part, self.boundary, solver, **pressure_settings(self.scene, self.surface, self.weights))

    def _rearrangement(self) -> Rearrangement:
        crowding, correction = partial(SharedCrowding, self.part), partial(SharedDensityCorrection, self.part)
        return Rearrangement(self.scene, self.grid, self.boundary, crowding=crowding, correction=correction)

    def _flights(self) -> None:
        """Bodies reach across the cuts between ranks, where none of them knows the whole of one."""

    def mark(self) -> None:
        """Find the liquid's cells, and show them."""
        self.particles.arrange(0)
        super().mark()
        self.particles.drop_ghosts()

    def step(self, dt: float) -> Row:
        """Advance by dt [s]; see the base class. What it raises is raised on all ranks."""
        self._dt = dt
        try:
            return super().step(dt)
        except (StepFailed, SimulationFailed):
            self.particles.drop_ghosts()
            raise

    def bring_to_faces(self, window: Window) -> None:
        """Bring the particles' velocities to the faces, and let gravity act on them."""
        super().bring_to_faces(window)
        with self.watch.stage("exchange between ranks", *self.velocity, *self.weights):
            self.part.fill(*self.velocity, *self.weights, *(self._saved or ()))

    def extend(self, window: Window, known: Sequence[wp.array], kind: wp.array, contact: wp.array) -> None:
        """Continue the velocity into air and walls, see the base class; it is then right in all ghost layers.

        Raises:
            StepFailed: it is so fast that particles would leave the ghost layers.
        """
        refill = Refill(self.part)
        with self.watch.stage("extrapolation", *self.velocity, *self.weights, *known, kind, contact, *self.boundary.open):
            self.boundary.extend(window, self.velocity, self.weights, list(known), kind, contact, self.layers, join=refill)
            if self.sources is not None:
                self.sources.hold(self.velocity, [])
            self.part.fill(*self.velocity)
        cells = float(self.part.ranks.max(too_far(self.part, self.velocity, self._dt)))
        if cells > 0.0:
            raise StepFailed(
                f"step {self.step_count}: the velocity would take liquid {cells:.1f} cells far, and a rank knows {self.part.layers - 1} "
                "around its box"
            )

    def bring_to_particles(self, window: Window, kind: wp.array, dt: float) -> None:
        """Give this rank's own particles the velocity of the faces."""
        self.particles.drop_ghosts()
        super().bring_to_particles(window, kind, dt)

    def met(self) -> tuple[int, int, int]:
        """Return how many of all met a wall, were pushed by a solid, and are stuck inside one."""
        met, pushed, stuck = self.part.ranks.sum(np.array(super().met()))
        return int(met), int(pushed), int(stuck)

    def _exchange(self, dt: float) -> dict[str, int]:
        """Exchange this rank's particles with sources and outlets; return what all ranks have."""
        mine = super()._exchange(dt)
        total = dict(zip(mine, self.part.ranks.sum(np.array([*mine.values()])).tolist(), strict=True))
        self._everyone += total["emitted"] - total["drained"] - total["departed"]
        return total

    def _remove_departed(self, outlets: Outlets) -> int:
        gone = int(self.part.ranks.sum(super()._remove_departed(outlets)))
        self._everyone -= gone
        return gone

    def _meet_walls(self, window: Window, dt: float) -> Row:
        """Collect what the projection has done to solids in this rank's box, and let walls drag there."""
        row = super()._meet_walls(self.part.owned, dt)
        if self.wall_drag is not None:
            self.part.fill(*self.velocity)
        return {name: float(self.part.ranks.sum(value)) for name, value in row.items()}

    def _measure(self) -> None:
        """Fill the rows of the tables by what all ranks have found."""
        if self.forces is not None and self.scene.output.forces:
            self.forces.impulses = self.part.ranks.sum(self.forces.impulses)
        super()._measure()

    def checked_totals(self, when: str) -> ParticleTotals:
        """Return sums over all ranks' particles.

        Raises:
            SimulationFailed: a value is not finite, a particle lies outside the domain, or not all are there; on all ranks.
        """
        totals = super().checked_totals(when)
        if totals.count != self._everyone:
            raise SimulationFailed(f"{when} step {self.step_count}: {totals.count} particles are there, of {self._everyone}")
        return totals

    def _trouble(self, totals: ParticleTotals, end: np.ndarray) -> str:
        """Return what the root rank says on whose part something is wrong."""
        told = self.part.ranks.comm.allgather(super()._trouble(totals, end))
        return next((text for text in told if text), "")

    def _totals_row(self, totals: ParticleTotals, dt: float) -> Row:
        return super()._totals_row(totals, dt) | {"particles": totals.count}

    def notes(self) -> list[str]:
        """Return warnings and facts worth a line at the start of a run."""
        boxes, whole = self.part.decomposition.boxes, self.part.decomposition.counts
        most = max(boxes, key=lambda box: box.cells).counts
        cells, largest = (" x ".join(map(str, counts[: self.grid.dimension])) for counts in (whole, most))
        return [
            f"{self._everyone} particles, {cells} cells of {self.grid.spacing:.4g} m",
            f"{len(boxes)} ranks, boxes of up to {largest} cells and {self.part.layers} layers of ghost cells",
            *self._notes,
        ]

    def piece_state(self) -> dict[str, np.ndarray]:
        """Return this rank's part of the state, without pickles, in the whole domain's coordinates.

        Names and shapes: `box` int64 (2, 3), the low and high (exclusive) cell x, y, z of this rank; `counts` int64 (3,), the whole grid's;
        `time`, `step_count`, `last_dt`, `pressure_dt`, `signature` as of `state`, `time_error` (2,), the same on all ranks; particles:
        `position`, `velocity`, `affine_0` ... float32 (n, 3) and `place` int64 (n,), their order; of the box, shape (nz, ny, nx):
        `pressure` float64, `cells` int8, `contact` uint8, and once particles were moved apart `density_correction` float64.
        """
        box, own = self.part.box, self.own_state()
        fields = {name: own[name] for name in CELLS} | self.rearrangement.state()
        fields = {name: np.ascontiguousarray(self.part.box_of(field)) for name, field in fields.items()}
        clock = {"time": np.array(self.time), "step_count": np.array(self.step_count), "last_dt": np.array(self.last_dt)}
        where = {"box": np.array([box.low, box.high]), "counts": np.array(self.part.decomposition.counts)}
        particles = {name: array.numpy().copy() for name, array in self.particles.arrays().items()}
        numbers = {name: own[name] for name in ("pressure_dt", "time_error")} | {"signature": signature(self.scene, self.part.grid)}
        return where | clock | numbers | particles | {"place": self.particles.place.copy()} | fields

    def restore_pieces(self, pieces: Sequence[Piece]) -> None:
        """Continue from the pieces of all ranks of a run on any number of ranks; each rank takes what lies in its box. Collective.

        Args:
            pieces: of `piece_state`, of all ranks, in any order. Of a piece that has nothing in this rank's box grown by some cells the
                arrays of particles and cells are not read.

        Raises:
            ValueError: the pieces do not belong to this scene, or do not cover the domain; on all ranks.
        """
        names, own_signature = list(self.particles.arrays()), signature(self.scene, self.part.grid)
        base = None if self.boundary.moves else self.boundary.base
        particles, cells, numbers = take_pieces(self.part, names, own_signature, pieces, base)
        everyone = int(self.part.ranks.sum(len(particles["place"])))
        if everyone != self._everyone and not (self.sources or self.outlets):
            raise ValueError(f"the pieces have {everyone} particles: this scene has {self._everyone}")
        self._everyone = everyone
        self.particles.assign_with_places(particles, particles["place"])
        self._faces_know = False
        self.rearrangement.expect(cells)
        own, moved = self.own_state(), self.rearrangement.state()
        for name, values in cells.items():
            self.part.box_of((own | moved)[name])[...] = values
        self.rearrangement.restore(moved)
        self.restore_own(own | {name: numbers[name] for name in ("pressure_dt", "time_error")})
        self.time, self.step_count, self.last_dt = float(numbers["time"]), int(numbers["step_count"]), float(numbers["last_dt"])
        self.boundary.place(self.time)

    def state(self) -> dict[str, np.ndarray]:
        """Return this rank's part of the state, see `piece_state`."""
        return self.piece_state()

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from the state of a simulation in one process; collective."""
        self.restore_pieces([state if "box" in state else piece_of(state)])
