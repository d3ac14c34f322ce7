"""The Poisson operator of a grid of cells, matrix-free: what pressure solves, obstacle problems and density corrections share."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.operators.cell_lists import cells_of
from warp_lcp.operators.components import ComponentFinder, FloatingComponents, Scratch
from warp_lcp.operators.stencil import Ghosts, Stencil, find_spans_kernel
from warp_lcp.problem.pickling import OnHost, Pickled, made_again
from warp_lcp.problem.protocol import AIR, FLUID, SOLID
from warp_lcp.rows import RowPass, Rows
from warp_lcp.rows.fields import CPU_CHUNK, LARGE, PaddedLayout, check_kept, check_storable, real_array
from warp_lcp.rows.vectors import Across, Sums

HEADERS = Path(__file__).parent / "headers"
CELLS = {"cells": wp.int8}
FIELDS = ("fx", "fy", "fz")
AROUND = dict.fromkeys(("around_x", "around_y", "around_z"), bool)

COPY_CELLS = RowPass("grid_poisson.copy_cells", HEADERS / "copy.h", wp.int8, reads={"source": wp.int8}, writes={"to": wp.int8})
COUNT_FACES = RowPass(
    "grid_poisson.count_faces", HEADERS / "count_faces.h", wp.uint8, reads=CELLS, writes={"diagonal": wp.uint8}, numbers=AROUND
)
FACES: dict[str, Any] = {"optional": (*FIELDS, "shift"), "numbers": dict.fromkeys(("nx", "ny", "nz"), "S")}
GIVEN = dict.fromkeys(("FIELD_X", "FIELD_Y", "FIELD_Z"), 0)  # which of them are fields
DIAGONAL = RowPass(
    "grid_poisson.diagonal", HEADERS / "diagonal.h", "S", reads={**CELLS, **dict.fromkeys((*FIELDS, "shift"), "S")},
    writes={"diagonal": "S"}, constants=GIVEN | {"SHIFTED": 0}, **FACES,
)  # fmt: skip
WEIGHTS = RowPass(
    "grid_poisson.weights", HEADERS / "weights.h", "S", reads={**CELLS, **dict.fromkeys(FIELDS, "S")},
    writes=dict.fromkeys(("wx", "wy", "wz"), "S"), constants=GIVEN, **FACES,
)  # fmt: skip
FACE_GRADIENT = RowPass(
    "grid_poisson.face_gradient", HEADERS / "face_gradient.h", wp.float64, reads={**CELLS, "multiplier": wp.float64, "x": wp.float64},
    writes=dict.fromkeys(("face_x", "face_y", "face_z", "shift"), wp.float64), optional=("face_x", "face_y", "face_z", "shift"),
    sums=("sum_x", "sum_y", "sum_z", "sum_shift"),
)  # fmt: skip


__all__ = ["AIR", "FLUID", "SOLID", "GridPoisson"]

Face = Any  # a number or an array
AXES = "xyz"


class GridPoisson(Pickled):
    """Negative Laplacian on the FLUID cells of a grid ([Book] 1.3.1), with general face coefficients.

    (A x)_i = sum over i's open faces of c_f (x_i - x_neighbor) + shift_i x_i, with x = 0 in AIR and in SOLID. A face with SOLID on a side
    is closed; outside the array is SOLID unless the axis is periodic. Numbers as coefficients keep the fast kernels: equal ones and no
    shift need one byte a cell.

    Args:
        cells: integers AIR = 0, FLUID = 1, SOLID = 2, shape (nz, ny, nx) or (ny, nx); numpy or wp.array. Unknowns live on FLUID cells,
            fields have the shape of `cells`, but on the CPU their memory is taken only near rows that have held FLUID cells.
        face_x: c_f >= 0 of the faces normal to x: a number or an array (nz, ny, nx + 1), or (ny, nx + 1) in 2-D.
        face_y: likewise, (nz, ny + 1, nx).
        face_z: likewise, (nz + 1, ny, nx); 2-D has none.
        shift: None, a number or an array of the shape of `cells`, >= 0.
            Face coefficients and shift may also be given in the padded shape (nz + 2, ny + 2, nx + 2), as wp.array of type `dtype` on
            the operator's device, a face's coefficient with the cell above it: they are then used in place and read again by `update`.
        periodic: whether x, y, z wrap around.
        device: Warp device; that of `cells` or the default device if None.
        dtype: storage of coefficients, wp.float32 or wp.float64. In float32 unequal coefficients and their sums are rounded, so that the
            problem solved is another one by about 1e-7 of the diagonal: for tolerances near that, and for closed domains with such
            coefficients, take wp.float64. Equal coefficients without a shift are not rounded.

    Attributes:
        cells: cell types with one layer of SOLID ghost cells, shape (nz + 2, ny + 2, nx + 2).
        cells_around: the same with ghost cells of periodic axes filled; `cells` itself where no axis is periodic.
        stencil: the diagonal and the weights on that padded grid.
        version: how often the cells have been taken; memory that holds something outside the rows' spans is cleared when it changes.

    Raises:
        ValueError: an argument has a wrong shape, type or sign, or is not finite; the message names it.

    Example:
        >>> import numpy as np, warp_lcp as wl
        >>> A = wl.GridPoisson(np.array([[wl.FLUID, wl.FLUID, wl.AIR]]), device="cpu")
        >>> print(A.diagonal().numpy())
        [[1. 2. 0.]]
        >>> print(A.apply(wp.array([[1.0, 3.0, 9.0]], dtype=wp.float64, device="cpu")).numpy())
        [[-2.  5.  0.]]
    """

    symmetric = True
    _ghosts: Ghosts | None = None  # of a box of cells among others
    _across: Across | None = None

    def __init__(
        self, cells: Any, *, face_x: Face = 1.0, face_y: Face = 1.0, face_z: Face = 1.0, shift: Any = None,
        periodic: tuple[bool, ...] = (False, False, False), device: Any = None, dtype: Any = wp.float32,
    ) -> None:  # fmt: skip
        if dtype not in (wp.float32, wp.float64):
            raise ValueError(f"dtype = {dtype}: must be wp.float32 or wp.float64")
        host = _checked_cells(cells)
        self.device = wp.get_device(device if device is not None else cells.device if isinstance(cells, wp.array) else None)
        self.dtype, self.shape = dtype, host.shape
        self.layout = PaddedLayout(host.shape, self.device, self._across)
        counts = self.layout.padding.counts
        flags = (*(bool(p) for p in periodic), False, False, False)[:3]
        self.periodic = (flags[0] and counts[2] > 1, flags[1] and counts[1] > 1, flags[2] and counts[0] > 1)
        given = (face_x, face_y, face_z if host.ndim == 3 else 1.0)
        faces = [f if isinstance(f, wp.array) else real_array(f, f"face_{axis}") for f, axis in zip(given, AXES, strict=True)]
        numbers = [float(f) if f.ndim == 0 else 0.0 for f in faces]
        self.uniform = (numbers[0], numbers[1], numbers[2])
        self._given = {f"face_{axis}": tuple(f.shape) for axis, f in zip(AXES, faces, strict=True)}
        self._given |= {} if shift is None else {"shift": tuple(np.shape(shift))}
        self.faces = [self._stored_face(f, axis) for axis, f in enumerate(faces)]
        self.shift = self._stored_shift(shift)
        self._check_sums()
        padded = np.full(self.layout.stored_shape, SOLID, dtype=np.int8)
        padded[1:-1, 1:-1, 1:-1] = host.reshape(counts)
        self.cells = wp.array(padded, device=self.device, copy=self.device.is_cuda)
        self.cells_around = wp.zeros_like(self.cells) if any(self.periodic) or self._ghosts is not None else self.cells
        self._spans, self._reach = (wp.zeros(counts[:2], dtype=wp.vec2i, device=self.device) for _ in range(2))
        whole = self.device.is_cuda or self.cells_around is not self.cells or self.layout.size < LARGE
        chunks = 0 if whole else -(-self.layout.size // CPU_CHUNK)
        self._chunks = wp.zeros((chunks, 1), dtype=wp.vec2i, device=self.device)
        self.layout.chunks = self._chunks if chunks else None
        self._find_rows()
        self.layout.find_use(self._reach.numpy()[..., 1] > 0)
        self.version = 0
        self.stencil = self._empty_stencil()
        self._mask: wp.array[Any] | None = None
        self._finder: ComponentFinder | None = None
        self._fill_stencil()

    @classmethod
    def from_cells(cls, shape: Sequence[int], fluid: Any, solid: Any = (), **options: Any) -> GridPoisson:
        """Make the operator of a grid from lists of its FLUID and SOLID cells, the others being AIR.

        Args:
            shape: cells along each axis, (nz, ny, nx) or (ny, nx).
            fluid: indices of FLUID cells, integers of shape (n, 3), a row (k, j, i) a cell as it is found in fields, or (n, 2) in 2-D;
                numpy or wp.array. The order of the cells does not matter; lists in the order of memory are taken fastest.
            solid: likewise of SOLID cells.
            options: all that the class takes beside `cells`.

        Raises:
            ValueError: a list has another shape or type, a cell is not in the grid, is listed twice or in both lists; the message names it.

        Example:
            >>> import warp_lcp as wl
            >>> A = wl.GridPoisson.from_cells((1, 1, 3), fluid=[(0, 0, 0), (0, 0, 1)], device="cpu")
            >>> print(A.diagonal().numpy())
            [[[1. 2. 0.]]]
        """
        return cls(cells=cells_of(shape, fluid, solid), **options)

    def update(self, cells: wp.array[Any]) -> None:
        """Take new cell types, and what face coefficients and shift in padded arrays have become, in place and without allocating.

        Args:
            cells: wp.int8 array on the operator's device, of its shape (3-D) or of the padded shape (nz + 2, ny + 2, nx + 2), whose
                outer layer is ignored.

        Raises:
            ValueError: type, device or shape differ.
        """
        padded, counts = self.layout.stored_shape, self.layout.padding.counts
        if not isinstance(cells, wp.array) or cells.dtype is not wp.int8 or cells.device != self.device:
            raise ValueError(f"cells: expected a wp.int8 array on {self.device}")
        if tuple(cells.shape) == self.shape != padded:
            wp.copy(self.cells[1:-1, 1:-1, 1:-1], cells.reshape(counts))
            cells = self.cells
        elif tuple(cells.shape) != padded:
            raise ValueError(f"cells has shape {tuple(cells.shape)}: expected {self.shape} or {padded}")
        self._refill(cells)

    def apply(self, x: wp.array[Any], out: wp.array[Any] | None = None) -> wp.array[Any]:
        """Return A x.

        Args:
            x: field of type wp.float32 or wp.float64, of the operator's shape or stored (padded, flat or not, 0 off the FLUID cells).
            out: field like x that receives the product; made if None.
        """
        if x.size == self.layout.size:
            if out is None:
                out = wp.zeros_like(x)
            else:
                out.zero_()
            self.stencil.product(x.flatten(), out.flatten())
            return out
        stored = self.layout.load(x, x.dtype, "x")
        inside = self.cells.numpy().ravel() == FLUID if self._mask is None else self._mask.numpy() != 0
        stored = wp.array(np.where(inside, stored.numpy(), 0), dtype=x.dtype, device=self.device)
        product = self.layout.unload(self.apply(stored))
        if out is None:
            return product
        wp.copy(out, product)
        return out

    apply_transpose = apply  # A is symmetric

    def apply_plus(self, x: wp.array[Any], b: wp.array[Any], out: wp.array[Any]) -> None:
        """out = A x + b in one pass; stored fields of one type."""
        self.stencil.product(x, out, plus=b)

    def relax(self, x: Any, b: Any, lower: Any, upper: Any, omega: float, *, forward: bool = True) -> None:
        """Sweep stored fields once, red cells then black ones (forward) or the reverse, each unknown projected onto its bounds."""
        self.stencil.relax(x, b, lower, upper, omega, forward=forward)

    def coefficient_gradient(self, multiplier: wp.array[Any], x: wp.array[Any]) -> dict[str, Any]:
        """Return (mu_i - mu_j) (x_i - x_j) of each face and mu_i x_i of the shift.

        0 on closed faces; x = mu = 0 in AIR. The first and the last faces of a periodic axis, which are one, have half of it each.
        """
        if self._mask is not None:
            raise ValueError("a masked operator has no coefficients of its own: take the one it was made from")
        s, arrays = self.stencil, {name: shape for name, shape in self._given.items() if shape}
        for field in (multiplier, x):
            s.wrap(field)
        fields: dict[str, Any] = {"cells": self.cells_around.flatten(), "multiplier": multiplier, "x": x}
        found: dict[str, Any] = {}
        if len(arrays) < len(self._given):
            totals = Sums(Rows.of(self.layout.padding, self.device), 4)
            values = totals.of(FACE_GRADIENT, **fields | dict.fromkeys(FACE_GRADIENT.writes)).tolist()
            found = dict(zip(FACE_GRADIENT.writes, values, strict=True))
        if arrays:
            rows = Rows.of(self.layout.padding, self.device, more=1)
            written = {name: self.layout.zeros(wp.float64) if name in arrays else None for name in FACE_GRADIENT.writes}
            partials = wp.empty(4 * rows.places, dtype=wp.float64, device=self.device)
            FACE_GRADIENT.bind(rows, **fields, **written, out=partials).launch()
            found |= {name: self._coefficient_field(name, written[name], shape) for name, shape in arrays.items()}
        return {name: found.get(name) if name in self._given else None for name in FACE_GRADIENT.writes}

    def _coefficient_field(self, name: str, stored: wp.array[Any], shape: tuple[int, ...]) -> wp.array[Any]:
        """Return a stored field of coefficients, lower faces' ones, in the shape that was given."""
        values = stored.numpy().reshape(self.layout.stored_shape)
        inner, axis = [slice(1, -1)] * 3, -1 if name == "shift" else AXES.index(name[-1])
        if axis >= 0:
            inner[2 - axis] = slice(1, None)
        part = values[tuple(inner)]
        if axis >= 0 and self.periodic[axis]:
            np.moveaxis(part, 2 - axis, 0)[[0, -1]] *= 0.5
        if shape == self.layout.stored_shape:  # padded: of other ghost cells nothing was asked
            kept = np.zeros(shape)
            kept[tuple(inner)] = part
            part = kept
        return wp.array(np.ascontiguousarray(part).reshape(shape), dtype=wp.float64, device=self.device, copy=self.device.is_cuda)

    def floating_components(self, scratch: Scratch | None = None) -> FloatingComponents | None:
        """Return the components on which A is singular, or None if there are none.

        Args:
            scratch: stored fields, of 4-byte elements and of bytes, that may be overwritten on the rows' spans; saves as much memory.
        """
        return self.component_finder.find(scratch)

    @property
    def component_finder(self) -> ComponentFinder:
        """What finds floating components."""
        if self._finder is None:
            self._finder = self._component_finder()
        return self._finder

    def _component_finder(self) -> ComponentFinder:
        return ComponentFinder(self)

    def diagonal(self) -> wp.array[Any]:
        """Return the diagonal of A, a field of the operator's shape and type; 0 off the FLUID cells."""
        d = self.stencil.d.numpy().astype(np.float64) * self.stencil.unit
        inner = d.reshape(self.layout.stored_shape)[1:-1, 1:-1, 1:-1]
        return wp.array(inner.reshape(self.shape), dtype=self.dtype, device=self.device)

    def masked(self, free: Any, shift: Any = None) -> GridPoisson:
        """Return the principal system P A P + P D P, P the restriction to `free` (non-zero entries) and D = diag(shift), shift >= 0."""
        mask = (self.layout.load(free, wp.uint8, "free").numpy() != 0) & (self.cells.numpy().ravel() == FLUID)
        twin = copy.copy(self)
        twin._mask, twin._finder = wp.array(mask.astype(np.uint8), device=self.device), None
        d, kind = self.stencil.d.numpy(), self.stencil.d.dtype
        if shift is not None:
            kind = self.dtype
            d = self.stencil.unit * d.astype(np.float64) + self.layout.load(shift, kind, "shift").numpy()
        new = wp.array(np.where(mask, d, 0), dtype=kind, device=self.device)
        twin.stencil = self.stencil.with_diagonal(new)
        return twin

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle cells and coefficients; these come back in the padded shape.

        Raises:
            TypeError: it is a part of a grid that ranks share, or a principal system.
        """
        if self.layout.across is not None:
            raise TypeError(f"{type(self).__name__} is a part of a grid that ranks share: pickle its cells and coefficients on each rank")
        if self._mask is not None:
            raise TypeError("a masked operator is not pickled: pickle the one it was made from, and mask that again")
        faces = {f"face_{axis}": OnHost(f) if f.size else c for axis, f, c in zip(AXES, self.faces, self.uniform, strict=True)}
        shift = OnHost(self.shift) if self.shift.size else None
        cells = self.cells.numpy()[1:-1, 1:-1, 1:-1].reshape(self.shape).copy()
        options = {**faces, "shift": shift, "periodic": self.periodic, "dtype": self.dtype}
        return made_again(GridPoisson, cells, device=self.device, **options)

    @property
    def unknowns(self) -> int:
        """Number of FLUID cells, those of ghosts not counted."""
        return sum(int(np.count_nonzero(plane == FLUID)) for plane in self.cells.numpy()[1:-1, 1:-1, 1:-1])

    def _stored_face(self, face: Face, axis: int) -> wp.array[Any]:
        """Return the coefficients of lower faces as a padded array, or an empty array for a number."""
        name = f"face_{AXES[axis]}"
        if face.ndim == 0:
            _check_coefficients(face, self.dtype, name)
            return wp.empty((0, 0, 0), dtype=self.dtype, device=self.device)
        if self._in_place(face, name):
            return face
        host = real_array(face, name)
        expected = list(self.shape)
        expected[-1 - axis] += 1
        if host.shape != tuple(expected):
            raise ValueError(f"{name} has shape {host.shape}: expected {tuple(expected)} for cells of shape {self.shape}")
        _check_coefficients(host, self.dtype, name)
        if self.periodic[axis] and not np.array_equal(host.take(0, -1 - axis), host.take(-1, -1 - axis)):
            raise ValueError(f"{name}: the first and the last faces of a periodic axis are the same ones, but their coefficients differ")
        counts = [*self.layout.padding.counts]
        counts[2 - axis] += 1
        padding = [(1, 0) if a == 2 - axis else (1, 1) for a in range(3)]
        return wp.array(np.pad(host.reshape(counts), padding), dtype=self.dtype, device=self.device)

    def _in_place(self, field: Any, name: str) -> bool:
        """Return whether a coefficient field is the caller's padded array, after checking it."""
        if not isinstance(field, wp.array) or tuple(field.shape) != self.layout.stored_shape or self.layout.stored_shape == self.shape:
            return False
        if field.dtype is not self.dtype or field.device != self.device:
            raise ValueError(f"{name} in the padded shape must be of type {self.dtype.__name__} on {self.device}")
        _check_coefficients(field.numpy(), self.dtype, name)
        return True

    def _stored_shift(self, shift: Any) -> wp.array[Any]:
        if shift is None:
            return wp.empty((0, 0, 0), dtype=self.dtype, device=self.device)
        if self._in_place(shift, "shift"):
            return shift
        host = real_array(shift, "shift")
        host = np.full(self.shape, host) if host.ndim == 0 else host
        if host.shape != self.shape:
            raise ValueError(f"shift has shape {host.shape}: expected {self.shape}")
        _check_coefficients(host, self.dtype, "shift")
        return wp.array(np.pad(host.reshape(self.layout.padding.counts), 1), dtype=self.dtype, device=self.device)

    def _check_sums(self) -> None:
        """Refuse coefficients that the type holds, but perhaps not their sums, which are the diagonal."""
        parts = zip([*self.faces, self.shift], [*self.uniform, 0.0], strict=True)
        *faces, shift = (float(f.numpy().max()) if f.size else number for f, number in parts)
        most, name = 2 * sum(faces) + shift, self.dtype.__name__
        if most > float(np.finfo(wp.dtype_to_numpy(self.dtype)).max):
            raise ValueError(f"face_x, face_y, face_z and shift add up to {most:.1e}, too large for {name}: pass dtype=wp.float64")

    @property
    def _counts_faces(self) -> bool:
        """Whether the diagonal is a number of open faces times one coefficient."""
        used = [c for c, n in zip(self.uniform, reversed(self.layout.padding.counts), strict=True) if c > 0 and n > 1]
        return not self._has_arrays and self.shift.size == 0 and len(set(used)) <= 1

    @property
    def _has_arrays(self) -> bool:
        return any(f.size > 0 for f in self.faces)

    def _empty_stencil(self) -> Stencil:
        layout, counts = self.layout, self._counts_faces
        strength: Any = tuple(map(self._mean_coefficient, self.faces, self.uniform))
        weights: Any = tuple(layout.zeros(self.dtype) for _ in AXES) if self._has_arrays else None
        used = [c for c, n in zip(self.uniform, reversed(layout.padding.counts), strict=True) if n > 1]
        unit = (max(used, default=1.0) or 1.0) if counts else 1.0
        d = layout.zeros(wp.uint8 if counts else self.dtype)
        return Stencil(layout.padding, d, weights, self.uniform, unit, self.periodic, self._spans, strength, self._ghosts)

    def _mean_coefficient(self, face: wp.array[Any], uniform: float) -> float:
        """Return the mean of the coefficients that are not 0."""
        if face.size == 0:
            return uniform
        values, across = face.numpy(), self.layout.across
        sums = np.array([values.sum(dtype=np.float64), np.count_nonzero(values)])
        total, count = sums if across is None else across.sum(sums)
        return float(total / max(count, 1))

    def _refill(self, cells: wp.array[Any]) -> None:
        """Take padded cell types and compute diagonal and weights."""
        if cells is not self.cells:
            COPY_CELLS.bind(Rows.of(self.layout.padding, self.device), source=cells.flatten(), to=self.cells.flatten()).launch()
        self._find_rows()
        self._fill_stencil()

    def _find_rows(self) -> None:
        """Find what of each row is in use."""
        counts = self.layout.padding.counts
        wp.launch(find_spans_kernel, counts[:2], [self.cells, counts[2], self._spans, self._reach, self._chunks], device=self.device)

    def _fill_stencil(self) -> None:
        """Compute diagonal and weights, on rows that are in use or have been."""
        s, padding, reach = self.stencil, self.layout.padding, self._rows_in_reach
        self.version += 1
        if self.cells_around is not self.cells:
            wp.copy(self.cells_around, self.cells)
            s.wrap(self.cells_around)
        around = {"cells": self.cells_around.flatten()}
        if self._counts_faces:
            axes: dict[str, Any] = {f"around_{a}": c > 0 for a, c in zip(AXES, self.uniform, strict=True)}
            COUNT_FACES.bind(reach, **around, diagonal=s.d, **axes).launch()
            return
        faces: dict[str, Any] = {}
        for axis, field, number in zip(AXES, self.faces, self.uniform, strict=True):
            faces |= {f"f{axis}": field.flatten() if field.size else None, f"n{axis}": number, f"FIELD_{axis.upper()}": field.size > 0}
        shift = self.shift.flatten() if self.shift.size else None
        DIAGONAL.bind(reach, **around, **faces, shift=shift, SHIFTED=self.shift.size > 0, diagonal=s.d).launch()
        if s.weights is not None:
            weights = dict(zip(("wx", "wy", "wz"), s.weights, strict=True))
            WEIGHTS.bind(Rows.of(padding, self.device, more=1), **around, **faces, **weights).launch()

    @cached_property
    def _rows_in_reach(self) -> Rows:
        return Rows.of(self.layout.padding, self.device, self._reach)


def _checked_cells(cells: Any) -> np.ndarray:
    """Return cell types as a host array."""
    host = real_array(cells, "cells")
    if host.ndim not in (2, 3) or host.size == 0:
        raise ValueError(f"cells has shape {host.shape}: expected (nz, ny, nx) or (ny, nx) with at least one cell")
    if not np.issubdtype(host.dtype, np.integer):
        raise ValueError(f"cells has type {host.dtype}: expected integers AIR = {AIR}, FLUID = {FLUID}, SOLID = {SOLID}")
    if host.min() < AIR or host.max() > SOLID:
        raise ValueError(f"cells has values from {host.min()} to {host.max()}: allowed are AIR = {AIR}, FLUID = {FLUID}, SOLID = {SOLID}")
    return host


def _check_coefficients(values: np.ndarray, dtype: Any, name: str) -> None:
    check_storable(values, dtype, name)
    check_kept(values, dtype, name)
    if (values < 0).any():
        raise ValueError(f"{name} holds a negative value ({values.min()}): coefficients must be >= 0")
