"""Random grids: domains, contact with obstacles, bounds and coefficients."""

from __future__ import annotations

import numpy as np
import scipy.ndimage

from warp_lcp import gallery
from warp_lcp.benchmarks.extremes.problem import GridProblem, faces_of, with_solution
from warp_lcp.benchmarks.extremes.unseen.draw import AIR, FLUID, SOLID, SeededGenerator, framed
from warp_lcp.files import Tables, TableValue


def some_bounds(draw: SeededGenerator, shape: tuple[int, ...]) -> Tables:
    """Return x >= 0 everywhere, on some cells, in one layer, or with an upper bound."""
    kind = draw.of("all", "all", "some", "layer", "box")
    if kind == "all":
        return {}
    if kind == "some":
        return {"lower": np.where(draw.rng.random(shape) < draw.between(0.05, 0.9), 0.0, -np.inf)}
    if kind == "layer":
        return {
            "lower": np.where(np.indices(shape)[draw.rng.integers(len(shape))] == 0, 0.0, -np.inf)
        }
    return {"upper": draw.decades(0.1, 100)}


def loaded(draw: SeededGenerator, cells: np.ndarray, **more: TableValue) -> GridProblem:
    """Return a problem with a random right-hand side and bounds on these cells."""
    return GridProblem(
        cells=cells, b=draw.load(cells.shape), **more, **some_bounds(draw, cells.shape)
    )


def strip(draw: SeededGenerator) -> GridProblem:
    """Return a long strip, 1 to 40 cells wide, with AIR at one end or both.

    Some strips have an upper bound.
    """
    length = draw.whole(50, 5000)
    wide = (draw.whole(1, 40),) if draw.chance(0.8) else (draw.whole(1, 6), draw.whole(1, 6))
    cells = np.full((*wide, length), FLUID)
    cells[..., -1] = AIR
    if draw.chance(0.3):
        cells[..., 0] = AIR
    b = draw.load(cells.shape)
    turn = draw.rng.permutation(cells.ndim)
    return GridProblem(
        cells=cells.transpose(turn),
        b=b.transpose(turn),
        upper=draw.decades(1, 1e4) if draw.chance(0.3) else np.inf,
    )


def vent(draw: SeededGenerator) -> GridProblem:
    """Return a box of liquid with a few single cells of AIR."""
    cells = np.full(draw.shape(draw.of(2, 2, 3)), FLUID)
    cells.flat[draw.rng.integers(cells.size, size=draw.of(1, 1, 2, 4))] = AIR
    return loaded(draw, cells)


def voxels(draw: SeededGenerator) -> GridProblem:
    """Return random blobs of AIR and SOLID in liquid, in 2-D or 3-D."""
    shape = draw.shape(draw.of(2, 3))
    width = draw.decades(1, 8)
    air, solid = draw.smooth(shape, width), draw.smooth(shape, width)
    cells = np.where(
        air > draw.between(0.2, 0.7), AIR, np.where(solid > draw.between(0.2, 0.7), SOLID, FLUID)
    )
    cells.flat[0], cells.flat[-1] = AIR, FLUID
    return loaded(draw, cells)


def liquid(draw: SeededGenerator) -> GridProblem:
    """Return a body of liquid with a rough surface in a box.

    b is the divergence of noise and of a fall; p >= 0 at walls or everywhere.
    """
    dimensions = draw.of(2, 3)
    shape = draw.shape(dimensions)
    surface = shape[0] * (
        draw.between(0.3, 0.8) + 0.2 * draw.smooth(shape[1:], draw.decades(2, 20))
    )
    height = np.arange(shape[0]).reshape(-1, *(1,) * (dimensions - 1))
    cells = np.where(height < surface, FLUID, AIR)
    cells[0].flat[0], cells[-1] = FLUID, AIR
    b = np.zeros(shape)
    for axis in range(dimensions):
        b += np.diff(draw.smooth(tuple(n + (q == axis) for q, n in enumerate(shape)), 4), axis=axis)
    b[0] -= draw.between(-1, 1)
    walls = np.ones(shape, dtype=bool)
    walls[(slice(1, -1),) * dimensions] = False
    lower = 0.0 if draw.chance(0.5) else np.where(walls, 0.0, -np.inf)
    return GridProblem(cells=cells, b=b, lower=lower)


def periodic(draw: SeededGenerator) -> GridProblem:
    """Return a box that is periodic along some axes, held by bounds on 1 or 2 cells."""
    dimensions = draw.of(2, 2, 3)
    shape = draw.shape(dimensions)
    wraps = (True, True, draw.chance(0.5)) if draw.chance(0.7) else (True, False, False)
    b = draw.smooth(shape, draw.decades(1, 6)) if draw.chance(0.7) else draw.noise(shape)
    lower, upper = np.full(shape, -np.inf), np.full(shape, np.inf)
    first, second = draw.rng.integers(b.size, size=2)
    sign = draw.of(-1.0, 1.0)
    (upper if sign < 0 else lower).flat[first] = draw.of(-1, 1) * draw.decades(1, 1e5)
    if draw.chance(0.5) and second != first:
        lower.flat[second] = min(-draw.decades(1, 1e5), float(upper.flat[second]))
    return GridProblem(
        cells=np.full(shape, FLUID),
        b=b - b.mean() + sign * draw.decades(1e-3, 1),
        lower=lower,
        upper=upper,
        periodic=wraps,
    )


def handful(draw: SeededGenerator) -> GridProblem:
    """Return one to sixty cells of any type."""
    dimensions = draw.of(2, 3)
    most = 8 if dimensions == 2 else 5
    shape = tuple(int(n) for n in draw.rng.integers(1, most, size=(dimensions,)))
    cells = draw.rng.choice([FLUID, AIR, SOLID], shape, p=[0.7, 0.2, 0.1])
    cells.flat[draw.rng.integers(cells.size)] = FLUID
    shift = draw.decades(1e-3, 1) if draw.chance(0.4) else None
    return GridProblem(cells=cells, b=draw.noise(shape), shift=shift, **some_bounds(draw, shape))


def section(draw: SeededGenerator, n: int) -> np.ndarray:
    """Return a cross-section of a bar.

    It is a square, a rectangle, an ellipse, an L, a triangle or a square with a hole.
    """
    kind = draw.of("square", "square", "rectangle", "ellipse", "L", "triangle", "hole")
    X, Y = np.meshgrid(*(np.linspace(0, 1, n),) * 2)
    if kind == "rectangle":
        return np.ones((n, max(3, int(n * draw.between(0.2, 0.9)))), dtype=bool)
    if kind == "ellipse":
        return np.asarray((X - 0.5) ** 2 + ((Y - 0.5) / draw.between(0.3, 1)) ** 2 < 0.25)
    if kind == "L":
        corner = draw.between(0.3, 0.7)
        return np.asarray((corner < X) | (draw.between(0.3, 0.7) < Y))
    if kind == "triangle":
        return np.asarray(Y <= X)
    if kind == "hole":
        return np.asarray(np.maximum(np.abs(X - 0.5), np.abs(Y - 0.5)) > draw.between(0.1, 0.3))
    return np.ones((n, n), dtype=bool)


def torsion(draw: SeededGenerator) -> GridProblem:
    """Return elastic-plastic torsion: |x| at most the distance to the border.

    The load is 2 to 30.
    """
    n = max(4, draw.side())
    cells = framed(section(draw, n))
    distance = scipy.ndimage.distance_transform_edt(cells == FLUID) / (n + 1)
    load = draw.decades(2, 30) * draw.of(-1, -1, 1)
    b = (
        load
        * (draw.smooth(cells.shape, n / 8) if draw.chance(0.2) else np.ones(cells.shape))
        / (n + 1) ** 2
    )
    return GridProblem(cells=cells, b=b, lower=-distance, upper=distance)


def rough(draw: SeededGenerator) -> GridProblem:
    """Return noise between two rough obstacles, AIR on one side."""
    shape = draw.shape()
    cells = np.full(shape, FLUID)
    cells[0] = 0
    b = draw.noise(shape) * draw.between(0.1, 1) - 0.02
    size = draw.decades(0.5, 50)
    low, high = (
        -(draw.smooth(shape, draw.decades(2, 12)) ** 2) * size,
        draw.smooth(shape, draw.decades(2, 16)) ** 2 * size,
    )
    return GridProblem(cells=cells, b=b, lower=low, upper=high + draw.between(0, 1))


def dam(draw: SeededGenerator) -> GridProblem:
    """Return seepage through a dam, by Baiocchi's variable.

    Width and water levels are random.
    """
    nx = max(5, draw.side())
    ny = max(5, int(nx * draw.between(0.6, 2)))
    width, high = draw.between(8, 32), draw.between(16, 32)
    flat = high * (nx - 1) / width / (ny - 1)
    problem = gallery.dam(
        nx, ny, width=width, high=high, low=high * draw.between(0, 0.6), device="cpu"
    )
    return GridProblem(
        cells=framed(np.ones((ny - 2, nx - 2))),
        b=problem.b,
        faces={"face_x": flat, "face_y": 1 / flat},
    )


def bearing(draw: SeededGenerator) -> GridProblem:
    """Return a journal bearing's film with cavitation: Reynolds' equation.

    Coefficients are h^3 around the shaft; the pressure is >= 0.
    """
    nx, ny = max(6, draw.side()), max(4, draw.side() // 2)
    eccentric, angle = draw.between(0.2, 0.95), 2 * np.pi / nx
    height = 1 + eccentric * np.cos(angle * np.arange(nx + 1))
    middle = 1 + eccentric * np.cos(angle * (np.arange(nx) + 0.5))
    slender = draw.decades(0.1, 10) * nx / (2 * np.pi * ny)  # hx / hy
    cells = np.full((ny + 2, nx), FLUID)
    cells[[0, -1]] = 0
    b = np.broadcast_to(angle * np.diff(height), cells.shape)
    faces = {
        "face_x": np.tile(height**3, (ny + 2, 1)),
        "face_y": np.tile(middle**3 * slender**2, (ny + 3, 1)),
    }
    faces["face_x"][:, -1] = faces["face_x"][:, 0]
    return GridProblem(cells=cells, b=b, faces=faces, periodic=(True, False, False))


def rows(draw: SeededGenerator) -> GridProblem:
    """Return rows of all kinds side by side, with random shares.

    The kinds are equations, one bound, two bounds and fixed values.
    """
    shape = draw.shape(draw.of(2, 3))
    cells = framed(np.ones(shape))
    kind = draw.rng.choice(5, cells.shape, p=draw.rng.dirichlet(np.ones(5)))
    scale = draw.decades(0.1, 100)
    low, high = -scale * draw.rng.random(cells.shape), scale * draw.rng.random(cells.shape)
    lower, upper = (
        np.choose(kind, [-np.inf, low, -np.inf, low, low]),
        np.choose(kind, [np.inf, np.inf, high, high, low]),
    )
    return GridProblem(cells=cells, b=draw.load(cells.shape), lower=lower, upper=upper)


def degenerate(draw: SeededGenerator) -> GridProblem:
    """Return b of a chosen degenerate solution.

    On a share of the cells x = l and y = 0 together; the solution is smooth or noise.
    """
    shape = draw.shape(draw.of(2, 3))
    cells = framed(np.ones(shape))
    inside = cells == FLUID
    field = (
        draw.smooth(cells.shape, draw.decades(1, 8))
        if draw.chance(0.6)
        else draw.noise(cells.shape)
    )
    x = np.where(inside, np.maximum(field - draw.between(-0.2, 0.4), 0), 0.0)
    x.flat[np.flatnonzero(inside)[0]] = 1.0
    push = np.maximum(draw.smooth(cells.shape, 4), 0) if draw.chance(0.7) else 0.0 * field
    return with_solution(cells, x, np.where(x == 0, push, 0.0))


def lognormal(draw: SeededGenerator) -> GridProblem:
    """Return coefficients exp(sigma N), sigma 1 to 3, AIR around.

    N is white noise or noise with a correlation length.
    """
    shape = draw.shape(draw.of(2, 2, 3))
    cells, sigma, length = (
        framed(np.ones(shape)),
        draw.between(1, 3),
        draw.of(0.0, 0.0, draw.decades(1, 10)),
    )

    def field(counts: tuple[int, ...]) -> np.ndarray:
        noise = draw.smooth(counts, length) if length else draw.noise(counts)
        return np.asarray(np.exp(sigma * noise / noise.std()))

    b = draw.noise(cells.shape) - 0.1 if draw.chance(0.7) else draw.load(cells.shape)
    return GridProblem(
        cells=cells,
        b=b,
        faces=faces_of(cells.shape, field),
        upper=draw.of(np.inf, np.inf, draw.decades(0.1, 100)),
    )


def cut_cells(draw: SeededGenerator) -> GridProblem:
    """Return liquid around a round solid with cut faces, below a ghost-fluid surface.

    The coefficients of faces at the surface are 1/theta.
    """
    shape = draw.shape()
    Y, X = np.indices([n + 1 for n in shape], dtype=np.float64)
    solid = np.full(Y.shape, np.inf)
    for _ in range(draw.whole(1, 6)):
        far = np.hypot(Y - draw.between(0, shape[0]), X - draw.between(0, shape[1]))
        solid = np.minimum(solid, far - draw.between(0.02, 0.25) * min(shape))

    def opened(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.asarray(
            (np.maximum(a, 0) + np.maximum(b, 0)) / np.maximum(np.abs(a) + np.abs(b), 1e-30)
        ).clip(0, 1)

    face_x, face_y = opened(solid[:-1], solid[1:]), opened(solid[:, :-1], solid[:, 1:])
    within = (face_x[:, :-1] + face_x[:, 1:] + face_y[:-1] + face_y[1:]) > 0
    surface = shape[0] * draw.between(0.4, 0.9) + draw.between(0, 0.1) * shape[0] * draw.smooth(
        (shape[1],), 6
    )
    height = np.arange(shape[0])[:, None] + 0.5
    cells = np.where(~within, SOLID, np.where(height < surface, FLUID, AIR))
    cells[-1] = np.where(within[-1], AIR, SOLID)
    theta = np.clip(surface - height, 1e-3, 1.0)
    beside_air = (cells[:-1] == FLUID) & (cells[1:] == AIR)
    face_y[1:-1] = np.where(beside_air, face_y[1:-1] / theta[:-1], face_y[1:-1])
    if not (cells == FLUID).any():
        cells[0, 0] = FLUID
    return loaded(draw, cells, faces={"face_x": face_x, "face_y": face_y})


def shifted(draw: SeededGenerator) -> GridProblem:
    """Return a time step of diffusion: a shift of 10^-5 to 100.

    The shift is on all cells or some, with or without AIR.
    """
    shape = draw.shape(draw.of(2, 3))
    cells = np.full(shape, FLUID)
    cells[: draw.chance(0.3)] = AIR
    shift: float | np.ndarray = draw.decades(1e-5, 100)
    if draw.chance(0.5):
        shift = shift * (draw.rng.random(shape) < draw.between(0.01, 1))
        shift.flat[-1] = 1.0
    return loaded(draw, cells, shift=shift)


KINDS = (
    strip,
    vent,
    voxels,
    liquid,
    periodic,
    handful,
    torsion,
    rough,
    dam,
    bearing,
    rows,
    degenerate,
    lognormal,
    cut_cells,
    shifted,
)
