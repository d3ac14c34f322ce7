"""Families of coefficients: slivers, contrasts over many decades, flat cells, and rigid bodies of any mass."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from warp_lcp.benchmarks.extremes.case import EITHER, PRECISIONS, Case, SolveCase
from warp_lcp.benchmarks.extremes.problem import GridProblem
from warp_lcp.benchmarks.extremes.shapes import AIR, FLUID, SEED, SOLID, both, noise, pool, same

SHAPES = ((48, 53), (17, 18, 19))
ROUGH = {"rtol": 1e-6}  # where the matrix's own rounding is felt: 12 decades beside each other
SINGLE_MAY_STOP = {"single": EITHER}
MIXED_MAY_STOP = {"single": EITHER, "mixed": EITHER}
# Documented limits: corrections of float32 know a cell's diagonal to 6e-8 of it, and what holds a light region to less than the contrast
LARGEST_CONTRAST = 1e4
LIGHTEST = 1e6  # 1/mass beyond which float32 does not tell the force on a body from the pressures that it is the difference of


def faces_of(shape: tuple[int, ...], value: Any) -> dict[str, np.ndarray]:
    """Return arrays of coefficients; `value` takes an array's shape."""
    sizes = {}
    for axis, name in enumerate(("face_x", "face_y", "face_z")[: len(shape)]):
        counts = list(shape)
        counts[-1 - axis] += 1
        sizes[name] = value(tuple(counts))
    return sizes


def slivers() -> Iterator[Case]:
    """Yield cut cells whose open fractions go down to 1e-12 and below."""
    case = partial(both, "cut fractions")
    for shape in SHAPES:
        for smallest in (1e-3, 1e-6, 1e-12, 1e-30):
            name = f"one face in 20 open by {smallest:g}, {len(shape)}-D"
            yield from case(name, partial(sprinkled, shape, smallest), promises=SINGLE_MAY_STOP)
        yield from case(f"fractions 0 to 1, {len(shape)}-D", partial(uniform_fractions, shape), promises=SINGLE_MAY_STOP)
    for fraction in (1e-3, 1e-6, 1e-12):
        name = f"pool behind a face open by {fraction:g}"
        yield from case(name, partial(behind_a_gap, fraction), promises=SINGLE_MAY_STOP)
        yield from case(f"lone cells behind {fraction:g}", partial(lone_cells, fraction), promises=SINGLE_MAY_STOP)
    for theta in (1e-2, 1e-6, 1e-12):
        yield from case(f"surface at 1/{theta:g}", partial(ghost_fluid, theta), promises=SINGLE_MAY_STOP)


def sprinkled(shape: tuple[int, ...], smallest: float) -> GridProblem:
    """Return a pool with a few faces all but closed."""
    chance = np.random.default_rng(SEED + 5)
    return pool(shape, faces=faces_of(shape, lambda counts: np.where(chance.random(counts) < 0.05, smallest, 1.0)))


def uniform_fractions(shape: tuple[int, ...]) -> GridProblem:
    """Return a pool with random fractions, a tenth of them 0; p >= 0 everywhere, so that enclosed cells with outflow have a solution."""
    chance = np.random.default_rng(SEED + 6)

    def fractions(counts: tuple[int, ...]) -> np.ndarray:
        return np.maximum(chance.uniform(-0.1, 1.0, counts), 0.0)

    return pool(shape, faces=faces_of(shape, fractions), lower=0.0, b=noise(shape) + 0.5)


def behind_a_gap(fraction: float) -> GridProblem:
    """Return two halves, one with air, joined by one face open by `fraction`; b that asks the gap for a flow in proportion to it."""
    shape = (32, 64)
    cells = np.full(shape, FLUID)
    cells[-1, 32:] = AIR
    face_x = np.ones((32, 65))
    face_x[:, 32] = 0.0
    face_x[10, 32] = fraction
    b = noise(shape)
    b[:, :32] += fraction / (32 * 32) - b[:, :32].mean()
    return GridProblem(cells=cells, b=b, faces={"face_x": face_x, "face_y": np.ones((33, 64))}, lower=-np.inf)


def lone_cells(fraction: float) -> GridProblem:
    """Return a pool with cells all of whose faces are open by `fraction` only, and b in proportion."""
    shape = (40, 40)
    face_x, face_y, b = np.ones((40, 41)), np.ones((41, 40)), noise(shape)
    for j in range(3, 36, 4):
        face_x[j, j : j + 2] = face_y[j : j + 2, j] = fraction
        b[j, j] *= fraction
    return pool(shape, faces={"face_x": face_x, "face_y": face_y}, b=b)


def ghost_fluid(theta: float) -> GridProblem:
    """Return a pool whose surface lies at random distances from cell centers, down to `theta` of a cell."""
    shape = (40, 44)
    chance = np.random.default_rng(SEED + 8)
    face_y = np.ones((41, 44))
    face_y[-2] = 1 / np.maximum(theta, 10 ** chance.uniform(np.log10(theta), 0, 44))
    return pool(shape, faces={"face_x": np.ones((40, 45)), "face_y": face_y})


def contrasts() -> Iterator[Case]:
    """Yield coefficients over 12 decades, densities to 10^8 to 1, and cells a thousand times flatter than wide."""
    case = partial(both, "contrasts")
    for ratio in (1e2, 1e4, 1e6, 1e8):
        promises = SINGLE_MAY_STOP if ratio <= LARGEST_CONTRAST else MIXED_MAY_STOP
        yield from case(f"layers of density 1:{ratio:g}", partial(layered, ratio), promises=promises, stopping=ROUGH)
        yield from case(f"bubbles of density 1:{ratio:g}", partial(bubbles, ratio), promises=promises, stopping=ROUGH)
    for shape in SHAPES:
        for decades in (4, 12):
            name = f"coefficients over {decades} decades, {len(shape)}-D"
            promises = dict.fromkeys(PRECISIONS, EITHER) if decades == 12 else SINGLE_MAY_STOP
            yield from case(name, partial(decades_of, shape, decades), promises=promises, stopping=ROUGH)
        for axis in range(len(shape)):
            for ratio in (1e3, 1e-3):
                name = f"anisotropy {ratio:g} along {'xyz'[axis]}, {len(shape)}-D"
                yield from case(name, partial(pool, shape, faces={f"face_{'xyz'[axis]}": ratio}))
    for low, high in ((-6, 6), (0, 12), (-12, 0)):
        name = f"shift from 1e{low} to 1e{high}"
        yield from case(name, partial(shifted, low, high), promises=SINGLE_MAY_STOP, stopping=ROUGH)
    for scale in (1e-12, 1e12, 1e-30, 1e30):
        name = f"all coefficients {scale:g}"
        yield from case(name, partial(pool, (40, 44), faces={"face_x": scale, "face_y": scale}))


def layered(ratio: float) -> GridProblem:
    """Return layers across y whose coefficients alternate between 1 and 1 / ratio."""
    shape = (48, 50)
    light = (np.arange(48) // 6) % 2 == 1
    cell = np.where(light, 1.0, 1 / ratio)[:, None] * np.ones(shape)
    return pool(shape, faces=harmonic(cell))


def bubbles(ratio: float) -> GridProblem:
    """Return light discs in heavy liquid."""
    y, x = np.indices((48, 50)) % 16 - 7.5
    return pool((48, 50), faces=harmonic(np.where(np.hypot(x, y) < 5, 1.0, 1 / ratio)))


def harmonic(cell: np.ndarray) -> dict[str, np.ndarray]:
    """Return faces with the harmonic mean of the cells beside them."""
    across = [np.concatenate([c[:1], 2 * c[1:] * c[:-1] / (c[1:] + c[:-1]), c[-1:]]) for c in (cell.T, cell)]
    return {"face_x": across[0].T, "face_y": across[1]}


def decades_of(shape: tuple[int, ...], decades: int) -> GridProblem:
    """Return a pool of coefficients that are random over so many decades, face by face."""
    chance = np.random.default_rng(SEED + 9)
    faces = faces_of(shape, lambda counts: 10 ** chance.uniform(-decades / 2, decades / 2, counts))
    return pool(shape, faces=faces)


def shifted(low: int, high: int) -> GridProblem:
    """Return a closed pool with a shift that is random over decades."""
    shape = (40, 44)
    shift = 10 ** np.random.default_rng(SEED + 10).uniform(low, high, shape)
    return GridProblem(cells=np.full(shape, FLUID), b=noise(shape), shift=shift)


def bodies() -> Iterator[Case]:
    """Yield rigid bodies in the liquid, as a term U W U' of masses from 10^-8 to 10^8 of the liquid's."""
    family = "rigid bodies"
    case = partial(both, family)
    for inverse in (1e-8, 1e-4, 1.0, 1e4, 1e8):
        promises = SINGLE_MAY_STOP if inverse <= LIGHTEST else MIXED_MAY_STOP
        yield from case(f"one body, 1/mass = {inverse:g}", partial(swimming, [inverse]), promises=promises, stopping=ROUGH)
    name, four = "four, 1/mass from 1e-8 to 1e8", partial(swimming, [1e-8, 1e8, 1.0, 1e4])
    yield SolveCase(family, f"{name}, projected-multigrid", four, promises=MIXED_MAY_STOP, stopping=ROUGH)
    yield SolveCase(family, f"{name}, minimum-map-newton", four, "minimum-map-newton", same(EITHER), stopping=ROUGH)
    yield from case("held: W = 0", lambda: swimming([0.0, 0.0]))
    for inverse in (1e2, 1e4, 1e6, 1e8):
        promises = SINGLE_MAY_STOP if inverse <= LIGHTEST else MIXED_MAY_STOP
        yield from case(f"two, 1/mass = {inverse:g}, 3-D", partial(swimming_3d, [inverse, inverse]), promises=promises, stopping=ROUGH)
    yield from case("heavy bodies, 3-D", lambda: swimming_3d([1e-8, 1e-8]))
    yield from case("a column that touches nothing", with_empty_column)
    yield from case("two equal columns", doubled_column)
    yield from case("a piston closes a chamber", piston)


def swimming(inverse_masses: list[float]) -> GridProblem:
    """Return a pool around square bodies: solid cells, whose pressure force along x and y is a column each."""
    shape = (48, 50)
    problem = pool(shape)
    cells, columns = problem.cells.copy(), []
    for number in range(len(inverse_masses)):
        j, i = 6 + 20 * (number // 2), 8 + 20 * (number % 2)
        cells[j : j + 8, i : i + 8] = SOLID
        columns += square(shape, j, i, 8)
    W = np.diag(np.repeat(np.array(inverse_masses), 2))
    return GridProblem(cells=cells, b=problem.b, lower=problem.lower, columns=np.stack(columns, axis=-1), weights=W)


def square(shape: tuple[int, ...], j: int, i: int, n: int) -> list[np.ndarray]:
    """Return how much a square body displaces in each cell when it moves along x, and along y."""
    x, y = np.zeros(shape), np.zeros(shape)
    x[j : j + n, i - 1], x[j : j + n, i + n] = 1.0, -1.0
    y[j - 1, i : i + n], y[j + n, i : i + n] = 1.0, -1.0
    return [x, y]


def swimming_3d(inverse_masses: list[float]) -> GridProblem:
    """Return bodies of three cells a side in a 3-D pool, each moving along y."""
    shape = (14, 15, 24)
    problem = pool(shape)
    cells, columns = problem.cells.copy(), []
    for number in range(len(inverse_masses)):
        i = 4 + 10 * number
        cells[5:8, 5:8, i : i + 3] = SOLID
        u = np.zeros(shape)
        u[5:8, 4, i : i + 3], u[5:8, 8, i : i + 3] = 1.0, -1.0
        columns.append(u)
    return GridProblem(
        cells=cells, b=problem.b, lower=problem.lower, columns=np.stack(columns, axis=-1), weights=np.diag(np.array(inverse_masses))
    )


def with_empty_column() -> GridProblem:
    """Return a body in air beside one in the liquid."""
    made = swimming([1.0])
    assert made.columns is not None
    columns = np.concatenate([made.columns, np.zeros((*made.cells.shape, 1))], axis=-1)
    return GridProblem(cells=made.cells, b=made.b, lower=made.lower, columns=columns, weights=np.diag([1.0, 1.0, 1e8]))


def doubled_column() -> GridProblem:
    """Return one body counted twice: the columns are linearly dependent."""
    made = swimming([10.0])
    assert made.columns is not None
    columns = np.concatenate([made.columns, made.columns[..., :1]], axis=-1)
    return GridProblem(cells=made.cells, b=made.b, lower=made.lower, columns=columns, weights=np.diag([10.0, 10.0, 3.0]))


def piston() -> GridProblem:
    """Return a chamber without air whose one wall is a body: its constants are no null space."""
    cells = np.full((20, 40), FLUID)
    cells[:, 19] = SOLID
    cells[-1, 20:] = AIR
    u = np.zeros(cells.shape)
    u[:, 18], u[:-1, 20] = 1.0, -1.0
    return GridProblem(cells=cells, b=noise(cells.shape), lower=-np.inf, columns=u[..., None], weights=np.array([[0.05]]))
