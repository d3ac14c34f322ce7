"""American and European puts in the Heston model of stochastic volatility.

The operator has a mixed derivative and is not symmetric; each time step is an LCP.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy.interpolate
import warp as wp

from warp_lcp.default_chain import default_chain
from warp_lcp.method_selection import solve
from warp_lcp.operators.grid_matrix import grid_matrix
from warp_lcp.operators.stencil import Stencil
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.operator_protocol import AIR, FLUID
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.settings import renamed_names
from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton

Coefficients = dict[tuple[int, int], np.ndarray]
IMPLICIT = 2  # steps of implicit Euler before Crank-Nicolson, since the payoff has a kink
DENSE = 0.2  # relative to K: range in which nodes of S are densest


def differences(
    x: np.ndarray, diffusion: np.ndarray, drift: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return difference weights of diffusion u'' + drift u' at nodes x.

    Weights below and above the diagonal: central differences, or upwind if a central weight would
    be negative.

    Args:
        x: nodes, increasing, shape (n,); the last one has the spacing of the one before.
        diffusion: >= 0, shape (..., n).
        drift: likewise, any sign.
    """
    below = np.diff(x, prepend=2 * x[0] - x[1])
    above = np.diff(x, append=2 * x[-1] - x[-2])
    low, high = (
        (2 * diffusion - drift * above) / (below * (below + above)),
        (2 * diffusion + drift * below) / (above * (below + above)),
    )
    upwind = (low < 0) | (high < 0)
    low_upwind = 2 * diffusion / (below * (below + above)) + np.maximum(-drift, 0) / below
    high_upwind = 2 * diffusion / (above * (below + above)) + np.maximum(drift, 0) / above
    return np.where(upwind, low_upwind, low), np.where(upwind, high_upwind, high)


@dataclass(frozen=True, kw_only=True)
class Heston:
    """American or European put in Heston's model of stochastic volatility.

    dS = r S dt + sqrt(v) S dW1, dv = kappa (theta - v) dt + sigma sqrt(v) dW2, with correlated dW1
    and dW2.

    The price u(S, v) at time t before expiry satisfies u_t + L u >= 0, u >= max(K - S, 0), one of
    them with equality, where L u = -(v S^2 u_SS / 2 + rho sigma v S u_Sv + sigma^2 v u_vv / 2 + r S
    u_S + kappa (theta - v) u_v - r u). The defaults are the test of Ikonen and Toivanen (2005).

    Args:
        strike: K > 0.
        expiry: time to expiry > 0 [years].
        rate: r >= 0 [1/year], without dividends.
        reversion: kappa > 0 [1/year].
        mean: theta > 0 [1/year].
        volatility: sigma > 0 [1/year], of the variance.
        correlation: rho, in (-1, 1).

    Raises:
        ValueError: a number is out of range.
    """

    strike: float = 10.0
    expiry: float = 0.25
    rate: float = 0.1
    reversion: float = 5.0
    mean: float = 0.16
    volatility: float = 0.9
    correlation: float = 0.1

    def __post_init__(self) -> None:
        """Check that all numbers are in range."""
        positive = {
            "strike": self.strike,
            "expiry": self.expiry,
            "reversion": self.reversion,
            "mean": self.mean,
            "volatility": self.volatility,
        }
        for name, value in positive.items():
            if not 0 < value < np.inf:
                raise ValueError(f"{name} = {value}: must be > 0 and finite")
        if not 0 <= self.rate < np.inf:
            raise ValueError(f"rate = {self.rate}: must be >= 0 and finite")
        if not -1 < self.correlation < 1:
            raise ValueError(f"correlation = {self.correlation}: must be in (-1, 1)")

    def nodes(self, ns: int, nv: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the nodes of S and v.

        S from 0 to about 3 K, dense around K, which is halfway between two nodes; v from 0 to 1 or
        6 theta, dense at 0.

        Args:
            ns: intervals of S.
            nv: intervals of v.
        """
        low, high = np.arcsinh(-1 / DENSE), np.arcsinh(2 / DENSE)
        step = -low / (round(ns * low / (low - high)) - 0.5)
        S = self.strike * (1 + DENSE * np.sinh(low + step * np.arange(ns + 1)))
        S[0] = 0.0
        v = np.sinh(np.linspace(0, np.arcsinh(20.0), nv + 1)) / 20.0
        return S, v * max(1.0, 6 * self.mean)

    def coefficients(self, S: np.ndarray, v: np.ndarray) -> Coefficients:
        """Return the differential operator as a stencil of 7 points.

        {(dv, dS): array of shape (v, S)}, of second order on smooth grids except for v near 0. The
        mixed derivative is the mean of those of the two squares in whose direction it is positive,
        which keeps A an M-matrix if the ratio of spacings allows it. Above the last v the price is
        constant, beyond the last S it is 0.

        Args:
            S: nodes, increasing from 0.
            v: nodes, increasing from 0.
        """
        X, V = np.meshgrid(S, v)
        west, east = differences(S, V * X**2 / 2, self.rate * X)
        south, north = (
            d.T
            for d in differences(
                v, (self.volatility**2 * V / 2).T, (self.reversion * (self.mean - V)).T
            )
        )
        a = {(0, -1): -west, (0, 1): -east, (-1, 0): -south, (1, 0): -north}
        h, k = np.diff(S), np.diff(v)
        mixed = np.where(
            (X > 0) & (V > 0), abs(self.correlation) * self.volatility * V * X / 2, 0.0
        )
        mixed[-1] = mixed[:, -1] = 0.0
        side = 1 if self.correlation > 0 else -1
        for up in (1, -1):
            right = side * up
            width, height = (
                np.append(s, s[-1]) if step > 0 else np.append(s[:1], s)
                for s, step in ((h, right), (k, up))
            )
            part = mixed / (width * height[:, None])
            a[up, right] = -part
            a[0, right] = a[0, right] + part
            a[up, 0] = a[up, 0] + part
        a[0, 0] = self.rate - np.sum(list(a.values()), axis=0)
        return a

    def put(
        self, ns: int, nv: int, steps: int, *, american: bool = True, device: wp.DeviceLike = None
    ) -> OptionPrices:
        """Return the prices of the put at time 0.

        Each time step is a complementarity problem, which starts from the last one's solution. Time
        steps grow linearly, since the price is smoother later and its free boundary moves more
        slowly.

        Args:
            ns: intervals of S, >= 8.
            nv: intervals of v, >= 4.
            steps: number of time steps > 2; the first 2 are implicit Euler, the others
                Crank-Nicolson.
            american: whether it can be exercised at any time; else there are no bounds.
            device: Warp device of the operator.

        Raises:
            ValueError: a number is too small.
            RuntimeError: a problem was not solved; the message has its status.
        """
        for name, value, least in (("ns", ns, 8), ("nv", nv, 4), ("steps", steps, IMPLICIT + 1)):
            if value < least:
                raise ValueError(f"{name} = {value}: must be >= {least}")
        S, v = self.nodes(ns, nv)
        cells = np.full((nv + 1, ns + 1), FLUID)
        cells[:, -1] = AIR  # the price is 0 there; at the other sides it is constant beyond
        shift = wp.zeros((3, nv + 3, ns + 3), dtype=wp.float64, device=device)
        A = Stencil(cells, self.coefficients(S, v), shift=shift, device=device, dtype=wp.float64)
        L = grid_matrix(A)  # without shift so far
        payoff = np.broadcast_to(np.maximum(self.strike - S, 0) * (S[-1] > S), cells.shape)
        u, times = payoff.copy(), self.expiry * (np.arange(steps + 1) / steps) ** 2
        b = A.layout.load(u, wp.float64).reshape(A.layout.stored_shape)
        problem = LCP(A, b, payoff if american else -np.inf)
        method = default_chain(MinimumMapNewton(), problem)
        work = method.init(problem)
        for step, (before, after) in enumerate(pairwise(times)):
            share = 1.0 if step < IMPLICIT else 0.5
            # Scale of y, chosen such that only the shift changes from step to step.
            unit = 1 / (share * (after - before))
            shift.fill_(unit)
            A.update(A.cells)
            rest = np.pad((L @ u[:, :-1].ravel()).reshape(nv + 1, ns), ((0, 0), (0, 1)))
            b.assign(
                A.layout.load((1 - share) / share * rest - unit * u, wp.float64).reshape(b.shape)
            )
            stopping = StoppingCriteria(rtol=1e-7, atol=1e-9 * unit, max_iterations=1000)
            result = solve(problem, method, x0=u, stopping=stopping, workspace=work)
            if not result:
                raise RuntimeError(f"time step {step}: {result.status.name}")
            u = A.layout.unload(result.x.flatten()).numpy().copy()
        return OptionPrices(S, v, u)

    def extrapolated(
        self,
        spot: float | np.ndarray,
        variance: float,
        ns: int,
        nv: int,
        steps: int,
        *,
        american: bool = True,
        device: wp.DeviceLike = None,
    ) -> np.ndarray:
        """Return Richardson-extrapolated prices from this grid and one twice as fine.

        4/3 of the fine grid's prices minus 1/3 of this grid's.

        Args:
            spot: S, a number or an array.
            variance: v.
            ns: intervals of S of the coarse grid.
            nv: intervals of v.
            steps: number of time steps.
            american: as of `put`.
            device: as of `put`.
        """
        coarse, fine = (
            self.put(k * ns, k * nv, k * steps, american=american, device=device).at(spot, variance)
            for k in (1, 2)
        )
        return (4 * fine - coarse) / 3


@dataclass(frozen=True, eq=False)
class OptionPrices:
    """Option prices on a grid.

    Attributes:
        S: prices of the stock, shape (ns + 1,).
        v: variances, shape (nv + 1,).
        u: prices of the put, shape (nv + 1, ns + 1).
    """

    S: np.ndarray
    v: np.ndarray
    u: np.ndarray

    def at(self, spot: float | np.ndarray, variance: float) -> np.ndarray:
        """Return interpolated prices: cubic splines, first in v, then in S."""
        return scipy.interpolate.CubicSpline(
            self.S, scipy.interpolate.CubicSpline(self.v, self.u)(variance)
        )(spot)


__getattr__ = renamed_names(__name__, Prices="OptionPrices")
