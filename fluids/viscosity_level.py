"""Multigrid levels of the viscous equations on faces: sweeps and transfers.

The equations of coarse levels have the same form, with averages of the finer level's weights.
Interpolation is linear; beside air it uses the unknowns that exist. A coarse level is a sum of
squares, too: an unknown is coupled to faces in walls by at least the weight of its links to them.
Gauss-Seidel sweeps take one component after the other, each in two colors of rows, and then in
reverse order.

On ranks each face belongs to the rank whose box has the cell above it. A sweep has the order of one
process: as many layers of ghost cells as the second color needs are computed twice, and then the
component's ghost cells are exchanged. So the cycle is that of one process, on any number of ranks.
Where rows are not cut it is equal in bits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import warp as wp

from warp_lcp.fluids.viscosity_passes import viscous_passes
from warp_lcp.grid.staggered import CLEAR, FieldT, StaggeredGrid, Window, three_components
from warp_lcp.kernels.launch_graph import Launch, perform
from warp_lcp.multigrid.cycle import CycleStage, Launches

# Layers of ghost cells that sweeps need: rows of the second color read those of the first, in which
# odd cells read even ones.
KNOWN = 3
# Sweeps of a smoother: of the band of each row, or of all unknowns; those of a light cycle.
BANDS, LIGHT_BANDS = (True, False, True), (False, True)
SWEEPS = 4  # sweeps of the coarsest level, each forward and backward
# Factor on the finer level's `mixed`: twice that is at most `cell`, so that the squares of a cell
# outweigh its products also in 3-D.
MIXED = 0.5
# Factor on the finer level's wall drag, relative to its links: half of the faces near a wall lie in
# the row beside it.
WALL = 0.5


@dataclass(frozen=True, slots=True)
class ViscousRows:
    """Equations of the faces of one component.

    Float32 fields except `span` and `axis`.

    Attributes:
        axis: axis of the component.
        cell: weights of links along the axis.
        mixed: the part of `cell` that is omitted from the products of different components beside
            walls.
        xb: weights of links across, along the first of the other axes.
        xc: likewise along the second; None in 2-D.
        volume: mass weights of the faces.
        drag: contribution of walls to the diagonal.
        diagonal: the sum, 0 where there is no unknown.
        span: first and one past the last unknown of each row, and its core, int32.
    """

    axis: int
    cell: wp.array
    mixed: wp.array
    xb: wp.array | None
    xc: wp.array | None
    volume: wp.array
    drag: wp.array
    diagonal: wp.array
    span: wp.array


@dataclass(frozen=True, slots=True)
class LevelShift:
    """Offset between the cells of a level and the finer one.

    Number of cells from cell 2n - 1 to the first cell of the finer level in cell n of a coarse one.
    It is not 0 in parts of grids.
    """

    shift_x: int = 0
    shift_y: int = 0
    shift_z: int = 0


class ViscosityLevel:
    """Viscous equations on a grid, see `CycleLevel`.

    On a rank, on its part of the grid.

    Args:
        grid: grid of the level.
        x: its solution.
        b: its right-hand side.
        finer: grid of the finer level; None for the finest level.

    Attributes:
        cell: weights of links along a component's own axis.
        mixed: the part of `cell` that is omitted from the products of different components beside
            walls, see `fluids.viscosity`.
        edges: weights of links across, by pairs of axes.
        volume, drag, diagonal, hold, norm, there: fields of the faces of each component: mass
            weights; contribution of walls to the diagonal; their sum; flags of faces that a wall
            holds; normalization of the interpolation; flags of unknowns.
        r: the residual; scratch memory of sweeps.
        span: first and one past the last unknown of each row, and its core, a run of cells with
            equal equations.
        shift: offset between the finer level's cells and this one's.
        odd_row, odd_cell: 1 if row or cell 0 is odd in the whole grid, as for parts of grids.
    """

    visits = 1  # a V-cycle

    def __init__(
        self,
        grid: StaggeredGrid,
        x: list[wp.array],
        b: list[wp.array],
        finer: StaggeredGrid | None = None,
    ) -> None:
        shared = grid.part.comm is not None
        ox, oy, oz = origin = grid.origin if shared else (0, 0, 0)
        self.odd_row, self.odd_cell, self.shift = (oy + oz) % 2, ox % 2, LevelShift()
        if shared and finer is not None:
            self.shift = LevelShift(
                *[2 * own - fine for own, fine in zip(origin, finer.origin, strict=True)]
            )
        self._windows = [
            self._grown(grid, width) if shared else grid.domain for width in range(KNOWN + 1)
        ]
        self.shared, self.grid, self.dimension, self.passes = (
            shared,
            grid,
            grid.dimension,
            viscous_passes(grid.dimension),
        )
        self.cell, self.mixed = grid.field(), grid.field()
        self.edges = {
            pair: grid.field()
            for pair in [(0, 1), (0, 2), (1, 2)][: 1 if grid.dimension == 2 else 3]
        }
        self.volume, self.drag, self.diagonal, self.hold, self.norm, self.r, self.there = (
            grid.faces() for _ in range(7)
        )
        self.x, self.b = x, b
        self.span = wp.zeros(4 * grid.shape[0] * grid.shape[1], dtype=wp.int32, device=grid.device)

    def others(self, axis: int) -> list[int | None]:
        """Return the two other axes; None for a missing one."""
        return [*(a for a in range(self.dimension) if a != axis), None][:2]

    def of_others(self, axis: int, fields: Sequence[FieldT]) -> list[FieldT | None]:
        """Return the entries of the other components in a list with one per component."""
        return [None if other is None else fields[other] for other in self.others(axis)]

    def rows(self, axis: int) -> ViscousRows:
        """Return the equations of a component's faces."""
        xb, xc = (
            None if other is None else self.edges[min(axis, other), max(axis, other)]
            for other in self.others(axis)
        )
        on_faces = (self.volume[axis], self.drag[axis], self.diagonal[axis])
        return ViscousRows(axis, self.cell, self.mixed, xb, xc, *on_faces, self.span)

    @property
    def equations(self) -> list[wp.array]:
        """The fields of the equations."""
        fields = (self.edges.values(), self.volume, self.drag, self.hold, self.diagonal)
        return [self.cell, self.mixed, *(field for each in fields for field in each)]

    def around(self, width: int) -> Window:
        """Return the window of this part's cells and `width` layers around it."""
        return self._windows[width]

    @staticmethod
    def _grown(grid: StaggeredGrid, width: int) -> Window:
        owned, domain = grid.part.owned, grid.domain
        low = [max(n - width, least) for n, least in zip(owned.low, domain.low, strict=True)]
        return Window.of(
            low,
            [min(n + width, most) for n, most in zip(owned.high, domain.high, strict=True)],
            grid.device,
        )

    def share(self, fields: Sequence[wp.array], launch: Launch | None = None) -> None:
        """Fill ghost cells from other ranks.

        All layers of equations; only `KNOWN` layers while a cycle is launched or recorded.
        """
        if self.shared and launch is not None:
            memory = fields if self.grid.device.is_cuda else [field.numpy() for field in fields]
            perform(partial(self.grid.part.fill, *memory, width=KNOWN), launch)
        elif self.shared:
            self.grid.part.fill(*fields)

    def halved(self, window: Window) -> Window:
        """Return the cells of this level that average a window of the finer one.

        On ranks, all cells that this rank needs.
        """
        if self.shared:
            return self.grid.part.stored
        low = [n // 2 for n in window.low]
        high = [min(n // 2 + 2, size) for n, size in zip(window.high, self.grid.shape, strict=True)]
        if self.dimension == 2:
            low[0], high[0] = 1, 2
        return Window.of(low, high, self.grid.device)

    def find_spans(self, window: Window) -> None:
        """Find the first and the last unknown of each row."""
        dx, dy, dz = three_components(self.diagonal)
        window = self.grid.domain if self.shared else window
        window.run(self.passes.span, whole=True, dx=dx, dy=dy, dz=dz, span=self.span, ends=None)
        if self.shared:
            join_cores(self)

    def descend(
        self, coarse: ViscosityLevel, *, projected: bool, from_zero: bool
    ) -> Iterator[CycleStage]:
        """Yield steps 1 and 2 of a cycle: sweeps, and restriction of the residual."""
        assert from_zero and not projected, "a V-cycle without bounds"
        yield from self.down(coarse, BANDS)

    def coarsen_bounds(self, coarse: ViscosityLevel) -> tuple[()]:
        """Return an empty tuple, since there are no bounds."""
        return ()

    def ascend(self, coarse: ViscosityLevel, *, projected: bool) -> Iterator[CycleStage]:
        """Yield steps 5 and 6 of a cycle: prolongation and sweeps."""
        yield from self.up(coarse, BANDS)

    def down(self, coarse: ViscosityLevel, bands: Sequence[bool]) -> Iterator[CycleStage]:
        """Yield sweeps and the restriction of the residual; `bands`: see `smooth`."""
        yield from self._beginning()
        smooth = partial(self.smooth, True, bands)
        for step in (smooth, self.residual, partial(self.restrict, coarse)):
            yield Launches(step)

    def up(self, coarse: ViscosityLevel, bands: Sequence[bool]) -> Iterator[CycleStage]:
        """Yield prolongation and sweeps; `bands`: see `smooth`."""
        for step in (partial(self.prolong, coarse), partial(self.smooth, False, bands)):
            yield Launches(step)

    def solve(self, visits: int, *, projected: bool, from_zero: bool) -> Iterator[CycleStage]:
        """Yield the stages of a `CoarsestSolver`: forward, then backward sweeps."""
        yield from self._beginning()
        for forth in (True,) * SWEEPS + (False,) * SWEEPS:
            yield Launches(partial(self.sweep, forth))

    def _beginning(self) -> Iterator[CycleStage]:
        """Yield the exchange of b's ghost cells, and x = 0."""
        yield Launches(partial(self.share, self.b))
        yield Launches(self.clear)

    def smooth(self, forth: bool, bands: Sequence[bool], launch: Launch) -> None:
        """Relax the band of each row or all unknowns, in the order of `bands` if `forth`.

        The band are the unknowns outside of the rows' cores, at surfaces and walls, where errors
        decay slowly. The order is reversed if not `forth`, so that a cycle is symmetric.
        """
        for band in bands if forth else reversed(bands):
            self.sweep(forth, launch, band=band)

    def sweep(self, forth: bool, launch: Launch, *, band: bool = False) -> None:
        """Relax all components, in reverse order if not `forth`.

        With `band`, only the unknowns outside of the rows' cores, at surfaces and walls.
        """
        for axis in range(self.dimension) if forth else reversed(range(self.dimension)):
            rows, (y, z) = self.rows(axis), self.of_others(axis, self.x)
            for left, color in (1, 0), (0, 1):
                order = int(not forth) ^ self.odd_cell
                window = self.around(1 + left)
                for only in (order, 1 ^ order) if self.grid.device.is_cuda else (-1,):
                    window.run(
                        self.passes.sweep,
                        rows,
                        whole=only < 0,
                        launch=launch,
                        x=self.x[axis],
                        y=y,
                        z=z,
                        b=self.b[axis],
                        scratch=self.r[axis],
                        color=color ^ self.odd_row ^ int(not forth),
                        order=order,
                        only=only,
                        band=int(band),
                    )
            self.share([self.x[axis]], launch)

    def residual(self, launch: Launch) -> None:
        """Compute r = b - A x."""
        for axis in range(self.dimension):
            y, z = self.of_others(axis, self.x)
            self.around(1).run(
                self.passes.residual,
                self.rows(axis),
                launch=launch,
                x=self.x[axis],
                y=y,
                z=z,
                right=self.b[axis],
                out=self.r[axis],
            )

    def product(self, x: list[wp.array], out: list[wp.array], launch: Launch) -> None:
        """Compute A x."""
        for axis in range(self.dimension):
            y, z = self.of_others(axis, x)
            self.around(0).run(
                self.passes.product,
                self.rows(axis),
                launch=launch,
                x=x[axis],
                y=y,
                z=z,
                right=None,
                out=out[axis],
            )

    def clear(self, launch: Launch) -> None:
        """Set x to 0."""
        for field in self.x:
            self.grid.domain.run(CLEAR[wp.float32], launch=launch, field=field)

    def average(
        self, fine: ViscosityLevel, window: Window, inner: Window, *, varies: bool = False
    ) -> None:
        """Set the weights to averages of a finer level.

        The interpolation also reaches cells across an axis that a coarse cell does not contain.
        Where these are thicker by orders of magnitude, a mean without them is too small by as much,
        and so is the coarse energy of what the interpolation does to them.

        Args:
            fine: the finer level.
            window: cells of this level with contributions of the finer one.
            inner: those of them in the domain.
            varies: whether viscosities differ: weights of links include those cells.
        """
        planes, axes = self.grid.planes, range(self.dimension)

        def mean(out: wp.array, of: wp.array, faces: int, scale: float, wide: bool = False) -> None:
            window.run(
                self.passes.average,
                self.shift,
                out=out,
                fine=of,
                planes=planes,
                faces=faces,
                wide=int(wide),
                scale=scale,
            )

        mean(self.cell, fine.cell, 0, 0.25, varies)
        mean(self.mixed, fine.mixed, 0, MIXED * 0.25, varies)
        for (a, b), edge in self.edges.items():
            mean(edge, fine.edges[a, b], 1 << a | 1 << b, 0.25, varies)
        for axis in axes:
            mean(self.volume[axis], fine.volume[axis], 1 << axis, 1.0)
            mean(self.drag[axis], fine.drag[axis], 1 << axis, WALL)
            window.run(
                self.passes.close,
                self.shift,
                out=self.hold[axis],
                fine=fine.hold[axis],
                axis=axis,
                planes=planes,
            )
        self.share(self.equations)
        for axis in axes:
            window.run(
                self.passes.coarse_diagonal,
                self.rows(axis),
                h=self.hold[axis],
                there=self.there[axis],
                planes=planes,
            )
        self.share([*self.diagonal, *self.there])
        self.find_spans(inner)

    def normalize(self, coarse: ViscosityLevel, window: Window) -> None:
        """Compute the normalization of the interpolation from a coarser level."""
        window = self.around(KNOWN) if self.shared else window
        for axis in range(self.dimension):
            window.run(
                self.passes.normalize,
                self.rows(axis),
                coarse.shift,
                norm=self.norm[axis],
                coarse=coarse.there[axis],
                x=None,
                planes=self.grid.planes,
            )

    def restrict(self, coarse: ViscosityLevel, launch: Launch) -> None:
        """Restrict the residual to the coarser level's right-hand side."""
        for axis in range(self.dimension):
            coarse.around(0).run(
                self.passes.restrict,
                coarse.rows(axis),
                coarse.shift,
                launch=launch,
                out=coarse.b[axis],
                fine=self.r[axis],
                norm=self.norm[axis],
                planes=self.grid.planes,
            )

    def prolong(self, coarse: ViscosityLevel, launch: Launch) -> None:
        """Add the interpolated solution of the coarser level."""
        for axis in range(self.dimension):
            self.around(3).run(
                self.passes.prolong,
                self.rows(axis),
                coarse.shift,
                launch=launch,
                x=self.x[axis],
                norm=self.norm[axis],
                coarse=coarse.x[axis],
                diagonal=None,
                planes=self.grid.planes,
            )


@dataclass(frozen=True)
class LightLevel:
    """Level of a cycle that relaxes the bands of rows once instead of twice, see `CycleLevel`.

    Args:
        level: the level.
    """

    level: ViscosityLevel
    visits: int = 1

    def descend(
        self, coarse: LightLevel, *, projected: bool, from_zero: bool
    ) -> Iterator[CycleStage]:
        """Yield steps 1 and 2 of a cycle: sweeps, and restriction of the residual."""
        assert from_zero and not projected, "a V-cycle without bounds"
        yield from self.level.down(coarse.level, LIGHT_BANDS)

    def coarsen_bounds(self, coarse: LightLevel) -> tuple[()]:
        """Return an empty tuple, since there are no bounds."""
        return ()

    def ascend(self, coarse: LightLevel, *, projected: bool) -> Iterator[CycleStage]:
        """Yield steps 5 and 6 of a cycle: prolongation and sweeps."""
        yield from self.level.up(coarse.level, LIGHT_BANDS)


def join_cores(level: ViscosityLevel) -> None:
    """Find the cores of rows that are cut into boxes of several ranks.

    The core of a row is its longest run of cells whose equations equal those of the cells beside
    them. Each rank knows its longest run, and the lengths of the runs at both ends of its part
    (`head`, `tail`). The parts are visited in order along x: a run that ended the part before goes
    on by `head` cells, and through a whole part if it fills it.
    """
    grid, ranks, owned = level.grid, level.grid.part.row_ranks, level.grid.part.owned
    if ranks is None:
        return
    domain, device = grid.domain, grid.device
    mine = Window.of([*domain.low[:2], owned.low[2]], [*domain.high[:2], owned.high[2]], device)
    span, ends = (
        wp.zeros(n * grid.shape[0] * grid.shape[1], dtype=wp.int32, device=device) for n in (4, 2)
    )
    dx, dy, dz = three_components(level.diagonal)
    mine.run(level.passes.span, whole=True, dx=dx, dy=dy, dz=dz, span=span, ends=ends)
    begin, end, offset = owned.low[2], owned.high[2], grid.origin[0]
    row = np.column_stack([span.numpy().reshape(-1, 4)[:, 2:], ends.numpy().reshape(-1, 2)]).astype(
        np.int32
    )
    none = row[:, 0] >= row[:, 1]
    row[none] = 0
    row[:, :2] += np.int32(offset) * ~none[:, None]
    every = ranks.gather(np.vstack([row, [[begin + offset, end + offset, 0, 0]]]).astype(np.int32))
    low, length, run = (np.zeros(len(row), dtype=np.int32) for _ in range(3))
    for found, (start, stop, _, _) in zip(every[:, :-1], every[:, -1], strict=True):
        first, last, head, tail = found.T
        for begins, size in (
            (start - run, np.where(head > 0, run + head, 0)),
            (first, last - first),
        ):
            longer = size > length
            low, length = np.where(longer, begins, low), np.where(longer, size, length)
        run = np.where(tail == stop - start, run + tail, tail)
    host = level.span.numpy().reshape(-1, 4).copy()
    host[:, 2] = np.where(length > 0, low - offset, host[:, 1])
    host[:, 3] = np.where(length > 0, low + length - offset, host[:, 1])
    level.span.assign(host.ravel())
