"""Obstacles of bodies: the domain's walls, fixed and moving solids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from warp_lcp.grid.motion import Motion, Pose
from warp_lcp.grid.signed_distance import Box, Plane
from warp_lcp.grid.voxelize import PlacedSolid
from warp_lcp.rigid.contact_shape import ContactShape

PLACED = Pose.identity()  # pose of solids at rest


@dataclass(frozen=True, kw_only=True, eq=False)
class Obstacle:
    """Solid that impulses do not move.

    Args:
        name: name in messages.
        shape: its surface as placed; None if it consists of planes.
        points: a point of each plane that bounds it [m], shape (m, 3).
        normals: normals of those planes, into the open, shape (m, 3).
        motion: its motion; None at rest.
    """

    name: str
    shape: ContactShape | None = None
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    normals: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    motion: Motion | None = None

    def pose(self, time: float) -> Pose:
        """Return the pose at a time [s]."""
        return PLACED if self.motion is None else self.motion.pose(time)


def domain_walls(
    size: Sequence[float], *, open_sides: int = 0, endless: Sequence[int] = ()
) -> Obstacle:
    """Return the walls of the domain, a box from the origin to `size` [m].

    Args:
        size: size of the domain.
        open_sides: bits of `warp_lcp.grid.domain_sides.side_bits`: sides without a wall.
        endless: periodic axes, also without walls.
    """
    points, normals = [], []
    for axis, length in enumerate(size):
        for end in (0, 1):
            if axis in endless or open_sides >> (2 * axis + end) & 1:
                continue
            point, normal = np.zeros(3), np.zeros(3)
            point[axis], normal[axis] = end * length, 1.0 - 2.0 * end
            points.append(point)
            normals.append(normal)
    shape = (-1, 3)
    return Obstacle(
        name="the domain's wall",
        points=np.reshape(points, shape),
        normals=np.reshape(normals, shape),
    )


def obstacle(solid: PlacedSolid, dimension: int) -> Obstacle:
    """Return a solid of a scene as an obstacle.

    Half spaces and inverted boxes are represented by planes, other shapes by their distance.

    A plane has its point placed in the world [m] and the normal R n, or -R n if it is inverted. The
    planes of an inverted box pass through its lower corner with normals R e_a, and through its
    upper one with -R e_a: normals point into the box.
    """
    shape = solid.geometry
    if isinstance(shape, Plane):
        flip = -1.0 if shape.invert else 1.0
        point = shape.placement.apply(np.array([[*shape.point, 0.0][:3]]))
        normal = flip * (shape.placement.rotation @ np.array([*shape.normal, 0.0][:3]))
        return Obstacle(name=solid.name, points=point, normals=normal[None], motion=solid.motion)
    if isinstance(shape, Box) and shape.invert:
        corners = np.array([[*corner, 0.0][:3] for corner in (shape.lower, shape.upper)])
        normals = np.concatenate([np.eye(3)[:dimension], -np.eye(3)[:dimension]])
        points = shape.placement.apply(np.repeat(corners, dimension, axis=0))
        return Obstacle(
            name=solid.name,
            points=points,
            normals=normals @ shape.placement.rotation.T,
            motion=solid.motion,
        )
    return Obstacle(name=solid.name, shape=ContactShape.of(shape, dimension), motion=solid.motion)
