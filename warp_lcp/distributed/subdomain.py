"""Subdomain of a staggered grid: a rank's box and its ghost layers."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from functools import partial
from typing import Any, cast, no_type_check

import numpy as np
import warp as wp

from warp_lcp.distributed.balance import Balance
from warp_lcp.distributed.ballistic_fragments import FragmentMerger
from warp_lcp.distributed.decomposition import Decomposition
from warp_lcp.distributed.ghost_width import GhostLayerExchange, displacement_beyond_ghosts
from warp_lcp.distributed.halo import StarForest, star_forest
from warp_lcp.distributed.interruptible_wait import waiting
from warp_lcp.distributed.messages import Mailbox, MpiMailbox, exchange_all, exchange_all_operation
from warp_lcp.distributed.particle_pieces import take_pieces
from warp_lcp.distributed.particles import ParticleMigration
from warp_lcp.distributed.passive_particles import rows_of_pieces, send_to_owners
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.distributed.repartition import cuts_of, migrate
from warp_lcp.distributed.subdomain_boundary import boundary_of_part
from warp_lcp.grid.cell_box import CellBox
from warp_lcp.grid.grid_part import BodyNumbers, Corner, FieldT, GridPart
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import ActiveWindow, StaggeredGrid, Window
from warp_lcp.grid.voxelize import PlacedSolid
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.launch_graph import HostTask, is_recording, launch, run_table
from warp_lcp.kernels.recorded_arguments import slot_of
from warp_lcp.kernels.thread_pool import Operation, OperationTable, team
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import Communicator, convert
from warp_lcp.material.boundary import Boundary
from warp_lcp.material.particle_pieces import Piece, fields_of
from warp_lcp.material.particle_scene import ParticleScene

DEFAULT_BALANCE = Balance()
MOST_KEPT = 32  # most cached exchanges
# Ghost layers. Whether liquid is held can depend on a closed face up to 4.8 cells away.
LAYERS = 5


def ghost_layers(cfl: float, smoothing: int) -> int:
    """Return the number of ghost layers that a box needs.

    Ghost layers are correct after a halo exchange. Each computation that reads neighbors then makes
    one more layer wrong, beginning with the outermost. The next exchange comes before wrong values
    reach the box. No exchange takes place during advection: each stage reads faces within 1.5 cells
    of the particle, and three layers more than the Courant number allow for liquid that the step
    makes faster. Neither does one take place during the smoothing of the level set: each binomial
    pass takes a layer, the slope beside walls another, and cells in solids two.

    Args:
        cfl: the Courant number of the run.
        smoothing: binomial passes over the level set.
    """
    return max(LAYERS, math.ceil(cfl) + 3, smoothing + 3)


@forward_kernel(module="warp_lcp.distributed.cells")
@no_type_check
def copy_kernel(to: wp.array3d(dtype=Any), source: wp.array3d(dtype=Any)):
    """Copy a row of cells."""
    k, j = wp.tid()
    for i in range(to.shape[2]):
        to[k, j, i] = source[k, j, i]


for _T in (wp.int8, wp.uint8, wp.float32, wp.float64):
    wp.overload(copy_kernel, [wp.array3d(dtype=_T), wp.array3d(dtype=_T)])


def _stays(field: wp.array | np.ndarray) -> bool:
    """Return whether a recorded launch may identify a field by its address."""
    return isinstance(field, wp.array) and field.device.is_cpu and slot_of(field) is None


def copy_cells(to: DeviceArray, source: DeviceArray) -> None:
    """Copy cells of a field to another, now or recorded; both may be views."""
    if is_recording():
        launch(copy_kernel, to.shape[:2], [to, source], device=to.device)
    else:
        wp.copy(to, source)


def _fill(forest: StarForest, fields: Sequence[wp.array | np.ndarray]) -> None:
    """Fill the ghost cells that a star forest has as leaves."""
    hosts = [field if isinstance(field, np.ndarray) else field.numpy() for field in fields]
    exchange_all(forest, [(host, host) for host in hosts])
    for field, host in zip(fields, hosts, strict=True):
        if isinstance(field, wp.array) and field.device.is_cuda:
            field.assign(host)


def _fill_operation(forest: StarForest, fields: Sequence[wp.array | np.ndarray]) -> Operation:
    """Return `_fill` as an operation of the thread pool."""
    hosts = [field if isinstance(field, np.ndarray) else field.numpy() for field in fields]
    return exchange_all_operation(forest, [(host, host) for host in hosts])


class Subdomain(GridPart):
    """Subdomain of a rank: the cells of its box and ghost layers around it.

    Ghost layers hold the cells of the domain within `layers` of the box. The outermost layer is the
    ring that every staggered grid has around its cells. At the domain's sides the ring is that of
    the whole grid, at cuts it is the last of the ghost layers: there the sides of the part must be
    open, see `cuts`. Along a periodic axis that is cut, the part continues beyond the domain's
    sides with the periodic images of the cells.

    Args:
        decomposition: the boxes of all ranks.
        spacing: edge of a cell [m].
        dimension: 2 or 3.
        device: a Warp device or its name.
        layers: ghost cells at cuts, the ring included.
        mailbox: carries messages between neighbors; None: MPI's.
        balance: when to repartition.

    Attributes:
        grid: the part as a grid, whose coordinates and positions are those of the whole domain.
        cuts: has bit n set if side n of the part, see `warp_lcp.grid.domain_sides`, is a cut.
        own_faces: those whose lower faces belong to the box: its cells, and the ring beyond the
            domain's upper sides that it touches.

    Raises:
        ValueError: a box has fewer cells along a cut axis than layers; on all ranks.
    """

    shared = True
    decomposition: Decomposition
    ranks: Ranks

    def __init__(
        self,
        decomposition: Decomposition,
        *,
        spacing: float,
        dimension: int,
        device: wp.DeviceLike,
        layers: int,
        mailbox: Mailbox | None = None,
        balance: Balance = DEFAULT_BALANCE,
    ) -> None:
        self.decomposition, self.layers, self.dimension = decomposition, layers, dimension
        self.ranks, self.box, self.joined = (
            decomposition.ranks,
            decomposition.box,
            tuple(decomposition.joined),
        )
        self.balance, self.mailbox = balance, mailbox or MpiMailbox(self.ranks.comm)
        self._fillings: dict[Hashable, OperationTable] = {}
        self._forests: dict[tuple[int, int | None, int], StarForest] = {}
        self._gathering: StarForest | None = None
        self._trees: FragmentMerger | None = None
        self._near: dict[int, tuple[Window, ActiveWindow]] = {}  # key: layers around the box
        for axis in decomposition.cut_axes:
            least, most = (
                min(decomposition.parts[axis]),
                max(decomposition.counts[axis] // layers, 1),
            )
            if least < layers:
                raise ValueError(
                    f"{decomposition.processes[axis]} ranks along {'xyz'[axis]} have boxes of "
                    f"{least} cells, but a step needs "
                    f"{layers} layers around a box: start fewer ranks (at most {most} along that "
                    "axis), or refine the grid"
                )
        cells = self._cells(self.box)
        self.grid = StaggeredGrid(
            cells.counts,
            spacing,
            dimension,
            device,
            origin=cells.low,
            whole=decomposition.counts,
            part=self,
        )
        inner = self.box.moved(cells.low, -1)
        self._owned = self.grid.window([low + 1 for low in inner.low], inner.high)
        last = self._at_sides(self.box)[1]
        self.own_faces = self.grid.window(
            [low + 1 for low in inner.low],
            [high + end for high, end in zip(inner.high, last, strict=True)],
        )
        self.cuts = 0
        for axis in range(dimension):
            for side in range(2):
                self.cuts |= (decomposition.neighbor(axis, side) is not None) << (2 * axis + side)

    @property
    def comm(self) -> Communicator | None:
        """Communicator of reductions; None if there is one rank."""
        return self.ranks if self.ranks.size > 1 else None

    @property
    def at_once(self) -> bool:
        """Whether launches with halo exchanges cannot be recorded.

        On CUDA the exchange goes through the host.
        """
        return bool(self.grid.device.is_cuda)

    @property
    def owned(self) -> Window:
        """The cells of the box."""
        return self._owned

    @property
    def stored(self) -> Window:
        """Stored cells that this rank owns.

        They are the cells of the box and the ring beyond the domain's sides.
        """
        stored = self.stored_cells
        return Window.of(stored.low[::-1], stored.high[::-1], self.grid.device)

    @property
    def first(self) -> tuple[int, int, int]:
        """First cell of the box along x, y, z, counted from 0 in the whole domain."""
        return self.box.low

    def faces(self, window: Window) -> Window:
        """Return the cells whose lower faces belong to the box."""
        return self.own_faces

    def own_cells(self, window: Window) -> Window:
        """Return the cells of the box."""
        return self._owned

    def whole(self, window: Window) -> Window:
        """Return all cells: other ranks may have material where this rank has none."""
        return self.grid.everywhere

    def repartition(self, decomposition: Decomposition) -> Subdomain:
        """Return the part of this rank with other boxes."""
        return Subdomain(
            decomposition,
            spacing=self.grid.spacing,
            dimension=self.dimension,
            device=self.grid.device,
            layers=self.layers,
            mailbox=self.mailbox,
            balance=self.balance,
        )

    def should_rebalance(self, step: int) -> bool:
        """Return whether the ranks check for better boxes in a step."""
        return self.balance.should_rebalance(self, step)

    def rebalance(self, particles: Particles, a_cell: int) -> Subdomain | None:
        """Return the part with better boxes, see `Balance.rebalance`; collective.

        Returns None if the present boxes are good enough.
        """
        better = self.balance.rebalance(self, particles, a_cell)
        return None if better is None else self.repartition(better)

    def migrate(self, piece: Piece, particles: Sequence[str], before: Subdomain) -> Piece:
        """Return the piece of a state in this box, from the former boxes; collective."""
        return migrate(piece, particles, before, self)

    def of_pieces(self, pieces: Sequence[Piece]) -> Subdomain | None:
        """Return the part with the boxes of pieces of a state; collective.

        Returns this part if the boxes are the same, and None if the ranks cannot have them.
        """
        with self.decomposition.collective.root_only():
            cuts = cuts_of(pieces, self)
        if cuts is None or cuts == self.decomposition.parts:
            return None if cuts is None else self
        return self.repartition(self.decomposition.repartition(cuts))

    def take_pieces(
        self,
        pieces: Sequence[Piece],
        particles: Sequence[str],
        like: Mapping[str, np.ndarray],
        signature: np.ndarray,
        solids: np.ndarray | None,
    ) -> tuple[Piece, Piece, Piece]:
        """Return the contents of pieces that lie in this box; collective.

        See `warp_lcp.distributed.particle_pieces.take_pieces`.
        """
        return take_pieces(self, particles, like, signature, pieces, solids)

    def send_to_owners(self, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray] | None:
        """Send passive particles to the ranks of their cells; collective.

        See `warp_lcp.distributed.passive_particles`, also for the next method.
        """
        return send_to_owners(self, arrays)

    def rows_of_pieces(
        self, pieces: Sequence[Piece], names: Sequence[str]
    ) -> dict[str, np.ndarray]:
        """Return the passive particles of pieces that lie in this box; collective."""
        return rows_of_pieces(self, pieces, names)

    @property
    def corners(self) -> tuple[Corner, Corner]:
        """First cell (x, y, z) of the box, and the one behind its last."""
        return self.box.low, self.box.high

    def where(self) -> dict[str, np.ndarray]:
        """Return the arrays that describe the box in a piece.

        `box`, int64 (2, 3), is the box's first cell and the one behind its last; `counts`, int64
        (3,), are the whole grid's cells.
        """
        return {"box": np.array(self.corners), "counts": np.array(self.decomposition.counts)}

    def checkpoint_fields(self, fields: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return fields on the box, shape (..., nz, ny, nx); numbers are unchanged."""
        cells = fields_of(fields)
        return {
            name: np.ascontiguousarray(self.box_of(values)) if name in cells else values
            for name, values in fields.items()
        }

    def refill(self) -> GhostLayerExchange:
        """Return a function that fills ghost cells during velocity extrapolation.

        It exchanges halos before wrong values in the ghost cells can reach the box.
        """
        return GhostLayerExchange(self)

    def cells_too_far(self, velocity: Sequence[wp.array], dt: float) -> float:
        """Return the largest displacement in a step that may leave the ghost layers.

        It is the largest of all ranks, in cells; 0: no particle leaves them.
        """
        return float(self.ranks.max(displacement_beyond_ghosts(self, velocity, dt)))

    def notes(self) -> list[str]:
        """Return the number of ranks and the size of their boxes, as text."""
        boxes = self.decomposition.boxes
        largest = " x ".join(
            map(str, max(boxes, key=lambda box: box.cells).counts[: self.dimension])
        )
        return [
            f"{len(boxes)} ranks, boxes of up to {largest} cells and {self.layers} layers of ghost "
            "cells"
        ]

    def coarser(self, layers: int) -> StaggeredGrid | None:
        """Return this rank's part of the grid with cells of twice the edge.

        Returns None if a cut lies inside a coarse cell, or a box is thinner than `layers`.
        """
        if self.comm is None:
            return super().coarser(layers)
        boxes, grid = self.decomposition.coarser((2, 2, self.dimension - 1)), self.grid
        if boxes is None or any(min(boxes.parts[axis]) < layers for axis in boxes.cut_axes):
            return None
        return Subdomain(
            boxes,
            spacing=2.0 * grid.spacing,
            dimension=self.dimension,
            device=grid.device,
            layers=layers,
        ).grid

    @property
    def row_ranks(self) -> Ranks | None:
        """Ranks with cells of the same rows along x, in order; None if x is not cut."""
        return (
            self.ranks.in_rows(self.decomposition.processes[0])
            if 0 in self.decomposition.cut_axes
            else None
        )

    def _cells(self, box: CellBox) -> CellBox:
        """Return the cells of the part around a box, without its ring."""
        counts, joined = self.decomposition.counts, self.decomposition.joined
        more = [self.layers if axis in joined else 0 for axis in range(3)]
        return box.grown(self.layers - 1).common(
            CellBox.of([-m for m in more], [n + m for n, m in zip(counts, more, strict=True)])
        )

    def _at_sides(self, box: CellBox) -> list[list[bool]]:
        """Return whether a box ends at the domain's lower and upper sides.

        One pair for each of x, y, z. Periodic sides do not count.
        """
        counts, joined = self.decomposition.counts, self.decomposition.joined
        ends = [
            [n == 0 for n in box.low],
            [n == count for n, count in zip(box.high, counts, strict=True)],
        ]
        return [[at and axis not in joined for axis, at in enumerate(end)] for end in ends]

    def forest(
        self,
        layers: int = 1,
        width: int | None = None,
        parts: int = 1,
        which: np.ndarray | None = None,
        into: StarForest | None = None,
    ) -> StarForest:
        """Return a star forest that fills ghost cells and rings; collective.

        Args:
            layers: of a field.
            width: distance from the box in cells; None: all.
            parts: the fields are of `grid.refined(parts)`.
            which: of a field's cells, bool; None: all.
            into: a forest that this one replaces, in recorded exchanges too; None: there is none.
        """
        boxes = self.decomposition.boxes
        owned = [self._with_sides(box, parts) for box in boxes]
        filled = None if width is None else self._refined(self.box.grown(width), parts)
        stored = [self._refined(self._cells(box), parts).grown(1) for box in boxes]
        shifts = [
            self._refined(CellBox(shift, shift), parts).low for shift in self.decomposition.shifts
        ]
        return star_forest(
            self.ranks,
            owned,
            stored,
            filled=filled,
            layers=layers,
            which=which,
            shifts=shifts,
            into=into,
        )

    def _refined(self, box: CellBox, parts: int) -> CellBox:
        """Return a box of cells refined by a factor along each axis."""
        each = [parts if axis < self.dimension else 1 for axis in range(3)]
        return CellBox.of(
            *([n * p for n, p in zip(corner, each, strict=True)] for corner in (box.low, box.high))
        )

    def _with_sides(self, box: CellBox, parts: int = 1) -> CellBox:
        """Return a box, refined, with the ring cells that its rank owns.

        They lie beyond the domain's sides that the box touches.
        """
        found = self._refined(box, parts)
        low, high = list(found.low), list(found.high)
        at_low, at_high = self._at_sides(box)
        for axis in range(self.dimension):  # in 2-D one plane is used
            low[axis] -= at_low[axis]
            high[axis] += at_high[axis]
        return CellBox.of(low, high)

    def fill(
        self,
        *fields: wp.array | np.ndarray,
        width: int | None = None,
        parts: int = 1,
        forest: StarForest | None = None,
    ) -> None:
        """Halo exchange: fill the ghost cells of fields, or of stacks of them; collective.

        A stack has equally many layers. On the CPU the exchange may be recorded among launches,
        which all ranks then run alike.

        Args:
            fields: any types, the last axes z, y, x; or the host's views of their memory, which
                cost less to fill often.
            width: distance from the box in cells; None: all.
            parts: the fields are of `grid.refined(parts)`.
            forest: of `forest`, for such fields; None: one that is made once.
        """
        if self.ranks.size == 1:
            return
        if forest is None:
            kind = 1 if fields[0].ndim == 3 else fields[0].shape[0], width, parts
            forest = self._forests[kind] = self._forests.get(kind) or self.forest(*kind)
            if not is_recording() and team() is not None and all(map(_stays, fields)):
                self._fill_again(forest, fields)
                return
        self.fill_task(*fields, forest=forest).launch()

    def fill_task(self, *fields: wp.array | np.ndarray, forest: StarForest) -> HostTask:
        """Return `fill` over a star forest, to run now or in a recorded program."""
        operation = None if self.grid.device.is_cuda else partial(_fill_operation, forest, fields)
        return HostTask(partial(_fill, forest, fields), operation)

    def _fill_again(self, forest: StarForest, fields: Sequence[wp.array]) -> None:
        """Fill fields that were filled before, by the exchange set up then."""
        key = forest, *((field.ptr, field.dtype) for field in fields)
        if key not in self._fillings:
            if len(self._fillings) >= MOST_KEPT:
                self._fillings.clear()
            hosts = [field.numpy() for field in fields]
            self._fillings[key] = OperationTable(
                [exchange_all_operation(forest, [(host, host) for host in hosts])]
            )
        run_table(self._fillings[key])

    def collect(self, fields: Sequence[wp.array], whole: Sequence[wp.array]) -> None:
        """Gather fields of the part into fields of the whole grid; collective.

        Every rank gets the whole fields.
        """
        if self._gathering is None:
            boxes, cells = self.decomposition.boxes, CellBox((0, 0, 0), self.decomposition.counts)
            stored = [self._cells(box).grown(1) for box in boxes]
            self._gathering = star_forest(
                self.ranks, [self._with_sides(box) for box in boxes], stored, whole=cells.grown(1)
            )
        hosts = [field.numpy() for field in whole]
        exchange_all(
            self._gathering,
            [(field.numpy(), host) for field, host in zip(fields, hosts, strict=True)],
        )
        for field, host in zip(whole, hosts, strict=True):
            if field.device.is_cuda:
                field.assign(host)

    def copy_part(self, whole: wp.array, field: wp.array) -> None:
        """Write this part's values of a whole-grid field to a field of the part."""
        wp.copy(field, whole[self._cells(self.box).grown(1).moved((1, 1, 1)).slices])

    def box_of(self, field: FieldT, ring: int = 0) -> FieldT:
        """Return the view of a field on the box and some cells around it.

        The field may be on the host or a device, and may have layers.
        """
        low, high = self.owned.low, self.owned.high
        edge = (ring if self.dimension == 3 else 0, ring, ring)
        box = (slice(l - e, h + e) for l, h, e in zip(low, high, edge, strict=True))
        return cast(FieldT, field[(slice(None),) * (field.ndim - 3) + tuple(box)])

    @property
    def stored_cells(self) -> CellBox:
        """Stored cells that this rank owns.

        They are the cells of the box and the ring beyond the domain's sides.
        """
        return self._with_sides(self.box).moved(self.grid.origin, -1).moved((1, 1, 1))

    def known_of(self, field: np.ndarray) -> np.ndarray:
        """Return the view of a host field on the cells that this rank owns."""
        return field[self.stored_cells.slices]

    def stored_box_of(self, field: wp.array) -> wp.array:
        """Return the view of a field on the box and one cell around it.

        It has the stored shape of such a box.
        """
        low, high = self.owned.low, self.owned.high
        return field[low[0] - 1 : high[0] + 1, low[1] - 1 : high[1] + 1, low[2] - 1 : high[2] + 1]

    def box_like(self, field: wp.array) -> wp.array:
        """Return a field of the box with a ring.

        It shares the part's memory where boxes are layers of planes; otherwise it is a new field of
        zeros.
        """
        view = self.stored_box_of(field)
        return (
            view
            if view.is_contiguous
            else wp.zeros(view.shape, dtype=field.dtype, device=self.grid.device)
        )

    def grid_field(self, box: wp.array) -> wp.array:
        """Return a field of zeros for the values of a field of the box."""
        return self.grid.field(box.dtype)

    def copy_to_box(self, field: wp.array, box: wp.array) -> None:
        """Copy the part's values to a field of the box, unless they share memory."""
        view = self.stored_box_of(field)
        if view.ptr != box.ptr:
            copy_cells(self._in_box(box), view)

    def copy_from_box(self, box: wp.array, field: wp.array) -> None:
        """Copy the cells of a field of the box to the part, without ghost cells."""
        copy_cells(self.box_of(field), self._in_box(box)[1:-1, 1:-1, 1:-1])

    def _in_box(self, box: wp.array) -> wp.array:
        """Return a field of the box, perhaps flat, in the box's stored shape."""
        nx, ny, nz = self.box.counts
        return box.reshape((nz + 2, ny + 2, nx + 2))

    def store(self, x: wp.array, field: wp.array, spare: wp.array) -> None:
        """Write the solution of a problem on the box to the part; collective.

        Ghost cells get the values of the ranks that own them.
        """
        if x.dtype is not wp.float64:  # result of a method in single precision
            convert(x.flatten(), spare.flatten())
            x = spare
        self.copy_from_box(x, field)
        self.fill(field)

    @property
    def gathered_from(self) -> Corner:
        """First cell of the result of `gathered`, in the whole domain."""
        return 0, 0, 0

    def gathered(self, values: np.ndarray) -> np.ndarray | None:
        """Return a field of the whole grid on the root rank, None elsewhere; collective.

        Args:
            values: of this part without its ring.
        """
        first = [low - before for low, before in zip(self.box.low, self.grid.origin, strict=True)]
        box = np.ascontiguousarray(values[CellBox((0, 0, 0), self.box.counts).moved(first).slices])
        with waiting("a gather"):
            everyone = [box] if self.ranks.size == 1 else self.ranks.comm.gather(box)
        if everyone is None:
            return None
        whole = np.empty(self.decomposition.counts[::-1], dtype=box.dtype)
        for part, values in zip(self.decomposition.boxes, everyone, strict=True):
            whole[part.slices] = values
        return whole

    def keep_own(self, cells: np.ndarray) -> None:
        """Set a mask of the part's cells to False outside the box."""
        own = tuple(
            slice(low - 1, high - 1)
            for low, high in zip(self.owned.low, self.owned.high, strict=True)
        )
        inside = cells[own].copy()
        cells[...] = False
        cells[own] = inside

    def make_boundary(
        self, scene: ParticleScene, solids: Sequence[PlacedSolid]
    ) -> tuple[Boundary, list[str]]:
        """Return solids and walls of the part, and warnings; collective.

        They are those of the whole grid.
        """
        return boundary_of_part(scene, self, solids)

    def exchange_of(self, particles: Particles) -> ParticleMigration:
        """Return the exchange of this part's particles with other ranks."""
        return ParticleMigration(self, particles)

    def nearest(self, cells: np.ndarray) -> np.ndarray:
        """Return the images of cells (x, y, z) that are nearest to the box.

        Shape (n, 3). Images exist along periodic axes.
        """
        for axis in self.joined:
            count = self.decomposition.counts[axis]
            first = self.owned.low[2 - axis] - 1 - (count - self.box.counts[axis]) // 2
            cells[:, axis] = (cells[:, axis] - first) % count + first
        return cells

    def near(self, window: Window, layers: int) -> Window | None:
        """Return a window clipped to the box and some layers around it.

        It follows a window that moves, for recorded launches.
        """
        if layers not in self._near:
            low, high = self.owned.low[::-1], [h - 1 for h in self.owned.high[::-1]]
            around = self.grid.window(low, high, grow=layers)
            self._near[layers] = around, ActiveWindow(around)
        around, active = self._near[layers]
        common = window.common(around)
        if common is None:
            return None
        active.move_to(common)
        return active

    def join_trees(
        self, trees: int, seen: Window | None, parent: wp.array, number: wp.array, held: wp.array
    ) -> BodyNumbers:
        """Join the trees of cells that extend over several boxes; collective."""
        if self._trees is None:
            self._trees = FragmentMerger(self)
        return self._trees.join(trees, seen, parent, number, held)

    def owners(self, cells: np.ndarray) -> np.ndarray:
        """Return the rank of each cell (x, y, z) of the whole domain, shape (n, 3)."""
        place = [
            np.searchsorted(np.cumsum(part)[:-1], cells[:, axis], side="right")
            for axis, part in enumerate(self.decomposition.parts)
        ]
        px, py, _ = self.decomposition.processes
        return np.asarray(place[0] + px * (place[1] + py * place[2]))
