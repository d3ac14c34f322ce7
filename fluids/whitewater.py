"""Whitewater: spray, foam and bubbles as passive particles of a liquid [Ihmsen et al. 2012].

After a step, each liquid cell emits particles at a rate per volume where liquid meets liquid, and
per area at wave crests; both rates grow with the kinetic energy. Velocities and the surface are
compared over a fixed length, by random points of the cells, so the amount depends neither on the
cells nor on the steps. The particles do not act on the liquid.

On ranks, each rank emits in the cells of its box and moves the particles in it. The ghost layers
reach as far as the compared points. After a step each particle goes to the rank of its cell.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_lcp.fluids import whitewater_kernels as kernels
from warp_lcp.grid.cell_kernel import launch_list, scan
from warp_lcp.grid.grid_part import ParticleExchange, SerialCommunicator, subdomain_of
from warp_lcp.grid.particle_loops import MARGIN, PARTICLE
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.kernels.launch_graph import clear
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.material.boundary import Boundary
from warp_lcp.material.particle_log import Row
from warp_lcp.material.particle_pieces import PASSIVE, Piece, passive_arrays
from warp_lcp.simulation import Points

if TYPE_CHECKING:
    from warp_lcp.distributed.ranks import Ranks
    from warp_lcp.fluids.scene import LiquidScene
    from warp_lcp.fluids.simulator import LiquidSimulation

# Half the thickness of the foam: a part of `length`, but at most as far as phi is known [cells].
LAYER, LAYER_CELLS = 1.0 / 16.0, 0.5
FAR = 1e9  # [m]
MOST_NEW = 2**30  # expected bound of the new particles of a step; their sums are 32-bit integers
SAMPLE_SPACING = 0.6  # mean distance of sampled cells in a step, relative to `length`
KINDS = ("spray", "foam", "bubbles")  # of the log's columns, in the order of the kernels' numbers
COLUMNS = (*(f"whitewater_{kind}" for kind in KINDS), "whitewater_removed")
# Names of the particles' arrays in a checkpoint; `kept` is age, life [s] and kind.
STATE = dict(zip(PASSIVE, ("position", "velocity", "kept"), strict=True))


def directions(dimension: int) -> np.ndarray:
    """Return the unit vectors to compared points, float32, shape (n, 3).

    2-D: a regular octagon. 3-D: the corners of an icosahedron, over which means of polynomials up
    to degree 5 are those over the sphere.
    """
    if dimension == 2:
        angle = np.arange(8) * (2.0 * np.pi / 8)
        return np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1).astype(np.float32)
    golden = 0.5 * (1.0 + np.sqrt(5.0))
    corners = [
        np.roll([0.0, one, other], turn)
        for turn in range(3)
        for one in (-1.0, 1.0)
        for other in (-golden, golden)
    ]
    return (np.array(corners) / np.hypot(1.0, golden)).astype(np.float32)


def oldest(
    state: np.ndarray, position: np.ndarray, count: int, ranks: SerialCommunicator | Ranks
) -> np.ndarray:
    """Return which particles of this process are among the oldest of all; collective.

    Of equal ages those with the least life come first, then those with the least position. These
    numbers are particles' own, so that the choice does not depend on their order or process.

    Args:
        state: age, life [s] and kind, shape (n, 3).
        position: [m], shape (n, 3).
        count: number of the oldest particles, at most that of all processes.
        ranks: the communicator of the processes.

    Returns:
        Indices in [0, n).
    """
    age, own = state[:, 0], np.arange(len(state))
    if count < len(age):  # the own oldest, with all of the last one's age
        own = np.flatnonzero(age >= -np.partition(-age, count - 1)[count - 1])
    keys = np.column_stack([-age[own], state[own, 1], position[own]])
    everyone = ranks.collect(keys)
    rank = np.repeat(np.arange(len(everyone)), [len(rows) for rows in everyone])
    index = np.concatenate([np.arange(len(rows)) for rows in everyone])
    first = np.lexsort(np.concatenate(everyone).T[::-1])[:count]
    chosen: np.ndarray = own[index[first[rank[first] == ranks.rank]]]
    return chosen


class Whitewater:
    """Diffuse particles of a liquid, and their emission.

    The arrays of a grid are set by `allocate`; the particles stay if the grid changes. On ranks the
    particles are those in this rank's box, and `advance`, `migrate` and `restore_pieces` are
    collective.

    Args:
        scene: a scene with the table [whitewater].
        grid: the first grid.

    Attributes:
        particles: position [m], velocity [m/s], and age, rest of the life [s] and kind in `kept`.
            In one process the oldest come first.
        settings: of the scene, with values for all defaults.
    """

    columns = COLUMNS

    def __init__(self, scene: LiquidScene, grid: StaggeredGrid) -> None:
        settings = scene.resolved_whitewater
        assert settings is not None, "the scene has whitewater"
        self.settings, self._solids = settings, bool(scene.solid)
        nothing = np.zeros((0, 3), dtype=np.float32)
        self.particles = Particles(
            grid, nothing, nothing, affine=False, kept=nothing[:, 0], indexed=False
        )
        # These particles have no ghosts and no order of sums: `migrate` sends them to their ranks.
        self.particles.exchange = ParticleExchange(self.particles)
        self._directions = wp.array(directions(grid.dimension), dtype=wp.vec3, device=grid.device)
        self._counts = DeviceScalar(grid.device, len(KINDS), wp.int32)
        self.removed = 0  # in the last step on all ranks, because there were too many
        self._skipped = 0  # new ones of this rank among them, which were not written

    def allocate(self, grid: StaggeredGrid) -> None:
        """Allocate the fields of a grid: its liquid, and numbers of new particles."""
        if grid is not self.particles.grid:
            self.particles.move_to(grid)
        self.grid = grid
        self._ends, self._centers = grid.field(wp.int32), grid.field(wp.vec4)

    def advance(self, liquid: LiquidSimulation, window: Window, dt: float) -> Row:
        """Emit particles, move all, and remove those whose life has ended.

        The liquid's particles and solids have moved. Its velocity is that of the middle of the
        step, its surface that of the start.

        Args:
            liquid: the simulation.
            window: cells that the liquid could touch at the start of the step.
            dt: time step [s].

        Returns:
            The values of `COLUMNS`, of all ranks.
        """
        fields = self._fields(liquid, window)
        self._emit(fields, window, liquid.step_count, dt)
        particles = self.particles
        if particles.count:
            thin = liquid.boundary.thin
            if thin is not None:
                thin.store_positions(particles.position)
            self._move(fields, liquid.gravity, dt)
            if thin is not None:
                thin.stop(particles.position, still=not liquid.boundary.moves)
            particles.finish_removal(particles.marks)
            if liquid.outlets is not None:
                liquid.outlets.apply(particles, liquid.time - dt, liquid.time)
        self.migrate()
        self._limit()
        return self._row()

    def migrate(self) -> None:
        """Send particles to the ranks that own their cells; collective."""
        if not self.grid.part.shared:
            return
        arrays = {name: array.numpy() for name, array in self.particles.arrays().items()}
        migrated = subdomain_of(self.grid).send_to_owners(arrays)
        if migrated is not None:
            self.particles.assign(migrated)

    def points(self) -> Points:
        """Return the particles for a frame: velocity [m/s], kind (0 to 2, as `KINDS`), age [s]."""
        arrays = {name: array.numpy().copy() for name, array in self.particles.arrays().items()}
        kept = arrays["kept"]
        return Points(
            "whitewater",
            arrays["position"],
            {
                "velocity": arrays["velocity"],
                "kind": kept[:, 2].astype(np.uint8),
                "age": np.maximum(kept[:, 0], 0.0),
            },
        )

    def state(self) -> dict[str, np.ndarray]:
        """Return the arrays of a checkpoint, float32 of shape (n, 3)."""
        arrays = self.particles.arrays()
        return {name: arrays[own].numpy().copy() for name, own in STATE.items()}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from the arrays of `state`.

        Raises:
            ValueError: as of `passive_arrays`.
        """
        arrays = passive_arrays(state)
        self.particles.assign({own: arrays[name] for name, own in STATE.items()})

    def restore_pieces(self, pieces: Sequence[Piece]) -> None:
        """Continue from the particles of all ranks' pieces in this rank's box; collective.

        Raises:
            ValueError: as of `passive_arrays`; on all ranks.
        """
        found = subdomain_of(self.grid).rows_of_pieces(pieces, list(STATE))
        self.particles.assign({own: found[name] for name, own in STATE.items()})

    def _fields(self, liquid: LiquidSimulation, window: Window) -> kernels.LiquidFields:
        """Return the liquid's fields as kernels take them."""
        grid, boundary, fields = self.grid, liquid.boundary, kernels.LiquidFields()
        velocity, phi = liquid.velocity, liquid.surface.phi
        assert phi is not None, "whitewater needs a level set"
        clear(self._centers)
        # In 2-D the third component is not read.
        # Later models of the step may have left other values in ghost cells.
        grid.part.fill(*velocity, phi)
        components = [velocity[0], velocity[1], velocity[-1]]
        window.launch(kernels.center_kernel, [grid.planes, *components, phi, self._centers])
        fields.planes, fields.dx = grid.planes, grid.spacing
        fields.origin = wp.vec3i(*grid.origin)
        fields.low, fields.high = (wp.vec3(*corner) for corner in self._limits(boundary))
        fields.centers, fields.base = self._centers, boundary.base
        # Arrays that the kernels do not read with these walls are others of their type.
        fields.distance = phi if boundary.distance is None else boundary.distance
        fields.room = boundary.base if boundary.room is None else boundary.room
        whole = kernels.CELLS if self._solids else kernels.NONE
        fields.walls = kernels.CUT if boundary.room is None else whole
        return fields

    def _limits(self, boundary: Boundary) -> tuple[list[float], list[float]]:
        """Return the smallest and largest coordinates of particles [m], far away at open sides.

        In 2-D z is not limited: it stays 0.
        """
        margin, low, high = MARGIN * self.grid.spacing, [-FAR] * 3, [FAR] * 3
        for axis in range(self.grid.dimension):
            if not boundary.open_sides >> (2 * axis) & 1:
                low[axis] = margin
            if not boundary.open_sides >> (2 * axis + 1) & 1:
                high[axis] = float(self.grid.extent[axis]) - margin
        return low, high

    @property
    def layer(self) -> float:
        """Half the thickness of the foam [m]."""
        assert self.settings.length is not None
        return min(LAYER * self.settings.length, LAYER_CELLS * self.grid.spacing)

    def _emission(self, step: int, dt: float) -> kernels.EmissionSettings:
        """Return the numbers of the emission of a step."""
        settings, grid, numbers = self.settings, self.grid, kernels.EmissionSettings()
        assert settings.length is not None
        assert settings.trapped_air_rate is not None and settings.crest_rate is not None
        assert settings.speed is not None and settings.trapped_air is not None
        numbers.seed, numbers.step, numbers.count = settings.seed, step, len(self._directions)
        numbers.directions = self._directions
        numbers.reach = settings.length / grid.spacing
        # As many samples a volume on all grids: cost and noise do not depend on the cells.
        numbers.spread = max(SAMPLE_SPACING * settings.length / grid.spacing, 1.0)
        numbers.share = numbers.spread**-grid.dimension
        # The sum over all sampled cells stays far below 2^31, also where more than expected are.
        numbers.most = MOST_NEW // (int(numbers.share * math.prod(grid.shape)) + 100)
        volume, area = grid.cell_volume, grid.spacing ** (grid.dimension - 1)
        numbers.trapped = settings.trapped_air_rate * volume * dt / numbers.share
        numbers.crest = settings.crest_rate * area * dt / numbers.share
        numbers.trapped_air_range = wp.vec2(*settings.trapped_air)
        numbers.crest_range = wp.vec2(*settings.crest)
        numbers.energy_range = wp.vec2(*(0.5 * speed**2 for speed in settings.speed))
        numbers.layer, numbers.lifetime = self.layer / grid.spacing, settings.lifetime
        numbers.dt, numbers.youngest = dt, 1.0
        return numbers

    def _emit(self, fields: kernels.LiquidFields, window: Window, step: int, dt: float) -> None:
        """Add the new particles of a step, in the order of cells; collective.

        If there are more than `max_particles` on all ranks, each cell writes only the youngest of
        its own: others would be removed at the end of the step.
        """
        own = self.grid.part.near(window, 0)  # other ranks emit in their own cells
        numbers, most = self._emission(step, dt), self.settings.max_particles
        drawn = written = self._count(own, fields, numbers)
        everyone = int(self.grid.part.ranks.sum(drawn))
        if everyone > most:
            numbers.youngest = most / everyone
            written = self._count(own, fields, numbers)
        self._skipped = drawn - written
        if own is not None and written:
            old = self.particles.make_room(written)
            inputs = [fields, numbers, self._ends, old, *self.particles.arrays().values()]
            own.launch(kernels.emit_kernel, inputs)

    def _count(
        self, own: Window | None, fields: kernels.LiquidFields, numbers: kernels.EmissionSettings
    ) -> int:
        """Sum up the cells' numbers of new particles in `_ends`; return the last sum."""
        if own is None:
            return 0
        clear(self._ends)
        own.launch(kernels.count_kernel, [fields, numbers, self._ends])
        flat = self._ends.flatten()
        scan(flat, flat, inclusive=True)
        return int(flat[-1:].numpy()[0])

    def _move(self, fields: kernels.LiquidFields, gravity: np.ndarray, dt: float) -> None:
        """Launch the motion of the particles, and the removal of those that it marks."""
        settings, particles, numbers = self.settings, self.particles, kernels.MotionSettings()
        size = float(np.linalg.norm(gravity)) or 9.81
        numbers.dt, numbers.layer, numbers.gravity = dt, self.layer, wp.vec3(*gravity)
        numbers.buoyancy = wp.vec3(*(-settings.buoyancy * gravity))
        # The drag that balances buoyancy at `rise_speed`; bubbles without buoyancy follow as fast.
        numbers.bubble_rate = (settings.buoyancy or 1.0) * size / settings.rise_speed
        numbers.air_rate = settings.air_drag
        inputs = [fields, numbers, *particles.arrays().values(), particles.marks]
        launch_list(
            kernels.advance_kernel, particles.count, inputs, device=self.grid.device, cost=PARTICLE
        )
        particles.launch_removal(particles.marks)

    def _limit(self) -> None:
        """Remove the oldest particles if there are more than `max_particles`; collective."""
        particles, ranks = self.particles, self.grid.part.ranks
        surplus = max(int(ranks.sum(particles.count)) - self.settings.max_particles, 0)
        self.removed = surplus + int(ranks.sum(self._skipped))
        if surplus:
            state, position = (particles.arrays()[name].numpy() for name in ("kept", "position"))
            marks = np.zeros(particles.count, dtype=np.int32)
            marks[oldest(state, position, surplus, ranks)] = 1
            if particles.count:
                particles.marks.assign(marks)
                particles.remove(particles.marks)

    def _row(self) -> Row:
        """Return the values of `COLUMNS`, summed over ranks; collective."""
        particles, counts = self.particles, self._counts
        clear(counts.array)
        if particles.count:
            launch_list(
                kernels.tally_kernel,
                particles.count,
                [particles.kept, counts.array],
                device=self.grid.device,
                ordered=True,
            )
        counts.changed()
        everyone = self.grid.part.ranks.sum(counts.numpy())
        values = [*everyone.tolist(), self.removed]
        return dict(zip(COLUMNS, values, strict=True))
