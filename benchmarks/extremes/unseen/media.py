"""Kinds of coefficients: lognormal, checkerboards, inclusions, anisotropy, cut cells, shifts, scales."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from warp_lcp.benchmarks.extremes.problem import GridProblem
from warp_lcp.benchmarks.extremes.unseen import domains, obstacles
from warp_lcp.benchmarks.extremes.unseen.draw import AIR, FLUID, SOLID, Draw, framed

SIMPLE = (domains.vent, domains.voxels_2d, domains.liquid, obstacles.torsion, obstacles.membrane, obstacles.rough, obstacles.ball)
CONTRAST = 1e4  # within the limits that docs/methods.md tells


def lognormal(draw: Draw) -> GridProblem:
    """Return coefficients exp(sigma N), sigma 1 to 3, of white noise or noise with a length, AIR all around."""
    shape = draw.shape(draw.of(2, 2, 3))
    cells, sigma, length = framed(np.ones(shape)), draw.between(1, 3), draw.of(0.0, 0.0, draw.decades(1, 10))

    def field(counts: tuple[int, ...], axis: int) -> np.ndarray:
        noise = draw.smooth(counts, length) if length else draw.noise(counts)
        return np.asarray(np.exp(sigma * noise / noise.std()))

    b = draw.noise(cells.shape) - 0.1 if draw.chance(0.7) else draw.load(cells.shape)
    return GridProblem(cells=cells, b=b, faces=draw.faces(cells.shape, field), upper=draw.of(np.inf, np.inf, draw.decades(0.1, 100)))


def by_cell(conductivity: np.ndarray, counts: tuple[int, ...], axis: int) -> np.ndarray:
    """Return the harmonic mean of the conductivities of a face's cells."""
    ax = conductivity.ndim - 1 - axis
    wide = np.pad(conductivity, [(1, 1) if q == ax else (0, 0) for q in range(conductivity.ndim)], mode="edge")
    low, high = (wide.take(range(k, k + counts[ax]), ax) for k in (0, 1))
    return np.asarray(2 * low * high / (low + high))


def checkerboard(draw: Draw) -> GridProblem:
    """Return conductivities 1 and 10 to 10^4 in squares or cubes of 1 to 20 cells."""
    shape = draw.shape(draw.of(2, 2, 3))
    cells = framed(np.ones(shape))
    odd = (np.indices(cells.shape) // draw.whole(1, 20)).sum(axis=0) % 2 == 1
    conductivity = np.where(odd, draw.decades(10, CONTRAST), 1.0)
    faces = draw.faces(cells.shape, lambda counts, axis: by_cell(conductivity, counts, axis))
    return GridProblem(
        cells=cells, b=draw.load(cells.shape), faces=faces, upper=draw.of(np.inf, draw.decades(0.5, 50)), lower=draw.of(0.0, -0.1)
    )


def inclusions(draw: Draw) -> GridProblem:
    """Return blobs that conduct up to 10^4 times better or worse, AIR on one side."""
    shape = draw.shape(draw.of(2, 3))
    cells = np.full(shape, FLUID)
    cells[0] = AIR
    blob = draw.smooth(shape, draw.decades(1, 10)) > draw.between(0.1, 0.5)
    conductivity = np.where(blob, draw.decades(10, CONTRAST) ** draw.of(1, -1), 1.0)
    faces = draw.faces(shape, lambda counts, axis: by_cell(conductivity, counts, axis))
    return GridProblem(cells=cells, b=draw.load(shape), faces=faces, **domains.some_bounds(draw, shape))


def anisotropic(draw: Draw) -> GridProblem:
    """Return constant coefficients of 1 to 10^3 along one axis or two."""
    shape = draw.shape(draw.of(2, 2, 3))
    cells = framed(np.ones(shape)) if draw.chance(0.7) else np.full(shape, FLUID)
    cells[-1] = AIR
    faces = {axis: draw.decades(1, 1e3) for axis in ("face_x", "face_y", "face_z")[: len(shape)] if draw.chance(0.6)}
    b = draw.load(cells.shape)
    return GridProblem(cells=cells, b=b, faces=faces, **domains.some_bounds(draw, cells.shape))


def flat_cells(draw: Draw) -> GridProblem:
    """Return an obstacle of another kind on cells that are not square: dx / dy of 1/30 to 30."""
    made = draw.of(obstacles.torsion, obstacles.stairs, obstacles.rough)(draw)
    ratio = draw.decades(1 / 30, 30)
    return replace(made, faces={"face_x": 1 / ratio, "face_y": ratio})


def cut_cells(draw: Draw) -> GridProblem:
    """Return liquid around a round solid that cuts faces, below a surface that is 1/theta away."""
    shape = draw.shape()
    Y, X = np.indices([n + 1 for n in shape], dtype=np.float64)
    solid = np.full(Y.shape, np.inf)
    for _ in range(draw.whole(1, 6)):
        far = np.hypot(Y - draw.between(0, shape[0]), X - draw.between(0, shape[1]))
        solid = np.minimum(solid, far - draw.between(0.02, 0.25) * min(shape))

    def opened(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.asarray((np.maximum(a, 0) + np.maximum(b, 0)) / np.maximum(np.abs(a) + np.abs(b), 1e-30)).clip(0, 1)

    face_x, face_y = opened(solid[:-1], solid[1:]), opened(solid[:, :-1], solid[:, 1:])
    within = (face_x[:, :-1] + face_x[:, 1:] + face_y[:-1] + face_y[1:]) > 0
    surface = shape[0] * draw.between(0.4, 0.9) + draw.between(0, 0.1) * shape[0] * draw.smooth((shape[1],), 6)
    height = np.arange(shape[0])[:, None] + 0.5
    cells = np.where(~within, SOLID, np.where(height < surface, FLUID, AIR))
    cells[-1] = np.where(within[-1], AIR, SOLID)
    theta = np.clip(surface - height, 1e-3, 1.0)
    beside_air = (cells[:-1] == FLUID) & (cells[1:] == AIR)
    face_y[1:-1] = np.where(beside_air, face_y[1:-1] / theta[:-1], face_y[1:-1])
    if not (cells == FLUID).any():
        cells[0, 0] = FLUID
    b = draw.load(shape)
    return GridProblem(cells=cells, b=b, faces={"face_x": face_x, "face_y": face_y}, **domains.some_bounds(draw, shape))


def shifted(draw: Draw) -> GridProblem:
    """Return a step of diffusion in time: a shift of 10^-5 to 100, on all cells or some, with or without AIR."""
    shape = draw.shape(draw.of(2, 3))
    cells = np.full(shape, FLUID)
    if draw.chance(0.3):
        cells[0] = AIR
    shift: Any = draw.decades(1e-5, 100)
    if draw.chance(0.5):
        shift = shift * (draw.rng.random(shape) < draw.between(0.01, 1))
        shift.flat[-1] = 1.0
    return GridProblem(cells=cells, b=draw.load(shape), shift=shift, **domains.some_bounds(draw, shape))


def scaled(draw: Draw) -> GridProblem:
    """Return a problem of another kind, A, b and bounds times 10^-6 to 10^6 each, b and bounds in step."""
    made = draw.of(*SIMPLE)(draw)
    values, matrix = draw.decades(1e-6, 1e6), draw.decades(1e-6, 1e6)
    names = ("face_x", "face_y", "face_z")[: made.cells.ndim]
    return replace(
        made,
        b=np.asarray(made.b) * values * matrix,
        lower=np.asarray(made.lower) * values,
        upper=np.asarray(made.upper) * values,
        faces={name: np.asarray(made.faces.get(name, 1.0)) * matrix for name in names},
    )
