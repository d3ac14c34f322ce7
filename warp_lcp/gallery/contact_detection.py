"""Which bodies touch, where and how far they are apart: spheres, boxes, gears and planes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse

from warp_lcp.gallery.rigid_bodies import RigidBodies, Sphere
from warp_lcp.rigid.box_contacts import OrientedBox, box_box

GROUND = -1  # the body that a plane belongs to


@dataclass(frozen=True)
class Plane:
    """Fixed ground where normal.x <= offset [m]; the normal is of length 1.

    Raises:
        ValueError: the normal is not.
    """

    normal: tuple[float, float, float]
    offset: float = 0.0

    def __post_init__(self) -> None:
        """Check the normal."""
        if abs(np.linalg.norm(self.normal) - 1) > 1e-9:
            raise ValueError(f"normal = {self.normal}: must be of length 1")


@dataclass(frozen=True, eq=False)
class Contacts:
    """Points where bodies touch or nearly do, k of them.

    Args:
        first: body that the normal points into, shape (k,).
        second: body it comes from, or GROUND, shape (k,).
        point: in the world [m], shape (k, 3).
        normal: unit vectors from second to first, shape (k, 3).
        gap: distance along the normal [m], negative where bodies overlap, shape (k,).
    """

    first: np.ndarray
    second: np.ndarray
    point: np.ndarray
    normal: np.ndarray
    gap: np.ndarray

    def __len__(self) -> int:
        """Return the number of contacts."""
        return len(self.first)

    def frames(self) -> np.ndarray:
        """Return normal and two tangents of each contact, right-handed, shape (k, 3, 3); rows are the vectors."""
        helper = np.eye(3)[np.abs(self.normal).argmin(axis=1)]
        u = np.cross(self.normal, helper)
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        return np.stack([self.normal, u, np.cross(self.normal, u)], axis=1)

    def jacobian(self, bodies: RigidBodies) -> scipy.sparse.csr_array:
        """Return J: relative velocities v_first - v_second along each contact's frame from body velocities, shape (3k, 6n).

        J = [d', (r x d)'] for a direction d and the arm r of the point; minus that for the second body.
        """
        k, frames = len(self), self.frames()
        rows, columns, entries = [], [], []
        for body, sign in ((self.first, 1.0), (self.second, -1.0)):
            of = np.flatnonzero(body >= 0)
            arm = self.point[of] - bodies.position[body[of]]
            blocks = sign * np.concatenate([frames[of], np.cross(arm[:, None], frames[of])], axis=2)
            rows.append(np.broadcast_to((3 * of)[:, None, None] + np.arange(3)[:, None], blocks.shape).ravel())
            columns.append(np.broadcast_to((6 * body[of])[:, None, None] + np.arange(6), blocks.shape).ravel())
            entries.append(blocks.ravel())
        triplets = (np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns)))
        return scipy.sparse.coo_array(triplets, shape=(3 * k, 6 * len(bodies))).tocsr()


def detect(bodies: RigidBodies, planes: tuple[Plane, ...], margin: float, ignored: frozenset[tuple[int, int]] = frozenset()) -> Contacts:
    """Return the contacts whose gap is at most `margin` [m].

    Args:
        bodies: all.
        planes: the ground.
        margin: >= 0 [m].
        ignored: pairs of bodies (the smaller index first) that do not collide, as they are joined.
    """
    found: list[tuple[int, int, np.ndarray, np.ndarray, float]] = []
    boxes = [_boxes(bodies, i) for i in range(len(bodies))]
    for i in np.flatnonzero(bodies.free):
        for plane in planes:
            found += _on_plane(bodies, boxes, int(i), plane, margin)
    reach = np.array([shape.reach for shape in bodies.shapes]) + 0.5 * margin
    for k in range(len(bodies)):
        distance = np.linalg.norm(bodies.position[k + 1 :] - bodies.position[k], axis=1)
        for other in (k + 1 + np.flatnonzero(distance <= reach[k] + reach[k + 1 :])).tolist():
            if (bodies.free[k] or bodies.free[other]) and (k, other) not in ignored:
                found += _between(bodies, boxes, k, other, margin)
    first, second, point, normal, gap = zip(*found, strict=True) if found else ((), (), (), (), ())
    points, normals = (np.array(v, dtype=np.float64).reshape(-1, 3) for v in (point, normal))
    return Contacts(np.array(first, dtype=int), np.array(second, dtype=int), points, normals, np.array(gap, dtype=np.float64))


def _boxes(bodies: RigidBodies, i: int) -> list[OrientedBox]:
    """Return the boxes of a body in the world, none of a sphere."""
    shape, R = bodies.shapes[i], bodies.rotation[i]
    return [] if isinstance(shape, Sphere) else [OrientedBox(bodies.position[i], R @ Q, half) for Q, half in shape.parts()]


def _on_plane(bodies: RigidBodies, boxes: list[list[OrientedBox]], i: int, plane: Plane, margin: float) -> list:
    """Return a sphere's lowest point, or the corners of boxes, near a plane."""
    normal, shape = np.array(plane.normal), bodies.shapes[i]
    if isinstance(shape, Sphere):
        points = bodies.position[i : i + 1] - shape.radius * normal
    else:
        points = np.concatenate([box.corners() for box in boxes[i]])
    gaps = points @ normal - plane.offset
    return [(i, GROUND, p - 0.5 * g * normal, normal, g) for p, g in zip(points, gaps, strict=True) if g <= margin]


def _between(bodies: RigidBodies, boxes: list[list[OrientedBox]], i: int, j: int, margin: float) -> list:
    """Return the contacts of two bodies."""
    one, other = bodies.shapes[i], bodies.shapes[j]
    if isinstance(one, Sphere) and isinstance(other, Sphere):
        return _two_spheres(i, j, bodies.position[i], one.radius, bodies.position[j], other.radius, margin)
    if isinstance(one, Sphere):
        return [hit for box in boxes[j] for hit in _sphere_box(i, j, bodies.position[i], one.radius, box, margin)]
    if isinstance(other, Sphere):
        return [hit for box in boxes[i] for hit in _sphere_box(j, i, bodies.position[j], other.radius, box, margin)]
    found = []
    for a in boxes[i]:
        for b in boxes[j]:
            hit = box_box(a, b, margin)
            found += [] if hit is None else [(i, j, p, hit[1], g) for p, g in zip(hit[0], hit[2], strict=True)]
    return found


def _two_spheres(i: int, j: int, a: np.ndarray, ra: float, b: np.ndarray, rb: float, margin: float) -> list:
    """Return the contact of spheres with centers a and b, its normal along their difference."""
    between = a - b
    distance = float(np.linalg.norm(between))
    gap = distance - ra - rb
    if gap > margin:
        return []
    normal = between / distance if distance > 0 else np.array([0.0, 0.0, 1.0])
    return [(i, j, b + (rb + 0.5 * gap) * normal, normal, gap)]


def _sphere_box(i: int, j: int, center: np.ndarray, radius: float, box: OrientedBox, margin: float) -> list:
    """Return the contact of a sphere (body i) and a box (body j): at the box's nearest point, through its nearest face from inside."""
    local = box.rotation.T @ (center - box.center)
    nearest = np.clip(local, -box.half, box.half)
    between = local - nearest
    distance = float(np.linalg.norm(between))
    if distance > 0:
        normal, depth = between / distance, distance
    else:
        axis = int((box.half - np.abs(local)).argmin())
        normal = np.zeros(3)
        normal[axis] = 1.0 if local[axis] >= 0 else -1.0
        depth = float(np.abs(local[axis]) - box.half[axis])
        nearest = local - depth * normal
    gap = depth - radius
    if gap > margin:
        return []
    normal = box.rotation @ normal
    return [(i, j, box.center + box.rotation @ nearest + 0.5 * gap * normal, normal, gap)]
