"""How to cut a grid so that no rank has much more to do than the others, as far as it is known before a run."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from warp_lcp.distributed.decomposition import Box, Triple, parts

OPEN = 0.1  # of the work that a cell full of material makes: what a cell without makes, ghost cells too

Corners = tuple[np.ndarray, np.ndarray]  # low and high x, y, z of a box of material, in cells


def balanced_processes(counts: Triple, size: int, *, layers: int, states: Sequence[Sequence[Corners]]) -> Triple | None:
    """Return the ranks along x, y, z for which the busiest has least to do; None if there are too many for the grid.

    Args:
        counts: cells (nx, ny, nz).
        size: ranks.
        layers: of ghost cells, which no box may be thinner than.
        states: where the material is at different times, each as boxes of it.

    >>> dam, pool = (np.zeros(3), np.array([16, 20, 32])), (np.zeros(3), np.array([64, 5, 32]))
    >>> balanced_processes((64, 32, 32), 2, layers=5, states=[[dam], [pool]])
    (1, 1, 2)
    """
    found = []
    for px in (d for d in range(1, size + 1) if size % d == 0):
        for py in (d for d in range(1, size // px + 1) if size // px % d == 0):
            p = px, py, size // (px * py)
            if any(a > 1 and a * layers > n for a, n in zip(p, counts, strict=True)):
                continue
            cuts = [parts(n, a) for n, a in zip(counts, p, strict=True)]
            if all(len(cut) == 1 or min(cut) >= layers for cut in cuts):
                found.append((sum(_most_work(counts, cuts, layers, state) for state in states), px, py, p))
    return min(found)[3] if found else None


def pool(counts: Triple, dimension: int, volume: float, gravity: np.ndarray) -> Corners:
    """Return the box that some cells of material fill when they have come to rest.

    Args:
        counts: cells (nx, ny, nz).
        dimension: 2 or 3.
        volume: of the material, in cells.
        gravity: [m/s^2]; the box lies at the side that it points to most; 0: it is the whole grid.
    """
    low, high = np.zeros(3), np.array(counts, dtype=float)
    axis = int(np.argmax(np.abs(gravity[:dimension])))
    if gravity[axis] == 0.0:
        return low, high
    depth = min(volume / math.prod(counts), 1.0) * counts[axis]
    if gravity[axis] < 0.0:
        high[axis] = depth
    else:
        low[axis] = counts[axis] - depth
    return low, high


def _most_work(counts: Triple, cuts: list[list[int]], layers: int, state: Sequence[Corners]) -> float:
    """Return what the busiest rank has to do, in cells full of material."""
    ends = [np.concatenate([[0], np.cumsum(cut)]) for cut in cuts]
    whole, most = Box((0, 0, 0), counts), 0.0
    for place in np.ndindex(*(len(cut) for cut in cuts)):
        low, high = (np.array([end[n + side] for end, n in zip(ends, place, strict=True)]) for side in range(2))
        box = Box((int(low[0]), int(low[1]), int(low[2])), (int(high[0]), int(high[1]), int(high[2])))
        full = sum(float(np.prod(np.clip(np.minimum(b, high) - np.maximum(a, low), 0.0, None))) for a, b in state)
        most = max(most, full + OPEN * box.grown(layers).common(whole).cells)
    return most
