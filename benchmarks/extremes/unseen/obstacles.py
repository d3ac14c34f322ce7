"""Kinds of contact: obstacles of all shapes, torsion, dams, bearings, mixed and degenerate bounds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import scipy.ndimage

from warp_lcp.benchmarks.extremes.problem import GridProblem
from warp_lcp.benchmarks.extremes.unseen.draw import FLUID, Draw, framed


def unit_square(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return X and Y of n^2 nodes on [0, 1]^2."""
    return tuple(np.meshgrid(*(np.linspace(0, 1, n),) * 2))  # type: ignore[return-value]


def section(draw: Draw, n: int) -> np.ndarray:
    """Return a cross-section: a square, a rectangle, an ellipse, an L, a triangle or a square with a hole."""
    kind = draw.of("square", "square", "rectangle", "ellipse", "L", "triangle", "hole")
    X, Y = unit_square(n)
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


def torsion(draw: Draw) -> GridProblem:
    """Return elastic-plastic torsion: |x| at most the distance to the border, for a load of 2 to 30."""
    n = max(4, draw.side())
    cells = framed(section(draw, n))
    distance = scipy.ndimage.distance_transform_edt(cells == FLUID) / (n + 1)
    load = draw.decades(2, 30) * draw.of(-1, -1, 1)
    b = load * (draw.smooth(cells.shape, n / 8) if draw.chance(0.2) else np.ones(cells.shape)) / (n + 1) ** 2
    return GridProblem(cells=cells, b=b, lower=-distance, upper=distance)


def membrane(draw: Draw) -> GridProblem:
    """Return a membrane between two obstacles."""
    n = max(5, draw.side())
    X, Y = unit_square(n)
    low = -0.02 - draw.between(0.05, 1) * ((X - draw.between(0, 1)) ** 2 + (Y - draw.between(0, 1)) ** 2)
    high = 0.01 + 0.2 * np.abs(X - draw.between(0, 1)) + 0.1 * np.abs(Y - draw.between(0, 1))
    b = draw.between(2, 40) * np.sin(draw.between(3, 20) * X * Y) / n**2
    return GridProblem(cells=framed(np.ones((n - 2, n - 2))), b=b, lower=low, upper=high)


def stairs(draw: Draw) -> GridProblem:
    """Return a membrane over stairs, blocks, pyramids or needles."""
    n = max(5, draw.side())
    X, Y = unit_square(n)
    kind = draw.of("stairs", "terraces", "blocks", "pyramids", "needles")
    steps = draw.whole(2, 12)
    if kind in ("stairs", "terraces"):
        low = -np.floor(X * steps) / (10 * steps) * (1 if kind == "stairs" else np.floor(Y * steps) / steps) - draw.of(0, 0.01)
    elif kind == "needles":
        low = np.where(draw.rng.random((n, n)) < 0.5 / n, draw.between(0.02, 0.3), -1.0)
    else:
        low = np.full((n, n), -1.0)
        for _ in range(steps):
            far = np.maximum(np.abs(X - draw.between(0, 1)), np.abs(Y - draw.between(0, 1))) / draw.between(0.05, 0.3)
            height = draw.between(-0.05, 0.3)
            low = np.maximum(low, np.where(far < 1, height if kind == "blocks" else height - far, -1.0))
    return GridProblem(cells=framed(np.ones((n - 2, n - 2))), b=np.full(low.shape, draw.between(0, 10) / n**2), lower=low)


def ball(draw: Draw) -> GridProblem:
    """Return a membrane over a ball or a paraboloid, in two dimensions or three."""
    dimensions = draw.of(2, 2, 3)
    n = max(5, draw.side(dimensions))
    r2 = sum(g * g for g in np.meshgrid(*(np.linspace(-2, 2, n),) * dimensions, indexing="ij"))
    sphere = np.where(r2 < 1, np.sqrt(np.maximum(1 - r2, 0)), -1.0)
    low = sphere if draw.chance(0.5) else draw.between(0.1, 1) - r2 * draw.between(0.2, 2)
    b = np.full(low.shape, 0.0 if draw.chance(0.5) else draw.between(0, 8) / n**2)
    return GridProblem(cells=framed(np.ones((n - 2,) * dimensions)), b=b, lower=low)


def moving(draw: Draw) -> tuple[GridProblem, GridProblem]:
    """Return a membrane over a paraboloid, a block or two obstacles, and the same with the obstacle moved by a part of a cell to three."""
    n, kind = max(7, draw.side()), draw.of("paraboloid", "block", "between")
    g = np.linspace(-2, 2, n)
    X, Y = np.meshgrid(g, g)
    angle, speed = draw.between(0, 6.28), draw.decades(0.05, 3.0) * 4 / n

    def at(a: float) -> dict[str, Any]:
        far = (X - 0.8 * np.cos(a)) ** 2 + (Y - 0.8 * np.sin(a)) ** 2
        if kind == "block":
            return {"lower": np.where(far < 0.3, 0.4, -1.0)}
        return {"lower": 0.5 - far, "upper": np.inf if kind == "paraboloid" else 0.6 + 0.1 * X}

    b = np.full((n, n), draw.decades(0.1, 10) * (4 / n) ** 2)
    made = GridProblem(cells=framed(np.ones((n - 2, n - 2))), b=b, **at(angle))
    return made, replace(made, **at(angle + speed / 0.8))


def lid(draw: Draw) -> GridProblem:
    """Return a slab of three dimensions under a lid that is flat, tilted or bent, pushed up below and held down above."""
    n = max(4, draw.side(3))
    shape = (n, max(3, int(n * draw.between(0.5, 1.5))), max(3, int(n * draw.between(0.5, 1.5))))
    cells = np.full(shape, FLUID)
    cells[0] = 0
    z, y, x = (i / m for i, m in zip(np.indices(shape), shape, strict=True))
    b = draw.between(-2e-3, 0) * (z < 0.6) + draw.between(0, 3e-3) * (z > 0.7)
    upper = draw.between(0.1, 0.5) * n * (1 + draw.between(0, 0.5) * draw.of(0 * x, x - y, draw.smooth(shape, 6)))
    return GridProblem(cells=cells, b=b, lower=draw.of(0.0, -np.inf, -0.1 * n), upper=upper)


def rough(draw: Draw) -> GridProblem:
    """Return noise between two rough obstacles, AIR on one side."""
    shape = draw.shape()
    cells = np.full(shape, FLUID)
    cells[0] = 0
    b = draw.noise(shape) * draw.between(0.1, 1) - 0.02
    size = draw.decades(0.5, 50)
    low, high = -(draw.smooth(shape, draw.decades(2, 12)) ** 2) * size, draw.smooth(shape, draw.decades(2, 16)) ** 2 * size
    return GridProblem(cells=cells, b=b, lower=low, upper=high + draw.between(0, 1))


def dam(draw: Draw) -> GridProblem:
    """Return seepage through a dam of any width and water levels, by Baiocchi's variable."""
    nx = max(5, draw.side())
    ny = max(5, int(nx * draw.between(0.6, 2)))
    width, high = draw.between(8, 32), draw.between(16, 32)
    tail = high * draw.between(0, 0.6)
    x, y = np.linspace(0, width, nx), np.linspace(0, high, ny)
    hx, hy = x[1], y[1]
    b = np.full((ny - 2, nx - 2), hx * hy)
    b[0] -= ((high**2 * (width - x) + tail**2 * x) / (2 * width))[1:-1] * hx / hy
    b[:, 0] -= ((high - y) ** 2 / 2)[1:-1] * hy / hx
    b[:, -1] -= np.where(y < tail, (tail - y) ** 2 / 2, 0)[1:-1] * hy / hx
    return GridProblem(cells=framed(np.ones(b.shape)), b=np.pad(b, 1), faces={"face_x": hy / hx, "face_y": hx / hy})


def bearing(draw: Draw) -> GridProblem:
    """Return a journal bearing's film with cavitation: Reynolds' equation, coefficients h^3 around the shaft, pressure >= 0."""
    nx, ny = max(6, draw.side()), max(4, draw.side() // 2)
    eccentric, angle = draw.between(0.2, 0.95), 2 * np.pi / nx
    height = 1 + eccentric * np.cos(angle * np.arange(nx + 1))
    middle = 1 + eccentric * np.cos(angle * (np.arange(nx) + 0.5))
    slender = draw.decades(0.1, 10) * nx / (2 * np.pi * ny)  # hx / hy
    cells = np.full((ny + 2, nx), FLUID)
    cells[[0, -1]] = 0
    b = np.broadcast_to(angle * np.diff(height), cells.shape)
    faces = {"face_x": np.tile(height**3, (ny + 2, 1)), "face_y": np.tile(middle**3 * slender**2, (ny + 3, 1))}
    faces["face_x"][:, -1] = faces["face_x"][:, 0]
    return GridProblem(cells=cells, b=b, faces=faces, periodic=(True, False, False))


def rows(draw: Draw) -> GridProblem:
    """Return rows of all kinds side by side: equations, one bound, two bounds, fixed values; shares at random."""
    shape = draw.shape(draw.of(2, 3))
    cells = framed(np.ones(shape))
    kind = draw.rng.choice(5, cells.shape, p=draw.rng.dirichlet(np.ones(5)))
    scale = draw.decades(0.1, 100)
    low, high = -scale * draw.rng.random(cells.shape), scale * draw.rng.random(cells.shape)
    lower = np.choose(kind, [-np.inf * np.ones(cells.shape), low, -np.inf * np.ones(cells.shape), low, low])
    upper = np.choose(kind, [np.inf * np.ones(cells.shape), np.inf * np.ones(cells.shape), high, high, low])
    return GridProblem(cells=cells, b=draw.load(cells.shape), lower=lower, upper=upper)


def degenerate(draw: Draw) -> GridProblem:
    """Return b of a chosen solution: x = l and y = 0 together on a share of the cells, smooth or of noise."""
    shape = draw.shape(draw.of(2, 3))
    cells = framed(np.ones(shape))
    inside = cells == FLUID
    field = draw.smooth(cells.shape, draw.decades(1, 8)) if draw.chance(0.6) else draw.noise(cells.shape)
    x = np.where(inside, np.maximum(field - draw.between(-0.2, 0.4), 0), 0.0)
    x.flat[np.flatnonzero(inside)[0]] = 1.0
    push = np.maximum(draw.smooth(cells.shape, 4), 0) if draw.chance(0.7) else 0.0 * field
    y = np.where(inside & (x == 0), push, 0.0)
    made = GridProblem(cells=cells, b=np.zeros(cells.shape))
    b = np.zeros(cells.shape)
    b[inside] = y[inside] - made.exact().matrix @ x[inside]
    return replace(made, b=b)
