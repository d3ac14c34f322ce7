"""Restarted, right-preconditioned GMRES on the device (Saad & Schultz 1986)."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

import numpy as np
import warp as wp

from warp_lcp.deadline import check_time
from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.fields import zeros, zeros_like
from warp_lcp.kernels.launch_graph import LaunchGraph, clear, copy
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import ADD, RowReduction, rows_of
from warp_lcp.krylov.conjugate_gradient import KrylovPreconditioner, LinearMap
from warp_lcp.krylov.hessenberg import HessenbergLeastSquares

KERNELS = KernelFile(Path(__file__).parent / "headers/krylov.h")
RESIDUAL = KERNELS["gmres.residual"]
WEIGH = KERNELS["gmres.weigh"]
DOTS = KERNELS["gmres.dots"]
COMBINE = KERNELS["gmres.combine"]
STORE = KERNELS["gmres.store"]
# Number of vectors whose preconditioned images are stored: solves that take no more of them need no
# last preconditioning.
KEPT = 8
# A restart that leaves more than this share of the residual makes no progress, and another one
# would not either.
STALLED = 0.99


class GMRES:
    """Restarted, right-preconditioned GMRES for any A.

    The right-hand side is the preconditioner's field `r`, which is overwritten; the solution is
    `x`. With preconditioning from the right the minimized residual is the true one. It is computed
    from x after every restart, and only that one is reported.

    Args:
        product: A.
        preconditioner: M, an approximation of A's inverse.
        restart: vectors before a restart.
        weight: residuals are measured as ||weight^(1/2) r||, field like r >= 0; None: all 1.
    """

    def __init__(
        self,
        product: LinearMap,
        preconditioner: KrylovPreconditioner,
        *,
        restart: int = 30,
        weight: DeviceArray | None = None,
    ) -> None:
        r, size = preconditioner.r, preconditioner.r.size
        self._product, self._preconditioner, self._restart = product, preconditioner, restart
        self.device, self.x = r.device, zeros_like(r)
        self._b, self._q = zeros_like(r), zeros_like(r)
        self._weight = weight
        self._basis = zeros((restart + 1) * size, r.dtype, r.device)  # fields, one after another
        # The first ones, preconditioned.
        self._images = zeros(min(KEPT, restart) * size, r.dtype, r.device)
        # Products with them, and a square in the last slot.
        self._sums = RowReduction(rows_of(r), restart + 1, slots=restart + 2)
        self._products = zeros(restart + 2, wp.float64, r.device)  # of the first orthogonalization
        self._factors = wp.zeros(restart + 1, dtype=wp.float64, device=r.device)
        self._residual = RESIDUAL.bind(rows_of(r), b=self._b, w=weight, q=self._q)
        self._increase = ADD.bind(rows_of(r), z=preconditioner.z, x=self.x)
        # Launches between two calls of the preconditioner or of A, recorded once on the CPU.
        at_once = r.device.is_cuda
        self._first = LaunchGraph(r.device, self._launch_first, at_once=at_once)
        self._again = LaunchGraph(r.device, self._launch_start, at_once=at_once)
        self._before, self._after, self._ends = (
            [
                LaunchGraph(r.device, partial(function, k), at_once=at_once)
                for k in range(restart + 1)
            ]
            for function in (self._launch_before, self._launch_after, self._launch_end)
        )
        self._problem = HessenbergLeastSquares(restart)

    def solve(self, tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Iterate from x = 0 until the residual norm is at most the tolerance.

        The norm is computed from x. Also ends if it is not a number, or stagnates.

        Returns:
            The iterations done, products with A that restarts cost not counted, and the norm of the
            residual.
        """
        self._first.run()
        norm, done = self._norm(), 0
        while norm > tolerance and done < max_iterations and math.isfinite(norm):
            columns = self._expand(norm, tolerance, min(self._restart, max_iterations - done))
            done += columns
            self._correct(columns)
            self._product(self.x, self._q)
            self._again.run()
            before, norm = norm, self._norm()
            if norm > STALLED * before:
                break
        return done, norm

    def _norm(self) -> float:
        """Return the norm of the residual that a start has stored."""
        return float(np.sqrt(self._sums.scalars.numpy()[-1]))

    def _launch_first(self) -> None:
        """Take the right-hand side, and start at x = 0."""
        copy(self._b, self._preconditioner.r)
        clear(self.x, self._q)
        self._launch_start()

    def _launch_start(self) -> None:
        """Store the normalized residual as the first vector; `_q` is A x."""
        self._residual.launch()
        self._combine(self._factors, self._q, 0)
        self._store(0)

    def _launch_before(self, k: int) -> None:
        """Write W^(-1/2) v_k to the preconditioner: the basis has weighted residuals."""
        copy(self._preconditioner.r, self._vector(self._basis, k))
        self._weigh(self._preconditioner.r, inverse=True)

    def _launch_after(self, k: int) -> None:
        """Orthogonalize w = W^(1/2) A z against the first k + 1 vectors, twice, and store it.

        It is stored as the next vector, normalized. `_products` and `_sums` have its products.
        """
        self._weigh(self._q)
        for first in True, False:
            DOTS.bind(
                rows_of(self._q),
                basis=self._basis,
                size=self._q.size,
                count=k + 1,
                x=self._q,
                out=self._sums.partials,
            ).launch()
            self._sums.add_up(0, columns=k + 1)
            self._combine(self._sums.scalars, self._q, k + 1, sign=-1.0)
            if first:
                copy(self._products, self._sums.scalars)
        self._store(k + 1)

    def _launch_end(self, columns: int) -> None:
        """Add the sum of factors_j M v_j to x, or write that of factors_j v_j to `r`.

        For few columns the stored images M v_j are used.
        """
        if columns <= KEPT:
            self._combine(self._factors, self.x, columns, other_basis=self._images)
            return
        r = self._preconditioner.r
        clear(r)
        self._combine(self._factors, r, columns)
        self._weigh(r, inverse=True)

    def _vector(self, basis: DeviceArray, place: int) -> DeviceArray:
        """Return a vector of a basis."""
        size = self._q.size
        return basis[place * size : (place + 1) * size]

    def _expand(self, norm: float, tolerance: float, most: int) -> int:
        """Add vectors until the residual's estimate is small enough; return their number.

        Arnoldi's process: v_k+1 is A M v_k, orthogonalized and normalized. Givens rotations keep H
        upper triangular; |g_k+1| is the norm of the residual.
        """
        problem, H, g = self._problem, self._problem.H, self._problem.g
        problem.begin(norm)
        for k in range(most):
            check_time()
            self._before[k].run()
            self._preconditioner.apply()
            if k < KEPT:
                wp.copy(
                    self._images,
                    self._preconditioner.z,
                    dest_offset=k * self._q.size,
                    count=self._q.size,
                )
            self._product(self._preconditioner.z, self._q)
            # Arnoldi: w = W^(1/2) A z, orthogonalized, is column k of H.
            self._after[k].run()
            found, products = self._sums.scalars.numpy(), self._products.numpy()
            H[: k + 1, k] = products[: k + 1] + found[: k + 1]
            H[k + 1, k] = np.sqrt(found[-1])
            problem.rotate(k)
            if not abs(g[k + 1]) > tolerance:  # also if it is NaN
                return k + 1
        return most

    def _weigh(self, q: DeviceArray, *, inverse: bool = False) -> None:
        """Multiply a residual by w^(1/2), or by w^(-1/2) if `inverse`.

        The vectors of the basis are weighted residuals.
        """
        if self._weight is not None:
            WEIGH.bind(rows_of(q), w=self._weight, q=q, inverse=inverse).launch()

    def _combine(
        self,
        factors: DeviceArray,
        x: DeviceArray,
        count: int,
        *,
        sign: float = 1.0,
        other_basis: DeviceArray | None = None,
    ) -> None:
        """Compute x += sign times the sum of factors_j v_j.

        Over the first `count` vectors; the last of the sums becomes x'x.
        """
        basis = self._basis if other_basis is None else other_basis
        self._sums.of(
            COMBINE,
            slot=self._restart + 1,
            basis=basis,
            size=x.size,
            factors=factors,
            x=x,
            count=count,
            sign=sign,
        )

    def _store(self, place: int) -> None:
        """Store `_q`, normalized, as a vector."""
        STORE.bind(
            rows_of(self._q),
            basis=self._basis,
            size=self._q.size,
            place=place,
            sums=self._sums.scalars,
            x=self._q,
            last=self._restart + 1,
        ).launch()

    def _correct(self, columns: int) -> None:
        """Compute x += M V y with H y = g.

        Columns of H that are singular to rounding are omitted. For few columns the stored images M
        v_j are used.
        """
        self._factors.assign(self._problem.solve(columns))
        self._ends[columns].run()
        if columns > KEPT:  # x += M (V y), with one more application of M
            self._preconditioner.apply()
            self._increase.launch()
