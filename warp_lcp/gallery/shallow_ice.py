"""The steady shallow ice sheet: thickness H >= 0 of ice that flows by its own slope, a nonlinear problem as a sequence of linear ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse

from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.solvers.default import solve

YEAR = 31556926.0  # [s]
# Where a cell's fluxes are taken, in its own coordinates; along which axis; and the corners (x, y) that each leaves and enters.
POINTS = (
    ((0.5, 0.25), 0, (0, 0), (1, 0)), ((0.5, 0.75), 0, (0, 1), (1, 1)), ((0.25, 0.5), 1, (0, 0), (0, 1)), ((0.75, 0.5), 1, (1, 0), (1, 1)),
)  # fmt: skip
SHARES = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 5e-3, 2e-3, 1e-3)  # of a constant diffusivity, one after another
STEPS, MOST = 60, 1000.0  # of Newton's method for a share, and the most that the thickness moves in one [m]
CORNERS = ((0, 0), (1, 0), (1, 1), (0, 1))


@dataclass(frozen=True, kw_only=True)
class IceDome:
    """A radial dome of ice on a flat bed, whose thickness H is known: div q = m where H > 0, q = -Gamma H^(n+2) |grad H|^(n-1) grad H.

    The surface mass balance m is what keeps the dome as it is; outside, more melts than flows in. Discretized by the control volumes of
    Bueler on bilinear elements with two fluxes a side, as his program p4pdes/ice.c does: F(H) >= 0, H >= 0, H'F(H) = 0, F the
    outflow of each volume less what falls on it, and D = (1 - regularization) Gamma H^(n+2) (|grad H|^2 + slope^2)^((n-1)/2) +
    regularization * 1 m^2/s for the diffusivity. H = 0 on the border.

    Args:
        nodes: a side of the square, the border included, >= 3.
        side: of the square [m].
        radius: of the dome [m].
        height: of its center [m].
        exponent: n > 1 of Glen's law.
        softness: A [1/(Pa^n s)] of the ice.
        regularization: share of a constant diffusivity, in [0, 1].
        slope: least slope, >= 0.

    Raises:
        ValueError: a number is out of range.
    """

    nodes: int
    side: float = 1800e3
    radius: float = 750e3
    height: float = 3600.0
    exponent: float = 3.0
    softness: float = 3.1689e-24
    regularization: float = 0.0
    slope: float = 1e-4

    @property
    def gamma(self) -> float:
        """2 A (rho g)^n / (n + 2) [1/(m^n s)]."""
        return 2 * self.softness * (910.0 * 9.81) ** self.exponent / (self.exponent + 2)

    @property
    def distance(self) -> np.ndarray:
        """Of the nodes from the center, in radii, shape (nodes, nodes)."""
        s = np.linspace(-self.side / 2, self.side / 2, self.nodes) / self.radius
        return np.hypot(*np.meshgrid(s, s))

    def thickness(self) -> np.ndarray:
        """Return the dome's H at the nodes [m], shape (nodes, nodes)."""
        n, s = self.exponent, np.minimum(self.distance, 1.0)
        shape = (1 + 1 / n) * s - 1 / n + (1 - s) ** (1 + 1 / n) - s ** (1 + 1 / n)
        return self.height * (np.maximum(shape, 0) / (1 - 1 / n)) ** (n / (2 * n + 2))

    def balance(self) -> np.ndarray:
        """Return m at the nodes [m/s], within 1 cm of the center and of the margin what it is there."""
        n = self.exponent
        s = np.clip(self.distance, 0.01 / self.radius, 1 - 0.01 / self.radius)
        scale = self.gamma * self.height ** (2 * n + 2) / (2 * self.radius * (1 - 1 / n)) ** n
        rise = s ** (1 / n) + (1 - s) ** (1 / n) - 1
        fall = 2 * s ** (1 / n) + (1 - s) ** (1 / n - 1) * (1 - 2 * s) - 1
        return scale / (self.radius * s) * rise ** (n - 1) * fall

    def outflow(self, H: np.ndarray, share: float) -> tuple[np.ndarray, scipy.sparse.csr_array]:
        """Return what flows out of the control volumes [m^3/s], and its derivative by H.

        Args:
            H: thickness at the nodes [m], shape (nodes, nodes).
            share: of a constant diffusivity.
        """
        h, n, N = self.side / (self.nodes - 1), self.exponent, self.nodes
        corners = np.stack([H[y : N - 1 + y, x : N - 1 + x] for x, y in CORNERS])
        number = np.arange(N * N).reshape(N, N)
        at = {c: number[c[1] : N - 1 + c[1], c[0] : N - 1 + c[0]].ravel() for c in CORNERS}
        F, rows, columns, entries = np.zeros(N * N), [], [], []
        for (px, py), axis, left, right in POINTS:
            weight = np.array([(px if x else 1 - px) * (py if y else 1 - py) for x, y in CORNERS])
            grad = np.array([[(1 if x else -1) * (py if y else 1 - py), (px if x else 1 - px) * (1 if y else -1)] for x, y in CORNERS]) / h
            value = np.tensordot(weight, corners, 1)
            gx, gy = (np.tensordot(grad[:, a], corners, 1) for a in (0, 1))
            steep = gx**2 + gy**2 + self.slope**2
            sliding = (1 - share) * self.gamma * steep ** ((n - 1) / 2)
            D = sliding * np.abs(value) ** (n + 2) + share
            along = (gx, gy)[axis]
            q = -D * along
            for k, corner in enumerate(CORNERS):
                turn = sliding * np.abs(value) ** (n + 2) * (n - 1) / steep * (gx * grad[k, 0] + gy * grad[k, 1])
                thick = sliding * (n + 2) * np.abs(value) ** (n + 1) * np.sign(value) * weight[k]
                dq = -(D * grad[k, axis] + along * (turn + thick)) * h / 2
                for node, sign in ((left, 1), (right, -1)):
                    rows.append(at[node])
                    columns.append(at[corner])
                    entries.append(sign * dq.ravel())
            np.add.at(F, at[left], q.ravel() * h / 2)
            np.add.at(F, at[right], -q.ravel() * h / 2)
        J = scipy.sparse.coo_array((np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns))), shape=(N * N,) * 2)
        return F.reshape(N, N), J.tocsr()

    def solve(self, *, device: Any = None) -> np.ndarray:
        """Return H at the nodes [m]: Newton's method, a linear complementarity problem a step, for less and less of a constant diffusivity.

        Args:
            device: Warp device of the problems.

        Raises:
            RuntimeError: a problem was not solved, or steps do not end.
        """
        inner = np.zeros((self.nodes,) * 2, dtype=bool)
        inner[1:-1, 1:-1] = True
        unknown, area = inner.ravel(), (self.side / (self.nodes - 1)) ** 2
        gain = self.balance() * area
        H = np.where(inner, np.maximum(self.balance() * YEAR * 1000, 0), 0.0)  # what falls in a thousand years
        for share in (s for s in (*SHARES, self.regularization) if s >= self.regularization):
            for _ in range(STEPS):
                F, J = self.outflow(H, share)
                J, b = J[unknown][:, unknown], (F - gain).ravel()[unknown] - J[unknown][:, unknown] @ H.ravel()[unknown]
                result = solve(LCP(SparseOperator(J, device=device), b), x0=H.ravel()[unknown], stopping=StoppingCriteria(rtol=1e-9))
                if not result:
                    raise RuntimeError(f"a share of {share} of constant diffusivity: {result.status.name}")
                new = np.zeros_like(H)
                new[inner] = result.x.numpy()
                moved, H = float(np.abs(new - H).max()), H + np.clip(new - H, -MOST, MOST)
                if moved <= 1e-6 * self.height:
                    break
            else:
                raise RuntimeError(f"a share of {share} of constant diffusivity: no end after {STEPS} steps of Newton's method")
        return H
