"""Momentum of the stress solve against a plain loop with named variables."""

import math

import numpy as np
import warp as wp

from warp_lcp.granular import stress_kernels as kernels
from warp_lcp.granular.stress_layout import COLUMNS

STEPS, PERIOD = 25, 5


def momenta_of_a_plain_loop(sums, limits, rest):
    """Return the momenta (pressure, friction) after each step.

    Args:
        sums: of each step, shape (STEPS, COLUMNS): <e, s>, <e, e>, <s, s> of pressure and of
            friction, and the squares of the estimated residuals.
        limits: of the momenta at the start.
        rest: 1 less the largest limit.
    """
    limits, waiting, totals, momenta = list(limits), [0.25, 0.25], np.zeros(COLUMNS), []
    for step, values in enumerate(sums, 1):
        totals += [*values[:6], *np.sqrt(values[6:])]
        if step % PERIOD == 0:
            for block in range(2):
                error_step, error, length = totals[3 * block : 3 * block + 3]
                cosine = error_step / math.sqrt(error * length)
                factor = 0.8 if cosine > 0.85 else 1.8 if cosine < 0.5 else 1.0
                limits[block] = 1 - min(max((1 - limits[block]) * factor, rest), 0.4)
            totals[:] = 0.0
        momenta.append(tuple(waiting))
        waiting = [min(limit, (step + 1) / (step + 4)) for limit in limits]
    return momenta


def test_the_momentum_grows_and_falls_with_the_angle_of_error_and_step():
    rng = np.random.default_rng(17)
    cosines = rng.choice([0.2, 0.7, 0.95], (STEPS // PERIOD, 2)).repeat(PERIOD, axis=0)
    sums = np.empty((STEPS, COLUMNS))
    sums[:, [1, 2, 4, 5, 6, 7]] = rng.uniform(0.9, 1.1, (STEPS, 6))
    for block in range(2):
        error, length = sums[:, 3 * block + 1], sums[:, 3 * block + 2]
        sums[:, 3 * block] = cosines[:, block] * np.sqrt(error * length)
    limits, rest = (0.7, 0.8), 0.12
    state = np.zeros(kernels.STATE)
    state[kernels.BETA_X : kernels.BETA_X + 2] = limits
    state[kernels.NEXT_X : kernels.NEXT_X + 2] = 0.25
    state[kernels.REST] = rest
    device_state = wp.array(state, dtype=wp.float64, device="cpu")
    found = []
    for of_cells in sums:
        # Sums over cells, then over walls.
        parts = np.concatenate([0.75 * of_cells, 0.25 * of_cells])
        inputs = [wp.array(parts, dtype=wp.float64, device="cpu"), device_state]
        wp.launch(kernels.momentum_kernel, 1, inputs, device="cpu")
        found.append(device_state.numpy()[kernels.NOW_X : kernels.NOW_X + 2].tolist())
    expected = momenta_of_a_plain_loop(sums, limits, rest)
    np.testing.assert_allclose(found, expected, rtol=1e-14)
    assert len({momentum for momentum, _ in expected}) > 5
