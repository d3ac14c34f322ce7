"""Rigid bodies in sand, coupled implicitly with the stresses."""

from __future__ import annotations

import typing
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import warp as wp

from warp_lcp.granular.bodies_kernels import (
    FieldShape,
    Places,
    add_runs_kernel,
    body_kernels,
    flat_vector,
    force_kernel,
    forget_kernel,
    layer_kernel,
    lightness_kernel,
    respond_kernel,
    stiffness_kernel,
)
from warp_lcp.granular.body_faces import (
    BodyFaces,
    entries_near,
    find_body_faces,
    own_copies,
    unowned_copies,
    within,
)
from warp_lcp.granular.fields import StressFields
from warp_lcp.granular.packing import Packing
from warp_lcp.granular.yield_set import F64, I32, U8
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.rows import Rows
from warp_lcp.rows.host_array import HostArray
from warp_lcp.rows.program import Launch, LaunchGraph, copy, launch
from warp_lcp.rows.readings import Reading
from warp_lcp.rows.vectors import add_across

if typing.TYPE_CHECKING:
    from warp_lcp.granular.stress import Velocity, Walls

# trial steps before a step: one is exact while all stresses around a body are free; a second took a
# sixth of the steps less
ROUNDS = 2
# cells or edges whose forces a thread adds up, on the CPU and on CUDA
GRAIN = {False: 1024, True: 64}
NUMBERS = {2: 3, 3: 6}  # degrees of freedom of a body
FIRST = {2: 2, 3: 4}  # layer of the first copy of a shear


class SandBodies:
    """Rigid bodies in the stress solve.

    `begin`, `prepare`, `respond` and `search` are collective. A rank adds up what the stresses of
    its cells do to the bodies, their copies on edges at cuts included, and sums over ranks are the
    force: all ranks give a body the same velocity, and so all faces of their parts.

    With F = - sum of rows times stresses, see `granular.body_faces`, a body leaves the solve with V
    = V* + rho dx^d M^-1 F. That adds R M^-1 R' to the matrix of the stresses: a light body's part
    of it is far larger than sand's own. So a step of the stresses takes it implicitly: it is the
    projected step whose own stresses give the bodies the velocity that it was taken with, a step in
    the metric D + R M^-1 R' instead of D. That velocity is the root of a monotone equation in k
    numbers a body, found by a few trial steps of the cells and wall faces beside bodies, each
    followed by V <- V - (1 + W G)^-1 (V - V* - W F), W = rho dx^d M^-1 and G = R D^-1 R' the most
    that F can fall with V. So the number of steps does not depend on the bodies' mass.

    The sand between a body's face and the centers of the cells before it has the face's velocity:
    its mass, half a cell's, is added to the body's, and what gravity and its own motion bring along
    to V*. Without it a body would neither bear nor drag along that layer.

    Args:
        grid: the grid.
        numbers: the wall's number of each body, 1 + index of its solid.

    Attributes:
        freedoms: k, degrees of freedom of a body.
        velocity: V of each, float64, shape (bodies, k) [m/s, 1/s]; after `Stress.residual` that
            which the stresses leave.
    """

    def __init__(self, grid: StaggeredGrid, numbers: Sequence[int]) -> None:
        """Allocate what does not depend on where the bodies are."""
        # the cells whose stresses act on the bodies here, and of their faces and edges those that
        # no one else has
        part = grid.part
        self._counted: Window | None = part.owned if part.shared else None
        self._own: Window | None = part.faces(grid.everywhere) if part.shared else None
        self.grid, self.numbers, self.freedoms = grid, tuple(numbers), NUMBERS[grid.dimension]
        count, k, device = len(self.numbers), self.freedoms, grid.device
        # velocity and force, as the stresses leave them
        self._left = [Reading(device, count * k) for _ in range(2)]
        self.velocity, self._force = (reading.array.reshape((count, k)) for reading in self._left)
        self._error = wp.zeros((count, k), dtype=wp.float64, device=device)
        self._start = HostArray((count, k), wp.float64, device)
        self._response, self._correction = (
            HostArray((count, k, k), wp.float64, device) for _ in range(2)
        )
        _, rows, columns = grid.shape
        self._shape = FieldShape()
        self._shape.dimension, self._shape.layer, self._shape.strides = (
            grid.dimension,
            grid.size,
            wp.vec3i(1, columns, columns * rows),
        )
        self._beginning = LaunchGraph(device, lambda: copy(self.velocity, self._start.array))
        self._total = wp.zeros_like(self._force)  # of all ranks
        # its entries, as `_owned` has runs
        self._each = wp.array(np.arange(count)[:, None] + [0, 1], dtype=wp.int32, device=device)
        # 1: sand is beside a body on some rank; else no force is asked for
        self._met = wp.zeros(1, dtype=wp.int32, device=device)
        self.faces: BodyFaces | None = None
        self._walls: Walls
        self._faces, self._cells, self._edges = Places(), Places(), Places()

    def place(self, index: np.ndarray, centers: np.ndarray, walls: Walls) -> None:
        """Find the faces, cells and edges where bodies meet sand.

        Args:
            index: int, -1 in open cells, the wall's number elsewhere; shape of the grid's fields.
            centers: of mass [m], shape (bodies, 3).
            walls: the faces between sand and solids, the same object as long as `index` is the
                same.
        """
        grid, device = self.grid, self.grid.device
        found = find_body_faces(grid, index, self.numbers, centers, self._counted)
        # the same cells: what is recorded stays valid
        if self.faces is not None and walls is self._walls:
            self.faces = found
            for places, rows in (
                (self._faces, found.face.row),
                (self._cells, found.cell.row),
                (self._edges, found.edge.row),
            ):
                places.row.assign(rows)  # type: ignore[attr-defined]  # an array of the struct
            return
        self.faces = found
        self._walls, wall_cells = walls, walls.host_cells
        self._entries, cells = entries_near(grid, found, wall_cells, walls.host_sides)
        self._entry_cells = wall_cells[self._entries].copy()

        def put(values: np.ndarray, dtype: type) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        for places, part in (
            (self._faces, found.face),
            (self._cells, found.cell),
            (self._edges, found.edge),
        ):
            places.at, places.axis, places.body = (
                put(part.at, I32),
                put(part.axis, U8),
                put(part.body, I32),
            )
            places.row = put(part.row, F64)
        self._edges.copies = put(own_copies(grid, found.edge, self._counted), U8)
        copies, homes = unowned_copies(grid, index, found)
        self._unowned = put((FIRST[grid.dimension] + copies) * grid.size + homes, I32)
        self._trial = put(cells, I32)
        self._active = wp.zeros(1 + len(self._entries), dtype=wp.int32, device=device)
        spans, parts = self._parts(found)
        self._spans, self._owned = put(spans, I32), put(parts, I32)
        self._partial = wp.zeros((len(spans), self.freedoms), dtype=wp.float64, device=device)

    def begin(
        self,
        packing: Packing,
        sand: Sequence[wp.array],
        weights: Sequence[wp.array],
        *,
        velocity: np.ndarray,
        inverse_mass: np.ndarray,
        density: float,
    ) -> None:
        """Start a time step.

        Args:
            packing: where sand is.
            sand: velocity u* of each component [m/s], gravity included, on the bodies' faces as
                well.
            weights: of the particles on each component's faces; where they are 0, so is `sand`.
            velocity: V* of each body, shape (bodies, k) [m/s, 1/s].
            inverse_mass: M^-1 of each, shape (bodies, k, k).
            density: of sand at its densest [kg/m^3].
        """
        assert self.faces is not None
        self._scale, rows, owner = (
            density * self.grid.cell_volume,
            self.faces.face.row,
            self.faces.face.body,
        )
        layer = wp.zeros(len(rows), dtype=wp.vec2d, device=self.grid.device)
        inputs = [
            self._faces,
            flat_vector(packing.mass),
            flat_vector(sand),
            flat_vector(weights),
            layer,
        ]
        wp.launch(layer_kernel, len(rows), inputs, device=self.grid.device)
        mass, speed = layer.numpy().T
        mass = mass * within(self.grid, self.faces.face.at, self._own)
        count = len(self.numbers)
        self._layer_mass = self._sum(_products(mass, rows, owner, count))
        # integers where there is no face
        momentum = [np.bincount(owner, mass * speed * row, count) for row in rows[:, 0].T]
        self._layer_momentum = self._sum(np.stack(momentum, axis=1).astype(float))
        alone = inverse_mass * self._scale
        heavier = np.linalg.inv(np.eye(self.freedoms) + alone @ self._layer_mass)
        self._host_response = heavier @ alone
        start = np.einsum(
            "bqr,br->bq", heavier, velocity + np.einsum("bqr,br->bq", alone, self._layer_momentum)
        )
        self._start.host[:], self._response.host[:] = start, self._host_response
        self._start.send()
        self._response.send()
        self._beginning.run()
        held = self._entries[packing.flags.numpy().ravel()[self._entry_cells] != 0]
        active = np.zeros(1 + len(self._entries), dtype=np.int32)
        active[0], active[1 : 1 + len(held)] = len(held), held
        self._active.assign(active)
        part = self.grid.part
        if part.across is not None:
            self._met.fill_(
                int(part.ranks.any(bool(packing.flags.numpy().ravel()[self._trial.numpy()].any())))
            )

    def forget(self, stress: StressFields) -> None:
        """Remove stresses where only the edge of a body is near."""
        if len(self._unowned):
            fields = [field.flatten() for field in (stress.now, stress.before, stress.point)]
            launch(
                forget_kernel, len(self._unowned), [self._unowned, *fields], device=self.grid.device
            )

    def prepare(
        self, packing: Packing, numbers: wp.array, *, pressure_step: float, shear_step: float
    ) -> None:
        """Compute the correction of a trial step per velocity mismatch.

        Args:
            packing: where sand is.
            numbers: of the stresses, see `granular.yield_set`.
            pressure_step: of the projected gradient, relative to the diagonal.
            shear_step: likewise, of the shear stresses.
        """
        found, device, dimension = self.faces, self.grid.device, self.grid.dimension
        assert found is not None
        inverse, cell, edge = flat_vector(packing.inverse), found.cell, found.edge
        room = 2 * len(cell.at)  # both in one memory, which is read by one copy
        memory = wp.zeros(room + len(edge.at), dtype=wp.float64, device=device)
        cells = wp.array(ptr=memory.ptr or 0, dtype=wp.vec2d, shape=len(cell.at), device=device)
        inputs = [
            self._shape,
            self._cells,
            packing.flags.flatten(),
            packing.drive.flatten(),
            packing.stiff.flatten(),
        ]
        wp.launch(
            stiffness_kernel,
            len(cell.at),
            [*inputs, flat_vector(packing.mass), inverse, numbers, cells],
            device=device,
        )
        edges = wp.array(
            ptr=(memory.ptr or 0) + 8 * room, dtype=wp.float64, shape=len(edge.at), device=device
        )
        inputs = [self._shape, self._edges, flat_vector(packing.share), inverse, edges]
        wp.launch(lightness_kernel, len(edge.at), inputs, device=device)
        found_cells, found_edges = np.split(memory.numpy(), [room])
        pressure, shear = (found_cells.reshape(-1, 2) * cell.share[:, None]).T
        along = cell.row.sum(axis=1)
        if dimension == 2:
            deviator, factor = (cell.row[:, 0] - cell.row[:, 1])[:, None], 1.0
        else:
            deviator, factor = cell.row - along[:, None] / 3.0, 2.0
        count = len(self.numbers)
        steepest = _products(pressure_step * pressure, along[:, None], cell.body, count)
        steepest += _products(factor * shear_step * shear, deviator, cell.body, count)
        own = within(self.grid, edge.at, self._own)
        steepest += _products(
            shear_step * found_edges * edge.share * own, edge.row, edge.body, count
        )
        steepest = self._sum(steepest)
        identity = np.eye(self.freedoms)
        self._correction.host[:] = np.linalg.inv(identity + self._host_response @ steepest)
        self._correction.send()

    def impulses(self) -> np.ndarray:
        """Return the impulse of the sand on each body since V*, shape (bodies, k).

        [kg m/s, kg m^2/s; 2-D: per m].

        That is of the stresses of the last `Stress.residual`, and of the layer of sand that moves
        with the body.
        """
        velocity, force = (reading.numpy().reshape(self.velocity.shape) for reading in self._left)
        layer = self._layer_momentum - np.einsum("bqr,br->bq", self._layer_mass, velocity)
        return np.asarray((force + layer) * self._scale)

    def changed(self) -> None:
        """Say that a solve has been launched, which changes `impulses`."""
        for reading in self._left:
            reading.changed()

    def move(self, velocity: Velocity, launch: Launch) -> None:
        """Set the velocity of the bodies' faces."""
        kernel = body_kernels(self.grid.dimension, velocity.real, velocity.box, velocity.rate).move
        if len(self._faces.at):
            launch(
                kernel,
                len(self._faces.at),
                [self._faces, self.velocity, flat_vector(velocity.u)],
                device=self.grid.device,
            )

    def respond(
        self, packing: Packing, stress: wp.array, launch: Launch, *, implicit: bool
    ) -> None:
        """Compute the bodies' velocity under the stresses, or a step towards it."""
        device = self.grid.device
        inputs = [
            self._shape,
            self._spans,
            stress.flatten(),
            self._cells,
            self._edges,
            flat_vector(packing.share),
            self._partial,
        ]
        if self._spans.shape[0]:
            launch(force_kernel, self._spans.shape[0], inputs, device=device)
        inputs = [
            int(implicit),
            *self._forces(launch),
            self._start.array,
            self._response.array,
            self._correction.array,
        ]
        launch(
            respond_kernel,
            len(self.numbers),
            [*inputs, self._force, self._error, self.velocity],
            device=device,
        )

    def search(
        self, packing: Packing, velocity: Velocity, stress: StressFields, launch: Launch
    ) -> None:
        """Find the bodies' velocity for which a step of the stresses is implicit.

        Faces and edges beside the bodies are set to it.

        Args:
            packing: where sand is.
            velocity: what a step is taken with, at the bodies' last velocity.
            stress: the stresses, of which `point` is overwritten beside bodies.
            launch: records.
        """
        p, device, walls = packing, self.grid.device, self._walls
        kernels = body_kernels(self.grid.dimension, velocity.real, velocity.box, velocity.rate)
        structs = (p.fields, velocity.fields, stress)
        edges = [self._shape, self._edges, flat_vector(velocity.u), flat_vector(velocity.edge)]
        for _ in range(ROUNDS):
            if count := len(self._trial):
                kernels.trial.bind(
                    Rows.entries(count, device), *structs, cell=self._trial, openings=None
                ).launch(launch)
            if count := len(self._entries):
                kernels.trial_wall.bind(
                    Rows.entries(count, device), *structs, walls.faces, active=self._active
                ).launch(launch)
            self.respond(packing, stress.point, launch, implicit=True)
            self.move(velocity, launch)
            if len(self._edges.at):
                launch(kernels.strain, len(self._edges.at), edges, device=device)

    def _sum(self, found: np.ndarray) -> np.ndarray:
        """Return sums over all processes."""
        return np.asarray(self.grid.part.ranks.sum(found))

    def _forces(self, launch: Launch) -> tuple[wp.array, wp.array]:
        """Return the runs of each body, first and last, and what stresses do to the body in these; of ranks, the sums over all."""
        across, device = self.grid.part.across, self.grid.device
        if across is None:
            return self._owned, self._partial
        launch(
            add_runs_kernel,
            self._total.shape,
            [self._owned, self._partial, self._met, self._total],
            device=device,
        )
        add_across(across, self._total.flatten(), slice(None), launch, condition=self._met)
        return self._each, self._total

    def _parts(self, found: BodyFaces) -> tuple[np.ndarray, np.ndarray]:
        """Return runs of the lists of cells and edges that a thread adds up, first and last of both, and each body's runs."""
        grain = GRAIN[self.grid.device.is_cuda]
        spans: list[list[int]] = []
        parts: list[list[int]] = []
        for body in range(len(self.numbers)):
            first = len(spans)
            for column, owner in ((0, found.cell.body), (2, found.edge.body)):
                low, high = np.searchsorted(owner, [body, body + 1])
                for start in range(low, high, grain):
                    run = [0, 0, 0, 0]
                    run[column : column + 2] = start, min(start + grain, high)
                    spans.append(run)
            parts.append([first, len(spans)])
        return np.array(spans).reshape(-1, 4), np.array(parts).reshape(-1, 2)


def _products(weight: np.ndarray, rows: np.ndarray, owner: np.ndarray, count: int) -> np.ndarray:
    """Return the sums of weight row' row over the rows of each owner, shape (count, k, k).

    Args:
        weight: shape (n,).
        rows: shape (n, several, k).
        owner: of each, ascending, shape (n,).
        count: of owners.
    """
    ends = np.searchsorted(owner, np.arange(count + 1))
    found = np.zeros((count, rows.shape[2], rows.shape[2]))
    for body, (low, high) in enumerate(pairwise(ends)):
        part = rows[low:high]
        found[body] = np.tensordot(weight[low:high, None, None] * part, part, axes=((0, 1), (0, 1)))
    return found
