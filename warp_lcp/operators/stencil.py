"""The 7-point stencil on a padded grid: arrays, sizes and launches. An operator and each level of its multigrid are one of these."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Protocol

import numpy as np
import warp as wp

from warp_lcp.operators.stencil_kernels import PRODUCT, RELAX, WRAP
from warp_lcp.rows import Bound, Rows
from warp_lcp.rows.fields import Padding
from warp_lcp.rows.layout import check_memory, put, stencil_struct
from warp_lcp.rows.program import Launch, perform


class Ghosts(Protocol):
    """Fills the ghost cells that stand for cells stored elsewhere, by another process.

    Attributes:
        whole: cells (nz, ny, nx) of the grid that this process has a box of.
        cuts: sides with ghost cells that others have: the axis, 0, 1, 2 for x, y, z, and 0 for the lower, 1 for the upper side.
        hierarchy: the class of multigrid hierarchies on such grids.
    """

    @property
    def whole(self) -> tuple[int, int, int]: ...  # noqa: D102
    @property
    def cuts(self) -> list[tuple[int, int]]: ...  # noqa: D102
    @property
    def hierarchy(self) -> Any: ...  # noqa: D102

    def fill(self, field: wp.array[Any]) -> None:
        """Fill those of a stored field."""

    def coarser(self, factors: tuple[int, int, int]) -> Ghosts | None:
        """Return what fills those of aggregates of so many cells along x, y, z; None if aggregates would be cut."""


@dataclass
class Stencil:
    """A x = unit d x - sum of w x_neighbor on the cells with d != 0.

    Args:
        padding: counts of cells and of stored cells.
        d: diagonal in units of `unit`, flat stored field; 0 where there is no unknown. A count of faces (wp.uint8) or a float.
        weights: weight of the lower face of each cell along x, y, z (flat stored fields), or None for one weight an axis.
        coefficients: the weights along x, y, z where `weights` is None.
        unit: value of one unit of d.
        periodic: whether x, y, z wrap around; ghost cells are then filled before each product.
        spans: first and one past the last cell of each row that may hold unknowns, shape (nz, ny), wp.vec2i; fields must be 0 outside.
            None: whole rows.
        strength: mean coefficient of all faces along x, y, z; None: that of the weights as they are.
        ghosts: fills ghost cells where another process has the neighbors, before each product; None: nobody has.
    """

    padding: Padding
    d: wp.array[Any]
    weights: tuple[wp.array[Any], wp.array[Any], wp.array[Any]] | None
    coefficients: tuple[float, float, float]
    unit: float = 1.0
    periodic: tuple[bool, bool, bool] = (False, False, False)
    spans: wp.array[Any] | None = None
    strength: tuple[float, float, float] | None = None
    ghosts: Ghosts | None = None

    def __post_init__(self) -> None:
        """Take the device of the diagonal."""
        self.device = self.d.device

    @cached_property
    def rows(self) -> Rows:
        """The rows that passes visit."""
        return Rows.of(self.padding, self.device, self.spans)

    @cached_property
    def struct(self) -> Any:
        """What passes take of it."""
        variable, d, w = self.storage
        numbers = {"unit": self.unit, **dict(zip(("cx", "cy", "cz"), self.coefficients, strict=True))}
        weights = dict(zip(("wx", "wy", "wz"), self.weights or (), strict=False)) if variable else {}
        for name, array in weights.items():
            check_memory(f"the stencil's {name}", array, w, (self.d.size,))
        return put(stencil_struct(d, w)(), numbers | {"d": self.d} | weights)

    @property
    def storage(self) -> tuple[bool, Any, Any]:
        """Form and types that choose the kernels: variable weights?, type of d, type of the weights."""
        return self.weights is not None, self.d.dtype, self.weights[0].dtype if self.weights else wp.float32

    @property
    def mean_weights(self) -> list[float]:
        """The mean weight of the faces along x, y and z; of all faces where the operator knows it, whatever cells there are now."""
        if self.strength is not None:
            return list(self.strength)
        if self.weights is None:
            return list(self.coefficients)
        sums = [float(w.numpy().sum(dtype=np.float64)) for w in self.weights]
        faces = [max(int(np.count_nonzero(w.numpy())), 1) for w in self.weights]
        return [s / n for s, n in zip(sums, faces, strict=True)]

    def with_diagonal(self, d: wp.array[Any]) -> Stencil:
        """Return the stencil with another diagonal (a mask makes it 0) and the same weights."""
        unit = self.unit if d.dtype is self.d.dtype else 1.0
        return Stencil(self.padding, d, self.weights, self.coefficients, unit, self.periodic, self.spans, self.strength, self.ghosts)

    @property
    def has_ghosts(self) -> bool:
        """Whether ghost cells must be filled before each product."""
        return any(self.periodic) or self.ghosts is not None

    def wrap(self, x: wp.array[Any], *, launch: Launch = wp.launch) -> None:
        """Fill x's ghost cells along periodic axes, and those that stand for cells of others."""
        for axis, periodic in enumerate(self.periodic):
            if periodic:
                self.filling(x, axis).launch(launch)
        if self.ghosts is not None:
            perform(partial(self.ghosts.fill, x), launch)

    def filling(self, x: wp.array[Any], axis: int) -> Bound:
        """Return the pass that fills x's ghost cells along a periodic axis, 0, 1, 2 for x, y, z."""
        step = (1, self.padding.row, self.padding.plane)[axis]
        return WRAP.bind(self._edges[axis], x=x, cells=self.padding.counts[2 - axis], step=step)

    @cached_property
    def _edges(self) -> list[Rows]:
        """The ghost cells before the first of each axis."""
        return [Rows.edge(self.padding, self.device, axis) for axis in range(3)]

    def product(self, x: wp.array[Any], out: wp.array[Any], plus: wp.array[Any] | None = None, *, launch: Launch = wp.launch) -> None:
        """Out = A x, or A x + plus. All of one float type; rows that are no unknowns give 0 (or plus)."""
        self.wrap(x, launch=launch)
        PRODUCT.bind(self.rows, stencil=self, x=x, b=plus, y=out).launch(launch)

    def relax(
        self, x: wp.array[Any], b: wp.array[Any], lower: wp.array[Any], upper: wp.array[Any], omega: float, *, forward: bool = True
    ) -> None:
        """Sweep x once, red cells then black ones (forward) or black then red, each cell projected onto its bounds."""
        for color in (0, 1) if forward else (1, 0):
            self.wrap(x)
            RELAX.bind(self.rows, stencil=self, x=x, b=b, lower=lower, upper=upper, omega=omega, color=color).launch()
