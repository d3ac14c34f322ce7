"""Hostile grids: sizes and masks that leave little or nothing to coarsen."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Unpack

import numpy as np

import warp_lcp as wl
from warp_lcp.benchmarks.extremes.case import (
    EITHER,
    INFEASIBLE,
    SOLVED,
    ExtremeCase,
    RefusalCase,
    SolveCase,
)
from warp_lcp.benchmarks.extremes.problem import GridFields, GridProblem, Problem, solvable
from warp_lcp.files import TableValue

AIR, FLUID, SOLID = wl.AIR, wl.FLUID, wl.SOLID
SEED = 7919
METHODS = ("projected-multigrid", "minimum-map-newton")  # methods that must solve every grid
LARGE_BUDGET = 60.0  # seconds for 10^6 unknowns


def solve_cases(
    family: str,
    name: str,
    make: Callable[[], Problem],
    methods: tuple[str, ...] = METHODS,
    **more: TableValue,
) -> Iterator[ExtremeCase]:
    """Yield the case for each method.

    `more` holds arguments of SolveCase. Its entry `but` maps a method to another expected outcome.
    """
    but = more.pop("but", {})
    for method in methods:
        own = {"expected": but[method]} if method in but else {}
        yield SolveCase(family, f"{name}, {method}", make, method, **(more | own))


def chance(number: int) -> np.random.Generator:
    """Return the random generator of a problem."""
    return np.random.default_rng(SEED + number)


def noise(shape: tuple[int, ...], number: int = 0) -> np.ndarray:
    """Return normal noise of zero mean as a right-hand side."""
    b = chance(number).standard_normal(shape)
    return b - b.mean()


def full(shape: tuple[int, ...], **more: Unpack[GridFields]) -> GridProblem:
    """Return a closed box of liquid, with p >= 0."""
    return GridProblem(cells=np.full(shape, FLUID), **({"b": noise(shape)} | more))


def pool(shape: tuple[int, ...], **more: Unpack[GridFields]) -> GridProblem:
    """Return a pool with AIR as its topmost layer along y.

    On a random half of the cells p >= 0; the others have no bound.
    """
    cells = np.full(shape, FLUID)
    cells[(..., -1, slice(None))] = AIR
    lower = np.where(chance(1).random(shape) < 0.5, 0.0, -np.inf)
    return GridProblem(cells=cells, **({"b": noise(shape), "lower": lower} | more))


def grounded(shape: tuple[int, ...]) -> GridProblem:
    """Return a grid without AIR, made regular by a shift in its first cell."""
    shift = np.zeros(shape)
    shift.flat[0] = 1.0
    return full(shape, b=noise(shape) if np.prod(shape) > 1 else np.full(shape, -1.5), shift=shift)


def sizes() -> Iterator[ExtremeCase]:
    """Yield grids of one cell, one layer, prime sizes, 10^6 cells and long ones."""
    case = partial(solve_cases, "sizes")
    for shape in (
        (1, 1),
        (1, 1, 1),
        (1, 2),
        (2, 1),
        (1, 1, 7),
        (1, 7, 1),
        (7, 1, 1),
        (1, 1, 4096),
        (4096, 1, 1),
        (1, 13, 17),
    ):
        yield from case("x".join(map(str, shape)), partial(grounded, shape))
    for shape in ((2, 2), (3, 1), (127, 131), (1, 127, 131), (31, 37, 41), (2, 3, 5)):
        yield from case("x".join(map(str, shape)) + " below air", partial(pool, shape))
    for shape in ((3, 3000), (3000, 3), (2, 2000), (2, 2, 2000), (2000, 2, 2), (3, 2000, 3)):
        yield from case(
            "1:1000, " + "x".join(map(str, shape)),
            partial(pool, shape),
            promises={"single": EITHER},
        )
    yield from case("1024x1024", lambda: pool((1024, 1024)), budget=LARGE_BUDGET)
    yield from case(
        "1024x1024 with noise as mask", lambda: sponge((1024, 1024), 0.75), budget=LARGE_BUDGET
    )
    yield from case(
        "2-D like 3-D of one layer, periodic",
        lambda: pool((1, 61, 67), periodic=(True, False, False)),
    )


def sponge(shape: tuple[int, ...], liquid: float) -> GridProblem:
    """Return cells of random type, and b solvable in every component.

    Components without AIR or bound get a compatible b.
    """
    draw = chance(2)
    cells = draw.choice([AIR, FLUID, SOLID], shape, p=[(1 - liquid) / 2, liquid, (1 - liquid) / 2])
    return solvable(GridProblem(cells=cells, b=draw.standard_normal(shape)))


def masks() -> Iterator[ExtremeCase]:
    """Yield grids of few or no unknowns, checkerboards, needles and walls of one cell."""
    case = partial(solve_cases, "masks")
    for name, kind in (("solid", SOLID), ("air", AIR)):
        yield RefusalCase("masks", f"all {name}", partial(without_unknowns, kind), "A ")
    for name, around in (("air", AIR), ("solid", SOLID)):
        for shape in ((3, 3), (5, 5, 5)):
            for b in (-1.0, 1.0, 0.0):
                if not (around == SOLID and b < 0):
                    yield from case(
                        f"one cell in {name}, {len(shape)}-D, b = {b:g}",
                        partial(single, shape, around, b),
                    )
    yield from case(
        "one cell in solid, b = -1", lambda: single((3, 3), SOLID, -1.0), expected=INFEASIBLE
    )
    for shape in ((40, 41), (12, 13, 14)):
        for name, other in (("air", AIR), ("solid", SOLID)):
            yield from case(
                f"checkerboard of liquid and {name}, {len(shape)}-D",
                partial(checkerboard, shape, other),
            )
    # Limits of multigrid.
    yield from case("labyrinth 65x65", lambda: labyrinth(65), but={"projected-multigrid": EITHER})
    yield from case("labyrinth 33x33 without bounds", lambda: labyrinth(33, lower=-np.inf))
    yield from case("two pools joined by a needle", lambda: needle(64))
    yield from case("chambers behind walls of one cell", lambda: chambers(59))
    for shape in ((64, 64), (24, 24, 24)):
        yield from case(f"one air cell in {'x'.join(map(str, shape))}", partial(punctured, shape))
    for liquid in (0.1, 0.5, 0.9):
        yield from case(f"sponge, {liquid:.0%} liquid", partial(sponge, (67, 71), liquid))
    yield from case("3-D sponge, 60% liquid", lambda: sponge((19, 23, 29), 0.6))


def without_unknowns(kind: int, device: str, precision: str) -> wl.LCP:
    """Return a problem with no liquid cell."""
    return wl.LCP(wl.GridPoisson(np.full((4, 5), kind), device=device), np.zeros((4, 5)))


def single(shape: tuple[int, ...], around: int, b: float) -> GridProblem:
    """Return one liquid cell in the middle."""
    cells = np.full(shape, around)
    cells[tuple(n // 2 for n in shape)] = FLUID
    return GridProblem(cells=cells, b=np.full(shape, b))


def checkerboard(shape: tuple[int, ...], other: int) -> GridProblem:
    """Return liquid in every second cell.

    Among SOLID cells each is isolated, so that b >= 0 there.
    """
    odd, b = np.indices(shape).sum(axis=0) % 2 == 1, noise(shape)
    return GridProblem(cells=np.where(odd, FLUID, other), b=np.abs(b) if other == SOLID else b)


def labyrinth(n: int, **more: TableValue) -> GridProblem:
    """Return one winding channel of liquid, a cell wide, open to air at its end."""
    cells = np.full((n, n), FLUID)
    cells[1::2] = SOLID
    cells[1::4, -1] = cells[3::4, 0] = FLUID
    cells[-1] = AIR
    return GridProblem(cells=cells, b=noise((n, n)), **more)


def needle(n: int) -> GridProblem:
    """Return a pool without air, joined to one with air by a channel.

    The channel is a cell wide and half the grid long.
    """
    cells = np.full((n, 2 * n), FLUID)
    cells[:, n // 2 : n + n // 2] = SOLID
    cells[n // 3, n // 2 : n + n // 2] = FLUID
    cells[-1, n + n // 2 :] = AIR
    return GridProblem(
        cells=cells,
        b=noise(cells.shape),
        lower=np.where(np.indices(cells.shape)[0] == 0, 0.0, -np.inf),
    )


def chambers(n: int) -> GridProblem:
    """Return chambers of five cells, joined by single-cell holes, air in one of them."""
    cells = np.full((n, n), FLUID)
    cells[5::6], cells[:, 5::6] = SOLID, SOLID
    cells[5::6, 2::6], cells[2::6, 5::6] = FLUID, FLUID
    cells[:5, :5] = AIR
    return GridProblem(
        cells=cells, b=noise((n, n)), lower=np.where(noise((n, n), 3) > 0, 0.0, -np.inf)
    )


def punctured(shape: tuple[int, ...]) -> GridProblem:
    """Return liquid with one cell of air, which alone makes the matrix regular."""
    cells = np.full(shape, FLUID)
    cells[tuple(n // 3 for n in shape)] = AIR
    return GridProblem(cells=cells, b=noise(shape), lower=-np.inf)


def closed_pools() -> Iterator[ExtremeCase]:
    """Yield closed pools of liquid.

    b of sum 0 is solvable; other b only if a bound separates.
    """
    case = partial(solve_cases, "closed pools")
    for shape in ((48, 53), (17, 18, 19)):
        yield from case(f"compatible, {len(shape)}-D", partial(full, shape, lower=-np.inf))
        for flow, b in (("outflow", noise(shape) + 0.1), ("inflow", noise(shape) - 0.1)):
            off = f"{flow}, {len(shape)}-D"
            yield from case(
                f"incompatible {off}", partial(full, shape, b=b, lower=-np.inf), expected=INFEASIBLE
            )
            yield from case(
                f"p >= 0, {off}",
                partial(full, shape, b=b),
                expected=SOLVED if flow == "outflow" else INFEASIBLE,
            )
    yield from case("one of 40 is incompatible", lambda: many_pools(0.05), expected=INFEASIBLE)
    yield from case("40 compatible ones", lambda: many_pools(0.0))
    yield from case(
        "boxed, inflow", lambda: full((9, 9), b=noise((9, 9)) - 0.2, lower=-1.0, upper=1.0)
    )
    yield from case(
        "incompatible by rounding only",
        lambda: full((64, 64), b=noise((64, 64)) * 1e6, lower=-np.inf),
    )
    yield from case(
        "periodic in x and y, compatible",
        lambda: full((31, 32), lower=-np.inf, periodic=(True, True, False)),
    )


def many_pools(net: float) -> GridProblem:
    """Return 40 pools in a row behind solid walls, b of zero mean in each.

    In the last pool the mean is shifted by `net`.
    """
    cells = np.full((8, 40 * 7), FLUID)
    cells[:, 6::7] = SOLID
    b = np.where(cells == FLUID, noise(cells.shape), 0.0)
    for at in range(0, cells.shape[1], 7):
        b[:, at : at + 6] -= b[:, at : at + 6].mean()
    b[:, -7:-1] += net
    return GridProblem(cells=cells, b=b, lower=-np.inf)
