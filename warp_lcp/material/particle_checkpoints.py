"""Checkpoints of particle simulations, for any grid and number of ranks."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from warp_lcp.grid.grid_part import subdomain_of
from warp_lcp.grid.particle_ids import ID, NO_ID, ParticleIds, cell_numbers, pack_ids, unpack_ids
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.material.domain_window import DomainWindow, carry_over
from warp_lcp.material.narrow_band import without_band
from warp_lcp.material.particle_frames import ParticleFrames
from warp_lcp.material.particle_pieces import IDENTITY, Piece, piece_of, state_of
from warp_lcp.material.particle_redistribution import ParticleRedistribution
from warp_lcp.material.particle_scene import ParticleScene
from warp_lcp.material.particle_state import check_state, other_spacing, signature
from warp_lcp.material.resample import resampled, resampling_notes
from warp_lcp.material.sources import Outlets, Sources
from warp_lcp.material.spray import Spray

if TYPE_CHECKING:
    from warp_lcp.distributed.subdomain import Subdomain


class ParticleCheckpoints(ParticleFrames):
    """Save, restore and resample the state of a simulation, and add particles.

    Attributes as of `ParticleSimulation`.
    """

    scene: ParticleScene
    spray: Spray
    rearrangement: ParticleRedistribution
    sources: Sources | None
    outlets: Outlets | None
    time: float
    step_count: int
    last_dt: float
    added = 0  # particles, by a program
    _coverage: DomainWindow | None

    @abstractmethod
    def mark(self) -> None:
        """Find the material's cells from the sorted particles.

        Frames show them before the first step.
        """

    @abstractmethod
    def regrid(self, grid: StaggeredGrid, state: Mapping[str, np.ndarray] | None = None) -> None:
        """Continue on another grid of the same domain."""

    @abstractmethod
    def _move_window(self, grid: StaggeredGrid) -> None:
        """Allocate another grid; its fields have no values yet."""

    @abstractmethod
    def rebalance(self) -> None:
        """Continue in better boxes of ranks, if there are any; collective."""

    @abstractmethod
    def admits(self, points: np.ndarray) -> np.ndarray:
        """Return at which points [m], shape (n, 3), a particle may be."""

    @abstractmethod
    def own_state(self) -> dict[str, np.ndarray]:
        """Return copies of the arrays for the next solve and for frames.

        They must have `cells`, int8 of AIR, FLUID, SOLID.
        """

    @abstractmethod
    def restore_own(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from the arrays of `own_state`, which have been checked.

        Shapes, types and values are correct.
        """

    def _fields(self) -> dict[str, np.ndarray]:
        """Return copies of the state's fields, and of the numbers that belong to them."""
        band = self.band.state() if self.band is not None else {}
        return self.own_state() | band | self.rearrangement.state()

    def _take_fields(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from the arrays of `_fields`."""
        self.restore_own({name: np.asarray(state[name]) for name in self.own_state()})
        self.rearrangement.restore(state)
        if self.band is not None:
            self.band.restore(state)

    def _particle_arrays(self) -> dict[str, np.ndarray]:
        """Return copies of the particles' arrays by name, with spray particles at the end."""
        return {
            name: self.spray.behind(name, array.numpy())
            for name, array in self.particles.arrays().items()
        }

    def _stored_arrays(self) -> dict[str, np.ndarray]:
        """Return `_particle_arrays` as a state has them: ids are numbers."""
        arrays = self._particle_arrays()
        if self.births is not None:
            arrays[ID] = unpack_ids(arrays.pop("identity"))
        return arrays

    def _with_identity(self, arrays: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        """Return particles of a state with the column of their ids, `NO_ID` if it has none."""
        if self.births is None:
            return arrays
        ids = arrays[ID] if ID in arrays else np.full(len(arrays["position"]), NO_ID)
        return {**arrays, "identity": pack_ids(ids)}

    def _give_ids(self, count: int, time: float) -> None:
        """Give new ids to the last particles, in the order of their cells; collective.

        Args:
            count: number of these particles on this process.
            time: time of their birth [s].
        """
        if self.births is None:
            return
        particles, begin = self.particles, self.particles.count - count
        points = particles.position[begin:].numpy() if count else np.zeros((0, 3))
        cells = cell_numbers(self.grid, points)
        self.births.give(particles, begin, self.grid.part, time, cells)

    def _renew_ids(self, births: ParticleIds) -> None:
        """Give new ids to all particles at the current time, after those of `births`; collective.

        They are those of a state without ids, or of another grid.
        """
        if self.births is not None:
            self.births = births
            self._give_ids(self.particles.count, self.time)
            if self.spray.particles.count:
                births.give(self.spray.particles, 0, self.grid.part, self.time)

    def _assign(self, arrays: Mapping[str, np.ndarray], flying: int = 0) -> None:
        """Replace the particles; the last `flying` of them are spray."""
        arrays = self._with_identity(arrays)
        on_grid = len(arrays["position"]) - (flying if self.spray.active else 0)
        self.particles.assign({name: arrays[name][:on_grid] for name in self.particles.arrays()})
        self.spray.particles.assign(
            {name: arrays[name][on_grid:] for name in self.spray.particles.arrays()}
        )
        self._faces_know = False

    def state(self) -> dict[str, np.ndarray]:
        """Return the arrays that `restore` needs to continue, bit for bit on the CPU.

        If the grid covers a part of the domain, its `box` is included.

        On several ranks it is this rank's piece of the state, in the whole domain's coordinates,
        without pickles. Names and shapes: `box` int64 (2, 3), the low and high (exclusive) cell x,
        y, z of this rank; `counts` int64 (3,), the whole grid's; `time`, `step_count`, `last_dt`,
        `signature`; particles: `position`, `velocity`, `affine_0` ... float32 (n, 3) and `place`
        int64 (n,), their order; of the box, shape (..., nz, ny, nx): `cells` int8, the other fields
        of `own_state` and those of a narrow band, and once particles were moved apart
        `density_correction` float64; the numbers of `own_state`, of a band and of bodies, the same
        on all ranks. With `output.ids` particles have `id` int64 (n,), and all ranks the table of
        `ParticleIds.state`.
        """
        part, flying = self.grid.part, self.spray.particles.count
        counts = {"spray": flying, "added": self.added}
        particles = self._stored_arrays() | {
            name: np.array(count) for name, count in counts.items() if count
        }
        particles |= self.particles.exchange.state()
        clock = {
            "time": np.array(self.time),
            "step_count": np.array(self.step_count),
            "last_dt": np.array(self.last_dt),
        }
        bodies = self.bodies.state() if self.bodies is not None else {}
        known = {"signature": signature(self.scene, self.grid)}
        births = self.births.state() if self.births is not None else {}
        fields = part.checkpoint_fields(self._fields())
        return clock | known | particles | births | fields | bodies | part.where()

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from `state`, on ranks that of one process; collective.

        Raises:
            ValueError: the arrays do not belong to this scene; on all ranks.
        """
        if self.grid.part.shared:
            self.restore_pieces([state if "box" in state else piece_of(state)])
            return
        state = self._on_this_grid(state)
        self.rearrangement.expect(state)
        # Velocities of older states belong to the time of the state itself. Subclasses check the
        # arrays that they add.
        expected = ParticleCheckpoints.state(self)
        state = {"last_dt": np.array(0.0), **state}
        self.added = int(state.get("added", 0))
        varies = bool(self.sources or self.outlets or self.band or self.added)
        check_state(
            state,
            {name: array for name, array in expected.items() if name not in IDENTITY},
            changing=[*self.particles.arrays()] if varies else [],
            solids_move=self.boundary.moves,
        )
        has_ids = self._has_ids(state)
        self._assign(state, int(state.get("spray", 0)))
        self._take_fields(state)
        self._take_clock(state)
        if not has_ids:
            self._renew_ids(ParticleIds())

    def _has_ids(self, state: Mapping[str, np.ndarray]) -> bool:
        """Return whether a state has ids; take over its table of births.

        Raises:
            ValueError: they are damaged.
        """
        if self.births is None or ID not in state:
            return False
        ids, count = np.asarray(state[ID]), len(state["position"])
        if (ids.shape, ids.dtype) != ((count,), np.dtype(np.int64)):
            raise ValueError(f"the state's {ID} is {ids.dtype}{ids.shape}: must be int64({count},)")
        self.births.restore(state, [ids])
        return True

    def _take_clock(self, state: Mapping[str, np.ndarray]) -> None:
        """Set time, bodies and places of solids to those of a state."""
        self.time, self.step_count, self.last_dt = (
            float(state["time"]),
            int(state["step_count"]),
            float(state["last_dt"]),
        )
        if self.bodies is not None:
            self.bodies.restore(state)
        self.boundary.place(self.time)

    def restore_pieces(self, pieces: Sequence[Piece]) -> None:
        """Continue from the pieces of all ranks of a run; collective.

        The run may have had any number of ranks. Each rank takes the data in its box.

        Args:
            pieces: pieces of `state`, of all ranks, in any order. Of a piece that has nothing in
                this rank's box grown by some cells the arrays of particles and cells are not read.

        Raises:
            ValueError: the pieces do not belong to this scene, or do not cover the domain; on all
                ranks.
        """
        if not self.grid.part.shared:
            if self.grid.whole is not None and self._coverage is not None:
                self.regrid(self._coverage.domain)
            self.restore(state_of(pieces, self.state()))
            return
        part = subdomain_of(self.grid)
        expected, found = self._global_count(), part.of_pieces(pieces)
        if found is not None and found is not part:
            self._work_on(found)
        self._take_pieces(pieces, expected)
        if found is None:  # the boxes are those of the start
            self.particles.totals()
            self.rebalance()

    def repartition(self, part: Subdomain) -> None:
        """Continue in other boxes of the same ranks; collective."""
        before, piece, expected = subdomain_of(self.grid), self.state(), self._global_count()
        self._work_on(part)
        self._take_pieces([part.migrate(piece, self._stored_names(), before)], expected)

    def _stored_names(self) -> list[str]:
        """Return the names of the particles' arrays in a state."""
        return [ID if name == "identity" else name for name in self.particles.arrays()]

    def _global_count(self) -> int:
        """Return the number of particles on all ranks, narrow band interior included."""
        return sum(self.particles.exchange.counts) + (
            self.band.held if self.band is not None else 0
        )

    def _work_on(self, part: Subdomain) -> None:
        """Allocate the arrays of another part of the grid.

        Its particles and fields have no values yet.
        """
        self._move_window(part.grid)
        part.ranks.free_ended()

    def _take_pieces(self, pieces: Sequence[Piece], expected: int) -> None:
        """Continue from the data of pieces in this rank's box; collective.

        Args:
            pieces: pieces of all ranks, or that of this box.
            expected: number of particles of all pieces if none enter or leave.
        """
        part = subdomain_of(self.grid)
        names, bodies = (
            self._stored_names(),
            self.bodies.state() if self.bodies is not None else {},
        )
        band = self.band.state() if self.band is not None else {}
        own_state = self.own_state() | band
        births = self.births.state() if self.births is not None else {}
        has_ids = ID in names and all(ID in piece for piece in pieces)
        if ID in names and not has_ids:
            names.remove(ID)
            births = {}
        solids = None if self.boundary.moves else own_state["cells"]
        particles, cells, numbers = part.take_pieces(
            pieces, names, own_state | bodies | births, signature(self.scene, self.grid), solids
        )
        if self.births is not None and has_ids:
            self.births.restore(numbers)
        interior = int(numbers["interior"][0]) if self.band is not None else 0
        everyone = int(part.ranks.sum(len(particles["place"]))) + interior
        if everyone != expected and not (self.sources or self.outlets):
            raise ValueError(f"the pieces have {everyone} particles: this scene has {expected}")
        self.particles.exchange.assign(self._with_identity(particles), particles["place"])
        self._faces_know = False
        self.rearrangement.expect(cells)
        state = own_state | self.rearrangement.state()
        for name, values in cells.items():
            part.box_of(state[name])[...] = values
        self._take_fields(
            state | {name: numbers[name] for name in own_state.keys() & numbers.keys()}
        )
        self._take_clock(numbers)
        if not has_ids:
            self._renew_ids(ParticleIds())

    def _on_this_grid(self, state: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        """Use the grid of a state if the scene allows that, else convert the state.

        Raises:
            ValueError: its box is not in this domain.
        """
        same = np.array_equal(state.get("signature", ()), signature(self.scene, self.grid))
        grid = (
            self._coverage.at(state.get("box"))
            if self._coverage is not None and same
            else self.grid
        )
        if grid != self.grid and self.scene.domain.follow:
            self.regrid(grid, state)
        if grid == self.grid:
            return state
        self.rearrangement.expect(state)
        return carry_over(state, grid, self.grid, self._fields())

    def resample(self, state: Mapping[str, np.ndarray]) -> list[str]:
        """Continue from the state of the same scene on another grid.

        The particles are resampled, and the next solve starts without a guess. Resampled particles
        are new ones: they get ids that have not been used, and their age is 0.

        Raises:
            ValueError: the state differs in more than the grid, or no particle is left.
        """
        spacing = other_spacing(state, self.scene, self.grid)
        if self.bodies is not None and "bodies" not in state:
            raise ValueError("the state has no bodies: it does not belong to this scene")
        self._take_clock(state)
        settings, wanted = self.scene.particles, self.particles.arrays().keys() - {"identity"}
        births = ParticleIds()
        if self._has_ids(state) and self.births is not None:
            births = self.births
        state = without_band(state, spacing, settings.seed)
        arrays, moved = resampled(
            {name: np.asarray(state[name]) for name in wanted},
            self.grid,
            self.admits,
            spacing=spacing,
            per_axis=settings.per_axis,
            random_seed=settings.seed + self.step_count,
        )
        self._assign(arrays)
        if self.band is not None:
            self.band.forget()
        self.particles.sort()
        self._renew_ids(births)
        self.mark()
        return resampling_notes(
            len(state["position"]), self.particles.count, moved, spacing, self.grid
        )

    def add(self, position: np.ndarray, velocity: np.ndarray) -> None:
        """Add particles between two steps.

        Positions [m] and velocities [m/s] have the shape (n, 3). Positions must be where the
        material may be.
        """
        self.particles.append(position, velocity)
        self._give_ids(len(position), self.time)
        self.added += len(position)
        self._faces_know = False
        self.particles.sort()
