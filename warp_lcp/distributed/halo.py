"""Halo exchange: ghost cells at the cuts between ranks, filled by PETSc."""

from __future__ import annotations

import ctypes
import itertools
import weakref
from collections.abc import Sequence
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, no_type_check

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
import warp as wp

from warp_lcp.distributed.launch import petsc
from warp_lcp.distributed.messages import exchange, exchange_operation
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.grid.cell_box import CellBox, Triple
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.launch_graph import HostTask, Launch, launch_now
from warp_lcp.kernels.types import DeviceArray

if TYPE_CHECKING:
    from petsc4py import PETSc

    from warp_lcp.distributed.decomposition import Decomposition

GROUND = 0  # node of the graph of components that stands for all supports


def number_nodes(ranks: Ranks, counts: np.ndarray) -> tuple[int, int]:
    """Number the nodes of a graph whose nodes are the components within the ranks' boxes.

    Args:
        ranks: that have the components.
        counts: number of components of each rank, shape (ranks,).

    Returns:
        The node of this rank's first component, and the number of all nodes with `GROUND`.
    """
    return 1 + int(counts[: ranks.rank].sum()), 1 + int(counts.sum())


def connected_components(ranks: Ranks, nodes: int, edges: np.ndarray) -> np.ndarray:
    """Return the number of each node's connected component, shape (nodes,); collective.

    Args:
        ranks: that have the components of their boxes, which are the nodes.
        nodes: number of nodes.
        edges: pairs of nodes that are connected, as far as this rank knows, int32, shape (n, 2).
    """
    all_edges = np.concatenate(ranks.collect(edges))
    graph = scipy.sparse.coo_matrix(
        (np.ones(len(all_edges)), tuple(all_edges.T)), shape=(nodes, nodes)
    )
    return np.asarray(scipy.sparse.csgraph.connected_components(graph, directed=False)[1])


class Halo:
    """Halo exchange: fill the ghost cells of fields that each rank stores for its box.

    A star forest of PETSc maps each ghost cell to a cell of another rank: neighbors send each other
    the values at their sides, edges and corners in one message each. Elements have 1, 2, 4 or 8
    bytes. Ghost cells at the domain's own sides keep their values.

    Args:
        decomposition: the boxes.
        width: ghost cells.

    Raises:
        ValueError: a box has fewer cells along a cut axis than the width; on all ranks.
    """

    def __init__(self, decomposition: Decomposition, width: int) -> None:
        self.decomposition, self.width = decomposition, width
        for axis in decomposition.cut_axes:
            least = min(decomposition.parts[axis])
            if least < width:
                raise ValueError(
                    f"a box of {least} cells along {'xyz'[axis]}, but {width} ghost cells: at most "
                    f"{max(decomposition.counts[axis] // width, 1)} ranks fit along that axis"
                )
        nx, ny, nz = (n + 2 * width for n in decomposition.box.counts)
        self.shape = nz, ny, nx
        boxes = decomposition.boxes
        stored = [box.grown(width) for box in boxes]
        several, shifts = decomposition.ranks.size > 1, decomposition.shifts
        self._forest = (
            star_forest(decomposition.ranks, boxes, stored, shifts=shifts) if several else None
        )
        self._staging: dict[type, np.ndarray] = {}
        self._coarser: dict[tuple[int, int, int], Halo | None] = {}

    @property
    def whole(self) -> tuple[int, int, int]:
        """Number of cells (nz, ny, nx) of the whole grid."""
        nx, ny, nz = self.decomposition.counts
        return nz, ny, nx

    @property
    def cuts(self) -> list[tuple[int, int]]:
        """Sides of the box with a neighbor rank, as (axis, 0 lower or 1 upper)."""
        d = self.decomposition
        return [
            (axis, side)
            for axis in d.cut_axes
            for side in range(2)
            if d.neighbor(axis, side) is not None
        ]

    def coarser(self, factors: tuple[int, int, int]) -> Halo | None:
        """Return the halo of aggregates of cells along x, y, z; None if one is cut."""
        if factors not in self._coarser:  # solves on the same boxes share the exchanges
            decomposition = self.decomposition.coarser(factors)
            self._coarser[factors] = (
                None if decomposition is None else Halo(decomposition, self.width)
            )
        return self._coarser[factors]

    def join_components(
        self, number: np.ndarray, held: np.ndarray, faces: Sequence[np.ndarray | float]
    ) -> np.ndarray | None:
        """Join components of this rank's cells with those of other ranks; collective.

        Free components of boxes are nodes of a graph, whose edges are open faces at cuts. One more
        node stands for all held components.

        Args:
            number: of the component of each stored cell, flat, from 0; -1: none, or it is held.
            held: mask of the stored cells that belong to held components, bool.
            faces: coefficients of the lower faces along x, y, z, stored or one number; 0: closed.

        Returns:
            The numbers of the joined components that are held on no rank, int32, flat, from 0, -1
            elsewhere; None: there are none.
        """
        ranks = self.decomposition.ranks
        # Nodes of the graph: GROUND for all held components, then the free ones, rank by rank.
        first, nodes = number_nodes(ranks, ranks.gather(int(number.max(initial=-1)) + 1))
        node = np.where(number >= 0, number + first, np.where(held, GROUND, -1)).astype(np.int32)
        component = connected_components(ranks, nodes, self._edges(node, faces))
        floating = component != component[GROUND]
        if not floating.any():
            return None
        # The joined components that are not connected with GROUND are numbered from 0.
        names = np.full(nodes, -1, dtype=np.int32)
        names[floating] = np.unique(component[floating], return_inverse=True)[1]
        return np.where(number >= 0, names[np.maximum(node, 0)], -1).astype(np.int32)

    def _edges(self, node: np.ndarray, faces: Sequence[np.ndarray | float]) -> np.ndarray:
        """Return pairs of nodes of neighboring ranks that an open face connects.

        The face lies at a cut. Shape (n, 2).
        """
        edges, grid = [], node.reshape(self.shape).copy()
        # Ghost cells at the domain's sides are not written.
        for axis in self.decomposition.cut_axes:
            for end in (0, -1):
                grid[(*[slice(None)] * (2 - axis), end, ...)] = -1
        self.fill(grid)
        # An edge connects a ghost cell below a cut with the first cell of the box above it.
        for axis in self.decomposition.cut_axes:
            lower = [slice(1, -1)] * 3
            lower[2 - axis] = slice(0, 1)
            upper = list(lower)
            upper[2 - axis] = slice(1, 2)
            a, b = grid[tuple(lower)].ravel(), grid[tuple(upper)].ravel()
            face = np.broadcast_to(faces[axis], self.shape)[tuple(upper)].ravel()
            open_faces = (a >= 0) & (b >= 0) & (face > 0)
            edges.append(np.stack([a[open_faces], b[open_faces]], axis=1))
        return (
            np.unique(np.concatenate(edges), axis=0) if edges else np.empty((0, 2), dtype=np.int32)
        )

    @cached_property
    def field_gather(self) -> GridGather:
        """Gathering of the fields of all ranks on every rank."""
        return GridGather(self.decomposition)

    def fill(self, field: DeviceArray | np.ndarray) -> None:
        """Halo exchange: fill the ghost cells of a contiguous field; collective.

        The field has shape `shape`, or as many elements.
        """
        if self._forest is None:
            return
        if isinstance(field, wp.array) and field.device.is_cuda:
            self._fill_through_host(field.reshape(self.shape))
            return
        exchange(self._forest, field.numpy() if isinstance(field, wp.array) else field)

    def fill_task(self, field: DeviceArray) -> HostTask:
        """Return the halo exchange of a field, to run now or within a recorded program.

        For more than one rank.
        """
        if field.device.is_cuda:
            return HostTask(partial(self.fill, field))
        assert self._forest is not None
        return HostTask(
            partial(self.fill, field),
            partial(exchange_operation, self._forest, field.numpy(), field.numpy()),
        )

    def _fill_through_host(self, field: DeviceArray) -> None:
        """Fill a field on a device.

        Cells within `width` of the cuts are copied through the host's memory, so that PETSc needs
        no CUDA.
        """
        assert self._forest is not None
        host = self._staging.setdefault(
            field.dtype, np.zeros(self.shape, dtype=wp.dtype_to_numpy(field.dtype))
        )
        for inner in self._slabs(ghost=False):
            host[inner] = field[inner].numpy()
        exchange(self._forest, host)
        for outer in self._slabs(ghost=True):
            wp.copy(
                field[outer],
                wp.array(np.ascontiguousarray(host[outer]), dtype=field.dtype, device="cpu"),
            )

    def _slabs(self, *, ghost: bool) -> list[tuple[slice, ...]]:
        """Return the slabs of a stored field beside this rank's cuts.

        They are ghost cells, or the cells that other ranks have as ghost cells.
        """
        slabs, w = [], self.width
        for axis, side in self.cuts:
            n = self.shape[2 - axis]
            first = (0 if ghost else w) if side == 0 else (n - w if ghost else n - 2 * w)
            slab = [slice(None)] * 3
            slab[2 - axis] = slice(first, first + w)
            slabs.append(tuple(slab))
        return slabs


class GridGather:
    """Gathers a field of all boxes into one field of the whole grid on every rank.

    Both fields have one layer of ghost cells.

    Args:
        decomposition: the boxes.
    """

    def __init__(self, decomposition: Decomposition) -> None:
        self.decomposition = decomposition
        whole = CellBox((0, 0, 0), decomposition.counts)
        boxes = decomposition.boxes
        self._forest = star_forest(
            decomposition.ranks, boxes, [box.grown(1) for box in boxes], whole=whole.grown(1)
        )
        self._low = [first.start for first in decomposition.box.grown(1).moved((1, 1, 1)).slices]
        nx, ny, nz = decomposition.box.counts
        self._shape, self._whole = (
            (nz + 2, ny + 2, nx + 2),
            tuple(n + 2 for n in reversed(decomposition.counts)),
        )

    def collect(self, mine: DeviceArray, whole: DeviceArray) -> None:
        """Write the ranks' cells to the whole grid's field on every rank."""
        source, target = mine.numpy(), whole.numpy()
        exchange(self._forest, source, target)
        if whole.device.is_cuda:
            whole.assign(target)

    def collect_task(self, own_part: DeviceArray, whole: DeviceArray) -> HostTask:
        """Return `collect`, now or among the launches of a program."""
        if whole.device.is_cuda:
            return HostTask(partial(self.collect, own_part, whole))
        return HostTask(
            partial(self.collect, own_part, whole),
            partial(exchange_operation, self._forest, own_part.numpy(), whole.numpy()),
        )

    def copy_part(self, whole: DeviceArray, mine: DeviceArray, launch: Launch = launch_now) -> None:
        """Write this rank's part of the whole grid's field to its own, with ghost cells."""
        given = [whole.reshape(self._whole), mine.reshape(self._shape), *self._low]
        launch(copy_part_kernel, self._shape[:2], given, device=mine.device)


@forward_kernel(module="warp_lcp.distributed.halo")
@no_type_check
def copy_part_kernel(
    whole: wp.array3d(dtype=Any), mine: wp.array3d(dtype=Any), k0: int, j0: int, i0: int
):
    """Copy a row of a box."""
    k, j = wp.tid()
    for i in range(mine.shape[2]):
        mine[k, j, i] = whole[k0 + k, j0 + j, i0 + i]


for _T in (wp.float32, wp.float64):
    wp.overload(copy_part_kernel, [wp.array3d(dtype=_T), wp.array3d(dtype=_T), int, int, int])


class StarForest:
    """A star forest of PETSc that is freed with the last reference to it.

    petsc4py keeps objects that Python's garbage collector frees until PETSc ends. Ranks then wait
    for ever unless all have kept equally many, but each collects garbage at another time.

    Args:
        made: the forest, invalid after this object is freed.

    Attributes:
        handle: PETSc's handle of it, which recorded exchanges read in each run.
        pairs: units and addresses of roots and leaves that recorded exchanges read, by their
            content.
    """

    def __init__(self, made: PETSc.SF) -> None:
        self.handle, self.free = (ctypes.c_uint64 * 1)(), weakref.finalize(self, made.destroy)
        self.petsc_forest = made
        self.handle[0] = made.handle
        self.pairs: dict[tuple[int, ...], ctypes.Array[ctypes.c_uint64]] = {}

    def replace(self, made: PETSc.SF) -> None:
        """Free the forest and use another one, also in recorded exchanges; collective."""
        self.free()
        self.petsc_forest, self.free = made, weakref.finalize(self, made.destroy)
        self.handle[0] = made.handle


def star_forest(
    ranks: Ranks,
    owned: Sequence[CellBox],
    stored: Sequence[CellBox],
    *,
    filled: CellBox | None = None,
    layers: int = 1,
    whole: CellBox | None = None,
    which: np.ndarray | None = None,
    shifts: Sequence[Triple] = ((0, 0, 0),),
    into: StarForest | None = None,
) -> StarForest:
    """Return a star forest that fills ghost cells; collective.

    Its leaves are this rank's ghost cells, its roots the cells of other ranks that they repeat.

    Args:
        ranks: that have the boxes.
        owned: the cells that each rank owns; they do not overlap.
        stored: the cells that each rank stores.
        filled: region of the ghost cells to fill; None: all.
        layers: of numbers of those cells, one behind the other.
        whole: the cells of other fields that receive the values of all ranks, this rank's too;
            None: leaves and roots lie in the same field.
        which: mask of the stored cells to fill, bool of their shape (nz, ny, nx); None: all.
        shifts: periodic images: cells along x, y, z by which owned cells are repeated around this
            rank.
        into: a forest that this one replaces, see `StarForest.replace`; None: there is none.
    """
    own_rank, roots = ranks.rank, layers * stored[ranks.rank].cells
    around = whole or stored[own_rank]
    wanted = around if filled is None else around.common(filled)
    leaves, remotes = [np.empty(0, dtype=np.int64)], [np.empty((0, 2), dtype=np.int32)]
    for (rank, (box, remote)), shift in itertools.product(
        enumerate(zip(owned, stored, strict=True)), shifts
    ):
        shared = wanted.common(box.moved(shift))
        if (whole or rank != own_rank) and shared.cells:
            here, remote_elements = (
                _elements(shared, around),
                _elements(shared.moved(shift, -1), remote),
            )
            if which is not None:
                chosen = which.ravel()[here]
                here, remote_elements = here[chosen], remote_elements[chosen]
            for layer in range(layers):
                leaves.append(here + layer * around.cells)
                remotes.append(_remote(rank, remote_elements + layer * remote.cells))
    forest = petsc().SF().create(comm=ranks.comm)
    forest.setGraph(roots, np.concatenate(leaves).astype(np.int32), np.concatenate(remotes))
    if into is None:
        return StarForest(forest)
    into.replace(forest)
    return into


def _elements(box: CellBox, within: CellBox) -> np.ndarray:
    """Return the indices of a box's cells in a flat array of another box's cells."""
    nx, ny, _ = within.counts
    x, y, z = (np.arange(l, h) - o for l, h, o in zip(box.low, box.high, within.low, strict=True))
    return ((z[:, None, None] * ny + y[:, None]) * nx + x).ravel()


def _remote(rank: int, elements: np.ndarray) -> np.ndarray:
    return np.stack([np.full(len(elements), rank), elements], axis=1).astype(np.int32)
