"""Surface tension and contact angles: pressure jump of a ghost-fluid surface."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_lcp.fluids import surface_tension_kernels as kernels
from warp_lcp.fluids.pressure import LiquidBoundary
from warp_lcp.fluids.surface_tension_barriers import curvature_kernel, jump_kernel
from warp_lcp.grid.cell_kernel import launch_list
from warp_lcp.grid.level_set import REACH as REACH_OF_PHI
from warp_lcp.grid.level_set_kernels import BINOMIAL
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import ActiveWindow, StaggeredGrid, Window, three_components
from warp_lcp.grid.window_reduction import WindowReduction
from warp_lcp.kernels.launch_graph import LaunchGraph, clear
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.material.boundary import Boundary
from warp_lcp.operators.grid_poisson import SOLID

# Binomial passes of the filter: the minimum follows from the noise of the particles, the maximum
# from the cost and from thin liquid.
PASSES, MOST_PASSES = 8, 16
# Damping rate of velocity gradients near the surface, relative to the grid's capillary rate.
CALM = 0.2
# The largest z^3 (2 exp(-z^2/2) - exp(-z^2)): of a filtered capillary wave, omega^2 s^3 rho dx^3 /
# sigma.
STIFFEST = 2.08
# Most steps of a quarter cell from the mirror image of a wall's cell to a point with open cells
# around it.
FARTHER = 9
# Width of the smoothed region around particles [cells]: two standard deviations of the widest
# filter, less the margin of `window`.
REACH = 6
SAFETY = 3.0  # safety factor on the square of the longest step: particles add noise


@dataclass(frozen=True, slots=True)
class SurfaceShares:
    """Smoothed liquid fractions of cells, and series of the distance to the surface.

    The distance [cells] is linear w + cubic w^3, with w = 1/2 - (2 once - twice).

    Attributes:
        once: fractions after the passes of the step, float32.
        twice: fractions after twice as many passes.
        linear: first coefficient of the distance.
        cubic: third coefficient of the distance.
    """

    once: wp.array
    twice: wp.array
    linear: float
    cubic: float


class SurfaceTension:
    """Apply the capillary pressure p = sigma kappa to the liquid at its surface.

    The jump of a ghost-fluid surface [Gibou et al. 2002] between a FLUID cell i and an AIR cell n
    at theta, with X = kick_dt sigma kappa / (rho dx) there, changes u = u* - (x_right - x_left) /
    theta by X / theta. It is added to u* before the projection, so that the pressure problem is
    unchanged: x is the liquid's whole pressure above that of the air, and 0 <= x on separating
    walls keeps its meaning.

    The curvature kappa = div n, n = -grad f / |grad f|, is that of f = (2 S - S^2) f0. Here f0 is
    the share of a cell's kernel below the surface, and S is m binomial passes (1, 2, 1)/4 along
    each axis, nearly a Gaussian of variance s^2 = m/2. Of a ripple of wavenumber q on a plane f
    keeps 2 e^-a - e^-2a, a = (q s)^2 / 2, so that capillary waves are slower by (q s)^4 / 8. Each
    step has m >= `PASSES`. Explicit leapfrog steps are stable while omega dt < 2, and no ripple
    then has omega^2 > STIFFEST sigma / (rho (s dx)^3). Longer steps use more passes: waves that a
    step cannot resolve are filtered out instead of limiting the step.

    In cells of walls, f is extended so that the surface meets the wall at the contact angle. Along
    the wall's normal the distance to the surface falls by the cosine of the angle, and by (1 -
    kappa d) times the cosine on the wall at a distance d from the surface, where parallel surfaces
    meet the wall. With the cosine alone the curvature beside the wall would be 0.6 of the right
    value at an angle of 30 degrees, on any grid. So kappa is computed twice in a step, first
    without this term. Beside walls particles represent only the open part of a cell's kernel, see
    `whole_share`.

    The contact angle at thin solids is 90 degrees, see `warp_lcp.grid.barriers`.

    Args:
        grid: the grid.
        boundary: solids and walls.
        phi: distance to the surface [cells], < 0 in liquid, from a `GhostFluidSurface`.
        coefficient: sigma [N/m].
        contact_angle: angle in the liquid [degrees].
        density: density of the liquid [kg/m^3].

    Attributes:
        jump: kick_dt sigma kappa / (rho dx) [m/s] in cells beside the surface, float32.
        adhesion: sigma cos(angle) kappa / (rho dx) [m/s^2] of the most curved surface, the suction
            with which liquid that wets a wall adheres to it.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        boundary: Boundary,
        phi: wp.array,
        *,
        coefficient: float,
        contact_angle: float,
        density: float,
    ) -> None:
        self.grid, self.boundary, self._phi = grid, boundary, phi
        self.coefficient, self.density = coefficient, density
        self._cosine = math.cos(math.radians(contact_angle)) if contact_angle != 90.0 else 0.0
        self._most = float(grid.dimension - 1)  # largest curvature: a radius of one cell [1/dx]
        self.adhesion = (
            max(self._cosine, 0.0) * self._most * coefficient / (density * grid.spacing**2)
        )
        self.jump, self._fields = grid.field(), [grid.field() for _ in range(3)]
        self._passes = kernels.push_pass(bool(boundary.open))
        self._energy = WindowReduction(self._passes.energy, grid)
        self._blocked = grid.field(wp.int8)
        self._capacity, self._lean = boundary.capacity, grid.field()
        # kick_dt sigma / (rho dx^2), and the factor on velocity gradients.
        self._scale, self._factor = Scalar(), Scalar()
        # Cells of the last energy measurement; None without liquid.
        self._measured: ActiveWindow | None = None
        self._cells = ActiveWindow(grid.domain)
        shared = grid.part.shared  # then ranks exchange halos, and their particles change
        # Moving solids change the lists of wall cells.
        self._pushing = LaunchGraph(grid.device, self._push, at_once=shared or boundary.moves)
        self._calming = LaunchGraph(grid.device, self._launch_velocity_damping, at_once=shared)
        self._measuring = LaunchGraph(
            grid.device,
            lambda kind: self._energy.launch(self._cells, self._faces(kind), self._shares),
        )
        self._find_walls()

    def longest_step(self) -> float:
        """Return the longest step [s] that is stable with the largest number of passes."""
        return self._step_of(MOST_PASSES)

    def _step_of(self, passes: int) -> float:
        spread = math.sqrt(0.5 * passes) * self.grid.spacing
        return math.sqrt(4.0 * self.density * spread**3 / (SAFETY * STIFFEST * self.coefficient))

    def _passes_for(self, kick_dt: float) -> int:
        """Return the number of filter passes of a step."""
        return next(
            (m for m in range(PASSES, MOST_PASSES) if self._step_of(m) >= kick_dt), MOST_PASSES
        )

    def act(
        self, velocity: Sequence[wp.array], window: Window, kind: wp.array, kick_dt: float
    ) -> None:
        """Apply the pressure jump to the faces that the surface crosses.

        Args:
            velocity: u* of each component [m/s] (updated).
            window: cells that hold all FLUID cells, with a margin on each side.
            kind: int8 of AIR, FLUID, SOLID, as `phi` marks them.
            kick_dt: time that forces act [s].
        """
        if self.boundary.moves:
            self._find_walls()
        self._passes_done = passes = self._passes_for(kick_dt)
        self._once, self._twice, self._bend = self._roles(passes)
        self._shares = SurfaceShares(self._once, self._twice, *_profile(passes))
        self._scale.value = kick_dt * self.coefficient / (self.density * self.grid.spacing**2)
        if self._cosine != 0.0:  # clear the jump of the last step's surface
            self._lean.fill_(self._cosine)
        self._pushing.run(velocity, window, kind, passes, variant=(passes, window.near is None))

    def _roles(self, passes: int) -> tuple[wp.array, wp.array, wp.array]:
        """Return the fields of both filtered fractions and of the curvature.

        The fractions are those after the given number of passes and after twice as many.
        """
        once = self._fields[1:][passes % 2]
        twice = [field for field in self._fields if field is not once][passes % 2]
        (bend,) = (field for field in self._fields if field is not once and field is not twice)
        return once, twice, bend

    def _push(
        self, velocity: Sequence[wp.array], window: Window, kind: wp.array, passes: int
    ) -> None:
        """Launch the kernels of `act`.

        The jump of the pressure is `scale` times the curvature on the surface. A contact angle
        first tilts the extension of the surface into walls, on which the curvature depends.
        """
        grid, planes, bend = self.grid, self.grid.planes, self._bend
        self._find_curvature(window, passes)
        if self._cosine != 0.0:  # the extension into walls depends on the curvature
            s, bending = self._shares, 1.0 / (grid.dimension - 1)
            shares = [s.linear, s.cubic, s.once, s.twice]
            inputs = [
                *self._walls,
                self._raised,
                planes,
                bending,
                self._cosine,
                *shares,
                bend,
                self._lean.flatten(),
            ]
            launch_list(kernels.lean_kernel, len(self._walls[0]), inputs, device=grid.device)
            self.grid.part.fill(self._lean)
            self._find_curvature(window, passes)
        window.run(
            kernels.JUMP,
            self._shares,
            planes=planes,
            bend=bend,
            jump=self.jump,
            kind=kind,
            scale=self._scale,
        )
        if (barriers := grid.barriers) is not None:
            near = [barriers.near, barriers.apart[-1], planes]
            window.launch(jump_kernel, [*near, self._scale, kind, bend, self.jump])
        self.grid.part.fill(self.jump)
        for axis, field in enumerate(velocity):
            window.run(self._passes.push, self._faces(kind), jump=self.jump, field=field, axis=axis)

    def _find_curvature(self, window: Window, passes: int) -> None:
        """Compute the curvature [1/cells] near the surface, and extend it into walls.

        The nearest point of the surface may lie in a wall.
        """
        first, *free = self._fields
        # The passes read cells outside of the window, where an earlier step may have left values.
        clear(*self._fields)
        capacity = self._capacity if self._cosine != 0.0 else None
        window.launch(
            kernels.share_kernel, [self._phi, self._blocked, capacity, self._cosine, first]
        )
        once = self._smoothed(window, first, free, passes, 0)
        self._smoothed(
            window, once, [field for field in self._fields if field is not once], passes, passes
        )
        window.run(
            kernels.CURVATURE,
            self._shares,
            planes=self.grid.planes,
            bend=self._bend,
            limit=self._most,
        )
        if (barriers := self.grid.barriers) is not None:
            s, near = self._shares, [barriers.near, barriers.apart[-1], self.grid.planes]
            shares = [s.once, s.twice, s.linear, s.cubic]
            window.launch(curvature_kernel, [*near, *shares, self._most, self._bend])
        self.grid.part.fill(self._bend)
        self._continue(self._bend, 0, 0.0)

    def damp_velocity_gradients(self, particles: Particles, dt: float) -> None:
        """Damp velocity gradients shorter than the filter on particles near the surface.

        Ripples shorter than the filter have no restoring force. Without damping they grow from the
        noise of the particles, since APIC has nearly no dissipation, and destroy the surface.

        Args:
            particles: the liquid (updated: gradients; also their numbers, as a narrow band may have
                added and removed particles).
            dt: time step [s].
        """
        self._factor.value = math.exp(
            -CALM * dt * math.sqrt(self.coefficient / (self.density * self.grid.spacing**3))
        )
        self._calming.run(particles)

    def _launch_velocity_damping(self, particles: Particles) -> None:
        """Launch the kernels of `damp_velocity_gradients`."""
        particles.number()
        for gradient in particles.affine:
            listed = [
                self._factor,
                -0.99 * REACH_OF_PHI,
                particles.key,
                self._phi.flatten(),
                gradient,
            ]
            launch_list(kernels.calm_kernel, particles.count, listed, device=self.grid.device)

    def measure(self, window: Window, kind: wp.array) -> None:
        """Compute the surface energy, which `energy` returns."""
        box = window.common(self.grid.part.owned)
        self._measured = None if box is None else self._cells
        if box is not None:
            self._cells.move_to(box)
            self._measuring.run(kind, variant=(self._passes_done, box.near is None))
            self._energy.changed()

    def energy(self) -> float:
        """Return the last measured energy of surface and wet walls [J; J/m in 2-D].

        It is sigma (area - cos(angle) wet area).
        """
        mine = self._energy.read() if self._measured is not None else [0.0, 0.0]
        area, wetted = self.grid.part.ranks.sum(np.array(mine)).tolist()
        return (
            self.coefficient
            * (area - self._cosine * wetted)
            * self.grid.spacing ** (self.grid.dimension - 1)
        )

    def _faces(self, kind: wp.array) -> LiquidBoundary:
        """Return cells, surface and walls as a kernel struct, with walls at rest."""
        return LiquidBoundary(
            kind,
            self._phi,
            self.grid.planes,
            *three_components(self.boundary.open),
            *three_components(()),
        )

    def _smoothed(
        self, window: Window, source: wp.array, free: Sequence[wp.array], passes: int, before: int
    ) -> wp.array:
        """Return the source after binomial passes, in one of two free fields.

        A pass is the mean with weights (1, 2, 1)/4 along each axis.
        `before` passes have been applied to the source already.
        """
        self._continue(source, before, self._cosine)
        # `begin_kernel` reads more layers of ghost cells than are filled.
        if before == 0 and self._cosine != 0.0:
            self.grid.part.fill(source)
        for done in range(1, passes + 1):
            out = free[done % 2]
            window.run(BINOMIAL, planes=self.grid.planes, source=source, out=out)
            if self.grid.barriers is not None:
                self.grid.barriers.smooth(window, source, out)
            # A pass reads one layer of ghost cells, the extension into walls three.
            if done % 2 == 0 or done == passes:
                self.grid.part.fill(out)
            self._continue(out, before + done, self._cosine)
            source = out
        return source

    def _continue(self, field: wp.array, passes: int, cosine: float) -> None:
        """Extend a smoothed fraction into walls after the given number of passes.

        With a cosine of 0 any field is extended by mirroring.
        """
        walls, fields = (
            [*self._walls, self._lean.flatten(), cosine],
            [self.grid.planes, self._blocked, field, field.flatten()],
        )
        kernel, spread = kernels.continue_kernel, [math.sqrt(0.25 + 0.5 * passes)]
        if passes == 0 and cosine != 0.0:  # a cell's kernel has compact support
            kernel, spread = kernels.begin_kernel, []
        launch_list(
            kernel, len(self._walls[0]), [*walls, *spread, *fields], device=self.grid.device
        )

    def _find_walls(self) -> None:
        """Find the wall cells that passes read, and the source points of their values."""
        distance, device = self.boundary.distance, self.grid.device
        blocked, *lists = wall_cells(
            self.grid, self.boundary.base.numpy(), None if distance is None else distance.numpy()
        )
        self._blocked.assign(blocked)
        kinds = (wp.int32, wp.vec3, wp.float32, wp.float32)
        *self._walls, self._raised = (
            wp.array(v, dtype=kind, device=device) for v, kind in zip(lists, kinds, strict=True)
        )


def _profile(passes: int) -> tuple[float, float]:
    """Return the coefficients of the distance to a plane, see `SurfaceShares`."""
    narrow, wide = (math.sqrt(0.25 + 0.5 * count) for count in (passes, 2 * passes))
    first, third = ((2.0 / narrow**n - 1.0 / wide**n) / math.sqrt(2.0 * math.pi) for n in (1, 3))
    return 1.0 / first, third / (6.0 * first**4)


def wall_cells(
    grid: StaggeredGrid, base: np.ndarray, distance: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the wall cells beside open ones, and the points that they mirror.

    A cell whose center lies in a solid is a wall cell, mirrored along the solid's normal. Cells of
    the ring and, without a distance, those of a solid's whole cells are mirrored along the axes.

    Args:
        grid: the grid.
        base: int8, SOLID or AIR, in the stored shape.
        distance: distance to solids at the cells' low corners [cells]; None if solids are whole
            cells.

    Returns:
        `blocked`, int8 in the stored shape; the flat indices of the cells, int32, shape (n,); their
        mirror points (i, j, k) in units of cells, shape (n, 3); the distances from cell to point
        [cells], and the distance of their middle from the wall, 0 for a mirror image, shape (n,);
        float32.
    """
    flat, ends = grid.dimension == 2, np.array(base.shape) - 1
    inner = np.zeros(base.shape, dtype=bool)
    inner[1:-1, 1:-1, 1:-1] = True
    center, normal = (
        _at_centers(distance, flat)
        if distance is not None
        else (np.ones(base.shape), np.zeros((3, *base.shape)))
    )
    blocked = (base == SOLID) | ~inner | (center < 0.0)
    padded = np.pad(~blocked, 1)
    steps = [
        np.array(s) - 1 for s in np.ndindex(3, 3, 3) if s != (1, 1, 1) and not (flat and s[0] != 1)
    ]
    # Cells with a partly open face need one more layer.
    near = _beside(~blocked, steps)
    cells = np.argwhere(blocked & (near | (_beside(near, steps) & (center < 0.0) & inner)))
    first, sides, least = np.zeros_like(cells), np.zeros_like(cells), np.full(len(cells), 4)
    # Neighbors across faces, then edges, then corners.
    for step in sorted(steps, key=lambda s: int(np.abs(s).sum())):
        there, size = padded[tuple((cells + 1 + step).T)], int(np.abs(step).sum())
        first[there & (least == 4)] = step
        least[there & (least == 4)] = size
        sides[there & (least == size)] += step
    # The cell between two open neighbors mirrors both walls, if it is open.
    sides = np.sign(sides)
    both = padded[tuple((cells + 1 + sides).T)]
    toward = np.where(both[:, None], sides, first)
    points, way = (cells + toward).astype(np.float32), np.abs(toward).sum(axis=1).astype(np.float32)
    raised = np.zeros_like(way)
    at, flat_index = (
        tuple(cells.T),
        np.asarray(np.ravel_multi_index(tuple(cells.T), base.shape), dtype=np.int32),
    )
    solid = np.flatnonzero((center[at] < 0.0) & inner[at])
    depth, along = -2.0 * center[at][solid], normal.reshape(3, -1)[:, flat_index[solid]].T
    corners = [np.array(corner) for corner in np.ndindex(1 if flat else 2, 2, 2)]
    for _ in range(FARTHER):  # until no wall cell is among those around the point
        mirrored = np.clip(cells[solid] + depth[:, None] * along, 1, ends - 1)
        around = [np.minimum(np.floor(mirrored).astype(int) + corner, ends) for corner in corners]
        depth += 0.25 * np.logical_or.reduce([blocked[tuple(cell.T)] != 0 for cell in around])
    points[solid], way[solid], raised[solid] = mirrored, depth, 0.5 * depth + center[at][solid]
    return blocked.astype(np.int8), flat_index, points[:, ::-1].copy(), way, raised


def _beside(marked: np.ndarray, steps: list[np.ndarray]) -> np.ndarray:
    """Return the cells that have a marked cell at one of the given steps."""
    padded = np.pad(marked, 1)
    return np.logical_or.reduce(
        [
            padded[tuple(slice(1 + d, 1 + d + n) for d, n in zip(s, marked.shape, strict=True))]
            for s in steps
        ]
    )


def _at_centers(nodes: np.ndarray, flat: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean over each cell's corners, and the unit gradient (k, j, i).

    `flat` is True in 2-D.
    """
    axes = (1, 2) if flat else (0, 1, 2)
    center, slopes = nodes.astype(np.float64), np.zeros((3, *nodes.shape))
    for axis in axes:
        slope = _next(nodes.astype(np.float64), axis) - nodes
        for other in axes:
            slope = slope if other == axis else 0.5 * (slope + _next(slope, other))
        slopes[axis] = slope
        center = 0.5 * (center + _next(center, axis))
    return center, slopes / np.maximum(np.linalg.norm(slopes, axis=0), 1e-9)


def _next(field: np.ndarray, axis: int) -> np.ndarray:
    """Return each element's successor along an axis; the last one is repeated."""
    return np.concatenate(
        [field.take(range(1, field.shape[axis]), axis), field.take([-1], axis)], axis
    )
