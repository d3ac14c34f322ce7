"""Articulated figures: trees of hinges with limits, end effectors, derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

Vector = np.ndarray
Z = (0.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class ArticulatedFigure:
    """Tree of hinges ([Book] 1.3.4).

    Each hinge rotates its link about an axis fixed in its parent's link. With R_j = R_parent
    Rot(axis_j, theta_j) and p_j = p_parent + R_parent offset_j, an end effector on link j is at p_j
    + R_j tip.

    Args:
        parents: parent of each hinge, the previous one from the root; -1 for a hinge on the fixed
            root; parents come first.
        axes: unit vectors in the parent's frame, shape (n, 3).
        offsets: positions of the hinges in the parent's frame [m], shape (n, 3).
        effectors: the hinges whose links have end effectors.
        tips: positions of the end effectors in their links' frames [m], shape (e, 3).
        lower: least angles [rad], shape (n,), may be -inf.
        upper: largest angles [rad], shape (n,), may be inf.
        dimension: 3, or 2 for figures in the x-y plane, in which all axes are z.

    Raises:
        ValueError: a shape, a parent, an axis or a limit is invalid; the message names the
            argument.

    Example:
        >>> figure = planar_chain([2.0, 1.0])
        >>> print(figure.positions(np.array([np.pi / 2, -np.pi / 2])).round(12))
        [[1. 2.]]
        >>> print(figure.jacobian(np.array([np.pi / 2, -np.pi / 2])).round(12))
        [[-2.  0.]
         [ 1.  1.]]
    """

    parents: tuple[int, ...]
    axes: Vector
    offsets: Vector
    effectors: tuple[int, ...]
    tips: Vector
    lower: Vector
    upper: Vector
    dimension: int = 3

    def __post_init__(self) -> None:
        """Check the tree and the shapes."""
        n, e = len(self.parents), len(self.effectors)
        if n == 0 or not all(-1 <= parent < j for j, parent in enumerate(self.parents)):
            raise ValueError(
                f"parents = {self.parents}: expected at least one hinge, and each parent before "
                "its children"
            )
        for name, values, shape in (
            ("axes", self.axes, (n, 3)),
            ("offsets", self.offsets, (n, 3)),
            ("tips", self.tips, (e, 3)),
            ("lower", self.lower, (n,)),
            ("upper", self.upper, (n,)),
        ):
            if np.shape(values) != shape:
                raise ValueError(f"{name} has shape {np.shape(values)}: expected {shape}")
        if e == 0 or not all(0 <= j < n for j in self.effectors):
            raise ValueError(
                f"effectors = {self.effectors}: expected at least one, each the number of a hinge"
            )
        if not np.allclose(np.linalg.norm(self.axes, axis=1), 1):
            raise ValueError("axes: each must be a unit vector")
        if not 0 < self.reach < np.inf:
            raise ValueError(
                "offsets and tips: an end effector must be some way from the first hinge, but "
                f"reach = {self.reach:.6g} m"
            )
        if not (self.lower <= self.upper).all():
            raise ValueError("lower > upper, or a NaN, in the limits")
        if self.dimension not in (2, 3) or (self.dimension == 2 and not np.allclose(self.axes, Z)):
            raise ValueError(f"dimension = {self.dimension}: must be 3, or 2 with all axes along z")

    @property
    def hinges(self) -> int:
        """Number of hinges."""
        return len(self.parents)

    @cached_property
    def ancestors(self) -> Vector:
        """Whether hinge j moves end effector i, shape (e, n), bool."""
        moves = np.zeros((len(self.effectors), self.hinges), dtype=bool)
        for i, j in enumerate(self.effectors):
            while j >= 0:
                moves[i, j] = True
                j = self.parents[j]
        return moves

    @cached_property
    def reach(self) -> float:
        """Length of the longest path from the first hinge to an end effector [m].

        It is the length scale of errors and angles.
        """
        links = np.linalg.norm(self.offsets, axis=1) * (np.array(self.parents) >= 0)
        return float((self.ancestors @ links + np.linalg.norm(self.tips, axis=1)).max())

    def _frames(self, theta: Vector) -> tuple[Vector, Vector, Vector]:
        """Return positions (n, 3) and axes (n, 3) of hinges, and end effectors (e, 3).

        In world coordinates.
        """
        own = Rotation.from_rotvec(theta[:, None] * self.axes).as_matrix()
        places, turns = self.offsets.copy(), own.copy()
        for j, parent in enumerate(self.parents):
            if parent >= 0:
                places[j] = places[parent] + turns[parent] @ self.offsets[j]
                turns[j] = turns[parent] @ own[j]
        axes = np.einsum("nij,nj->ni", turns, self.axes)  # a hinge does not rotate its own axis
        carriers = list(self.effectors)
        return places, axes, places[carriers] + np.einsum("eij,ej->ei", turns[carriers], self.tips)

    def positions(self, theta: Vector) -> Vector:
        """Return the positions f(theta) of the end effectors [m], shape (e, dimension)."""
        return self._frames(theta)[2][:, : self.dimension]

    def jacobian(self, theta: Vector) -> Vector:
        """Return the Jacobian df/dtheta [m], shape (e dimension, n).

        It is a_j x (f_i - p_j) if hinge j moves effector i, else 0.
        """
        places, axes, ends = self._frames(theta)
        arms = np.cross(axes[None], ends[:, None] - places[None]) * self.ancestors[..., None]
        return arms[..., : self.dimension].transpose(0, 2, 1).reshape(-1, self.hinges)

    def curvature(self, theta: Vector, weights: Vector) -> Vector:
        """Return sum_k w_k d^2 f_k / dtheta^2 [m^2], shape (n, n), symmetric.

        d^2 f_i / dtheta_j dtheta_k = a_j x (a_k x (f_i - p_k)), with j on the path from k to the
        root, or k itself, and k on the path of effector i.

        Args:
            theta: angles [rad], shape (n,).
            weights: w [m], shape (e dimension,).
        """
        places, axes, ends = self._frames(theta)
        w = np.zeros_like(ends)
        w[:, : self.dimension] = weights.reshape(len(ends), -1)
        arms = np.cross(axes[None], ends[:, None] - places[None]) * self.ancestors[..., None]
        # w . (a_j x arm_k) = (w x a_j) . arm_k
        second = np.einsum("ekc,ejc->jk", arms, np.cross(w[:, None], axes[None]))
        # J is k or on its path to the root.
        above = np.zeros((self.hinges, self.hinges), dtype=bool)
        for k, parent in enumerate(self.parents):
            above[:, k] = above[:, parent] if parent >= 0 else False
            above[k, k] = True
        upper = np.where(above, second, 0.0)
        return upper + upper.T - np.diag(np.diag(upper))


def planar_chain(
    lengths: Sequence[float], *, lower: float | Vector = -2.0, upper: float | Vector = 2.0
) -> ArticulatedFigure:
    """Return a chain in the x-y plane that lies along x at theta = 0.

    Args:
        lengths: lengths of the links [m].
        lower: least angles [rad], a number or one per link.
        upper: largest angles [rad], likewise.
    """
    n = len(lengths)
    if n == 0 or not np.isfinite(lengths).all() or not np.any(lengths):
        raise ValueError(
            f"lengths = {lengths}: expected finite lengths [m], at least one of them not 0"
        )
    offsets = np.zeros((n, 3))
    offsets[1:, 0] = lengths[:-1]
    tips = np.array([[lengths[-1], 0.0, 0.0]])
    low, high = (
        np.broadcast_to(np.asarray(side, dtype=np.float64), (n,)) for side in (lower, upper)
    )
    return ArticulatedFigure(
        tuple(range(-1, n - 1)), np.tile(Z, (n, 1)), offsets, (n - 1,), tips, low, high, dimension=2
    )


def spatial_chain(
    lengths: Sequence[float], *, lower: float | Vector = -2.0, upper: float | Vector = 2.0
) -> ArticulatedFigure:
    """Return a chain in space that lies along x at theta = 0.

    The axes of its hinges are z, y, x, z, y, x and so on.

    Args:
        lengths: lengths of the links [m].
        lower: least angles [rad], a number or one per link.
        upper: largest angles [rad], likewise.
    """
    flat = planar_chain(lengths, lower=lower, upper=upper)
    axes = np.eye(3)[[2 - j % 3 for j in range(flat.hinges)]]
    return ArticulatedFigure(
        flat.parents, axes, flat.offsets, flat.effectors, flat.tips, flat.lower, flat.upper
    )


def branching_figure() -> ArticulatedFigure:
    """Return the upper half of a body with three end effectors.

    A spine of 3 hinges, two arms of 5 and a head of 2. At theta = 0, y is up and the arms point
    sideways; the distance from hip to shoulders, and from shoulder to hand, is 1 m; limits are
    roughly those of a person.
    """
    x, y, z = np.eye(3)
    joints: list[tuple[int, Vector, Vector, float, float]] = [  # parent, axis, offset, limits
        (-1, x, 0 * y, -0.4, 1.2),
        (0, z, 0 * y, -0.6, 0.6),
        (1, y, 0.5 * y, -0.8, 0.8),
    ]
    ends: list[tuple[int, Vector]] = []
    for side in (-1.0, 1.0):
        shoulder = len(joints)
        low, high = sorted((-0.5 * side, 1.5 * side))
        joints += [
            (2, y, 0.5 * y + 0.2 * side * x, -1.5, 0.6)
            if side < 0
            else (2, y, 0.5 * y + 0.2 * side * x, -0.6, 1.5),
            (shoulder, z, 0 * y, low, high),
            (shoulder + 1, x, 0 * y, -1.5, 1.5),
            (shoulder + 2, y, 0.35 * side * x, -2.4, 0.0)
            if side < 0
            else (shoulder + 2, y, 0.35 * side * x, 0.0, 2.4),
            (shoulder + 3, z, 0.3 * side * x, -1.0, 1.0),
        ]
        ends.append((shoulder + 4, 0.15 * side * x))
    joints += [(2, x, 0.6 * y, -0.7, 0.7), (len(joints), z, 0 * y, -0.5, 0.5)]
    ends.append((len(joints) - 1, 0.25 * y))
    parents, axes, offsets, lower, upper = zip(*joints, strict=True)
    effectors, tips = zip(*ends, strict=True)
    return ArticulatedFigure(
        parents,
        np.array(axes),
        np.array(offsets),
        effectors,
        np.array(tips),
        np.array(lower),
        np.array(upper),
        dimension=3,
    )
