"""Particles and their fields on the ranks of MPI: each has a box of the domain, and the particles in it.

A step is that of one process on the part of the grid around a rank's box. What another rank knows comes in where the chain of dependence
needs it: particles a cell from the cut before they are brought to the faces; velocities and weights of the faces; what a material finds of
its cells; the solve, which is one of all ranks; the velocity that it leaves, and again while that is continued into air and walls.
All of it is computed by the same kernels from the same numbers in the same order as by one process, so that runs on any number of ranks
differ by the rounding in the solver and in sums over all particles alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.distributed.balance import Balance
from warp_lcp.distributed.decomposition import CellBox, Decomposition
from warp_lcp.distributed.extension import Refill, too_far
from warp_lcp.distributed.flight import SharedFlights
from warp_lcp.distributed.migration import cuts_of, handed_over
from warp_lcp.distributed.particle_pieces import take_pieces
from warp_lcp.distributed.particles import SharedParticles
from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.grid.particles import SORTED, UNSORTED, ParticleTotals
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.material.flight import Flights
from warp_lcp.material.particle_assembly import Parts, make_flights
from warp_lcp.material.particle_log import Row
from warp_lcp.material.particle_pieces import Piece, fields_of, piece_of
from warp_lcp.material.particle_scene import ParticleScene
from warp_lcp.material.particle_simulation import ParticleSimulation
from warp_lcp.material.particle_state import signature
from warp_lcp.material.sources import Outlets
from warp_lcp.material.wall import Join
from warp_lcp.simulation import Cells, Part, SimulationFailed, StepFailed, Surface, Volume


class SharedParticleSimulation(ParticleSimulation):
    """A rank's part of a material in progress; with a subclass of `ParticleSimulation` it implements `warp_lcp.simulation.Simulation`.

    Making it, `stable_dt`, `step`, `mark` and `restore_pieces` are collective and give every rank the same numbers, or raise the same error
    on all: rows of the log are of the whole material. `frame` shows this rank's particles and cells, with positions and cells' numbers of
    the whole domain; it is collective, too. `piece_state`, `columns` and `notes` ask nobody.

    A class is made of the material's own simulation and this one, in this order. Its `mark` is in `with_ghosts`, its `step` in `attempt`,
    its `frame` is `in_box`.

    Args:
        scene: what to simulate.
        grid: that of the part.
        parts: the solids that meet it, and sources.
        particles: this rank's; they know the part.
        make_parts: makes solids and sources of another part.
        more: as of the base class.

    Attributes:
        part: where this rank works.
        balance: says when the ranks' boxes are cut anew.
    """

    shared = True
    particles: SharedParticles

    def __init__(
        self, scene: ParticleScene, grid: StaggeredGrid, parts: Parts, particles: SharedParticles, *,
        make_parts: Callable[[Subdomain], Parts], **more: Any,
    ) -> None:  # fmt: skip
        """Allocate the fields, fill the sources that run at the start and sort the particles."""
        self.part, self.balance, self._make_parts = particles.part, Balance(), make_parts
        self._dt = 0.0
        super().__init__(scene, grid, parts, particles, **more)
        self._everyone = int(self.part.ranks.sum(particles.count)) + self._in_band

    @property
    def _in_band(self) -> int:
        """How many particles the material without any stands for."""
        return self.band.held if self.band is not None else 0

    def surfaces(self) -> list[Surface]:
        """Return the surface in this rank's box; collective."""
        if self.surface_mesh is None:
            return []
        with self.with_ghosts(UNSORTED):
            return super().surfaces()

    def volumes(self) -> list[Volume]:
        """Return the whole domain's level set and density on the root rank: no reader makes one volume of several. Collective."""
        if self.particle_volume is None:
            return []
        with self.with_ghosts(UNSORTED):
            mine = super().volumes()
        first = [box - origin for box, origin in zip(self.part.box.low, self.grid.origin, strict=True)]
        inside = CellBox((0, 0, 0), self.part.box.counts).moved(first).slices
        whole = [self.part.gathered(volume.values[inside]) for volume in mine]
        return [replace(volume, values=v, origin=(0, 0, 0)) for volume, v in zip(mine, whole, strict=True) if v is not None]

    def _flights(self) -> Flights | None:
        return make_flights(self.scene, self.grid, self.boundary, partial(SharedFlights, self.part))

    def _follow(self, totals: ParticleTotals, dt: float) -> None:
        """Cut the ranks' boxes anew in a step in which that pays."""
        if self.balance.due(self.part, self.step_count):
            self._rebalance()

    def _rebalance(self) -> None:
        """Go on in the boxes in which the busiest rank has least to do, if they are much better than those there are; collective."""
        with self.watch.stage("repartitioning", self.particles.position):
            found = self.balance.better(self.part, self.particles, self.scene.particles.per_axis**self.part.dimension)
            if found is not None:
                self.repartition(found)

    def repartition(self, decomposition: Decomposition) -> None:
        """Go on in other boxes of the same ranks; collective."""
        before, piece, names = self.part, self.piece_state(), list(self.particles.arrays())
        self._work_on(before.repartition(decomposition))
        self._take_pieces([handed_over(piece, names, before, self.part, self.particles.post)])

    def _work_on(self, part: Subdomain) -> None:
        """Make what belongs to a part; its particles and fields are still to come."""
        self.part = part
        self.particles.work_on(part)
        self._lay_anew(part.grid, lambda _: self._make_parts(part))
        part.ranks.free_ended()

    def in_box(self, frame: list[Part]) -> list[Part]:
        """Return a frame of this rank whose cells know the box that they are from."""
        box = self.part.box
        return [replace(part, box=(box.low, box.high)) if isinstance(part, Cells) else part for part in frame]

    @contextmanager
    def with_ghosts(self, step: int = SORTED) -> Iterator[None]:
        """Let the particles around this rank's box be there, arranged as in a step of this number."""
        self.particles.arrange(step)
        self.particles.lie_in_order()
        yield
        self.particles.drop_ghosts()

    @contextmanager
    def attempt(self, dt: float) -> Iterator[None]:
        """Take a step of dt [s], after which ghosts are gone even if it fails."""
        self._dt = dt
        try:
            yield
        except (StepFailed, SimulationFailed):
            self.particles.drop_ghosts()
            self.restore_bodies()
            raise

    def extrapolate_velocity(self, window: Window, known: Sequence[wp.array], kind: wp.array, contact: wp.array) -> None:
        """Continue the velocity into air and walls, see the base class; it is then right in all ghost layers.

        Raises:
            StepFailed: it is so fast that particles would leave the ghost layers.
        """
        super().extrapolate_velocity(window, known, kind, contact)
        cells = float(self.part.ranks.max(too_far(self.part, self.velocity, self._dt)))
        if cells > 0.0:
            raise StepFailed(
                f"step {self.step_count}: {self.scene.materials()[0]} would move {cells:.1f} cells, more than the ghost layers of a rank, "
                f"{self.part.layers - 1}"
            )

    def _layer_filled(self) -> Join | None:
        return Refill(self.part)

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

    def checked_totals(self, when: str) -> ParticleTotals:
        """Return sums over all ranks' particles.

        Raises:
            SimulationFailed: a value is not finite, a particle lies outside the domain, or not all are there; on all ranks.
        """
        totals = super().checked_totals(when)
        if totals.count != self._everyone:
            raise SimulationFailed(f"{when} step {self.step_count}: {totals.count} particles are left of {self._everyone}")
        return totals

    def _trouble(self, totals: ParticleTotals, end: np.ndarray) -> str:
        """Return what the root rank says on whose part something is wrong."""
        told = self.part.ranks.collect(super()._trouble(totals, end))
        return next((text for text in told if text), "")

    def _totals_row(self, totals: ParticleTotals, dt: float) -> Row:
        return super()._totals_row(totals, dt) | {"particles": totals.count - self._in_band}

    def notes(self) -> list[str]:
        """Return warnings and facts worth a line at the start of a run."""
        boxes, whole = self.part.decomposition.boxes, self.part.decomposition.counts
        most = max(boxes, key=lambda box: box.cells).counts
        cells, largest = (" x ".join(map(str, counts[: self.grid.dimension])) for counts in (whole, most))
        return [
            f"{self._everyone - self._in_band} particles, {cells} cells of {self.grid.spacing:.4g} m",
            f"{len(boxes)} ranks, boxes of up to {largest} cells and {self.part.layers} layers of ghost cells",
            *self._notes,
        ]

    def body_surfaces(self) -> list[Surface]:
        """Return the rigid bodies as a frame shows them, on the root rank alone."""
        return super().body_surfaces() if self.part.ranks.is_root else []

    def piece_state(self) -> dict[str, np.ndarray]:
        """Return this rank's part of the state, without pickles, in the whole domain's coordinates.

        Names and shapes: `box` int64 (2, 3), the low and high (exclusive) cell x, y, z of this rank; `counts` int64 (3,), the whole grid's;
        `time`, `step_count`, `last_dt`, `signature` as of `state`; particles: `position`, `velocity`, `affine_0` ... float32 (n, 3) and
        `place` int64 (n,), their order; of the box, shape (..., nz, ny, nx): `cells` int8, the other fields of `own_state` and those of a
        narrow band, and once particles were moved apart `density_correction` float64; the numbers of `own_state`, of a band and of
        bodies, the same on all ranks.
        """
        box, own = self.part.box, self._own_fields()
        fields = {name: np.ascontiguousarray(self.part.box_of(field)) for name, field in self._cell_fields(own).items()}
        clock = {"time": np.array(self.time), "step_count": np.array(self.step_count), "last_dt": np.array(self.last_dt)}
        where = {"box": np.array([box.low, box.high]), "counts": np.array(self.part.decomposition.counts)}
        particles = {name: array.numpy().copy() for name, array in self.particles.arrays().items()}
        numbers = own | {"signature": signature(self.scene, self.part.grid)}
        return where | clock | numbers | particles | {"place": self.particles.place.copy()} | fields

    def _own_fields(self) -> dict[str, np.ndarray]:
        parts = (part.state() for part in (self.band, self.bodies) if part is not None)
        return self.own_state() | {name: values for part in parts for name, values in part.items()}

    def _cell_fields(self, own: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        return fields_of(own) | self.rearrangement.state()

    def restore_pieces(self, pieces: Sequence[Piece]) -> None:
        """Continue from the pieces of all ranks of a run on any number of ranks; each rank takes what lies in its box. Collective.

        Args:
            pieces: of `piece_state`, of all ranks, in any order. Of a piece that has nothing in this rank's box grown by some cells the
                arrays of particles and cells are not read.

        Raises:
            ValueError: the pieces do not belong to this scene, or do not cover the domain; on all ranks.
        """
        with self.part.decomposition.collective.led():
            cuts = cuts_of(pieces, self.part)
        if cuts is not None and cuts != self.part.decomposition.parts:
            self._work_on(self.part.repartition(self.part.decomposition.repartition(cuts)))
        self._take_pieces(pieces)
        if cuts is None and self.part.ranks.size > 1:
            self.particles.totals()
            self._rebalance()

    def _take_pieces(self, pieces: Sequence[Piece]) -> None:
        own, names = self._own_fields(), list(self.particles.arrays())
        base = None if self.boundary.moves else self._still_solids()
        particles, cells, numbers = take_pieces(self.part, names, own, signature(self.scene, self.part.grid), pieces, base)
        everyone = int(self.part.ranks.sum(len(particles["place"]))) + (int(numbers["interior"][0]) if self.band is not None else 0)
        if everyone != self._everyone and not (self.sources or self.outlets):
            raise ValueError(f"the pieces have {everyone} particles: this scene has {self._everyone}")
        self._everyone = everyone
        self.particles.assign_with_places(particles, particles["place"])
        self._faces_know = False
        self.rearrangement.expect(cells)
        fields = self._cell_fields(own)
        for name, values in cells.items():
            self.part.box_of(fields[name])[...] = values
        self.rearrangement.restore(fields)
        found = own | {name: numbers[name] for name in own.keys() & numbers.keys()}
        self.restore_own({name: found[name] for name in self.own_state()})
        if self.band is not None:
            self.band.restore(found)
        self.time, self.step_count, self.last_dt = float(numbers["time"]), int(numbers["step_count"]), float(numbers["last_dt"])
        if self.bodies is not None:
            self.bodies.restore(numbers)
        self.boundary.place(self.time)

    def _still_solids(self) -> wp.array:
        """Return int8, SOLID where `cells` of a state are."""
        return self.boundary.base

    def state(self) -> dict[str, np.ndarray]:
        """Return this rank's part of the state, see `piece_state`."""
        return self.piece_state()

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from the state of a simulation in one process; collective."""
        self.restore_pieces([state if "box" in state else piece_of(state)])
