"""Conserve momentum and angular momentum of airborne material.

Material that no wall touches moves along its parabola.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import warp as wp

from warp_lcp.grid.cell_kernel import launch_list
from warp_lcp.grid.grid_part import BodyNumbers
from warp_lcp.grid.particle_loops import PARTICLE, ListMemory
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import StaggeredGrid, Window, three_components
from warp_lcp.kernels.launch_graph import LaunchGraph, clear
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.material import ballistic_fragments_kernels as kernels
from warp_lcp.material.boundary import Boundary

# [cells^2] Least second moment about an axis, per particle, of a body whose rotation the grid
# resolves.
NARROW = 1.0
ROOM, LEAST = 2, 64  # allocated bodies: a factor on their number, and a minimum
VECTORS = 5  # vectors of a body that kernels read
# Columns of the matrix xx, xy, xz; xy, yy, yz; xz, yz, zz among a body's sums.
SECOND_MOMENTS = [10, 13, 14, 13, 11, 15, 14, 15, 12]
Sums = np.ndarray  # results of `kernels.add_up`, float64, shape (bodies, COLUMNS)
NOTHING: Sums = np.zeros((0, kernels.COLUMNS))


class BallisticFragments:
    """Find bodies of material that no wall touches, and keep their momenta.

    The pressure's impulses on an airborne body add up to zero, but not the impulses that its
    particles get from them. They are not spread as evenly as the volume for which the pressure is
    solved, and particles outside the surface take the velocity of liquid beside them. Moreover, a
    particle that moves with a flow that turns by an angle a in a step keeps a velocity that does
    not turn: a rigid rotation loses a^2 / 2 of its angular momentum. Therefore a body's particles
    are moved again, once the end of the step is known:

    - They move through a velocity field that translates with the body. In a field at rest the
      middle of a spinning drop would move aside by a / 2 of its path.
    - Their part of the body's rigid rotation turns with the body. This is the effect of the
      pressure that keeps the body together.
    - A rigid motion, which causes no strain, restores the momentum and the angular momentum (of the
      particles' x and v) that the body had before the transfer to the grid, plus those of gravity.
    - If the body then moves faster within itself than before, its non-rigid velocity is scaled down
      until it does not.

    Bodies are sets of cells that are connected by faces with particle weight; a lone particle is a
    body.

    Args:
        grid: the grid.
        boundary: solids and walls.
        coheres: whether a pressure below that of the air keeps a rotating body together; if not,
            its particles go straight on.
        settles: whether overfull material is pushed apart in flight, and may so move faster within
            itself.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        boundary: Boundary,
        *,
        coheres: bool = True,
        settles: bool = False,
    ) -> None:
        self.grid, self.boundary, self._settles = grid, boundary, settles
        self._parent, self._number = (
            wp.zeros(grid.size, dtype=wp.int32, device=grid.device) for _ in range(2)
        )
        self._held, self._several = (
            wp.zeros(grid.size, dtype=wp.uint8, device=grid.device) for _ in range(2)
        )
        self._count, self._found = DeviceScalar(grid.device, 2, wp.int32), False
        self._flight = kernels.FragmentFields()
        self._flight.straight = not coheres
        self._flight.planes, self._flight.inverse_dx = grid.planes, 1.0 / grid.spacing
        self._flight.origin = wp.vec3i(*grid.origin)
        self._before: Sums = NOTHING
        # Window of the last search; None if it has no cells of this process.
        self._seen: Window | None = None
        self._numbers = BodyNumbers(0)
        self._growing = LaunchGraph(grid.device, self._launch_growth)
        self._rate, self._quanta = Scalar(), Scalar()  # see `ballistic_fragments_kernels.add_up`
        self._list = ListMemory(grid.device)  # list of the bodies' particles
        self._vectors, self._start = (
            np.zeros((0, VECTORS, 3), dtype=np.float32),
            wp.zeros(0, dtype=wp.vec3, device=grid.device),
        )
        launches = (
            self._launch_boarding,
            self._launch_lift,
            self._launch_flight,
            self._launch_landing,
        )
        self._boarding, self._lifting, self._flying, self._landing = (
            LaunchGraph(grid.device, launch) for launch in launches
        )

    def find(self, window: Window, weights: Sequence[wp.array], kind: wp.array) -> None:
        """Find airborne bodies, without waiting for their number; arguments as of `begin`.

        Grow the trees of the window's cells, and of the cells below it whose faces are in it: on a
        part of the grid those beside its own cells.
        """
        part, self._found = self.grid.part, True
        self._seen, around = part.near(window, 1), part.near(window, 2)
        if self._seen is None or around is None:
            self._count.array.zero_()
        else:
            self._growing.run(self._seen, around, weights, kind, variant=window.near is None)
        self._count.changed()

    def _launch_growth(
        self, window: Window, around: Window, weights: Sequence[wp.array], kind: wp.array
    ) -> None:
        """Launch the growth of the trees, and the numbering of the bodies."""
        parent, held, several = self._parent, self._held, self._several
        u, v, w = three_components(weights)
        around.run(kernels.ALONE, kind=kind, parent=parent, held=held, several=several)
        window.run(kernels.UNITE, u=u, v=v, w=w, parent=parent)
        window.run(
            kernels.HOLD,
            kind=kind,
            touch=self.boundary.touch,
            parent=parent,
            held=held,
            several=several,
        )
        clear(self._count.array)
        around.run(
            kernels.NUMBER,
            kind=kind,
            parent=parent,
            held=held,
            several=several,
            number=self._number,
            count=self._count.array,
        )

    def begin(
        self,
        particles: Particles,
        window: Window,
        weights: Sequence[wp.array],
        kind: wp.array,
        dt: float,
        change: np.ndarray,
    ) -> int:
        """Find bodies, before particles get new velocities; return their number.

        Args:
            particles: the material; `key` holds its cells.
            window: cells that it can touch.
            weights: weights of the particles on each component's faces.
            kind: int8 of AIR, FLUID, SOLID, of the step's solve.
            dt: time step [s].
            change: change of the velocity by gravity in this step [m/s], shape (3,).
        """
        if not self._found:
            self.find(window, weights, kind)
        self._found, trees = False, int(self._count.numpy()[0])
        self._numbers = self.grid.part.join_trees(
            trees, self._seen, self._parent, self._number, self._held
        )
        bodies = self._numbers.count
        self._before = np.zeros((bodies, kernels.COLUMNS)) if bodies else NOTHING
        if bodies == 0:
            return 0
        self._reserve(particles, bodies)
        self._list.resize(self._board(particles))
        self._rate.value = dt / self.grid.spacing
        # No sum of products of positions and velocities may overflow; these are of fewer cells than
        # the domain has along its longest side.
        longest = max(self.grid.domain_counts)
        self._quanta.value = 2.0 ** math.floor(
            60.0 - math.log2(sum(particles.exchange.counts) * longest**2)
        )
        self._lifting.run(particles)
        self._before = self._sums(bodies)
        self._change = change * self._rate.value
        return bodies

    def _reserve(self, particles: Particles, bodies: int) -> None:
        """Allocate memory for a number of bodies with some of these particles."""
        flight, device, most = self._flight, self.grid.device, particles.capacity
        if bodies <= len(self._vectors) and most <= len(self._start):
            return
        rows = max(ROOM * bodies, LEAST)
        self._who, self._body = (wp.zeros(most, dtype=wp.int32, device=device) for _ in range(2))
        flight.who, flight.body = self._who, self._body
        self._list.set_list(0, {"who": self._who})
        flight.sums = wp.zeros((rows, kernels.COLUMNS), dtype=wp.int64, device=device)
        self._vectors = np.zeros((rows, VECTORS, 3), dtype=np.float32)
        self._motion = wp.array(self._vectors, dtype=wp.vec3, device=device, copy=device.is_cuda)
        self._start, self._end, self._x = (
            wp.zeros(most, dtype=wp.vec3, device=device) for _ in range(3)
        )
        self._near = wp.zeros(most, dtype=wp.uint8, device=device)
        for graph in (self._boarding, self._lifting, self._flying, self._landing):
            graph.forget()

    def _launch_boarding(self, particles: Particles) -> None:
        """Launch the listing of the bodies' particles."""
        inputs = [
            particles.key,
            self._parent,
            self._number,
            self._who,
            self._body,
            self._count.array,
        ]
        launch_list(
            kernels.board_kernel, particles.count, inputs, device=self.grid.device, ordered=True
        )

    def _launch_lift(self, particles: Particles) -> None:
        """Launch the sums over the bodies' particles at their places before the step."""
        clear(self._flight.sums)
        self._add(kernels.lift_kernel, particles, [particles.position, self._start])

    def _launch_flight(self, particles: Particles, velocity: list[wp.array]) -> None:
        """Launch the advection of the bodies' particles, and sums at the new places."""
        clear(self._flight.sums)
        wall, arrived = self.boundary, [self._x, self._near]
        inputs = [
            *three_components(velocity),
            self._motion,
            wall.base,
            wall.touch,
            self._start,
            self._end,
            *arrived,
        ]
        self._carry(kernels.fly_kernel, [self._rate, particles.velocity, *inputs])
        self._add(kernels.arrive_kernel, particles, arrived)

    def _launch_landing(self, particles: Particles) -> None:
        """Launch the update of the bodies' particles: places and velocities."""
        moved = [particles.velocity, *three_components(particles.affine)]
        self._carry(kernels.land_kernel, [*moved, self._motion, self._end, particles.position])

    def end(self, particles: Particles, velocity: Sequence[wp.array]) -> None:
        """Move the bodies' particles again, and correct their momenta.

        Args:
            particles: those of `begin`, in their order, with new velocities (updated: position,
                velocity, gradients).
            velocity: velocity of each component on the faces [m/s].
        """
        if len(self._before) == 0:
            return
        rate = self._rate.value
        before, dx, dt, had = (
            self._before,
            self.grid.spacing,
            rate * self.grid.spacing,
            _about_center(self._before),
        )
        number = np.maximum(before[:, :1], 1.0)
        center, drift = before[:, 1:4] / number, before[:, 4:7] / number + self._change
        spin = np.zeros_like(drift) if self._flight.straight else _turning(before, had)[0]
        self._copy_to_kernels(drift * dx / dt, spin / dt, center * dx)
        self._flying.run(particles, list(velocity))
        after = self._sums(len(before))
        has, missing = _about_center(after), drift - after[:, 4:7] / number
        rigid, turn = _turning(after, had, had - has)
        least, most = (rigid * had).sum(axis=1), _about_mean(before)
        now = _about_mean(after) + (turn * (had + has)).sum(axis=1)
        share = np.sqrt(np.clip((most - least) / np.maximum(now - least, 1e-30), 0.0, 1.0))[:, None]
        if self._settles:
            share[:] = 1.0
        push, turn = share * missing + (1.0 - share) * drift, share * turn + (1.0 - share) * rigid
        share[after[:, kernels.LEAVES] > 0.0] = -1.0  # the body meets a wall in this step
        shift, center = center + drift - after[:, 1:4] / number, center + drift
        self._copy_to_kernels(
            shift * dx, push * dx / dt, turn / dt, center * dx, np.repeat(share, 3, axis=1)
        )
        self._landing.run(particles)

    def _board(self, particles: Particles) -> int:
        """List the bodies' particles, and the body of each; return their number."""
        self._boarding.run(particles)
        self._count.changed()
        count, body_of_tree = int(self._count.numpy()[1]), self._numbers.of_tree
        if body_of_tree is None:
            return count
        who, tree = (found.numpy() for found in (self._who, self._body))
        body = body_of_tree[tree[:count]]
        flying = np.flatnonzero(body >= 0)
        who[: len(flying)], tree[: len(flying)] = who[flying], body[flying]
        if self.grid.device.is_cuda:
            self._who.assign(who)
            self._body.assign(tree)
        return len(flying)

    def _sums(self, bodies: int) -> Sums:
        """Return the sums over each body of the last launch, as integers in quanta.

        They include the particles of all processes.
        """
        whole, several = self._flight.sums.numpy()[:bodies], self._numbers.several
        if several:  # the same on all ranks
            whole = np.concatenate([self.grid.part.ranks.sum(whole[:several]), whole[several:]])
        sums: np.ndarray = whole.astype(np.float64)
        sums[:, 1 : kernels.LEAVES] /= self._quanta.value
        return sums

    def _copy_to_kernels(self, *vectors: np.ndarray) -> None:
        """Copy vectors of each body, shape (bodies, 3) each, to the kernels' memory."""
        for number, values in enumerate(vectors):
            self._vectors[: len(values), number] = values
        if self.grid.device.is_cuda:
            self._motion.assign(self._vectors)

    def _add(self, kernel: wp.Kernel, particles: Particles, inputs: Sequence[object]) -> None:
        """Launch a kernel that sums over the bodies' particles."""
        flight = self._flight
        given = [self._who, flight, self._rate, self._quanta, particles.velocity, *inputs]
        launch_list(
            kernel, int(self._list.count.value), given, device=self.grid.device, ordered=True
        )

    def _carry(self, kernel: wp.Kernel, inputs: Sequence[object]) -> None:
        """Launch a kernel that moves the bodies' particles."""
        flight, count = self._flight, int(self._list.count.value)
        launch_list(
            kernel, count, [self._who, flight, *inputs], device=self.grid.device, cost=PARTICLE
        )


def _about_center(sums: Sums) -> np.ndarray:
    """Return the angular momenta of bodies about their centers, shape (bodies, 3)."""
    x, y, z, u, v, w = sums[:, 1:7].T
    orbital = np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)
    momenta: np.ndarray = sums[:, 7:10] - orbital / np.maximum(sums[:, :1], 1.0)
    return momenta


def _about_mean(sums: Sums) -> np.ndarray:
    """Return the sums of squared velocities relative to the bodies' means.

    The shape is (bodies,).
    """
    of_mean = (sums[:, 4:7] ** 2).sum(axis=1) / np.maximum(sums[:, 0], 1.0)
    squares: np.ndarray = sums[:, 16] - of_mean
    return squares


def _turning(sums: Sums, *momenta: np.ndarray) -> list[np.ndarray]:
    """Return the rigid rotations with given angular momenta about the bodies' centers.

    The unit is that of cells and steps; the shape is (bodies, 3) each.
    """
    least, center = (
        NARROW * np.maximum(sums[:, :1], 1.0),
        sums[:, 1:4] / np.maximum(sums[:, :1], 1.0),
    )
    moments = sums[:, SECOND_MOMENTS].reshape(-1, 3, 3) - sums[:, 1:4, None] * center[:, None, :]
    trace = moments[:, 0, 0] + moments[:, 1, 1] + moments[:, 2, 2]
    values, axes = np.linalg.eigh(trace[:, None, None] * np.eye(3) - moments)
    inverse = (
        axes * np.where(values > least, 1.0 / np.maximum(values, least), 0.0)[:, None, :]
    ) @ axes.swapaxes(1, 2)
    return [(inverse @ momentum[:, :, None])[:, :, 0] for momentum in momenta]
