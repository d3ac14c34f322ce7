"""The part of a grid that a process works on, and what it finds out from the processes that work on the others.

One process works on all of the grid; then nothing is exchanged, and a sum over all processes is the number itself. The part of a rank
among several is `warp_lcp.distributed.subdomain.Subdomain`. Methods named *collective* must be called by every rank, in the same order,
also by one that has no material.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import warp as wp

from warp_lcp.operators.grid_poisson import GridPoisson
from warp_lcp.rows.vectors import convert

if TYPE_CHECKING:
    from warp_lcp.grid.staggered import StaggeredGrid, Window
    from warp_lcp.rows.vectors import Across


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


ONE_PROCESS = OneProcess()


class GridPart:
    """The part of a grid that a process works on: here all of it.

    Args:
        grid: the grid, whose fields have the cells of the part and a ring, or layers of ghost cells, around them.

    Attributes:
        grid: as given.
        ranks: the processes that work on the grid.
        decomposition: their boxes of cells; None: there is one process.
        shared: whether there may be others.
        joined: axes without an end that are cut, along which another process goes on beyond the domain's sides.
        cuts: has bit n set if beyond side n of the part, see `warp_lcp.grid.sides`, another process goes on.
    """

    shared: ClassVar[bool] = False
    cuts = 0
    joined: tuple[int, ...] = ()
    ranks: Any = ONE_PROCESS
    decomposition: Any = None

    def __init__(self, grid: StaggeredGrid) -> None:
        self.grid = grid

    @property
    def across(self) -> Across | None:
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

    def owners(self, cells: np.ndarray) -> np.ndarray:
        """Return the process that owns each cell (x, y, z) of the whole domain, shape (n, 3)."""
        return np.zeros(len(cells), dtype=np.int64)

    def fill(self, *fields: wp.array | np.ndarray, width: int | None = None, parts: int = 1, forest: Any = None) -> None:
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
        return field[(slice(None),) * (field.ndim - 3) + tuple(slice(a, b) for a, b in zip(low, high, strict=True))]

    def forest(self, layers: int = 1, width: int | None = None, *, which: np.ndarray | None = None) -> Any:
        """Return what `fill` exchanges of some cells alone, to be freed by the caller; collective.

        Args:
            layers: of a field.
            width: how far from the owned cells; None: all.
            which: of a field's cells, bool; None: all.
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
        return GridPoisson(cells, device=self.grid.device, decomposition=self.decomposition, **coefficients)
