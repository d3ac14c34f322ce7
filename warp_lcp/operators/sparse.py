"""A sparse matrix as an operator: compressed rows on the device."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import no_type_check

import numpy as np
import scipy.sparse
import warp as wp

from warp_lcp.kernels import KernelFile, Rows
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.fields import (
    Layout,
    check_kept,
    check_storable,
    checked_device,
    device_copy,
    real_array,
    relative_rounding,
    zeros,
    zeros_like,
)
from warp_lcp.kernels.launch_graph import Launch, launch_now
from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.kernels.vectors import RowReduction
from warp_lcp.operators.compressed_rows import CompressedRows, RowEntries
from warp_lcp.operators.dense import is_rounding
from warp_lcp.operators.reordering import Renumbering, renumbering
from warp_lcp.problem.data_types import Matrix, SparseMatrix, Values
from warp_lcp.problem.lcp import as_operator
from warp_lcp.problem.operator_protocol import Derivatives
from warp_lcp.problem.pickling import HostPickling, Reduced, rebuilt_from
from warp_lcp.problem.residual_scaling import scale_of_matrix

INDICES = wp.array(dtype=wp.int32)


@no_type_check
@forward_kernel(module="warp_lcp.sparse.color")
def color_kernel(ptr: INDICES, col: INDICES, taken: INDICES, color: INDICES, n: int):
    """Color rows greedily in row order, by one thread.

    Each row gets the least color that no neighbor has. `taken[c]` is the last row that has seen
    color c, plus one.
    """
    for i in range(n):
        for k in range(ptr[i], ptr[i + 1]):
            j = col[k]
            if j < i:
                taken[color[j]] = i + 1
        c = int(0)
        while taken[c] == i + 1:
            c += 1
        color[i] = c


KERNELS = KernelFile(Path(__file__).parent / "headers/matrices.h")
PRODUCT = KERNELS["sparse.product"]
RELAX = KERNELS["sparse.relax"]
SURVEY = KERNELS["sparse.survey"]
# Sizes of nodes' blocks, and the largest number of entries of the blocks in units of A's.
BLOCKS, FILL = (6, 5, 4, 3, 2), 1.2
GATHER = KERNELS["sparse.gather"]


@dataclass(frozen=True, slots=True)
class MatrixSweep:
    """A sweep over rows of a sparse matrix, each unknown projected onto its bounds.

    Attributes:
        ptr: first entry of each row and the end, int32, shape (n + 1,).
        col: columns of the entries, int32.
        a: values of the entries.
        d: diagonal, shape (n,).
        b: right-hand side.
        lower: bounds.
        upper: bounds.
        x: iterate, moved in place.
        omega: relaxation factor.
        forward: whether rows are taken in ascending order.
    """

    ptr: DeviceArray
    col: DeviceArray
    a: DeviceArray
    d: DeviceArray
    b: DeviceArray
    lower: DeviceArray
    upper: DeviceArray
    x: DeviceArray
    omega: float
    forward: bool


class SparseOperator(HostPickling):
    """Sparse square matrix as an operator.

    Duplicate entries are summed and columns sorted, as `matrix.tocsr().sum_duplicates()` does;
    explicit zeros are kept, so that `update` may replace them.

    Args:
        matrix: A, any scipy.sparse matrix or array of shape (n, n), real and finite. Rows may be
            empty.
        device: Warp device; the default device if None.
        dtype: storage of A's entries, wp.float64 or wp.float32.
        near_null_space: fields that A nearly maps to 0, shape (n, k), k <= 12: the rigid body
            motions of elasticity, three in 2-D, six in 3-D, which coarse levels then represent too.
            None: the constants. Where unknowns are ordered node by node (all of a node's
            displacements in turn) whole nodes are aggregated.

    Attributes:
        block: number of unknowns of a node, 1 to 6: A consists of full blocks of as many rows and
            columns; determined if there is a near_null_space.
        indptr: where each row begins, shape (n + 1,), wp.int32.
        indices: column of each entry, shape (nnz,), wp.int32, ascending in each row.
        values: the entries, shape (nnz,), `dtype`.
        symmetric: whether A equals its transpose, to rounding.
        row_sizes: the largest magnitude of each row, shape (n,), wp.float64; None where no row is
            empty.
        version: number of times that the entries have been set.

    Raises:
        ValueError: the matrix is not square, empty, complex, not finite, or has more than 2^31 - 1
            entries; or near_null_space has another shape, vanishes or is not finite.

    Example:
        >>> import scipy.sparse, warp as wp, warp_lcp as wl
        >>> T = scipy.sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(3, 3))
        >>> A = wl.SparseOperator(T, device="cpu")
        >>> x = wp.array([1.0, 2.0, 4.0], dtype=wp.float64, device="cpu")
        >>> print(A.apply(x).numpy(), A.symmetric)
        [ 0. -1.  6.] True
    """

    shape: tuple[int, ...]

    def __init__(
        self,
        matrix: Matrix,
        *,
        device: wp.DeviceLike = None,
        dtype: DataType = wp.float64,
        near_null_space: Values | None = None,
    ) -> None:
        if dtype not in (wp.float32, wp.float64):
            raise ValueError(f"dtype = {dtype}: must be wp.float32 or wp.float64")
        host = _checked(matrix)
        check_storable(host.data, dtype, "matrix")
        self.near_null_space = (
            None if near_null_space is None else _near_null_space(near_null_space, host.shape[0])
        )
        self.device, self.dtype, self.shape = checked_device(device), dtype, (host.shape[0],)
        self.layout = Layout(self.shape, self.device)
        parts = (host.indptr, wp.int32), (host.indices, wp.int32), (host.data, dtype)
        self.indptr, self.indices, self.values = (
            wp.array(v, dtype=t, device=self.device, copy=self.device.is_cuda) for v, t in parts
        )
        self._indptr, self._indices = host.indptr, host.indices
        self._diagonal = zeros(self.unknowns, dtype, self.device)
        self._transpose_values: DeviceArray | None = None
        self.version = 0
        self._scale: np.ndarray | None = None
        self._turned: SparseOperator | None = None
        self._turned_from = 0
        self._survey_entries(host)

    def __reduce__(self) -> Reduced:
        """Pickle the current matrix."""
        return rebuilt_from(
            SparseOperator,
            self.matrix(),
            device=self.device,
            dtype=self.dtype,
            near_null_space=self.near_null_space,
        )

    @property
    def unknowns(self) -> int:
        """Number of rows, which are all unknowns."""
        return self.shape[0]

    @property
    def nnz(self) -> int:
        """Number of stored entries, zeros among them."""
        return int(self.values.size)

    @cached_property
    def bandwidth(self) -> int:
        """Largest distance of an entry from the diagonal."""
        first, last = self._indptr[:-1], self._indptr[1:] - 1
        rows = np.flatnonzero(last >= first)  # columns ascend in each row
        ends = np.stack([self._indices[first[rows]], self._indices[last[rows]]])
        return int(np.abs(ends - rows).max(initial=0))

    def matrix(self) -> scipy.sparse.csr_array:
        """Return the current A on the host, in float64."""
        return self._matrix_of(self.values.numpy())

    def update(self, values: Values) -> None:
        """Replace the entries; the sparsity pattern is fixed.

        Args:
            values: entries in the order of `indices`, shape (nnz,), numpy or wp.array; or a
                scipy.sparse matrix with the same pattern.

        Raises:
            ValueError: shape or pattern differ, or a value is not finite.
        """
        if scipy.sparse.issparse(values):
            host = _checked(values)
            if not (
                np.array_equal(host.indptr, self._indptr)
                and np.array_equal(host.indices, self._indices)
            ):
                raise ValueError(
                    "values has a different sparsity pattern: make a new SparseOperator"
                )
        else:
            array = real_array(values, "values")
            if array.shape != (self.nnz,):
                raise ValueError(f"values has shape {array.shape}: expected {(self.nnz,)}")
            host = self._matrix_of(array)
        check_storable(host.data, self.dtype, "values")
        self.values.assign(host.data.astype(wp.dtype_to_numpy(self.dtype)))
        self._survey_entries(host)

    def apply(self, x: DeviceArray, out: DeviceArray | None = None) -> DeviceArray:
        """Return A x, x of shape (n,) and type wp.float32 or wp.float64."""
        out = self._result(x, out)
        self.product(x, out)
        return out

    def apply_transpose(self, x: DeviceArray, out: DeviceArray | None = None) -> DeviceArray:
        """Return A' x.

        The first call stores the transpose, unless A is symmetric.
        """
        if self.symmetric:
            return self.apply(x, out)
        out = self._result(x, out)
        indptr, indices, order = self._transpose
        if self._transpose_values is None:
            self._transpose_values = zeros_like(self.values)
            self._gather(order)
        PRODUCT.bind(
            Rows.flat(x.size, self.device),
            ptr=indptr,
            col=indices,
            a=self._transpose_values,
            x=x,
            plus=None,
            y=out,
        ).launch()
        return out

    def apply_plus(self, x: DeviceArray, b: DeviceArray, out: DeviceArray) -> None:
        """Evaluate out = A x + b in one pass; fields of one type."""
        self.product(x, out, plus=b)

    def product(
        self,
        x: DeviceArray,
        out: DeviceArray,
        plus: DeviceArray | None = None,
        *,
        launch: Launch = launch_now,
    ) -> None:
        """Evaluate out = A x, or A x + plus; launches kernels only."""
        PRODUCT.bind(Rows.flat(x.size, self.device), self._rows, x=x, plus=plus, y=out).launch(
            launch
        )

    def diagonal(self) -> DeviceArray:
        """Return the diagonal of A, shape (n,).

        It is the operator's own memory, which `update` keeps current.
        """
        return self._diagonal

    def rows(self) -> CompressedRows:
        """Return the compressed rows, in the operator's own memory."""
        return CompressedRows(self.indptr, self.indices, self.values)

    def scale(self) -> np.ndarray:
        """Return the natural residual's d, shape (n,)."""
        if self._scale is None:
            self._scale = scale_of_matrix(self.matrix())
        return self._scale

    def storage_rounding(self) -> float:
        """Return the largest relative rounding of an entry."""
        return self._rounding

    def renumbered(self) -> tuple[Renumbering, SparseOperator] | None:
        """Return A with unknowns renumbered for memory locality, or None.

        None where its own numbering is as good, and on CUDA.
        """
        numbering = self._numbering
        if numbering is None:
            return None
        if self._turned is None or self._turned_from != self.version:
            B = None if self.near_null_space is None else self.near_null_space[numbering.order]
            self._turned = SparseOperator(
                numbering.matrix(self.matrix()),
                device=self.device,
                dtype=self.dtype,
                near_null_space=B,
            )
            self._turned._rounding, self._turned_from = self._rounding, self.version
        return numbering, self._turned

    @cached_property
    def _numbering(self) -> Renumbering | None:
        return None if self.device.is_cuda else renumbering(self.matrix(), self.block)

    @cached_property
    def block(self) -> int:
        """Number of unknowns of a node."""
        if self.near_null_space is None:
            return 1
        pattern = _ones(self._indptr, self._indices)
        return next(
            (
                size
                for size in BLOCKS
                if self.unknowns % size == 0
                and pattern.tobsr((size, size)).data.size <= FILL * self.nnz
            ),
            1,
        )

    def coefficient_gradient(self, multiplier: DeviceArray, x: DeviceArray) -> Derivatives:
        """Return the derivatives of mu'A x by the entries, mu_i x_j as `matrix`.

        In the order of `indices`.

        Shape (nnz,), float64.
        """
        entries = np.repeat(multiplier.numpy(), np.diff(self._indptr)) * x.numpy()[self._indices]
        return {"matrix": wp.array(entries, dtype=wp.float64, device=self.device)}

    def masked(self, free: Values, shift: Values | None = None) -> SparseOperator:
        """Return P A P + P D P with P the restriction to `free` and D = diag(shift).

        `free` has non-zero entries on the rows that stay.
        """
        p = scipy.sparse.diags_array(
            (self.layout.load(free, wp.uint8, "free").numpy() != 0).astype(np.float64)
        )
        matrix = p @ self.matrix() @ p
        if shift is not None:
            matrix = matrix + p @ scipy.sparse.diags_array(
                self.layout.load(shift, wp.float64, "shift").numpy()
            )
        return SparseOperator(matrix, device=self.device, dtype=self.dtype)

    def relax(
        self,
        x: DeviceArray,
        b: DeviceArray,
        lower: DeviceArray,
        upper: DeviceArray,
        omega: float,
        *,
        forward: bool = True,
        colored: bool | None = None,
        launch: Launch = launch_now,
    ) -> None:
        """Sweep x once, each unknown projected onto its bounds.

        Rows with a zero diagonal are skipped.

        Projected SOR: x_i <- clip(x_i - omega (A x + b)_i / a_ii, l_i, u_i), with the current x.

        Args:
            x: field, moved in place.
            b: field like x.
            lower: field like x.
            upper: field like x.
            omega: relaxation factor.
            forward: rows, or colors, in ascending order; else descending.
            colored: color by color, all rows of a color in parallel, instead of row by row by one
                thread; on CUDA if None.
            launch: launches or records.
        """
        sweep = MatrixSweep(
            self.indptr,
            self.indices,
            self.values,
            self._diagonal,
            b,
            lower,
            upper,
            x,
            omega,
            forward,
        )
        if not (self.device.is_cuda if colored is None else colored):
            RELAX.bind(
                Rows.flat(x.size, self.device, serial=True), sweep, list=None, first=0
            ).launch(launch)
            return
        rows, starts = self.colors
        colors = range(len(starts) - 1)
        for c in colors if forward else reversed(colors):
            here = Rows.flat(starts[c + 1] - starts[c], self.device)
            RELAX.bind(here, sweep, list=rows, first=starts[c]).launch(launch)

    @cached_property
    def colors(self) -> tuple[DeviceArray, list[int]]:
        """Rows grouped by color, and the start of each color (and the end).

        On the device. No row has an entry in another row of its color. The coloring is greedy in
        row order, so the same on every run: red-black on the 5- and the 7-point stencil.
        """
        color = self.coloring()
        counts = np.bincount(color)
        rows = wp.array(np.argsort(color, kind="stable"), dtype=wp.int32, device=self.device)
        return rows, [0, *np.cumsum(counts).tolist()]

    def coloring(self) -> np.ndarray:
        """Return the color of each row, shape (n,), from 0."""
        return greedy_colors(_ones(self._indptr, self._indices))

    def _survey_entries(self, host: scipy.sparse.csr_array) -> None:
        """Update the data that depend on the entries."""
        largest, diagonal, same = _survey(host)
        self.symmetric = same or _is_symmetric(host, largest)
        check_kept(largest, self.dtype, "matrix, the largest entries of its rows")
        self.row_sizes = (
            None if largest.all() else wp.array(largest, dtype=wp.float64, device=self.device)
        )
        self._diagonal.assign(diagonal.astype(wp.dtype_to_numpy(self.dtype)))
        if self._transpose_values is not None:
            self._gather(self._transpose[2])
        self._scale, self._rounding = None, relative_rounding(host.data, self.dtype)
        self.version += 1

    def _gather(self, order: DeviceArray) -> None:
        GATHER.bind(
            Rows.flat(order.size, self.device),
            source=self.values,
            order=order,
            taken=self._transpose_values,
        ).launch()

    @cached_property
    def _transpose(self) -> tuple[DeviceArray, DeviceArray, DeviceArray]:
        """Rows and columns of A', and the index in A of each of its entries."""
        numbered = scipy.sparse.csr_array(
            (np.arange(self.nnz), self._indices, self._indptr), shape=self.shape * 2
        )
        turned = numbered.T.tocsr()
        parts = [
            device_copy(v, wp.int32, self.device)
            for v in (turned.indptr, turned.indices, turned.data)
        ]
        return parts[0], parts[1], parts[2]

    @property
    def _rows(self) -> RowEntries:
        return RowEntries(self.indptr, self.indices, self.values)

    def _matrix_of(self, values: np.ndarray) -> scipy.sparse.csr_array:
        return scipy.sparse.csr_array(
            (values.astype(np.float64), self._indices, self._indptr), shape=self.shape * 2
        )

    def _result(self, x: DeviceArray, out: DeviceArray | None) -> DeviceArray:
        if tuple(x.shape) != self.shape:
            raise ValueError(f"x has shape {tuple(x.shape)}: expected {self.shape}")
        return wp.zeros_like(x) if out is None else out


def greedy_colors(pattern: scipy.sparse.csr_array) -> np.ndarray:
    """Return a color of each row, from 0.

    Rows of one color have no entries in each other's columns.
    """
    both = (pattern + pattern.T).tocsr()
    inputs = [wp.array(v, dtype=wp.int32, device="cpu") for v in (both.indptr, both.indices)]
    taken = wp.zeros(int(np.diff(both.indptr).max(initial=0)) + 2, dtype=wp.int32, device="cpu")
    color = wp.zeros(pattern.shape[0], dtype=wp.int32, device="cpu")
    wp.launch(color_kernel, 1, [*inputs, taken, color, color.size], device="cpu")
    return np.asarray(color.numpy())


def _checked(matrix: Matrix) -> scipy.sparse.csr_array:
    """Return a matrix in compressed rows, sorted, without duplicates, in float64."""
    if not scipy.sparse.issparse(matrix):
        raise ValueError(
            f"matrix is a {type(matrix).__name__}: expected a scipy.sparse matrix (DenseOperator "
            "takes numpy arrays)"
        )
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or matrix.shape[0] == 0:
        raise ValueError(f"matrix has shape {matrix.shape}: expected (n, n) with n >= 1")
    if matrix.dtype.kind not in "fiub":
        raise ValueError(f"matrix has entries of type {matrix.dtype}: expected real numbers")
    _check_indices(matrix)
    host = scipy.sparse.csr_array(matrix, dtype=np.float64, copy=True)
    host.sum_duplicates()
    if host.nnz > np.iinfo(np.int32).max:
        raise ValueError(f"matrix has {host.nnz} entries: at most 2^31 - 1 can be indexed")
    return host


def _check_indices(matrix: SparseMatrix) -> None:
    """Refuse indices out of range.

    SciPy's conversions and the kernels would access other memory with them.
    """
    try:
        if matrix.format in ("csr", "csc", "bsr"):
            matrix.check_format(full_check=True)
        elif matrix.format == "coo":
            for name, index, n in zip(
                ("row", "column"), (matrix.row, matrix.col), matrix.shape, strict=True
            ):
                if len(index) != matrix.nnz or (
                    len(index) and not 0 <= int(index.min()) <= int(index.max()) < n
                ):
                    raise ValueError(
                        f"{name} indices must be from 0 to {n - 1}, one for each entry"
                    )
    except ValueError as reason:
        raise ValueError(
            f"matrix is not a valid sparse matrix of shape {matrix.shape}: {reason}"
        ) from reason


def _near_null_space(vectors: Values, n: int) -> np.ndarray:
    """Return fields as an array of shape (n, k), float64."""
    B = real_array(vectors, "near_null_space").astype(np.float64)
    B = B[:, None] if B.ndim == 1 else B
    if B.ndim != 2 or B.shape[0] != n or not 1 <= B.shape[1] <= 12:
        raise ValueError(
            f"near_null_space has shape {B.shape}: expected ({n}, k) with k from 1 to 12"
        )
    if not np.isfinite(B).all() or not (B != 0).any(axis=0).all():
        raise ValueError("near_null_space holds fields that vanish or are not finite")
    return B


def _ones(indptr: np.ndarray, indices: np.ndarray) -> scipy.sparse.csr_array:
    n = len(indptr) - 1
    return scipy.sparse.csr_array(
        (np.ones(len(indices), dtype=np.float32), indices, indptr), shape=(n, n)
    )


def _survey(host: scipy.sparse.csr_array) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return the largest magnitude of each row, the diagonal, and exact symmetry.

    The last is whether all entries equal those across the diagonal.
    """
    parts = (host.indptr, wp.int32), (host.indices, wp.int32), (host.data, wp.float64)
    ptr, col, a = (wp.array(v, dtype=t, device="cpu", copy=False) for v, t in parts)
    largest, diagonal = (zeros(host.shape[0], wp.float64, wp.get_device("cpu")) for _ in range(2))
    found = RowReduction(Rows.flat(largest.size, largest.device), 2).of(
        SURVEY, ptr=ptr, col=col, a=a, largest=largest, diagonal=diagonal
    )
    return largest.numpy(), diagonal.numpy(), not found.any()


def _is_symmetric(host: scipy.sparse.csr_array, largest: np.ndarray) -> bool:
    """Return whether A is symmetric up to rounding.

    |a_ij - a_ji| must be rounding of the smaller one of the largest entries of rows i and j, for
    all i, j.
    """
    turned = host.T.tocsr()
    if np.array_equal(turned.indptr, host.indptr) and np.array_equal(turned.indices, host.indices):
        largest_here = np.repeat(largest, np.diff(host.indptr))
        return is_rounding(turned.data - host.data, largest_here, largest[host.indices])
    difference = (host - turned).tocoo()
    return is_rounding(difference.data, largest[difference.row], largest[difference.col])


@as_operator.register(scipy.sparse.sparray)
@as_operator.register(scipy.sparse.spmatrix)
def _sparse(
    A: Matrix, device: wp.DeviceLike = None, dtype: DataType = wp.float64
) -> SparseOperator:
    return SparseOperator(A, device=device, dtype=dtype)
