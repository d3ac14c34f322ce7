# mypy: ignore-errors
"""Passes of the coupled pressure and friction of sand: projected steps on the stresses of `granular.yield_set`, 2-D and 3-D.

And what damps the pattern that exerts no force: a checkerboard in the pressure and one in the shear balance each other on every face. Noise
in the fraction feeds it and no equation takes it away. Where p = (-1)^(i + j), the shear stress with -p at a cell's low-low corner, +p at
the two mixed ones and -p at high-high cancels grad p; in 3-D half of that on the edges of each shear does. So a part of what alternates of
the pressure in all directions, (-1, 2, -1)/4 along each axis, can be taken from p and added to the copies with those signs, and no velocity
changes. Only cells deep in dense sand take part, away from solids that cut cells.
"""

import functools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.granular.yield_set import COLUMNS, CONSTANTS, F64
from warp_lcp.rows import KernelFile
from warp_lcp.rows.compiler import forward_kernel

# The momentum's state: steps done; the most of it for pressure and friction; that of this step; that of the next; estimates of the natural
# residuals over the last PERIOD steps; sums over these; 1 less the most that the momentum may grow to.
COUNT, BETA_X, NOW_X, NOW_S, NEXT_X, NEXT_S, RESIDUAL_X, SUMS, REST, STATE = 0, 1, 3, 4, 5, 6, 7, 9, 17, 18
PERIOD = 5
DAMPED = 0.15  # of the checkerboard, in a step
HIGH, LOW = 0.85, 0.5  # cosines above and below which the momentum grows and falls

MOMENTUM: dict[str, Any] = {"NOW_X": NOW_X, "NOW_S": NOW_S, "NEXT_X": NEXT_X, "NEXT_S": NEXT_S}
KERNELS = KernelFile(Path(__file__).parent / "headers/stress.h", CONSTANTS | MOMENTUM | {"DAMPED": DAMPED})


@functools.cache
def stress_passes(dimension: int, real: Any, *, box: bool = False, rate: bool = False, cut: bool = False) -> SimpleNamespace:
    """Return the passes for 2 or 3 dimensions: with velocities of float32 of a step, of float64 of what the natural residual would move."""
    residual = real is F64
    kind = ("residual" if residual else "step") + "_box" * box + "_rate" * rate + "_cut" * cut
    module = f"granular.stress_{dimension}d_{real.__name__}_{kind}"
    words = {"DIM": dimension, "BOX": box, "RATE": rate, "CUT": cut, "RESIDUAL": residual, "TRIAL": 0}
    names = ("edge_stress", "face_velocity", "edge_strain", "step", "traction", "admit", "damp")
    made = {name: KERNELS.kernel(f"granular.stress.{name}", module=module, compute=real, constants=words) for name in names}
    wall = KERNELS.kernel("granular.stress.wall_step", module=module, compute=real, constants=words)
    return SimpleNamespace(**made, wall=wall)


@forward_kernel(module="granular.momentum")
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
