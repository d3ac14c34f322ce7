"""Which bodies are near each other and what surrounds them: bounds first, then points of contact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warp_lcp.grid.motion import Motion, Pose
from warp_lcp.rigid.body import RigidBody
from warp_lcp.rigid.contact_shape import ContactShape
from warp_lcp.rigid.contacts import Place, Touch, between, on_planes
from warp_lcp.rigid.surroundings import Obstacle, Surroundings


@dataclass(frozen=True, eq=False)
class Found:
    """Contacts of two.

    Args:
        first: body that normals point into.
        second: body that they come from; the number of bodies where that is none.
        touch: the points, one at least.
        obstacle: what they come from if it is no body.
    """

    first: int
    second: int
    touch: Touch
    obstacle: Obstacle | None = None

    @property
    def motion(self) -> Motion | None:
        """How the obstacle moves, if there is one and it does."""
        return None if self.obstacle is None else self.obstacle.motion


class Neighborhood:
    """Finds contacts of bodies with each other and with their surroundings.

    Args:
        bodies: all.
        shapes: of the bodies as placed.
        surroundings: what else there is.
        dimension: 2 or 3.
    """

    def __init__(
        self,
        bodies: Sequence[RigidBody],
        shapes: Sequence[ContactShape],
        surroundings: Surroundings,
        dimension: int,
    ) -> None:
        self._bodies, self._shapes = bodies, shapes
        self._center = np.array([body.properties.center for body in bodies])
        self._surroundings, self._dimension = surroundings, dimension
        self._middle = np.array([0.5 * (shape.low + shape.high) for shape in shapes])
        self._half = np.array([0.5 * (shape.high - shape.low) - shape.radius for shape in shapes])
        self._radius = np.array([shape.radius for shape in shapes])

    def find(self, time: float, ways: np.ndarray, brought: np.ndarray, near: float = 0.0) -> list[Found]:
        """Return where bodies touch.

        Args:
            time: of the state [s].
            ways: how far each body may come [m], shape (n,).
            brought: gap up to which a body that rests touches each obstacle [m].
            near: gap up to which bodies that rest touch each other [m].
        """
        turns, at = (np.array([getattr(body, name) for body in self._bodies]) for name in ("rotation", "position"))
        shifts = at - (turns @ self._center[:, :, None])[:, :, 0]
        poses = [Place(turn, shift) for turn, shift in zip(turns, shifts, strict=True)]
        middle = (turns @ self._middle[:, :, None])[:, :, 0] + shifts
        half = (np.abs(turns) @ self._half[:, :, None])[:, :, 0] + self._radius[:, None]
        found = []
        for obstacle, more in zip(self._surroundings.obstacles, brought, strict=True):
            found += self._with_obstacle(obstacle, obstacle.pose(time), poses, middle, half, ways + more)
        margins = near + ways[:, None] + ways
        apart = (np.abs(middle[:, None] - middle) - half[:, None] - half).max(axis=2)
        for i, j in np.argwhere(np.tril(apart <= margins, -1)).tolist():
            touch = between(self._shapes[i], poses[i], self._shapes[j], poses[j], float(margins[i, j]), self._dimension)
            if len(touch):
                found.append(Found(i, j, touch))
        return found

    def _with_obstacle(
        self, obstacle: Obstacle, there: Pose, poses: list[Place], middle: np.ndarray, half: np.ndarray, margins: np.ndarray
    ) -> list[Found]:
        """Return where bodies touch an obstacle."""
        shape, n, dimension, touches = obstacle.shape, len(poses), self._dimension, []
        if shape is None:
            points, normals = there.apply(obstacle.points), obstacle.normals @ there.rotation.T
            heights = middle @ normals.T - (points * normals).sum(axis=1) - half @ np.abs(normals).T
            for i in np.flatnonzero((heights <= margins[:, None]).any(axis=1)).tolist():
                chosen = heights[i] <= margins[i]
                touches.append((i, on_planes(self._shapes[i], poses[i], points[chosen], normals[chosen], margins[i], dimension)))
        else:
            near = np.ones(n, dtype=bool)
            if shape.closed:
                center, reach = there.apply(0.5 * (shape.low + shape.high)), np.abs(there.rotation) @ (0.5 * (shape.high - shape.low))
                near = (np.abs(middle - center) - half - reach).max(axis=1) <= margins
            for i in np.flatnonzero(near).tolist():
                touches.append((i, between(self._shapes[i], poses[i], shape, there, float(margins[i]), dimension)))
        return [Found(i, n, touch, obstacle) for i, touch in touches if len(touch)]
