"""Models of Coulomb friction: polyhedral-cone LCP, boxed problem, proximal map.

See [Book] 1.3.5. All models start from a `ContactSystem`: relative velocities at the contacts after
impulses r, u = B r + q, of any origin.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import groupby
from typing import Protocol

import numpy as np
import scipy.sparse

from warp_lcp.host_problem import Problem
from warp_lcp.problem.affine_bounds import AffineBounds


@dataclass(frozen=True, eq=False)
class ContactSystem:
    """Velocities u = B r + q at k contacts and m further rows (joints) for impulses r.

    The rows of a contact are consecutive: normal, then `dim - 1` tangents; joints follow the
    contacts.

    Args:
        name: name of the scene.
        B: J M^-1 J', symmetric positive semi-definite [1/kg], scipy.sparse, shape (dim k + m, dim k
            + m).
        q: velocities without impulses, plus position correction [m/s], shape (dim k + m,).
        friction: coefficient mu >= 0 of each contact, shape (k,).
        lower: least impulse of each joint row [N s], shape (m,); -inf without a bound.
        upper: largest impulse.
        dim: 3 in space, 2 in the plane.

    Raises:
        ValueError: shapes do not match, or a coefficient is negative.
    """

    name: str
    B: scipy.sparse.csr_array
    q: np.ndarray
    friction: np.ndarray
    lower: np.ndarray = field(default_factory=lambda: np.zeros(0))
    upper: np.ndarray = field(default_factory=lambda: np.zeros(0))
    dim: int = 3

    def __post_init__(self) -> None:
        n = self.dim * len(self.friction) + len(self.lower)
        if self.dim not in (2, 3):
            raise ValueError(f"dim = {self.dim}: must be 2 or 3")
        if self.B.shape != (n, n) or self.q.shape != (n,) or self.upper.shape != self.lower.shape:
            raise ValueError(
                f"B has shape {self.B.shape}, q {self.q.shape}: expected {n} rows for "
                f"{len(self.friction)} contacts"
            )
        if not (self.friction >= 0).all():
            raise ValueError("friction holds a negative value or NaN")

    @property
    def contacts(self) -> int:
        """Number of contacts."""
        return len(self.friction)

    @property
    def normals(self) -> np.ndarray:
        """Rows of the normal impulses, shape (k,)."""
        return self.dim * np.arange(self.contacts)

    @property
    def tangents(self) -> np.ndarray:
        """Rows of the tangential impulses, shape (k, dim - 1)."""
        return self.normals[:, None] + np.arange(1, self.dim)

    @property
    def joints(self) -> np.ndarray:
        """Rows of the joints, shape (m,)."""
        return np.arange(self.dim * self.contacts, len(self.q))

    def blocks(self, most: int = 5) -> list[np.ndarray]:
        """Return the rows of each contact, then blocks of the joints' rows.

        Consecutive equations share a block of at most `most` rows; bounded rows have blocks of
        their own.
        """
        blocks = list(np.arange(self.dim * self.contacts).reshape(self.contacts, self.dim))
        free = np.isinf(self.lower) & np.isinf(self.upper)
        for equations, group in groupby(
            zip(self.joints, free, strict=True), key=lambda entry: entry[1]
        ):
            rows = np.array([row for row, _ in group])
            blocks += np.split(
                rows, range(most if equations else 1, len(rows), most if equations else 1)
            )
        return blocks

    def staggered(self) -> list[np.ndarray]:
        """Return two blocks of rows: normal impulses with joints, and friction.

        Only the first block if there is no contact.
        """
        blocks = [np.concatenate([self.normals, self.joints]), self.tangents.ravel()]
        return [block for block in blocks if block.size]

    def residual(self, r: np.ndarray) -> float:
        """Return the residual norm of the proximal map at r [m/s].

        The map projects onto the circular cone. With u = B r + q and d a contact's mean diagonal of
        B, the residual is d (r_n - max(0, r_n - u_n / d)), and for friction the same with the
        projection onto |r_t| <= mu r_n ([Book] 1.1.4, 1.3.5; the disk of the true normal impulse).
        It is 0 exactly if Coulomb's law holds: r_n >= 0, u_n >= 0, r_n u_n = 0, and r_t is in the
        disk, and opposite to u_t if u_t is not 0. Joint rows are clipped.
        """
        u, d = self.B @ r + self.q, np.abs(self.B.diagonal())
        d = np.where(d > 0, d, 1.0)
        k, rows = self.contacts, self.dim * self.contacts
        scale = d[:rows].reshape(k, self.dim).mean(axis=1, keepdims=True)
        free = (r[:rows].reshape(k, self.dim)) - u[:rows].reshape(k, self.dim) / scale
        mine = r[:rows].reshape(k, self.dim)
        defect = scale * (mine - project_cone(free, self.friction, mine[:, 0]))
        j = self.joints
        joint = d[j] * (r[j] - np.clip(r[j] - u[j] / d[j], self.lower, self.upper))
        return float(np.sqrt(np.square(defect).sum() + np.square(joint).sum()))


def project_cone(r: np.ndarray, friction: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Project impulses onto the friction cone of given normal impulses.

    Returns (max(0, r_n), r_t projected onto the disk of radius mu max(0, normal)), shape (k, dim).
    """
    out = r.copy()
    out[:, 0] = np.maximum(r[:, 0], 0.0)
    radius, length = friction * np.maximum(normal, 0.0), np.linalg.norm(r[:, 1:], axis=1)
    out[:, 1:] *= (radius / np.maximum(length, np.maximum(radius, 1e-300)))[:, None]
    return out


class ContactModel(Protocol):
    """Friction model: turns a contact system into a problem."""

    def problem(self, system: ContactSystem) -> Problem:
        """Return the problem of a contact system."""

    def impulses(self, system: ContactSystem, x: np.ndarray) -> np.ndarray:
        """Return the impulses r of a solution."""

    def guess(self, system: ContactSystem, r: np.ndarray) -> np.ndarray:
        """Return a first guess whose impulses are near r."""


@dataclass(frozen=True)
class BoxedModel:
    """Boxed friction model: |r_t| <= mu r_n for each tangent separately.

    Bounds are affine in r_n ([Book] 1.3.5). The cone has four sides and allows friction up to
    sqrt(2) mu along diagonals, and friction is not exactly opposite to the slip. The problem is
    symmetric positive semi-definite, with n = dim k + m unknowns, for methods that support affine
    bounds.
    """

    def problem(self, system: ContactSystem) -> Problem:
        """Return the boxed problem, whose x are the impulses r."""
        n, normal, mu = len(system.q), np.full(len(system.q), -1), np.zeros(len(system.q))
        normal[system.tangents] = system.normals[:, None]
        mu[system.tangents] = system.friction[:, None]
        low, high = np.zeros(n), np.full(n, np.inf)
        low[system.joints], high[system.joints] = system.lower, system.upper
        lower, upper = AffineBounds.friction(normal, mu, low, high)
        facts = {"symmetric", "semidefinite", "boxed", "affine"} | (
            {"mixed"} if np.isinf(system.lower).any() else set()
        )
        return Problem(
            f"{system.name}: boxed", system.B, system.q, lower, upper, None, frozenset(facts)
        )

    def impulses(self, system: ContactSystem, x: np.ndarray) -> np.ndarray:
        """Return x: the unknowns are the impulses."""
        return x

    def guess(self, system: ContactSystem, r: np.ndarray) -> np.ndarray:
        """Return r clipped to the bounds at r."""
        x = r.copy()
        x[system.joints] = np.clip(x[system.joints], system.lower, system.upper)
        x[system.normals] = np.maximum(x[system.normals], 0.0)
        radius = (system.friction * x[system.normals])[:, None]
        x[system.tangents] = np.clip(x[system.tangents], -radius, radius)
        return x


@dataclass(frozen=True, eq=False)
class FrozenBoxModel(BoxedModel):
    """Boxed friction model with given normal impulses s: |r_t| <= mu s.

    Bounds are constants, so any method for boxed problems can solve it.

    Args:
        normal: impulse s of each contact [N s], shape (k,).
    """

    normal: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def problem(self, system: ContactSystem) -> Problem:
        """Return the boxed problem with constant bounds."""
        p = BoxedModel().problem(system)
        at = np.zeros(len(p.b))
        at[system.normals] = np.maximum(self.normal, 0.0)
        assert isinstance(p.lower, AffineBounds) and isinstance(p.upper, AffineBounds)
        facts = p.facts - {"affine"} | {"solvable"}
        return Problem(
            f"{system.name}: frozen boxes", p.A, p.b, p.lower.at(at), p.upper.at(at), None, facts
        )


@dataclass(frozen=True)
class StewartTrinkleModel:
    """LCP of Stewart and Trinkle with a friction cone of K sides.

    [Book] 1.3.5, eqs. 1.146-1.147. Friction is a sum of non-negative impulses along K unit vectors,
    evenly spaced around the normal. With the slip speed beta, a contact has the rows y_n = u_n, y_t
    = u_t + beta, y_beta = mu x_n - sum of x_t, each complementary to its x >= 0. With the sign of
    the last row the matrix is [B_nn, B_nt, 0; B_tn, B_tt, e; mu, -e', 0]. It is not symmetric, the
    diagonal of beta is 0, and it is copositive: a problem for Lemke's method and Newton-type
    methods, with (2 + K) k + m unknowns.

    The cone lies inside the circular one and touches it along the K vectors; its sides are nearer
    by the factor cos(pi / K). In the plane the vectors are +-t, K = 2, whatever `directions` is.

    Args:
        directions: K, even; with 2 opposite ones, friction acts along one tangent only.

    Raises:
        ValueError: K is odd, or less than 2.
    """

    directions: int = 4

    def __post_init__(self) -> None:
        """Check that K is even and at least 2."""
        if self.directions < 2 or self.directions % 2:
            raise ValueError(f"directions = {self.directions}: must be an even number >= 2")

    def spread(self, dim: int) -> np.ndarray:
        """Return normal and K tangent vectors in a contact's frame, shape (1 + K, dim)."""
        K = self.directions if dim == 3 else 2
        angles = 2 * np.pi * np.arange(K) / K
        around = np.stack([np.cos(angles), np.sin(angles)], axis=1)[:, : dim - 1]
        return np.block([[np.ones((1, 1)), np.zeros((1, dim - 1))], [np.zeros((K, 1)), around]])

    def unfold(self, system: ContactSystem) -> scipy.sparse.csr_array:
        """Return the matrix T of r = T'x; shape (unknowns, rows of B).

        Impulses are r = T'x for the unknowns x, velocities along the vectors T u.
        """
        each = np.vstack([self.spread(system.dim), np.zeros(system.dim)])
        blocks = [
            scipy.sparse.kron(scipy.sparse.eye_array(system.contacts), each),
            scipy.sparse.eye_array(len(system.lower)),
        ]
        return scipy.sparse.csr_array(scipy.sparse.block_diag(blocks))

    def problem(self, system: ContactSystem) -> Problem:
        """Return the LCP; it is mixed if joints have equations.

        A = T B T' plus the entries of the cones: 1 in the rows of x_t and -1 in the row of beta,
        and mu in the row of beta at x_n.
        """
        k, m, T = system.contacts, len(system.lower), self.unfold(system)
        K = len(self.spread(system.dim)) - 1
        beta = np.zeros((2 + K, 2 + K))
        beta[1:-1, -1], beta[-1, 1:-1] = 1.0, -1.0
        slope = np.zeros((2 + K, 2 + K))
        slope[-1, 0] = 1.0
        cones = scipy.sparse.kron(scipy.sparse.eye_array(k), beta) + scipy.sparse.kron(
            scipy.sparse.diags_array(system.friction), slope
        )
        A = scipy.sparse.csr_array(
            T @ system.B @ T.T + scipy.sparse.block_diag([cones, scipy.sparse.csr_array((m, m))])
        )
        n = A.shape[0]
        lower, upper = np.zeros(n), np.full(n, np.inf)
        lower[n - m :], upper[n - m :] = system.lower, system.upper
        facts = {"copositive"} | ({"mixed"} if np.isinf(system.lower).any() else set())
        facts |= {"boxed"} if np.isfinite(system.upper).any() else set()
        return Problem(
            f"{system.name}: Stewart-Trinkle, {K} sides",
            A,
            T @ system.q,
            lower,
            upper,
            None,
            frozenset(facts),
        )

    def impulses(self, system: ContactSystem, x: np.ndarray) -> np.ndarray:
        """Return r: friction is the sum over the tangent vectors."""
        return np.asarray(self.unfold(system).T @ x)

    def guess(self, system: ContactSystem, r: np.ndarray) -> np.ndarray:
        """Return a first guess whose impulses are near r.

        Friction is split onto the two nearest vectors; beta is the slip speed at r.

        K unit vectors are 2 pi / K apart. Friction f at an angle a from the vector before it is
        f sin(2 pi / K - a) / sin(2 pi / K) times that vector, plus f sin(a) / sin(2 pi / K) times
        the next one. beta = max(0, max over the vectors t of -t.u) [m/s].
        """
        k, dim, spread = system.contacts, system.dim, self.spread(system.dim)
        rows, own = dim * k, r[: dim * k].reshape(k, dim)
        u = (system.B @ r + system.q)[:rows].reshape(k, dim)
        x = np.zeros((k, 1 + len(spread)))
        x[:, 0] = own[:, 0]
        K = len(spread) - 1
        if K == 2:
            x[:, 1], x[:, 2] = np.maximum(own[:, 1], 0.0), np.maximum(-own[:, 1], 0.0)
        else:
            turn = np.arctan2(own[:, 2], own[:, 1]) % (2 * np.pi) * K / (2 * np.pi)
            before = np.floor(turn).astype(int) % K
            length, rest = (
                np.linalg.norm(own[:, 1:], axis=1),
                (turn - np.floor(turn)) * 2 * np.pi / K,
            )
            each = np.arange(k)
            x[each, 1 + before] = length * np.sin(2 * np.pi / K - rest) / np.sin(2 * np.pi / K)
            x[each, 1 + (before + 1) % K] = length * np.sin(rest) / np.sin(2 * np.pi / K)
        x[:, -1] = np.maximum((-u @ spread[1:].T).max(axis=1), 0.0)
        return np.concatenate([x.ravel(), r[rows:]])


def proximal_sweeps(
    system: ContactSystem,
    *,
    tolerance: float = 1e-9,
    most: int = 1000,
    r0: np.ndarray | None = None,
) -> tuple[np.ndarray, float, int]:
    """Solve the proximal form with the circular cone by Gauss-Seidel sweeps.

    The sweeps are over contacts, on the host ([Book] 1.1.4, 1.3.5): r_n <- max(0, r_n - u_n /
    B_nn), then r_t <- proj(r_t - u_t / rho) onto |r_t| <= mu r_n, with rho the largest eigenvalue
    of the contact's B_tt; joint rows <- clip(r - u / B_ii). Convergence is not proven for mu > 0.
    The result is the reference for the polyhedral cones here, in systems of up to some hundred
    contacts.

    Args:
        system: the contact system.
        tolerance: limit of `system.residual`, relative to that at r = 0.
        most: limit of sweeps.
        r0: initial impulses; 0 if None.

    Returns:
        r, the residual at r [m/s], and the number of sweeps.
    """
    dense = system.B.toarray()
    r, k, dim = np.zeros(len(system.q)) if r0 is None else r0.copy(), system.contacts, system.dim
    u = dense @ r + system.q
    diagonal = np.where(np.diag(dense) > 0, np.diag(dense), 1.0)
    rho = [float(np.linalg.eigvalsh(dense[t][:, t])[-1]) or 1.0 for t in system.tangents]
    target = tolerance * system.residual(np.zeros_like(r))

    def change(rows: np.ndarray, to: np.ndarray) -> None:
        nonlocal u
        u += dense[:, rows] @ (to - r[rows])
        r[rows] = to

    for sweep in range(1, most + 1):
        for c in range(k):
            n, t = dim * c, system.tangents[c]
            change(np.array([n]), np.maximum(r[n : n + 1] - u[n] / diagonal[n], 0.0))
            free, radius = r[t] - u[t] / rho[c], system.friction[c] * r[n]
            length = float(np.linalg.norm(free))
            change(t, free if length <= radius else free * (radius / length))
        for row, low, high in zip(system.joints, system.lower, system.upper, strict=True):
            change(np.array([row]), np.clip(r[row : row + 1] - u[row] / diagonal[row], low, high))
        residual = system.residual(r)
        if residual <= target:
            return r, residual, sweep
    return r, residual, most
