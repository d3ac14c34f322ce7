# mypy: ignore-errors
"""Kernels of the coupled pressure and friction of sand, in 2-D and 3-D.

They run projected steps on the stresses of `granular.stress_layout`, update the momentum of these
steps, and make the decisions with which a device runs them without the host, see
`granular.stress_device_iteration`.

They also damp a pattern that exerts no force: a checkerboard in the pressure and one in the shear
balance each other on every face. Noise in the fraction excites it, and no equation damps it. With
p = (-1)^(i + j), the shear stress with -p at a cell's low-low corner, +p at the two mixed ones and
-p at high-high cancels grad p; in 3-D half of that on the edges of each shear does. So a part of
the pressure that alternates along all directions, (-1, 2, -1)/4 along each axis, can be subtracted
from p and added to the copies with those signs, without a change of velocity. Only cells deep in
dense sand take part, away from solids that cut cells.
"""

import functools
from dataclasses import dataclass
from pathlib import Path

import warp as wp

from warp_lcp.granular.stress_layout import (
    COHESION,
    COLUMNS,
    CONSTANTS,
    F64,
    FRICTION,
    GAIN,
    HALFWAY,
    LOOKAHEAD,
    PRESSURE_STEP,
    RATIO,
    SHEAR_STEP,
    STEP_OF_CELL,
    TENSION,
    UNSURE,
    WEIGHT,
)
from warp_lcp.kernels import KernelFile, StencilKernel
from warp_lcp.kernels.compiler import forward_kernel

# Slots of the momentum's state: number of steps; limits for pressure and friction; momenta of this
# step and of the next one; estimates of the natural residuals over the last PERIOD steps; sums over
# these steps; 1 less the limit up to which the momentum may grow.
COUNT, BETA_X, NOW_X, NOW_S, NEXT_X, NEXT_S, RESIDUAL_X, SUMS, REST, STATE = (
    0,
    1,
    3,
    4,
    5,
    6,
    7,
    9,
    17,
    18,
)
PERIOD = 5
DAMPED = 0.15  # part of the checkerboard that is removed in a step
HIGH, LOW = 0.85, 0.5  # cosines above and below which the momentum grows and falls

MOMENTUM: dict[str, int] = {"NOW_X": NOW_X, "NOW_S": NOW_S, "NEXT_X": NEXT_X, "NEXT_S": NEXT_S}
KERNELS = KernelFile(
    Path(__file__).parent / "headers/stress.h", CONSTANTS | MOMENTUM | {"DAMPED": DAMPED}
)


@dataclass(frozen=True)
class StressKernels:
    """Kernels of the stress solve; the declarations in the headers explain them."""

    edge_stress: StencilKernel
    face_velocity: StencilKernel
    edge_strain: StencilKernel
    step: StencilKernel
    traction: StencilKernel
    admit: StencilKernel
    damp: StencilKernel
    wall: StencilKernel


@functools.cache
def stress_passes(
    dimension: int, real: type, *, box: bool = False, rate: bool = False, cut: int = 0
) -> StressKernels:
    """Return the kernels for 2 or 3 dimensions.

    Steps have velocities in float32, the natural residual in float64. `cut`: 1 if solids cut cells,
    2 if some of them move.
    """
    residual = real is F64
    kind = ("residual" if residual else "step") + "_box" * box + "_rate" * rate
    kind += ("", "_cut", "_cut_moving")[cut]
    module = f"granular.stress_{dimension}d_{real.__name__}_{kind}"
    words = {
        "DIM": dimension,
        "BOX": box,
        "RATE": rate,
        "CUT": cut,
        "RESIDUAL": residual,
        "TRIAL": 0,
    }
    kernel = functools.partial(KERNELS.kernel, module=module, compute=real, constants=words)
    return StressKernels(
        edge_stress=kernel("granular.stress.edge_stress"),
        face_velocity=kernel("granular.stress.face_velocity"),
        edge_strain=kernel("granular.stress.edge_strain"),
        step=kernel("granular.stress.step"),
        traction=kernel("granular.stress.traction"),
        admit=kernel("granular.stress.admit"),
        damp=kernel("granular.stress.damp"),
        wall=kernel("granular.stress.wall_step"),
    )


@forward_kernel(module="granular.momentum")
def momentum_kernel(sums: wp.array(dtype=wp.float64), state: wp.array(dtype=wp.float64)):
    """Update the momentum of the next step but one.

    Every few steps it is increased or decreased, by the angle between the projection's error e and
    the step s: cos = <e, s> / sqrt(<e, e> <s, s>) is near 1 where more momentum would help, and
    small where the iterates oscillate.
    """
    for c in range(COLUMNS):
        value = sums[c] + sums[COLUMNS + c]
        if c >= 6:
            value = wp.sqrt(value)
        state[SUMS + c] = state[SUMS + c] + value
    count = state[COUNT] + wp.float64(1.0)
    state[COUNT] = count
    if state[COUNT] % wp.float64(PERIOD) == wp.float64(0.0):
        for block in range(2):
            at = SUMS + 3 * block
            size = state[at + 1] * state[at + 2]
            rest = wp.float64(1.0) - state[BETA_X + block]
            if size > wp.float64(0.0):
                cosine = state[at] / wp.sqrt(size)
                if cosine > wp.float64(HIGH):
                    rest = rest * wp.float64(0.8)
                if cosine < wp.float64(LOW):
                    rest = rest * wp.float64(1.8)
            state[BETA_X + block] = wp.float64(1.0) - wp.clamp(rest, state[REST], wp.float64(0.4))
        state[RESIDUAL_X] = state[SUMS + 6] / wp.float64(PERIOD)
        state[RESIDUAL_X + 1] = state[SUMS + 7] / wp.float64(PERIOD)
        for c in range(COLUMNS):
            state[SUMS + c] = wp.float64(0.0)
    for block in range(2):
        state[NOW_X + block] = state[NEXT_X + block]
        state[NEXT_X + block] = wp.min(
            state[BETA_X + block], (count + wp.float64(1.0)) / (count + wp.float64(4.0))
        )


@forward_kernel(module="granular.momentum")
def keep_step_kernel(
    sums: wp.array(dtype=wp.float64), found: wp.array2d(dtype=wp.float64), step: int
):
    """Store the sums of a step of a period on this rank; a thread per column."""
    c = wp.tid()
    found[step, c] = sums[c]


# total_c = sum over the steps of v_c, with v_c the sum over cells and walls, for c < 6. For columns
# 6 and 7, squared norms, total_c = (sum of sqrt(v_c))^2.
@forward_kernel(module="granular.momentum")
def period_kernel(step_sums: wp.array2d(dtype=wp.float64), total: wp.array(dtype=wp.float64)):
    """Combine the sums of a period over cells, walls and ranks; a thread per column.

    `momentum_kernel` expects one set of sums per step. It adds roots of columns 6 and 7, and takes
    the root of its argument.
    """
    c = wp.tid()
    value = wp.float64(0.0)
    for step in range(PERIOD):
        part = step_sums[step, c] + step_sums[step, COLUMNS + c]
        if c >= 6:
            part = wp.sqrt(part)
        value += part
    if c >= 6:
        value *= value
    total[c] = value
    total[COLUMNS + c] = wp.float64(0.0)


# Slots of the decisions of a solve. Counts of steps: done, at the best estimate, at the last change
# of estimate or momentum, minimum, maximum.
DONE, BEST_AT, CHANGED, LEAST, MOST = 0, 1, 2, 3, 4
# In m/s: best estimate, target, and the value below which `LEAST` does not count.
BEST, AIM, STILL = 5, 6, 7
# Number of momentum limits used; whether the residual is due; whether progress has ended.
LIMITS, DUE, STAGNATES = 8, 9, 10
# Sums of a residual (squares of the pressure's and the friction's, squares of the stresses, work of
# the error) at the start and after the last steps.
FIRST, LAST, DECISIONS = 11, 15, 19
# Factors on the best estimate: less is progress; a stagnating solve ends within the second one.
BETTER, NEAR_BEST = 0.95, 1.2
NOTHING = 1e-3  # relative to the tolerance: nothing to solve
STILL_SHARE = 1e-2  # relative to the tolerance: sand stays at rest
# Factor on the first target, if the velocities have a tolerance, too: it may hold before that of
# the residual.
EARLY = 4.0
TIGHTER = 0.8  # factor on the target at each residual, since the estimate may be too low
# Factor from a step of the friction over its length to its natural residual: measured.
SHARE = 0.7**0.5
SAFELY = 1.0 + 1e-9  # the host recomputes the norm
f32s, f64s, i32s = wp.array(dtype=wp.float32), wp.array(dtype=wp.float64), wp.array(dtype=wp.int32)


@forward_kernel(module="granular.momentum")
def numbers_kernel(
    numbers: f32s,
    k: float,
    cohesion: float,
    tension: float,
    x: float,
    y: float,
    z: float,
    step: float,
    gain: float,
    halfway: float,
    ratio: float,
    unsure: float,
):
    """Write the parameters of a time step, see `granular.stress_layout`.

    The steps of a method are set afterwards.
    """
    numbers[FRICTION] = k
    numbers[COHESION] = cohesion
    numbers[TENSION] = tension
    numbers[WEIGHT] = x
    numbers[WEIGHT + 1] = y
    numbers[WEIGHT + 2] = z
    numbers[PRESSURE_STEP] = 1.0
    numbers[SHEAR_STEP] = 1.0
    numbers[LOOKAHEAD] = 0.0
    numbers[STEP_OF_CELL] = step
    numbers[GAIN] = gain
    numbers[HALFWAY] = halfway
    numbers[RATIO] = ratio
    numbers[UNSURE] = unsure


@wp.func
def limit(state: f64s, momentum: wp.float64):
    """Limit all later momenta."""
    for i in range(BETA_X, NEXT_X + 2):
        state[i] = wp.min(state[i], momentum)
    state[REST] = wp.float64(1.0) - momentum


@forward_kernel(module="granular.momentum")
def keep_sums_kernel(sums: f64s, decisions: f64s, place: int):
    """Store the sums of a residual: of pressure, friction, stresses, and work of the error."""
    decisions[place] = sums[0]
    decisions[place + 1] = sums[1] + sums[COLUMNS]
    decisions[place + 2] = sums[2]
    decisions[place + 3] = sums[3] + sums[COLUMNS + 3]


# The norm of the residual is sqrt((pressure + friction) / cells) [m/s], with sums of squares over
# cells and walls. No minimum of steps is due if it is below NOTHING * tolerance, or within
# the tolerance with stresses whose root mean square is below `unloaded`. Steps run if a minimum is
# due or norm > tolerance (1 + 1e-9).
@forward_kernel(module="granular.momentum")
def begin_steps_kernel(
    sums: f64s,
    counted: f64s,
    numbers: f32s,
    state: f64s,
    decisions: f64s,
    going: i32s,
    pressure_step: float,
    shear_step: float,
    lookahead: float,
    momentum: wp.float64,
    most_momentum: wp.float64,
    limit_: wp.float64,
    tolerance: wp.float64,
    least: wp.float64,
    still: wp.float64,
    unloaded: wp.float64,
    most: wp.float64,
    early: wp.float64,
):
    """Start the steps of a solve, as `coupled.MomentumWorkspace.start` does.

    The residual at the start must be known.
    """
    numbers[PRESSURE_STEP] = pressure_step
    numbers[SHEAR_STEP] = shear_step
    numbers[LOOKAHEAD] = lookahead
    for i in range(STATE):
        state[i] = wp.float64(0.0)
    for block in range(2):
        state[BETA_X + block] = momentum
        state[NEXT_X + block] = wp.float64(0.25)
    state[REST] = wp.float64(1.0) - most_momentum
    if wp.isfinite(limit_):
        limit(state, limit_)
    decisions[FIRST] = sums[0]
    decisions[FIRST + 1] = sums[1] + sums[COLUMNS]
    decisions[FIRST + 2] = sums[2]
    decisions[FIRST + 3] = sums[3] + sums[COLUMNS + 3]
    cells = wp.max(counted[0], wp.float64(1.0))
    norm = wp.sqrt((decisions[FIRST] + decisions[FIRST + 1]) / cells)
    falls = norm <= tolerance and wp.sqrt(sums[2] / cells) < unloaded
    wanted = least
    if falls or norm <= wp.float64(NOTHING) * tolerance:
        wanted = wp.float64(0.0)
    decisions[DONE] = wp.float64(0.0)
    decisions[BEST_AT] = wp.float64(0.0)
    decisions[CHANGED] = wp.float64(0.0)
    decisions[LEAST] = wanted
    decisions[MOST] = most
    decisions[BEST] = wp.float64(wp.inf)
    decisions[AIM] = early * tolerance
    decisions[STILL] = still
    decisions[LIMITS] = wp.float64(0.0)
    decisions[DUE] = wp.float64(0.0)
    decisions[STAGNATES] = wp.float64(0.0)
    steps = wanted > wp.float64(0.0) or norm > tolerance * wp.float64(SAFELY)
    going[0] = wp.where(steps and most > wp.float64(0.0) and wp.isfinite(norm), 1, 0)


@forward_kernel(module="granular.momentum")
def resume_steps_kernel(decisions: f64s, going: i32s):
    """Continue after a residual that has missed the tolerance."""
    decisions[DUE] = wp.float64(0.0)
    decisions[STAGNATES] = wp.float64(0.0)
    going[0] = 1


# estimate = sqrt(((R_x / step_x)^2 + (SHARE R_s / step_s)^2) / cells) [m/s], where R_x and R_s are
# the means over the period of the norms of pressure and friction, and step_x and step_s the lengths
# of their steps.
@forward_kernel(module="granular.momentum")
def decide_kernel(
    counted: f64s,
    numbers: f32s,
    state: f64s,
    decisions: f64s,
    limits: f64s,
    going: i32s,
    check: int,
    patience: int,
    wait: int,
):
    """Decide after a period whether the residual is due.

    The rules are those of `coupled.MomentumWorkspace.judge`.
    """
    done = decisions[DONE] + wp.float64(PERIOD)
    decisions[DONE] = done
    if done % wp.float64(check) != wp.float64(0.0):
        return
    pressure = state[RESIDUAL_X] / wp.float64(numbers[PRESSURE_STEP])
    friction = wp.float64(SHARE) * state[RESIDUAL_X + 1] / wp.float64(numbers[SHEAR_STEP])
    scale = wp.float64(1.0) / wp.sqrt(wp.max(counted[0], wp.float64(1.0)))
    estimate = scale * wp.sqrt(pressure * pressure + friction * friction)
    stagnates = bool(False)
    if estimate < wp.float64(BETTER) * decisions[BEST]:
        decisions[BEST] = estimate
        decisions[BEST_AT] = done
        decisions[CHANGED] = done
    else:
        late = (
            done - decisions[BEST_AT] >= wp.float64(patience)
            and estimate < wp.float64(NEAR_BEST) * decisions[BEST]
        )
        stagnates = late or not wp.isfinite(estimate)
        used = int(decisions[LIMITS])
        if (
            used < limits.shape[0]
            and done - decisions[CHANGED] >= wp.float64(wait)
            and estimate > decisions[AIM]
        ):
            limit(state, limits[used])
            decisions[LIMITS] = wp.float64(used + 1)
            decisions[CHANGED] = done
    early = done < decisions[LEAST] and estimate > decisions[STILL]
    due = stagnates or not (estimate > decisions[AIM] or early)
    if due:
        decisions[AIM] = wp.float64(TIGHTER) * decisions[AIM]
    decisions[DUE] = wp.where(due, wp.float64(1.0), wp.float64(0.0))
    decisions[STAGNATES] = wp.where(stagnates, wp.float64(1.0), wp.float64(0.0))
    going[0] = wp.where(due or done >= decisions[MOST], 0, 1)
