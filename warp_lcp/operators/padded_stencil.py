"""Stencil on a padded grid: arrays, sizes and launches.

An operator and each level of its multigrid are one of these. (A x)_i = d_i x_i - sum of w_f
x_neighbor, for d_i != 0; rows with d_i = 0 are no unknowns and give 0. Fields are 0 in cells that
are no unknowns, so a neighbor needs no test.

All forms share one source. Stencils of 5 or 7 points are `uniform`, with one weight for each axis,
or `variable`, with an array of lower faces for each axis; d of a uniform one may be a count of open
faces in one byte, in units of d_scale. Compact stencils have up to 27 points, symmetric or not, and
their `Pattern` defines the neighbors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol, no_type_check

import numpy as np
import warp as wp

from warp_lcp.kernels import BoundKernel, KernelFile, Rows
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.fields import Padding
from warp_lcp.kernels.launch_graph import HostTask, Launch, launch_now
from warp_lcp.kernels.layout import Pattern, check_memory, put, stencil_struct
from warp_lcp.kernels.types import DataType, DeviceArray, StructInstance
from warp_lcp.kernels.vectors import Communicator

KERNELS = KernelFile(Path(__file__).parent / "headers/stencil_operator.h")
PRODUCT = KERNELS["stencil.product"]
RELAX = KERNELS["stencil.relax"]
WRAP = KERNELS["stencil.wrap"]
# Spans begin at multiples of this, so that rows consist of whole vectors and aggregates are not
# cut.
SPAN_CELLS = wp.constant(16)


@no_type_check
@wp.func
def whole_span(first: int, last: int, n: int):
    """Return a span of whole vectors around first ... last of n cells.

    Empty if there are no cells.
    """
    begin = first // SPAN_CELLS * SPAN_CELLS
    end = last
    if last <= first:
        begin = 0
        end = 0
    return wp.vec2i(begin, wp.min(n, (end + SPAN_CELLS - 1) // SPAN_CELLS * SPAN_CELLS))


@no_type_check
@forward_kernel(module="warp_lcp.stencil")
def coarsen_spans_kernel(
    fine: wp.array2d(dtype=wp.vec2i), factors: wp.vec3i, n: int, spans: wp.array2d(dtype=wp.vec2i)
):
    """Compute the span of a coarse row: it covers those of its fine rows.

    factors = cells of an aggregate along z, y, x.
    """
    k, j = wp.tid()
    first = int(n)
    last = int(0)
    for a in range(factors[0]):
        for b in range(factors[1]):
            z = factors[0] * k + a
            y = factors[1] * j + b
            if z < fine.shape[0] and y < fine.shape[1]:
                if fine[z, y][1] > fine[z, y][0]:
                    first = wp.min(first, fine[z, y][0] // factors[2])
                    last = wp.max(last, (fine[z, y][1] + factors[2] - 1) // factors[2])
    spans[k, j] = whole_span(first, last, n)


class FieldGather(Protocol):
    """Collects a field of all processes' boxes, with ghost cells, on every process."""

    def collect_task(self, mine: DeviceArray, whole: DeviceArray) -> HostTask:
        """Return the task that writes all processes' cells to the whole grid's field."""

    def copy_part(self, whole: DeviceArray, mine: DeviceArray, launch: Launch = ...) -> None:
        """Write this process's part of the whole grid's field to its own."""


class GhostExchange(Protocol):
    """Fills the ghost cells that represent cells of another process.

    Attributes:
        whole: cells (nz, ny, nx) of the grid of which this process has a box.
        cuts: sides with ghost cells of other processes: the axis, 0, 1, 2 for x, y, z, and 0 for
            the lower, 1 for the upper side.
        gathering: collects fields of all processes' boxes on every process.
    """

    @property
    def whole(self) -> tuple[int, int, int]: ...  # noqa: D102
    @property
    def cuts(self) -> list[tuple[int, int]]: ...  # noqa: D102
    @property
    def field_gather(self) -> FieldGather: ...  # noqa: D102

    def fill(self, field: DeviceArray) -> None:
        """Fill the ghost cells of a stored field."""

    def fill_task(self, field: DeviceArray) -> HostTask:
        """Return the task that fills ghost cells, now or in a program."""

    def coarser(self, factors: tuple[int, int, int]) -> GhostExchange | None:
        """Return the ghost cells of aggregates, None if aggregates would be cut.

        `factors` are cells of an aggregate along x, y, z.
        """

    def join_components(
        self, number: np.ndarray, held: np.ndarray, faces: Sequence[np.ndarray | float]
    ) -> np.ndarray | None:
        """Join components of this process's cells with those of others; collective.

        Args:
            number: of the component of each stored cell, flat, from 0; -1: none, or it is grounded.
            held: which stored cells belong to grounded components, bool.
            faces: coefficients of the lower faces along x, y, z, stored or one number; 0: closed.

        Returns:
            The numbers of the joined components that are not grounded on any process, int32, flat,
            from 0, -1 elsewhere; None if there are none.
        """


class CellDecomposition(Protocol):
    """Boxes of cells, one for each process: `warp_lcp.distributed.Decomposition`.

    Attributes:
        ghosts: fills ghost cells; None: there is one process.
        comm: communicator; None if serial.
    """

    @property
    def ghosts(self) -> GhostExchange | None: ...  # noqa: D102
    @property
    def comm(self) -> Communicator | None: ...  # noqa: D102

    def together(self) -> AbstractContextManager[object]:
        """Return a block that raises an exception of one process on all processes."""

    def check_operator(
        self, shape: tuple[int, ...], periodic: Sequence[bool], coefficients: Mapping[str, object]
    ) -> None:
        """Refuse an operator that does not fit the box; collective.

        It must be of the same kind on all processes.
        """


@dataclass
class PaddedStencil:
    """Stencil A x = unit d x - sum of w x_neighbor on the cells with d != 0.

    Args:
        padding: counts of cells and of stored cells.
        d: diagonal in units of `unit`, flat stored field; 0 where there is no unknown. A count of
            faces (wp.uint8) or a float.
        weights: weight of the lower face of each cell along x, y, z (flat stored fields), or None
            for one weight for each axis. For a compact stencil the weights of the pattern's
            neighbors, in its order, if it has arrays.
        coefficients: the weights along x, y, z where `weights` is None; for a compact stencil those
            of the pattern, if they are numbers.
        unit: value of one unit of d.
        periodic: whether x, y, z wrap around; ghost cells are then filled before each product.
        spans: first and one past the last cell of each row that may have unknowns, shape (nz, ny),
            wp.vec2i; fields must be 0 outside. None: whole rows.
        strength: mean coefficient of all faces along x, y, z; None: that of the current weights.
        ghosts: fills ghost cells where another process has the neighbors, before each product; None
            if serial.
        pattern: of a compact stencil; None: 7 points.
    """

    padding: Padding
    d: DeviceArray
    weights: tuple[DeviceArray, ...] | None
    coefficients: tuple[float, ...]
    unit: float = 1.0
    periodic: tuple[bool, bool, bool] = (False, False, False)
    spans: DeviceArray | None = None
    strength: tuple[float, float, float] | None = None
    ghosts: GhostExchange | None = None
    pattern: Pattern | None = None

    def __post_init__(self) -> None:
        """Set the device of the diagonal."""
        self.device = self.d.device

    @cached_property
    def rows(self) -> Rows:
        """The rows that kernels process."""
        return Rows.of(self.padding, self.device, self.spans)

    @cached_property
    def struct(self) -> StructInstance:
        """Struct of the stencil for kernels."""
        variable, d, w = self.storage
        fields, names = (
            (("wx", "wy", "wz"), ("cx", "cy", "cz"))
            if self.pattern is None
            else (self.pattern.names, self.pattern.numbers)
        )
        numbers = {"unit": self.unit, **dict(zip(names, self.coefficients, strict=True))}
        weights = dict(zip(fields, self.weights or (), strict=False)) if variable else {}
        for name, array in weights.items():
            check_memory(f"the stencil's {name}", array, w, (self.d.size,))
        return put(stencil_struct(d, w, self.pattern)(), numbers | {"d": self.d} | weights)

    @property
    def storage(self) -> tuple[bool, DataType, DataType]:
        """Form and types that select the kernels.

        Whether weights are variable, the type of d, the type of the weights.
        """
        return (
            self.weights is not None,
            self.d.dtype,
            self.weights[0].dtype if self.weights else wp.float32,
        )

    @property
    def mean_weights(self) -> list[float]:
        """The mean weight of the faces along x, y and z.

        Of all faces if `strength` is known, independent of the current cells.
        """
        if self.strength is not None:
            return list(self.strength)
        if self.weights is None:
            return list(self.coefficients)
        sums = [float(w.numpy().sum(dtype=np.float64)) for w in self.weights]
        faces = [max(int(np.count_nonzero(w.numpy())), 1) for w in self.weights]
        return [s / n for s, n in zip(sums, faces, strict=True)]

    def with_diagonal(self, d: DeviceArray) -> PaddedStencil:
        """Return the stencil with another diagonal and the same weights.

        A mask makes the diagonal 0.
        """
        unit = self.unit if d.dtype is self.d.dtype else 1.0
        return replace(self, d=d, unit=unit)

    def wrap(self, x: DeviceArray, *, launch: Launch = launch_now) -> None:
        """Fill x's ghost cells along periodic axes, and those of other ranks."""
        for filling in self.fillings(x):
            filling.launch(launch)

    def fillings(self, x: DeviceArray) -> list[BoundKernel | HostTask]:
        """Return the launches of `wrap`."""
        strides, counts = (1, self.padding.row, self.padding.plane), self.padding.counts[::-1]
        axes = [axis for axis, periodic in enumerate(self.periodic) if periodic]
        made: list[BoundKernel | HostTask] = [
            WRAP.bind(self._edges[a], x=x, cells=counts[a], step=strides[a]) for a in axes
        ]
        return made if self.ghosts is None else [*made, self.ghosts.fill_task(x)]

    @cached_property
    def _edges(self) -> list[Rows]:
        """The ghost cells before the first cell of each axis."""
        return [Rows.edge(self.padding, self.device, axis) for axis in range(3)]

    def product(
        self,
        x: DeviceArray,
        out: DeviceArray,
        plus: DeviceArray | None = None,
        *,
        launch: Launch = launch_now,
    ) -> None:
        """Compute out = A x, or A x + plus.

        All are of one float type; rows that are no unknowns give 0 (or plus).
        """
        self.wrap(x, launch=launch)
        PRODUCT.bind(self.rows, stencil=self, x=x, b=plus, y=out).launch(launch)

    def relax(
        self,
        x: DeviceArray,
        b: DeviceArray,
        lower: DeviceArray,
        upper: DeviceArray,
        omega: float,
        *,
        forward: bool = True,
    ) -> None:
        """Sweep x once, each cell projected onto its bounds.

        Red cells then black ones (forward) or black then red. Where cells touch diagonally, there
        are four colors, or eight in 3-D.
        """
        colors = 2 if self.pattern is None else 1 << sum(n > 1 for n in self.padding.counts)
        for color in range(colors) if forward else reversed(range(colors)):
            self.wrap(x)
            RELAX.bind(
                self.rows,
                stencil=self,
                x=x,
                b=b,
                lower=lower,
                upper=upper,
                omega=omega,
                color=color,
            ).launch()
