"""The principal system of a sparse matrix: conjugate gradients or GMRES, preconditioned by algebraic multigrid or incomplete factors."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, Protocol

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import warp as wp

from warp_lcp.krylov.conjugate_gradient import ConjugateGradient, Preconditioner
from warp_lcp.krylov.gmres import GMRES
from warp_lcp.krylov.system import KrylovSystem
from warp_lcp.multigrid.aggregates import suits_multigrid
from warp_lcp.multigrid.algebraic import AlgebraicHierarchy
from warp_lcp.multigrid.cycle_settings import AlgebraicSettings
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.rows.fields import zeros
from warp_lcp.rows.program import Launch

# symmetric matrices far from M-matrices: on plates of 60^2 and 120^2 0.55 times the iterations of the usual settings, .8 on elastic blocks
FAR_FROM_M = partial(AlgebraicSettings, strength=0.08, interval=(0.05, 1.0))
DROP, FILL = 1e-4, 10.0  # share of a column below which entries of the factors go, and the most of them in units of A's
NUDGE, GOLDEN = 1e-14, (math.sqrt(5) - 1) / 2  # share of a row's largest entry; its multiples modulo 1 are all different
DIRECT = 2000  # unknowns up to which factors are complete: that costs less than the iterations it saves


class SparsePreconditioner(Preconditioner, Protocol):
    """An approximate inverse of M = P A P + P D P, and M itself."""

    weight: wp.array[Any]

    def restrict(self, free: wp.array[Any], shift: wp.array[Any] | None = None) -> None:
        """Take a free set and a shift."""

    def product(self, p: wp.array[Any], q: wp.array[Any], *, launch: Launch = wp.launch) -> None:
        """q = M p, on the device."""


class SparseSystem(KrylovSystem):
    """(P A P + P D P) e = r with a sparse A.

    Symmetric matrices whose diagonal is not negative take conjugate gradients with algebraic multigrid, which falls back on sweeps where
    nothing aggregates. Others take GMRES: with algebraic multigrid if most rows are diagonally dominant and nearly all off-diagonal
    entries negative (convection-diffusion), else with incomplete factors that SciPy makes anew and applies, on the host for any device.
    """

    def __init__(self, A: SparseOperator, real: Any, *, shifted: bool = False, settings: AlgebraicSettings | None = None) -> None:
        host = A.matrix()
        self._A, self._version, self._symmetric = A, A.version, A.symmetric
        positive = bool((host.diagonal() >= 0).all())
        self.preconditioner: SparsePreconditioner
        if (A.symmetric and positive) or suits_multigrid(host):
            usual = AlgebraicSettings if suits_multigrid(host) else FAR_FROM_M
            self.preconditioner = AlgebraicHierarchy(A, real, settings or usual())
        else:
            self.preconditioner = IncompleteFactors(A, real)
        M = self.preconditioner
        weight = M.weight if shifted else None
        method = ConjugateGradient if A.symmetric and positive else GMRES
        self.r = M.r
        self._iterate_by(method(M.product, M, weight=weight), weight)

    def refresh(self) -> None:
        """Choose again where an update of A has changed whether it is symmetric; `restrict` takes the entries.

        Raises:
            ValueError: A was symmetric and is not any more: this system's fields serve conjugate gradients.
        """
        if self._version != self._A.version:
            self._version = self._A.version
            if self._symmetric and not self._A.symmetric:
                raise ValueError("A was updated from a symmetric to an unsymmetric matrix: make a new workspace")

    def restrict(self, free: wp.array[Any], shift: wp.array[Any] | None = None) -> None:
        """Take another free set and shift, and compute the preconditioner anew."""
        self.preconditioner.restrict(free, shift)


class IncompleteFactors:
    """L U factors of the free block by SciPy, on the host; incomplete ones of more than `DIRECT` unknowns.

    Args:
        A: the matrix.
        real: type of the corrections.
    """

    def __init__(self, A: SparseOperator, real: Any) -> None:
        self._A = A
        self.r, self.z, self.weight = (zeros(A.unknowns, real, A.device) for _ in range(3))
        self._solve: Any = None
        self._free = np.zeros(0, dtype=np.intp)

    def restrict(self, free: wp.array[Any], shift: wp.array[Any] | None = None) -> None:
        """Factor the free block, its diagonal nudged where a factor might be singular."""
        self._free = np.flatnonzero(free.numpy())
        matrix = self._A.matrix()
        if shift is not None:
            matrix = (matrix + scipy.sparse.diags_array(shift.numpy())).tocsr()
        mask = scipy.sparse.diags_array((free.numpy() != 0).astype(np.float64))
        self._M = (mask @ matrix @ mask).tocsr()
        diagonal = np.abs(self._M.diagonal())
        self.weight.assign(np.where(free.numpy() != 0, 1 / np.where(diagonal > 0, diagonal, 1.0), 0.0))
        self._solve = self._factor(matrix[self._free][:, self._free].tocsc()) if self._free.size else None

    def product(self, p: wp.array[Any], q: wp.array[Any], *, launch: Launch = wp.launch) -> None:
        """q = M p, on the host."""
        q.assign(self._M @ p.numpy())

    def apply(self) -> None:
        """Precondition on the host: z = the factors' inverse times r."""
        z = np.zeros(self._A.unknowns)
        if self._solve is not None:
            z[self._free] = self._solve(self.r.numpy()[self._free].astype(np.float64))
        with np.errstate(over="ignore"):  # the method sees that its iterate is not finite
            self.z.assign(z)

    def _factor(self, block: Any) -> Any:
        """Return what applies the factors' inverse; nothing is done where they cannot be had."""
        try:
            if block.shape[0] <= DIRECT:
                return scipy.sparse.linalg.splu(nudged(block, NUDGE)).solve
            return scipy.sparse.linalg.spilu(nudged(block, NUDGE, small=100 * DROP), drop_tol=DROP, fill_factor=FILL).solve
        except RuntimeError:  # a factor is exactly singular after all
            return np.asarray


def nudged(block: Any, share: float, *, small: float = 0.0) -> Any:
    """Return a block without exactly singular factors: SuperLU, given those, writes to stderr, and may crash the process.

    A strictly diagonally dominant block is regular and stays as it is. Of others the diagonal grows by a share of each row's largest entry,
    another one in each row, so that no two rows become alike.

    Args:
        block: square, in compressed columns.
        share: of a row's largest entry.
        small: the share where the diagonal entry itself is less than that: incomplete factors drop smaller ones.
    """
    magnitude, diagonal = abs(block), block.diagonal()
    off = np.asarray(magnitude.sum(axis=1)).ravel() - np.abs(diagonal)
    if (np.abs(diagonal) > (1 + 1e-12) * off).all():
        return block
    largest = magnitude.max(axis=1).toarray().ravel()
    largest = np.where(largest > 0, largest, 1.0)
    shares = np.where(np.abs(diagonal) <= small * largest, max(share, small), share) * (1 + np.arange(len(off)) * GOLDEN % 1)
    return (block + scipy.sparse.diags_array(np.where(diagonal < 0, -1.0, 1.0) * shares * largest)).tocsc()
