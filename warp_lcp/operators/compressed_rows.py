"""Entries of a matrix by rows, on its device."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import scipy.sparse
import warp as wp

from warp_lcp.kernels.layout import make_struct
from warp_lcp.kernels.types import DataType, DeviceArray, StructInstance
from warp_lcp.problem.data_types import Matrix


@functools.cache
def matrix_rows(a_type: DataType) -> DataType:
    """Return the struct of a matrix in compressed rows; `col` may be empty: full rows."""
    members = {
        "ptr": wp.array(dtype=wp.int32),
        "col": wp.array(dtype=wp.int32),
        "a": wp.array(dtype=a_type),
    }
    return make_struct(f"MatrixRows_{a_type.__name__}", members)


@dataclass(frozen=True, slots=True)
class RowEntries:
    """Entries of a sparse matrix by rows, as a kernel argument.

    Attributes:
        ptr: first entry of each row and the end, int32, shape (n + 1,).
        col: columns of the entries, int32.
        a: values of the entries, float32 or float64.
    """

    ptr: DeviceArray
    col: DeviceArray
    a: DeviceArray


@dataclass(frozen=True, eq=False)
class CompressedRows:
    """Compressed sparse rows of a matrix.

    Attributes:
        indptr: where each row begins, shape (n + 1,), wp.int32.
        indices: columns, wp.int32, ascending in each row; empty if every row is full.
        values: entries, wp.float32 or wp.float64.
    """

    indptr: DeviceArray
    indices: DeviceArray
    values: DeviceArray

    @property
    def operand(self) -> StructInstance:
        """Struct of the rows for kernels."""
        made = matrix_rows(self.values.dtype)()
        made.ptr, made.col, made.a = self.indptr, self.indices, self.values
        return made

    def matrix(self) -> Matrix:
        """Return the matrix on the host, float64.

        A scipy.sparse.csr_array, or numpy if every row is full, perhaps in the same memory.
        """
        n, values = self.indptr.size - 1, self.values.numpy()
        if self.indices.size == 0 and values.size:
            return values.reshape(n, n).astype(np.float64, copy=False)
        return scipy.sparse.csr_array(
            (values.astype(np.float64), self.indices.numpy(), self.indptr.numpy()), shape=(n, n)
        )
