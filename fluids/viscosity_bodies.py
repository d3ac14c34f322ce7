"""Two-way viscous coupling of the liquid with moving solids and rigid bodies.

The velocities of rigid bodies are unknowns of the viscous step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.linalg
import warp as wp

from warp_lcp.fluids.viscosity_level import ViscosityLevel
from warp_lcp.fluids.viscosity_passes import ViscousKernels
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.kernels.launch_graph import Launch
from warp_lcp.kernels.vectors import Communicator
from warp_lcp.material.boundary import Boundary, CutBoundary, WholeCells
from warp_lcp.operators.low_rank import BlockColumns, weigh_kernel
from warp_lcp.rigid.bodies import RigidBodies

SPARE = 1.5  # factor on the number of links when the buffer is enlarged


@dataclass(frozen=True, slots=True)
class ViscousWalls:
    """Fields of walls and cells that the viscous coupling reads.

    Attributes:
        distance: distance of each component's faces from walls [cells].
        slip: slip length of those walls [cells].
        kind: cell kinds.
        contact: wall contact of cells.
    """

    distance: Sequence[wp.array]
    slip: Sequence[wp.array]
    kind: wp.array
    contact: wp.array


class ViscousWallCoupling:
    """Viscous coupling coefficients between liquid faces and moving solids.

    The viscous force on a face due to a solid's velocity V is c'V. The motions of a solid are (vx,
    vy, wz) in 2-D and (vx, vy, vz, wx, wy, wz) in 3-D, about a point. For a link that meets its
    wall, c is the weight times the velocities of the unit motions there. For a product with a face
    in the solid, c has those at that face. The reaction on the solid is C'u - D V, with rows c of
    C. Both are derivatives of an energy that is 0 for rigid motions of liquid and solid together,
    so that D satisfies C'u = D V for them.

    Args:
        grid: the grid.
        boundary: its solids.
        numbers: numbers of the solids, 0 for the domain.
        passes: kernels of the viscous solve.

    Attributes:
        rows: face of each c, in the flat field of all components.
        blocks: solid of each c.
        owners: place in `numbers` of each solid, or -1, int32.
        values: c, shape (n, 3) or (n, 6).
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        boundary: Boundary,
        numbers: Sequence[int],
        solids: int,
        passes: ViscousKernels,
    ) -> None:
        self.grid, self.boundary, self._passes = grid, boundary, passes
        self.width, self.count = 3 if grid.dimension == 2 else 6, len(numbers)
        owners = np.full(solids, -1, dtype=np.int32)
        owners[list(numbers)] = np.arange(len(numbers))
        self.owners = wp.array(owners, dtype=wp.int32, device=grid.device)
        self._counts = wp.zeros(grid.shape[0] * grid.shape[1], dtype=wp.int32, device=grid.device)

    def update(
        self, window: Window | None, level: ViscosityLevel, walls: ViscousWalls, points: np.ndarray
    ) -> None:
        """Compute `rows`, `blocks` and `values`.

        Each entry is a link of a liquid face to a face or wall of a solid. The kernel counts the
        entries of each component, and then writes them.

        Args:
            window: cells with all faces beside the solids; None without any.
            level: the equations of the step.
            walls: walls around the liquid.
            points: reference points of the solids' rotations [m], shape (solids, 3).
        """
        grid, distance = self.grid, walls.distance
        owners: list[wp.array | None] = (
            [*self.boundary.cut.wall]
            if isinstance(self.boundary, CutBoundary)
            else [None] * grid.dimension
        )
        index = self.boundary.solids.index if isinstance(self.boundary, WholeCells) else None
        center = wp.array(points.ravel(), dtype=wp.float64, device=grid.device)
        entries = [
            (np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.int32), np.zeros((0, self.width)))
        ]
        for axis in range(grid.dimension if window is not None else 0):
            assert window is not None
            (db, dc), (wall_b, wall_c) = (
                level.of_others(axis, distance),
                level.of_others(axis, owners),
            )
            links = partial(
                window.run,
                self._passes.links,
                level.rows(axis),
                grid.placement,
                whole=True,
                kind=walls.kind,
                contact=walls.contact,
                body=self.owners,
                base=self.boundary.base,
                center=center,
                index=index,
                width=self.width,
                counts=self._counts,
                d=distance[axis],
                db=db,
                dc=dc,
                h=walls.slip[axis],
                wall=owners[axis],
                wall_b=wall_b,
                wall_c=wall_c,
                from_=axis * grid.size,
            )
            entries.append(self._entries(links))
        self.rows, self.blocks, self.values = (
            np.concatenate(parts) for parts in zip(*entries, strict=True)
        )

    def pulled(
        self, velocity: Sequence[wp.array], points: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return C'u and D of each solid.

        Shapes (solids, width) and (solids, width, width).

        Args:
            velocity: u of each component [m/s].
            points: see `take`.
        """
        grid, dimension = self.grid, self.grid.dimension
        axes, cells = np.divmod(self.rows, grid.size)
        k, j, i = np.unravel_index(cells, grid.shape)
        places = (
            np.stack((i, j, k), axis=-1) + np.array(grid.origin) - 0.5 - 0.5 * np.eye(3)[axes]
        ) * grid.spacing
        at = [field.numpy().ravel() for field in velocity]
        speeds = np.array([at[axis][cell] for axis, cell in zip(axes, cells, strict=True)])
        sums, drags = (
            np.zeros((self.count, self.width)),
            np.zeros((self.count, self.width, self.width)),
        )
        for n in range(self.count):
            own = self.blocks == n
            arms = places[own] - points[n]
            arms[:, dimension:] = 0.0
            # Velocities of unit rotations about each axis.
            turns = np.cross(np.eye(3)[None], arms[:, None])[np.arange(len(arms)), :, axes[own]]
            motions = np.concatenate(
                (np.eye(3)[axes[own]][:, :dimension], turns[:, 2:] if dimension == 2 else turns),
                axis=1,
            )
            drag = self.values[own].T @ motions
            drags[n], sums[n] = 0.5 * (drag + drag.T), speeds[own] @ self.values[own]
        return sums, drags

    def _entries(self, links: Callable[..., None]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return rows, solids and values of a component's entries.

        `links` counts them, and then writes them.
        """
        device = self.grid.device
        self._counts.zero_()
        links(offsets=None, entry_rows=None, blocks=None, values=None)
        counts = self._counts.numpy().copy()
        total = int(counts.sum())
        rows, blocks = (wp.zeros(total, dtype=wp.int32, device=device) for _ in range(2))
        values = wp.zeros(total * self.width, dtype=wp.float64, device=device)
        if total:
            offsets = wp.array(np.cumsum(counts) - counts, dtype=wp.int32, device=device)
            links(offsets=offsets, entry_rows=rows, blocks=blocks, values=values)
        return rows.numpy(), blocks.numpy(), values.numpy().reshape(-1, self.width)


class BodyDrag:
    """Implicit coupling of liquid and rigid bodies by viscosity, see `ViscousWallCoupling`.

    With m = rho dx^d M^-1 a body's velocity is V = V1 + m (C'u - D V), so that a change of the
    liquid's velocity changes it by

        dV = W C'du,   W = (1 + m D)^-1 m,

    and C W C' is subtracted from the matrix of the liquid, which stays symmetric.

    Args:
        grid: the grid.
        boundary: its solids, with the bodies among them.
        bodies: the bodies.
        density: density of the liquid [kg/m^3].
        passes: kernels of the viscous solve.
        solved: cells whose faces are unknowns.
        comm: communicator; all methods are then collective. None if serial.

    Attributes:
        moved: whether the arrays of the columns were reallocated; reset by who has recorded them.
        change: change of the bodies' velocities in the step so far.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        boundary: CutBoundary,
        bodies: RigidBodies,
        density: float,
        passes: ViscousKernels,
        solved: Window,
        comm: Communicator | None,
    ) -> None:
        self.grid, self.boundary, self.bodies, self._solved = grid, boundary, bodies, solved
        self._pull = ViscousWallCoupling(
            grid, boundary, bodies.numbers, 1 + len(boundary.cut.solids), passes
        )
        self._scale, self._width = density * grid.cell_volume, self._pull.width
        self.columns = BlockColumns(
            grid.dimension * grid.size, len(bodies.bodies), self._width, wp.float64, grid.device
        )
        self.columns.comm = comm
        rank = self.columns.rank
        self.moved = False
        self._response = wp.zeros((rank, rank), dtype=wp.float64, device=grid.device)
        self._factors = wp.zeros(rank, dtype=wp.float64, device=grid.device)

    def update(
        self, level: ViscosityLevel, walls: ViscousWalls, velocity: Sequence[wp.array]
    ) -> None:
        """Compute the coefficients of a step, and the bodies' response to the liquid.

        With m = rho dx^d M^-1 it computes W = (1 + m D)^-1 m for each body, symmetrized against
        rounding, and the force C'u - D V of the current velocities.

        Arguments as of `ViscousWallCoupling.take`.
        """
        block, bodies, dimension = (
            self.boundary.cut.moving_block(),
            self.bodies.bodies,
            self.grid.dimension,
        )
        window = None if block is None else self.grid.window(*block, grow=1).common(self._solved)
        points = np.array([body.position for body in bodies])
        self._pull.update(window, level, walls, points)
        pulled, drags = self._pull.pulled(velocity, points)
        if self.columns.comm is not None:
            found = self.columns.comm.sum(np.concatenate((pulled[:, None], drags), axis=1))
            pulled, drags = found[:, 0], found[:, 1:]
        self._drag = drags
        count = len(self._pull.rows)
        if count > self.columns.capacity:
            self.moved = True
            self.columns.reserve(round(SPARE * count))
        self.columns.assign(self._pull.rows, self._pull.blocks, self._pull.values)
        m = [self._scale * body.inverse_mass(dimension) for body in bodies]
        answers = [
            np.linalg.solve(np.eye(self._width) + a @ drag, a)
            for a, drag in zip(m, self._drag, strict=True)
        ]
        before = np.array([body.velocities(dimension) for body in bodies])
        self._pulled = pulled - np.einsum("bij,bj->bi", self._drag, before)
        W = scipy.linalg.block_diag(*answers)
        self._weights = 0.5 * (W + W.T)
        self._response.assign(self._weights)

    @property
    def owners(self) -> wp.array:
        """Number of the body of each solid, -1 for the others, int32."""
        return self._pull.owners

    def inverse_masses(self) -> np.ndarray:
        """Return m of all bodies, block diagonal, see the class."""
        m = [self._scale * body.inverse_mass(self.grid.dimension) for body in self.bodies.bodies]
        return scipy.linalg.block_diag(*m)

    def drags(self) -> np.ndarray:
        """Return D of all bodies, block diagonal, see the class."""
        return scipy.linalg.block_diag(*self._drag)

    def answer(self, residual: wp.array, change: wp.array) -> None:
        """Add the bodies' response to a change of the liquid's velocity to a residual."""
        self.change = self._weights @ (self._pulled.ravel() + self.columns.gather(change).numpy())
        self._factors.assign(self.change)
        self.columns.scatter(self._factors, residual, residual)

    def subtract(self, p: wp.array, q: wp.array, launch: Launch) -> None:
        """Subtract C W C'p from q."""
        self.columns.gather(p, launch=launch)
        launch(
            weigh_kernel,
            self.columns.rank,
            [self._response, self.columns.sums, self._factors],
            device=self.grid.device,
        )
        self.columns.scatter(self._factors, q, q, sign=-1.0, launch=launch)

    def settle(self) -> None:
        """Forget the response of the last solve: the bodies have the step's velocities."""
        self.change = np.zeros(self.columns.rank)

    def velocities(self) -> np.ndarray:
        """Return the bodies' velocities after the step [m/s, 1/s].

        Shape (bodies, width). The bodies themselves have them only after `push`.
        """
        before = np.array([body.velocities(self.grid.dimension) for body in self.bodies.bodies])
        return before + self.change.reshape(before.shape)

    def push(self, change: wp.array) -> None:
        """Apply the impulses of a step to the bodies, given the change of the liquid."""
        moved = self.change.reshape(self._pulled.shape)
        pulled = (
            self._pulled
            + self.columns.gather(change).numpy().reshape(moved.shape)
            - np.einsum("bij,bj->bi", self._drag, moved)
        )
        for body, impulse in zip(self.bodies.bodies, self._scale * pulled, strict=True):
            body.apply_impulse(impulse)
