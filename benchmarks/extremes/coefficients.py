"""Hostile coefficients: slivers, contrasts, flat cells, bodies of any mass."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from warp_lcp.benchmarks.extremes.case import EITHER, SOLVED, ExtremeCase
from warp_lcp.benchmarks.extremes.problem import GridProblem, faces_of
from warp_lcp.benchmarks.extremes.shapes import (
    AIR,
    FLUID,
    SOLID,
    chance,
    full,
    noise,
    pool,
    solve_cases,
)
from warp_lcp.files import Tables

SHAPES = ((48, 53), (17, 18, 19))
Y, X = np.indices((48, 50))
# Limited by the matrix's own rounding: neighboring entries differ by 12 decades.
ROUGH = {"rtol": 1e-6}
SINGLE_MAY_STOP = {"single": EITHER}
MIXED_MAY_STOP = {"single": EITHER, "mixed": EITHER}
# Documented limit: float32 corrections resolve a cell's diagonal to 6e-8 of it, and the coupling of
# a light region only up to this contrast.
LARGEST_CONTRAST = 1e4
# Largest 1/mass: beyond it float32 cannot resolve the force on a body as a difference of pressures.
LIGHTEST = 1e6


def may_stop(value: float, largest: float) -> Tables:
    """Return the promise for a ratio whose documented limit is `largest`."""
    return {"promises": SINGLE_MAY_STOP if value <= largest else MIXED_MAY_STOP, "stopping": ROUGH}


def slivers() -> Iterator[ExtremeCase]:
    """Yield cut cells whose open fractions go down to 1e-12 and below."""
    case = partial(solve_cases, "cut fractions", promises=SINGLE_MAY_STOP)
    for shape in SHAPES:
        for smallest in (1e-3, 1e-6, 1e-12, 1e-30):
            yield from case(
                f"one face in 20 open by {smallest:g}, {len(shape)}-D",
                partial(sprinkled, shape, smallest),
            )
        yield from case(f"fractions 0 to 1, {len(shape)}-D", partial(uniform_fractions, shape))
    for fraction in (1e-3, 1e-6, 1e-12):
        yield from case(f"pool behind a face open by {fraction:g}", partial(behind_a_gap, fraction))
        yield from case(f"lone cells behind {fraction:g}", partial(lone_cells, fraction))
    for theta in (1e-2, 1e-6, 1e-12):
        yield from case(f"surface at 1/{theta:g}", partial(ghost_fluid, theta))


def sprinkled(shape: tuple[int, ...], smallest: float) -> GridProblem:
    """Return a pool with a few nearly closed faces."""
    draw = chance(5)
    return pool(
        shape,
        faces=faces_of(shape, lambda counts: np.where(draw.random(counts) < 0.05, smallest, 1.0)),
    )


def uniform_fractions(shape: tuple[int, ...]) -> GridProblem:
    """Return a pool with random open fractions, a tenth of them 0.

    p >= 0 everywhere, so that enclosed cells with outflow have a solution.
    """
    draw = chance(6)
    return pool(
        shape,
        faces=faces_of(shape, lambda counts: np.maximum(draw.uniform(-0.1, 1, counts), 0)),
        lower=0.0,
        b=noise(shape) + 0.5,
    )


def behind_a_gap(fraction: float) -> GridProblem:
    """Return two halves, one with air, joined by one face open by `fraction`.

    b requires a flow through the gap in proportion to its fraction.
    """
    shape = (32, 64)
    cells, faces, b = np.full(shape, FLUID), faces_of(shape, np.ones), noise(shape)
    cells[-1, 32:] = AIR
    faces["face_x"][:, 32] = 0.0
    faces["face_x"][10, 32] = fraction
    b[:, :32] += fraction / (32 * 32) - b[:, :32].mean()
    return GridProblem(cells=cells, b=b, faces=faces, lower=-np.inf)


def lone_cells(fraction: float) -> GridProblem:
    """Return a pool with cells whose faces are all open by `fraction` only.

    b is in proportion to it in these cells.
    """
    shape = (40, 40)
    faces, b = faces_of(shape, np.ones), noise(shape)
    for j in range(3, 36, 4):
        faces["face_x"][j, j : j + 2] = faces["face_y"][j : j + 2, j] = fraction
        b[j, j] *= fraction
    return pool(shape, faces=faces, b=b)


def ghost_fluid(theta: float) -> GridProblem:
    """Return a pool whose surface lies at random distances from cell centers.

    The smallest distance is `theta` of a cell.
    """
    faces = faces_of((40, 44), np.ones)
    faces["face_y"][-2] = 1 / np.maximum(theta, 10 ** chance(8).uniform(np.log10(theta), 0, 44))
    return pool((40, 44), faces=faces)


def contrasts() -> Iterator[ExtremeCase]:
    """Yield coefficients of 12 decades, density ratios of 10^8 and very flat cells.

    The cells are up to a thousand times flatter than wide.
    """
    case = partial(solve_cases, "contrasts")
    for ratio in (1e2, 1e4, 1e6, 1e8):
        for name, light in (
            ("layers", (Y // 6) % 2 == 1),
            ("bubbles", np.hypot(Y % 16 - 7.5, X % 16 - 7.5) < 5),
        ):
            make_problem = partial(pool, Y.shape, faces=harmonic(np.where(light, 1.0, 1 / ratio)))
            yield from case(
                f"{name} of density 1:{ratio:g}", make_problem, **may_stop(ratio, LARGEST_CONTRAST)
            )
    for shape in SHAPES:
        for decades, expected in ((4, SOLVED), (12, EITHER)):
            name, make = (
                f"coefficients over {decades} decades, {len(shape)}-D",
                partial(decades_of, shape, decades),
            )
            yield from case(name, make, expected=expected, promises=SINGLE_MAY_STOP, stopping=ROUGH)
        for axis in "xyz"[: len(shape)]:
            for ratio in (1e3, 1e-3):
                yield from case(
                    f"anisotropy {ratio:g} along {axis}, {len(shape)}-D",
                    partial(pool, shape, faces={f"face_{axis}": ratio}),
                )
    for low, high in ((-6, 6), (0, 12), (-12, 0)):
        make_problem = partial(full, (40, 44), shift=10 ** chance(10).uniform(low, high, (40, 44)))
        yield from case(
            f"shift from 1e{low} to 1e{high}",
            make_problem,
            promises=SINGLE_MAY_STOP,
            stopping=ROUGH,
        )
    for scale in (1e-12, 1e12, 1e-30, 1e30):
        yield from case(
            f"all coefficients {scale:g}",
            partial(pool, (40, 44), faces={"face_x": scale, "face_y": scale}),
        )


def harmonic(cell: np.ndarray) -> dict[str, np.ndarray]:
    """Return face coefficients: harmonic means of the adjacent cells."""
    across = [
        np.concatenate([c[:1], 2 * c[1:] * c[:-1] / (c[1:] + c[:-1]), c[-1:]])
        for c in (cell.T, cell)
    ]
    return {"face_x": across[0].T, "face_y": across[1]}


def decades_of(shape: tuple[int, ...], decades: int) -> GridProblem:
    """Return a pool of random face coefficients over so many decades."""
    draw = chance(9)
    return pool(
        shape,
        faces=faces_of(shape, lambda counts: 10 ** draw.uniform(-decades / 2, decades / 2, counts)),
    )


def bodies() -> Iterator[ExtremeCase]:
    """Yield rigid bodies in the liquid, as a term U W U'.

    Their masses are 10^-8 to 10^8 of the liquid's.
    """
    case = partial(solve_cases, "rigid bodies")
    for inverse in (1e-8, 1e-4, 1.0, 1e4, 1e8):
        yield from case(
            f"one body, 1/mass = {inverse:g}",
            partial(swimming, [inverse]),
            **may_stop(inverse, LIGHTEST),
        )
    four, promises, but = (
        partial(swimming, [1e-8, 1e8, 1.0, 1e4]),
        MIXED_MAY_STOP,
        {"minimum-map-newton": EITHER},
    )
    yield from case(
        "four, 1/mass from 1e-8 to 1e8", four, promises=promises, but=but, stopping=ROUGH
    )
    yield from case("held: W = 0", lambda: swimming([0.0, 0.0]))
    for inverse in (1e2, 1e4, 1e6, 1e8):
        yield from case(
            f"two, 1/mass = {inverse:g}, 3-D",
            partial(swimming_3d, [inverse, inverse]),
            **may_stop(inverse, LIGHTEST),
        )
    yield from case("heavy bodies, 3-D", lambda: swimming_3d([1e-8, 1e-8]))
    # The term of a body in air.
    yield from case("a column that touches nothing", lambda: with_column(swimming([1.0]), 0.0, 1e8))
    # The term of a body counted twice.
    yield from case("two equal columns", lambda: with_column(swimming([10.0]), 1.0, 3.0))
    yield from case("a piston closes a chamber", piston)


def swimming(inverse_masses: Sequence[float]) -> GridProblem:
    """Return a pool around square bodies.

    Bodies are solid cells; each has a column for its pressure force along x and one along y.
    """
    problem, n = pool((48, 50)), 8
    cells, U = problem.cells.copy(), np.zeros((*problem.cells.shape, len(inverse_masses), 2))
    for number in range(len(inverse_masses)):
        j, i = 6 + 20 * (number // 2), 8 + 20 * (number % 2)
        cells[j : j + n, i : i + n] = SOLID
        U[j : j + n, i - 1, number, 0], U[j : j + n, i + n, number, 0] = 1.0, -1.0
        U[j - 1, i : i + n, number, 1], U[j + n, i : i + n, number, 1] = 1.0, -1.0
    return replace(
        problem,
        cells=cells,
        columns=U.reshape(*cells.shape, -1),
        weights=np.diag(np.repeat(np.array(inverse_masses), 2)),
    )


def swimming_3d(inverse_masses: Sequence[float]) -> GridProblem:
    """Return cubic bodies, three cells a side, in a 3-D pool, each moving along y."""
    problem = pool((14, 15, 24))
    cells, U = problem.cells.copy(), np.zeros((*problem.cells.shape, len(inverse_masses)))
    for number in range(len(inverse_masses)):
        i = 4 + 10 * number
        cells[5:8, 5:8, i : i + 3] = SOLID
        U[5:8, 4, i : i + 3, number], U[5:8, 8, i : i + 3, number] = 1.0, -1.0
    return replace(problem, cells=cells, columns=U, weights=np.diag(np.array(inverse_masses)))


def with_column(problem: GridProblem, factor: float, weight: float) -> GridProblem:
    """Return the problem with its first column repeated, times a factor.

    The columns are then linearly dependent.
    """
    assert problem.columns is not None
    assert problem.weights is not None
    weights = np.diag([*problem.weights.diagonal(), weight])
    return replace(
        problem,
        columns=np.concatenate([problem.columns, factor * problem.columns[..., :1]], axis=-1),
        weights=weights,
    )


def piston() -> GridProblem:
    """Return a chamber without air, one of whose walls is a body.

    Its constants are not in the null space.
    """
    cells = np.full((20, 40), FLUID)
    cells[:, 19] = SOLID
    cells[-1, 20:] = AIR
    u = np.zeros(cells.shape)
    u[:, 18], u[:-1, 20] = 1.0, -1.0
    return GridProblem(
        cells=cells,
        b=noise(cells.shape),
        lower=-np.inf,
        columns=u[..., None],
        weights=np.array([[0.05]]),
    )
