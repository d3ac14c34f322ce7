# mypy: ignore-errors
"""Passes of the coupled pressure and friction of sand: projected steps on the stresses of `granular.yield_set`, 2-D and 3-D."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.granular.yield_set import COLUMNS, F32, F64, I32, U8, WALLS, sand_pass, xyz

# The momentum's state: steps done; the most of it for pressure and friction; that of this step; that of the next; estimates of the natural
# residuals over the last PERIOD steps; sums over these; 1 less the most that the momentum may grow to.
COUNT, BETA_X, NOW_X, NOW_S, NEXT_X, NEXT_S, RESIDUAL_X, SUMS, REST, STATE = 0, 1, 3, 4, 5, 6, 7, 9, 17, 18
PERIOD = 5
HIGH, LOW = 0.85, 0.5  # cosines above and below which the momentum grows and falls

MOMENTUM: dict[str, Any] = {"NOW_X": NOW_X, "NOW_S": NOW_S, "NEXT_X": NEXT_X, "NEXT_S": NEXT_S}
STEP = {"momentum": F64, "numbers": F32}
STRESSES = dict.fromkeys(("now", "before", "point"), F32)
CELLS = STRESSES | {"drive": F32, "stiff": F32, "openings": F32} | xyz("share", "mass", "inverse")


@functools.cache
def stress_passes(dimension: int, real: Any, *, box: bool = False, rate: bool = False, cut: bool = False) -> SimpleNamespace:
    """Return the passes for 2 or 3 dimensions: with velocities of float32 of a step, of float64 of what the natural residual would move."""
    residual = real is F64
    kind = ("residual" if residual else "step") + "_box" * box + "_rate" * rate + "_cut" * cut
    words = {"BOX": box, "RATE": rate, "CUT": cut, "RESIDUAL": residual, "TRIAL": 0} | MOMENTUM
    made = functools.partial(sand_pass, f"stress_{dimension}d_{real.__name__}_{kind}", dimension=dimension, real=real, **words)
    u, edge, spans = xyz(u=[real] * 3), xyz(edge=[real] * 3), {"spans": I32}
    faces, sums = xyz("start", "inverse") | {"openings": F32}, STEP | {"partials": F64}
    entries = {**WALLS, **STRESSES, **edge, **xyz("share", "inverse"), **sums}
    return SimpleNamespace(
        edge_stress=made("edge_stress", box=xyz("share") | {"y": F32} | edge, whole=spans),
        face_velocity=made("face_velocity", box={"share_x": F32, "y": F32, **edge, **faces, **u}, whole=spans),
        edge_strain=made("edge_strain", box={"share_x": F32, **u, **edge}, whole=spans),
        step=made("step", box={"flags": U8, **CELLS, **edge, **u}, whole=spans | sums),
        wall=made("wall_step", box={"active": I32}, whole=entries, numbers={"behind": int}),
        admit=made("admit", box={"flags": U8, "stiff": F32, **xyz("share"), **STRESSES}, numbers={"ratio": F32}),
    )


@wp.kernel(enable_backward=False, module="granular.momentum")
def momentum_kernel(sums: wp.array(dtype=wp.float64), state: wp.array(dtype=wp.float64)):
    """Momentum of the next step but one; every few steps more or less of it, by the angle between the projection's error and the step.

    cos = <e, s> / sqrt(<e, e> <s, s>) is near 1 where more momentum would help and small where the iterates flutter.
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
        state[NEXT_X + block] = wp.min(state[BETA_X + block], (count + wp.float64(1.0)) / (count + wp.float64(4.0)))
