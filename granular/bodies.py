"""Rigid bodies in sand, coupled implicitly with the stresses."""

from __future__ import annotations

import typing
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import warp as wp

from warp_lcp.granular.bodies_kernels import (
    FieldShape,
    IncidenceFields,
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
from warp_lcp.granular.stress_layout import F64, I32, U8
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.kernels import Rows
from warp_lcp.kernels.host_array import HostArray
from warp_lcp.kernels.launch_graph import Launch, LaunchGraph, copy, launch
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.vectors import sum_over_ranks

if typing.TYPE_CHECKING:
    from warp_lcp.granular.stress import SandWalls, Velocity

# Trial steps before a step. One is exact while all stresses around a body are free; a second one
# saved a sixth of the steps.
ROUNDS = 2
# Cells or edges whose forces a thread sums, on the CPU and on CUDA.
GRAIN = {False: 1024, True: 64}
NUMBERS = {2: 3, 3: 6}  # degrees of freedom of a body
FIRST = {2: 2, 3: 4}  # layer of the first copy of the first shear


class SandBodies:
    """Implicit coupling of rigid bodies with the stresses of sand.

    `begin`, `prepare`, `respond` and `search` are collective. A rank sums the forces of the
    stresses of its cells on the bodies, including their copies on edges at cuts. The force is the
    sum over the ranks, so that a body has the same velocity on all ranks.

    With F = - sum of rows times stresses, see `granular.body_faces`, the velocity of a body after
    the solve is V = V* + rho dx^d M^-1 F. This adds R M^-1 R' to the matrix of the stresses. For a
    light body this term is far larger than the sand's own, so a step of the stresses treats it
    implicitly: it is a projected step in the metric D + R M^-1 R' instead of D, taken with the
    velocity that its own stresses give the bodies.

    This velocity is the root of a monotone equation with k unknowns per body. It is found by a few
    trial steps of the cells and wall faces beside bodies, each followed by V <- V - (1 + W G)^-1 (V
    - V* - W F), with W = rho dx^d M^-1 and G = R D^-1 R', a bound of -dF/dV. So the number of steps
    does not depend on the mass of the bodies.

    The sand between a body's face and the centers of the cells in front of it moves with the face:
    its mass, half of a cell's, is added to the body's, and its momentum, including gravity, to V*.
    Otherwise a body would neither carry nor drag this layer.

    Args:
        grid: the grid.
        numbers: wall number of each body, 1 + index of its solid.

    Attributes:
        freedoms: k, degrees of freedom of a body.
        velocity: V of each body, float64, shape (bodies, k) [m/s, 1/s]; after `Stress.residual` the
            one that results from the stresses.
    """

    def __init__(self, grid: StaggeredGrid, numbers: Sequence[int]) -> None:
        """Allocate the arrays that do not depend on the positions of the bodies."""
        # The cells whose stresses this rank sums, and the faces and edges that only this rank has.
        part = grid.part
        self._counted: Window | None = part.owned if part.shared else None
        self._own: Window | None = part.faces(grid.everywhere) if part.shared else None
        self.grid, self.numbers, self.freedoms = grid, tuple(numbers), NUMBERS[grid.dimension]
        count, k, device = len(self.numbers), self.freedoms, grid.device
        # Velocity and force that result from the stresses.
        self._left = [DeviceScalar(device, count * k) for _ in range(2)]
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
        self._total = wp.zeros_like(self._force)  # sum over all ranks
        # Run indices per entry, in the format of `_owned`.
        self._each = wp.array(np.arange(count)[:, None] + [0, 1], dtype=wp.int32, device=device)
        # 1 if sand is beside a body on some rank; else no force is computed.
        self._in_contact = wp.zeros(1, dtype=wp.int32, device=device)
        self.faces: BodyFaces | None = None
        self._walls: SandWalls
        self._faces, self._cells, self._edges = (
            IncidenceFields(),
            IncidenceFields(),
            IncidenceFields(),
        )

    def place(self, index: np.ndarray, centers: np.ndarray, walls: SandWalls) -> None:
        """Find the faces, cells and edges where bodies meet sand.

        Args:
            index: int, -1 in open cells, the wall number elsewhere; shape of the grid's fields.
            centers: centers of mass [m], shape (bodies, 3).
            walls: faces between sand and solids; the same object while `index` is unchanged.
        """
        grid, device = self.grid, self.grid.device
        faces = find_body_faces(grid, index, self.numbers, centers, self._counted)
        # With the same cells, recorded launches stay valid.
        if self.faces is not None and walls is self._walls:
            self.faces = faces
            for places, rows in (
                (self._faces, faces.face.row),
                (self._cells, faces.cell.row),
                (self._edges, faces.edge.row),
            ):
                places.row.assign(rows)  # type: ignore[attr-defined]  # an array of the struct
            return
        self.faces = faces
        self._walls, wall_cells = walls, walls.host_cells
        self._entries, cells = entries_near(grid, faces, wall_cells, walls.host_sides)

        def put(values: np.ndarray, dtype: type) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        self._entry_cells = put(wall_cells[self._entries], I32)

        for places, part in (
            (self._faces, faces.face),
            (self._cells, faces.cell),
            (self._edges, faces.edge),
        ):
            places.at, places.axis, places.body = (
                put(part.at, I32),
                put(part.axis, U8),
                put(part.body, I32),
            )
            places.row = put(part.row, F64)
        self._edges.copies = put(own_copies(grid, faces.edge, self._counted), U8)
        copies, homes = unowned_copies(grid, index, faces)
        self._unowned = put((FIRST[grid.dimension] + copies) * grid.size + homes, I32)
        self._trial = put(cells, I32)
        self._active = wp.zeros(1 + len(self._entries), dtype=wp.int32, device=device)
        spans, parts = self._parts(faces)
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
        dt: float,
    ) -> None:
        """Start a time step; the host waits for the device once.

        The start velocity is that of the body together with its layer of sand, of mass m and
        momentum p in units of full faces. With w = rho dx^d M^-1 it is (1 + w m)^-1 (V* + w p), and
        the response to impulses is (1 + w m)^-1 w.

        Args:
            packing: the packing of the step.
            sand: velocity u* of each component [m/s], including gravity, also on the bodies' faces.
            weights: particle weights on the faces of each component; where they are 0, so is
                `sand`.
            velocity: V* of each body, shape (bodies, k) [m/s, 1/s].
            inverse_mass: M^-1 of each, shape (bodies, k, k).
            density: density of sand at its densest packing [kg/m^3].
            dt: time step [s].
        """
        assert self.faces is not None
        self._scale, rows, owner = (
            density * self.grid.cell_volume,
            self.faces.face.row,
            self.faces.face.body,
        )
        layer, scales, self._edge_scales, flags = self._read(packing, sand, weights, dt)
        self._cell_scales = scales.reshape(-1, 2) * self.faces.cell.share[:, None]
        mass, speed = layer.reshape(-1, 2).T
        mass = mass * within(self.grid, self.faces.face.at, self._own)
        count = len(self.numbers)
        self._layer_mass = self._sum(_products(mass, rows, owner, count))
        # bincount returns integers if there are no faces.
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
        held = self._entries[flags != 0]
        active = np.zeros(1 + len(self._entries), dtype=np.int32)
        active[0], active[1 : 1 + len(held)] = len(held), held
        self._active.assign(active)
        part = self.grid.part
        if part.comm is not None:
            self._in_contact.fill_(
                int(part.ranks.any(bool(packing.flags.numpy().ravel()[self._trial.numpy()].any())))
            )

    def forget(self, stress: StressFields) -> None:
        """Set stresses to 0 in cells that touch a body only with an edge."""
        if len(self._unowned):
            fields = [field.flatten() for field in (stress.now, stress.before, stress.point)]
            launch(
                forget_kernel, len(self._unowned), [self._unowned, *fields], device=self.grid.device
            )

    def _read(
        self, packing: Packing, sand: Sequence[wp.array], weights: Sequence[wp.array], dt: float
    ) -> list[np.ndarray]:
        """Compute and read what the host needs of a packing; see `begin`.

        Returns:
            Mass and velocity of the sand of each face; inverse step scales of pressure and friction
            of each cell, and of shear of each edge; flags of the cells of the entries. All are
            float64 and flat, in one array, so that one copy reads them.
        """
        found, device = self.faces, self.grid.device
        assert found is not None
        face, cell, edge, entries = found.face, found.cell, found.edge, len(self._entries)
        sizes = [2 * len(face.at), 2 * len(cell.at), len(edge.at), entries]
        memory = wp.zeros(sum(sizes), dtype=wp.float64, device=device)
        begins = np.cumsum([0, *sizes]).tolist()
        layer, cells, edges, held = (
            wp.array(ptr=(memory.ptr or 0) + 8 * begin, dtype=dtype, shape=count, device=device)
            for begin, count, dtype in zip(
                begins,
                (len(face.at), len(cell.at), len(edge.at), entries),
                (wp.vec2d, wp.vec2d, wp.float64, wp.float64),
                strict=False,
            )
        )
        mass, inverse, flags = (
            flat_vector(packing.mass),
            flat_vector(packing.inverse),
            packing.flags.flatten(),
        )
        inputs = [self._faces, mass, flat_vector(sand), flat_vector(weights)]
        inputs += [self._entry_cells, flags, layer, held]
        wp.launch(layer_kernel, len(face.at) + entries, inputs, device=device)
        inputs = [self._shape, self._cells, flags, packing.drive.flatten(), packing.stiff.flatten()]
        inputs += [mass, inverse, dt / self.grid.spacing, cells]
        wp.launch(stiffness_kernel, len(cell.at), inputs, device=device)
        inputs = [self._shape, self._edges, flat_vector(packing.share), inverse, edges]
        wp.launch(lightness_kernel, len(edge.at), inputs, device=device)
        return np.split(memory.numpy(), begins[1:-1])

    def prepare(self, *, pressure_step: float, shear_step: float) -> None:
        """Compute the correction of a trial step per velocity mismatch.

        The correction is (1 + W G)^-1, where G = R D^-1 R' bounds the change of the force with the
        velocity: a sum over cells of the steps of pressure and deviator, and over edges of those of
        shear.

        Args:
            pressure_step: length of the projected gradient step, relative to the diagonal.
            shear_step: likewise for the shear stresses.
        """
        found, dimension = self.faces, self.grid.dimension
        assert found is not None
        cell, edge = found.cell, found.edge
        pressure, shear = self._cell_scales.T
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
            shear_step * self._edge_scales * edge.share * own, edge.row, edge.body, count
        )
        steepest = self._sum(steepest)
        identity = np.eye(self.freedoms)
        self._correction.host[:] = np.linalg.inv(identity + self._host_response @ steepest)
        self._correction.send()

    def impulses(self) -> np.ndarray:
        """Return the impulse of the sand on each body since V*, shape (bodies, k).

        [kg m/s, kg m^2/s; 2-D: per m]. It includes the stresses of the last `Stress.residual` and
        the layer of sand that moves with the body.
        """
        velocity, force = (reading.numpy().reshape(self.velocity.shape) for reading in self._left)
        layer = self._layer_momentum - np.einsum("bqr,br->bq", self._layer_mass, velocity)
        return np.asarray((force + layer) * self._scale)

    def changed(self) -> None:
        """Mark `impulses` as changed, after a solve has been launched."""
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
        """Compute the bodies' velocity under the stresses, or a step toward it.

        A first kernel sums the forces over runs of cells and edges; a second one sums the runs of
        each body and updates its velocity, see `bodies_kernels.respond_kernel`.
        """
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
            packing: the packing of the step.
            velocity: velocity of the sand, which the steps start from, with the bodies' last
                velocity.
            stress: the stresses; their `point` is overwritten beside bodies.
            launch: records the launches.
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
        """Return the sums over all ranks."""
        return np.asarray(self.grid.part.ranks.sum(found))

    def _forces(self, launch: Launch) -> tuple[wp.array, wp.array]:
        """Return the runs of each body, first and last, and the forces on it in them.

        On ranks, the sums over all.
        """
        comm, device = self.grid.part.comm, self.grid.device
        if comm is None:
            return self._owned, self._partial
        launch(
            add_runs_kernel,
            self._total.shape,
            [self._owned, self._partial, self._in_contact, self._total],
            device=device,
        )
        sum_over_ranks(comm, self._total.flatten(), slice(None), launch, condition=self._in_contact)
        return self._each, self._total

    def _parts(self, faces: BodyFaces) -> tuple[np.ndarray, np.ndarray]:
        """Split the lists of cells and edges into runs, one per thread.

        Returns the first and last entry of both lists for each run, and the runs of each body.

        A run has at most `GRAIN` entries, all of one body and of one list. Shapes: (runs, 4) with
        first and last cell, first and last edge; (bodies, 2) with first and last run. A last number
        is one past the end.
        """
        grain = GRAIN[self.grid.device.is_cuda]
        spans: list[list[int]] = []
        parts: list[list[int]] = []
        for body in range(len(self.numbers)):
            first = len(spans)
            for column, owner in ((0, faces.cell.body), (2, faces.edge.body)):
                low, high = np.searchsorted(owner, [body, body + 1])
                for start in range(low, high, grain):
                    run = [0, 0, 0, 0]
                    run[column : column + 2] = start, min(start + grain, high)
                    spans.append(run)
            parts.append([first, len(spans)])
        return np.array(spans).reshape(-1, 4), np.array(parts).reshape(-1, 2)


def _products(weight: np.ndarray, rows: np.ndarray, owner: np.ndarray, count: int) -> np.ndarray:
    """Return the sums of weight row' row over the rows of each owner.

    Shape (count, k, k).

    Args:
        weight: shape (n,).
        rows: shape (n, rows per entry, k).
        owner: owner of each entry, ascending, shape (n,).
        count: number of owners.
    """
    ends = np.searchsorted(owner, np.arange(count + 1))
    found = np.zeros((count, rows.shape[2], rows.shape[2]))
    for body, (low, high) in enumerate(pairwise(ends)):
        part = rows[low:high]
        found[body] = np.tensordot(weight[low:high, None, None] * part, part, axes=((0, 1), (0, 1)))
    return found
