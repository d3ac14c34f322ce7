"""Narrow band: particles near the surface only, grid velocity below.

After narrow band FLIP [Ferstl et al. 2016]; the scheme is derived here. Deep inside a liquid the
particles carry no information: their density is that at rest, and their velocity is that of the
grid. Let d(x) be the depth, the distance to the surface [cells], and W the band's width.

1. Where. A step starts with the depth d* that the last step has advected, so {d* > W} is the region
   without particles: liquid that was deeper than W and moved with the flow. Cells with d* >= D =
   min(2, W / 2) count as full; the density of all others is that of their particles, which extend
   beyond any kernel around these cells. So the surface depends on the particles alone, and errors
   of d* do not accumulate: after the solve d is measured again as a chamfer distance from air
   cells, with the fraction of a cell from their level set; solids do not count.
2. How fast. On faces deeper than W - 1 the velocity u* is the last step's, advected by a
   semi-Lagrangian step of third order (`warp_lcp.grid.advection`). On faces above W - 2 it is the
   particles' mean; in between it is interpolated linearly. Gravity and pressure act on both alike.
3. Exchange. Particles deeper than W are removed. The band's last layer, W - 1 < d <= W, and cells
   of {d* > W - 1} that are now shallower (because a wall has separated, say) get fresh particles in
   each step. They are a reservoir of even density, from which the flow takes exactly the amount
   that it carries away. Their lattice moves on through the cell by irrational steps, so that in the
   mean over steps every place is equally likely. (With a fixed lattice no particle is ever where a
   slow flow could carry it away, and cells filled up to a count lose 10 % to the same bias.) Fresh
   particles take their velocity and its gradient from the grid, as all others do at that time.
4. Mass. H is the number of particles that the interior represents: those that entered it less those
   that left it. The density of the fresh layer, and of the interior in the density correction, is H
   divided by the particles that {d* > W} would hold at rest, limited to within a tenth of 1. The
   numbers of particles and H together are those without a band, so that the correction pushes back
   liquid lost to one side as it would without one.

In sums the interior counts by whole cells, so that a log's center of mass may be off by a part of a
cell, and its potential energy accordingly. Particles also stay within W of places where liquid
leaves a wall, where solids cut cells or move, and of sources, drains and open sides.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import reduce

import numpy as np
import warp as wp

from warp_lcp.grid.advection import CENTERS, carry_field
from warp_lcp.grid.cell_kernel import launch_list, scan
from warp_lcp.grid.particles import MOST_A_CELL, Particles, ParticleTotals
from warp_lcp.grid.staggered import ActiveWindow, StaggeredGrid, Window, three_components
from warp_lcp.grid.transfer import faces_to_particles
from warp_lcp.kernels.launch_graph import LaunchGraph, clear, is_recording
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.material import narrow_band_kernels as kernels
from warp_lcp.material.boundary import Boundary
from warp_lcp.material.resample import PLASTIC
from warp_lcp.operators.grid_poisson import AIR, FLUID, SOLID

# Cells below the band in which depths are resolved: a depth that is advected into the band must
# have a slope.
BEYOND = 3.0
DEEP = 2.0  # depth in cells from which a cell counts as full, whatever its particles
REACH = 1.5  # half the width of a cell's kernel [cells]
FALLS = 2  # passes over rows, forth and back, after which most depths are final
UNEVEN = 0.1  # largest difference of the interior's density from that at rest


class NarrowBand:
    """Narrow band of particles; the grid carries the liquid below it.

    A step calls `blend` when the particles' velocity is on the faces, `fill` when their density is
    computed, `exchange` between the solve and the transfer to the particles, and `carry` when the
    particles have moved.

    Args:
        grid: the grid.
        boundary: solids and walls.
        width: width of the band [cells], >= 3.
        per_axis: particles along the edge of a cell.
        jitter: width of fresh particles' random displacement, a fraction of their distance.
        random_seed: seed of the displacements.
        keep: cells that hold particles whatever their depth, bool of the stored shape; None if
            there are none.

    Attributes:
        depth: d* [cells], float32; 0 in air. More than `width` where there are no particles.
        velocity: velocity on each component's faces, advected with the depth [m/s].
        held: H, particles that the interior stands for; negative if the band has got more than
            there was.
        interior: sums over the cells without particles, at their centers; its count is theirs.
        full: depth from which on cells count as full [cells].
        fresh: particles that the last exchange has put into the band; they are the last ones.
        behind: place to which the places of these are relative, on ranks.

    Raises:
        ValueError: the width is too small.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        boundary: Boundary,
        *,
        width: float,
        per_axis: int,
        jitter: float,
        random_seed: int,
        keep: np.ndarray | None = None,
    ) -> None:
        if not width >= 3.0:
            raise ValueError(f"width = {width}: must be at least 3 cells")
        self.grid, self.boundary, self.width = grid, boundary, float(width)
        self.per_axis, self.jitter, self.random_seed = per_axis, jitter, random_seed
        self.particles_a_cell = per_axis**grid.dimension
        self.full = min(DEEP, 0.5 * self.width)
        self.depth, self._now, self.velocity = grid.field(), grid.field(), grid.faces()
        self._keep = (
            wp.array(keep.astype(np.int8), dtype=wp.int8, device=grid.device)
            if keep is not None
            else None
        )
        self._total = wp.zeros(grid.size, dtype=wp.int32, device=grid.device)
        self._sum = self._total[-1:]
        self._changed = wp.zeros(1, dtype=wp.int32, device=grid.device)
        self._seeds = random_seed % 2**31 - 1
        self._steps = np.append(
            PLASTIC[grid.dimension] ** -np.arange(1.0, grid.dimension + 1), 0.0
        )[:3]
        self._sums = wp.zeros(
            (*grid.shape[:2], kernels.COLUMNS), dtype=wp.float64, device=grid.device
        )
        self.held = self.fresh = self.behind = 0
        self._numbered = kernels.CellNumbering()
        self._numbered.origin, self._numbered.across = (
            wp.vec3i(*grid.origin),
            wp.vec2i(*(n + 2 for n in grid.domain_counts[:2])),
        )
        self._own, self._before = grid.part.owned, grid.origin
        self._window, self._owned, self._inner = (
            ActiveWindow(w) for w in (grid.everywhere, grid.domain, grid.domain)
        )
        self._last = Scalar(), Scalar()  # plane and row of the window
        self._each, self._at_rest, self._way, self._behind = (Scalar() for _ in range(4))
        self._shift = Scalar(), Scalar(), Scalar()  # shift of fresh particles' lattice
        launches = (
            self._launch_depth,
            self._fall,
            self._launch_quota,
            self._launch_carry,
            self._launch_seeds,
        )
        self._depths, self._falling, self._quota, self._carrying, self._seeding = (
            LaunchGraph(grid.device, launch, at_once=grid.part.at_once) for launch in launches
        )
        # On a GPU it uses Warp's scan.
        self._leaving = LaunchGraph(grid.device, self._launch_leaving, at_once=grid.device.is_cuda)
        self._move_to(grid.everywhere)
        self.interior = self._summed(grid.everywhere)

    @property
    def mean_density(self) -> float | None:
        """H relative to the interior at rest; None without interior."""
        return (
            self.held / (self.particles_a_cell * self.interior.count)
            if self.interior.count
            else None
        )

    @property
    def density(self) -> float:
        """Density of fresh particles and of the interior, relative to rest.

        As the density correction uses it.
        """
        mean = self.mean_density
        return min(max(mean, 1.0 - UNEVEN), 1.0 + UNEVEN) if mean is not None else 1.0

    def start(self, owner: np.ndarray, velocities: np.ndarray) -> np.ndarray:
        """Initialize the band from the liquid's cells; return cells without particles.

        Args:
            owner: number of the liquid in each cell, -1: none, shape (nz, ny, nx).
            velocities: velocities of the liquids [m/s], shape (n, 3).

        Returns:
            bool, shape (nz, ny, nx).
        """
        grid, padded = self.grid, np.full(self.grid.shape, -1)
        padded[1:-1, 1:-1, 1:-1] = owner
        base = self.boundary.base.numpy()
        kind = wp.array(
            np.where(base == SOLID, SOLID, np.where(padded >= 0, FLUID, AIR)).astype(np.int8),
            device=grid.device,
        )
        self._measure(grid.everywhere, kind, None, grid.field(wp.uint8))
        wp.copy(self.depth, self._now)
        deep = (self.depth.numpy() > self.width) & (padded >= 0)
        own = tuple(map(slice, self._own.low, self._own.high))
        self.held = self._sum_over_ranks(int(deep[own].sum())) * self.particles_a_cell
        for axis, field in enumerate(self.velocity):
            speed = np.where(padded >= 0, velocities[padded, axis], np.nan)
            both = np.stack([speed, np.roll(speed, 1, axis=2 - axis)])
            known = np.isfinite(both)
            field.assign(
                (np.where(known, both, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)).astype(
                    np.float32
                )
            )
        self.grid.part.fill(*self.velocity)
        self.interior = self._summed(grid.everywhere)
        return np.asarray(grid.interior(deep))

    def blend(
        self, window: Window, velocity: Sequence[wp.array], weights: Sequence[wp.array]
    ) -> None:
        """Blend the carried velocity into the faces deep inside.

        Args:
            window: faces that material can reach.
            velocity: velocity of each component [m/s] (updated).
            weights: weights of the particles on each component's faces (updated).
        """
        start, full = self.width - 2.0, float(self.particles_a_cell)
        for axis, (carried, field, weight) in enumerate(
            zip(self.velocity, velocity, weights, strict=True)
        ):
            window.launch(
                kernels.blend_kernel,
                [axis, start, full, self.depth, self.boundary.base, carried, field, weight],
            )

    def fill(self, window: Window, density: wp.array) -> None:
        """Set deep cells to the density at rest, for the surface.

        Args:
            window: cells that material can reach.
            density: density of the particles, in units of that at rest (updated).
        """
        window.launch(
            kernels.fill_kernel, [self.full, 1.0, self.depth, self.boundary.capacity, density]
        )

    def fill_interior(self, window: Window, density: wp.array) -> None:
        """Set the interior's density where particles do not fill the kernel.

        Args:
            window: cells that material can reach.
            density: density of the particles, in units of that at rest (updated).
        """
        least = max(self.width - REACH, self.full)
        if not is_recording():
            self._at_rest.value = self.density
        window.launch(
            kernels.fill_kernel, [least, self._at_rest, self.depth, self.boundary.capacity, density]
        )

    def exchange(
        self,
        particles: Particles,
        window: Window,
        kind: wp.array,
        phi: wp.array | None,
        contact: wp.array,
        step: int,
        saved: Sequence[wp.array] = (),
    ) -> None:
        """Measure the depth; remove deep particles and renew the band's inner layer.

        The new ones have no velocity yet but for FLIP; `warp_lcp.grid.transfer.faces_to_particles`
        gives it to them.

        Args:
            particles: the liquid (updated); `key` holds its cells.
            window: cells that material can touch.
            kind: int8 of AIR, FLUID, SOLID.
            phi: float32 distance to the surface [cells]; None if it lies on the cells' faces.
            contact: uint8, RELEASED where liquid leaves a wall.
            step: number of the step, which the random part of new places depends on.
            saved: velocity as it came from the particles [m/s], for FLIP.
        """
        self.behind = first = particles.exchange.next_place()
        self._move_to(window)
        self._each.value = self.particles_a_cell * self.density
        self._depths.run(kind, phi, contact, variant=phi is None)
        self._relax(fallen=FALLS)
        removed = 0
        if particles.count:
            marks = particles.marks
            self._leaving.run(particles, marks)
            removed = sum(particles.finish_removal(marks))
        self.held += self._sum_over_ranks(removed)
        shift = (self._steps * step) % 1.0
        for number, part in zip(self._shift, shift, strict=True):
            number.value = float(part)
        self._quota.run(variant=self._owns_cells)
        self.fresh = int(self._sum.numpy()[0])
        if self._owns_cells and self.fresh:
            self._seed(particles, saved, first)
        self.held -= self._sum_over_ranks(self.fresh)

    def carry(self, velocity: list[wp.array], dt: float) -> None:
        """Advect depth and velocity for a time step.

        In the window of the last exchange.

        Args:
            velocity: velocity of each component on the faces [m/s].
            dt: time step [s].
        """
        self._way.value = dt / self.grid.spacing
        self._carrying.run(velocity, variant=self._owns_cells)
        self.interior = self._summed(self._window, launched=True)
        self._at_rest.value = self.density

    def _launch_carry(self, velocity: list[wp.array]) -> None:
        """Launch the advection, and the sums over cells without particles."""
        for axis, field, out in [
            (CENTERS, self._now, self.depth),
            *zip(range(3), velocity, self.velocity, strict=False),
        ]:
            clear(out)
            carry_field(
                field=field,
                out=out,
                axis=axis,
                level=self._now,
                least=0.0,
                before=self._before,
                grid=self.grid,
                window=self._inner,
                velocity=velocity,
                way=self._way,
            )
        self.grid.part.fill(self.depth, *self.velocity)
        if self._owns_cells:
            self._launch_sums(self._owned)

    def _launch_quota(self) -> None:
        """Launch the count of fresh particles of each cell."""
        clear(self._total)
        where = [self.boundary.base, self._now, self.depth, self._total.reshape(self.grid.shape)]
        if self._owns_cells:
            self._owned.launch(
                kernels.quota_kernel,
                [self._numbered, self.width, self._each, self._seeds, self._shift[0], *where],
            )
        scan(self._total, self._total, inclusive=True)

    def _launch_leaving(self, particles: Particles, marks: wp.array) -> None:
        """Launch the removal of particles of deep cells, and of cells that get fresh ones."""
        inputs = [self.width, particles.key, self._now.flatten(), self.depth.flatten(), marks]
        launch_list(kernels.leave_kernel, particles.count, inputs, device=self.grid.device)
        particles.launch_removal(marks)

    def with_interior(self, totals: ParticleTotals) -> ParticleTotals:
        """Return sums over the particles and the interior.

        The interior counts as H particles, and is weighted as at rest: the difference of H from
        rest is spread over all the liquid. Otherwise the center would move with every particle that
        the band has more or less than its share.

        With N particles and N_0 = particles per cell * interior cells, the interior has the share s
        = N_0 / (N + N_0), and each mean is (1 - s) of the particles + s of the interior. Units are
        those of `ParticleTotals`.
        """
        inside, count = self.interior, totals.count + self.held
        if inside.count == 0 or count <= 0:
            return replace(totals, count=max(count, 0))
        at_rest = self.particles_a_cell * inside.count
        share = at_rest / (totals.count + at_rest)
        return replace(
            totals,
            count=count,
            mean_square_speed=(1.0 - share) * totals.mean_square_speed
            + share * inside.mean_square_speed,
            velocity=(1.0 - share) * totals.velocity + share * inside.velocity,
            center=(1.0 - share) * totals.center + share * inside.center,
            low=np.minimum(totals.low, inside.low) if totals.count else inside.low,
            high=np.maximum(totals.high, inside.high) if totals.count else inside.high,
            max_speed=max(totals.max_speed, inside.max_speed),
        )

    def state(self) -> dict[str, np.ndarray]:
        """Return the state of the band; unused values are 0, for better compression.

        Depths are in cells. They are used in cells with depth > min(width - BEYOND, full - 1), and
        velocities [m/s] on the faces of these cells.
        """
        depth = self.depth.numpy()
        deep = depth > min(self.width - BEYOND, self.full - 1.0)
        faces = {}
        for axis, field in enumerate(self.velocity):
            near = deep | np.roll(deep, 1, axis=2 - axis)
            faces[f"interior_velocity_{axis}"] = np.where(near, field.numpy(), np.float32(0.0))
        # All sums but the counts of bad values. They include cells where solids were, in an order
        # that depends on windows.
        inside = list(vars(self.interior).values())[:7]
        sums = np.hstack([self.held, self.width, *inside])
        return {"depth": np.where(deep, depth, np.float32(0.0)), "interior": sums} | faces

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Restore `state`.

        Raises:
            ValueError: the band had another width.
        """
        held, width, cells, squares, *vectors, fastest = state["interior"].tolist()
        if width != self.width:
            raise ValueError(
                f"the state's narrow band is {width:g} cells wide: this scene's is {self.width:g}"
            )
        self.depth.assign(state["depth"])
        for axis, field in enumerate(self.velocity):
            field.assign(state[f"interior_velocity_{axis}"])
        self.grid.part.fill(self.depth, *self.velocity)
        self.held = int(held)
        velocity, center, low, high = np.reshape(vectors, (4, 3))
        self.interior = ParticleTotals(int(cells), squares, velocity, center, low, high, fastest)

    def forget(self) -> None:
        """Start with particles everywhere; the next exchange removes deep ones."""
        for field in (self.depth, *self.velocity):
            field.zero_()
        self.held = 0
        self.interior = self._summed(self.grid.everywhere)

    def _move_to(self, window: Window) -> None:
        """Set the window that launches visit."""
        self._window.move_to(window)
        # Only the domain and the ring's upper layer are advected; faces below the first cell lie in
        # the wall.
        self._inner.move_to(
            Window.of([max(start, 1) for start in window.low], window.high, window.device)
        )
        for number, end in zip(self._last, window.high, strict=False):
            number.value = end - 1
        own = window.common(self._own)
        self._owns_cells = own is not None  # whether any of its cells are this grid's own
        if own is not None:
            self._owned.move_to(own)

    def _measure(
        self, window: Window, kind: wp.array, phi: wp.array | None, contact: wp.array
    ) -> None:
        """Compute the depth of a window's cells, up to `BEYOND` below the band."""
        self._move_to(window)
        self._shore(kind, phi, contact)
        self._relax()

    def _shore(self, kind: wp.array, phi: wp.array | None, contact: wp.array) -> None:
        """Launch the depth of cells at most one cell deep, the start of `_relax`."""
        planes, most = self.grid.planes, self.width + BEYOND
        thin = self.grid.barriers.near if self.grid.barriers is not None else None
        fields = [phi, contact, self._keep, self.boundary.distance, thin, self._now]
        inputs = [planes, most, kind, *fields]
        self.grid.everywhere.launch(kernels.shore_kernel, inputs)

    def _launch_depth(self, kind: wp.array, phi: wp.array | None, contact: wp.array) -> None:
        """Launch the depth, without the passes after the first `FALLS`."""
        self._shore(kind, phi, contact)
        for number in range(FALLS):
            self._fall(number % 2 == 1)

    def _fall(self, forth: bool) -> None:
        """Launch a pass that lowers the depth of cells to their neighbors' limit."""
        if self.grid.device.is_cpu:
            clear(self._changed)
        plane, row = (0, 0) if forth else self._last
        self._window.run(
            kernels.RELAX,
            depth=self._now,
            changed=self._changed,
            planes=self.grid.planes,
            last_plane=plane,
            last_row=row,
        )

    def _relax(self, fallen: int = 0) -> None:
        """Lower the depth until it agrees with the neighbors on all ranks.

        `fallen` passes have been made. The shortest path to the surface may cross several ranks.
        """
        self._relax_here(fallen)
        part, falls = self.grid.part, self.grid.part.comm is not None
        while falls:
            before = self._now.numpy().copy()
            part.fill(self._now)
            after = np.minimum(before, self._now.numpy())
            self._now.assign(after)
            falls = part.ranks.any(bool((after < before).any()))
            if falls:
                self._relax_here(0)

    def _relax_here(self, fallen: int) -> None:
        """Lower the depth of this process's cells until it agrees with the neighbors."""
        for number in range(fallen, math.ceil(self.width + BEYOND) + 1):
            # Rows are visited in sequence, so three passes or so suffice.
            if number and self.grid.device.is_cpu and self._changed.numpy()[0] == 0:
                break
            self._falling.run(number % 2 == 1, variant=number % 2 == 1)

    def _sum_over_ranks(self, count: int) -> int:
        """Return the sum of a count over all processes."""
        return int(self.grid.part.ranks.sum(count))

    def _add_places(self, particles: Particles, behind: int) -> None:
        """Set the places of a rank's fresh particles in the order of the domain's cells."""
        counts = np.diff(self._total.numpy(), prepend=0)
        stored = np.flatnonzero(counts)
        counts = counts[stored]
        k, j, i = np.unravel_index(stored, self.grid.shape)
        x, y, z = (
            cells + before for cells, before in zip((i, j, k), self.grid.origin, strict=True)
        )
        nx, ny, _ = (n + 2 for n in self.grid.domain_counts)
        first = ((z * ny + y) * nx + x) * MOST_A_CELL - np.cumsum(counts) + counts
        particles.exchange.add_places(behind + np.repeat(first, counts) + np.arange(counts.sum()))

    def _seed(self, particles: Particles, saved: Sequence[wp.array], behind: int) -> None:
        """Add fresh particles after the others; on ranks `behind` is their first place."""
        first = particles.make_room(self.fresh)
        self._behind.value = first
        self._seeding.run(particles)
        if saved:
            tail = particles.position[first:], particles.velocity[first:]
            faces_to_particles(self.grid, list(saved), *tail, [])
        if self.grid.part.shared:
            self._add_places(particles, behind)

    def _launch_seeds(self, particles: Particles) -> None:
        """Launch the placing of fresh particles on their sites."""
        grid, sites = self.grid, kernels.JitteredLattice()
        sites.planes, sites.per_axis, sites.jitter, sites.seed = (
            grid.planes,
            self.per_axis,
            self.jitter,
            self._seeds,
        )
        sites.dx = grid.spacing
        numbers = [*self._shift, self._behind, *grid.shape[1:]]
        self._owned.launch(
            kernels.seed_kernel, [sites, self._numbered, *numbers, self._total, particles.position]
        )

    def _launch_sums(self, box: Window) -> None:
        """Launch the sums over a box's cells without particles."""
        u, v, w = three_components(self.velocity)
        box.launch_rows(
            kernels.sum_kernel,
            [self.grid.planes, self.width, self.boundary.base, self.depth, u, v, w, self._sums],
        )

    def _summed(self, window: Window, *, launched: bool = False) -> ParticleTotals:
        """Sum up the cells without particles of all processes.

        `launched`: the sums over rows have been launched already.
        """
        return reduce(
            ParticleTotals.joined,
            self.grid.part.ranks.collect(self._summed_here(window, launched=launched)),
        )

    def _summed_here(self, window: Window, *, launched: bool) -> ParticleTotals:
        """Sum up the cells without particles of this process.

        The columns of a row's sums are those of `kernels.sum_kernel`. Means are sums / cells;
        positions are (index + origin - 1/2) dx [m], 0 along z in 2-D, and squared speeds are in
        m^2/s^2.
        """
        box = window.common(self._own)
        if box is None:
            return ParticleTotals()
        if not launched:
            self._launch_sums(box)
        rows = box.rows_of(self._sums).reshape(-1, kernels.COLUMNS)
        cells, dx = int(rows[:, 0].sum()), self.grid.spacing
        if cells == 0:
            return ParticleTotals()
        center, lowest, highest = (
            rows[:, 2:5].sum(axis=0) / cells,
            rows[:, 6:9].min(axis=0),
            rows[:, 9:12].max(axis=0),
        )
        places = (np.stack([center, lowest, highest]) + np.array(self.grid.origin) - 0.5) * dx
        places[:, self.grid.dimension :] = 0.0
        squares, fastest = float(rows[:, 1].sum()) / cells, float(rows[:, 5].max())
        return ParticleTotals(
            cells,
            squares,
            rows[:, 12:15].sum(axis=0) / cells,
            places[0],
            places[1],
            places[2],
            math.sqrt(fastest),
        )


def without_band(
    state: Mapping[str, np.ndarray], spacing: float, random_seed: int
) -> Mapping[str, np.ndarray]:
    """Return a state with the interior of its narrow band filled with particles.

    A state without a band is returned unchanged.

    Args:
        state: arrays of the particles and, if there was a band, of `NarrowBand.state`.
        spacing: spacing of its grid [m].
        random_seed: seed of the places.
    """
    if "interior" not in state or state["interior"][0] <= 0:
        return state
    held, width = int(state["interior"][0]), float(state["interior"][1])
    solid = state["cells"] == SOLID
    k, j, i = np.nonzero((state["depth"] > width) & ~solid)
    if len(i) == 0:
        return state
    faces = [
        state[f"interior_velocity_{axis}"]
        for axis in range(3)
        if f"interior_velocity_{axis}" in state
    ]
    dimension = len(faces)
    ends = np.arange(len(i) + 1) * held // len(i)
    cell = np.repeat(np.arange(len(i)), np.diff(ends))
    steps, shift = (
        PLASTIC[dimension] ** -np.arange(1.0, dimension + 1),
        np.random.default_rng(random_seed).random(dimension),
    )
    place = (shift + np.arange(held)[:, None] * steps) % 1.0
    position, velocity = np.zeros((held, 3)), np.zeros((held, 3))
    position[:, :dimension] = (
        np.stack([i, j, k], axis=1)[cell, :dimension]
        - 1.0
        + np.clip(place, kernels.INSET, 1.0 - kernels.INSET)
    )
    more = {}
    for axis, field in enumerate(faces):
        low = field[k, j, i]
        change = field[k + (axis == 2), j + (axis == 1), i + (axis == 0)] - low
        velocity[:, axis] = low[cell] + place[:, axis] * change[cell]
        gradient = np.zeros((held, 3))
        gradient[:, axis] = change[cell] / spacing
        more[f"affine_{axis}"] = gradient
    added = {"position": position * spacing, "velocity": velocity} | more
    return {
        name: np.concatenate([v, added[name].astype(v.dtype)]) if name in added else v
        for name, v in state.items()
    }
