"""Bounds that are affine in x ([Book] 1.3.5, 2.2.1).

For example friction, |x_t| <= mu x_n: a box whose size depends on another unknown.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import no_type_check

import numpy as np
import warp as wp

from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.fields import Layout, real_array
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.problem.data_types import BoundValues, Values

f64, i32 = wp.array(dtype=wp.float64), wp.array(dtype=wp.int32)


@wp.struct
class AffineSide:
    """Lower or upper bounds: constant + coefficient x[index] where index >= 0.

    The constant alone where `index` is -1 or empty.
    """

    constant: f64
    index: i32
    coefficient: f64


@no_type_check
@wp.func
def bound_at(S: AffineSide, x: f64, i: int):
    """Return the bound of unknown i at x."""
    value = S.constant[i]
    if S.index.shape[0] > 0:
        if S.index[i] >= 0:
            value = value + S.coefficient[i] * x[S.index[i]]
    return value


@no_type_check
@forward_kernel(module="warp_lcp.affine_bounds")
def evaluate_kernel(S: AffineSide, x: f64, out: f64):
    """Write the bounds at x, one unknown per thread."""
    i = wp.tid()
    out[i] = bound_at(S, x, i)


SIDES = ("lower", "upper")


@dataclass(frozen=True, eq=False, init=False)
class AffineBounds:
    """Bounds on one side that depend on x: c_i + k_i x_j with j = index_i.

    Where index_i = -1 the bound is the constant c_i.

    Given to `LCP` as `lower` or `upper`. The unknown x_j that a bound depends on must itself have
    constant bounds. Methods that evaluate their bounds at the iterate take such problems (sweeps,
    NNCG, SubspaceMinimization, Staggering); others refuse. With them the problem is a
    quasi-variational inequality, which may have no solution or several, and no convergence proof
    covers it.

    Args:
        constant: a number or a field of the problem's shape; -inf or inf where there is no bound
            (with index -1).
        index: flat index into a field of the problem's shape, or -1; integers, that shape.
        coefficient: a number or a field of that shape, finite.

    Raises:
        ValueError: shapes differ, an index is no unknown's, a coefficient is not finite.
    """

    constant: np.ndarray
    index: np.ndarray
    coefficient: np.ndarray

    def __init__(self, constant: Values, index: Values, coefficient: Values) -> None:
        """Broadcast numbers to the shape of `index`, and check all."""
        index = np.asarray(index)
        if not np.issubdtype(index.dtype, np.integer):
            raise ValueError(f"index has type {index.dtype}: expected integers")
        if index.size and (index.min() < -1 or index.max() >= index.size):
            raise ValueError(
                f"index has values from {index.min()} to {index.max()}: expected -1 ... "
                f"{index.size - 1}"
            )
        object.__setattr__(self, "index", index)
        for name, given in (("constant", constant), ("coefficient", coefficient)):
            value = np.asarray(real_array(given, name), dtype=np.float64)
            if value.shape not in ((), index.shape):
                raise ValueError(
                    f"{name} has shape {value.shape}: expected a number or {index.shape}"
                )
            object.__setattr__(self, name, np.array(np.broadcast_to(value, index.shape)))
        if not np.isfinite(self.coefficient[index >= 0]).all():
            raise ValueError("coefficient holds a value that is not finite")
        if not np.isfinite(self.constant[index >= 0]).all():
            raise ValueError(
                "constant holds a value that is not finite where the bound depends on x"
            )

    @classmethod
    def friction(
        cls, normal: Values, mu: Values, lower: Values = 0.0, upper: Values = np.inf
    ) -> tuple[AffineBounds, AffineBounds]:
        """Return the bounds of a friction box: |x_i| <= mu_i x_j with j = normal_i.

        Where normal_i = -1 they are [lower_i, upper_i].

        Args:
            normal: for each tangential unknown the flat index of its normal one; -1 for others.
            mu: coefficient of friction >= 0, a number or a field.
            lower: bound of the unknowns with normal_i = -1, a number or a field.
            upper: likewise.

        Raises:
            ValueError: mu is negative, or shapes differ.

        Example:
            >>> low, high = AffineBounds.friction([-1, 0], 0.5)
            >>> print(low.coefficient, high.constant)
            [-0.  -0.5] [inf  0.]
        """
        index = np.asarray(normal)
        tangential, mu = index >= 0, np.asarray(mu, dtype=np.float64)
        if not (np.broadcast_to(mu, index.shape)[tangential] >= 0).all():
            raise ValueError("mu holds a negative value or NaN: friction coefficients are >= 0")
        slope = np.where(tangential, mu, 0.0)
        sides = (np.where(tangential, 0.0, np.asarray(side)) for side in (lower, upper))
        low, high = (
            cls(constant, index, sign * slope)
            for constant, sign in zip(sides, (-1.0, 1.0), strict=True)
        )
        return low, high

    def at(self, x: np.ndarray) -> np.ndarray:
        """Return the bounds at x (numpy, the field's shape)."""
        values = self.constant + self.coefficient * np.where(
            self.index >= 0, x.ravel()[self.index], 0.0
        )
        return np.where(self.index >= 0, values, self.constant)


class AffineFields:
    """Both sides of a problem's bounds on the device, and their values at an iterate.

    Attributes:
        constant: stored fields (lower, upper), float64.
        index: stored int32 fields of stored indices, -1 where the bound is the constant.
        coefficient: stored fields, float64.
        values: stored fields, the bounds at the x of the last `evaluate`; at clip(0, l, u) before
            that.
        sides: both sides as AffineBounds.
    """

    def __init__(self, layout: Layout, lower: BoundValues, upper: BoundValues) -> None:
        sides = [
            side if isinstance(side, AffineBounds) else _constant(layout, side, name)
            for side, name in zip((lower, upper), SIDES, strict=True)
        ]
        for side, name in zip(sides, SIDES, strict=True):
            if not layout.fits(side.index):
                raise ValueError(
                    f"{name}: index has shape {side.index.shape}: expected {layout.shape}"
                )
        self.sides = (sides[0], sides[1])
        indices = [np.where(s.index >= 0, layout.places(s.index)[s.index], -1) for s in sides]
        self.constant = [
            layout.load(s.constant, wp.float64, name) for s, name in zip(sides, SIDES, strict=True)
        ]
        self.coefficient = [
            layout.load(s.coefficient, wp.float64, name)
            for s, name in zip(sides, SIDES, strict=True)
        ]
        # ghost cells become 0 by loading, so that -1 is stored as 0 and the others one too large
        shifted = [
            layout.load(i + 1, wp.int32, name) for i, name in zip(indices, SIDES, strict=True)
        ]
        self.index = [
            wp.array(s.numpy() - 1, dtype=wp.int32, device=layout.device) for s in shifted
        ]
        dependent = [i.numpy() >= 0 for i in self.index]
        for number, name in enumerate(SIDES):
            needed = self.index[number].numpy()[dependent[number]]
            if (dependent[0] | dependent[1])[needed].any():
                raise ValueError(
                    f"{name} depends on an unknown whose own bounds are affine: these must be "
                    "constant"
                )
        self.values = [wp.clone(c) for c in self.constant]
        self._check()

    def evaluate(self, x: DeviceArray) -> None:
        """Compute the bounds at x (stored, float64)."""
        for operands, values in zip(self.operands, self.values, strict=True):
            wp.launch(evaluate_kernel, x.size, [operands, x, values], device=x.device)

    @cached_property
    def operands(self) -> list[AffineSide]:
        """Lower and upper bounds as kernel arguments."""
        return [
            affine_side(*of) for of in zip(self.constant, self.index, self.coefficient, strict=True)
        ]

    def _check(self) -> None:
        """Refuse empty boxes; evaluate the bounds at clip(0, l, u).

        Boxes are tested with the unknown on which they depend at each of its own bounds.
        """
        low, high = (c.numpy() for c in self.constant)
        for x in (np.clip(0.0, low, high), low, high):
            at = [
                self._host(side, np.where(np.isfinite(x), x, np.clip(0.0, low, high)))
                for side in (0, 1)
            ]
            if (at[0] > at[1]).any():
                raise ValueError(
                    f"lower > upper in {np.count_nonzero(at[0] > at[1])} unknowns if those they "
                    "depend on are at a bound"
                )
        start = np.clip(0.0, low, high)
        for side in (0, 1):
            self.values[side].assign(self._host(side, start))

    def _host(self, side: int, x: np.ndarray) -> np.ndarray:
        index, coefficient = self.index[side].numpy(), self.coefficient[side].numpy()
        with np.errstate(invalid="ignore"):
            return np.asarray(
                np.where(
                    index >= 0,
                    self.constant[side].numpy() + coefficient * x[index],
                    self.constant[side].numpy(),
                )
            )


def affine_side(
    constant: DeviceArray, index: DeviceArray | None = None, coefficient: DeviceArray | None = None
) -> AffineSide:
    """Return bounds as a kernel argument; constant ones without index."""
    side = AffineSide()
    side.constant = constant
    if index is not None:
        side.index, side.coefficient = index, coefficient
    return side


def affine_fields(layout: Layout, lower: BoundValues, upper: BoundValues) -> AffineFields | None:
    """Return the fields of bounds if a side is affine, None if neither is."""
    affine = isinstance(lower, AffineBounds) or isinstance(upper, AffineBounds)
    return AffineFields(layout, lower, upper) if affine else None


def _constant(layout: Layout, side: Values, name: str) -> AffineBounds:
    """Return constant bounds as affine ones."""
    host = real_array(side, name)
    shape = layout.shape if host.ndim == 0 else host.shape
    if shape not in (layout.shape, layout.stored_shape):
        raise ValueError(f"{name} has shape {shape}: expected {layout.shape}")
    return AffineBounds(host, np.full(shape, -1), 0.0)
