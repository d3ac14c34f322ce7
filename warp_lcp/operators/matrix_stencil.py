"""Recognize sparse matrices that are compact stencils on a box of cells.

The unknowns must be in the natural order, x first, and the rows must reach compact neighbors only.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.kernels import KernelFile, Rows
from warp_lcp.kernels.fields import Padding, zeros
from warp_lcp.kernels.layout import Pattern
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import RowReduction
from warp_lcp.operators.compressed_rows import CompressedRows, RowEntries
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.operators.stencil import StoredStencil
from warp_lcp.problem.operator_protocol import FLUID

KERNELS = KernelFile(Path(__file__).parent / "headers/stencil_operator.h")
RECOGNIZE = KERNELS["matrix_stencil.recognize"]
LEAST = 3  # least number of cells of an axis: with fewer, offsets along it and across it coincide
LOWER = ((-1, 0, 0), (0, -1, 0), (0, 0, -1))  # neighbors of lower faces
# Number of consecutive rows from the middle one on whose offsets determine the box: most of them
# are not on its border.
SAMPLED = 8


def stencil_of(A: SparseOperator) -> StoredStencil | None:
    """Return the operator as a stencil on a box, with the same bits, or None.

    None where the matrix is no stencil, or is not stored in float64. It takes one pass over the
    entries, and a second one if they differ from row to row and must be stored.
    """
    if A.dtype is not wp.float64:
        return None
    rows = A.rows()
    for shape in _boxes(rows):
        found = _as_stencil(A, rows, shape)
        if found is not None:
            return found
    return None


def _offsets(rows: CompressedRows) -> np.ndarray:
    """Return the offsets of entries in some rows near the middle, ascending."""
    starts, columns = rows.indptr.numpy(), rows.indices.numpy()
    n = len(starts) - 1
    some = range(n // 2, min(n // 2 + SAMPLED, n))
    return np.unique(np.concatenate([columns[starts[r] : starts[r + 1]] - r for r in some]))


def _boxes(rows: CompressedRows) -> Iterator[tuple[int, int, int]]:
    """Yield the boxes (nz, ny, nx) that are compatible with the offsets.

    In the natural order, the neighbor at the step (a, b, c), each -1, 0 or 1, has the offset
    a + b nx + c nx ny. So nx is among the smallest offsets above 1 and nx ny among those above
    nx + 1, and those differ from nx ny by at most nx + 1.
    """
    n, found = rows.indptr.size - 1, _offsets(rows)
    far = np.unique(np.abs(found[np.abs(found) > 1]))
    if len(far) == 0 or len(found) > 27:
        return
    for nx in far[far <= far[0] + 2]:
        if nx < LEAST or n % nx:
            continue
        beyond = far[far > nx + 1]
        if len(beyond) == 0:
            yield 1, n // int(nx), int(nx)
        for plane in beyond:
            if plane % nx == 0 and n % plane == 0 and (np.abs(beyond - plane) <= nx + 1).all():
                yield n // int(plane), int(plane // nx), int(nx)


def _as_stencil(
    A: SparseOperator, rows: CompressedRows, shape: tuple[int, int, int]
) -> StoredStencil | None:
    """Return the operator as a stencil on a box of a given shape, or None.

    The row in the middle of the box defines the expected entries. A pass over all rows tests the
    pattern, and whether entries differ from those. Of symmetric matrices half of the neighbors are
    stored. If the diagonal is a small multiple of one weight, it is stored as a byte.
    """
    nz, ny, nx = shape
    if ny < LEAST or (nz > 1 and nz < LEAST):
        return None
    padding, device, starts = Padding(shape), A.device, rows.indptr.numpy()
    middle = np.zeros(27)
    row = ((nz // 2) * ny + ny // 2) * nx + nx // 2
    steps = itertools.product((-1, 0, 1) if nz > 1 else (0,), (-1, 0, 1), (-1, 0, 1))
    offsets = {x + y * nx + z * nx * ny: 13 + x + 3 * y + 9 * z for z, y, x in steps}
    full = 0
    for offset in _offsets(rows).tolist():
        if offset not in offsets:
            return None
        full |= 1 << offsets[offset]
    entries = slice(starts[row], starts[row + 1])
    for column, value in zip(
        rows.indices.numpy()[entries].tolist(), rows.values.numpy()[entries], strict=True
    ):
        if column - row not in offsets:
            return None
        middle[offsets[column - row]] += value
    stored_offsets = full & ((1 << 13) - 1) if A.symmetric else full & ~(1 << 13)
    where, d = Rows.of(padding, device), padding.zeros(wp.float64, device)
    sums, matrix, on_device = (
        RowReduction(where, 4),
        RowEntries(rows.indptr, rows.indices, rows.values),
        wp.array(middle, device=device),
    )

    def recognize(block: DeviceArray | None) -> np.ndarray:
        """Compare all rows with the middle one, and copy entries to `block` if given."""
        return sums.of(
            RECOGNIZE,
            matrix,
            middle=on_device,
            made=d,
            nx=nx,
            ny=ny,
            nz=nz,
            full=full,
            kept=stored_offsets,
            size=padding.size,
            weights=block,
        )

    wrong, centers, differ, positive = recognize(None)
    if wrong:
        return None
    places = [o for o in range(27) if stored_offsets >> o & 1]
    neighbors = tuple((o % 3 - 1, o // 3 % 3 - 1, o // 9 - 1) for o in places)
    weights: tuple[Any, ...] = tuple(-middle[o] for o in places)
    if differ:
        block = zeros(len(places) * padding.size, wp.float64, device)
        recognize(block)
        weights = tuple(
            block[i * padding.size : (i + 1) * padding.size] for i in range(len(places))
        )
    sizes = [float(np.abs(w.numpy()).sum()) / A.unknowns if differ else abs(w) for w in weights]
    strength = tuple(
        sum(s for s, o in zip(sizes, neighbors, strict=True) if o[axis]) / (1 if A.symmetric else 2)
        for axis in range(3)
    )
    cells = np.full(shape if nz > 1 else shape[1:], FLUID, dtype=np.int8)
    pattern: Pattern | None = Pattern(neighbors, A.symmetric, "arrays" if differ else "numbers")
    faces = 1.0  # of a cell
    if A.symmetric and not positive and set(neighbors) <= set(LOWER):  # as for a GridPoisson
        none, along = (
            padding.zeros(wp.float64, device) if differ else 0.0,
            dict(zip(neighbors, weights, strict=True)),
        )
        pattern, weights = None, tuple(along.get(o, none) for o in LOWER)
        used = {w for w in weights if w} if not differ else set()
        faces = float(middle[13]) / used.pop() if len(used) == 1 else 0.0
    unit = 1.0
    if not centers and faces in range(1, 256):  # a byte a cell
        unit = float(middle[13]) / faces
        d = wp.array(np.where(d.numpy() != 0, faces, 0).astype(np.uint8), device=device)
    return StoredStencil(
        cells,
        d,
        weights,
        pattern,
        unit=unit,
        symmetric=A.symmetric,
        monotone=not positive,
        strength=strength,  # type: ignore[arg-type]
    )
