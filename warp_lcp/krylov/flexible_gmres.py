"""GMRES that stores preconditioned vectors and can go on after a look at its result."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import warp as wp

from warp_lcp.deadline import check_time
from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.fields import zeros, zeros_like
from warp_lcp.kernels.launch_graph import LaunchGraph, clear
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import Communicator, RowReduction, rows_of
from warp_lcp.krylov.conjugate_gradient import KrylovPreconditioner, LinearMap
from warp_lcp.krylov.hessenberg import HessenbergLeastSquares

KERNELS = KernelFile(Path(__file__).parent / "headers/krylov.h")
DOTS = KERNELS["gmres.dots"]
COLUMN = KERNELS["gmres.column"]
COMBINE = KERNELS["gmres.combine"]
STORE = KERNELS["gmres.store"]
WEIGHED = KERNELS["gmres.weighed"]
LOAD = KERNELS["gmres.load"]
KEEP = KERNELS["gmres.keep"]
# Vectors that a GPU adds before the first reading of a space, and at most before another one.
FIRST_VECTORS = 2
MOST_VECTORS = 4


class FlexibleGMRES:
    """Right-preconditioned GMRES in float32 for loose tolerances (Saad 1993).

    The right-hand side is the preconditioner's field `r`, which is overwritten. All preconditioned
    vectors are stored, so that a solution needs no application of the preconditioner. The host
    reads the columns of H; everything between is one recorded run, if possible. A GPU adds several
    vectors before a reading, by the rate of convergence so far. Vectors beyond the
    tolerance are dropped, so that the result does not depend on this.
    Vectors are made orthogonal once: at residuals of 1e-4 of the start, rounding errors of 1e-7 per
    vector do not count.

    The space can grow after its solution has been looked at, see `extend`.

    Args:
        product: A.
        preconditioner: M, an approximation of A's inverse.
        restart: the most vectors.
        weight: residuals are measured as ||weight^(1/2) r||, field like r >= 0. It is 0 in entries
            that do not count, such as those that other processes count.
        at_once: whether A or M have tasks of the host, and are launched in each run.
        comm: communicator of the other parts of the fields; None if serial.

    Attributes:
        x: the change of the solution by the last `extend`.
        columns: number of vectors.
        ahead: whether several vectors are added before a reading.
    """

    def __init__(
        self,
        product: LinearMap,
        preconditioner: KrylovPreconditioner,
        *,
        restart: int,
        weight: DeviceArray,
        at_once: bool = False,
        comm: Communicator | None = None,
    ) -> None:
        r, size = preconditioner.r, preconditioner.r.size
        self._product, self._preconditioner, self._restart = product, preconditioner, restart
        self.x, self._q, self._weight = zeros_like(r), zeros_like(r), weight
        self._basis = zeros((restart + 1) * size, r.dtype, r.device)  # fields, one after another
        self._images = zeros(restart * size, r.dtype, r.device)  # the same, preconditioned
        # Products with them, and a square in the last slot.
        self._sums = RowReduction(rows_of(r), restart + 1, slots=restart + 2, comm=comm)
        # Columns of H, one row each, with the square of the norm at the end.
        self._read = DeviceScalar(r.device, restart * (restart + 2))
        self._factors = wp.zeros(restart + 1, dtype=wp.float64, device=r.device)
        self._problem = HessenbergLeastSquares(restart)
        self._place, self._next = Scalar(0), Scalar(1)  # k, and k + 1
        self._y, self.columns, self._norm = np.zeros(restart + 1), 0, 0.0
        self.ahead = r.device.is_cuda
        at_once = at_once or r.device.is_cuda
        self._first = LaunchGraph(r.device, self._launch_first, at_once=r.device.is_cuda)
        self._before = LaunchGraph(r.device, self._launch_before, at_once=at_once)
        self._after = LaunchGraph(r.device, self._launch_after, at_once=at_once)
        self._end = LaunchGraph(r.device, self._launch_end, at_once=r.device.is_cuda)

    @property
    def full(self) -> bool:
        """Whether there is no room for another vector."""
        return self.columns == self._restart

    def begin(self) -> float:
        """Begin a space with the residual r, whose image z is known; return the norm."""
        self.launch_first()
        return self.read_first()

    def launch_first(self) -> None:
        """Launch the first vector of a space; z is scaled. `read_first` returns the norm."""
        self.columns = 0
        self._y[:] = 0.0
        self._first.run()
        self._sums.reading.changed()

    def read_first(self) -> float:
        """Return the norm of the residual after `launch_first`."""
        self._norm = float(np.sqrt(self._sums.reading.numpy()[self._restart + 1]))
        self._problem.begin(self._norm)
        return self._norm

    def extend(self, tolerance: float) -> tuple[int, float]:
        """Add vectors until the estimate of the residual is at most the tolerance.

        `x` is then the change of the solution.

        For vector k, with W = diag(weight) and the image z_k = M W^(-1/2) v_k, Arnoldi's step is

            w = W^(1/2) A z_k,   h_jk = v_j . w for j <= k,   h_(k+1)k = |w - sum_j h_jk v_j|.

        Givens rotations make H triangular; |g_(k+1)| estimates the residual. With H y = g, x is the
        sum of (y_j - y_j of the last call) z_j. The image z_0 is known at the beginning of a space.

        Returns:
            The number of vectors added, and the estimate.
        """
        problem, first, done = self._problem, self.columns, False
        while not done and not self.full:
            check_time()
            new = range(self.columns, self.columns + self._vectors_ahead(tolerance))
            for k in new:
                self._place.value, self._next.value = k, k + 1
                if k:
                    self._before.run()
                self._after.run()
            self._read.changed()
            read = self._read.numpy().reshape(self._restart, -1)
            for k in new:
                problem.H[: k + 1, k] = read[k, : k + 1]
                problem.H[k + 1, k] = np.sqrt(read[k, -1])
                problem.rotate(k)
                self.columns = k + 1
                done = not abs(problem.g[k + 1]) > tolerance  # also if it is NaN
                if done:
                    break
        y = problem.solve(self.columns)
        self._factors.assign(y - self._y)
        self._y = y
        self._next.value = self.columns
        self._end.run()
        left = float(abs(problem.g[self.columns]))
        return self.columns - first, left if math.isfinite(left) else math.inf

    def _vectors_ahead(self, tolerance: float) -> int:
        """Return how many vectors are added before the next reading.

        Half of those that a residual needs which goes on falling at its mean rate in this space.
        """
        count, left = self.columns, float(abs(self._problem.g[self.columns]))
        if not self.ahead:
            return 1
        vectors = 1 if count else FIRST_VECTORS
        if count and 0.0 < tolerance < left < self._norm:
            vectors = int(0.5 * count * math.log(left / tolerance) / math.log(self._norm / left))
        return min(max(vectors, 1), MOST_VECTORS, self._restart - count)

    def _launch_first(self) -> None:
        """Store the normalized residual as the first vector; scale its image."""
        r = self._preconditioner.r
        self._sums.launch(WEIGHED, slot=self._restart + 1, r=r, w=self._weight, q=self._q)
        self._store(0, self._basis, self._q)
        self._store(0, self._preconditioner.z, self._preconditioner.z)

    def _launch_before(self) -> None:
        """Write W^(-1/2) v_k to the preconditioner, and apply it."""
        r = self._preconditioner.r
        LOAD.bind(
            rows_of(r), basis=self._basis, size=r.size, place=self._place, w=self._weight, r=r
        ).launch()
        self._preconditioner.apply()

    def _launch_after(self) -> None:
        """Store the image z; orthogonalize w = W^(1/2) A z against the vectors, and store it."""
        q, z = self._q, self._preconditioner.z
        self._product(z, q)
        KEEP.bind(
            rows_of(q), basis=self._images, size=q.size, place=self._place, w=self._weight, z=z, q=q
        ).launch()
        DOTS.bind(
            rows_of(q),
            basis=self._basis,
            size=q.size,
            count=self._next,
            x=q,
            out=self._sums.partials,
        ).launch()
        self._sums.add_up(0, columns=self._restart + 1)
        self._sums.launch(
            COMBINE,
            slot=self._restart + 1,
            basis=self._basis,
            size=q.size,
            factors=self._sums.scalars,
            x=q,
            count=self._next,
            sign=-1.0,
        )
        self._store(self._next, self._basis, q)
        sums = self._sums.scalars
        COLUMN.bind(
            rows_of(sums), columns=self._read.array, size=sums.size, place=self._place, sums=sums
        ).launch()

    def _launch_end(self) -> None:
        """Write the sum of factors_j M v_j to x."""
        clear(self.x)
        self._sums.launch(
            COMBINE,
            slot=self._restart + 1,
            basis=self._images,
            size=self.x.size,
            factors=self._factors,
            x=self.x,
            count=self._next,
            sign=1.0,
        )

    def _store(self, place: int | Scalar, basis: DeviceArray, x: DeviceArray) -> None:
        """Store a field, divided by the norm in the last slot, in a basis."""
        STORE.bind(
            rows_of(x),
            basis=basis,
            size=x.size,
            place=place,
            sums=self._sums.scalars,
            x=x,
            last=self._restart + 1,
        ).launch()
