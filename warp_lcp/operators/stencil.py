"""User-defined compact stencils on a grid of cells, matrix-free.

Up to 9 points in 2-D, 27 in 3-D, symmetric or not.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias, no_type_check

import numpy as np
import scipy
import warp as wp

from warp_lcp.kernels import KernelFile, Rows
from warp_lcp.kernels.fields import check_kept, check_storable, real_array
from warp_lcp.kernels.layout import Pattern
from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.kernels.vectors import RowReduction
from warp_lcp.operators.components import FloatingComponents, null_vectors, numbered_components
from warp_lcp.operators.grid_matrix import grid_matrix
from warp_lcp.operators.grid_operator import GridOperator
from warp_lcp.operators.padded_stencil import PaddedStencil
from warp_lcp.problem.data_types import Values
from warp_lcp.problem.operator_protocol import AIR, FLUID, SOLID, Derivatives, Scratch
from warp_lcp.problem.pickling import HostArrayPickle, Reduced, rebuilt_from

KERNELS = KernelFile(Path(__file__).parent / "headers/stencil_operator.h")
DIAGONAL = KERNELS["stencil.diagonal"]
TRANSPOSED = KERNELS["stencil.transposed"]
GRADIENT = KERNELS["stencil.gradient"]
# Unknowns of a component whose null vectors are computed by sparse factors, in a second or two.
MOST_IN_PLANE, MOST_IN_SPACE = 1 << 17, 1 << 14
CENTER = (0, 0, 0)
# All neighbors in 2-D.
AROUND = Pattern(
    tuple((x, y, 0) for y in (-1, 0, 1) for x in (-1, 0, 1) if x or y),
    symmetric=False,
    kind="arrays",
)
Offset = tuple[int, int, int]  # along x, y, z
Coefficient: TypeAlias = Values | wp.Function
"""Coefficient of a neighbor: a number, a field, or a Warp function of the cell."""
Coefficients: TypeAlias = Mapping[tuple[int, ...], Coefficient] | Values
"""Coefficients by offset, or an array of 3 x 3 (x 3) numbers."""

__all__ = ["Stencil"]


class Stencil(GridOperator):
    """Operator of a compact stencil on the FLUID cells of a grid.

    For your own finite differences, finite volumes or finite elements.

    (A x)_i = sum over offsets o of a_o(i) x_(i + o) + shift_i x_i, with x = 0 in AIR, and x_(i + o)
    = x_i where i + o is SOLID (a closed side: no flux). With other values in AIR cells, see
    `boundary_term`. Nothing is assembled: numbers are constants in the kernels, Warp functions are
    evaluated where a row is needed, arrays are read.

    Args:
        cells: integers AIR = 0, FLUID = 1, SOLID = 2, shape (nz, ny, nx) or (ny, nx); numpy or
            wp.array. Unknowns are on FLUID cells, fields have the shape of `cells`.
        coefficients: a_o by offset, (dz, dy, dx) or (dy, dx), each -1, 0 or 1, the center included;
            absent ones are 0. Each is a number, an array of the shape of `cells`, or a Warp
            function of the cell's indices, (k, j, i) or (j, i), that returns a float; functions and
            arrays cannot be combined. Or an array of numbers of shape (3, 3) or (3, 3, 3), the
            center in the middle.
        shift: None, a number or an array of the shape of `cells`, >= 0.
        periodic: whether x, y, z wrap around; the cells of an axis of one cell are then their own
            neighbors.
        outside: type of the cells outside the array along axes that are not periodic: SOLID, as for
            `wl.GridPoisson`, or AIR.
        device: Warp device; that of `cells` or the default device if None.
        dtype: storage of coefficients, wp.float32 or wp.float64. In float32 coefficients are
            rounded, which changes the problem by about 1e-7 of the diagonal; tolerances below the
            rounding end with FLOOR.

    Attributes:
        symmetric: whether a_o(i) = a_-o(i + o) between all unknowns, to the last bit; coefficients
            toward SOLID, AIR and cells outside do not matter. Once other cells in place have made A
            unsymmetric, it stays False.
        monotone: whether all a_o but the center's are <= 0, as in an M-matrix.

    Raises:
        ValueError: an argument has a wrong shape or type or is not finite, an offset is not
            compact, or a row's diagonal is not positive; the message names it.

    Example:
        >>> import numpy as np, warp_lcp as wl
        >>> coefficients = {(0, 0): 3.0, (0, -1): -2.0, (0, 1): -1.0}
        >>> A = wl.Stencil(np.full((1, 3), wl.FLUID), coefficients, outside=wl.AIR, device="cpu")
        >>> x = wp.array([[1.0, 1.0, 1.0]], dtype=wp.float64, device="cpu")
        >>> print(A.apply(x).numpy(), A.symmetric)
        [[2. 0. 1.]] False
    """

    def __init__(
        self,
        cells: Values,
        coefficients: Coefficients,
        *,
        shift: Values | None = None,
        periodic: tuple[bool, ...] = (False, False, False),
        outside: int = SOLID,
        device: wp.DeviceLike = None,
        dtype: DataType = wp.float32,
    ) -> None:
        if outside not in (AIR, SOLID):
            raise ValueError(
                f"outside = {outside}: allowed are wl.AIR = {AIR} and wl.SOLID = {SOLID}"
            )
        self.outside = outside
        super().__init__(
            cells, {"coefficients": coefficients, "shift": shift}, periodic, device, dtype
        )

    def _take_coefficients(
        self, cells: np.ndarray, *, coefficients: Coefficients, shift: Values | None
    ) -> None:
        """Check the coefficients, and store them in the form that kernels use.

        The forms are numbers, Warp functions, or arrays. Of symmetric coefficients half of the
        neighbors are stored. The weights of the kernels are -a_o, because A x = d x - sum of
        weights times neighbors.
        """
        self._given = by_offset = _by_offset(coefficients, cells.ndim)
        self.shift, self._shift_given = (
            self._stored_shift(shift),
            None if shift is None else tuple(np.shape(shift)),
        )
        functions = {
            o: _of_three(f, cells.ndim) for o, f in by_offset.items() if isinstance(f, wp.Function)
        }
        values = {
            o: real_array(f, f"coefficients[{_named(o, cells.ndim)}]")
            for o, f in by_offset.items()
            if o not in functions
        }
        for o, f in values.items():
            if f.ndim and f.shape != cells.shape:
                raise ValueError(
                    f"coefficients[{_named(o, cells.ndim)}] has shape {f.shape}: expected a number "
                    f"or {cells.shape}"
                )
            check_storable(f, self.dtype, f"coefficients[{_named(o, cells.ndim)}]")
            check_kept(f, self.dtype, f"coefficients[{_named(o, cells.ndim)}]")
            if f.ndim:  # numbers are not stored, but added
                self._note_rounding(f)
        if functions and any(f.ndim for f in values.values()):
            raise ValueError(
                "coefficients: arrays and Warp functions cannot be combined: evaluate the "
                "functions or make the arrays functions"
            )
        fluid = cells.reshape(self.layout.padding.counts) == FLUID
        self._around_itself = [
            a for a in range(cells.ndim) if self._wraps[a] and fluid.shape[2 - a] == 1
        ]  # its cells are their own neighbors
        # Ghost cells, and sums, exist for arrays only.
        if functions and (any(self.periodic) or self._around_itself):
            values, functions = values | {o: self._evaluated(f) for o, f in functions.items()}, {}
        values = _folded(
            {o: f.reshape(fluid.shape) if f.ndim else f for o, f in values.items()},
            self._around_itself,
        )
        evaluated = {o: self._evaluated(f) for o, f in functions.items()}  # for tests, not stored
        full = {o: np.broadcast_to(f, fluid.shape) for o, f in values.items()} | evaluated
        self._center = (
            self._stored(full[CENTER])
            if evaluated.keys() & {CENTER} or values[CENTER].ndim
            else None
        )
        self._number = 0.0 if self._center is not None else float(values[CENTER])
        around = [o for o in sorted(full, key=lambda o: o[::-1]) if o != CENTER and full[o].any()]
        halves = self._pair_up(full, around) and not functions
        halves = halves and not any(
            values[o].ndim == values[_opposite(o)].ndim == 0 and values[o] != values[_opposite(o)]
            for o in around
        )
        stored = any(values[o].ndim for o in around if o in values)
        kind = (
            "arrays"
            if stored
            else "functions"
            if any(o in functions for o in around)
            else "numbers"
        )
        offsets = tuple(o for o in around if not halves or o[::-1] < CENTER)
        pattern_functions = (
            tuple(functions.get(o, float(values[o]) if o in values else 0.0) for o in offsets)
            if kind == "functions"
            else ()
        )
        self._pattern = Pattern(offsets, halves, kind, pattern_functions)
        self._weights = (
            tuple(self._stored_weight(full, o, halves) for o in offsets) if stored else None
        )
        self._numbers = tuple(-float(values[o]) for o in offsets) if kind == "numbers" else ()
        sizes = {o: float(np.abs(full[o][fluid]).mean()) if fluid.any() else 0.0 for o in around}
        along_x, along_y, along_z = (
            sum(size for o, size in sizes.items() if o[axis]) / 2 for axis in range(3)
        )
        self._strength = (along_x, along_y, along_z)

    @property
    def given(self) -> dict[tuple[int, ...], Coefficient]:
        """Coefficients by offset, as given."""
        return {_named(offset, len(self.shape)): value for offset, value in self._given.items()}

    def _arguments(self) -> dict[str, Any]:
        return {
            "coefficients": self.given,
            "shift": self.shift if self.shift.size else None,
            "outside": self.outside,
        }

    def coefficient_gradient(self, multiplier: DeviceArray, x: DeviceArray) -> Derivatives:
        """Return the derivatives by each offset's coefficients and by the shift.

        mu_i x_(i + o) of each offset, under `coefficients`, and mu_i x_i of the shift; for
        functions the derivatives by their values. Where the neighbor is SOLID, it is mu_i x_i; x =
        0 in AIR.
        """
        self._check_own()
        self.stencil.wrap(x)
        rows, cells = Rows.of(self.layout.padding, self.device), self.cells_around.flatten()

        def gradient_of(offset: Offset, shape: tuple[int, ...]) -> DeviceArray | float:
            """Return the derivative by the coefficients of an offset, of a given shape."""
            part = self.layout.zeros(wp.float64) if shape else None
            step, row, plane = (
                0 if axis in self._around_itself else step for axis, step in enumerate(offset)
            )
            total = RowReduction(rows, 1).of(
                GRADIENT,
                cells=cells,
                multiplier=multiplier,
                x=x,
                part=part,
                step=step,
                row=row,
                plane=plane,
            )
            return (
                total.item()
                if part is None
                else part.reshape(shape)
                if part.size == math.prod(shape)
                else self.layout.unload(part)
            )

        shapes = {
            o: self.shape if isinstance(f, wp.Function) else tuple(np.shape(f))
            for o, f in self._given.items()
        }
        given = self._shift_given
        found = {_named(o, len(self.shape)): gradient_of(o, shape) for o, shape in shapes.items()}
        return {
            "coefficients": found,
            "shift": None if given is None else gradient_of(CENTER, given),
        }

    def transposed(self) -> Stencil:
        """Return A' as a stencil of arrays, without SOLID cells.

        Its diagonal includes the contributions of closed sides.
        """
        fluid = self.cells.numpy()[1:-1, 1:-1, 1:-1] == FLUID
        transposed: dict[tuple[int, ...], Coefficient] = {
            (0,) * len(self.shape): np.where(
                fluid.reshape(self.shape), self.diagonal().numpy(), 1.0
            )
        }
        for offset, here in self._full().items():
            # a_o(i) is the neighbor's coefficient for i; between FLUID cells, so that each of them
            # may be removed later.
            if offset != CENTER:
                there = self._beside(np.where(fluid, here, 0.0), _opposite(offset))
                transposed[_named(_opposite(offset), len(self.shape))] = np.where(
                    fluid, there, 0.0
                ).reshape(self.shape)
        cells = np.where(fluid, FLUID, AIR).reshape(self.shape)
        return Stencil(
            cells,
            transposed,
            periodic=self.periodic,
            outside=AIR,
            device=self.device,
            dtype=self.dtype,
        )

    def _pair_up(self, full: dict[Offset, np.ndarray], around: list[Offset]) -> bool:
        """Find the sides with a_o(i) != a_-o(i + o), and those with positive coefficients.

        Returns whether all sides between cells have one coefficient.
        """
        differing = [(o, self._beside(np.ones_like(full[o], dtype=bool), o)) for o in around]
        differing = [
            (
                o,
                between
                & (
                    full[o] != self._beside(full[_opposite(o)], o)
                    if _opposite(o) in full
                    else full[o] != 0
                ),
            )
            for o, between in differing
        ]
        self._differing = [(o, where) for o, where in differing if where.any()]
        positive = functools.reduce(
            np.logical_or, [full[o] > 0 for o in around], np.zeros_like(full[CENTER], dtype=bool)
        )
        self._positive = positive if positive.any() else None
        self.symmetric = self.monotone = True  # until `_fill_stencil` has seen the cells
        return not self._differing and all(_opposite(o) in around for o in around)

    def _find_signs(self) -> None:
        """Find whether A is symmetric and monotone on the current FLUID cells."""
        if self._differing or self._positive is not None:
            fluid = self.cells.numpy()[1:-1, 1:-1, 1:-1] == FLUID
            self.symmetric = self.symmetric and not any(
                (where & fluid & self._beside(fluid, o)).any() for o, where in self._differing
            )
            self._differing = self._differing if self.symmetric else []
            self.monotone = self._positive is None or not (self._positive & fluid).any()

    def _beside(self, values: np.ndarray, offset: Offset) -> np.ndarray:
        """Return the values of each cell's neighbor, 0 beyond the array."""
        moved: np.ndarray = np.roll(values, tuple(-step for step in offset[::-1]), (0, 1, 2))
        for axis, step in enumerate(offset[::-1]):
            if step and not self.periodic[2 - axis]:
                np.moveaxis(moved, axis, 0)[-1 if step > 0 else 0] = 0
        return moved

    def _full(self) -> dict[Offset, np.ndarray]:
        """Return the coefficients of all cells by offset, (nz, ny, nx)."""
        n, counts = len(self.shape), self.layout.padding.counts
        values = {
            o: self._evaluated(_of_three(f, n))
            if isinstance(f, wp.Function)
            else real_array(f, "coefficients")
            for o, f in self._given.items()
        }
        folded = _folded(
            {o: f.reshape(counts) if f.ndim else f for o, f in values.items()}, self._around_itself
        )
        return {o: np.broadcast_to(f, counts) for o, f in folded.items()}

    def _evaluated(self, function: wp.Function) -> np.ndarray:
        """Return the values of a Warp function at all cells."""
        out = wp.zeros(self.layout.padding.counts, dtype=wp.float64, device=self.device)
        wp.launch(_evaluation(function), out.shape, [out], device=self.device)
        values: np.ndarray = out.numpy()
        check_storable(values, self.dtype, f"coefficients: {function.key}")
        return values

    def evaluated(self, function: wp.Function) -> np.ndarray:
        """Return the values of one of the pattern's functions as a stored field."""
        return np.pad(self._evaluated(function), 1).ravel()

    def _stored(self, values: np.ndarray) -> DeviceArray:
        """Return coefficients of all cells as a stored field."""
        return wp.array(np.pad(values, 1).ravel(), dtype=self.dtype, device=self.device)

    def _stored_weight(
        self, full: dict[Offset, np.ndarray], offset: Offset, halves: bool
    ) -> DeviceArray:
        """Return an offset's weights as a stored field.

        Ghost cells of periodic axes have those of the cells that they represent. A weight that
        serves two cells is stored at the upper one: ghost cells beyond the array have those of the
        cells' upper sides there.
        """
        padded = self._wrapped(-full[offset])
        if halves:
            steps = tuple(-step for step in offset[::-1])
            # Of the cell below, seen from the upper one.
            lower = np.roll(self._wrapped(-full[_opposite(offset)]), steps, (0, 1, 2))
            for axis in (a for a in range(3) if offset[2 - a] and not self.periodic[2 - a]):
                ghosts = (slice(None),) * axis + (-1 if offset[2 - axis] < 0 else 0,)
                padded[ghosts] = lower[ghosts]
        return wp.array(padded.ravel(), dtype=self.dtype, device=self.device)

    def _wrapped(self, values: np.ndarray) -> np.ndarray:
        """Return a padded field with filled ghost cells along periodic axes."""
        padded = np.pad(values, 1)
        for axis in (a for a in range(3) if self.periodic[2 - a]):
            lines = np.moveaxis(padded, axis, 0)
            lines[0], lines[-1] = lines[-2], lines[1]
        return padded

    def _empty_stencil(self) -> PaddedStencil:
        """Return the stencil with an allocated diagonal."""
        layout = self.layout
        return PaddedStencil(
            layout.padding,
            layout.zeros(self.dtype),
            self._weights,
            self._numbers,
            periodic=self.periodic,
            spans=self._spans,
            strength=self._strength,
            pattern=self._pattern,
        )

    def _fill_stencil(self) -> None:
        """Compute the diagonal, and refuse one that is not positive.

        d = center + the coefficients of closed neighbors + shift: the value beyond a closed side is
        the cell's own.
        """
        s = self.stencil
        self._wrap_cells()
        self._find_signs()
        shift = self.shift.flatten() if self.shift.size else None
        DIAGONAL.bind(
            self._rows_in_reach,
            stencil=s,
            cells=self.cells_around.flatten(),
            center=self._center,
            shift=shift,
            number=self._number,
            made=s.d,
        ).launch()
        d, fluid = s.d.numpy(), self.cells.numpy().ravel() == FLUID
        if not (d[fluid] > 0).all():
            where = tuple(
                map(int, np.argwhere((fluid & (d <= 0)).reshape(self.layout.stored_shape))[0] - 1)
            )[-len(self.shape) :]
            raise ValueError(
                f"coefficients: the diagonal of cell {where} is {d[fluid].min():.3g}, with its "
                "closed sides: must be > 0"
            )

    def apply_transpose(self, x: DeviceArray, out: DeviceArray | None = None) -> DeviceArray:
        """Return A' x, as `apply` does A x."""
        return self._applied(x, out, transposed=not self.symmetric)

    def _product(self, x: DeviceArray, out: DeviceArray, *, transposed: bool) -> None:
        if not transposed:
            super()._product(x, out, transposed=False)
            return
        self.stencil.wrap(x)
        TRANSPOSED.bind(self.stencil.rows, stencil=self.stencil, x=x, y=out).launch()

    def boundary_term(self, values: Values) -> DeviceArray:
        """Return the contribution to b of given values in AIR cells, instead of 0.

        The sums of a_o(i) value_(i + o), float64, shape of `cells`.

        Args:
            values: field of the shape of `cells`, or padded, (nz + 2, ny + 2, nx + 2) or (ny + 2,
                nx + 2), with the values outside; values of FLUID and SOLID cells and of the padding
                along a periodic axis are ignored.
        """
        host = real_array(values, "values")
        padded = np.zeros(self.layout.stored_shape)
        if host.shape == self.shape:
            padded[1:-1, 1:-1, 1:-1] = host
        elif host.shape == tuple(n + 2 for n in self.shape):
            padded[(slice(None),) * 3 if host.ndim == 3 else 1] = host
        else:
            raise ValueError(
                f"values has shape {host.shape}: expected {self.shape} or "
                f"{tuple(n + 2 for n in self.shape)}"
            )
        check_storable(padded, wp.float64, "values")
        boundary = wp.array(
            np.where(self.cells.numpy() == AIR, padded, 0).ravel(),
            dtype=wp.float64,
            device=self.device,
        )
        out = self.layout.zeros(wp.float64)
        self.stencil.product(boundary, out)
        return self.layout.unload(out)

    def floating_components(self, scratch: Scratch | None = None) -> FloatingComponents | None:
        """Return the components on which rows sum to 0, or None.

        A symmetric A is singular there.
        """
        if self._found is None or self._found[0] != self.version:
            self._found = self.version, self._find_floating()
        found: FloatingComponents | None = self._found[1]
        return found

    def _find_floating(self) -> FloatingComponents | None:
        """Find components on which all rows sum to 0, or all columns; on the host.

        If A is symmetric and all coupled neighbors have nonzero weights, the components follow from
        the cells alone, else from the assembled matrix.
        """
        fluid = (self.cells.numpy() == FLUID) & (
            self.stencil.d.numpy().reshape(self.layout.stored_shape) != 0
        )
        inside = fluid.ravel()
        rows = self._sums_vanish(inside, transposed=False)
        columns = rows if self.symmetric else self._sums_vanish(inside, transposed=True)
        if not (rows[inside].any() or columns[inside].any()):
            return None
        places = np.flatnonzero(inside)
        if (
            self.symmetric
            and not any(self.periodic)
            and all((w.numpy()[places] != 0).all() for w in self.stencil.weights or ())
        ):
            structure = np.zeros((3, 3, 3), dtype=bool)  # of all neighbors that are coupled
            for offset in (
                o for stored in self._pattern.offsets for o in (stored, CENTER, _opposite(stored))
            ):
                structure[tuple(step + 1 for step in offset[::-1])] = True
            number, count = scipy.ndimage.label(fluid, structure)
            number = number.ravel()
            return numbered_components(
                number, np.bincount(number, inside & ~rows, count + 1) > 0, self.device
            )
        matrix = grid_matrix(self)
        if len(places) < matrix.shape[0]:  # a principal system
            stored = inside[self.cells.numpy().ravel() == FLUID]
            matrix = matrix[stored][:, stored]
        most = MOST_IN_SPACE if self.layout.padding.counts[0] > 1 else MOST_IN_PLANE
        vectors = null_vectors(
            matrix, rows[places], columns[places], most=most if self.monotone else 0
        )
        number, fields = (
            np.zeros(inside.size, dtype=np.int32),
            [np.ones(inside.size) for _ in range(2)],
        )
        number[places] = vectors.number + 1
        for field, vector in zip(fields, (vectors.left, vectors.right), strict=True):
            field[places] = vector
        left, right = (None if (field == 1).all() else field for field in fields)
        return numbered_components(
            number, np.r_[True, vectors.held], self.device, left=left, right=right
        )

    def _sums_vanish(self, inside: np.ndarray, *, transposed: bool) -> np.ndarray:
        """Return which rows, or columns, sum to 0 up to rounding, as a flat stored field."""
        x, sums = (
            wp.array(np.where(inside, 1.0, 0.0), dtype=wp.float64, device=self.device),
            self.layout.zeros(wp.float64),
        )
        self._product(x, sums, transposed=transposed)
        rounding = 8 * float(np.finfo(wp.dtype_to_numpy(self.dtype)).eps)
        center = np.abs(self._number) if self._center is None else np.abs(self._center.numpy())
        size = np.maximum(self.stencil.d.numpy(), center)  # closed sides cancel some of it
        return np.asarray(inside & (np.abs(sums.numpy()) <= rounding * size))

    def __reduce__(self) -> Reduced:
        """Pickle cells and coefficients; Warp functions are pickled as arrays."""
        cells, options = self._pickled()
        n = cells.ndim
        coefficients = {
            o: self._evaluated(_of_three(f, n)).reshape(cells.shape)
            if isinstance(f, wp.Function)
            else f.numpy()
            if isinstance(f, wp.array)
            else f
            for o, f in self.given.items()
        }
        shift = HostArrayPickle(self.shift) if self.shift.size else None
        return rebuilt_from(
            Stencil,
            cells,
            **self._arguments() | {"coefficients": coefficients, "shift": shift},
            device=self.device,
            **options,
        )


class StoredStencil(GridOperator):
    """A compact stencil with existing diagonal and weights.

    They are fields of a padded grid, which the stencil takes over.

    Args:
        cells: as of `Stencil`; beyond the array there is AIR.
        d: diagonal in units of `unit`, stored; 0 off the FLUID cells.
        weights: of the pattern's neighbors, stored, or numbers.
        pattern: the neighbors, and the kind of their weights; None: weights along x, y, z of 5 or 7
            points, as in `PaddedStencil`.
        symmetric: whether A is symmetric.
        unit: of the diagonal.
        monotone: whether all weights are >= 0.
        strength: mean weights along x, y, z.
    """

    outside = AIR

    def __init__(
        self,
        cells: np.ndarray,
        d: DeviceArray,
        weights: tuple[DeviceArray | float, ...],
        pattern: Pattern | None,
        *,
        symmetric: bool,
        unit: float = 1.0,
        monotone: bool = False,
        strength: tuple[float, float, float] = (1.0, 1.0, 1.0),
    ) -> None:
        self.symmetric, self.monotone = symmetric, monotone
        self._made, self._unit = (d, weights, pattern, strength), unit
        super().__init__(cells, {}, (), d.device, wp.float64 if d.dtype is wp.uint8 else d.dtype)

    def set_fields(self, cells: np.ndarray, d: np.ndarray, weights: DeviceArray) -> None:
        """Set other cells of the same shape, another diagonal, and weights, in place.

        `weights` has one field after another.
        """
        own, fields, _, _ = self._made
        own.assign(d)
        for place, field in enumerate(fields):
            assert isinstance(field, wp.array), "the weights are fields"
            wp.copy(field, weights, src_offset=place * field.size, count=field.size)
        padded = np.full(self.layout.stored_shape, AIR, dtype=np.int8)
        padded[1:-1, 1:-1, 1:-1] = cells.reshape(self.layout.padding.counts)
        self.update(wp.array(padded, device=self.device))

    def _take_coefficients(self, cells: np.ndarray) -> None:
        pass

    def _empty_stencil(self) -> PaddedStencil:
        """Return the stencil of the given fields."""
        d, weights, pattern, strength = self._made
        fields, numbers = (None, weights) if isinstance(weights[0], float) else (weights, ())
        return PaddedStencil(
            self.layout.padding,
            d,
            fields,
            numbers,
            self._unit,
            spans=self._spans,
            strength=strength,
            pattern=pattern,
        )

    def _fill_stencil(self) -> None:
        self._wrap_cells()


def _opposite(offset: Offset) -> Offset:
    """Return the offset of a cell as seen from its neighbor."""
    return -offset[0], -offset[1], -offset[2]


def _folded(values: dict[Offset, np.ndarray], axes: list[int]) -> dict[Offset, np.ndarray]:
    """Return coefficients without steps along periodic axes of one cell.

    Such a neighbor is the one without that step.
    """
    found: dict[Offset, np.ndarray] = {}
    for offset, value in values.items():
        place = tuple(0 if axis in axes else step for axis, step in enumerate(offset))
        found[place] = found[place] + value if place in found else value  # type: ignore[index]
    return found


def _named(offset: Offset, dimension: int) -> tuple[int, ...]:
    """Return an offset in the user's order of axes."""
    return offset[::-1][3 - dimension :]


def _by_offset(coefficients: Coefficients, dimension: int) -> dict[Offset, Coefficient]:
    """Return coefficients by offset along x, y, z, the center included."""
    if not isinstance(coefficients, Mapping):
        host = real_array(coefficients, "coefficients")
        if host.shape != (3,) * dimension:
            raise ValueError(
                f"coefficients has shape {host.shape}: expected {(3,) * dimension}, or a mapping "
                "by offset"
            )
        places = itertools.product(range(3), repeat=dimension)
        coefficients = {
            tuple(i - 1 for i in place): float(host[place]) for place in places if host[place]
        }
    by_offset: dict[Offset, Coefficient] = {}
    for offset, value in coefficients.items():
        steps = tuple(offset) if isinstance(offset, tuple) else (offset,)
        if len(steps) != dimension or not all(
            isinstance(s, (int, np.integer)) and -1 <= s <= 1 for s in steps
        ):
            form = ("(dy, dx)", "(dz, dy, dx)")[dimension - 2]
            raise ValueError(
                f"coefficients: offset {offset}: expected {form}, each -1, 0 or 1: wider stencils "
                "need a wl.SparseOperator"
            )
        along_xyz = tuple(map(int, reversed((0,) * (3 - dimension) + steps)))
        by_offset[along_xyz] = value  # type: ignore[index]
    if CENTER not in by_offset:
        raise ValueError(f"coefficients: the center, offset {(0,) * dimension}, is missing")
    return by_offset


@functools.cache
def _of_three(function: wp.Function, dimension: int) -> wp.Function:
    """Return a Warp function of (k, j, i) in float64 for a function of the cell."""
    count = len(function.input_types)
    if count != dimension:
        raise ValueError(
            f"coefficients: {function.key} takes {count} arguments: expected the {dimension} "
            "indices of a cell, integers"
        )
    if dimension == 3:

        @no_type_check
        def of_cell(k: int, j: int, i: int):
            return wp.float64(function(k, j, i))
    else:

        @no_type_check
        def of_cell(k: int, j: int, i: int):
            return wp.float64(function(j, i))

    of_cell.__name__ = of_cell.__qualname__ = f"{function.key}_of_cell"
    return wp.func(of_cell)


@functools.cache
def _evaluation(function: wp.Function) -> wp.Kernel:
    """Return a kernel that evaluates a Warp function of (k, j, i) at all cells."""

    @no_type_check
    def evaluate(out: wp.array3d(dtype=wp.float64)):
        k, j, i = wp.tid()
        out[k, j, i] = function(k, j, i)

    return wp.kernel(enable_backward=False, module="unique")(evaluate)
