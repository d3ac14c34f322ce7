"""Stress of sand: pressure and friction, solved together."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.granular.bodies import SandBodies
from warp_lcp.granular.bodies_kernels import forget_kernel
from warp_lcp.granular.cut_walls import WALL_FACE, cut_kind
from warp_lcp.granular.fields import StressFields, VelocityFields
from warp_lcp.granular.packing import REACH, SHEARS, Packing
from warp_lcp.granular.stress_kernels import (
    BETA_X,
    NEXT_X,
    PERIOD,
    RESIDUAL_X,
    REST,
    SHARE,
    STATE,
    keep_step_kernel,
    momentum_kernel,
    numbers_kernel,
    period_kernel,
    stress_passes,
)
from warp_lcp.granular.stress_layout import COLUMNS, LOOKAHEAD, NUMBERS, PRESSURE_STEP, SHEAR_STEP
from warp_lcp.granular.wall_friction import SandWalls
from warp_lcp.grid.staggered import three_components
from warp_lcp.kernels import Rows
from warp_lcp.kernels.launch_graph import (
    CommandBuffer,
    Launch,
    LaunchGraph,
    copy,
    launch,
    launch_now,
)
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.kernels.vectors import Reduction, sum_over_ranks
from warp_lcp.settings import renamed_method

WALL_GRAIN = 256  # wall faces per CPU thread
# Estimate of the velocity's error: factor, and least error of the stresses [rho g dx].
ERROR_SHARE, UNSURE_WEIGHTS = 0.5, 0.5
MOST_MOMENTUM = 0.985  # default limit of the momentum
GROWN = 1.5  # if forces act longer than this times the last step, old stresses are no good guess


@dataclass(frozen=True)
class YieldSet:
    """Yield set of sand: |s|_F / sqrt(2) <= k x + cohesion, x >= -tension.

    Stresses are impulses over rho dx [m/s]. With `gain`, friction grows with the shear rate: k
    becomes k + gain e / (e + halfway sqrt(x)), e = |shear rate| dx [m/s], which is mu(I)
    [Jop, Forterre & Pouliquen 2006].

    Attributes:
        k: slope of the cone, see `granular.materials.slope`.
        cohesion: cohesion of cells that have shear stress.
        tension: tensile strength of cells that are nearly full.
        gain: largest increase of k; used only if the stresses were created with `rate`.
        halfway: e / sqrt(x) [sqrt(m/s)] at which half of that is gained.
    """

    k: float
    cohesion: float = 0.0
    tension: float = 0.0
    gain: float = 0.0
    halfway: float = 0.0


class Velocity:
    """Velocity and strain rates under a stress, in one precision.

    Attributes:
        u: velocity of each component [m/s].
        edge: values of each shear on edges: first the shear stress, then twice the shear rate times
            dx [m/s].
    """

    def __init__(self, packing: Packing, real: type, *, box: bool, rate: bool) -> None:
        grid = packing.grid
        self.packing, self.real, self.box, self.rate = packing, real, box, rate
        self.u = grid.faces(real)
        self.edge = [grid.field(real) for _ in SHEARS[grid.dimension]]
        self.openings = None if packing.cut is None else packing.cut.openings
        self.passes = stress_passes(
            grid.dimension, real, box=box, rate=rate, cut=cut_kind(packing.cut)
        )

    @property
    def fields(self) -> VelocityFields:
        """Return the fields as a kernel struct."""
        return VelocityFields(
            *[*three_components(self.u), *three_components(self.edge), self.openings]
        )

    def find(
        self,
        stress: wp.array,
        *,
        launch: Launch = launch_now,
        bodies: SandBodies | None = None,
        respond: bool = False,
    ) -> None:
        """Compute velocity and rates of strain under a field of stresses.

        Args:
            stress: the stresses.
            launch: launches or records.
            bodies: bodies whose velocity is set on their faces.
            respond: first update the bodies' velocity from the stresses.
        """
        p, passes, sand, fields = self.packing, self.passes, self.packing.fields, self.fields
        p.join(stress, launch=launch)
        p.stressed.run(passes.edge_stress, sand, fields, launch=launch, y=stress)
        p.moved.run(passes.face_velocity, sand, fields, launch=launch, y=stress)
        if bodies is not None:
            if respond:
                bodies.respond(p, stress, launch, implicit=False)
            bodies.move(self, launch)
        if p.sides is not None:
            p.sides.wrap(*self.u, launch=launch)
        p.strained.run(passes.edge_strain, sand, fields, launch=launch)


class Stress(wl.VariationalInequality):
    """Variational inequality of pressure and friction of sand for a given packing.

    With x = kick_dt p / (rho dx), s scaled in the same way, and u = u* + (1/m) (-grad x + div s) on
    faces of mass m, the stress is the solution of

        0 <= x  complementary to  w = drive + div(m' u) >= 0,
        s = the nearest point of the yield set at x to s + r E u,

    for any r > 0, with drive of `granular.packing.Packing`, and m' = m in loose cells and 1 in full
    ones [Narain, Golas & Lin 2010; Daviet & Bertails-Descoubes 2016]. So the density of sand never
    exceeds 1, and friction dissipates as much energy as it can. In a cell |n|^2 / 2 + sum over
    shears of max_q b_q^2 <= (k x + cohesion)^2. On a face of a solid the shear stress is within mu
    times the normal load (Coulomb), and within the strength of the sand beside it: against a
    rougher wall the sand itself fails (snippet `wall_bound` of `headers/sand.h`).

    This is a quasi-variational inequality, over the product of x >= 0 and the slices of the cones
    that contain each cell's s at its x. Its natural residual is the norm of (x, s) - P((x, s) -
    y/d), with y = (w, -E u), where P projects onto x >= 0 first and then onto the slice at that x.
    P is not the projection onto the cones themselves, which would make sand dilate as it shears (an
    associated flow rule, whose normal velocity is k times the slip). `wl.solve` solves the problem
    by the methods of `granular.stress_methods`. Gradient, projection and momentum of a cell are
    fused in one kernel (`granular.stress.step` in `headers/stress.h`), so that there are no
    separate functions for y and P.

    Args:
        packing: the packing of the step.
        walls: faces between sand and solids.
        box: bound each part of the friction separately, as Narain et al. do; else the cone.
        rate: friction grows with the shear rate, see `YieldSet`.
        bodies: rigid bodies that the stresses move, if any.

    Attributes:
        now: the stresses, see `granular.stress_layout`, float32.
        kick_dt: time that forces acted in the step of these stresses [s]; 0 before the first step.
        cold: whether forces act for much longer in the current step than in the last one, as in the
            first two steps.
        checked: velocity under the stresses, in float64, from the last `residual`.
        last_residual: residual of pressure and friction [m/s].
        mean_stress: root mean square of the stresses in that residual [m/s].
        velocity_error: estimate of the root mean square error of the velocity under the stresses of
            that residual [m/s], see `take_residual`.
        steps_taken: steps of the method since `begin`.
    """

    def __init__(
        self,
        packing: Packing,
        walls: SandWalls,
        *,
        box: bool = False,
        rate: bool = False,
        bodies: SandBodies | None = None,
    ) -> None:
        grid, self.packing, self.walls, self.box, self.rate, self.bodies = (
            packing.grid,
            packing,
            walls,
            box,
            rate,
            bodies,
        )
        self.shared, self._comm = grid.part.shared, grid.part.comm
        normals, shears = (3, 3) if grid.dimension == 3 else (1, 1)
        tractions = 0 if packing.cut is None else grid.dimension
        shape = (1 + normals + 4 * shears + tractions, *grid.shape)
        self.now, self._before, self._point = (
            wp.zeros(shape, dtype=wp.float32, device=grid.device) for _ in range(3)
        )
        self.velocity, self.checked = (
            Velocity(packing, real, box=box, rate=rate) for real in (wp.float32, wp.float64)
        )
        self.numbers = wp.zeros(NUMBERS, dtype=wp.float32, device=grid.device)
        self.momentum = wp.zeros(STATE, dtype=wp.float64, device=grid.device)
        self._sums = wp.zeros(2 * COLUMNS, dtype=wp.float64, device=grid.device)
        # Sums over all ranks.
        self.total = self._sums if self._comm is None else wp.zeros_like(self._sums)
        # `cells` for kernels.
        self.counts = (
            wp.zeros(1, dtype=wp.float64, device=grid.device) if self.shared else packing.counts
        )
        self._nothing = wp.zeros_like(self._sums)
        # Sums by the steps of a period.
        self._found = wp.zeros((PERIOD, 2 * COLUMNS), dtype=wp.float64, device=grid.device)
        threads = int(np.prod(packing.grid.shape[:2])) * packing.counted.cells.chunks
        self._cell_sums = Reduction(
            grid.size, grid.device, self._sums, columns=COLUMNS, threads=threads
        )
        self._wall_sums: Reduction | None = None
        # On the CPU these are views of the device arrays.
        self._host, self._host_momentum = self.numbers.numpy(), self.momentum.numpy()
        self._program: CommandBuffer | None = None  # a period of steps with momentum
        self._check: CommandBuffer | None = None  # evaluation of the residual
        self._cells: int | None = 1  # None until it is read after `begin`
        self._yields = [Scalar() for _ in range(NUMBERS - 3)]  # arguments of `numbers_kernel`
        self.last_residual = 0.0, 0.0
        self.mean_stress, self.velocity_error, self.steps_taken = 0.0, 0.0, 0
        self.kick_dt, self.cold = 0.0, True
        self._last, self._last_kick = wp.zeros_like(self.now), 0.0  # before `begin`
        self._ratio = Scalar()  # ratio of this step's `kick_dt` to the last one
        self._admitting, self._restarting = (
            LaunchGraph(grid.device, record, at_once=grid.part.at_once)
            for record in (self._launch_admission, self.start_from_now)
        )
        self.set_walls(walls)

    def set_walls(self, walls: SandWalls) -> None:
        """Replace the walls after solids have moved."""
        device = self.packing.grid.device
        self.walls, self._program, self._check = walls, None, None
        self._admitting.forget()
        self._sums.zero_()
        self._grain = 1 if device.is_cuda else WALL_GRAIN
        cut = self.packing.cut
        threads = sum(
            -(-count // self._grain) for count in (walls.count, cut.count if cut is not None else 0)
        )
        self._wall_sums = (
            Reduction(max(threads, 1), device, self._sums, columns=COLUMNS, threads=threads)
            if threads
            else None
        )

    def forget_tractions(self, cells: np.ndarray) -> None:
        """Set the wall friction to 0 in cells that moving walls have left.

        Args:
            cells: flat indices, shape (n,).
        """
        if len(cells) == 0:
            return
        grid = self.packing.grid
        first = self.now.shape[0] - grid.dimension
        slots = (np.arange(first, first + grid.dimension)[:, None] * grid.size + cells).ravel()
        device = grid.device
        listed = wp.array(slots, dtype=wp.int32, device=device)
        fields = [field.flatten() for field in (self.now, self._before, self._point)]
        wp.launch(forget_kernel, len(slots), [listed, *fields], device=device)

    def begin(self, bound: YieldSet, gravity: np.ndarray, dt: float, kick_dt: float) -> None:
        """Start from the last stresses, in cells that allow them in the new packing.

        The stresses of the last step are scaled by the ratio of the times that forces act, damped
        in the checkerboard pattern, and set to 0 in cells that cannot have stress in the new
        packing.

        Args:
            bound: yield set of the sand.
            gravity: [m/s^2], three entries.
            dt: time step [s].
            kick_dt: time that forces act in the step [s]; stresses are impulses and are rescaled
                from the last step's pressure.
        """
        self._last_kick, self.steps_taken = self.kick_dt, 0
        before = bound.k, bound.cohesion, bound.tension, *map(float, gravity * kick_dt)
        ratio = kick_dt / self.kick_dt if self.kick_dt > 0.0 else 1.0
        unsure = UNSURE_WEIGHTS * float(np.linalg.norm(gravity)) * kick_dt
        after = dt / self.packing.grid.spacing, bound.gain, bound.halfway, ratio, unsure
        self._host[:] = *before, 1.0, 1.0, 0.0, *after
        if self.packing.grid.device.is_cuda:
            for number, value in zip(self._yields, (*before, *after), strict=True):
                number.value = value
        self._cells = None
        if self.shared:
            self.packing.find_ghosts(self.now.shape[0])
            self.counts.fill_(self.cells)
        self.cold = kick_dt > GROWN * self.kick_dt
        self._ratio.value = ratio
        self._admitting.run()
        self.kick_dt = kick_dt
        # Ghost cells without sand have lost their stresses, too.
        self.packing.grid.part.fill(self.now, width=REACH)

    def _launch_admission(self) -> None:
        """Launch the transfer of the last stresses to the new packing.

        They are rescaled, set to 0 where the packing allows none, and damped in the checkerboard.
        """
        p, sand, stresses = self.packing, self.packing.fields, self._fields
        if p.grid.device.is_cuda:  # on the CPU the arrays share the host's memory
            launch(numbers_kernel, 1, [self.numbers, *self._yields], device=p.grid.device)
        copy(self._last, self.now)
        self.walls.activate(p.flags)
        p.counted.run(self.velocity.passes.admit, sand, stresses, ratio=self._ratio)
        if self.bodies is not None:
            self.bodies.forget(stresses)
        p.join(self._point)
        p.counted.run(self.velocity.passes.damp, sand, stresses, source=self._point)

    def _count(self) -> int:
        """Return the number of cells with sand on all ranks."""
        return int(self.packing.grid.part.ranks.sum(self.packing.sand_cells))

    @property
    def cells(self) -> int:
        """Number of cells with sand, at least 1; may wait for the device."""
        if self._cells is None:
            self._cells = max(self._count(), 1)
        return self._cells

    def _upload(self, array: wp.array, host: np.ndarray) -> None:
        """Copy host values to a device array; on the CPU they share memory."""
        if self.packing.grid.device.is_cuda:
            array.assign(host)

    def roll_back(self) -> None:
        """Restore the stresses before `begin`, for a step that is rejected."""
        wp.copy(self.now, self._last)
        self.kick_dt = self._last_kick

    def restart(
        self, *, pressure_step: float, shear_step: float, lookahead: float, momentum: float
    ) -> None:
        """Restart the steps with momentum.

        Args:
            pressure_step: length of the projected gradient step, relative to the diagonal.
            shear_step: likewise for the shear stresses.
            lookahead: point of the gradient, in units of the momentum's displacement.
            momentum: initial limit of the momentum, the fraction of the last step that is repeated.
        """
        self.set_steps(pressure_step, shear_step, lookahead)
        self._upload(self.numbers, self._host)
        state = self._host_momentum
        state[:] = 0.0
        state[[BETA_X, BETA_X + 1]] = momentum
        state[[NEXT_X, NEXT_X + 1]] = 0.25
        state[REST] = 1.0 - MOST_MOMENTUM
        self._upload(self.momentum, state)
        self._restarting.run()

    def set_steps(self, pressure_step: float, shear_step: float, lookahead: float) -> None:
        """Set the lengths of steps on the host; see `restart`.

        The bodies' response to a step depends on them.
        """
        self._host[[PRESSURE_STEP, SHEAR_STEP, LOOKAHEAD]] = pressure_step, shear_step, lookahead
        if self.bodies is not None:
            self.bodies.prepare(pressure_step=pressure_step, shear_step=shear_step)

    def start_from_now(self) -> None:
        """Reset the momentum to the current stresses; launches or records."""
        for stress in (self._point, self._before):
            copy(stress, self.now)

    def limit_momentum(self, momentum: float) -> None:
        """Limit all later momenta to `momentum`."""
        state = self.momentum.numpy().copy()
        state[BETA_X : NEXT_X + 2] = np.minimum(state[BETA_X : NEXT_X + 2], momentum)
        state[REST] = 1.0 - momentum
        self.momentum.assign(state)

    face = renamed_method("face", set_walls)
    take_back = renamed_method("take_back", roll_back)
    calm = renamed_method("calm", limit_momentum)

    def advance(self, periods: int) -> float:
        """Run several periods of steps; return an estimate of the residual [m/s].

        See `PERIOD`; the steps have momentum.
        """
        program = self.period()
        for _ in range(periods):
            program.run()
        pressure, friction = self.momentum.numpy()[[RESIDUAL_X, RESIDUAL_X + 1]]
        pressure, friction = (
            pressure / self._host[PRESSURE_STEP],
            SHARE * friction / self._host[SHEAR_STEP],
        )
        return float(
            1.0 / math.sqrt(self.cells) * math.sqrt(pressure * pressure + friction * friction)
        )

    def period(self) -> CommandBuffer:
        """Return the program of `PERIOD` steps with momentum, for the current walls."""
        if self._program is None:
            self._program = CommandBuffer(self.packing.grid.device)
            for step in range(PERIOD):
                self._record(step, self._program.launch)
        return self._program

    def _record(self, step: int, launch: Launch) -> None:
        self.velocity.find(self._point, launch=launch, bodies=self.bodies)
        if self.bodies is not None:
            self.bodies.search(self.packing, self.velocity, self._fields, launch)
        self._project(self.velocity, launch)
        self._end_step(step, launch)

    def _end_step(self, step: int, launch: Launch) -> None:
        """Sum the results of a step of a period, and update the momentum.

        The momentum changes by these sums only once per period, so ranks exchange them once per
        period.
        """
        self._add_up_here(launch)
        if self._comm is None:
            self._choose_momentum(self.total, launch)
            return
        device, last = self.packing.grid.device, step == PERIOD - 1
        launch(keep_step_kernel, 2 * COLUMNS, [self._sums, self._found, step], device=device)
        if last:
            sum_over_ranks(self._comm, self._found.flatten(), slice(None), launch)
            launch(period_kernel, COLUMNS, [self._found, self.total], device=device)
        self._choose_momentum(self.total if last else self._nothing, launch)

    def _choose_momentum(self, sums: wp.array, launch: Launch) -> None:
        launch(momentum_kernel, 1, [sums, self.momentum], device=self.packing.grid.device)

    def residual(self) -> tuple[float, float]:
        """Return the natural residual of pressure and friction [m/s], in float64.

        Root mean squares over the cells that hold sand.
        """
        self.check().run()
        sums = self.total.numpy()
        return self.take_residual(
            sums[0], sums[1] + sums[COLUMNS], sums[2], sums[3] + sums[COLUMNS + 3]
        )

    def check(self) -> CommandBuffer:
        """Return the program that writes the sums of the residual to `total`."""
        if self._check is None:
            self._check = CommandBuffer(self.packing.grid.device)
            self.checked.find(self.now, launch=self._check.launch, bodies=self.bodies, respond=True)
            self._project(self.checked, self._check.launch)
            self._add_up(self._check.launch)
        return self._check

    def take_residual(
        self, pressure: float, friction: float, stresses: float, work: float
    ) -> tuple[float, float]:
        """Return the residual [m/s] from sums of the device over cells and walls.

        Let y* be the solution, y the stresses with velocity u, and e = y - P(y - D^-1 G(y)). If the
        bound of the friction is held, the problem is a monotone variational inequality with the
        matrix A = C M^-1 B, and adding its inequalities at y* and at y - e gives

            |u - u*|_M^2 = |y - y*|_A^2 <= <D e, y - y*> + <A e, y - y*> - <D e, e>.

        So the error of the velocity is of the size of the root of the residual times the error of
        the stresses. The latter is taken to be the change of the stresses in the time step plus
        half of the weight of a cell, since an error may persist from step to step:

            velocity_error = ERROR_SHARE sqrt(sum of D |e| (|y - y_past| + unsure) / cells).

        This is calibrated against 49 solutions by a proximal Newton method, of 2-D collapses,
        silos and bins: the error, with the masses of the faces as weights, was 0.24 to 1.9 times
        the estimate. On 47 other steps, spread over collapses at 120 and 240 cells that end at
        0.05 g dt, it was 0.18 to 1.6 times the estimate, 44 were within 0.05, and all within 0.072.

        Args:
            pressure: sum of the squared residual of the pressure [m^2/s^2].
            friction: likewise of the friction.
            stresses: sum of the squared stresses [m^2/s^2].
            work: sum of D |e| (|y - y_past| + unsure) [m^2/s^2].
        """
        self.last_residual = math.sqrt(pressure / self.cells), math.sqrt(friction / self.cells)
        self.mean_stress = math.sqrt(stresses / self.cells)
        self.velocity_error = ERROR_SHARE * math.sqrt(work / self.cells)
        return self.last_residual

    def _project(self, velocity: Velocity, launch: Launch) -> None:
        """Launch projected steps of cells and wall faces, or their natural residual.

        With `self.velocity` in float32 it is a step; with `self.checked` in float64 the distance
        that a step would move the stresses.
        """
        p, walls, passes = self.packing, self.walls, velocity.passes
        structs = (p.fields, velocity.fields, self._fields)
        p.counted.run(passes.step, *structs, launch=launch, partials=self._cell_sums.partials)
        if self._wall_sums is not None:
            partials = self._wall_sums.partials
            if walls.count:
                rows = Rows.entries(walls.count, p.grid.device, self._grain, weight=WALL_FACE)
                passes.wall.bind(
                    rows, *structs, walls.faces, active=walls.active, behind=0, partials=partials
                ).launch(launch)
            if p.cut is not None:
                p.cut.project(p, velocity, self._fields, partials, self._grain, launch)

    @property
    def _fields(self) -> StressFields:
        return StressFields(
            self.now, self._before, self._point, self._last, self.momentum, self.numbers
        )

    def _add_up(self, launch: Launch) -> None:
        """Launch the sums over cells and walls of all ranks."""
        self._add_up_here(launch)
        if self._comm is not None:
            launch(
                keep_step_kernel,
                2 * COLUMNS,
                [self._sums, self.total.reshape((1, -1)), 0],
                device=self.packing.grid.device,
            )
            sum_over_ranks(self._comm, self.total, slice(None), launch)

    def _add_up_here(self, launch: Launch) -> None:
        self._cell_sums.add_up(0, COLUMNS, launch=launch)
        if self._wall_sums is not None:
            self._wall_sums.add_up(COLUMNS, COLUMNS, launch=launch)
