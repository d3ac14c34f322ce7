"""What passes find in the cells of a window: sums, and the largest of something."""

from __future__ import annotations

from typing import Any

import numpy as np

from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.rows import RowPass
from warp_lcp.rows.vectors import Tally

CUDA_SUMS = 1 << 20  # columns of cells, a thread each, into which a GPU cuts a grid: some waves of the largest ones
CUDA_PLANES = 16  # of one of them, at least


class WindowTally:
    """A tally over windows of a grid; on the CPU rows are added up as they lie in the grid.

    Args:
        declared: a pass over a box, with what it finds.
        grid: the grid.
    """

    def __init__(self, declared: RowPass, grid: StaggeredGrid) -> None:
        self._shape, domain = grid.shape[:2], grid.domain
        self._planes = max(CUDA_PLANES, grid.size // CUDA_SUMS)
        self.name = declared.name
        self._tally = Tally(declared, grid.device, domain.rows_of_sums(self._planes).places)
        self._window, self._host = domain, np.zeros((*self._shape, len(declared.found)))

    def take(self, window: Window, **given: Any) -> None:
        """Launch the pass over a window."""
        self._window = window
        self._tally.take(window.rows_of_sums(self._planes), **given)

    def on_device(self) -> Any:
        """Return what is found, a number a column, where it is on a GPU; None on the CPU."""
        return self._tally.found

    def read(self, box: Window | None = None) -> list[float]:
        """Return what the last launch found; `box`: cells whose rows the host adds up, which has the bits of it; None: of the window."""
        return [float(v) for v in self._tally.read(lambda parts: self._arranged(parts, box or self._window))]

    def _arranged(self, parts: np.ndarray, box: Window) -> np.ndarray:
        """Return what rows have found as they lie in the grid, 0 where none was visited."""
        host, window = self._host, self._window
        host[...] = 0.0
        if window.near is None:
            planes, rows = window.rows
            host[window.low[0] : window.high[0], window.low[1] : window.high[1]] = parts.T.reshape(planes, rows, -1)
        else:
            k, j = window.rows_visited.T
            host[k, j] = parts.T
        return np.moveaxis(host[box.low[0] : box.high[0], box.low[1] : box.high[1]], -1, 0)
