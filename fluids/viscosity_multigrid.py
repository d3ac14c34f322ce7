"""Multigrid preconditioner of the viscous equations: one symmetric V-cycle."""

from __future__ import annotations

import math
from functools import partial

import warp as wp

from warp_lcp.fluids.viscosity_level import KNOWN, LightLevel, ViscosityLevel
from warp_lcp.grid.grid_part import subdomain_of
from warp_lcp.grid.staggered import ActiveWindow, StaggeredGrid, Window
from warp_lcp.kernels.fields import zeros
from warp_lcp.kernels.launch_graph import CommandBuffer, Launch, launch_now, perform
from warp_lcp.multigrid.cycle import CoarsestSolver, Cycle, GatheredLevel, Launches, recorded
from warp_lcp.multigrid.halo_levels import GATHERED

LEAST = 8  # cells of the longest side of the coarsest level


class ViscosityMultigrid:
    """Multigrid preconditioner z = M r, symmetric and positive definite.

    M approximates the inverse of the viscous equations on faces. On ranks `set_up` and `apply` are
    collective: r is read, and z written, on this rank's own faces; within `KNOWN` layers of ghost
    faces z has the values of their owners.

    Args:
        grid: the finest grid.
        varies: whether viscosities differ.

    Attributes:
        r, z: flat float32 fields, one component after the other.
        levels: the levels, the finest one first.
        program: launches of one cycle.
    """

    def __init__(self, grid: StaggeredGrid, *, varies: bool = False) -> None:
        self._varies = varies
        self.grid, size, self._shared = (
            grid,
            grid.dimension * grid.size,
            grid.part.comm is not None,
        )
        self.r, self.z = (
            zeros(size, wp.float32, grid.device, small_pages=grid.sparse) for _ in range(2)
        )
        # A copy of r with ghost cells.
        self._b = zeros(size, wp.float32, grid.device) if self._shared else self.r
        self.levels = self._levels()
        self._gathered = self._whole() if self._shared else None
        # Cells whose equations are computed.
        self._boxes = [ActiveWindow(level.grid.everywhere) for level in self.levels]
        # Those of them in the domain.
        self._inner = [ActiveWindow(level.grid.domain) for level in self.levels]
        self._window: Window | None = None  # window of the last `move_to`
        self.program = self._recorded(self.cycle)

    def _recorded(self, cycle: Cycle) -> CommandBuffer:
        """Return the launches of a cycle on r."""
        begin = [Launches(partial(perform, self._take_right_side))] if self._shared else []
        return recorded(self.grid.device, [*begin, *cycle.stages()])

    def _take_right_side(self) -> None:
        wp.copy(self._b, self.r)

    def _levels(self) -> list[ViscosityLevel]:
        grid: StaggeredGrid | None = self.grid
        levels = [ViscosityLevel(self.grid, self.components(self.z), self.components(self._b))]
        while (
            not self._is_coarsest(levels[-1].grid)
            and (grid := levels[-1].grid.part.coarser(KNOWN + 1)) is not None
        ):
            levels.append(ViscosityLevel(grid, grid.faces(), grid.faces(), levels[-1].grid))
        return levels

    def _is_coarsest(self, grid: StaggeredGrid) -> bool:
        """Whether a grid is the coarsest level.

        It is solved by sweeps; on ranks it is gathered.
        """
        return max(grid.domain_counts) <= LEAST or (
            self._shared and math.prod(grid.domain_counts) <= GATHERED
        )

    def _whole(self) -> ViscosityMultigrid:
        """Return the multigrid of the last level's whole grid."""
        last = self.levels[-1].grid
        return ViscosityMultigrid(
            StaggeredGrid(last.domain_counts, last.spacing, last.dimension, last.device),
            varies=self._varies,
        )

    def light_program(self) -> CommandBuffer:
        """Return the launches of a cycle with fewer sweeps beside walls and surfaces.

        Coupled solves need about as many iterations with it as with `program`.
        """
        return self._recorded(self._light_cycle)

    @property
    def cycle(self) -> Cycle:
        """One cycle on the levels; on ranks, the last one gathered."""
        whole = None if self._gathered is None else self._gathered.cycle
        return Cycle(self.levels, self._coarsest(whole))

    @property
    def _light_cycle(self) -> Cycle:
        whole = None if self._gathered is None else self._gathered._light_cycle
        return Cycle([LightLevel(level) for level in self.levels], self._coarsest(whole))

    def _coarsest(self, whole: Cycle | None) -> CoarsestSolver:
        """Return the solver of the last level; a cycle on the `whole` grid where it is gathered."""
        last = self.levels[-1]
        if whole is None or self._gathered is None:
            return last.solve
        part, first = subdomain_of(last.grid), self._gathered.levels[0]
        gather = Launches(partial(perform, partial(part.collect, last.b, first.b)))
        copy_part = Launches(partial(perform, partial(_copy_part, last, first)))
        return GatheredLevel(
            whole=lambda projected: whole, gather=[gather], gather_bounds=[], copy_part=copy_part
        ).solve

    def components(self, field: wp.array) -> list[wp.array]:
        """Return views of a flat field, one per component."""
        n = self.grid.size
        return [
            field[axis * n : (axis + 1) * n].reshape(self.grid.shape)
            for axis in range(self.grid.dimension)
        ]

    def apply(self) -> None:
        """Compute z = M r."""
        self.program.run()

    def product(self, p: wp.array, q: wp.array, *, launch: Launch = launch_now) -> None:
        """Compute q = A p."""
        self.levels[0].product(self.components(p), self.components(q), launch)

    def move_to(self, window: Window) -> None:
        """Restrict `set_up` to the cells of a window in the domain.

        Equations elsewhere are not changed.
        """
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
        """Compute the coarse levels from the finest one, in the cells of `move_to`.

        On ranks, in all cells.
        """
        fine = self.levels[0]
        fine.share(fine.equations)
        fine.find_spans(self._inner[0])
        for number, coarse in enumerate(self.levels[1:], start=1):
            boxes = self._boxes[number], self._inner[number]
            coarse.average(fine, *boxes, varies=self._varies)
            fine.normalize(coarse, self._inner[number - 1])
            fine = coarse
        if self._gathered is not None:
            first = self._gathered.levels[0]
            part = subdomain_of(fine.grid)
            part.collect(fine.equations, first.equations)
            self._gathered.move_to(first.grid.everywhere)
            self._gathered.set_up()


def _copy_part(level: ViscosityLevel, whole: ViscosityLevel) -> None:
    """Copy this rank's part of the whole grid's solution, with ghost cells."""
    part = subdomain_of(level.grid)
    for x, of_whole in zip(level.x, whole.x, strict=True):
        part.copy_part(of_whole, x)
