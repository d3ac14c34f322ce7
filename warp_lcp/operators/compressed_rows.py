"""The entries of a matrix by rows, on its device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
import warp as wp


@dataclass(frozen=True, eq=False)
class CompressedRows:
    """The entries of a matrix by rows.

    Attributes:
        indptr: where each row begins, shape (n + 1,), wp.int32.
        indices: columns, wp.int32, ascending in each row; empty if every row is full.
        values: entries, wp.float32 or wp.float64.
    """

    indptr: wp.array[Any]
    indices: wp.array[Any]
    values: wp.array[Any]

    def matrix(self) -> Any:
        """Return the matrix on the host, float64: a scipy.sparse.csr_array, or where every row is full numpy, perhaps the same memory."""
        n, values = self.indptr.size - 1, self.values.numpy()
        if self.indices.size == 0 and values.size:
            return values.reshape(n, n).astype(np.float64, copy=False)
        return scipy.sparse.csr_array((values.astype(np.float64), self.indices.numpy(), self.indptr.numpy()), shape=(n, n))
