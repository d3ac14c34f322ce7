"""The grid operator of a box of cells among those of other ranks."""

from __future__ import annotations

from typing import Any

import numpy as np

from warp_lcp.distributed.components import GROUND, joined, nodes_of
from warp_lcp.distributed.decomposition import Decomposition
from warp_lcp.operators.components import ComponentFinder, FloatingComponents, Scratch
from warp_lcp.operators.grid_poisson import FLUID, GridPoisson


class DistributedGridPoisson(GridPoisson):
    """Distributed `GridPoisson`: each rank stores its box and a layer of ghost cells.

    All arguments and fields are those of this rank's box: cells (nz, ny, nx), coefficients of its faces, upper faces included (those
    at a cut are stored by both ranks). An `LCP` with it is one problem of all ranks, and `wl.solve` of it is collective: every rank
    calls it, and gets its box of x with the status, residual and history of the whole. On one rank it equals a `GridPoisson`.

    Args:
        decomposition: the boxes.
        cells: integers AIR, FLUID, SOLID of this rank's box, shape (nz, ny, nx), or (ny, nx) if the whole grid has one cell along z.
        coefficients: `face_x`, `face_y`, `face_z`, `shift`, `device`, `dtype` as of `GridPoisson`.

    Attributes:
        decomposition: the boxes.

    Raises:
        ValueError: an argument has a wrong shape, type or sign, or is not of the same kind on all ranks; a box is one cell thin at a cut.

    Example:
        >>> import numpy as np, warp_lcp as wl
        >>> from warp_lcp.distributed import Decomposition, DistributedGridPoisson, Ranks
        >>> def operator(n):
        ...     boxes = Decomposition((n, n, n), Ranks.world())
        ...     return DistributedGridPoisson(boxes, np.full(boxes.box.counts[::-1], wl.FLUID))
    """

    def __init__(self, decomposition: Decomposition, cells: Any, **coefficients: Any) -> None:
        self.decomposition = decomposition
        with decomposition.collective.together():
            self._check(cells, coefficients)
        kinds = [(name, np.ndim(value) > 0 or value) for name, value in sorted(coefficients.items()) if name not in ("device", "dtype")]
        decomposition.ranks.agree("the kind of coefficients", kinds)
        if decomposition.ranks.size > 1:
            self._ghosts, self._across = decomposition.halo, decomposition.ranks
        with decomposition.collective.together():
            super().__init__(cells, **coefficients)

    def _check(self, cells: Any, coefficients: dict[str, Any]) -> None:
        """Refuse what is wrong on this rank; takes `periodic` out of the coefficients."""
        boxes = self.decomposition
        shape, expected = tuple(np.shape(cells)), tuple(reversed(boxes.box.counts))
        if any(coefficients.pop("periodic", ())):
            raise ValueError("periodic: periodic axes are not supported on several ranks; use one rank")
        if shape != expected and not (shape == expected[1:] and boxes.counts[2] == 1):
            raise ValueError(f"cells has shape {shape}: expected {expected}, the cells of rank {boxes.ranks.rank}")
        for axis in boxes.cut_axes:
            if min(boxes.parts[axis]) < 2:
                raise ValueError(f"a rank has one cell along {'xyz'[axis]}: boxes of shared operators have at least two")

    @property
    def unknowns(self) -> int:
        """Number of FLUID cells of all ranks."""
        return int(self.decomposition.ranks.sum(super().unknowns))

    def _component_finder(self) -> ComponentFinder:
        return ComponentFinder(self) if self._ghosts is None else DistributedComponentFinder(self)


class DistributedComponentFinder(ComponentFinder):
    """Finds floating components that may reach over several ranks.

    Each rank finds the components of its own box; those that nothing holds there are nodes of a graph, whose edges are open faces at cuts.

    Args:
        A: the operator.
    """

    _A: DistributedGridPoisson

    def find(self, scratch: Scratch | None = None) -> FloatingComponents | None:
        """Return the floating components with the parts of all ranks, or None if there are none."""
        A, ranks = self._A, self._A.decomposition.ranks
        parent, grounded = self._grow(scratch, A.cells)
        if not ranks.any(bool(self._count.numpy()[0])):
            return None
        number = self._numbers(parent.numpy(), grounded.numpy())
        first, nodes = nodes_of(ranks, ranks.gather(int(number.max(initial=-1)) + 1))
        fluid = (A.cells.numpy() == FLUID).ravel()
        node = np.where(number >= 0, number + first, np.where(fluid, GROUND, -1)).astype(np.int32)
        component = joined(ranks, nodes, _edges(A, node))
        floating = component != component[GROUND]
        if not floating.any():
            return None
        names = np.full(nodes, -1, dtype=np.int32)
        names[floating] = np.unique(component[floating], return_inverse=True)[1]
        label = np.where(number >= 0, names[np.maximum(node, 0)], -1).astype(np.int32)
        return FloatingComponents(label, A.device, ranks)


def _edges(A: DistributedGridPoisson, node: np.ndarray) -> np.ndarray:
    """Return the pairs of nodes of this rank and its neighbors between which a face at a cut is open, shape (n, 2)."""
    assert A._ghosts is not None
    shape, found = A.layout.stored_shape, []
    grid = node.reshape(shape).copy()
    for axis in A.decomposition.cut_axes:  # ghost cells at the domain's sides are not written
        for end in (0, -1):
            grid[(*[slice(None)] * (2 - axis), end, ...)] = -1
    A._ghosts.fill(grid)
    for axis in A.decomposition.cut_axes:
        lower = [slice(1, -1)] * 3
        lower[2 - axis] = slice(0, 1)
        upper = list(lower)
        upper[2 - axis] = slice(1, 2)
        a, b = grid[tuple(lower)].ravel(), grid[tuple(upper)].ravel()
        face = A.faces[axis].numpy()[tuple(upper)].ravel() if A.faces[axis].size else np.full(a.size, A.uniform[axis])
        open_faces = (a >= 0) & (b >= 0) & (face > 0)
        found.append(np.stack([a[open_faces], b[open_faces]], axis=1))
    return np.unique(np.concatenate(found), axis=0) if found else np.empty((0, 2), dtype=np.int32)
