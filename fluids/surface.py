"""Free surface: liquid cells, and the surface between cell centers."""

import typing
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.grid.cell_kernel import F32, I8, cell_kernel, launch_list, list_kernel
from warp_lcp.grid.extrapolate import complete
from warp_lcp.grid.level_set import Fill, LevelSet
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.kernels.launch_graph import copy
from warp_lcp.material.boundary import Boundary
from warp_lcp.operators.grid_poisson import AIR, FLUID

_AIR = wp.constant(wp.int8(AIR))
_FLUID = wp.constant(wp.int8(FLUID))


@list_kernel("fluids.surface")
@typing.no_type_check
def mark_particles_kernel(i, key: wp.array(dtype=wp.int32), kind: wp.array(dtype=wp.int8)):
    """Mark the cells of particles as FLUID."""
    cell = key[i]
    if kind[cell] == _AIR:
        kind[cell] = _FLUID


@cell_kernel("fluids.surface")
@typing.no_type_check
def mark_inside_kernel(k, j, first, end, phi: F32, capacity: F32, most: float, kind: I8):
    """Mark open cells below the free surface as FLUID.

    Only cells whose open share of the kernel is at most `most`.
    """
    for i in range(wp.max(first, 1), wp.min(end, kind.shape[2] - 1)):
        if (
            kind[k, j, i] == _AIR
            and k > 0
            and j > 0
            and k + 1 < kind.shape[0]
            and j + 1 < kind.shape[1]
        ):
            if phi[k, j, i] < 0.0 and capacity[k, j, i] <= most:
                kind[k, j, i] = _FLUID


# A cell whose open share is smaller may hold no particle though liquid fills it: the level set
# decides.
SLIVER = 0.35
SAMPLES = 8  # sample points along the edge of a cut cell, for its open volume


class FreeSurface(Protocol):
    """Free surface of a liquid.

    Attributes:
        phi: float32 distance to the surface at cell centers [cells], < 0 in liquid; None if the
            surface lies on the cells' faces.
        density: density of the particles at the last `mark`, relative to that at rest, float32;
            None if not computed.
    """

    phi: wp.array | None
    density: wp.array | None

    def begin(self, window: Window) -> None:
        """Begin a step in a window: clear values of the last step outside of it."""

    def mark(self, particles: Particles, window: Window, kind: wp.array) -> None:
        """Mark the kind of each cell, after `begin`.

        Args:
            particles: the liquid; `key` holds the cell of each particle.
            window: cells that the liquid can touch.
            kind: int8 of AIR, FLUID, SOLID (written).
        """

    def complete(
        self,
        window: Window,
        velocity: Sequence[wp.array],
        weights: Sequence[wp.array],
        known: Sequence[wp.array],
    ) -> None:
        """Set u* on faces of FLUID cells without particle weight.

        `known` is scratch memory.
        """

    def measure(self) -> None:
        """Compute the liquid's volume, which `volume` returns."""

    def volume(self, cells: int) -> float:
        """Return the volume of liquid at the last `mark` or `measure` [m^3; m^2 in 2-D].

        The argument is the number of FLUID cells.
        """


class WholeCellSurface:
    """Free surface on cell faces: cells that hold a particle are liquid.

    In cells that a solid cuts down to a sliver there may be no particle though the liquid fills
    them; there a level set decides.
    """

    phi = None

    def __init__(
        self,
        grid: StaggeredGrid,
        boundary: Boundary,
        *,
        particles_a_cell: int,
        fill: Fill | None = None,
    ) -> None:
        """Create a level set if cells are cut.

        `fill` adds the density of liquid without particles.
        """
        self.grid, self.boundary, self._fill = grid, boundary, fill
        self._level_set = (
            LevelSet(grid, particles_a_cell=particles_a_cell) if boundary.open else None
        )
        self.density = self._level_set.density if self._level_set is not None else None

    def begin(self, window: Window) -> None:
        """Clear values of the last step outside of the window."""
        if self._level_set is not None:
            self._level_set.leave(window)

    def mark(self, particles: Particles, window: Window, kind: wp.array) -> None:
        """Mark cells that hold a particle as FLUID."""
        copy(kind, self.boundary.base)
        launch_list(
            mark_particles_kernel,
            particles.count,
            [particles.key, kind.flatten()],
            device=self.grid.device,
            ordered=True,
        )
        if self._level_set is not None:
            self._level_set.compute(
                particles, window, self.boundary.capacity, self.boundary.base, fill=self._fill
            )
            window.launch(
                mark_inside_kernel, [self._level_set.phi, self.boundary.capacity, SLIVER, kind]
            )

    def complete(
        self,
        window: Window,
        velocity: Sequence[wp.array],
        weights: Sequence[wp.array],
        known: Sequence[wp.array],
    ) -> None:
        """Set u* on faces of sliver cells that hold no particle."""
        if self._level_set is not None:
            complete(window, velocity, weights, known, barriers=self.grid.barriers)

    def measure(self) -> None:
        """Do nothing: the volume is the number of cells."""

    def volume(self, cells: int) -> float:
        """Return the volume of the FLUID cells."""
        return cells * self.grid.cell_volume


class NoSurface:
    """No free surface: all open cells are liquid, as in a filled closed box."""

    phi = density = None

    def __init__(self, grid: StaggeredGrid, boundary: Boundary) -> None:
        """Find the open cells, and the volume of those of this process."""
        kind = boundary.base.numpy().copy()
        kind[kind == wl.AIR] = wl.FLUID
        self.grid = grid
        self._kind = wp.array(kind, dtype=wp.int8, device=grid.device)
        owned = grid.part.owned
        cells = tuple(
            slice(low - 1, high - 1) for low, high in zip(owned.low, owned.high, strict=True)
        )
        filled = (grid.interior(kind) == wl.FLUID)[cells]
        self._volume, self._ranks = (
            float(_open_shares(grid, boundary)[cells][filled].sum()) * grid.cell_volume,
            grid.part.ranks,
        )

    def begin(self, window: Window) -> None:
        """Do nothing: all cells are marked in each step."""

    def mark(self, particles: Particles, window: Window, kind: wp.array) -> None:
        """Mark all open cells as FLUID."""
        copy(kind, self._kind)

    def complete(
        self,
        window: Window,
        velocity: Sequence[wp.array],
        weights: Sequence[wp.array],
        known: Sequence[wp.array],
    ) -> None:
        """Set u* on faces between particles."""
        complete(window, velocity, weights, known, barriers=self.grid.barriers)

    def measure(self) -> None:
        """Do nothing: the volume is constant."""

    def volume(self, cells: int) -> float:
        """Return the volume outside of solids."""
        return float(self._ranks.sum(self._volume))


class GhostFluidSurface:
    """Ghost-fluid surface: zero of a level set of the particles' density.

    It lies between cell centers [Gibou et al. 2002].

    Args:
        grid: the grid.
        boundary: solids and walls.
        particles_a_cell: particles per cell of liquid at rest.
        smoothing: binomial passes over the density: less noise, less accuracy in thin sheets.
        fill: adds the density of liquid without particles.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        boundary: Boundary,
        *,
        particles_a_cell: int,
        smoothing: int,
        fill: Fill | None = None,
    ) -> None:
        self.grid, self.boundary, self._fill = grid, boundary, fill
        self.level_set = LevelSet(grid, particles_a_cell=particles_a_cell, smoothing=smoothing)
        self.phi: wp.array | None = self.level_set.phi
        self.density: wp.array | None = self.level_set.density
        self._window, self._measured = grid.everywhere, False

    def begin(self, window: Window) -> None:
        """Clear values of the last step outside of the window."""
        self._window, self._measured = window.current, False
        self.level_set.leave(window)

    def mark(self, particles: Particles, window: Window, kind: wp.array) -> None:
        """Mark cells below the surface as FLUID."""
        self.level_set.compute(
            particles, window, self.boundary.capacity, self.boundary.base, fill=self._fill
        )
        copy(kind, self.boundary.base)
        window.launch(mark_inside_kernel, [self.level_set.phi, self.boundary.capacity, 2.0, kind])

    def complete(
        self,
        window: Window,
        velocity: Sequence[wp.array],
        weights: Sequence[wp.array],
        known: Sequence[wp.array],
    ) -> None:
        """Set u* on FLUID faces between particles."""
        complete(window, velocity, weights, known, barriers=self.grid.barriers)

    def measure(self) -> None:
        """Compute the volume inside the surface."""
        self.level_set.measure(self.boundary.distance, self._window.common(self.grid.part.owned))
        self._measured = True

    def volume(self, cells: int) -> float:
        """Return the volume inside the surface."""
        if not self._measured:
            self.measure()
        return float(self.grid.part.ranks.sum(self.level_set.measured))


def _open_shares(grid: StaggeredGrid, boundary: Boundary) -> np.ndarray:
    """Return the open share of each cell, shape (nz, ny, nx).

    It is computed from the distance to solids at the cells' corners.
    """
    nx, ny, nz = grid.counts
    if boundary.distance is None:
        return np.ones((nz, ny, nx))
    axes = range(3 - grid.dimension, 3)
    distance = boundary.distance.numpy().astype(np.float64)
    distance = distance[1 : nz + (grid.dimension == 3) + 1, 1 : ny + 2, 1 : nx + 2]
    corners = np.stack([_corner(distance, corner) for corner in np.ndindex(*(2 for _ in axes))])
    shares = (corners.mean(axis=0) > 0.0).astype(np.float64)
    cut = (corners.min(axis=0) < 0.0) & (corners.max(axis=0) > 0.0)
    values = corners[:, cut].reshape(*(2 for _ in axes), -1)
    low = (np.arange(SAMPLES) + 0.5) / SAMPLES
    # Interpolate from corners to sample points, one axis after the other.
    for _ in axes:
        values = np.moveaxis(np.tensordot(np.stack([1.0 - low, low]), values, axes=(0, 0)), 0, -2)
    shares[cut] = (values > 0.0).mean(axis=tuple(range(values.ndim - 1)))
    return shares


def _corner(distance: np.ndarray, corner: tuple[int, ...]) -> np.ndarray:
    """Return the values at one corner of every cell, 0 or 1 along each axis."""
    whole = (0,) * (3 - len(corner)) + corner
    count = [n - (axis >= 3 - len(corner)) for axis, n in enumerate(distance.shape)]
    return distance[tuple(slice(low, low + n) for low, n in zip(whole, count, strict=True))]
