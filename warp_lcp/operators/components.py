"""Floating components: connected FLUID cells on which A is singular.

They have neither AIR neighbors nor a shift; their null space is the constants.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, no_type_check

import numpy as np
import scipy.sparse.csgraph
import scipy.sparse.linalg
import warp as wp

from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.launch_graph import Launch, clear, together
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.problem.operator_protocol import FLUID

options: dict[str, str] = {"module": "warp_lcp.components"}
F64, I32 = wp.array(dtype=wp.float64), wp.array(dtype=wp.int32)


@no_type_check
@forward_kernel(**options)
def component_sums_kernel(
    label: I32, free: wp.array(dtype=wp.uint8), r: wp.array(dtype=Any), sums: F64, held: I32
):
    """Sum r over each component; mark those with an unknown that is not free."""
    i = wp.tid()
    c = label[i]
    if c >= 0:
        if free[i] != wp.uint8(0):
            wp.atomic_add(sums, c, wp.float64(r[i]))
        else:
            held[c] = 1


@no_type_check
@forward_kernel(**options)
def remove_means_kernel(label: I32, sums: F64, held: I32, sizes: F64, r: wp.array(dtype=Any)):
    """Subtract the mean of r from every component that is free as a whole."""
    i = wp.tid()
    c = label[i]
    if c >= 0:
        if held[c] == 0:
            r[i] = r[i] - r.dtype(sums[c] / sizes[c])


@no_type_check
@forward_kernel(**options)
def smallest_gap_kernel(label: I32, x: F64, lower: F64, upper: F64, below: F64, above: F64):
    """Compute the smallest distances to the bounds over each component.

    `below` is that to the lower, `above` that to the upper bounds.
    """
    i = wp.tid()
    c = label[i]
    if c >= 0:
        wp.atomic_min(below, c, x[i] - lower[i])
        wp.atomic_min(above, c, upper[i] - x[i])


@no_type_check
@forward_kernel(**options)
def shift_components_kernel(label: I32, held: I32, constant: F64, lower: F64, upper: F64, x: F64):
    """Add each component's constant, where the component is free as a whole.

    The result is projected onto the bounds, because the sum is rounded.
    """
    i = wp.tid()
    c = label[i]
    if c >= 0:
        if held[c] == 0:
            x[i] = wp.clamp(x[i] + constant[c], lower[i], upper[i])


for _T in (wp.float32, wp.float64):
    wp.overload(
        component_sums_kernel, [I32, wp.array(dtype=wp.uint8), wp.array(dtype=_T), F64, I32]
    )
    wp.overload(remove_means_kernel, [I32, F64, I32, F64, wp.array(dtype=_T)])


if TYPE_CHECKING:
    from warp_lcp.kernels.vectors import Communicator
    from warp_lcp.operators.grid_poisson import GridPoisson


Scratch = tuple[DeviceArray, DeviceArray]
ROUNDED = 1e-10  # relative to the terms of a sum whose weights were computed


@dataclass(frozen=True, slots=True)
class FaceCoefficients:
    """Coefficients of the lower faces of cells.

    Attributes:
        fx: along x, a stored field; None: `nx` everywhere.
        fy: along y; None: `ny`.
        fz: along z; None: `nz`.
        nx: number for all faces along x.
        ny: likewise along y.
        nz: likewise along z.
    """

    fx: DeviceArray | None
    fy: DeviceArray | None
    fz: DeviceArray | None
    nx: float
    ny: float
    nz: float


KERNELS = KernelFile(Path(__file__).parent / "headers/components.h")
SINGLETONS = KERNELS["components.singletons"]
UNITE = KERNELS["components.unite"]
GROUND = KERNELS["components.ground"]
COUNT = KERNELS["components.count"]


class FloatingComponents:
    """The floating components of an operator, numbered from 0.

    They make solves well posed. Summing y = A x + b over such a component leaves the sum of b:
    without bounds a solution exists only if that is 0, with lower bounds alone only if it is >= 0,
    with upper bounds alone only if it is <= 0. Where A is not symmetric, sums are weighted by w > 0
    with w'A = 0, and A v = 0 with v > 0 replaces the constants; both by components, on the host.

    Args:
        label: component of each stored cell, -1 where there is none.
        device: of the fields.
        comm: communicator if components reach over several ranks; None if serial.
        left: w, a flat stored field; None: 1.
        right: v, likewise.
    """

    def __init__(
        self,
        label: np.ndarray,
        device: wp.Device,
        comm: Communicator | None = None,
        *,
        left: np.ndarray | None = None,
        right: np.ndarray | None = None,
    ) -> None:
        self.device, self.label, self._comm = device, label, comm
        self.left, self.right = left, right
        self.count = int(self._largest(label.max())) + 1
        self.sizes = self._total(
            np.bincount(label[label >= 0], minlength=self.count).astype(np.float64)
        )
        self._label = wp.array(label, dtype=wp.int32, device=device)
        self._sizes = wp.array(self.sizes, dtype=wp.float64, device=device)
        self._sums = wp.zeros(self.count, dtype=wp.float64, device=device)
        self._held = wp.zeros(self.count, dtype=wp.int32, device=device)
        self._net: np.ndarray = np.zeros(self.count)

    def _total(self, sums: np.ndarray) -> np.ndarray:
        """Return sums over all ranks."""
        return sums if self._comm is None else self._comm.sum(sums)

    def _largest(self, values: np.ndarray) -> np.ndarray:
        """Return the largest values over all ranks."""
        return values if self._comm is None else self._comm.max(values)

    def without(self, removed: np.ndarray) -> FloatingComponents | None:
        """Return the components except some that are not floating.

        None if none is left.

        Args:
            removed: mask of the components to remove, bool of shape (count,).
        """
        if not removed.any():
            return self
        if removed.all():
            return None
        number = np.where(removed, -1, np.cumsum(~removed) - 1).astype(np.int32)
        label = np.where(self.label >= 0, number[self.label], -1).astype(np.int32)
        return FloatingComponents(label, self.device, self._comm, left=self.left, right=self.right)

    def transposed(self) -> FloatingComponents:
        """Return the floating components of A'."""
        if self.left is None and self.right is None:
            return self
        return FloatingComponents(
            self.label, self.device, self._comm, left=self.right, right=self.left
        )

    def unattainable(self, b: DeviceArray, lower: DeviceArray, upper: DeviceArray) -> float:
        """Return a lower bound of the natural residual's norm; 0 if b is compatible.

        Args:
            b: stored field, float64, units of y.
            lower: stored lower bounds.
            upper: stored upper bounds.
        """
        inside = self.label >= 0
        label = self.label[inside]
        w = np.ones(1) if self.left is None else self.left[inside]
        terms = w * b.numpy()[inside]
        values = (
            terms,
            np.abs(terms),
            *(np.isfinite(bound.numpy()[inside]) for bound in (lower, upper)),
        )
        # For empty input NumPy 1 returns integers.
        # Sums over each component: w'b, its absolute terms, and whether a bound is finite.
        mine = np.stack([np.bincount(label, v, self.count) for v in values])
        sums = self._total(mine.astype(np.float64))
        rest, scale, below, above = sums[0], sums[1], sums[2] > 0, sums[3] > 0
        self._net = rest.copy()
        # Bounds absorb a sum of the right sign.
        rest[(below & (rest > 0)) | (above & (rest < 0))] = 0
        rounding = 4 * np.finfo(np.float64).eps if self.left is None else ROUNDED
        rest[np.abs(rest) <= rounding * scale * np.sqrt(self.sizes)] = 0  # rounding of a sum
        squares = self.sizes if self.left is None else np.bincount(label, w**2, self.count)
        return float(np.sqrt(np.sum(rest**2 / squares)))

    def project(self, r: DeviceArray, free: DeviceArray) -> None:
        """Subtract the mean of r from every component whose unknowns are all free.

        The result is a right-hand side that a singular block can meet.
        """
        if self.left is not None:
            self._project_weighted(self.left, r, free)
            return
        self._sums.zero_()
        self._held.zero_()
        n = r.size
        wp.launch(
            component_sums_kernel,
            n,
            [self._label, free, r, self._sums, self._held],
            device=self.device,
        )
        if self._comm is not None:
            self._sums.assign(self._comm.sum(self._sums.numpy()))
            self._held.assign(self._comm.max(self._held.numpy()))
        wp.launch(
            remove_means_kernel,
            n,
            [self._label, self._sums, self._held, self._sizes, r],
            device=self.device,
        )

    def _project_weighted(self, w: np.ndarray, r: DeviceArray, free: DeviceArray) -> None:
        """Subtract w (w'r)/(w'w) from r on components whose unknowns are all free."""
        inside = self.label >= 0
        label, weights, host = self.label[inside], w[inside], r.numpy()
        held = np.bincount(label, free.numpy()[inside] == 0, self.count) > 0
        self._held.assign(held.astype(np.int32))
        shares = np.bincount(label, weights * host[inside], self.count) / np.bincount(
            label, weights**2, self.count
        )
        changed = host.copy()
        changed[inside] -= (np.where(held, 0.0, shares)[label] * weights).astype(host.dtype)
        r.assign(changed)

    def _settle_weighted(
        self, v: np.ndarray, x: DeviceArray, lower: DeviceArray, upper: DeviceArray
    ) -> None:
        """Choose multiples of v instead of constants, otherwise like `settle`.

        For each component, x <- clip(x + c v, l, u). The distances to the bounds are
        min((x - l) / v) and min((u - x) / v), and the mean, which c removes without bounds, is
        v'x / v'v.
        """
        inside, moved = self.label >= 0, x.numpy().copy()
        label, weights, held = self.label[inside], v[inside], self._held.numpy() != 0
        low, values, high = lower.numpy()[inside], moved[inside], upper.numpy()[inside]
        below, above = (np.full(self.count, np.inf) for _ in range(2))
        np.minimum.at(below, label, (values - low) / weights)
        np.minimum.at(above, label, (high - values) / weights)
        mean = np.bincount(label, weights * values, self.count) / np.bincount(
            label, weights**2, self.count
        )
        constants = np.where(held, 0.0, self._constants(below, above, mean))
        moved[inside] = np.clip(values + constants[label] * weights, low, high)
        x.assign(moved)

    def _constants(self, below: np.ndarray, above: np.ndarray, mean: np.ndarray) -> np.ndarray:
        """Return the constant to add to each component.

        `below` and `above` are the distances to the component's bounds.
        """
        # The sum of b pushes x down where it is positive, up where it is negative: x must touch the
        # bound on that side.
        up = np.isfinite(above) & ((self._net < 0) | ~np.isfinite(below))
        found: np.ndarray = np.where(up, above, np.where(np.isfinite(below), -below, -mean))
        return found

    def settle(self, x: DeviceArray, lower: DeviceArray, upper: DeviceArray) -> None:
        """Choose the constants that the last `project` left open.

        The mean is 0 without bounds; otherwise x touches the bound toward which the sum of b pushes
        it. Only components that were free as a whole move.
        """
        if self.right is not None:
            self._settle_weighted(self.right, x, lower, upper)
            return
        below, above = (
            wp.full(self.count, np.inf, dtype=wp.float64, device=self.device) for _ in range(2)
        )
        wp.launch(
            smallest_gap_kernel,
            x.size,
            [self._label, x, lower, upper, below, above],
            device=self.device,
        )
        gap_below, gap_above = -self._largest(-below.numpy()), -self._largest(-above.numpy())
        inside = self.label >= 0
        mean = (
            self._total(np.bincount(self.label[inside], x.numpy()[inside], self.count)) / self.sizes
        )
        constants = wp.array(
            self._constants(gap_below, gap_above, mean), dtype=wp.float64, device=self.device
        )
        wp.launch(
            shift_components_kernel,
            x.size,
            [self._label, self._held, constants, lower, upper, x],
            device=self.device,
        )


class ComponentFinder:
    """Finds floating components; its memory serves every call.

    Args:
        A: the operator; its cells may change between calls.
    """

    def __init__(self, A: GridPoisson) -> None:
        self._A, device = A, A.device
        self._own: Scratch | None = None
        self._none_at = -1  # the operator's version that had no floating components
        self._count = DeviceScalar(device, dtype=wp.int32)

    def find(self, scratch: Scratch | None = None) -> FloatingComponents | None:
        """Return the floating components, None if there are none.

        `scratch` as in GridPoisson.floating_components.
        """
        A, comm = self._A, self._A.layout.comm
        if A._ghosts is not None and comm is not None:
            parent, grounded = self._grow(scratch, A.cells)
            if not comm.any(bool(self._count.numpy()[0])):
                return None
            number = self._numbers(parent.numpy(), grounded.numpy())
            held = (A.cells.numpy() == FLUID).ravel() & (number < 0)
            faces = [
                face.numpy() if face.size else one
                for face, one in zip(A.faces, A.uniform, strict=True)
            ]
            label = A._ghosts.join_components(number, held, faces)
            return None if label is None else FloatingComponents(label, A.device, comm)
        tell = self.launch_search(scratch)
        if tell():
            return None
        parent, grounded = self._scratch
        return self._label(parent.numpy(), grounded.numpy())

    def launch_search(self, scratch: Scratch | None = None) -> Callable[[], bool]:
        """Launch the search; return a function that says whether there are none.

        That function waits for the device; `scratch` as of `find`.
        """
        if self.wanted():
            self.search(scratch)
        return self.none

    def search(self, scratch: Scratch | None) -> None:
        """Launch a search if it is `wanted`; `scratch` as of `find`."""
        self._scratch = self._grow(scratch, self._A.cells_around)

    def changed(self) -> None:
        """Mark the result of a recorded `search` as changed."""
        self._count.changed()

    def wanted(self) -> bool:
        """Return whether a search is needed, and reset its count.

        It is needed if the cells have changed since there were no floating components.
        """
        if self._none_at == self._A.version:
            return False
        if self._A.device.is_cpu:  # else `search` does
            self._count.array.zero_()
        return True

    def none(self) -> bool:
        """Return whether the launched search has found none; waits for the device."""
        version = self._A.version
        if self._none_at != version and not self._count.numpy()[0]:
            self._none_at = version
        return self._none_at == version

    def record(self, scratch: Scratch | None, launch: Launch) -> None:
        """Record the launches of a search, to be run if it is `wanted`.

        `scratch` as of `find`. On ranks it searches this rank's cells alone, see `held_here`.
        """
        shared = self._A.layout.comm is not None
        self._search(scratch, self._A.cells if shared else self._A.cells_around, launch)

    @property
    def held_here(self) -> wp.array[wp.int32]:
        """Number of cells in components that are not grounded on this rank, shape (1,).

        Of the last search.
        """
        return self._count.array

    def _grow(self, scratch: Scratch | None, joined: DeviceArray) -> Scratch:
        """Search now; return the result of `_search`."""
        clear(self._count.array)
        with together(self._A.device) as launch:
            found = self._search(scratch, joined, launch)
        self._count.changed()
        return found

    def _search(self, scratch: Scratch | None, joined: DeviceArray, launch: Launch) -> Scratch:
        """Return the component trees: each cell's parent, and the grounded roots.

        The number of cells without a grounded root is in `_count`.

        Args:
            scratch: memory, or None.
            joined: stored cell types, of which FLUID neighbors are one component.
            launch: launches or records.
        """
        A, rows = self._A, self._A.stencil.rows
        if scratch is None:
            if self._own is None:
                self._own = (
                    wp.zeros(A.layout.size, dtype=wp.int32, device=A.device),
                    wp.zeros(A.layout.size, dtype=wp.uint8, device=A.device),
                )
            scratch = self._own
        parent, grounded = scratch[0].view(wp.int32), scratch[1]
        cells, faces = A.cells_around.flatten(), A.face_coefficients
        SINGLETONS.bind(rows, parent=parent, grounded=grounded).launch(launch)
        UNITE.bind(rows, faces, cells=joined.flatten(), parent=parent).launch(launch)
        GROUND.bind(
            rows, faces, cells=cells, shift=A.shift.flatten(), parent=parent, grounded=grounded
        ).launch(launch)
        COUNT.bind(
            rows, cells=cells, parent=parent, grounded=grounded, count=self._count.array
        ).launch(launch)
        return parent, grounded

    def _label(self, parent: np.ndarray, grounded: np.ndarray) -> FloatingComponents:
        """Number the floating components, on the host because they are rare."""
        return FloatingComponents(self._numbers(parent, grounded), self._A.device)

    def _numbers(self, parent: np.ndarray, grounded: np.ndarray) -> np.ndarray:
        """Return the number of each stored cell's floating component, from 0.

        -1 elsewhere.
        """
        A = self._A
        interior = np.zeros(A.layout.stored_shape, dtype=bool)
        interior[1:-1, 1:-1, 1:-1] = A.cells.numpy()[1:-1, 1:-1, 1:-1] == FLUID
        inside = interior.ravel()
        roots = _roots(np.where(inside, parent, np.arange(parent.size, dtype=np.int32)))
        floating = inside & (grounded[roots] == 0)
        label = np.full(roots.size, -1, dtype=np.int32)
        label[floating] = np.unique(roots[floating], return_inverse=True)[1]
        return label


def _roots(parent: np.ndarray) -> np.ndarray:
    """Follow parents to their roots."""
    roots = parent[parent]
    while not np.array_equal(roots, roots[roots]):
        roots = roots[roots]
    return np.asarray(roots)


def numbered_components(
    number: np.ndarray,
    held: np.ndarray,
    device: wp.Device,
    *,
    left: np.ndarray | None = None,
    right: np.ndarray | None = None,
) -> FloatingComponents | None:
    """Return the floating ones of numbered components, None if there are none.

    Args:
        number: of each stored cell, 0 where there is no component.
        held: for each number, 0 included, whether the component is not floating.
        device: of the fields.
        left: as of `FloatingComponents`.
        right: likewise.
    """
    held[0] = True
    if held.all():
        return None
    names = np.where(held, -1, np.cumsum(~held) - 1).astype(np.int32)
    return FloatingComponents(names[number], device, left=left, right=right)


class NullVectors(NamedTuple):
    """Connected components of a matrix and their null vectors.

    The number of each row, which components are not known to be singular, and w'A = 0, A v = 0 on
    the others.
    """

    number: np.ndarray
    held: np.ndarray
    left: np.ndarray
    right: np.ndarray


def null_vectors(
    matrix: scipy.sparse.csr_array, rows: np.ndarray, columns: np.ndarray, *, most: int
) -> NullVectors:
    """Find null vectors of components of a matrix whose rows or columns sum to 0.

    Where both do, they are the constants. Where one does, the other vector is computed if the
    component is an irreducible M-matrix, because it is then unique and positive (Berman & Plemmons
    1994, theorem 6.4.16).

    Args:
        matrix: the matrix.
        rows: whether each row is known to sum to 0, bool.
        columns: likewise for each column.
        most: largest number of unknowns of a component for which a vector is computed; 0 where
            off-diagonal entries may be positive.
    """
    count, number = scipy.sparse.csgraph.connected_components(matrix, directed=False)
    of_rows, of_columns = (np.bincount(number, ~vanish, count) == 0 for vanish in (rows, columns))
    held, left, right = ~(of_rows & of_columns), np.ones(len(number)), np.ones(len(number))
    for c in np.flatnonzero(of_rows != of_columns) if most else ():
        places = np.flatnonzero(number == c)
        block = matrix[places][:, places]
        if (
            len(places) <= most
            and scipy.sparse.csgraph.connected_components(block, connection="strong")[0] == 1
        ):
            vector = _null_vector(block.T if of_rows[c] else block)
            (left if of_rows[c] else right)[places], held[c] = vector, not (vector > 0).all()
    return NullVectors(number, held, left, right)


def _null_vector(block: scipy.sparse.csr_array) -> np.ndarray:
    """Return v with A v = 0 and a mean of 1.

    A is an irreducible M-matrix whose columns sum to 0. One entry is set to 1, and the others are
    the solution of the remaining equations.
    """
    # The diagonal that makes the sums of columns exactly 0.
    away = scipy.sparse.csc_array(block - scipy.sparse.diags_array(block.diagonal()))
    exact = (away - scipy.sparse.diags_array(np.asarray(away.sum(axis=0)).ravel())).tocsc()
    v = np.ones(block.shape[0])
    if len(v) > 1:
        v[1:] = scipy.sparse.linalg.splu(exact[1:, 1:].tocsc()).solve(
            -exact[1:, [0]].toarray().ravel()
        )
    return np.asarray(v / v.mean())
