"""Deterministic sums and maxima over the cells of a window."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from warp_lcp.grid.staggered import KERNELS, ActiveWindow, StaggeredGrid, Window
from warp_lcp.kernels import Rows, StencilKernel
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.kernels.vectors import DynamicReduction

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

# Columns of cells, one a thread, into which a GPU cuts a grid: some waves of the largest GPUs.
CUDA_SUMS = 1 << 20
CUDA_PLANES = 16  # least planes of a column

ADD_ROWS = KERNELS["warp_lcp.grid.window_reduction.add_rows"]


class WindowReduction:
    """Reduction over windows of a grid; the CPU sums rows in the order of the grid.

    Args:
        declared: a pass over a box, and the values that it reduces.
        grid: the grid.
        counted: cells whose rows the CPU sums up; None for those of the window.
    """

    def __init__(
        self, declared: StencilKernel, grid: StaggeredGrid, counted: Window | None = None
    ) -> None:
        self._shape, domain, self._declared = grid.shape[:2], grid.domain, declared
        self._planes = max(CUDA_PLANES, grid.size // CUDA_SUMS)
        self.name, self._counted = declared.name, counted
        columns, device = len(declared.reductions), grid.device
        self._tally = (
            DynamicReduction(declared, device, domain.rows_of_sums(self._planes).places)
            if device.is_cuda
            else None
        )
        if self._tally is None:
            rows = self._shape[0] * self._shape[1]
            self._partials, self._host = (
                wp.zeros(columns * rows, dtype=wp.float64, device=device) for _ in range(2)
            )
            self._reading, self._columns = (
                DeviceScalar(device, columns),
                Rows.flat(columns, device, serial=True),
            )

    def launch(self, window: Window, *structs: DataclassInstance, **kernel_args: object) -> None:
        """Launch the pass, bound as by `StencilKernel.bind`, over a window."""
        rows_of_sums = window.rows_of_sums(self._planes)
        if self._tally is not None:
            self._tally.launch_arguments(rows_of_sums, structs, kernel_args)
            return
        kernel_args["out"] = self._partials
        self._declared.bind_arguments(rows_of_sums, structs, kernel_args).launch()
        first_k, first_j, planes, rows = _numbers(window)
        box_k, box_j, box_planes, box_rows = _numbers(self._counted or window)
        hulls, pieces = _hulls(window)
        ADD_ROWS.bind(
            self._columns,
            partials=self._partials,
            host=self._host,
            results=self._reading.array,
            hulls=hulls,
            pieces=pieces,
            first_k=first_k,
            first_j=first_j,
            planes=planes,
            rows_=rows,
            box_k=box_k,
            box_j=box_j,
            box_planes=box_planes,
            box_rows=box_rows,
            sums_=len(self._declared.sums),
            all_planes=self._shape[0],
            all_rows=self._shape[1],
        ).launch()
        self._reading.changed()

    def changed(self) -> None:
        """Mark the result as changed after a recorded `launch` has run."""
        if self._tally is None:
            self._reading.changed()
        else:
            self._tally.changed()

    def on_device(self) -> wp.array[wp.float64]:
        """Return the results on the device, a number a column."""
        return self._reading.array if self._tally is None else self._tally.results

    def read(self) -> list[float]:
        """Return the results of the last launch."""
        found = self._reading.numpy() if self._tally is None else self._tally.read()
        return [float(v) for v in found]


def _numbers(window: Window) -> tuple[Scalar | int, Scalar | int, Scalar | int, Scalar | int]:
    """Return the first plane and row of a window, and the number of planes and rows."""
    if isinstance(window, ActiveWindow):
        return *window.first, *window.sizes
    return *window.low[:2], *window.rows


def _hulls(window: Window) -> tuple[Scalar | int, wp.array | None]:
    """Return the pieces of rows of an active window, and their number.

    0 and None stand for the whole box.
    """
    if isinstance(window, ActiveWindow):
        return window.pieces, window.hull_pieces
    return (0, None) if window.near is None else (len(window._hulls), window._hulls)
