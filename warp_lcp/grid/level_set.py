"""Level set of the liquid's surface from the density of its particles."""

from __future__ import annotations

import math
from collections.abc import Callable

import warp as wp

from warp_lcp.grid import level_set_kernels as kernels
from warp_lcp.grid.extrapolate import extrapolate
from warp_lcp.grid.particle_loops import scatter, touched_planes
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import COPY, ActiveWindow, StaggeredGrid, Window
from warp_lcp.grid.window_reduction import WindowReduction
from warp_lcp.kernels.launch_graph import LaunchGraph, clear

REACH = 1.5  # half the width of a cell's kernel [cells]
QUANTILE = 3.7191  # quantile of the normal distribution at 1 - level_set_kernels.TAIL
Fill = Callable[[Window, wp.array], None]
PARTS = {2: 4, 3: 2}  # sample points per axis of a cell on the surface


class LevelSet:
    """Level set: signed distance of cell centers to the liquid's surface.

    The density is the sum of the particles' quadratic B-splines at the cell's center, in units of
    the density at rest. Divided by the capacity, the open share of the cell's kernel beside solids,
    it is the filled share of the kernel, and phi is the distance at which a half space fills that
    share. For a plane along an axis this is unbiased, without a radius to tune, also at a wall
    perpendicular to the plane. A plane across the axes is off by up to 0.01 cells. A film on a wall
    within the kernel's reach looks too thin: phi is 0 with the liquid still 0.11 cells above the
    center of a cell that the wall bounds, 0.36 above a center that lies on the wall.

    Binomial passes (1, 2, 1)/4 over density and capacity make the kernel wider and closer to the
    normal distribution of variance 1/4 + passes/2; phi is then its quantile. They remove noise from
    a surface at rest, and erase thin fronts.

    Args:
        grid: the grid.
        particles_a_cell: particles in a full cell at rest.
        smoothing: binomial passes, >= 0.

    Attributes:
        phi: [cells], float32, < 0 in the liquid, within +-`limit`; SOLID cells within two of an
            open one have the mean of their neighbors, others and all cells outside the window are
            air.
        density: density in units of the density at rest, float32, in open cells and in SOLID ones
            next to them.
        limit: the largest |phi| [cells].

    Raises:
        ValueError: an argument is out of range.
    """

    def __init__(self, grid: StaggeredGrid, *, particles_a_cell: int, smoothing: int = 0) -> None:
        if particles_a_cell < 1:
            raise ValueError(f"particles_a_cell = {particles_a_cell}: must be at least 1")
        if smoothing < 0:
            raise ValueError(f"smoothing = {smoothing}: must be a number of passes, 0 or more")
        self.grid, self.particles_a_cell, self.smoothing = grid, particles_a_cell, smoothing
        self._spread = math.sqrt(0.25 + 0.5 * smoothing) if smoothing else 0.0
        self.limit = QUANTILE * self._spread if smoothing else REACH
        self.phi, self.density, self._known = grid.field(), grid.field(), grid.field(wp.int8)
        self.phi.fill_(self.limit)
        self._scratch = [grid.field() for _ in range(3)] if smoothing else []
        self._volume: WindowReduction | None = None  # made when it is first asked for
        self._box, self._measuring = (
            ActiveWindow(grid.domain),
            LaunchGraph(grid.device, self._launch_volume),
        )
        self._left, self._leaving = (
            ActiveWindow(grid.domain),
            LaunchGraph(grid.device, self._launch_leaving),
        )
        self._beside: wp.array | None = None  # filled shares of cells beside thin solids
        self._measured = False
        self._filled: Window | None = None

    def update(
        self,
        particles: Particles,
        window: Window,
        capacity: wp.array | None,
        base: wp.array,
        *,
        fill: Fill | None = None,
    ) -> None:
        """Compute the level set of the particles.

        Args:
            particles: the liquid. If it is indexed it must not have moved since it was sorted: each
                cell then gathers from the particles around it, the same bits on every run of a GPU.
                Otherwise they scatter.
            window: cells that hold all particles, with 2 + 2 `smoothing` to spare on each side.
                Values that a pass reads from beyond the window are then out of reach of the
                density.
            capacity: open share of each cell's kernel, float32; None for 1.
            base: int8, SOLID in cells that hold no liquid.
            fill: adds the density of liquid without particles in a window.
        """
        self.leave(window)
        self.compute(particles, window, capacity, base, fill=fill)

    def leave(self, window: Window) -> None:
        """Clear what the last update has written to another window."""
        before, self._filled = self._filled, window.current
        if before is not None and (before.low, before.high) != (window.low, window.high):
            self._left.move_to(before)
            self._leaving.run(variant=before.near is None)

    def _launch_leaving(self) -> None:
        self._left.launch(kernels.clear_kernel, [self.limit, self.phi, self._known])

    def compute(
        self,
        particles: Particles,
        window: Window,
        capacity: wp.array | None,
        base: wp.array,
        *,
        fill: Fill | None = None,
    ) -> None:
        """Launch the computation of `update` after `leave`."""
        grid = self.grid
        particle_density(grid, particles, window, self.particles_a_cell, self.density)
        if fill is not None:
            fill(window, self.density)
        density, smooth = self.density, None
        if self.smoothing:
            # A pass reads one cell beyond the window, where an earlier update may have written
            # values.
            clear(*self._scratch[:2])
            density = self._smoothed(window, self.density, self._scratch[0], self._scratch[1])
            if capacity is not None:
                free = self._scratch[1] if density is self._scratch[0] else self._scratch[0]
                smooth = self._smoothed(window, capacity, free, self._scratch[2])
        window.run(
            kernels.DISTANCE,
            density=density,
            capacity=capacity,
            smooth=smooth,
            base=base,
            phi=self.phi,
            known=self._known,
            spread=self._spread,
            limit=self.limit,
        )
        if smooth is not None:
            shifted = next(field for field in self._scratch if field is not smooth)
            window.launch(
                kernels.wall_shift_kernel,
                [self._spread**2, self.limit, smooth, self.phi, self._known, shifted],
            )
            if grid.barriers is not None:
                given = (self._spread**2, self.limit, smooth, self.phi, self._known, shifted)
                grid.barriers.shift(window, *given)
            window.run(COPY, source=shifted, field=self.phi)
        apart = grid.barriers.apart[-1] if grid.barriers is not None else None
        extrapolate(window, self._known, self.phi, kernels.EXTENDED, apart=apart)

    def volume(self, distance: wp.array | None, window: Window) -> float:
        """Return the volume of phi < 0 outside the solids [m^3; m^2 in 2-D].

        phi is multilinear between the cells' centers, and linear about them beside thin solids.

        Args:
            distance: signed distance to the solids at the cells' low corners [cells], > 0 in the
                open, float32; None: solids are the cells that were SOLID in the last update.
            window: window of the last update.
        """
        self.measure(distance, window)
        return self.measured

    def measure(self, distance: wp.array | None, window: Window | None) -> None:
        """Launch the computation of `volume` without waiting.

        None: of no cells.
        """
        box = window.common(self.grid.domain) if window is not None else None
        self._measured = box is not None
        if box is None:
            return
        if self._volume is None:
            self._volume = WindowReduction(kernels.VOLUME, self.grid)
            self._beside = self.grid.field() if self.grid.barriers is not None else None
        self._box.move_to(box)
        self._measuring.run(distance, variant=box.near is None)
        self._volume.changed()

    def _launch_volume(self, distance: wp.array | None) -> None:
        grid = self.grid
        assert self._volume is not None
        if grid.barriers is not None:
            grid.barriers.fill(self._box, self.phi, self._known, distance, self._beside)
        self._volume.launch(
            self._box,
            phi=self.phi,
            known=self._known,
            distance=distance,
            beside=self._beside,
            planes=grid.planes,
            parts=PARTS[grid.dimension],
        )

    @property
    def measured(self) -> float:
        """Measured volume [m^3; m^2 in 2-D]."""
        return (
            self._volume.read()[0] * self.grid.cell_volume
            if self._volume is not None and self._measured
            else 0.0
        )

    def _smoothed(
        self, window: Window, source: wp.array, first: wp.array, second: wp.array
    ) -> wp.array:
        """Return the source after the binomial passes; in one of two scratch fields."""
        for _ in range(self.smoothing):
            window.run(kernels.BINOMIAL, planes=self.grid.planes, source=source, out=first)
            if self.grid.barriers is not None:
                self.grid.barriers.smooth(window, source, first)
            source, first, second = first, second, first
        return source


def particle_density(
    grid: StaggeredGrid,
    particles: Particles,
    window: Window,
    particles_a_cell: int,
    density: wp.array,
) -> None:
    """Compute the density of particles at cell centers, relative to rest.

    By quadratic B-splines.

    Args:
        grid: the grid.
        particles: the liquid. If it is indexed it must not have moved since it was sorted.
        window: cells that hold all particles, with 2 to spare on each side.
        particles_a_cell: particles in a full cell at rest.
        density: float32 (written, 0 away from particles).
    """
    position, each = particles.position, 1.0 / particles_a_cell
    clear(density)
    if particles.offsets is not None:
        window.run(
            kernels.GATHER,
            grid.placement,
            grouped=True,
            position=position,
            offsets=particles.offsets,
            density=density,
            each=each,
        )
        if grid.barriers is not None:
            grid.barriers.density(window, particles.offsets, position, density, each)
    else:
        touched = touched_planes(grid, position)
        scatter(
            kernels.SCATTER,
            grid,
            position,
            touched,
            runs=particles.runs,
            density=density,
            each=each,
        )


def whole_cell_capacity(grid: StaggeredGrid, base: wp.array, capacity: wp.array) -> None:
    """Compute the open fraction of each cell's kernel for whole-cell solids.

    Exact: 1/6, 2/3, 1/6 of the kernel along each axis.

    Args:
        grid: the grid.
        base: int8, SOLID or not.
        capacity: float32 (written).
    """
    grid.everywhere.launch(kernels.whole_cell_capacity_kernel, [grid.planes, base, capacity])
