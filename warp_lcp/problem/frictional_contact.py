"""Contact problem of rigid bodies with Coulomb's circular friction cone."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import warp as wp
from scipy.sparse import bsr_array, csr_array

from warp_lcp.problem.data_types import Values
from warp_lcp.problem.solve_loop import VariationalInequality


class FrictionalContact(VariationalInequality):
    """Contact problem of rigid bodies with Coulomb's circular friction cone.

    Find impulses r at k contacts so that Coulomb's law holds for the resulting velocities u = J J'
    r + e r + b.

    A contact's rows are its normal and `dim` - 1 tangents. With K = {|r_t| <= mu r_n} and its dual
    cone K* = {u_n >= mu |u_t|} the law is

        K contains r, K* contains u^ = (u_n + mu |u_t|, u_t), and r'u^ = 0

    [De Saxce & Feng 1998; Acary & Brogliato 2008, 3.9]: an open contact has no impulse, a sticking
    one does not slip, a slipping one has friction mu r_n against the slip, and slip causes no
    normal velocity. r is a solution if r = P_K(r - u^ / d), for any d > 0. Since u^ is not a
    gradient there may be several solutions, or none if mu > 0 and no r can stop the velocities b.

    J is given by the bodies of each contact and its rows for each of them. The velocities of bodies
    are M^-1 J' r if the rows include a factor of the inverse masses, J M^-1/2. A product then costs
    the entries of J, and J J' is never assembled.

    Args:
        first: body that each contact pushes, from 0, shape (k,).
        second: the other body, `bodies` if there is none, shape (k,).
        one: rows of J for the first body, shape (k, dim, q).
        other: for the second, shape (k, dim, q); 0 is used if there is none.
        b: velocities without impulses [m/s], minus the least allowed ones along normals, shape (k,
            dim).
        friction: Coulomb's coefficient mu >= 0, shape (k,).
        bodies: their number.
        yields: e >= 0, compliance of the contacts [1/kg], shape (k, dim); 0 if None.
        device: Warp device that methods use; the CPU if None.

    Raises:
        ValueError: shapes do not fit, a number is not finite or has a wrong sign, or a contact has
            a row that moves nothing.

    Example:
        >>> one, other = np.eye(3)[None], np.zeros((1, 3, 3))
        >>> down = FrictionalContact([0], [1], one, other, [[-1.0, 3.0, 4.0]], [0.5], 1)
        >>> # Friction mu r_n acts against the slip.
        >>> print(f"{down.residual(np.array([[1.0, -0.3, -0.4]])):.1f}")
        0.0
    """

    def __init__(
        self,
        first: Values,
        second: Values,
        one: Values,
        other: Values,
        b: Values,
        friction: Values,
        bodies: int,
        *,
        yields: Values | None = None,
        device: wp.DeviceLike = None,
    ) -> None:
        self.first, self.second = (np.asarray(side, dtype=np.int64) for side in (first, second))
        self.one, self.b, self.friction = (
            np.asarray(values, dtype=np.float64) for values in (one, b, friction)
        )
        self.bodies, self.device = int(bodies), wp.get_device(device or "cpu")
        self.other = np.array(other, dtype=np.float64)
        self.yields = (
            np.zeros_like(self.b) if yields is None else np.asarray(yields, dtype=np.float64)
        )
        self._check()
        self.other[self.second == self.bodies] = 0.0

    def _check(self) -> None:
        """Raise ValueError for wrong shapes, values or body numbers."""
        shapes = {
            "one": self.one,
            "other": self.other,
            "b": self.b,
            "yields": self.yields,
            "friction": self.friction,
        }
        if self.one.ndim != 3 or not 1 <= self.one.shape[1] <= 3 or self.one.shape[2] < 1:
            raise ValueError(
                f"one has shape {self.one.shape}: expected (k, dim, q) with dim = 1, 2 or 3"
            )
        k, dim, q = self.one.shape
        expected = {
            "other": (self.other, (k, dim, q)),
            "b": (self.b, (k, dim)),
            "yields": (self.yields, (k, dim)),
            "friction": (self.friction, (k,)),
            "first": (self.first, (k,)),
            "second": (self.second, (k,)),
        }
        for name, (values, shape) in expected.items():
            if values.shape != shape:
                raise ValueError(f"{name} has shape {values.shape}: expected {shape}")
        for name, values in shapes.items():
            if not np.isfinite(values).all():
                raise ValueError(f"{name} holds values that are not finite")
            if name in ("yields", "friction") and (values < 0).any():
                raise ValueError(f"{name} holds a negative value")
        if ((self.first < 0) | (self.first >= self.bodies)).any() or (
            (self.second < 0) | (self.second > self.bodies)
        ).any():
            raise ValueError(
                f"first, second: expected numbers of {self.bodies} bodies, in second {self.bodies} "
                "for none"
            )
        if (same := self.first == self.second).any():
            raise ValueError(f"contact {int(same.argmax())} joins a body to itself")
        if (still := ~(self.diagonal > 0)).any():
            raise ValueError(
                f"contact {int(still.any(axis=1).argmax())} has a zero row, which moves no body"
            )

    @property
    def dim(self) -> int:
        """Number of rows of a contact."""
        return int(self.one.shape[1])

    def __len__(self) -> int:
        """Return the number of contacts."""
        return len(self.friction)

    @cached_property
    def diagonal(self) -> np.ndarray:
        """Diagonal of J J' + diag(e) [1/kg], shape (k, dim)."""
        other = np.where((self.second < self.bodies)[:, None, None], self.other, 0.0)
        return np.asarray(
            np.square(self.one).sum(axis=2) + np.square(other).sum(axis=2) + self.yields
        )

    @cached_property
    def jacobian(self) -> csr_array:
        """J, shape (k dim, bodies q)."""
        k, dim, q = self.one.shape
        blocks, places = (
            np.stack([self.one, self.other], axis=1).reshape(2 * k, dim, q),
            np.stack([self.first, self.second], axis=1),
        )
        made = bsr_array(
            (blocks, places.ravel(), 2 * np.arange(k + 1)), shape=(k * dim, (self.bodies + 1) * q)
        )
        return csr_array(made.tocsr()[:, : self.bodies * q])

    def velocities(self, r: np.ndarray) -> np.ndarray:
        """Return u at impulses r [m/s], shape (k, dim) both, computed on the host."""
        J = self.jacobian
        return np.asarray((J @ (J.T @ r.ravel())).reshape(r.shape) + self.yields * r + self.b)

    def residual(self, r: np.ndarray) -> float:
        """Return the norm of the proximal map's defect at impulses r [m/s].

        ||d (r - P_K(r - u^ / d))|| with r of shape (k, dim) and d the mean of a contact's diagonal.
        """
        d, u = self.diagonal.mean(axis=1, keepdims=True), self.velocities(r)
        u[:, 0] += self.friction * np.linalg.norm(u[:, 1:], axis=1)
        return float(np.linalg.norm(d * (r - onto_cones(r - u / d, self.friction))))

    @cached_property
    def reference(self) -> float:
        """The residual of no impulses [m/s]."""
        return self.residual(np.zeros_like(self.b))


def onto_cones(z: np.ndarray, friction: np.ndarray) -> np.ndarray:
    """Return the projections of z onto the cones |r_t| <= mu r_n, row by row.

    z has shape (k, dim). A point inside stays; one in the polar cone, mu |z_t| <= -z_n, goes to 0;
    any other goes to the nearest point of the cone's surface.
    """
    normal, length = z[:, 0], np.linalg.norm(z[:, 1:], axis=1)
    inside, polar = length <= friction * normal, friction * length <= -normal
    # On the surface r_t = mu r_n z_t / |z_t| the nearest point has
    # r_n = (z_n + mu |z_t|) / (1 + mu^2).
    side = (normal + friction * length) / (1.0 + friction**2)
    onto = np.column_stack(
        [side, (friction * side / np.maximum(length, 1e-300))[:, None] * z[:, 1:]]
    )
    return np.where(inside[:, None], z, np.where(polar[:, None], 0.0, onto))
