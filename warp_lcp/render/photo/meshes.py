"""Triangle meshes of path-traced pictures.

Normals with creases, a liquid closed against walls and solids, grains of sand, convex solids.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection
from scipy.spatial.transform import Rotation

from warp_lcp.simulation import Surface

CREASE = 40.0  # largest angle [degrees] between triangles that share a normal
OVERLAP = 0.1  # overlap of a liquid with the solids that it touches [cells]
TOUCHING = 0.6  # distance from a solid up to which a liquid's points touch it [cells]
PROTOTYPES = 64  # number of different grains
FINE_GRAINS = 60_000  # up to this number grains have 80 triangles, otherwise 20

# Signed distance [m] at points [m], negative inside solids.
Distance = Callable[[np.ndarray], np.ndarray]


def face_normals(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the normals of triangles, with lengths of twice the areas [m^2]."""
    a, b, c = np.moveaxis(points[corners], 1, 0)
    return np.cross(b - a, c - a)


def creased(
    points: np.ndarray, corners: np.ndarray, angle: float = CREASE
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, corners and unit normals of a mesh with creases.

    The mesh is smooth except at edges sharper than an angle [degrees]. The normal at each corner of
    a triangle is the average over the triangles around its point whose normals are within the angle
    of its own.
    """
    normal = face_normals(points, corners)
    unit = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    point = corners.ravel()
    order = np.argsort(point, kind="stable")
    count = np.bincount(point, minlength=len(points))
    first = np.cumsum(count) - count
    around = count[point]  # triangles around the point of each corner
    corner = np.repeat(np.arange(len(point)), around)
    place = np.arange(len(corner)) - np.repeat(np.cumsum(around) - around, around)
    other = order[first[point[corner]] + place] // 3
    near = np.einsum("ij,ij->i", unit[corner // 3], unit[other]) >= np.cos(np.radians(angle))
    sums = np.zeros((len(point), 3))
    for axis in range(3):
        sums[:, axis] = np.bincount(corner[near], normal[other[near], axis], len(point))
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-30)
    return points[point], np.arange(len(point)).reshape(-1, 3), sums


def smooth_normals(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return unit normals at the points, area-weighted over adjacent triangles."""
    normal = face_normals(points, corners)
    sums = np.zeros((len(points), 3))
    for axis in range(3):
        sums[:, axis] = np.bincount(corners.ravel(), np.repeat(normal[:, axis], 3), len(points))
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-30)


def closed_liquid(
    surface: Surface, size: Sequence[float], spacing: float, distance: Distance | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return a liquid's surface, closed against the domain's walls and solids.

    As points, corners, normals and velocities.

    - Triangles in a wall are flat, with points of their own, so that the free surface meets them at
      a sharp edge.
    - The liquid reaches below the floor y = 0 and into solids by `OVERLAP`, so that no film of air
      remains between them, which would reflect.

    Args:
        surface: closed triangles, with or without the field `velocity`.
        size: size of the domain [m].
        spacing: cell size [m].
        distance: distance to the solids; None without solids.
    """
    points, corners = np.array(surface.points, dtype=np.float64), surface.corners
    velocity = np.array(surface.fields.get("velocity", np.zeros_like(points)), dtype=np.float64)
    sides = [(axis, end) for axis in range(3) for end in (0.0, size[axis])]
    at_wall = np.stack([np.abs(points[:, axis] - end) < 1e-3 * spacing for axis, end in sides])
    for (axis, _), at in zip(sides, at_wall, strict=True):
        velocity[at, axis] = 0.0
    flat = [at[corners].all(axis=1) for at in at_wall]
    free = ~np.any(flat, axis=0)
    if distance is not None:
        points = pressed_against(points, corners[free], distance, spacing)
    points[at_wall[2], 1] = -OVERLAP * spacing
    pieces = [(corners[free], None)] + [
        (corners[at], (np.eye(3)[axis] * (1.0 if end else -1.0)))
        for (axis, end), at in zip(sides, flat, strict=True)
        if at.any()
    ]
    out: list[tuple[np.ndarray, ...]] = []
    start = 0
    for own, normal in pieces:
        used, local = np.unique(own, return_inverse=True)
        local = local.reshape(-1, 3)
        at = points[used]
        normals = smooth_normals(at, local) if normal is None else np.broadcast_to(normal, at.shape)
        out.append((at, local + start, normals, velocity[used]))
        start += len(used)
    joined = [np.concatenate(parts) for parts in zip(*out, strict=True)]
    return joined[0], joined[1], joined[2], joined[3]


def pressed_against(
    points: np.ndarray, corners: np.ndarray, distance: Distance, spacing: float
) -> np.ndarray:
    """Return a surface's points, with those at a solid moved `OVERLAP` into it.

    Only points whose normals face the solid are moved. A point at signed distance d moves by (d +
    overlap) against the distance's gradient, which points out of the solid.
    """
    points, overlap = points.copy(), OVERLAP * spacing
    normal = np.zeros_like(points)
    used = np.unique(corners)
    normal[used] = smooth_normals(points, corners)[used]
    near = np.flatnonzero(np.abs(distance(points)) < TOUCHING * spacing)
    if not len(near):
        return points
    for _ in range(2):  # the gradient changes near edges
        at = points[near]
        step = 1e-2 * spacing
        shifts = step * np.eye(3)
        gradient = np.stack(
            [distance(at + shift) - distance(at - shift) for shift in shifts], axis=1
        ) / (2.0 * step)
        gradient /= np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)
        facing = np.einsum("ij,ij->i", normal[near], gradient) < -0.3
        d = distance(at)
        inward = facing & (d > -overlap)
        points[near[inward]] -= (d[inward] + overlap)[:, None] * gradient[inward]
    return points


def icosphere(rounds: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points and triangles of a unit icosahedron, subdivided `rounds` times.

    Each round cuts a triangle into four.
    """
    golden = 0.5 * (1.0 + 5.0**0.5)
    pairs = [(0.0, a, b * golden) for a in (-1.0, 1.0) for b in (-1.0, 1.0)]
    points = np.array([np.roll(pair, turn) for turn in range(3) for pair in pairs])
    points /= np.linalg.norm(points[0])
    corners = outward_hull(points)
    for _ in range(rounds):
        middles = (
            points[np.stack([corners, np.roll(corners, -1, axis=1)], axis=-1)]
            .mean(axis=2)
            .reshape(-1, 3)
        )
        middles /= np.linalg.norm(middles, axis=1, keepdims=True)
        points = np.unique(np.concatenate([points, middles]).round(9), axis=0)
        corners = outward_hull(points)
    return points, corners


def outward_hull(points: np.ndarray) -> np.ndarray:
    """Return the triangles of the convex hull of points.

    Counterclockwise seen from outside.
    """
    hull = ConvexHull(points)
    corners = np.array(hull.simplices)
    inward = np.einsum("ij,ij->i", face_normals(points, corners), hull.equations[:, :3]) < 0.0
    corners[inward] = corners[inward][:, ::-1]
    return corners


def clipped_convex(
    halfspaces: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the triangles of a convex solid n x + d <= 0 inside a box.

    None if they do not intersect.

    Args:
        halfspaces: rows (n, d), shape (k, 4), n of unit length.
        low: corner of the box [m].
        high: the other corner [m].
    """
    box = np.concatenate([np.column_stack([-np.eye(3), low]), np.column_stack([np.eye(3), -high])])
    rows = np.concatenate([halfspaces, box])
    center, radius = _inner_ball(rows)
    if radius < 1e-6 * float(np.max(high - low)):
        return None
    points = np.unique(HalfspaceIntersection(rows, center).intersections.round(9), axis=0)
    return points, outward_hull(points)


def _inner_ball(rows: np.ndarray) -> tuple[np.ndarray, float]:
    """Return center and radius of the largest ball in halfspaces.

    max r, n x + r <= -d.
    """
    solution = linprog(
        [0.0, 0.0, 0.0, -1.0],
        A_ub=np.column_stack([rows[:, :3], np.ones(len(rows))]),
        b_ub=-rows[:, 3],
        bounds=[(None, None)] * 4,
    )
    return (solution.x[:3], float(solution.x[3])) if solution.success else (np.zeros(3), 0.0)


def grain_prototypes(rounds: int) -> tuple[np.ndarray, np.ndarray]:
    """Return irregular grains of about unit radius.

    Points, shape (PROTOTYPES, n, 3), and their common triangles.
    """
    rng = np.random.default_rng(5077)
    points, corners = icosphere(rounds)
    shapes = []
    for _ in range(PROTOTYPES):
        waves = np.sin(2.2 * points @ rng.normal(size=(3, 3)) + rng.uniform(0.0, 2.0 * np.pi, 3))
        shapes.append(
            points * (1.0 + 0.13 * waves).prod(axis=1)[:, None] * rng.uniform(0.8, 1.15, 3)
        )
    return np.stack(shapes), corners


def grain_poses(seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return prototype, rotation, scale and tone of each grain, by its seed.

    The rotation is a matrix, the scale a factor on the radius, the tone in [0, 1).

    Args:
        seeds: integers, shape (n,); equal ones give equal grains.
    """
    rng = np.random.default_rng(6151)
    count = 1 << 14
    rotations, scales, tones = (
        Rotation.random(count, random_state=71).as_matrix(),
        np.exp(rng.normal(0.0, 0.16, count)),
        rng.random(count),
    )
    place = np.asarray(seeds, dtype=np.int64) % count
    return (
        place % PROTOTYPES,
        rotations[place].astype(np.float32),
        np.clip(scales, 0.65, 1.5)[place],
        tones[place],
    )


def grain_mesh(
    centers: np.ndarray, radius: float, seeds: np.ndarray, rounds: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return one mesh of all grains, in float32.

    Points, triangles, and the grain's index of each point.

    Args:
        centers: [m], shape (n, 3).
        radius: mean radius [m].
        seeds: seeds of the grains, shape (n,).
        rounds: 0 for 20 triangles per grain, 1 for 80.
    """
    shapes, corners = grain_prototypes(rounds)
    prototype, rotation, scale, _ = grain_poses(seeds)
    each = shapes.shape[1]
    points = np.empty((len(centers), each, 3), dtype=np.float32)
    for start in range(0, len(centers), 100_000):  # limits the memory
        own = slice(start, start + 100_000)
        turned = np.einsum("nij,nkj->nki", rotation[own], shapes.astype(np.float32)[prototype[own]])
        points[own] = centers[own, None] + (radius * scale[own])[:, None, None] * turned
    triangles = (
        np.arange(len(centers), dtype=np.uint32)[:, None, None] * each + corners.astype(np.uint32)
    ).reshape(-1, 3)
    return points.reshape(-1, 3), triangles, np.repeat(np.arange(len(centers)), each)
