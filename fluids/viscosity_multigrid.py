"""Multigrid for the viscous equations: one symmetric cycle, the preconditioner of conjugate gradients.

Coarse levels have equations of the same form with the means of what the finer one weighs; unknowns are carried linearly, beside air by
those there are. A coarse level is a sum of squares, too: an unknown is drawn to faces in walls by no less than its links to them weigh.
Gauss-Seidel takes one component after the other, two colors of rows each, and back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import warp as wp

from warp_lcp.fluids.viscosity_passes import viscous_passes
from warp_lcp.grid.staggered import CLEAR, ActiveWindow, StaggeredGrid, Window, three_components
from warp_lcp.rows.fields import zeros
from warp_lcp.rows.program import Launch, Program, launch_now

LEAST = 8  # cells of the longest side at which there is no coarser level
SWEEPS = 4  # of the coarsest level, each forth and back
MIXED = 0.5  # of the finer level's: twice that is at most `cell`, so that cells' squares outweigh their products in 3-D, too
WALL = 0.5  # of the finer level's drag by walls, in units of its own links: half of what is near one lies in its row


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


class VectorLevel:
    """Fields and passes of a grid.

    Args:
        grid: the level's.
        x: its solution.
        b: its right-hand side.

    Attributes:
        cell: weights of links along a component's own axis.
        mixed: of those, what is left out of the products of different components where walls are, see `fluids.viscosity`.
        edges: weights of links across, by pairs of axes.
        volume, drag, diagonal, hold, norm, there: of the faces of each component: what weighs, what walls add, the sum; whether a wall
            holds it; the interpolation's normalization; and what that is to find.
        r: the residual, and what a sweep keeps.
        span: where a row's unknowns begin and end, and its core, a run of cells with the equations of those around them.
        shift: from the finer level's cells to this one's.
    """

    shift = LevelShift()
    odd_row, odd_cell = 0, 0  # whether row and cell 0 have the colors of row and cell 1 of the whole grid

    def __init__(self, grid: StaggeredGrid, x: list[wp.array], b: list[wp.array]) -> None:
        self.grid, self.dimension, self.passes = grid, grid.dimension, viscous_passes(grid.dimension)
        self.cell, self.mixed = grid.field(), grid.field()
        self.edges = {pair: grid.field() for pair in [(0, 1), (0, 2), (1, 2)][: 1 if grid.dimension == 2 else 3]}
        self.volume, self.drag, self.diagonal, self.hold, self.norm, self.r, self.there = (grid.faces() for _ in range(7))
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
        xb, xc = (None if other is None else self.edges[min(axis, other), max(axis, other)] for other in self.others(axis))
        on_faces = (self.volume[axis], self.drag[axis], self.diagonal[axis])
        return ViscousRows(axis, self.cell, self.mixed, xb, xc, *on_faces, self.span)

    @property
    def equations(self) -> list[wp.array]:
        """The fields that say what the equations are."""
        fields = (self.edges.values(), self.volume, self.drag, self.hold, self.diagonal)
        return [self.cell, self.mixed, *(field for each in fields for field in each)]

    def around(self, width: int) -> Window:
        """Return the cells in which something is to be found: those of this part of a grid and so many around it."""
        return self.grid.domain

    def share(self, fields: Sequence[wp.array], launch: Launch | None = None) -> None:
        """Take what other parts of a grid know of fields, if there are any: of equations, or between the launches of a sweep."""

    def halved(self, window: Window) -> Window:
        """Return the cells of this level that take something from a window of the finer one."""
        low = [n // 2 for n in window.low]
        high = [min(n // 2 + 2, size) for n, size in zip(window.high, self.grid.shape, strict=True)]
        if self.dimension == 2:
            low[0], high[0] = 1, 2
        return Window.of(low, high, self.grid.device)

    def find_spans(self, window: Window) -> None:
        """Find where the rows' unknowns lie."""
        dx, dy, dz = three_components(self.diagonal)
        window.run(self.passes.span, whole=True, dx=dx, dy=dy, dz=dz, span=self.span, ends=None)

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
                self.passes.residual, self.rows(axis), launch=launch, x=self.x[axis], y=y, z=z, right=self.b[axis], out=self.r[axis]
            )

    def product(self, x: list[wp.array], out: list[wp.array], launch: Launch) -> None:
        """Find A x."""
        for axis in range(self.dimension):
            y, z = self.of_others(axis, x)
            self.around(0).run(self.passes.product, self.rows(axis), launch=launch, x=x[axis], y=y, z=z, right=None, out=out[axis])

    def clear(self, launch: Launch) -> None:
        """Set x to 0."""
        for field in self.x:
            self.grid.domain.run(CLEAR[wp.float32], launch=launch, field=field)

    def average(self, fine: VectorLevel, window: Window, inner: Window) -> None:
        """Take the means of a finer level.

        Args:
            fine: the finer level.
            window: cells of this one that take something of it.
            inner: those of the domain among them.
        """
        planes, axes = self.grid.planes, range(self.dimension)

        def mean(out: wp.array, of: wp.array, faces: int, scale: float) -> None:
            window.run(self.passes.average, self.shift, out=out, fine=of, planes=planes, faces=faces, scale=scale)

        mean(self.cell, fine.cell, 0, 0.25)
        mean(self.mixed, fine.mixed, 0, MIXED * 0.25)
        for (a, b), edge in self.edges.items():
            mean(edge, fine.edges[a, b], 1 << a | 1 << b, 0.25)
        for axis in axes:
            mean(self.volume[axis], fine.volume[axis], 1 << axis, 1.0)
            mean(self.drag[axis], fine.drag[axis], 1 << axis, WALL)
            window.run(self.passes.close, self.shift, out=self.hold[axis], fine=fine.hold[axis], axis=axis, planes=planes)
        self.share(self.equations)
        for axis in axes:
            window.run(self.passes.coarse_diagonal, self.rows(axis), h=self.hold[axis], there=self.there[axis], planes=planes)
        self.share([*self.diagonal, *self.there])
        self.find_spans(inner)

    def normalize(self, coarse: VectorLevel, window: Window) -> None:
        """Find the normalization of the interpolation from a coarser level."""
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

    def restrict(self, coarse: VectorLevel, launch: Launch) -> None:
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

    def prolong(self, coarse: VectorLevel, launch: Launch) -> None:
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


class VectorMultigrid:
    """Approximate the inverse of the viscous equations on faces: z = M r, symmetric and positive definite.

    Args:
        grid: the finest grid.

    Attributes:
        r, z: flat float32 fields, one component after the other.
        levels: from the finest on.
        program: one cycle.
    """

    def __init__(self, grid: StaggeredGrid) -> None:
        self.grid, size = grid, grid.dimension * grid.size
        self.r, self.z = (zeros(size, wp.float32, grid.device, small_pages=grid.sparse) for _ in range(2))
        self.levels: Sequence[VectorLevel] = self._levels()
        self._boxes = [ActiveWindow(level.grid.everywhere) for level in self.levels]  # of the cells whose equations are made
        self._inner = [ActiveWindow(level.grid.domain) for level in self.levels]  # those of the domain among them
        self._window: Window | None = None  # of the last `move_to`
        self.program = Program(grid.device)
        self._cycle(0, self.program.launch)

    def _levels(self) -> Sequence[VectorLevel]:
        grid = self.grid
        levels = [VectorLevel(grid, self.components(self.z), self.components(self.r))]
        while max(grid.counts) > LEAST:
            nx, ny, nz = (-(-n // 2) for n in grid.counts)
            grid = StaggeredGrid((nx, ny, nz), 2.0 * grid.spacing, grid.dimension, grid.device)
            levels.append(VectorLevel(grid, grid.faces(), grid.faces()))
        return levels

    def components(self, field: wp.array) -> list[wp.array]:
        """Return a flat field as one field a component."""
        n = self.grid.size
        return [field[axis * n : (axis + 1) * n].reshape(self.grid.shape) for axis in range(self.grid.dimension)]

    def apply(self) -> None:
        """Write z = M r."""
        self.program.run()

    def product(self, p: wp.array, q: wp.array, *, launch: Launch = launch_now) -> None:
        """Write q = A p."""
        self.levels[0].product(self.components(p), self.components(q), launch)

    def move_to(self, window: Window) -> None:
        """Have `set_up` make the equations of a window, which has cells of the domain: elsewhere they are what they were."""
        if window == self._window:
            return
        self._window = window
        for number, level in enumerate(self.levels):
            window = level.halved(window) if number else window
            inner = window.common(level.grid.domain)
            assert inner is not None, "a window of cells of the domain"
            self._boxes[number].move_to(window)
            self._inner[number].move_to(inner)

    def set_up(self) -> None:
        """Make the coarse levels from the finest, in the cells of `move_to`."""
        fine = self.levels[0]
        fine.share(fine.equations)
        fine.find_spans(self._inner[0])
        for number, coarse in enumerate(self.levels[1:], start=1):
            coarse.average(fine, self._boxes[number], self._inner[number])
            fine.normalize(coarse, self._inner[number - 1])
            fine = coarse

    def _cycle(self, number: int, launch: Launch) -> None:
        level = self.levels[number]
        level.clear(launch)
        if number == len(self.levels) - 1:
            for forth in (True,) * SWEEPS + (False,) * SWEEPS:
                level.sweep(forth, launch)
            return
        level.smooth(True, launch)
        level.residual(launch)
        level.restrict(self.levels[number + 1], launch)
        self._cycle(number + 1, launch)
        level.prolong(self.levels[number + 1], launch)
        level.smooth(False, launch)


def make_multigrid(grid: StaggeredGrid) -> VectorMultigrid:
    """Return the multigrid of a grid, across ranks if several work on it."""
    part: Any = grid.part
    if part.across is None:
        return VectorMultigrid(grid)
    from warp_lcp.fluids.distributed.viscosity_multigrid import SharedVectorMultigrid

    return SharedVectorMultigrid(part)
