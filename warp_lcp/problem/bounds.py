"""Bounds of a problem: numbers, fields, or codes.

Where all finite bounds are equal, a byte for each cell replaces eight.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Hashable
from pathlib import Path
from typing import TypeAlias

import numpy as np
import warp as wp

from warp_lcp.kernels import KernelFile, Rows
from warp_lcp.kernels.fields import LARGE, Array, Layout, nothing, overwrite, real_array
from warp_lcp.kernels.launch_graph import Launch, launch_now
from warp_lcp.kernels.layout import BoundOperands
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import RowReduction
from warp_lcp.problem.affine_bounds import AffineBounds, affine_fields
from warp_lcp.problem.data_types import BoundValues
from warp_lcp.problem.pickling import HostArrayPickle

NAMES, INFINITE = ("lower", "upper"), (-np.inf, np.inf)
# A bound of this magnitude is infinite in files and for users of SciPy and qpsolvers, as in OSQP
# and CPLEX.
INFINITY = 1e20
# From this number of elements on a kernel reads fields on the CPU; for fewer NumPy takes less time
# than the launch.
LAUNCHED = 4096
BITS = (1, 2)  # bits of a code: the lower bound is finite, the upper one is
KERNELS = KernelFile(Path(__file__).parent / "headers/problem.h")
ENCODE = KERNELS["bounds.encode"]
CODE_ROWS = KERNELS["bounds.code_rows"]
DECODE = KERNELS["bounds.decode"]


PickledSide: TypeAlias = "float | np.ndarray | HostArrayPickle | AffineBounds"  # of a pickle


class Bounds:
    """Lower and upper bounds, each a number or a field.

    A pressure is bounded by 0 on wall cells and not at all elsewhere. Such bounds are coded, one
    byte a cell with a bit for each side. Fields from the host are not stored then. Fields on the
    device, which the caller may change, are stored; `refresh` codes them again.

    Args:
        layout: of the problem's fields.
        lower: a number or a field, or AffineBounds.
        upper: likewise.

    Attributes:
        affine: the fields of bounds that depend on x, else None; `fields` then hold the bounds at
            the x of the last `follow`.
        fields: stored float64 fields; empty where a number or the code is used.
        values: the numbers that are used where there is no field; where bounds are coded, the value
            of the finite ones.
        code: stored uint8 field, bit 1 where the lower bound is finite, bit 2 where the upper one
            is; empty if bounds are not coded.
    """

    def __init__(self, layout: Layout, lower: BoundValues, upper: BoundValues) -> None:
        self.layout, self.device = layout, layout.device
        self._none, self._no_code = nothing(wp.float64, self.device), nothing(wp.uint8, self.device)
        self.fields, self.values, self.code = (
            [self._none, self._none],
            list(INFINITE),
            self._no_code,
        )
        self._memory: DeviceArray | None = None
        self.affine = affine_fields(layout, lower, upper)
        if self.affine is not None:
            self.fields, self.values, self.varying, self.in_place = (
                list(self.affine.values),
                [0.0, 0.0],
                (True, True),
                False,
            )
            return
        low, high = (
            v if isinstance(v, wp.array) else real_array(v, name)
            for v, name in zip((lower, upper), NAMES, strict=True)
        )
        sides = (low, high)
        varies = [v.ndim > 0 for v in sides]
        self.varying = (varies[0], varies[1])
        self.in_place = any(varies[s] and layout.holds(sides[s], wp.float64) for s in (0, 1))
        for side in (0, 1):
            if not varies[side]:
                self.values[side] = float(sides[side])
        if any(varies) and not self.in_place and self._code_from_host(sides):
            return
        for side in (0, 1):
            if varies[side]:
                self.fields[side] = layout.load(sides[side], wp.float64, NAMES[side])
                self.values[side] = 0.0
        if self.in_place:
            self.refresh()

    @property
    def may_bind(self) -> tuple[bool, bool]:
        """Whether a lower and an upper bound may be finite.

        Now, or after the caller has changed a field.
        """
        below, above = (
            self.varying[side] or bool(np.isfinite(self.values[side])) for side in (0, 1)
        )
        return below, above

    @property
    def form(self) -> Hashable | None:
        """Sizes and numbers of bounds that can `take` each other's data.

        None if they have no copies: bounds that depend on x, or are used in place.
        """
        if self.affine is not None or self.in_place:
            return None
        return (
            tuple(field.size for field in (*self.fields, self.code)),
            self.varying,
            *map(float.hex, self.values),
        )

    def replica(self) -> Bounds:
        """Return a copy of the bounds in its own memory."""
        twin = copy.copy(self)
        twin.fields, twin.code = [wp.clone(field) for field in self.fields], wp.clone(self.code)
        return twin

    def copy_from(self, other: Bounds) -> None:
        """Copy bounds of the same form."""
        for to, source in zip((*self.fields, self.code), (*other.fields, other.code), strict=True):
            overwrite(to, source)

    @property
    def operands(self) -> BoundOperands:
        """The bounds as arguments of kernels that support codes.

        For each side a field, or an empty array and the number that is then used; last the code.
        """
        numbers = [wp.float64(v) for v in self.values]
        if self.code.size:
            return BoundOperands(self._none, numbers[0], self._none, numbers[1], self.code)
        return BoundOperands(self.fields[0], numbers[0], self.fields[1], numbers[1], self.code)

    def follow(self, x: DeviceArray) -> None:
        """Evaluate bounds that depend on x at x (stored, float64)."""
        if self.affine is not None:
            self.affine.evaluate(x)

    def given_again(self) -> tuple[PickledSide, PickledSide]:
        """Return the current values of both sides, for a pickle."""
        if self.affine is not None:
            return self.affine.sides
        sides = []
        for side in (0, 1):
            held = self.fields[side].size and self.in_place
            field = self.as_field(side) if self.varying[side] else None
            sides.append(
                self.values[side]
                if field is None
                else HostArrayPickle(field)
                if held
                else field.numpy().copy()
            )
        return sides[0], sides[1]

    def refresh(self) -> None:
        """Code fields again that the caller may have changed.

        They are coded if all their finite values are 0.
        """
        if self.in_place:
            self.encode()
            self.code = self._no_code if self._other_values() else self._memory

    def encode(self, launch: Launch = launch_now) -> None:
        """Launch the coding of fields that are in place.

        `stays` then returns its outcome, and waits for the device.
        """
        if not self.in_place:
            return
        if self._memory is None:
            self._memory = self.layout.zeros(wp.uint8)
            self._others = RowReduction(Rows.of_fields(self.layout))
        least, most = (
            0.0 if field.size else v for field, v in zip(self.fields, self.values, strict=True)
        )
        lower, upper = self.fields
        self._others.launch(
            ENCODE,
            launch=launch,
            lower=lower,
            upper=upper,
            least=least,
            most=most,
            code=self._memory,
        )

    def changed(self) -> None:
        """Mark the results of a recorded `encode` as changed."""
        if self.in_place and self._memory is not None:
            self._others.reading.changed()

    @property
    def stays(self) -> bool:
        """Whether bounds are still coded, or still not coded."""
        return not self.in_place or self.stays_with(self._other_values())

    def stays_with(self, others: float) -> bool:
        """Return `stays` for a number of finite nonzero values on all ranks."""
        return not self.in_place or bool(others) == (self.code is not self._memory)

    @property
    def others_here(self) -> wp.array[wp.float64] | None:
        """Number of finite nonzero values in the last coding on this rank.

        Shape (1,); None if nothing is coded.
        """
        return self._others.reading.array if self.in_place and self._memory is not None else None

    def _other_values(self) -> float:
        """Return the number of finite nonzero values in the last coding, on all ranks."""
        found, comm = float(self._others.reading.numpy()[0]), self.layout.comm
        return found if comm is None else float(comm.sum(found))

    def as_field(self, side: int) -> DeviceArray:
        """Return a stored float64 field of the lower (0) or the upper bound (1)."""
        if self.fields[side].size:
            return self.fields[side]
        field = wp.full(self.layout.size, self.values[side], dtype=wp.float64, device=self.device)
        if self.code.size and not self.in_place:
            rows, value = Rows.flat(self.layout.size, self.device), self.values[side]
            DECODE.bind(
                rows,
                code=self.code,
                field=field,
                bit=BITS[side],
                value=value,
                infinite=INFINITE[side],
            ).launch()
        return field

    def host(self, side: int) -> np.ndarray:
        """Return `as_field` on the host, without a launch.

        It is the caller's memory if there is a field on the CPU.
        """
        if self.fields[side].size:
            return np.asarray(self.fields[side].numpy())
        field = np.full(self.layout.size, self.values[side])
        if self.code.size and not self.in_place:
            field[self.code.numpy() & BITS[side] == 0] = INFINITE[side]
        return field

    def _code_from_host(self, sides: tuple[Array, Array]) -> bool:
        """Code fields that are not stored yet.

        Returns False, with nothing done, if their finite values differ or one is NaN. On ranks
        either all code their fields, or none.
        """
        code, values, comm = (self.layout.host_zeros(wp.uint8), list(self.values), self.layout.comm)
        for side in (0, 1):
            host = real_array(sides[side], NAMES[side])
            if not self.varying[side]:
                code += np.uint8(BITS[side] * bool(np.isfinite(values[side])))
                continue
            takes = self.layout.fits(host) and host.dtype.kind in "fiu"
            value = float(host.max() if side == 0 else host.min()) if takes else math.nan
            if comm is not None:
                value = float(comm.max(value) if side == 0 else comm.min(value))
            coded = not (value == -INFINITE[side] or np.isnan(value)) and self._code_rows(
                side, host, value, code
            )
            if not coded if comm is None else comm.any(not coded):
                return False
            values[side] = value
        self.values = values
        self.code = wp.array(
            code.ravel(), dtype=wp.uint8, device=self.device, copy=self.device.is_cuda
        )
        return True

    def _code_rows(self, side: int, host: np.ndarray, value: float, code: np.ndarray) -> bool:
        """Add a side's bits to a code on the host.

        Returns False if there are other finite values.
        """
        target = self.layout.target(code, host)
        if host.size <= LAUNCHED:
            finite = host != INFINITE[side]
            target += (BITS[side] * finite).astype(np.uint8).reshape(target.shape)
            return not (finite & (host != value)).any()
        target = target if target.ndim == 3 else target.reshape(1, 1, -1)
        host = host.reshape(target.shape)
        # Other types are copied
        at_once = len(host) if host.dtype == np.float64 else -(-LARGE // host[0].size)
        parts = [slice(k, k + at_once) for k in range(0, len(host), at_once)]
        return all(self._code_part(side, host[part], value, code, target[part]) for part in parts)

    def _code_part(
        self, side: int, host: np.ndarray, value: float, code: np.ndarray, target: np.ndarray
    ) -> bool:
        """Add a side's bits for some planes of the code."""
        first = target.__array_interface__["data"][0] - code.__array_interface__["data"][0]
        rows = Rows.strided(
            code.size, wp.get_device("cpu"), (first, *target.strides[:2]), target.shape
        )
        arrays = (
            np.ascontiguousarray(host, dtype=np.float64).ravel(),
            code.ravel(),
            np.zeros(rows.places),
        )
        source, bits, out = (wp.array(a, device="cpu", copy=False) for a in arrays)
        CODE_ROWS.bind(
            rows,
            source=source,
            code=bits,
            value=value,
            infinite=INFINITE[side],
            bit=BITS[side],
            out=out,
        ).launch()
        return not out.numpy().any()


def huge_as_infinite(values: np.ndarray) -> np.ndarray:
    """Replace magnitudes of INFINITY and more by infinities.

    In bounds and right-hand sides.
    """
    huge = np.abs(values) >= INFINITY
    return np.where(huge, np.copysign(np.inf, values), values) if huge.any() else values


def without_far(lower: np.ndarray, upper: np.ndarray, far: float) -> tuple[np.ndarray, np.ndarray]:
    """Replace bounds of at least `far` in magnitude by infinities.

    Lower bounds of at most -far, and upper ones of at least far.
    """
    return np.where(lower <= -far, -np.inf, lower), np.where(upper >= far, np.inf, upper)
