"""Families of right-hand sides and bounds: scales, degenerate solutions, all or none at a bound, tolerances below rounding."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from warp_lcp.benchmarks.extremes.case import BELOW_ROUNDING, EITHER, PRECISIONS, Case, Expected, Promise, refusal
from warp_lcp.benchmarks.extremes.problem import GridProblem
from warp_lcp.benchmarks.extremes.shapes import AIR, FLUID, SEED, both, noise, pool, same

SHAPE = (40, 44)
OVERFLOWS = Promise(Expected.STOPPED, frozenset({"NON_FINITE"}))
EXACT_OR_FLOOR = Promise(Expected.EITHER, frozenset({"FLOOR"}))


def scales() -> Iterator[Case]:
    """Yield right-hand sides from 0 to 1e30, and spikes."""
    case = partial(both, "scales of b")
    yield from case("b = 0", lambda: pool(SHAPE, b=np.zeros(SHAPE)))
    yield from case("b = -0.0", lambda: pool(SHAPE, b=np.full(SHAPE, -0.0)))
    for scale in (1e-30, 1e-15, 1e15, 1e30):
        yield from case(f"b of {scale:g}", partial(pool, SHAPE, b=scale * noise(SHAPE)))
        yield from case(f"b and bounds of {scale:g}", partial(boxed, scale))
    for scale in (1e-160, 1e-310):
        yield from case(f"b of {scale:g}", partial(pool, SHAPE, b=scale * noise(SHAPE)), promises=same(refusal("b: values up to")))
    yield from case("b of 1e160", lambda: pool(SHAPE, b=1e160 * noise(SHAPE)), promises=same(OVERFLOWS))
    yield from case("one cell of b at 1e12", lambda: spike(1e12))
    yield from case(
        "b over 30 decades", lambda: pool(SHAPE, b=noise(SHAPE) * 10 ** np.random.default_rng(SEED + 11).uniform(-15, 15, SHAPE))
    )
    yield from case("bounds at 1e30", lambda: pool(SHAPE, lower=-1e30, upper=1e30))
    yield from case("b of 1e-30 beside a bound of 1e10", tiny_beside_huge)


def boxed(scale: float) -> GridProblem:
    """Return a pool with a box of the scale of b."""
    return pool(SHAPE, b=scale * noise(SHAPE), lower=-0.1 * scale, upper=0.2 * scale)


def spike(height: float) -> GridProblem:
    """Return a pool with one huge entry in b."""
    b = noise(SHAPE)
    b[17, 19] = -height
    return pool(SHAPE, b=b)


def tiny_beside_huge() -> GridProblem:
    """Return a bound far beyond what b can do, so that one cell pushes all others."""
    lower = np.full(SHAPE, -np.inf)
    lower[20, 20] = 1e10
    return pool(SHAPE, b=1e-30 * noise(SHAPE), lower=lower)


def degenerate() -> Iterator[Case]:
    """Yield solutions with x_i = l_i and y_i = 0 on many cells, and sets that hold all or nothing."""
    case = partial(both, "active sets")
    for share in (0.1, 0.5, 0.9):
        yield from case(f"x = y = 0 on {share:.0%} of the cells", partial(planted, share))
    yield from case("x = y = 0 on all cells but one", lambda: planted(1.0))
    yield from case("all active", lambda: pool(SHAPE, b=np.abs(noise(SHAPE)) + 0.01, lower=0.0))
    yield from case("all active but one", all_but_one)
    yield from case("none active", lambda: pool(SHAPE, b=-np.abs(noise(SHAPE)) - 0.01, lower=0.0))
    yield from case("l = u everywhere", lambda: pool(SHAPE, lower=0.5, upper=0.5))
    yield from case("l = u on half of the cells", half_fixed)
    yield from case("box of 1e-12", lambda: pool(SHAPE, lower=-1e-12, upper=1e-12))
    yield from case("b = 0 on half of the cells", lambda: pool(SHAPE, b=np.where(noise(SHAPE) > 0, 0.0, noise(SHAPE, SEED + 12))))
    yield from case("equal b everywhere", lambda: pool(SHAPE, b=np.full(SHAPE, -1.0), lower=0.0, upper=50.0))
    yield from case("lower bounds of noise, l > 0", lambda: pool(SHAPE, lower=np.abs(noise(SHAPE, SEED + 13))))
    yield from case("upper bounds only", lambda: pool(SHAPE, lower=-np.inf, upper=0.0))
    yield from case("checkerboard of bounds", lambda: pool(SHAPE, lower=np.where(np.indices(SHAPE).sum(axis=0) % 2 == 0, 0.0, -np.inf)))
    yield from case("resting under a ceiling", ceiling)
    for far in (1e6, 1e20, -1e20):
        yield from case(f"start at {far:g}", lambda: pool(SHAPE), x0=np.full(SHAPE, far))


def planted(share: float) -> GridProblem:
    """Return b whose solution has x = y = 0 on a share of the cells."""
    chance = np.random.default_rng(SEED + 14)
    cells = pool(SHAPE).cells
    inside = cells == FLUID
    x = np.where(inside & (chance.random(SHAPE) >= share), chance.uniform(0.1, 1.0, SHAPE), 0.0)
    x[5, 5] = 1.0
    y = np.where(inside & (x == 0) & (chance.random(SHAPE) > 0.9) & (share < 1), chance.uniform(0.1, 1.0, SHAPE), 0.0)
    made = GridProblem(cells=cells, b=np.zeros(SHAPE))
    b = np.zeros(SHAPE)
    b[inside] = y[inside] - made.exact().matrix @ x[inside]
    return GridProblem(cells=cells, b=b)


def all_but_one() -> GridProblem:
    """Return b that pushes one cell away from its bound."""
    b = np.ones(SHAPE)
    b[11, 12] = -2.0
    return pool(SHAPE, b=b, lower=0.0)


def half_fixed() -> GridProblem:
    """Return bounds that leave every second cell no room."""
    odd = np.indices(SHAPE).sum(axis=0) % 2 == 1
    return pool(SHAPE, lower=np.where(odd, 0.3, -np.inf), upper=np.where(odd, 0.3, np.inf))


def ceiling() -> GridProblem:
    """Return liquid at rest up to a ceiling that separates: y = 0 there, x = 0 to rounding."""
    cells = np.full(SHAPE, FLUID)
    cells[-1, -6:] = AIR
    b = np.zeros(SHAPE)
    b[0], b[-2] = -0.1, 0.1
    b[-2, -6:] = 0.1
    return GridProblem(cells=cells, b=b, lower=np.where(np.indices(SHAPE)[0] >= 38, 0.0, -np.inf))


def tolerances() -> Iterator[Case]:
    """Yield tolerances that no arithmetic reaches: FLOOR, not CONVERGED and not an endless loop."""
    case = partial(both, "tolerances")
    for rtol in (1e-15, 1e-17, 0.0):
        for name, shape in (("2-D", (64, 66)), ("3-D", (17, 18, 19))):
            promises: dict[str, Promise] = same(BELOW_ROUNDING if rtol < 1e-16 else EXACT_OR_FLOOR)  # type: ignore[assignment]
            yield from case(
                f"rtol = {rtol:g}, {name}", partial(pool, shape), promises=promises, stopping={"rtol": rtol, "max_iterations": 500}
            )
    yield from case("rtol = 1e-12, single stops", lambda: pool((64, 66)), promises={"single": BELOW_ROUNDING}, stopping={"rtol": 1e-12})
    yield from case("atol = 1e30", lambda: pool(SHAPE), stopping={"atol": 1e30})
    stopped = Promise(Expected.STOPPED, frozenset({"MAX_ITERATIONS"}))
    for limit in (0, 1):
        yield from case(f"{limit} iterations", lambda: pool(SHAPE), promises=same(stopped), stopping={"max_iterations": limit})
    yield from case("256x256 to 1e-13", lambda: pool((256, 256)), promises=dict.fromkeys(PRECISIONS, EITHER), stopping={"rtol": 1e-13})
