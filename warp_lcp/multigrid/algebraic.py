"""Algebraic multigrid for the principal systems of a sparse matrix.

PyAMG forms the aggregates; cycles and coarsening run on the device. The aggregation is computed
once, on A. When the free set or the shift changes, only numbers are recomputed: the Galerkin
products P' M P go into known patterns, by lists of positions made once.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TypeAlias

import numpy as np
import scipy.sparse
import warp as wp
from pyamg.aggregation.smooth import jacobi_prolongation_smoother
from pyamg.aggregation.tentative import fit_candidates
from pyamg.strength import symmetric_strength_of_connection

from warp_lcp.kernels import BoundKernel, KernelFile, Rows
from warp_lcp.kernels.fields import device_copy, zeros
from warp_lcp.kernels.launch_graph import CommandBuffer, Launch, launch_now
from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.multigrid.aggregates import aggregated, symmetric_part
from warp_lcp.multigrid.algebraic_kernels import (
    densify_kernel,
    factor_kernel,
    invert_kernel,
    places_kernel,
    solve_kernel,
)
from warp_lcp.multigrid.coarsest_kernels import PINNED
from warp_lcp.multigrid.cycle import Cycle, CycleStage, Launches, recorded
from warp_lcp.multigrid.cycle_settings import AlgebraicSettings
from warp_lcp.operators.compressed_rows import RowEntries
from warp_lcp.operators.sparse import GATHER, PRODUCT, SparseOperator

KERNELS = KernelFile(Path(__file__).parent / "headers/algebraic.h")
FILL = KERNELS["algebraic.fill"]
SCALE_ROWS = KERNELS["algebraic.scale_rows"]
MULTIPLY = KERNELS["algebraic.multiply"]
INVERSE = KERNELS["algebraic.inverse"]
SMOOTH = KERNELS["algebraic.smooth"]
REMAINDER = KERNELS["algebraic.remainder"]
WIDEST = np.iinfo(np.uint16).max  # most entries of a row whose positions are stored
Matrix: TypeAlias = scipy.sparse.csr_array


class DeviceMatrix:
    """A sparse matrix of any shape in compressed rows on the device."""

    def __init__(self, host: Matrix, real: DataType, device: wp.Device) -> None:
        self.shape, self.device = host.shape, device
        self.indptr, self.indices = (
            device_copy(v, wp.int32, device) for v in (host.indptr, host.indices)
        )
        self.values = device_copy(host.data, real, device)
        self.rows, self.entries = (
            Rows.flat(self.shape[0], device),
            RowEntries(self.indptr, self.indices, self.values),
        )

    def product_kernel(self, x: DeviceArray, y: DeviceArray, *, add: bool = False) -> BoundKernel:
        """Return the kernel y = A x, or y + A x."""
        return PRODUCT.bind(self.rows, self.entries, x=x, plus=y if add else None, y=y)


def product_pass(
    left: DeviceMatrix, right: DeviceMatrix, out: DeviceMatrix, hosts: tuple[Matrix, Matrix, Matrix]
) -> BoundKernel:
    """Return the launch that computes A B into a known pattern.

    Args:
        left: A.
        right: B.
        out: receives the product; its pattern holds that of A B.
        hosts: the patterns of A, B and A B.
    """
    A, B, C = hosts
    ends = np.concatenate([[0], np.cumsum(np.diff(B.indptr).astype(np.int64)[A.indices])])
    place = wp.zeros(int(ends[-1]), dtype=wp.uint16, device="cpu")
    patterns = [
        wp.array(v, dtype=wp.int32, device="cpu") for m in hosts for v in (m.indptr, m.indices)
    ]
    at = wp.zeros(C.shape[1], dtype=wp.int32, device="cpu")
    wp.launch(places_kernel, 1, [*patterns, at, place, A.shape[0]], device="cpu")
    begins = wp.array(ends[A.indptr[:-1]], dtype=wp.int64, device=left.device)
    return MULTIPLY.bind(
        left.rows,
        left.entries,
        right=right.indptr,
        b=right.values,
        starts=out.indptr,
        place=place.to(left.device),
        result=out.values,
        begins=begins,
    )


class AlgebraicLevel:
    """One level, see `CycleLevel`: matrix, smoother's scale and transfer.

    The transfer leads to the next coarser level.

    Args:
        host: the matrix.
        real: type of the fields.
        device: of the fields.
        weights: relaxation factors of a pair of sweeps.
        visits: cycles on this level in each of the next finer one.

    Attributes:
        x, b, t: iterate, right-hand side and the value between two sweeps.
    """

    def __init__(
        self,
        host: Matrix,
        real: DataType,
        device: wp.Device,
        weights: tuple[float, float],
        visits: int,
    ) -> None:
        self.size, self.device, self.weights, self.visits = host.shape[0], device, weights, visits
        self._legs: dict[tuple[str, bool], list[CycleStage]] = {}
        self.A = DeviceMatrix(host, real, device)
        self.x, self.b, self.t, self.inverse = (zeros(self.size, real, device) for _ in range(4))
        self.P: DeviceMatrix | None = None

    def connect(self, hosts: tuple[Matrix, ...], coarse: AlgebraicLevel, real: DataType) -> None:
        """Set the prolongation from a coarser level.

        `hosts` are A, P, R = P', and the patterns of A P and of the coarse matrix.
        """
        device, (host, P, R, AP, coarse_host) = self.device, hosts
        turn = (
            scipy.sparse.csr_array((np.arange(P.nnz), P.indices, P.indptr), shape=P.shape)
            .T.tocsr()
            .data
        )
        self.P, self.R = DeviceMatrix(P, real, device), DeviceMatrix(R, real, device)
        self.plain = wp.clone(self.P.values)  # P's entries before its rows are scaled
        self.turn = wp.array(turn, dtype=wp.int32, device=device)
        self.AP = DeviceMatrix(AP, real, device)
        self.products = (
            product_pass(self.A, self.P, self.AP, (host, P, AP)),
            product_pass(self.R, self.AP, coarse.A, (R, AP, coarse_host)),
        )

    def sweep(
        self, y: DeviceArray, x: DeviceArray, omega: float, *, from_zero: bool = False
    ) -> BoundKernel:
        """Return the sweep y = x + omega (b - A x), scaled by the rows' l1 norms.

        x is taken as 0 if from_zero.
        """
        A = self.A
        return SMOOTH.bind(
            A.rows,
            A.entries,
            inverse=self.inverse,
            x=x,
            b=self.b,
            y=y,
            omega=omega,
            from_zero=from_zero,
        )

    def pair(self, weights: tuple[float, float], *, from_zero: bool = False) -> list[CycleStage]:
        """Return two sweeps, x to t and back."""
        return [
            self.sweep(self.t, self.x, weights[0], from_zero=from_zero),
            self.sweep(self.x, self.t, weights[1]),
        ]

    def descend(
        self, coarse: AlgebraicLevel, *, projected: bool, from_zero: bool
    ) -> list[CycleStage]:
        """Return steps 1 and 2 of a cycle.

        A pair of Chebyshev-Jacobi sweeps, and b_c = P'(b - A x).
        """
        assert not projected, "smoothed aggregates know no bounds"
        key = "down", from_zero
        if key not in self._legs:
            residual = REMAINDER.bind(self.A.rows, self.A.entries, x=self.x, b=self.b, y=self.t)
            self._legs[key] = [
                *self.pair(self.weights, from_zero=from_zero),
                residual,
                self.R.product_kernel(self.t, coarse.b),
            ]
        return self._legs[key]

    def coarsen_bounds(self, coarse: AlgebraicLevel) -> tuple[()]:
        """Return no stages: there are no bounds."""
        return ()

    def ascend(self, coarse: AlgebraicLevel, *, projected: bool) -> list[CycleStage]:
        """Return steps 5 and 6 of a cycle: x + P x_c, and the pair in reverse order."""
        key = "up", projected
        if key not in self._legs:
            assert self.P is not None, "not the coarsest level"
            self._legs[key] = [
                self.P.product_kernel(coarse.x, self.x, add=True),
                *self.pair(self.weights[::-1]),
            ]
        return self._legs[key]


class AlgebraicHierarchy:
    """Multigrid for M e = r, M = P A P + P D P, with a sparse A.

    Rows of the finest prolongation are scaled by a_ii / (a_ii + D_i), the value from the row's own
    equation, and are 0 off the free set: a coarse correction then hardly changes stiff unknowns,
    whatever D's size. On an unsymmetric A the aggregates are those of its symmetric part, smoothed
    where that part dominates, and the coarse matrices are P' M P with M as it is.

    Args:
        A: the matrix.
        real: type of the corrections.
        settings: of the hierarchy and its cycles.

    Attributes:
        r: the right-hand side, field of A's shape; z: the result of a cycle.
        weight: one over the diagonal of M, field like r; 1 where that is 0, 0 off the free set.
    """

    def __init__(
        self, A: SparseOperator, real: DataType, settings: AlgebraicSettings | None = None
    ) -> None:
        self.settings, self.real, self.source, self.device = (
            settings or AlgebraicSettings(),
            real,
            A,
            A.device,
        )
        host = A.matrix()
        pattern = _with_diagonal(host if A.symmetric else _union(host))
        self._order = self._find_entries(host, pattern)
        self.levels = _coarsen(A, host, pattern, real, self.settings, self._coarsest_limit)
        n, last = A.unknowns, self.levels[-1].size
        self.scale = zeros(n, real, self.device)
        self.weight = zeros(n, real, self.device)
        self.inverts = last <= self._coarsest_limit
        shape = (last, last) if self.inverts else (0, 0)
        self._matrix, self._inverse = (
            wp.zeros(shape, dtype=wp.float64, device=self.device) for _ in range(2)
        )
        self.r, self.z = self.levels[0].b, self.levels[0].x

    def restrict(self, free: DeviceArray, shift: DeviceArray | None = None) -> None:
        """Set the free set and the shift D >= 0, and coarsen.

        The set is a uint8 field, the shift a float64 field; None: 0.
        """
        finest, A = self.levels[0], self.source
        FILL.bind(
            finest.A.rows,
            finest.A.entries,
            a=A.values,
            order=self._order,
            m=finest.A.values,
            d=A.diagonal(),
            free=free,
            shift=shift,
            inverse=finest.inverse,
            scale=self.scale,
            weight=self.weight,
        ).launch()
        self._coarsen_program.run()

    def product(self, p: DeviceArray, q: DeviceArray, *, launch: Launch = launch_now) -> None:
        """Compute q = M p on the finest level."""
        self.levels[0].A.product_kernel(p, q).launch(launch)

    @cached_property
    def program(self) -> CommandBuffer:
        """Program of one cycle: z approximates M^-1 r.

        The approximate inverse is symmetric positive (semi-)definite if M is.
        """
        return recorded(self.device, Cycle(self.levels, self._solve).stages())

    def apply(self) -> None:
        """Run one cycle: `program`."""
        self.program.run()

    @cached_property
    def _coarsen_program(self) -> CommandBuffer:
        program = CommandBuffer(self.device)
        launch = program.launch
        for depth, (fine, coarse) in enumerate(zip(self.levels, self.levels[1:], strict=False)):
            P = fine.P
            assert P is not None
            # The finest P has the rows s_i p_i with s_i = a_ii / (a_ii + D_i), 0 off the free set;
            # R = P' has the same entries in another order.
            if depth == 0:
                SCALE_ROWS.bind(
                    P.rows, ptr=P.indptr, a=fine.plain, scale=self.scale, scaled=P.values
                ).launch(launch)
                turned = Rows.flat(fine.turn.size, self.device)
                GATHER.bind(turned, source=P.values, order=fine.turn, taken=fine.R.values).launch(
                    launch
                )
            # Galerkin product: first A P, then P' (A P).
            for product in fine.products:
                product.launch(launch)
            # Scale of the coarse smoother.
            INVERSE.bind(
                coarse.A.rows, ptr=coarse.A.indptr, a=coarse.A.values, inverse=coarse.inverse
            ).launch(launch)
        # The coarsest matrix is expanded, factored and inverted.
        if self.inverts:
            last = self.levels[-1]
            launch(
                densify_kernel,
                last.size,
                [last.A.indptr, last.A.indices, last.A.values, self._matrix],
                device=self.device,
            )
            launch(
                factor_kernel, 1, [self._matrix, wp.float64(PINNED[self.real])], device=self.device
            )
            launch(invert_kernel, last.size, [self._matrix, self._inverse], device=self.device)
        return program

    def _solve(self, visits: int, *, projected: bool, from_zero: bool) -> list[CycleStage]:
        """Return the stages of a `CoarsestSolver`.

        They multiply by the inverse, or sweep where the level is too large for that.
        """
        last, weights = self.levels[-1], self.settings.weights
        if not self.inverts:  # forward and backward, so that the solver is symmetric
            pairs = range(self.settings.last_sweeps)
            return [
                s
                for i in pairs
                for s in last.pair(
                    weights[::-1] if i % 2 else weights, from_zero=from_zero and i == 0
                )
            ]
        return [self._multiply_by_inverse]

    @cached_property
    def _multiply_by_inverse(self) -> CycleStage:
        last = self.levels[-1]
        return Launches.of_kernel(
            solve_kernel, last.size, [self._inverse, last.b, last.x], self.device
        )

    @property
    def _coarsest_limit(self) -> int:
        return self.settings.coarsest_cuda if self.device.is_cuda else self.settings.coarsest_cpu

    def _find_entries(self, host: Matrix, pattern: Matrix) -> DeviceArray:
        """Return the index in A of each entry of the pattern, -1 if A lacks it.

        Empty if both patterns are equal.
        """
        if _alike(host, pattern):
            return wp.empty(0, dtype=wp.int32, device=self.device)
        order = np.full(pattern.nnz, -1, dtype=np.int32)
        order[_places(host, pattern)] = np.arange(host.nnz, dtype=np.int32)
        return wp.array(order, dtype=wp.int32, device=self.device)


def _coarsen(
    source: SparseOperator,
    A: Matrix,
    pattern: Matrix,
    real: DataType,
    settings: AlgebraicSettings,
    most: int,
) -> list[AlgebraicLevel]:
    """Return the levels of a matrix.

    `A` is on the host; its entries are stored in `pattern`. Nodes are aggregated where there are
    blocks.
    """
    device, B, block = source.device, source.near_null_space, source.block
    values = np.zeros(pattern.nnz)
    values[_places(A, pattern)] = A.data
    current = scipy.sparse.csr_array((values, pattern.indices, pattern.indptr), shape=pattern.shape)
    candidates = np.ones((A.shape[0], 1)) if B is None else B
    cycles = settings.weights, settings.gamma if source.symmetric else settings.gamma_unsymmetric
    levels = [AlgebraicLevel(current, real, device, *cycles)]
    while current.shape[0] > most:
        fine = levels[-1]
        entries = symmetric_part(current)
        entries = entries.tobsr((block, block)) if block > 1 else entries
        C = symmetric_strength_of_connection(entries, theta=settings.strength)
        aggregates = aggregated(C, settings.stall)
        if aggregates is None:
            break
        T, candidates = fit_candidates(aggregates, candidates)
        block = candidates.shape[1]
        # Local weights are sums of magnitudes. Spectral weights start from random vectors, so runs
        # would differ.
        P = T
        if _skewness(current, entries) <= settings.skew:
            P = jacobi_prolongation_smoother(
                entries, T, C, candidates, omega=4 / 3, weighting="local"
            )
        P = scipy.sparse.csr_array(P)
        P.sort_indices()
        R = P.T.tocsr()
        AP = _pattern_product(current, P)
        coarse = _pattern_product(R, AP)
        # Coarsening fills wide rows.
        if coarse.nnz > current.nnz or np.diff(AP.indptr).max() > WIDEST:
            break
        levels.append(AlgebraicLevel(coarse, real, device, *cycles))
        fine.connect((current, P, R, AP, coarse), levels[-1], real)
        for product in fine.products:
            product.launch()
        values = levels[-1].A.values.numpy().astype(np.float64)
        current = scipy.sparse.csr_array(
            (values, coarse.indices, coarse.indptr), shape=coarse.shape
        )
    return levels


def _pattern_product(A: Matrix, B: Matrix) -> Matrix:
    """Return the pattern of A B, sorted.

    The product is that of positive numbers: SciPy drops entries that cancel, and these do not.
    """
    product = (_ones(A) @ _ones(B)).tocsr()
    product.sort_indices()
    return product


def _skewness(A: Matrix, symmetric: Matrix) -> float:
    """Return the sum of |A - A'| / 2 over that of the off-diagonal |A + A'| / 2."""
    off = float(np.abs(symmetric.data).sum() - np.abs(symmetric.diagonal()).sum())
    return 0.5 * float(np.abs((A - A.T).data).sum()) / off if off > 0 else 0.0


def _alike(A: Matrix, B: Matrix) -> bool:
    """Return whether two matrices have the same pattern."""
    return np.array_equal(A.indptr, B.indptr) and np.array_equal(A.indices, B.indices)


def _places(A: Matrix, pattern: Matrix) -> np.ndarray:
    """Return the position of each entry of A in a sorted pattern that has them all.

    SciPy's sum of both would drop zeros.
    """
    if _alike(A, pattern):
        return np.arange(A.nnz)
    n = np.int64(A.shape[0])
    keys = [np.repeat(np.arange(n), np.diff(m.indptr)) * n + m.indices for m in (A, pattern)]
    return np.asarray(np.searchsorted(keys[1], keys[0]))


def _ones(matrix: Matrix) -> Matrix:
    return scipy.sparse.csr_array(
        (np.ones(matrix.nnz, dtype=np.float32), matrix.indices, matrix.indptr), shape=matrix.shape
    )


def _union(matrix: Matrix) -> Matrix:
    """Return the pattern of A + A'."""
    return (_ones(matrix) + _ones(matrix).T).tocsr()


def _with_diagonal(matrix: Matrix) -> Matrix:
    """Return the pattern of a matrix with a full diagonal."""
    pattern = _ones(matrix)
    pattern = (pattern + scipy.sparse.eye_array(matrix.shape[0], dtype=np.float32)).tocsr()
    pattern.sort_indices()
    return pattern
