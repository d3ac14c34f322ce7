"""Operator given by its products on the host.

A function of NumPy arrays, SciPy's LinearOperator, or another object with `@`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol, TypeAlias, runtime_checkable

import numpy as np
import numpy.typing as npt
import scipy.sparse.linalg
import warp as wp

from warp_lcp.kernels.fields import Layout, check_storable, checked_device, real_array
from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.problem.data_types import HasShape, Matrix, SupportsMatmul, Values
from warp_lcp.problem.lcp import as_operator
from warp_lcp.problem.operator_protocol import Operator
from warp_lcp.problem.pickling import HostPickling, Reduced, rebuilt_from
from warp_lcp.problem.residual_scaling import NoTranspose, estimated_scale

Product: TypeAlias = Callable[[np.ndarray], npt.ArrayLike]
Factor: TypeAlias = Product | SupportsMatmul  # by which A x is computed
ASYMMETRY = 1e-5  # relative to ||u|| ||A v||: larger than float32 products leave of u'Av = v'Au


@runtime_checkable
class HasDataType(Protocol):
    """An object whose products have a type; None: not known."""

    dtype: npt.DTypeLike


@runtime_checkable
class HasAdjoint(Protocol):
    """An operator of SciPy, with products A' y."""

    def rmatvec(self, x: np.ndarray) -> np.ndarray:
        """Return A' x."""


@runtime_checkable
class HasTranspose(Protocol):
    """A matrix that has a transpose."""

    @property
    def T(self) -> SupportsMatmul: ...  # noqa: D102, N802


class LinearOperator(HostPickling, Operator):
    """Operator given by products alone: a function or a SciPy LinearOperator.

    A x comes from the function, or from `A @ x`; rows and entries are not available.

    Products are computed on the host, from copies of x in float64, on any device. Every method that
    needs products only accepts it (docs "Operators of your own"); `MinimumMapNewton` is the
    default. Two products check the arguments, two more check the symmetry of A if `symmetric` is
    set.

    Args:
        A: function of a float64 array of shape `shape` that returns A x in that shape; or an object
            of shape (n, n) with products by `@`.
        shape: of the fields; (n,) if None, which is not allowed for a function.
        symmetric: whether A equals its transpose, which halves the cost of Newton's systems
            (conjugate gradients, else GMRES) and which some methods need. None: False, unless A is
            its own adjoint, `A.H is A`, as SciPy's special arrays are.
        diagonal: of A, a number or a field. None: row and column norms, estimated from 16 products,
            are used instead; the natural residual's scale never depends on it alone.
        transpose: function that returns A'x; None: `A.rmatvec` where that is defined. Methods that
            need A' (GradientDescent) refuse an unsymmetric A without it.
        device: Warp device of the fields; the CPU if None.

    Raises:
        ValueError: A is of another kind, not square or not real; a product has another shape, is
            not real or not finite; `symmetric` is set and A is not symmetric.

    Example:
        >>> import numpy as np, warp_lcp as wl
        >>> def product(x):
        ...     return 3 * x - np.roll(x, 1) - np.roll(x, -1)
        >>> A = wl.LinearOperator(product, (5,), symmetric=True, diagonal=3.0)
        >>> print(wl.solve(wl.LCP(A, np.array([1.0, -2.0, 1.0, 1.0, 1.0]))).x.numpy().round(3))
        [0.    0.667 0.    0.    0.   ]
    """

    def __init__(
        self,
        A: Factor,
        shape: tuple[int, ...] | None = None,
        *,
        symmetric: bool | None = None,
        diagonal: Values | None = None,
        transpose: Product | None = None,
        device: wp.DeviceLike = None,
    ) -> None:
        self._arguments = (A, shape, symmetric, diagonal, transpose)
        self.shape = _shape_of(A, shape)
        self.device = checked_device("cpu" if device is None else device)
        self.layout = Layout(self.shape, self.device)
        self._product, self._transpose = _products_of(A, self.shape, transpose)
        self._diagonal = None if diagonal is None else self._field(diagonal)
        probes = np.random.default_rng(20230817).standard_normal((2, *self.shape))
        images = [self._image(z, self._product) for z in probes]
        if not all(np.isfinite(image).all() for image in images):
            raise ValueError("the product of A with normally distributed numbers is not finite")
        self.symmetric = (
            isinstance(A, scipy.sparse.linalg.LinearOperator) and A.H is A
            if symmetric is None
            else bool(symmetric)
        )
        one, other = (
            float(np.vdot(z, image)) for z, image in zip(probes, images[::-1], strict=True)
        )
        if symmetric and abs(one - other) > ASYMMETRY * math.sqrt(self.layout.size) * max(
            float(np.linalg.norm(v)) for v in images
        ):
            raise ValueError(
                f"symmetric: A is not, u'Av is {one:.6g} and v'Au {other:.6g} for some u and v; "
                "pass symmetric=False"
            )
        self._scale: np.ndarray | None = None

    def __reduce__(self) -> Reduced:
        """Pickle the constructor's arguments."""
        return rebuilt_from(_made, *self._arguments, device=self.device)

    def apply(self, x: DeviceArray, out: DeviceArray | None = None) -> DeviceArray:
        """Return A x, x of `shape` and type wp.float32 or wp.float64."""
        return self._applied(self._product, x, out)

    def apply_transpose(self, x: DeviceArray, out: DeviceArray | None = None) -> DeviceArray:
        """Return A' x, x as for `apply`.

        Raises:
            NoTranspose: A has none.
        """
        if self._transpose is None and not self.symmetric:
            raise NoTranspose(
                "A has no products with its transpose: give wl.LinearOperator a transpose, or "
                "choose a method that needs none"
            )
        return self._applied(
            self._product if self.symmetric or self._transpose is None else self._transpose, x, out
        )

    def diagonal(self) -> DeviceArray:
        """Return the diagonal of A or its estimate, of `shape`."""
        d = self.scale() if self._diagonal is None else self._diagonal
        return wp.array(d.reshape(self.shape), dtype=wp.float64, device=self.device)

    def scale(self) -> np.ndarray:
        """Return the natural residual's d, estimated by 16 products.

        The estimate is made at the first call.
        """
        if self._scale is None:
            self._scale = estimated_scale(
                self, self.layout, np.ones(self.layout.size, dtype=bool), self._diagonal
            )
        return self._scale

    def _field(self, diagonal: Values) -> np.ndarray:
        """Return a diagonal as a flat field."""
        host = np.asarray(real_array(diagonal, "diagonal"), dtype=np.float64)
        if host.shape not in ((), self.shape):
            raise ValueError(f"diagonal has shape {host.shape}: expected a number or {self.shape}")
        check_storable(host, wp.float64, "diagonal")
        return np.broadcast_to(host, self.shape).ravel().copy()

    def _applied(self, product: Product, x: DeviceArray, out: DeviceArray | None) -> DeviceArray:
        if x.size != self.layout.size:
            raise ValueError(f"x has shape {tuple(x.shape)}: expected {self.shape}")
        image = self._image(np.array(x.numpy(), dtype=np.float64).reshape(self.shape), product)
        out = wp.zeros_like(x) if out is None else out
        out.assign(image.reshape(out.shape))
        return out

    def _image(self, x: np.ndarray, product: Product) -> np.ndarray:
        """Return a product with an array that it may keep.

        Raises:
            ValueError: it returns nothing, is not real or has another shape.
        """
        try:
            # The result is copied, because A may return its own buffer and write to it next time.
            image = np.array(product(x))
        except ValueError as reason:  # SciPy's, for a matvec that returns another shape
            raise ValueError(
                f"A fails to multiply an array of shape {self.shape}: {reason}"
            ) from reason
        if image.dtype.kind not in "biuf":
            raise ValueError(f"A gives a product of type {image.dtype}: expected real numbers")
        if image.shape != self.shape:
            raise ValueError(f"A gives a product of shape {image.shape}: expected {self.shape}")
        return image


def _shape_of(A: Factor, shape: tuple[int, ...] | None) -> tuple[int, ...]:
    """Return the shape of A's fields, checked against A's own shape."""
    matrix_shape = A.shape if isinstance(A, HasShape) else None
    if isinstance(A, Operator) or not (callable(A) or isinstance(A, SupportsMatmul)):
        raise ValueError(
            f"A is a {type(A).__name__}: expected a function, or a "
            "scipy.sparse.linalg.LinearOperator"
        )
    if not isinstance(A, SupportsMatmul):
        matrix_shape = None
    elif (
        matrix_shape is None
        or len(matrix_shape) != 2
        or matrix_shape[0] != matrix_shape[1]
        or matrix_shape[0] == 0
    ):
        raise ValueError(f"A has shape {matrix_shape}: expected (n, n) with n >= 1")
    if matrix_shape is None and shape is None:
        raise ValueError("shape: must be given if A is a function")
    try:
        field_shape = (
            matrix_shape[:1]
            if shape is None
            else tuple(int(n) for n in np.atleast_1d(np.asarray(shape, dtype=object)))
        )
    except (TypeError, ValueError):
        raise ValueError(f"shape = {shape!r}: expected a tuple of integers") from None
    if (
        not field_shape
        or min(field_shape) < 1
        or (matrix_shape is not None and math.prod(field_shape) != matrix_shape[0])
    ):
        raise ValueError(
            f"shape = {shape!r}: expected integers >= 1"
            + ("" if matrix_shape is None else f" whose product is {matrix_shape[0]}")
        )
    if isinstance(A, HasDataType) and np.dtype(A.dtype or np.float64).kind not in "biuf":
        raise ValueError(f"A has type {A.dtype}: expected real numbers")
    return field_shape


def _products_of(
    A: Factor, shape: tuple[int, ...], transpose: Product | None
) -> tuple[Product, Product | None]:
    """Return the functions x -> A x and x -> A'x on fields of a shape.

    The second is None if it is not defined.
    """
    if not (transpose is None or callable(transpose)):
        raise ValueError(f"transpose is a {type(transpose).__name__}: expected a function")
    if not isinstance(A, SupportsMatmul):
        return A, transpose
    factor: SupportsMatmul = A

    def product(x: np.ndarray) -> np.ndarray:
        return np.asarray(factor @ x.ravel()).reshape(shape)

    if transpose is not None:
        return product, transpose
    if not isinstance(A, HasAdjoint):
        return product, _by_transpose(A, shape) if isinstance(A, HasTranspose) else None
    matvec = A.rmatvec

    def adjoint(x: np.ndarray) -> np.ndarray:
        return np.asarray(matvec(x.ravel())).reshape(shape)

    try:
        adjoint(np.zeros(shape))
    except NotImplementedError:  # SciPy's error if there is no adjoint
        return product, None
    return product, adjoint


def _by_transpose(A: HasTranspose, shape: tuple[int, ...]) -> Product:
    return lambda x: np.asarray(A.T @ x.ravel()).reshape(shape)


def _made(
    A: Factor,
    shape: tuple[int, ...] | None,
    symmetric: bool | None,
    diagonal: Values | None,
    transpose: Product | None,
    device: wp.DeviceLike,
) -> LinearOperator:
    return LinearOperator(
        A, shape, symmetric=symmetric, diagonal=diagonal, transpose=transpose, device=device
    )


@as_operator.register(scipy.sparse.linalg.LinearOperator)
def _linear(
    A: Matrix, device: wp.DeviceLike = None, dtype: DataType = wp.float64
) -> LinearOperator:
    return LinearOperator(A, device=device)
