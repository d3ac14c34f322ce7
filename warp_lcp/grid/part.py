"""The part of a grid that a process works on, and what it finds out from the processes that work on the others.

One process works on all of the grid; then nothing is exchanged, and a sum over all processes is the
number itself. The part of a rank among several is `warp_lcp.distributed.subdomain.Subdomain`.
Methods named *collective* must be called by every rank, in the same order, also by one that has no
material.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import warp as wp

from warp_lcp.kernels.launch_graph import Task
from warp_lcp.kernels.vectors import convert
from warp_lcp.operators.grid_poisson import GridPoisson

if TYPE_CHECKING:
    from warp_lcp.grid.particles import Particles, ParticleTotals
    from warp_lcp.grid.staggered import StaggeredGrid, Window
    from warp_lcp.kernels.vectors import Communicator


class OneProcess:
    """The only process: what `warp_lcp.distributed.ranks.Ranks` finds out about all is what it knows."""

    size, rank, is_root = 1, 0, True

    def sum(self, values: Any) -> Any:
        """Return the sum over the processes of a number or an array."""
        return values

    def max(self, values: Any) -> Any:
        """Return the maximum over the processes, entry by entry."""
        return values

    def any(self, condition: bool) -> bool:
        """Return whether a condition holds on any process."""
        return bool(condition)

    def gather(self, values: Any) -> np.ndarray:
        """Return an array of every process, shape (processes, *values.shape)."""
        return np.asarray(values)[None]

    def share(self, value: Any) -> Any:
        """Return the object of the first process."""
        return value

    def collect(self, value: Any) -> list[Any]:
        """Return an object of every process."""
        return [value]


Corner = tuple[int, int, int]

ONE_PROCESS = OneProcess()


class ParticleExchange:
    """What a process's particles have to do with those of the others: here there are none.

    `warp_lcp.distributed.particles.ParticleMigration` is that of a rank among several.

    Args:
        particles: of this process.

    Attributes:
        room: of the storage over the particles that it is made for.
    """

    room = 1.0

    def __init__(self, particles: Particles) -> None:
        self.particles = particles

    @property
    def counts(self) -> list[int]:
        """Particles of each process, as the last totals have found them."""
        return [self.particles.count]

    @property
    def expected(self) -> int:
        """How many particles all processes must have, as the last totals have found it: nothing but `append` and removal changes it."""
        return self.particles.count

    def move_to(self, part: GridPart) -> None:
        """Work on another part of the grid from now on."""

    def state(self) -> dict[str, np.ndarray]:
        """Return what a checkpoint keeps besides the particles' arrays."""
        return {}

    def next_place(self) -> int:
        """Return a place in the order of sums that is behind those of all particles; collective."""
        return 0

    def assign(self, arrays: Mapping[str, np.ndarray], place: np.ndarray) -> None:
        """Take other particles, in the order of their places; collective.

        Args:
            arrays: float32 of shape (n, 3) for every name of `Particles.arrays`.
            place: int64, shape (n,).
        """
        order = np.argsort(place, kind="stable")
        self.particles.assign(
            {name: np.ascontiguousarray(values[order]) for name, values in arrays.items()}
        )

    def count(self) -> None:
        """Count the particles of all processes; collective."""

    def appended(self, count: int) -> None:
        """Take notice of so many particles that have been added behind the others."""

    def removing(self, marks: wp.array) -> None:
        """Take notice of the particles that are about to be removed: those whose mark is not 0."""

    def begin_sort(self) -> None:
        """Bring the particles into the order that a stable sort starts from."""

    def end_sort(self) -> None:
        """Take notice of the order of a sort."""

    def arrange(self, *, sort: bool) -> None:
        """Hand on particles that have left this process's part, take in ghosts, and sort or number all by cell; collective."""
        if sort:
            self.particles.sort()
        else:
            self.particles.number()

    def look_around(self) -> None:
        """Copy positions of other ranks' particles within a cell as ghosts; collective."""

    def drop_ghosts(self) -> None:
        """Keep this process's own particles alone."""

    def with_ghosts(self, step: int) -> AbstractContextManager[None]:
        """Return a context in which ghosts are there, all particles in the order of sums; collective.

        Args:
            step: the particles are arranged as in a step of this number.
        """
        return nullcontext()

    def joined_totals(self, own: ParticleTotals) -> ParticleTotals:
        """Return the sums over all processes' particles, given those over this one's; collective."""
        return own


@dataclass(frozen=True)
class BodyNumbers:
    """Bodies of material in flight, given the trees of cells that each process has found.

    Attributes:
        count: of bodies that this process knows.
        several: how many of them, the first ones, several processes have trees of.
        of_tree: the body of each tree of this process, int32, -1: none, shape (trees,); None: each
            tree is a body.
    """

    count: int
    several: int = 0
    of_tree: np.ndarray | None = None


class GridPart:
    """The part of a grid that a process works on: here all of it.

    Args:
        grid: the grid, whose fields have the cells of the part and a ring, or layers of ghost
            cells, around them.

    Attributes:
        grid: as given.
        ranks: the processes that work on the grid.
        decomposition: their boxes of cells; None: there is one process.
        layers: of ghost cells around the part, its ring included.
        shared: whether there may be others.
        joined: axes without an end that are cut, along which another process goes on beyond the
            domain's sides.
        cuts: has bit n set if beyond side n of the part, see `warp_lcp.grid.sides`, another process
            goes on.
    """

    shared: ClassVar[bool] = False
    layers = 0
    cuts = 0
    joined: tuple[int, ...] = ()
    ranks: Any = ONE_PROCESS
    decomposition: Any = None

    def __init__(self, grid: StaggeredGrid) -> None:
        self.grid = grid

    @property
    def across(self) -> Communicator | None:
        """The other processes, as reductions take them; None: there are none."""
        return None

    @property
    def at_once(self) -> bool:
        """Whether launches cannot be recorded where processes exchange ghost cells in them."""
        return False

    @property
    def owned(self) -> Window:
        """The cells that this process is the one to know."""
        return self.grid.domain

    @property
    def stored(self) -> Window:
        """Stored cells that this process is the one to know: the owned ones, and the ring beside them at the domain's sides."""
        return self.grid.everywhere

    @property
    def first(self) -> tuple[int, int, int]:
        """The first of them along x, y, z, counted from 0 in the whole domain."""
        return self.grid.origin

    def keep_own(self, cells: np.ndarray) -> None:
        """Set a mask of the part's cells, bool of shape (nz, ny, nx), to False where another process owns them."""

    def exchange_of(self, particles: Particles) -> ParticleExchange:
        """Return what particles on this part have to do with those of other processes."""
        return ParticleExchange(particles)

    def nearest(self, cells: np.ndarray) -> np.ndarray:
        """Return cells (x, y, z) of the part, shape (n, 3), along axes without an end those images that are nearest to it."""
        return cells

    def near(self, window: Window, layers: int) -> Window | None:
        """Return the cells of a window that this process owns or that are at most so many layers away; None: none."""
        return window

    def join_trees(
        self, trees: int, seen: Window | None, parent: wp.array, number: wp.array, held: wp.array
    ) -> BodyNumbers:
        """Join the trees of cells that reach over several processes' parts to bodies; collective.

        Args:
            trees: how many this process has found.
            seen: the cells that it has looked at; None: none.
            parent: of each cell in its tree, int32, flat.
            number: of each root's tree, -1: none, int32, flat.
            held: not 0 at roots of trees that a wall touches, flat.
        """
        return BodyNumbers(trees)

    @property
    def corners(self) -> tuple[Corner, Corner] | None:
        """The first cell (x, y, z) and the one behind the last that a frame of this process shows; None: of the whole domain."""
        return None

    def where(self) -> dict[str, np.ndarray]:
        """Return what of the domain the fields of a checkpoint are: `box`, int64 (2, 3), its first cell and the one behind the last.

        Nothing of a whole domain.
        """
        low = np.array(self.grid.origin)
        return {} if self.grid.whole is None else {"box": np.array([low, low + self.grid.counts])}

    def kept(self, fields: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return what a checkpoint of this process keeps of fields, and of numbers among them, which stay as they are."""
        return dict(fields)

    @property
    def gathered_from(self) -> Corner:
        """The first cell (x, y, z) of what `gathered` returns."""
        return self.grid.origin

    def gathered(self, values: np.ndarray) -> np.ndarray | None:
        """Return the whole grid's field on the first process, None elsewhere, given this part's without its ring; collective."""
        return values

    def refill(self) -> Callable[[wp.array, wp.array], None] | None:
        """Return what fills ghost cells of marks and velocities again after each layer that they are continued by; None: nothing."""
        return None

    def cells_too_far(self, velocity: Sequence[wp.array], dt: float) -> float:
        """Return how many cells the fastest particles move in a time step if that is out of the ghost cells, else 0; collective."""
        return 0.0

    def should_rebalance(self, step: int) -> bool:
        """Return whether processes look for better parts in a step."""
        return False

    def rebalance(self, particles: Particles, a_cell: int) -> GridPart | None:
        """Return the part of the grid that this process should have, see `should_rebalance`; None: the one it has. Collective.

        Args:
            particles: of this process, whose totals have been found.
            a_cell: particles of a full cell.
        """
        return None

    def notes(self) -> list[str]:
        """Return what is worth a line at the start of a run."""
        return []

    def owners(self, cells: np.ndarray) -> np.ndarray:
        """Return the process that owns each cell (x, y, z) of the whole domain, shape (n, 3)."""
        return np.zeros(len(cells), dtype=np.int64)

    def fill(
        self,
        *fields: wp.array | np.ndarray,
        width: int | None = None,
        parts: int = 1,
        forest: Any = None,
    ) -> None:
        """Fill the ghost cells of fields with what other processes know (halo exchange); collective.

        Args:
            fields: any types, or stacks of equally many layers, the last axes z, y, x.
            width: how far from the owned cells; None: all.
            parts: the fields are of `grid.refined(parts)`.
            forest: of `forest`, for such fields; None: all cells.
        """

    def faces(self, window: Window) -> Window:
        """Return the cells whose lower faces this process adds up, of a window around its material."""
        return window

    def whole(self, window: Window) -> Window:
        """Return the cells that all processes visit together, of a window around this one's material."""
        return window

    def coarser(self, layers: int) -> StaggeredGrid | None:
        """Return the grid of cells of twice the edge on which the same processes work (coarse level); None if they cannot share it.

        Args:
            layers: of ghost cells of its parts, the ring included.
        """
        return self.grid.coarser()

    @property
    def row_ranks(self) -> Any:
        """The processes that have cells of the same rows along x, in their order; None if rows are not cut."""
        return None

    def known_of(self, field: np.ndarray) -> np.ndarray:
        """Return the view of a host's field on what this process alone knows."""
        return field

    def box_of(self, field: Any) -> Any:
        """Return the view of a field, host or device, or of layers of one, on the owned cells."""
        low, high = self.owned.low, self.owned.high
        return field[
            (slice(None),) * (field.ndim - 3)
            + tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        ]

    def filling(self, *fields: wp.array | np.ndarray, forest: Any) -> Task:
        """Return `fill` of the cells of a `forest`, to run now or within a recorded program."""
        return Task(partial(self.fill, *fields, forest=forest))

    def forest(
        self,
        layers: int = 1,
        width: int | None = None,
        *,
        which: np.ndarray | None = None,
        into: Any = None,
    ) -> Any:
        """Return what `fill` exchanges of some cells alone; collective.

        Args:
            layers: of a field.
            width: how far from the owned cells; None: all.
            which: of a field's cells, bool; None: all.
            into: a forest that this one replaces, in recorded exchanges too; None: there is none.
        """

    def box_like(self, field: wp.array) -> wp.array:
        """Return the field that a problem on the owned cells has in place of a field: itself if it has no ghost cells."""
        return field

    def copy_to_box(self, field: wp.array, box: wp.array) -> None:
        """Give a field of `box_like` what a field holds, if it does not share its memory."""

    def store(self, x: wp.array, field: wp.array, spare: wp.array) -> None:
        """Write the solution of a problem on the owned cells to a field, and what others have found to its ghost cells; collective.

        Args:
            x: float32 or float64, with as many elements as `box_like(field)`.
            field: float64 (written).
            spare: float64 memory of the size of x, which may be overwritten.
        """
        convert(x.flatten(), field.flatten())

    def poisson(self, cells: np.ndarray, **coefficients: Any) -> GridPoisson:
        """Return the operator of all processes' problem on the owned cells; coefficients are fields of `box_like`, see `GridPoisson`."""
        return GridPoisson(
            cells, device=self.grid.device, decomposition=self.decomposition, **coefficients
        )
