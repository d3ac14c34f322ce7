"""Levels of the viscous equations on faces: sweeps, transfers, and what ranks exchange between them.

Coarse levels have equations of the same form with the means of what the finer one weighs; unknowns
are carried linearly, beside air by those there are. A coarse level is a sum of squares, too: an
unknown is drawn to faces in walls by no less than its links to them weigh. Gauss-Seidel takes one
component after the other, two colors of rows each, and back.

On ranks each face belongs to the one whose box has the cell above it. A sweep takes the faces of
one process in its order: ghost cells in so many layers as the second color needs are computed
twice; then the component's ghost cells come from their ranks. So the cycle is that of one process,
on any number of ranks; where rows are not cut it has its bits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.fluids.viscosity_passes import viscous_passes
from warp_lcp.grid.staggered import CLEAR, StaggeredGrid, Window, three_components
from warp_lcp.multigrid.cycle import CycleStage, Launches
from warp_lcp.rows.program import Launch, perform

# layers of ghost cells that sweeps need: rows of the second color look at those of the first, where
# odd cells look at even ones
KNOWN = 3
SWEEPS = 4  # of the coarsest level, each forth and back
# of the finer level's: twice that is at most `cell`, so that cells' squares outweigh their products
# in 3-D, too
MIXED = 0.5
# of the finer level's drag by walls, in units of its own links: half of what is near one lies in
# its row
WALL = 0.5


@dataclass(frozen=True, slots=True)
class ViscousRows:
    """Equations of the faces of one component, float32 fields but for `span` and `axis`.

    Attributes:
        axis: of the component.
        cell: weights of links along the axis.
        mixed: of those, what is left out of the products of different components where walls are.
        xb: weights of links across, towards the first of the other axes.
        xc: likewise towards the second; None in 2-D.
        volume: what weighs on the faces.
        drag: what walls add to the diagonal.
        diagonal: the sum, 0 where there is no unknown.
        span: where each row's unknowns begin and end, and its core, int32.
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
    """Cells from cell 2n - 1 to the first cell of the finer level that is in cell n of a coarse one: not 0 in parts of grids."""

    shift_x: int = 0
    shift_y: int = 0
    shift_z: int = 0


class ViscosityLevel:
    """Viscous equations on a grid, see `CycleLevel`; on a rank, on its part of the grid.

    Args:
        grid: the level's.
        x: its solution.
        b: its right-hand side.
        finer: grid of the finer level; None: this one is the finest.

    Attributes:
        cell: weights of links along a component's own axis.
        mixed: of those, what is left out of the products of different components where walls are,
            see `fluids.viscosity`.
        edges: weights of links across, by pairs of axes.
        volume, drag, diagonal, hold, norm, there: of the faces of each component: what weighs, what
            walls add, the sum; whether a wall holds it; the interpolation's normalization; and what
            that is to find.
        r: the residual, and what a sweep keeps.
        span: where a row's unknowns begin and end, and its core, a run of cells with the equations
            of those around them.
        shift: from the finer level's cells to this one's.
        odd_row, odd_cell: whether row and cell 0 have the colors of row and cell 1 of the whole
            grid.
    """

    visits = 1  # V-cycles

    def __init__(
        self,
        grid: StaggeredGrid,
        x: list[wp.array],
        b: list[wp.array],
        finer: StaggeredGrid | None = None,
    ) -> None:
        shared = grid.part.across is not None
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
        """Return the two other axes; None: there is none."""
        return [*(a for a in range(self.dimension) if a != axis), None][:2]

    def of_others(self, axis: int, fields: Sequence[Any]) -> list[Any]:
        """Return what other components have of fields, a field a component."""
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
        """The fields that say what the equations are."""
        fields = (self.edges.values(), self.volume, self.drag, self.hold, self.diagonal)
        return [self.cell, self.mixed, *(field for each in fields for field in each)]

    def around(self, width: int) -> Window:
        """Return the cells in which something is to be found: those of this part of a grid and so many around it."""
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
        """Fill ghost cells from other ranks: all of them, of equations; while a cycle is launched or recorded, `KNOWN` layers."""
        if self.shared and launch is not None:
            memory = fields if self.grid.device.is_cuda else [field.numpy() for field in fields]
            perform(partial(self.grid.part.fill, *memory, width=KNOWN), launch)
        elif self.shared:
            self.grid.part.fill(*fields)

    def halved(self, window: Window) -> Window:
        """Return the cells of this level that take something from a window of the finer one; on ranks all that this one is to know."""
        if self.shared:
            return self.grid.part.stored
        low = [n // 2 for n in window.low]
        high = [min(n // 2 + 2, size) for n, size in zip(window.high, self.grid.shape, strict=True)]
        if self.dimension == 2:
            low[0], high[0] = 1, 2
        return Window.of(low, high, self.grid.device)

    def find_spans(self, window: Window) -> None:
        """Find where the rows' unknowns lie."""
        dx, dy, dz = three_components(self.diagonal)
        window = self.grid.domain if self.shared else window
        window.run(self.passes.span, whole=True, dx=dx, dy=dy, dz=dz, span=self.span, ends=None)
        if self.shared:
            join_cores(self)

    def descend(
        self, coarse: ViscosityLevel, *, projected: bool, from_zero: bool
    ) -> Iterator[CycleStage]:
        """Yield steps 1 and 2 of a cycle: sweeps, and the residual on the next level."""
        assert from_zero and not projected, "a V-cycle without bounds"
        yield from self._beginning()
        for step in (partial(self.smooth, True), self.residual, partial(self.restrict, coarse)):
            yield Launches(step)

    def coarsen_bounds(self, coarse: ViscosityLevel) -> tuple[()]:
        """Return nothing: there are no bounds."""
        return ()

    def ascend(self, coarse: ViscosityLevel, *, projected: bool) -> Iterator[CycleStage]:
        """Yield steps 5 and 6."""
        for step in (partial(self.prolong, coarse), partial(self.smooth, False)):
            yield Launches(step)

    def solve(self, visits: int, *, projected: bool, from_zero: bool) -> Iterator[CycleStage]:
        """Yield the stages of a `CoarsestSolver`: sweeps forth, as many back."""
        yield from self._beginning()
        for forth in (True,) * SWEEPS + (False,) * SWEEPS:
            yield Launches(partial(self.sweep, forth))

    def _beginning(self) -> Iterator[CycleStage]:
        """Yield ghost cells of b, and x = 0."""
        yield Launches(partial(self.share, self.b))
        yield Launches(self.clear)

    def smooth(self, forth: bool, launch: Launch) -> None:
        """Relax all, and what lies before and behind the rows' cores, where errors last, before and after."""
        for band in (True, False, True):
            self.sweep(forth, launch, band=band)

    def sweep(self, forth: bool, launch: Launch, *, band: bool = False) -> None:
        """Relax all components, the last one first if not forth; in a band at surfaces and walls alone if asked."""
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
        """Find r = b - A x."""
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
        """Find A x."""
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

    def average(self, fine: ViscosityLevel, window: Window, inner: Window) -> None:
        """Take the means of a finer level.

        Args:
            fine: the finer level.
            window: cells of this one that take something of it.
            inner: those of the domain among them.
        """
        planes, axes = self.grid.planes, range(self.dimension)

        def mean(out: wp.array, of: wp.array, faces: int, scale: float) -> None:
            window.run(
                self.passes.average,
                self.shift,
                out=out,
                fine=of,
                planes=planes,
                faces=faces,
                scale=scale,
            )

        mean(self.cell, fine.cell, 0, 0.25)
        mean(self.mixed, fine.mixed, 0, MIXED * 0.25)
        for (a, b), edge in self.edges.items():
            mean(edge, fine.edges[a, b], 1 << a | 1 << b, 0.25)
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
        """Find the normalization of the interpolation from a coarser level, where it is made."""
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
        """Make the residual the coarser level's right-hand side."""
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
        """Add the coarser level's solution."""
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


def join_cores(level: ViscosityLevel) -> None:
    """Find the cores of rows that are cut: they may reach over the boxes of several ranks."""
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
