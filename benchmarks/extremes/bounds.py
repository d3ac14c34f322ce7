"""Hostile right-hand sides and bounds.

The families are scales, degenerate solutions, active sets of all or no unknowns, and tolerances
below rounding.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Unpack

import numpy as np

from warp_lcp.benchmarks.extremes.case import (
    BELOW_ROUNDING,
    EITHER,
    ExpectedOutcome,
    ExtremeCase,
    OutcomeKind,
    refusal,
    stopped,
)
from warp_lcp.benchmarks.extremes.problem import GridFields, GridProblem, with_solution
from warp_lcp.benchmarks.extremes.shapes import AIR, FLUID, chance, noise, pool, solve_cases
from warp_lcp.files import Tables

SHAPE = (40, 44)
EXACT_OR_FLOOR = ExpectedOutcome(OutcomeKind.EITHER, frozenset({"FLOOR"}))
NOISE, ODD = noise(SHAPE), np.indices(SHAPE).sum(axis=0) % 2 == 1


def but(at: tuple[int, int], value: float, b: np.ndarray) -> np.ndarray:
    """Return a field with another value in one cell."""
    changed = b.copy()
    changed[at] = value
    return changed


def scales() -> Iterator[ExtremeCase]:
    """Yield right-hand sides from 0 to 1e30, and spikes."""
    case = partial(given_pool, "scales of b")
    yield from case("b = 0", b=np.zeros(SHAPE))
    yield from case("b = -0.0", b=np.full(SHAPE, -0.0))
    for scale in (1e-30, 1e-15, 1e15, 1e30):
        yield from case(f"b of {scale:g}", b=scale * NOISE)
        yield from case(
            f"b and bounds of {scale:g}", b=scale * NOISE, lower=-0.1 * scale, upper=0.2 * scale
        )
    for scale in (1e-160, 1e-310):
        yield from case(
            f"b of {scale:g}", {"expected": refusal("b: largest value")}, b=scale * NOISE
        )
    yield from case("b of 1e160", {"expected": stopped("NON_FINITE")}, b=1e160 * NOISE)
    yield from case("one cell of b at 1e12", b=but((17, 19), -1e12, NOISE))
    yield from case("b over 30 decades", b=NOISE * 10 ** chance(11).uniform(-15, 15, SHAPE))
    yield from case("bounds at 1e30", lower=-1e30, upper=1e30)
    # Far beyond the range of b, so that one cell pushes all others.
    yield from case(
        "b of 1e-30 beside a bound of 1e10",
        b=1e-30 * NOISE,
        lower=but((20, 20), 1e10, np.full(SHAPE, -np.inf)),
    )


def given_pool(
    family: str, name: str, more: Tables | None = None, **fields: Unpack[GridFields]
) -> Iterator[ExtremeCase]:
    """Yield a pool with these fields for both methods.

    `more` holds arguments of SolveCase.
    """
    return solve_cases(family, name, partial(pool, SHAPE, **fields), **(more or {}))


def degenerate() -> Iterator[ExtremeCase]:
    """Yield degenerate solutions, and active sets of all or no unknowns.

    A degenerate solution has x_i = l_i and y_i = 0 on many cells.
    """
    family = "active sets"
    case = partial(given_pool, family)
    for share in (0.1, 0.5, 0.9):
        yield from solve_cases(
            family, f"x = y = 0 on {share:.0%} of the cells", partial(planted, share)
        )
    yield from solve_cases(family, "x = y = 0 on all cells but one", lambda: planted(1.0))
    yield from case("all active", b=np.abs(NOISE) + 0.01, lower=0.0)
    yield from case("all active but one", b=but((11, 12), -2.0, np.ones(SHAPE)), lower=0.0)
    yield from case("none active", b=-np.abs(NOISE) - 0.01, lower=0.0)
    yield from case("l = u everywhere", lower=0.5, upper=0.5)
    yield from case(
        "l = u on half of the cells",
        lower=np.where(ODD, 0.3, -np.inf),
        upper=np.where(ODD, 0.3, np.inf),
    )
    yield from case("box of 1e-12", lower=-1e-12, upper=1e-12)
    yield from case("b = 0 on half of the cells", b=np.where(NOISE > 0, 0.0, noise(SHAPE, 12)))
    yield from case("equal b everywhere", b=np.full(SHAPE, -1.0), lower=0.0, upper=50.0)
    yield from case("lower bounds of noise, l > 0", lower=np.abs(noise(SHAPE, 13)))
    yield from case("upper bounds only", lower=-np.inf, upper=0.0)
    yield from case("checkerboard of bounds", lower=np.where(ODD, -np.inf, 0.0))
    yield from solve_cases(family, "resting under a ceiling", ceiling)
    for far in (1e6, 1e20, -1e20):
        yield from case(f"start at {far:g}", {"x0": np.full(SHAPE, far)})


def planted(share: float) -> GridProblem:
    """Return b whose solution has x = y = 0 on a share of the cells."""
    draw, cells = chance(14), pool(SHAPE).cells
    inside = cells == FLUID
    x = np.where(inside & (draw.random(SHAPE) >= share), draw.uniform(0.1, 1.0, SHAPE), 0.0)
    x[5, 5] = 1.0
    return with_solution(
        cells,
        x,
        np.where(
            (x == 0) & (draw.random(SHAPE) > 0.9) & (share < 1), draw.uniform(0.1, 1.0, SHAPE), 0.0
        ),
    )


def ceiling() -> GridProblem:
    """Return liquid at rest up to a separating ceiling.

    At the ceiling y = 0, and x = 0 to rounding.
    """
    cells = np.full(SHAPE, FLUID)
    cells[-1, -6:] = AIR
    b = np.zeros(SHAPE)
    b[0], b[-2] = -0.1, 0.1
    return GridProblem(cells=cells, b=b, lower=np.where(np.indices(SHAPE)[0] >= 38, 0.0, -np.inf))


def tolerances() -> Iterator[ExtremeCase]:
    """Yield tolerances below rounding.

    The solve must end as FLOOR, not as CONVERGED, and must not loop for ever.
    """
    case = partial(solve_cases, "tolerances")
    for rtol in (1e-15, 1e-17, 0.0):
        expected, stopping = (
            BELOW_ROUNDING if rtol < 1e-16 else EXACT_OR_FLOOR,
            {"rtol": rtol, "max_iterations": 500},
        )
        for name, shape in (("2-D", (64, 66)), ("3-D", (17, 18, 19))):
            yield from case(
                f"rtol = {rtol:g}, {name}",
                partial(pool, shape),
                expected=expected,
                stopping=stopping,
            )
    yield from case(
        "rtol = 1e-12, single stops",
        lambda: pool((64, 66)),
        promises={"single": BELOW_ROUNDING},
        stopping={"rtol": 1e-12},
    )
    yield from case("atol = 1e30", lambda: pool(SHAPE), stopping={"atol": 1e30})
    for limit in (0, 1):
        promise = stopped("MAX_ITERATIONS")
        yield from case(
            f"{limit} iterations",
            lambda: pool(SHAPE),
            expected=promise,
            stopping={"max_iterations": limit},
        )
    yield from case(
        "256x256 to 1e-13", lambda: pool((256, 256)), expected=EITHER, stopping={"rtol": 1e-13}
    )
