"""Cell types from lists of cells, for scenes that are mostly empty.

Only the array of types is as large as the grid.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warp_lcp.kernels.fields import real_array
from warp_lcp.problem.data_types import Values
from warp_lcp.problem.operator_protocol import AIR, FLUID, SOLID

TOGETHER = 1 << 20  # cells of a list that are processed together


def cells_of(shape: Sequence[int], fluid: Values, solid: Values) -> np.ndarray:
    """Return cell types of a shape, int8; see `GridPoisson.from_cells`."""
    counts = tuple(shape)
    if len(counts) not in (2, 3) or not all(
        isinstance(n, (int, np.integer)) and n > 0 for n in counts
    ):
        raise ValueError(
            f"shape = {shape}: expected (nz, ny, nx) or (ny, nx) with at least one cell"
        )
    cells = np.zeros(counts, dtype=np.int8)  # AIR
    for name, listed, kind in (("fluid", fluid, FLUID), ("solid", solid, SOLID)):
        rows = real_array(listed, name)
        if rows.size and (
            rows.ndim != 2 or rows.shape[1] != len(counts) or rows.dtype.kind not in "iu"
        ):
            expected = (
                f"integers, shape (n, {len(counts)}), a row "
                f"{('(j, i)', '(k, j, i)')[len(counts) - 2]} a cell"
            )
            raise ValueError(
                f"{name} has shape {rows.shape} and type {rows.dtype}: expected {expected}"
            )
        for first in range(0, len(rows) if rows.size else 0, TOGETHER):
            _write(cells, rows[first : first + TOGETHER], kind, f"{name}[{{}}]", first)
    return cells


def _write(cells: np.ndarray, rows: np.ndarray, kind: int, name: str, first: int) -> None:
    """Write the types of some listed cells, which must be AIR so far."""
    outside = ((rows < 0) | (rows >= cells.shape)).any(axis=1)
    if outside.any():
        n = int(outside.argmax())
        raise ValueError(
            f"{name.format(first + n)} = {tuple(rows[n].tolist())}: there is no such cell in a "
            f"grid of shape {cells.shape}"
        )
    places, flat = np.ravel_multi_index(tuple(rows.T), cells.shape), cells.reshape(-1)
    again = flat[places] != AIR
    if not (np.diff(places) > 0).all():  # an ascending list has no cell twice
        once = np.unique(places, return_index=True)[1]
        again[np.setdiff1d(np.arange(len(places)), once)] = True
    if again.any():
        n = int(again.argmax())
        where = "both lists" if flat[places[n]] not in (AIR, kind) else "the list twice"
        raise ValueError(
            f"{name.format(first + n)} = {tuple(rows[n].tolist())}: the cell is in {where}"
        )
    flat[places] = kind
