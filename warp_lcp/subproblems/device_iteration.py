"""Device-resident iteration of projected multigrid.

The device, a GPU or the threads of the CPU, begins a solve and takes truncated steps as long as the
host has nothing to decide.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, no_type_check

import numpy as np
import warp as wp

from warp_lcp.kernels import Rows
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.fields import zeros
from warp_lcp.kernels.launch_graph import (
    CommandBuffer,
    Conditional,
    Launch,
    LaunchGraph,
    copy,
    launch,
    loops_on_device,
)
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import CONVERT, sum_over_ranks
from warp_lcp.multigrid.cycle_passes import CLEAR
from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.operators.grid_poisson import GridPoisson
from warp_lcp.problem.method_protocol import Precision
from warp_lcp.problem.operator_protocol import Scratch
from warp_lcp.problem.stopping import MeanCriteria, StoppingCriteria
from warp_lcp.subproblems.energy_monitor import CREEP, STALL
from warp_lcp.subproblems.grid_step_kernels import (
    CARRY,
    ENERGY,
    MOVED,
    NORM,
    PER_SIZE,
    SIZE,
    STEP,
    f64,
)

if TYPE_CHECKING:
    from warp_lcp.subproblems.multigrid_workspace import MultigridWorkspace

EPS = float(np.finfo(np.float64).eps)
# Least residual that counts as ordinary: the squares of smaller ones underflow, which the loop
# examines.
ORDINARY = 1e-100
# Range of the ratio of a guess's residual to b in which float32 corrections neither overflow nor
# vanish.
RATIOS = 1e-6, 1e6
ROWS = 32  # largest number of rows
KEPT_BEGINNINGS = 2  # recorded starts of solves


# A row is stored for each evaluation: NORM ... ENERGY, then these.
ROW_STEP = wp.constant(4)
ROW_SIZE = wp.constant(5)
ROW = wp.constant(6)
# Slots of the numbers by which the device judges its steps, as `EnergyMonitor` and the outer loop
# do.
TAKEN = wp.constant(0)  # number of rows written
MOST = wp.constant(1)  # largest number of rows
TOLERANCE = wp.constant(2)
BEST = wp.constant(3)  # least norm
LAST_NORM = wp.constant(4)
LAST_ENERGY = wp.constant(5)
LOWEST = wp.constant(6)  # energy
FELL = wp.constant(7)  # last decrease of the energy
NOISE = wp.constant(8)  # relative noise of the energy
JUDGED = 9
CREEPS, STALLS = wp.constant(wp.float64(CREEP)), wp.constant(wp.float64(STALL))
# Safety factor: the host recomputes the decision and must not decide otherwise.
SAFELY = wp.constant(wp.float64(1.0 + 1e-9))
LEAST_RATIO, MOST_RATIO = wp.constant(wp.float64(1e-6)), wp.constant(wp.float64(1e6))


@wp.func
@no_type_check
def keep_row(scalars: f64, rows: f64, n: int):
    """Store the results of an evaluation as row n."""
    for c in range(4):
        rows[n * ROW + c] = scalars[c]
    rows[n * ROW + ROW_STEP] = scalars[STEP]
    rows[n * ROW + ROW_SIZE] = scalars[SIZE]


@forward_kernel(module="warp_lcp.projected_multigrid.ahead")
@no_type_check
def take_unit_kernel(scalars: f64, square: f64):
    """Use ||b|| as the unit of right-hand sides, 1 if it is 0; reset the step."""
    size = wp.sqrt(square[0])
    scalars[SIZE] = size
    if size == wp.float64(0.0):
        scalars[SIZE] = wp.float64(1.0)
    scalars[PER_SIZE] = wp.float64(1.0) / scalars[SIZE]
    scalars[STEP] = wp.float64(0.0)


@forward_kernel(module="warp_lcp.projected_multigrid.ahead")
@no_type_check
def keep_row_kernel(scalars: f64, rows: f64, n: int):
    """Store the results of an evaluation as row n."""
    keep_row(scalars, rows, n)


@forward_kernel(module="warp_lcp.projected_multigrid.ahead")
@no_type_check
def join_unusual_kernel(
    floating: wp.array(dtype=wp.int32), faults: f64, other_bounds: f64, unusual: f64
):
    """Join the flags of an unusual start, so that ranks exchange them together.

    Floating components, faults of the guess, and bounds of another code.
    """
    unusual[0] = wp.float64(floating[0])
    unusual[1] = faults[0]
    unusual[2] = wp.float64(0.0)
    if other_bounds:
        unusual[2] = other_bounds[0]


@forward_kernel(module="warp_lcp.projected_multigrid.ahead")
@no_type_check
def begin_kernel(
    scalars: f64,
    rows: f64,
    judged: f64,
    going: wp.array(dtype=wp.int32),
    stale: wp.array(dtype=wp.int32),
    was_stale: int,
    most: int,
    rtol: wp.float64,
    atol: wp.float64,
    counted: f64,
    noise: wp.float64,
    calm: wp.array(dtype=wp.int32),
):
    """Begin with the evaluated guess, unless the host must decide.

    Steps follow if the guess misses the tolerance and its residual is comparable to b. Row 0 has
    the reference. The tolerance is absolute, or that of the root mean square if unknowns are
    counted. `calm`: whether the host need not prepare the steps.

    With the norm |r| of the guess's residual, that of the reference |r_0| (row 0), |b| and n
    counted unknowns:

        tolerance = max(atol, rtol |r_0|), with atol sqrt(n) for atol if unknowns are counted,
        energy = scalars[ENERGY] / 2,
        go if |r| > SAFELY tolerance and LEAST_RATIO < |r| / |b| < MOST_RATIO.
    """
    keep_row(scalars, rows, 1)
    norm = wp.sqrt(scalars[NORM])
    energy = wp.float64(0.5) * scalars[ENERGY]
    absolute = atol
    if counted:
        absolute = atol * wp.sqrt(counted[0])
    judged[TAKEN] = wp.float64(2.0)
    judged[MOST] = wp.float64(most)
    judged[TOLERANCE] = wp.max(absolute, rtol * wp.sqrt(rows[NORM]))
    judged[BEST] = norm
    judged[LAST_NORM] = norm
    judged[LAST_ENERGY] = energy
    judged[LOWEST] = energy
    judged[FELL] = wp.float64(wp.inf)
    judged[NOISE] = noise
    ratio = norm / scalars[SIZE]
    go = (
        norm > judged[TOLERANCE] * SAFELY
        and ratio > LEAST_RATIO
        and ratio < MOST_RATIO
        and most > 2
    )
    if counted:
        go = go and counted[0] > wp.float64(0.0)
    if calm:
        go = go and calm[0] != 0
    going[0] = wp.where(go, 1, 0)
    stale[0] = wp.where(scalars[MOVED] + rows[MOVED] > wp.float64(0.0), 1, was_stale)
    scalars[CARRY] = wp.float64(0.0)


@forward_kernel(module="warp_lcp.projected_multigrid")
@no_type_check
def resume_kernel(
    judged: f64,
    going: wp.array(dtype=wp.int32),
    stale: wp.array(dtype=wp.int32),
    was_stale: int,
    most: int,
    tolerance: wp.float64,
    norm: wp.float64,
    best: wp.float64,
    energy: wp.float64,
    lowest: wp.float64,
    fell: wp.float64,
    noise: wp.float64,
):
    """Begin with a step, from the state that the host has judged."""
    judged[TAKEN] = wp.float64(0.0)
    judged[MOST] = wp.float64(most)
    judged[TOLERANCE] = tolerance
    judged[BEST] = best
    judged[LAST_NORM] = norm
    judged[LAST_ENERGY] = energy
    judged[LOWEST] = lowest
    judged[FELL] = fell
    judged[NOISE] = noise
    going[0] = 1
    stale[0] = was_stale


@forward_kernel(module="warp_lcp.projected_multigrid")
@no_type_check
def judge_kernel(
    scalars: f64,
    rows: f64,
    judged: f64,
    going: wp.array(dtype=wp.int32),
    stale: wp.array(dtype=wp.int32),
    rebuilds: bool,
    bounded: bool,
    calm: wp.array(dtype=wp.int32),
):
    """Store the result of a truncated step; decide whether the device goes on.

    It goes on if the residual and, with bounds, the energy are the least so far, the tolerance is
    missed, and the free set does not creep. The free set must not change either, unless the device
    rebuilds what depends on it; `calm`: whether that is sufficient.

    norm = sqrt(sum r^2), energy E = x'A x / 2 + b'x; E has fallen if E_lowest - E > noise
    (|E_last| + |E|). SAFELY widens the limits, so that the host decides all close cases.
    """
    zero = wp.float64(0.0)
    n = int(judged[TAKEN])
    keep_row(scalars, rows, n)
    norm = wp.sqrt(scalars[NORM])
    energy = wp.float64(0.5) * scalars[ENERGY]
    fell = judged[LAST_ENERGY] - energy
    margin = judged[NOISE] * (wp.abs(judged[LAST_ENERGY]) + wp.abs(energy))
    go = n + 1 < int(judged[MOST]) and wp.isfinite(scalars[STEP])
    go = go and norm > judged[TOLERANCE] * SAFELY and norm < judged[BEST]
    if bounded:  # without bounds the energy is not used
        go = go and judged[LOWEST] - energy > margin * SAFELY
    if scalars[MOVED] > zero:
        go = (
            go
            and rebuilds
            and fell * SAFELY < CREEPS * judged[FELL]
            and norm * SAFELY < STALLS * judged[LAST_NORM]
        )
        if calm:
            go = go and calm[0] != 0
    judged[TAKEN] = wp.float64(n + 1)
    judged[BEST] = wp.min(judged[BEST], norm)
    judged[LAST_NORM] = norm
    judged[LAST_ENERGY] = energy
    judged[LOWEST] = wp.min(judged[LOWEST], energy)
    judged[FELL] = fell
    going[0] = wp.where(go, 1, 0)
    stale[0] = wp.where(scalars[MOVED] > zero, 1, 0)


class DeviceIteration:
    """Steps that the device takes without the host, and their unread results.

    Another step follows while residual and energy are the least so far, the tolerance is missed and
    the free set does not creep. There the host, which repeats all these decisions later, would have
    taken the same step. All other cases are left to the host. On the CPU the threads execute the
    beginning of a solve as one table of launches, and the steps as a table that is repeated.

    Args:
        work: the workspace of the steps; its operator is a grid's, in one process.
        rebuilds: whether the device also updates the hierarchy for the free set; else steps end
            where that changes, and the host rebuilds.

    Attributes:
        rows: evaluations that the host has not read, see `keep_row`.
    """

    def __init__(self, work: MultigridWorkspace, *, rebuilds: bool = True) -> None:
        self._work, self._rebuilds, device = work, rebuilds, work.A.device
        self._shared = work.problem.layout.comm is not None
        self.rows = deque[np.ndarray]()
        self._results, self._judged = (
            DeviceScalar(device, ROWS * int(ROW)),
            DeviceScalar(device, JUDGED),
        )
        self._going, self._stale = (zeros(1, wp.int32, device) for _ in range(2))
        # Arguments of the kernel that begins: stale, most, both tolerances, noise.
        self._numbers = [Scalar() for _ in range(5)]
        self._standing = [Scalar() for _ in range(9)]  # of the kernel that resumes
        # By the step's program, and whether the device rebuilds.
        self._loops: dict[tuple[int, bool], CommandBuffer] = {}
        self._resuming = LaunchGraph(device, self._launch_resumption)
        self._beginnings: list[SolveStart] = []  # of the latest guesses and counts

    @staticmethod
    def suits(work: MultigridWorkspace) -> bool:
        """Return whether the device can work without its host.

        Loops must run on the device, on a grid. On ranks only the beginning of a solve does, on the
        CPU.
        """
        plain = type(work.hierarchy) is Hierarchy and isinstance(work.A, GridPoisson)
        alone = work.problem.layout.comm is None
        return plain and loops_on_device(work.A.device) and (alone or work.A.device.is_cpu)

    def steps(self, tolerance: float, left: int) -> bool:
        """Take a step and those that follow it, at most `left`.

        Returns False, with nothing done, where kernels have yet to be loaded. Ranks, which wait for
        each other in every step, take none.
        """
        work = self._work
        if self._shared:
            return False
        if not self._rebuilds:
            work.rebuild(classify=True)
        loop = self._loop(rebuilds=self._may_rebuild())
        if loop is None:
            return False
        arguments = [
            int(work.stale),
            min(left, ROWS),
            tolerance,
            *work.energy_monitor.device_state,
            work.energy_monitor.noise,
        ]
        for number, value in zip(self._standing, arguments, strict=True):
            number.value = value
        self._resuming.run(loop, variant=work.program_key())
        if not work.A.device.is_cuda:
            loop.run_while(self._going)
        self._take_rows()
        return True

    @property
    def _calm(self) -> DeviceArray | None:
        """On a GPU, whether bodies need no correction of the cycle.

        None if there are no bodies.
        """
        correction = self._work.correction
        return None if correction is None else correction.calm

    def _may_rebuild(self) -> bool:
        """Return whether the device updates the hierarchy now."""
        correction = self._work.correction
        return self._rebuilds or (correction is not None and correction.is_calm)

    def begin(
        self, guess: DeviceArray, criteria: StoppingCriteria | MeanCriteria, left: int
    ) -> float | None:
        """Begin a solve from a guess, and take steps.

        Returns the residual |r_0| at clip(0, l, u), None where the loop has to begin again. It
        goes on if 4 EPS |b| < |r_0| and 1e-6 |b| < |r| < 1e6 |b|, where r is the guess's residual:
        then neither rounding nor the range of float32 corrections matters. Without unknowns that
        count, nothing is done, and the residual is 0.

        Args:
            guess: stored field that is not the iterate.
            criteria: when steps are done.
            left: largest number of steps.
        """
        work, r = self._work, self._work.residual
        loop = self._loop(rebuilds=True) if self._may_rebuild() and not self._shared else None
        if loop is None and self._rebuilds and not (work.A.device.is_cuda or self._shared):
            return None
        hierarchy = work.hierarchy
        renewed = r.has_new_operator()
        if renewed and not (work.A.device.is_cuda and hierarchy.knows_changes):
            hierarchy.refresh()
            renewed = False
        counted = criteria.counted if isinstance(criteria, MeanCriteria) else None
        numbers = (
            int(work.stale),
            min(left + 2, ROWS),
            criteria.rtol,
            criteria.atol,
            work.energy_monitor.noise,
        )
        beginning = self._beginning_of(guess, counted)
        for number, value in zip(self._numbers, numbers, strict=True):
            number.value = value
        if work.A.device.is_cuda:
            beginning.run_with(loop, self._going, renewed=renewed)
        else:
            beginning.run()
            if loop is not None:
                loop.run_while(self._going)
        self._take_rows()
        # No unknown counts: there is nothing to solve.
        if isinstance(criteria, MeanCriteria) and criteria.count() == 0:
            self.rows.clear()
            work.distrust_hierarchy()  # the free set is unknown
            return r.mark_evaluated(0.0)
        reference, first = (math.sqrt(row[int(NORM)]) for row in (self.rows[0], self.rows[1]))
        size = math.sqrt(r.square_of_b.numpy()[0])
        usual = (
            beginning.is_plain() and math.isfinite(size) and 4 * EPS * size < reference < math.inf
        )
        if not (usual and reference > ORDINARY and RATIOS[0] * size < first < RATIOS[1] * size):
            self.rows.clear()
            work.distrust_hierarchy()  # the hierarchy may be of any free set now
            return None
        for classified in (False, True):
            r.store_evaluation(self.rows.popleft(), size, classified=classified)
        return reference

    def forget_guess(self) -> None:
        """Release the guess: the launches that begin from one are created again."""
        self._beginnings.clear()
        self.rows.clear()

    def _beginning_of(self, guess: DeviceArray, counted: DeviceArray | None) -> SolveStart:
        """Return the launches of a guess and a count.

        Those of the last two are kept: a step of thick liquid solves with two criteria.
        """
        for start in self._beginnings:
            if start.fits(guess, counted):
                return start
        start = SolveStart(self._work, guess, counted, self._results, self._judge_first)
        self._beginnings = [start, *self._beginnings[: KEPT_BEGINNINGS - 1]]
        return start

    def _judge_first(self, counted: DeviceArray | None, launch: Launch) -> None:
        """Record the kernel that decides whether the guess is good enough."""
        *arguments, noise = self._numbers
        memory = [
            self._work.residual.scalars,
            self._results.array,
            self._judged.array,
            self._going,
            self._stale,
        ]
        launch(
            begin_kernel,
            1,
            [*memory, *arguments, counted, noise, self._calm],
            device=self._work.A.device,
        )

    def _launch_resumption(self, loop: CommandBuffer) -> None:
        """Launch the kernel that resumes, and on CUDA the steps."""
        memory, device = [self._judged.array, self._going, self._stale], self._work.A.device
        launch(resume_kernel, 1, [*memory, *self._standing], device=device)
        if device.is_cuda:
            loop.run_while(self._going)
            if (correction := self._work.correction) is not None:
                correction.note(launch)
                if correction.slots:
                    correction.note_products()

    def _take_rows(self) -> None:
        """Read the rows of a loop; waits for the device."""
        for reading in (self._results, self._judged, *self._work.readings):
            reading.changed()
        count = int(self._judged.numpy()[int(TAKEN)])
        self._work.free_set_noted = self._work.A.device.is_cuda
        self.rows.extend(self._results.numpy()[: count * int(ROW)].reshape(count, -1).copy())

    def _loop(self, *, rebuilds: bool) -> CommandBuffer | None:
        """Return the program of a step, None while parts of it have not run.

        A step is a rebuild of the hierarchy if the free set is stale, the truncated cycle, and the
        decision whether another step follows.
        """
        work = self._work
        step, rebuild = work.step_program(), work.hierarchy.rebuild_program
        if not (step.has_run and rebuild.has_run):
            return None
        key = id(step), rebuilds
        if key not in self._loops:
            loop = self._loops[key] = CommandBuffer(work.A.device)
            if rebuilds:
                loop.record(Conditional(self._stale, rebuild))
            # Rounding cannot be undone: x, the best iterate, is stored before each step.
            if work.precision is Precision.SINGLE:
                CONVERT.bind(Rows.of_fields(work.problem.layout), a=work.x, b=work.best()).launch(
                    loop.launch
                )
            loop.extend(step)
            calm = self._calm if rebuilds else None
            if calm is not None:
                assert work.correction is not None
                work.correction.note(loop.launch)
            memory = [
                work.residual.scalars,
                self._results.array,
                self._judged.array,
                self._going,
                self._stale,
            ]
            loop.launch(
                judge_kernel, 1, [*memory, rebuilds, work.bounded, calm], device=work.A.device
            )
        return self._loops[key]


class SolveStart:
    """The launches that begin a solve from a guess.

    They evaluate the residuals at clip(0, l, u) and at the guess, and test for unusual data.

    Args:
        work: of the solve.
        guess: stored field, read each time.
        counted: of the criteria, see `MeanCriteria`.
        found: receives the first evaluation, see `keep_row`.
        judge: launches or records the kernel that decides whether the guess is good enough.
    """

    def __init__(
        self,
        work: MultigridWorkspace,
        guess: DeviceArray,
        counted: DeviceArray | None,
        results: DeviceScalar,
        judge: Callable[[DeviceArray | None, Launch], None],
    ) -> None:
        self._work, self._guess, self._counted, self._results, device = (
            work,
            guess,
            counted,
            results,
            work.A.device,
        )
        self._key, self._finder = (
            work.program_key(),
            work.A.component_finder,  # type: ignore[attr-defined]  # of a GridPoisson
        )
        self._judge, self._graph = judge, LaunchGraph(device, self._launch)  # on CUDA
        self._unusual = DeviceScalar(device, 3)  # flags of ranks
        self._program = None if device.is_cuda else CommandBuffer(device)
        if self._program is not None:
            self._searches, search = zeros(1, wp.int32, device), CommandBuffer(device)
            self._finder.record(work.scratch, search.launch)
            self._record(self._program.launch, Conditional(self._searches, search))
            judge(counted, self._program.launch)

    def fits(self, guess: DeviceArray, counted: DeviceArray | None) -> bool:
        """Return whether the launches are for this guess, count and bounds."""
        return (
            self._guess.ptr == guess.ptr
            and self._counted is counted
            and self._key == self._work.program_key()
        )

    def run(self) -> None:
        """Launch everything, on the CPU."""
        assert self._program is not None
        self._searches.numpy()[0] = self._finder.wanted()
        self._program.run()

    def run_with(self, loop: CommandBuffer | None, going: DeviceArray, *, renewed: bool) -> None:
        """Launch everything on CUDA, and the steps that follow: one graph.

        Args:
            loop: a step; None: no step follows.
            going: steps are repeated while it is not 0.
            renewed: whether the hierarchy reads the operator again first.
        """
        self._graph.run(loop, going, renewed, self._finder.wanted())
        r, p = self._work.residual, self._work.problem
        for changed in (p.bounds, r.square_of_b, self._finder, self._faults):
            changed.changed()

    def _launch(
        self, loop: CommandBuffer | None, going: DeviceArray, renewed: bool, searches: bool
    ) -> None:
        """Launch or record everything, with the arguments of `run_with`.

        `searches`: whether to search for floating components.
        """
        if renewed:
            self._work.hierarchy.refresh()
        self._record(launch, self._finder.search if searches else None)
        self._judge(self._counted, launch)
        if loop is not None:
            loop.run_while(going)
        elif (correction := self._work.correction) is not None and correction.is_made_on_gpu:
            self._work.hierarchy.rebuild_changed()
            correction.make_potentials()

    def is_plain(self) -> bool:
        """Return whether the data are as usual; waits for the device.

        No component floats, the guess is finite, and bounds are coded as before.
        """
        bounds = self._work.problem.bounds
        if self._work.problem.layout.comm is not None:
            floating, faults, others = self._unusual.numpy()
            return floating == faults == 0.0 and bounds.stays_with(others)
        return bounds.stays and self._finder.none() and not self._faults.numpy()[0]

    def _record(
        self, launch: Launch, search: Conditional | Callable[[Scratch | None], object] | None
    ) -> None:
        """Record the launches, or launch them.

        Args:
            launch: launches or records.
            search: of floating components: on the CPU a part of the program, on CUDA a function
                that launches it; None: it is not due.
        """
        work, r, x = self._work, self._work.residual, self._work.x
        p, device = work.problem, work.A.device
        p.bounds.encode(launch)
        r.share_bounds(launch)
        r.project(x, keep=False, launch=launch)
        work.round_iterate(launch=launch)
        r.launch_square_of_b(launch)
        launch(take_unit_kernel, 1, [r.scalars, r.square_of_b.array], device=device)
        r.assess(x, classify=False, launch=launch)
        launch(keep_row_kernel, 1, [r.scalars, self._results.array, 0], device=device)
        if isinstance(search, Conditional):
            assert self._program is not None
            self._program.record(search)
        elif search is not None:
            search(work.scratch)
        self._faults = p.look_at(self._guess, launch)
        if p.layout.comm is not None:
            memory = [
                self._finder.held_here,
                self._faults.array,
                p.bounds.others_here,
                self._unusual.array,
            ]
            launch(join_unusual_kernel, 1, memory, device=device)
            sum_over_ranks(p.layout.comm, self._unusual.array, slice(0, 3), launch)
        if device.is_cuda:
            copy(x, self._guess)
        else:
            CONVERT.bind(Rows.of_fields(p.layout), a=self._guess, b=x).launch(launch)
        r.project(x, keep=True, launch=launch)
        work.round_iterate(launch=launch)
        r.assess(x, classify=True, launch=launch)
        if device.is_cuda and work.correction is not None:
            work.correction.note(launch)
        if work.scratch is not None:
            CLEAR.bind(work.flat, x=work.scratch[1]).launch(launch)
