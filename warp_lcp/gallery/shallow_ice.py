"""Steady shallow ice sheet: thickness H >= 0, a nonlinear obstacle problem.

It is solved as a sequence of LCPs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
import warp as wp

from warp_lcp.method_selection import solve
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.stopping import StoppingCriteria

STEPS = 60  # limit of Newton steps; at most 7 were needed
TIGHT = StoppingCriteria(rtol=1e-10, max_iterations=200)
# Points of a cell's fluxes, in its own coordinates; axis of each flux; and the corners (x, y) that
# it leaves and enters.
POINTS = (
    ((0.5, 0.25), 0, (0, 0), (1, 0)),
    ((0.5, 0.75), 0, (0, 1), (1, 1)),
    ((0.25, 0.5), 1, (0, 0), (0, 1)),
    ((0.75, 0.5), 1, (1, 0), (1, 1)),
)
CORNERS = ((0, 0), (1, 0), (1, 1), (0, 1))


@dataclass(frozen=True, kw_only=True)
class IceDome:
    """Radial dome of ice on a flat bed with a known thickness H.

    div q = m where H > 0, q = -Gamma H^(n+2) |grad H|^(n-1) grad H. The surface mass balance m
    keeps the dome steady; outside, more ice melts than flows in.

    The discretization is that of Bueler (2016), control volumes on bilinear elements with two
    fluxes per side, as in his program p4pdes/ice.c: F(H) >= 0, H >= 0, H'F(H) = 0. F is the outflow
    of each volume less its mass balance, with the diffusivity D = (1 - regularization) Gamma
    H^(n+2) (|grad H|^2 + slope^2)^((n-1)/2) + regularization * 1 m^2/s. H = 0 on the border.

    Args:
        nodes: nodes per side of the square, including the border, >= 3.
        side: side of the square [m].
        radius: radius of the dome [m].
        height: height of its center [m].
        exponent: n > 1 of Glen's law.
        softness: ice softness A [1/(Pa^n s)].
        regularization: share of a constant diffusivity, in (0, 1].
        slope: least slope, > 0.

    Raises:
        ValueError: a number is out of range.
    """

    nodes: int
    side: float = 1800e3
    radius: float = 750e3
    height: float = 3600.0
    exponent: float = 3.0
    softness: float = 3.1689e-24
    regularization: float = 1e-4
    slope: float = 1e-4

    def __post_init__(self) -> None:
        """Check that all numbers are in range."""
        if self.nodes < 3:
            raise ValueError(
                f"nodes = {self.nodes}: must be >= 3, the nodes along a side, border included"
            )
        for name, value, least in (
            ("side", self.side, 0),
            ("radius", self.radius, 0),
            ("height", self.height, 0),
            ("exponent", self.exponent, 1),
            ("softness", self.softness, 0),
            ("slope", self.slope, 0),
        ):
            if not least < value < np.inf:
                raise ValueError(f"{name} = {value}: must be > {least} and finite")
        if not 0 < self.regularization <= 1:
            raise ValueError(f"regularization = {self.regularization}: must be in (0, 1]")

    @property
    def gamma(self) -> float:
        """2 A (rho g)^n / (n + 2) [1/(m^n s)]."""
        return 2 * self.softness * (910.0 * 9.81) ** self.exponent / (self.exponent + 2)

    @property
    def distance(self) -> np.ndarray:
        """Distance of the nodes from the center, in radii, shape (nodes, nodes)."""
        s = np.linspace(-self.side / 2, self.side / 2, self.nodes) / self.radius
        return np.hypot(*np.meshgrid(s, s))

    def thickness(self) -> np.ndarray:
        """Return the exact H at the nodes [m], shape (nodes, nodes)."""
        n, s = self.exponent, np.minimum(self.distance, 1.0)
        shape = (1 + 1 / n) * s - 1 / n + (1 - s) ** (1 + 1 / n) - s ** (1 + 1 / n)
        return self.height * (np.maximum(shape, 0) / (1 - 1 / n)) ** (n / (2 * n + 2))

    def balance(self) -> np.ndarray:
        """Return the mass balance m at the nodes [m/s], shape (nodes, nodes).

        m is not finite at center and margin; there its value 1 cm beside is used.
        """
        n = self.exponent
        s = np.clip(self.distance, 0.01 / self.radius, 1 - 0.01 / self.radius)
        scale = self.gamma * self.height ** (2 * n + 2) / (2 * self.radius * (1 - 1 / n)) ** n
        rise = s ** (1 / n) + (1 - s) ** (1 / n) - 1
        fall = 2 * s ** (1 / n) + (1 - s) ** (1 / n - 1) * (1 - 2 * s) - 1
        return scale / (self.radius * s) * rise ** (n - 1) * fall

    def outflow(self, H: np.ndarray, share: float) -> tuple[np.ndarray, scipy.sparse.csr_array]:
        """Return the outflow of each volume [m^3/s] and its derivative by H.

        Shape (nodes, nodes), and a matrix of the nodes.

        Args:
            H: thickness at the nodes [m], shape (nodes, nodes).
            share: share of the constant diffusivity.
        """
        h, n, N = self.side / (self.nodes - 1), self.exponent, self.nodes
        corners = np.stack([H[y : N - 1 + y, x : N - 1 + x] for x, y in CORNERS])
        number = np.arange(N * N).reshape(N, N)
        at = {c: number[c[1] : N - 1 + c[1], c[0] : N - 1 + c[0]].ravel() for c in CORNERS}
        F, rows, columns, entries = np.zeros(N * N), [], [], []
        for (px, py), axis, left, right in POINTS:
            weight = np.array([(px if x else 1 - px) * (py if y else 1 - py) for x, y in CORNERS])
            grad = (
                np.array(
                    [
                        [
                            (1 if x else -1) * (py if y else 1 - py),
                            (px if x else 1 - px) * (1 if y else -1),
                        ]
                        for x, y in CORNERS
                    ]
                )
                / h
            )
            value = np.tensordot(weight, corners, 1)
            gx, gy = (np.tensordot(grad[:, a], corners, 1) for a in (0, 1))
            steep = gx**2 + gy**2 + self.slope**2
            sliding = (1 - share) * self.gamma * steep ** ((n - 1) / 2)
            D = sliding * np.abs(value) ** (n + 2) + share
            along = (gx, gy)[axis]
            q = -D * along
            for k, corner in enumerate(CORNERS):
                turn = (
                    sliding
                    * np.abs(value) ** (n + 2)
                    * (n - 1)
                    / steep
                    * (gx * grad[k, 0] + gy * grad[k, 1])
                )
                thick = sliding * (n + 2) * np.abs(value) ** (n + 1) * np.sign(value) * weight[k]
                dq = -(D * grad[k, axis] + along * (turn + thick)) * h / 2
                for node, sign in ((left, 1), (right, -1)):
                    rows.append(at[node])
                    columns.append(at[corner])
                    entries.append(sign * dq.ravel())
            np.add.at(F, at[left], q.ravel() * h / 2)
            np.add.at(F, at[right], -q.ravel() * h / 2)
        J = scipy.sparse.coo_array(
            (np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns))),
            shape=(N * N,) * 2,
        )
        return F.reshape(N, N), J.tocsr()

    def solve(self, *, device: wp.DeviceLike = None) -> np.ndarray:
        """Return the discrete H at the nodes [m] by Newton's method.

        Shape (nodes, nodes). Each step is a linear complementarity problem, H >= 0. The share of
        the constant diffusivity falls from 1, where the problem is linear, by a third of a decade
        each time, to `regularization`.

        Args:
            device: Warp device of the operators.

        Raises:
            RuntimeError: a linear problem was not solved, or Newton's method did not converge; the
                message names the cause.
        """
        H, share = np.zeros((self.nodes,) * 2), 1.0
        while True:
            H = self._newton(H, share, device)
            if share <= self.regularization:
                return H
            share = max(share / 10 ** (1 / 3), self.regularization)

    def _newton(self, H: np.ndarray, share: float, device: wp.DeviceLike) -> np.ndarray:
        """Return the solution for a share of the constant diffusivity from a guess.

        Each step solves the LCP of the linearization, F(H_k) - m + J (H - H_k) complementary to H
        >= 0, on the inner nodes.
        """
        inner = np.flatnonzero(np.pad(np.ones((self.nodes - 2,) * 2, dtype=bool), 1))
        falls = (self.balance() * (self.side / (self.nodes - 1)) ** 2).ravel()[inner]
        for _ in range(STEPS):
            F, J = self.outflow(H, share)
            x, y = H.ravel()[inner], F.ravel()[inner] - falls
            if np.linalg.norm(np.minimum(x / self.height, y / np.abs(falls).max())) <= 1e-7:
                return H
            A = SparseOperator(J[inner][:, inner], device=device, dtype=wp.float64)
            result = solve(
                LCP(A, y - A.apply(wp.array(x, dtype=wp.float64, device=A.device)).numpy()),
                x0=x,
                stopping=TIGHT,
            )
            if not result:
                raise RuntimeError(f"share {share:.1e}: {result.status.name}")
            H = H.copy()
            H.ravel()[inner] = result.x.numpy()
        raise RuntimeError(f"share {share:.1e}: no convergence in {STEPS} steps")
