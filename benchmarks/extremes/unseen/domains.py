"""Kinds of domains: strips, vents, channels, films, porous media, random voxels, single cells."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.ndimage

from warp_lcp.benchmarks.extremes.problem import GridProblem
from warp_lcp.benchmarks.extremes.unseen.draw import AIR, FLUID, SOLID, Draw


def some_bounds(draw: Draw, shape: tuple[int, ...]) -> dict[str, Any]:
    """Return x >= 0 everywhere, on some cells, in one layer, or with a lid."""
    kind = draw.of("all", "all", "some", "layer", "box")
    if kind == "all":
        return {}
    if kind == "some":
        return {"lower": np.where(draw.rng.random(shape) < draw.between(0.05, 0.9), 0.0, -np.inf)}
    if kind == "layer":
        return {"lower": np.where(np.indices(shape)[draw.rng.integers(len(shape))] == 0, 0.0, -np.inf)}
    return {"upper": draw.decades(0.1, 100)}


def aired(cells: np.ndarray) -> np.ndarray:
    """Return the cells with liquid that no AIR reaches made SOLID."""
    label, _ = scipy.ndimage.label(cells != SOLID)
    return np.where(np.isin(label, np.unique(label[cells == AIR])), cells, SOLID)


def strip(draw: Draw) -> GridProblem:
    """Return a long strip, 1 to 40 cells wide, with AIR at one end or both, perhaps with a lid."""
    length = draw.whole(50, 5000)
    wide = (draw.whole(1, 40),) if draw.chance(0.8) else (draw.whole(1, 6), draw.whole(1, 6))
    cells = np.full((*wide, length), FLUID)
    cells[..., -1] = AIR
    if draw.chance(0.3):
        cells[..., 0] = AIR
    b = draw.load(cells.shape)
    turn = draw.rng.permutation(cells.ndim)
    return GridProblem(cells=cells.transpose(turn), b=b.transpose(turn), upper=draw.decades(1, 1e4) if draw.chance(0.3) else np.inf)


def vent(draw: Draw) -> GridProblem:
    """Return a box of liquid with a few single cells of AIR."""
    shape = draw.shape(draw.of(2, 2, 3))
    cells = np.full(shape, FLUID)
    cells.flat[draw.rng.integers(cells.size, size=draw.of(1, 1, 2, 4))] = AIR
    return GridProblem(cells=cells, b=draw.load(shape), **some_bounds(draw, shape))


def voxels(draw: Draw, dimensions: int) -> GridProblem:
    """Return random blobs of AIR and SOLID in liquid."""
    shape = draw.shape(dimensions)
    width = draw.decades(1, 8)
    air, solid = draw.smooth(shape, width), draw.smooth(shape, width)
    cells = np.where(air > draw.between(0.2, 0.7), AIR, np.where(solid > draw.between(0.2, 0.7), SOLID, FLUID))
    cells.flat[0] = AIR
    cells.flat[-1] = FLUID
    return GridProblem(cells=cells, b=draw.load(shape), **some_bounds(draw, shape))


def voxels_2d(draw: Draw) -> GridProblem:
    """Return a random domain of two dimensions."""
    return voxels(draw, 2)


def voxels_3d(draw: Draw) -> GridProblem:
    """Return a random domain of three dimensions."""
    return voxels(draw, 3)


def rectangles(draw: Draw) -> GridProblem:
    """Return liquid with random rectangles of SOLID and AIR, one over the other."""
    shape = draw.shape(draw.of(2, 2, 3))
    cells = np.full(shape, FLUID)
    for _ in range(draw.whole(1, 30)):
        low = [int(draw.rng.integers(n)) for n in shape]
        box = tuple(slice(a, a + 1 + int(draw.rng.integers(max(1, n // 4)))) for a, n in zip(low, shape, strict=True))
        cells[box] = draw.of(SOLID, SOLID, AIR, FLUID)
    cells.flat[0], cells.flat[-1] = AIR, FLUID
    return GridProblem(cells=cells, b=draw.load(shape), **some_bounds(draw, shape))


def bend(draw: Draw) -> GridProblem:
    """Return an L, a U or a T of liquid with AIR at one end."""
    n = max(6, draw.side())
    cells, third, kind = np.full((n, n), FLUID), n // 3, draw.of("L", "U", "T")
    if kind == "L":
        cells[: n - third, : n - third] = SOLID
    elif kind == "U":
        cells[third:, third : n - third] = SOLID
    else:
        cells[third:, :third], cells[third:, n - third :] = SOLID, SOLID
    cells[-1, cells[-1] == FLUID] = AIR
    b = draw.load((n, n))
    return GridProblem(cells=cells, b=b, upper=draw.of(np.inf, float(n), 5.0 * n))


def spiral(draw: Draw) -> GridProblem:
    """Return a channel that winds around the middle, AIR at its outer or inner end."""
    n, width = max(8, draw.side()), draw.whole(2, 16)
    middle = (n - 1) / 2
    Y, X = np.indices((n, n)) - middle
    turns = np.hypot(X, Y) / (width + 2) - np.arctan2(Y, X) / (2 * np.pi)
    cells = np.where((turns % 1.0) * (width + 2) < width, FLUID, SOLID)
    cells[0] = SOLID
    if draw.chance(0.5):
        cells[-1, cells[-1] == FLUID] = AIR
        cells[-1, n // 2] = AIR
    else:
        cells[int(middle) : int(middle) + 2, int(middle) : int(middle) + 2] = AIR
    cells = aired(cells)
    return GridProblem(cells=cells, b=draw.load((n, n)), **some_bounds(draw, (n, n)))


def maze(draw: Draw) -> GridProblem:
    """Return a channel in bends, 2 to 12 cells wide, or chambers joined by holes."""
    n, width = max(9, draw.side()), draw.whole(2, 12)
    cells, pitch = np.full((n, n), FLUID), width + 1
    if draw.chance(0.5):
        cells[width::pitch] = SOLID
        for row, wall in enumerate(range(width, n, pitch)):
            cells[wall, -width:] = FLUID if row % 2 else SOLID
            cells[wall, :width] = SOLID if row % 2 else FLUID
    else:
        cells[width::pitch], cells[:, width::pitch] = SOLID, SOLID
        hole = int(draw.rng.integers(width))
        cells[width::pitch, hole::pitch], cells[hole::pitch, width::pitch] = FLUID, FLUID
    cells[-1, :width] = AIR
    return GridProblem(cells=cells, b=draw.load((n, n)), **some_bounds(draw, (n, n)))


def porous(draw: Draw) -> GridProblem:
    """Return a bed of grains of SOLID, AIR on one side."""
    dimensions = draw.of(2, 3)
    shape = draw.shape(dimensions)
    grains = draw.rng.random(shape) < draw.between(0.2, 1.0) / draw.decades(10, 200)
    distance = scipy.ndimage.distance_transform_edt(~grains) if grains.any() else np.full(shape, np.inf)
    cells = np.where(distance < draw.decades(0.8, 3.5), SOLID, FLUID)
    cells[-1] = AIR
    cells[-2] = FLUID
    cells = aired(cells) if draw.chance(0.7) else cells
    return GridProblem(cells=cells, b=draw.load(shape), **some_bounds(draw, shape))


def film(draw: Draw) -> GridProblem:
    """Return a film one to five cells thick over a floor, AIR above it or at its rim only, heights that may vary."""
    thick, wide = draw.whole(1, 5), (draw.side(), draw.side())
    floor = np.floor((draw.smooth(wide, 8) + 1) * draw.of(0, 1, 3)).astype(int)
    cells = np.full((int(floor.max()) + thick + 1, *wide), SOLID)
    height = np.arange(len(cells))[:, None, None]
    cells[(height >= floor) & (height < floor + thick)] = FLUID
    if draw.chance(0.5):
        cells[height >= floor + thick] = AIR
    else:
        cells[:, :, -1] = AIR
    faces = {"face_z": draw.decades(1e-2, 1e2)} if draw.chance(0.4) else {}
    return GridProblem(cells=cells, b=draw.load(cells.shape), faces=faces, **some_bounds(draw, cells.shape))


def liquid(draw: Draw) -> GridProblem:
    """Return a body of liquid with a rough surface in a box, b the divergence of noise and of a fall, p >= 0 at walls or everywhere."""
    dimensions = draw.of(2, 3)
    shape = draw.shape(dimensions)
    surface = shape[0] * (draw.between(0.3, 0.8) + 0.2 * draw.smooth(shape[1:], draw.decades(2, 20)))
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


def periodic(draw: Draw) -> GridProblem:
    """Return a box without walls along some axes, held by a bound on one cell or on two."""
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
    return GridProblem(cells=np.full(shape, FLUID), b=b - b.mean() + sign * draw.decades(1e-3, 1), lower=lower, upper=upper, periodic=wraps)


def chain(draw: Draw) -> GridProblem:
    """Return cells in a row along x, y or z, held by AIR at an end or by a shift, perhaps with coefficients."""
    n = draw.whole(2, 20000)
    shape = draw.of((1, n), (n, 1), (1, 1, n), (1, n, 1), (n, 1, 1))
    cells = np.full(shape, FLUID)
    held = draw.of("end", "both", "shift")
    if held != "shift":
        cells.flat[-1] = AIR
    if held == "both" and n > 2:
        cells.flat[0] = AIR
    faces = draw.faces(shape, lambda counts, axis: np.exp(0.5 * draw.noise(counts))) if draw.chance(0.3) else {}
    shift = draw.decades(1e-6, 1) if held == "shift" else None
    return GridProblem(cells=cells, b=draw.load(shape), faces=faces, shift=shift, upper=draw.of(np.inf, np.inf, draw.decades(1, 1e3)))


def handful(draw: Draw) -> GridProblem:
    """Return one to sixty cells of any type."""
    dimensions = draw.of(2, 3)
    shape = tuple(int(n) for n in draw.rng.integers(1, 8 if dimensions == 2 else 5, dimensions))
    cells = draw.rng.choice([FLUID, AIR, SOLID], shape, p=[0.7, 0.2, 0.1])
    cells.flat[draw.rng.integers(cells.size)] = FLUID
    shift = draw.decades(1e-3, 1) if draw.chance(0.4) else None
    return GridProblem(cells=cells, b=draw.noise(shape), shift=shift, **some_bounds(draw, shape))
