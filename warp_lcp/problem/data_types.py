"""Types of the matrices, vectors and bounds that users pass."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, TypeAlias, TypeGuard, runtime_checkable

import numpy as np
import scipy.sparse

from warp_lcp.kernels.fields import Array
from warp_lcp.kernels.types import DataFrame, DeviceArray, Values

if TYPE_CHECKING:
    from warp_lcp.problem.affine_bounds import AffineBounds
    from warp_lcp.problem.operator_protocol import Operator

SparseMatrix: TypeAlias = scipy.sparse.csr_array | scipy.sparse.csr_matrix
Matrix: TypeAlias = SparseMatrix | np.ndarray  # on the host
MatrixData: TypeAlias = Matrix | DeviceArray | DataFrame
"""Entries of a matrix: a numpy or Warp array, a scipy.sparse matrix, a data frame."""
OperatorLike: TypeAlias = "Operator | MatrixData"
"""An operator, or the entries from which `as_operator` makes one."""
BoundValues: TypeAlias = "Values | AffineBounds"
"""Bounds of one side: a number, a field, or bounds that are affine in x."""
Indices: TypeAlias = "Values"
"""Integers: a list, or an array on the host or a device."""


@runtime_checkable
class SupportsArray(Protocol):
    """An object that NumPy converts to an array."""

    def __array__(self) -> np.ndarray:
        """Return the values as an array."""


@runtime_checkable
class SupportsMatmul(Protocol):
    """An object with products M @ v: a matrix, or an operator of SciPy or PyAMG."""

    def __matmul__(self, other: np.ndarray) -> np.ndarray:
        """Return M @ v."""


@runtime_checkable
class HasPreconditioner(Protocol):
    """A hierarchy of PyAMG, which makes a preconditioner."""

    def aspreconditioner(self) -> SupportsMatmul:
        """Return the cycle as an operator."""


@runtime_checkable
class HasShape(Protocol):
    """An object with a shape, as arrays and linear operators have."""

    shape: tuple[int, ...]


def is_sparse(A: Matrix) -> TypeGuard[SparseMatrix]:
    """Return whether a matrix is one of scipy.sparse."""
    return bool(scipy.sparse.issparse(A))


def dense(A: Matrix) -> np.ndarray:
    """Return a matrix as a numpy array, without a copy if it is one."""
    return A.toarray() if is_sparse(A) else np.asarray(A)


__all__ = [
    "Array",
    "BoundValues",
    "HasPreconditioner",
    "HasShape",
    "Indices",
    "Matrix",
    "MatrixData",
    "OperatorLike",
    "SparseMatrix",
    "SupportsArray",
    "SupportsMatmul",
    "Values",
    "dense",
    "is_sparse",
]
