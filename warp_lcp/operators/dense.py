"""A dense matrix as an operator, for small problems, oracles and tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy.sparse
import warp as wp

from warp_lcp.kernels import KernelFile, Rows
from warp_lcp.kernels.fields import (
    Layout,
    check_kept,
    check_storable,
    checked_device,
    real_array,
    relative_rounding,
)
from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.operators.compressed_rows import CompressedRows
from warp_lcp.problem.data_types import Matrix, Values
from warp_lcp.problem.lcp import as_operator
from warp_lcp.problem.operator_protocol import Derivatives
from warp_lcp.problem.pickling import HostPickling, Reduced, rebuilt_from
from warp_lcp.problem.residual_scaling import scale_of_matrix

KERNELS = KernelFile(Path(__file__).parent / "headers/matrices.h")
PRODUCT = KERNELS["dense.product"]
RELAX = KERNELS["dense.relax"]
# Relative to the largest entries of two rows: asymmetry from rounding of J M^-1 J' and of assembly
# in float64.
SYMMETRIC = 64 * float(np.finfo(np.float64).eps)


def is_rounding(difference: np.ndarray, one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether each a_ij - a_ji is rounding.

    That is relative to the smaller one of the largest entries of rows i and j.

    Args:
        difference: a_ij - a_ji.
        one: the largest magnitude of row i, of a shape that broadcasts with the difference.
        other: that of row j.
    """
    return bool((np.abs(difference) <= SYMMETRIC * np.minimum(one, other)).all())


class DenseOperator(HostPickling):
    """Dense square matrix as an operator.

    Args:
        matrix: A, numpy array or wp.array (n, n), finite.
        device: Warp device; the default device if None.
        dtype: storage of A, wp.float64 or wp.float32.

    Attributes:
        row_sizes: the largest magnitude of each row, shape (n,), wp.float64; None where no row is
            empty.

    Raises:
        ValueError: the matrix is not square, empty or not finite.
    """

    shape: tuple[int, ...]

    def __init__(
        self, matrix: Matrix, *, device: wp.DeviceLike = None, dtype: DataType = wp.float64
    ) -> None:
        if dtype not in (wp.float32, wp.float64):
            raise ValueError(f"dtype = {dtype}: must be wp.float32 or wp.float64")
        if scipy.sparse.issparse(matrix):
            raise ValueError("matrix is sparse: use SparseOperator")
        host = np.asarray(real_array(matrix, "matrix"), dtype=np.float64)
        if host.ndim != 2 or host.shape[0] != host.shape[1] or host.size == 0:
            raise ValueError(f"matrix has shape {host.shape}: expected (n, n) with n >= 1")
        check_storable(host, dtype, "matrix")
        self.device, self.dtype, self.shape = checked_device(device), dtype, (host.shape[0],)
        self.layout = Layout(self.shape, self.device)
        self.matrix = wp.array(host, dtype=dtype, device=self.device)
        largest = np.abs(host).max(axis=1)
        check_kept(largest, dtype, "matrix, the largest entries of its rows")
        self.row_sizes = (
            None if largest.all() else wp.array(largest, dtype=wp.float64, device=self.device)
        )
        self._rounding = relative_rounding(host, dtype)
        self.symmetric = is_rounding(host - host.T, largest[:, None], largest)

    def __reduce__(self) -> Reduced:
        """Pickle the current matrix."""
        return rebuilt_from(
            DenseOperator, self.matrix.numpy(), device=self.device, dtype=self.dtype
        )

    @property
    def unknowns(self) -> int:
        """Number of rows, which are all unknowns."""
        return self.shape[0]

    def update(self, values: Values) -> None:
        """Replace the entries: shape (n, n), finite.

        `symmetric` and `row_sizes` keep their values.
        """
        self.matrix.assign(values)
        self._rounding = relative_rounding(real_array(values, "values"), self.dtype)

    def storage_rounding(self) -> float:
        """Return the largest relative rounding of an entry."""
        return self._rounding

    def apply(self, x: DeviceArray, out: DeviceArray | None = None) -> DeviceArray:
        """Return A x, x of shape (n,) and type wp.float32 or wp.float64."""
        return self._product(x, out, transposed=False)

    def apply_transpose(self, x: DeviceArray, out: DeviceArray | None = None) -> DeviceArray:
        """Return A' x, x as for `apply`."""
        return self._product(x, out, transposed=True)

    def diagonal(self) -> DeviceArray:
        """Return the diagonal of A, shape (n,)."""
        return wp.array(self.host_diagonal().copy(), dtype=self.dtype, device=self.device)

    def host_diagonal(self) -> np.ndarray:
        """Return the diagonal of A on the host, shape (n,)."""
        return np.asarray(self.matrix.numpy().diagonal())

    def rows(self) -> CompressedRows:
        """Return the rows, in the operator's own memory."""
        starts = wp.array(
            np.arange(self.unknowns + 1) * self.unknowns, dtype=wp.int32, device=self.device
        )
        return CompressedRows(
            starts, wp.empty(0, dtype=wp.int32, device=self.device), self.matrix.flatten()
        )

    def scale(self) -> np.ndarray:
        """Return the natural residual's d, shape (n,), for the current entries."""
        return scale_of_matrix(self.matrix.numpy().astype(np.float64))

    def coefficient_gradient(self, multiplier: DeviceArray, x: DeviceArray) -> Derivatives:
        """Return the derivatives of mu'A x by the entries, mu_i x_j as `matrix`.

        Shape (n, n), float64.
        """
        return {
            "matrix": wp.array(
                np.outer(multiplier.numpy(), x.numpy()), dtype=wp.float64, device=self.device
            )
        }

    def masked(self, free: Values, shift: Values | None = None) -> DenseOperator:
        """Return P A P + P D P with P the restriction to `free` and D = diag(shift).

        `free` has non-zero entries on the rows that stay.
        """
        p = self.layout.load(free, wp.uint8, "free").numpy() != 0
        matrix = self.matrix.numpy() * np.outer(p, p)
        if shift is not None:
            matrix = matrix + np.diag(self.layout.load(shift, self.dtype, "shift").numpy() * p)
        return DenseOperator(matrix, device=self.device, dtype=self.dtype)

    def relax(
        self,
        x: DeviceArray,
        b: DeviceArray,
        lower: DeviceArray,
        upper: DeviceArray,
        omega: float,
        *,
        forward: bool = True,
    ) -> None:
        """Sweep x once in row order, forward or backward, projected onto the bounds."""
        rows, matrix = Rows.flat(x.size, self.device, serial=True), self.matrix.flatten()
        RELAX.bind(
            rows, a=matrix, b=b, lower=lower, upper=upper, x=x, omega=omega, forward=forward
        ).launch()

    def _product(self, x: DeviceArray, out: DeviceArray | None, *, transposed: bool) -> DeviceArray:
        """Return A x or A' x, in `out` if given."""
        if tuple(x.shape) != self.shape:
            raise ValueError(f"x has shape {tuple(x.shape)}: expected {self.shape}")
        out = wp.zeros_like(x) if out is None else out
        rows = Rows.flat(self.unknowns, self.device)
        PRODUCT.bind(
            rows, a=self.matrix.flatten(), x=x, y=out, size=self.unknowns, transposed=transposed
        ).launch()
        return out


@as_operator.register(np.ndarray)
@as_operator.register(wp.array)
def _dense(A: Matrix, device: wp.DeviceLike = None, dtype: DataType = wp.float64) -> DenseOperator:
    return DenseOperator(
        A, device=A.device if device is None and isinstance(A, wp.array) else device, dtype=dtype
    )
