"""Matrix-free Poisson operator of a grid of cells.

For pressure solves, obstacle problems and density corrections.
"""

from __future__ import annotations

import copy
from collections.abc import Hashable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias, TypedDict

import numpy as np
import warp as wp

from warp_lcp.kernels import KernelFile, Rows
from warp_lcp.kernels.fields import Array, overwrite, real_array
from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.kernels.vectors import RowReduction
from warp_lcp.operators.components import (
    ComponentFinder,
    FaceCoefficients,
    FloatingComponents,
    Scratch,
)
from warp_lcp.operators.grid_operator import GridOperator, check_coefficients
from warp_lcp.operators.padded_stencil import CellDecomposition, PaddedStencil
from warp_lcp.problem.data_types import Values
from warp_lcp.problem.operator_protocol import AIR, FLUID, SOLID, Derivatives
from warp_lcp.problem.pickling import HostArrayPickle, Reduced, rebuilt_from

KERNELS = KernelFile(Path(__file__).parent / "headers/grid_poisson.h")
COUNT_FACES = KERNELS["grid_poisson.count_faces"]
DIAGONAL = KERNELS["grid_poisson.diagonal"]
WEIGHTS = KERNELS["grid_poisson.weights"]
FACE_GRADIENT = KERNELS["grid_poisson.face_gradient"]


__all__ = ["AIR", "FLUID", "SOLID", "GridPoisson"]

Face: TypeAlias = Array | float  # of all faces along an axis, or one number


class PoissonArguments(TypedDict, total=False):
    """Coefficients and periodic axes of `GridPoisson`, see there."""

    face_x: Face
    face_y: Face
    face_z: Face
    shift: Array | float | None
    periodic: tuple[bool, ...]


AXES = "xyz"


class GridPoisson(GridOperator):
    """Negative Laplacian on the FLUID cells of a grid, with face coefficients.

    [Book] 1.3.1.

    (A x)_i = sum over i's open faces of c_f (x_i - x_neighbor) + shift_i x_i, with x = 0 in AIR and
    in SOLID. A face with SOLID on a side is closed; outside the array is SOLID unless the axis is
    periodic. Coefficients that are numbers keep the fast kernels: equal ones and no shift need one
    byte a cell.

    Args:
        cells: integers AIR = 0, FLUID = 1, SOLID = 2, shape (nz, ny, nx) or (ny, nx); numpy or
            wp.array. Unknowns are on FLUID cells, fields have the shape of `cells`, but on the CPU
            their memory is used only near rows that have had FLUID cells.
        face_x: c_f >= 0 of the faces normal to x: a number or an array (nz, ny, nx + 1), or (ny, nx
            + 1) in 2-D.
        face_y: likewise, (nz, ny + 1, nx).
        face_z: likewise, (nz + 1, ny, nx); 2-D has none.
        shift: None, a number or an array of the shape of `cells`, >= 0. Face coefficients and shift
            may also be given in the padded shape (nz + 2, ny + 2, nx + 2), as wp.array of type
            `dtype` on the operator's device, a face's coefficient with the cell above it: they are
            then used in place and read again by `update`.
        periodic: whether x, y, z wrap around.
        decomposition: boxes of cells, one for each rank (`warp_lcp.distributed.Decomposition`). All
            arguments and fields are then those of this rank's box, coefficients of its upper faces
            included. An `LCP` with the operator is one problem of all ranks. Its construction and
            `wl.solve` are collective: each rank gets its box of x, and status, residual and history
            of the whole.
        device: Warp device; that of `cells` or the default device if None.
        dtype: storage of coefficients, wp.float32 or wp.float64. In float32 unequal coefficients
            and their sums are rounded, which changes the problem by about 1e-7 of the diagonal: use
            wp.float64 for closed domains with such coefficients, and for tolerances below the
            rounding, where the status is FLOOR. Equal coefficients without a shift are not rounded.

    Raises:
        ValueError: an argument has a wrong shape, type or sign, or is not finite; the message names
            it. With a decomposition, on all ranks, also if the kinds of arguments differ, an axis
            is periodic, or a box is one cell thin at a cut.

    Example:
        >>> import numpy as np, warp_lcp as wl
        >>> A = wl.GridPoisson(np.array([[wl.FLUID, wl.FLUID, wl.AIR]]), device="cpu")
        >>> print(A.diagonal().numpy())
        [[1. 2. 0.]]
        >>> print(A.apply(wp.array([[1.0, 3.0, 9.0]], dtype=wp.float64, device="cpu")).numpy())
        [[-2.  5.  0.]]
    """

    def __init__(
        self,
        cells: Values,
        *,
        face_x: Face = 1.0,
        face_y: Face = 1.0,
        face_z: Face = 1.0,
        shift: Values | None = None,
        periodic: tuple[bool, ...] = (False, False, False),
        device: wp.DeviceLike = None,
        dtype: DataType = wp.float32,
        decomposition: CellDecomposition | None = None,
    ) -> None:
        coefficients, self.decomposition = (
            {"face_x": face_x, "face_y": face_y, "face_z": face_z, "shift": shift},
            decomposition,
        )
        if decomposition is None:
            super().__init__(cells, coefficients, periodic, device, dtype)
            return
        decomposition.check_operator(np.shape(cells), periodic, coefficients)
        self._ghosts, self._comm = decomposition.ghosts, decomposition.comm
        with decomposition.together():
            super().__init__(cells, coefficients, periodic, device, dtype)

    def _take_coefficients(
        self, cells: np.ndarray, *, face_x: Face, face_y: Face, face_z: Face, shift: Values | None
    ) -> None:
        """Store face coefficients and shift, numbers as numbers."""
        given = (face_x, face_y, face_z if cells.ndim == 3 else 1.0)
        faces = [
            f if isinstance(f, wp.array) else real_array(f, f"face_{axis}")
            for f, axis in zip(given, AXES, strict=True)
        ]
        numbers = [float(f) if f.ndim == 0 else 0.0 for f in faces]
        self.uniform = (numbers[0], numbers[1], numbers[2])
        self._given = {f"face_{axis}": tuple(f.shape) for axis, f in zip(AXES, faces, strict=True)}
        self._given |= {} if shift is None else {"shift": tuple(np.shape(shift))}
        self.faces = [self._stored_face(f, axis) for axis, f in enumerate(faces)]
        self.shift = self._stored_shift(shift)
        self._check_sums()

    def coefficient_gradient(self, multiplier: DeviceArray, x: DeviceArray) -> Derivatives:
        """Return the derivatives of mu'A x by face coefficients and shift.

        (mu_i - mu_j) (x_i - x_j) of each face and mu_i x_i of the shift.

        0 on closed faces; x = mu = 0 in AIR. The first and the last faces of a periodic axis are
        the same faces, and each has half of the derivative.
        """
        self._check_own()
        s, arrays = self.stencil, {name: shape for name, shape in self._given.items() if shape}
        for field in (multiplier, x):
            s.wrap(field)
        cells = self.cells_around.flatten()
        derivatives: Derivatives = {}
        if len(arrays) < len(self._given):
            totals = RowReduction(Rows.of(self.layout.padding, self.device), 4)
            values = totals.of(
                FACE_GRADIENT,
                cells=cells,
                multiplier=multiplier,
                x=x,
                face_x=None,
                face_y=None,
                face_z=None,
                shift=None,
            ).tolist()
            derivatives = dict(zip(FACE_GRADIENT.writes, values, strict=True))
        if arrays:
            rows = Rows.of(self.layout.padding, self.device, more=1)
            written = {
                name: self.layout.zeros(wp.float64) if name in arrays else None
                for name in FACE_GRADIENT.writes
            }
            partials = wp.empty(4 * rows.places, dtype=wp.float64, device=self.device)
            face_x, face_y, face_z, shift = (
                written[name] for name in ("face_x", "face_y", "face_z", "shift")
            )
            FACE_GRADIENT.bind(
                rows,
                cells=cells,
                multiplier=multiplier,
                x=x,
                face_x=face_x,
                face_y=face_y,
                face_z=face_z,
                shift=shift,
                out=partials,
            ).launch()
            derivatives |= {
                name: self._coefficient_field(name, written[name], shape)
                for name, shape in arrays.items()
            }
        return {
            name: derivatives.get(name) if name in self._given else None
            for name in FACE_GRADIENT.writes
        }

    def _coefficient_field(
        self, name: str, stored: DeviceArray, shape: tuple[int, ...]
    ) -> DeviceArray:
        """Return a stored field of coefficients in the shape that was given.

        The field has those of lower faces.
        """
        values = stored.numpy().reshape(self.layout.stored_shape)
        inner, axis = [slice(1, -1)] * 3, -1 if name == "shift" else AXES.index(name[-1])
        if axis >= 0:
            inner[2 - axis] = slice(1, None)
        part = values[tuple(inner)]
        if axis >= 0 and self.periodic[axis]:
            np.moveaxis(part, 2 - axis, 0)[[0, -1]] *= 0.5
        if shape == self.layout.stored_shape:  # padded: other ghost cells are 0
            kept = np.zeros(shape)
            kept[tuple(inner)] = part
            part = kept
        return wp.array(
            np.ascontiguousarray(part).reshape(shape),
            dtype=wp.float64,
            device=self.device,
            copy=self.device.is_cuda,
        )

    def floating_components(self, scratch: Scratch | None = None) -> FloatingComponents | None:
        """Return the components on which A is singular, or None if there are none.

        Args:
            scratch: stored fields, of 4-byte elements and of bytes, that may be overwritten on the
                rows' spans; saves as much memory.
        """
        return self.component_finder.find(scratch)

    @property
    def component_finder(self) -> ComponentFinder:
        """Finder of floating components."""
        if self._finder is None:
            self._finder = ComponentFinder(self)
        return self._finder

    @property
    def form(self) -> Hashable | None:
        """Sizes, types and numbers of operators that can `take` each other's data.

        None if the operator has no copies: subclasses, principal systems, GPUs, ranks and large
        grids.
        """
        plain = (
            type(self) is GridPoisson
            and self._mask is None
            and self._ghosts is None
            and self.layout.comm is None
        )
        if not plain or self.device.is_cuda or self.layout.chunks is not None:
            return None
        s = self.stencil
        numbers = map(float.hex, map(float, (*self.uniform, s.unit, *(s.strength or ()))))
        sizes = tuple(field.size for field in (*self.faces, self.shift, *(s.weights or ())))
        return self.shape, self.periodic, self.dtype, s.d.dtype, sizes, *numbers

    def _held(self) -> list[DeviceArray]:
        """Return all arrays that a solve reads of the operator."""
        s = self.stencil
        return [
            self.cells,
            self.cells_around,
            self._spans,
            s.d,
            *(s.weights or ()),
            *self.faces,
            self.shift,
        ]

    def replica(self) -> GridPoisson:
        """Return a copy of the operator in its own memory."""
        twin = copy.copy(self)
        twin._refills, twin._finder = {}, None
        for cached in ("_search", "_rows_in_reach"):
            twin.__dict__.pop(cached, None)
        s, kept = self.stencil, {id(field): wp.clone(field) for field in self._held()}

        def copy_of(field: DeviceArray) -> DeviceArray:
            return kept[id(field)]

        twin.cells, twin.cells_around, twin._spans, twin.shift = map(
            copy_of, (self.cells, self.cells_around, self._spans, self.shift)
        )
        twin.faces, weights = (
            list(map(copy_of, self.faces)),
            None if s.weights is None else tuple(map(copy_of, s.weights)),
        )
        twin.stencil = replace(s, d=copy_of(s.d), weights=weights, spans=twin._spans)
        return twin

    def copy_from(self, other: GridPoisson) -> None:
        """Copy an operator of the same form."""
        for to, source in zip(self._held(), other._held(), strict=True):
            overwrite(to, source)
        self.version += 1

    def __reduce__(self) -> Reduced:
        """Pickle cells and coefficients; arrays are restored in the padded shape."""
        cells, options = self._pickled()
        given = {
            name: HostArrayPickle(v) if isinstance(v, wp.array) else v
            for name, v in self._arguments().items()
        }
        return rebuilt_from(GridPoisson, cells, device=self.device, **given, **options)

    def _arguments(self) -> dict[str, Any]:
        faces = {
            f"face_{axis}": f if f.size else c
            for axis, f, c in zip(AXES, self.faces, self.uniform, strict=True)
        }
        return faces | {"shift": self.shift if self.shift.size else None}

    def _stored_face(self, face: Array, axis: int) -> DeviceArray:
        """Return the coefficients of lower faces as a padded array.

        Face i lies between cells i - 1 and i, so an axis of n cells has n + 1 faces. The array of
        shape (nz + 2, ny + 2, nx + 2) has the lower face of each stored cell at the cell's index.
        Empty for a number.
        """
        name = f"face_{AXES[axis]}"
        if face.ndim == 0:
            check_coefficients(face, self.dtype, name)
            return wp.empty((0, 0, 0), dtype=self.dtype, device=self.device)
        if self._in_place(face, name):
            return face
        host = real_array(face, name)
        expected = list(self.shape)
        expected[-1 - axis] += 1
        if host.shape != tuple(expected):
            raise ValueError(
                f"{name} has shape {host.shape}: expected {tuple(expected)} for cells of shape "
                f"{self.shape}"
            )
        check_coefficients(host, self.dtype, name)
        self._note_rounding(host)
        if self.periodic[axis] and not np.array_equal(
            host.take(0, -1 - axis), host.take(-1, -1 - axis)
        ):
            raise ValueError(
                f"{name}: the first and the last faces of a periodic axis are the same faces, but "
                "their coefficients differ"
            )
        counts = [*self.layout.padding.counts]
        counts[2 - axis] += 1
        padding = [(1, 0) if a == 2 - axis else (1, 1) for a in range(3)]
        return wp.array(np.pad(host.reshape(counts), padding), dtype=self.dtype, device=self.device)

    def _check_sums(self) -> None:
        """Refuse coefficients whose sums, the diagonal, may overflow their type."""
        parts = zip([*self.faces, self.shift], [*self.uniform, 0.0], strict=True)
        *faces, shift = (float(f.numpy().max()) if f.size else number for f, number in parts)
        most, name = 2 * sum(faces) + shift, self.dtype.__name__
        if most > float(np.finfo(wp.dtype_to_numpy(self.dtype)).max):
            raise ValueError(
                f"face_x, face_y, face_z and shift add up to {most:.1e}, too large for {name}: "
                "pass dtype=wp.float64"
            )

    @property
    def _counts_faces(self) -> bool:
        """Whether the diagonal is a number of open faces times one coefficient."""
        used = [
            c
            for c, n in zip(self.uniform, reversed(self.layout.padding.counts), strict=True)
            if c > 0 and n > 1
        ]
        return not self._has_arrays and self.shift.size == 0 and len(set(used)) <= 1

    @property
    def _has_arrays(self) -> bool:
        return any(f.size > 0 for f in self.faces)

    def _empty_stencil(self) -> PaddedStencil:
        """Allocate the stencil: a count of faces in one byte if coefficients allow it."""
        layout, counts = self.layout, self._counts_faces
        along_x, along_y, along_z = map(self._mean_coefficient, self.faces, self.uniform)
        weights = tuple(layout.zeros(self.dtype) for _ in AXES) if self._has_arrays else None
        used = [
            c for c, n in zip(self.uniform, reversed(layout.padding.counts), strict=True) if n > 1
        ]
        unit = (max(used, default=1.0) or 1.0) if counts else 1.0
        d = layout.zeros(wp.uint8 if counts else self.dtype)
        return PaddedStencil(
            layout.padding,
            d,
            weights,
            self.uniform,
            unit,
            self.periodic,
            self._spans,
            (along_x, along_y, along_z),
            self._ghosts,
        )

    def _mean_coefficient(self, face: DeviceArray, uniform: float) -> float:
        """Return the mean of the coefficients that are not 0."""
        if face.size == 0:
            return uniform
        values, comm = face.numpy(), self.layout.comm
        sums = np.array([values.sum(dtype=np.float64), np.count_nonzero(values)])
        total, count = sums if comm is None else comm.sum(sums)
        return float(total / max(count, 1))

    @property
    def face_coefficients(self) -> FaceCoefficients:
        """Coefficients of the faces as kernel arguments."""
        fx, fy, fz = (f.flatten() if f.size else None for f in self.faces)
        return FaceCoefficients(fx, fy, fz, *self.uniform)

    records = True

    def _fill_stencil(self) -> None:
        """Compute diagonal and weights on the current and former rows in use.

        The diagonal is the number of open faces times one coefficient, if possible; else the sum of
        the coefficients of open faces and the shift.
        """
        s, padding, reach = self.stencil, self.layout.padding, self._rows_in_reach
        self._wrap_cells()
        cells = self.cells_around.flatten()
        if self._counts_faces:
            x, y, z = (c > 0 for c in self.uniform)
            COUNT_FACES.bind(
                reach, cells=cells, diagonal=s.d, around_x=x, around_y=y, around_z=z
            ).launch()
            return
        faces = self.face_coefficients
        x, y, z = (f.size > 0 for f in self.faces)
        shift = self.shift.flatten() if self.shift.size else None
        DIAGONAL.bind(
            reach,
            faces,
            cells=cells,
            shift=shift,
            diagonal=s.d,
            FIELD_X=x,
            FIELD_Y=y,
            FIELD_Z=z,
            SHIFTED=self.shift.size > 0,
        ).launch()
        if s.weights is not None:
            rows, (wx, wy, wz) = Rows.of(padding, self.device, more=1), s.weights
            WEIGHTS.bind(
                rows, faces, cells=cells, wx=wx, wy=wy, wz=wz, FIELD_X=x, FIELD_Y=y, FIELD_Z=z
            ).launch()
