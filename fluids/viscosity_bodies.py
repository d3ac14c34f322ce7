"""Rigid bodies that a thick liquid drags along, and that drag it: their velocities are unknowns of the viscous step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.linalg
import warp as wp

from warp_lcp.fluids.viscosity_multigrid import VectorLevel
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.material.boundary import CutBoundary
from warp_lcp.operators.low_rank import BlockColumns, weigh_kernel
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.rows.program import Launch

SPARE = 1.5  # room for links, times those there are when there is none left


class BodyDrag:
    """Solve for liquid and bodies together, see `fluids.viscosity`.

    What pulls a face towards a body's velocity V does so by c'V: of a link that meets its wall, the weight times the velocities g of the
    body's unit motions there; of a product with a face in the body, those at that face. The body is pulled back by C'u - D V, C of rows c.
    All this is an energy's, which rigid motions of liquid and body together leave 0, so D is what makes C'u = D V for those. With
    m = rho dx^d M^-1 the body's velocity is V = V1 + m (C'u - D V), so that a change of the liquid's velocity changes it by

        dV = W C'du,   W = (1 + m D)^-1 m,

    and the liquid's equations lose C W C', symmetric like the rest.

    Args:
        grid: the grid.
        boundary: its solids, with the bodies among them.
        bodies: the bodies.
        density: of the liquid [kg/m^3].
        passes: of the viscous solve.

    Attributes:
        moved: whether the columns lie elsewhere since the last step.
    """

    def __init__(self, grid: StaggeredGrid, boundary: CutBoundary, bodies: RigidBodies, density: float, passes: Any) -> None:
        self.grid, self.boundary, self.bodies, self._passes = grid, boundary, bodies, passes
        self._scale, self._width, n = density * grid.cell_volume, 3 if grid.dimension == 2 else 6, len(bodies.bodies)
        self.columns = BlockColumns(grid.dimension * grid.size, n, self._width, wp.float64, grid.device)
        body = np.full(1 + len(boundary.cut.solids), -1, dtype=np.int32)
        body[bodies.numbers] = np.arange(n)
        self._body = wp.array(body, dtype=wp.int32, device=grid.device)
        self._counts = wp.zeros(grid.shape[0] * grid.shape[1], dtype=wp.int32, device=grid.device)
        rank = self.columns.rank
        self._response = wp.zeros((rank, rank), dtype=wp.float64, device=grid.device)
        self._factors = wp.zeros(rank, dtype=wp.float64, device=grid.device)

    def take(
        self,
        level: VectorLevel,
        distance: Sequence[wp.array],
        slip: Sequence[wp.array],
        velocity: Sequence[wp.array],
        where: dict[str, Any],
    ) -> None:
        """Find what pulls the bodies in a step, and how they answer to the liquid's velocity as it is.

        Args:
            level: the equations of the step.
            distance: of each component's faces from walls [cells].
            slip: what their walls have for a slip length [cells].
            velocity: of each component [m/s].
            where: `kind` and `contact` of cells.
        """
        grid, wall = self.grid, self.boundary.cut.wall
        block = self.boundary.cut.moving_block()
        window = None if block is None else grid.window(*block, grow=1).common(grid.domain)
        centers = np.array([body.position for body in self.bodies.bodies])
        given = where | {"body": self._body, "center": wp.array(centers.ravel(), dtype=wp.float64, device=grid.device)}
        given |= {"cell": level.cell, "mixed": level.mixed, "planes": grid.planes, "dx": grid.spacing, "width": self._width}
        given |= dict(zip(("before_x", "before_y", "before_z"), grid.origin, strict=True)) | {"counts": self._counts}
        found = [(np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.int32), np.zeros((0, self._width)))]
        for axis in range(grid.dimension if window is not None else 0):
            assert window is not None
            of = given | level.across(axis) | {"axis": axis, "d": distance[axis], "h": slip[axis], "diagonal": level.diagonal[axis]}
            of |= {"wall": wall[axis], "from_": axis * grid.size}
            of |= dict(zip(("db", "dc"), level.of_others(axis, distance), strict=True))
            of |= dict(zip(("wall_b", "wall_c"), level.of_others(axis, wall), strict=True))
            found.append(self._entries(window, of))
        rows, blocks, values = (np.concatenate(parts) for parts in zip(*found, strict=True))
        self._find_response(rows, blocks, values, velocity)

    def _entries(self, window: Window, given: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return rows, bodies and values of a component's entries."""
        device = self.grid.device
        self._counts.zero_()
        window.run(self._passes.links, whole=True, **given, **dict.fromkeys(("offsets", "entry_rows", "blocks", "values")))
        counts = self._counts.numpy().copy()
        total = int(counts.sum())
        rows, blocks = (wp.zeros(total, dtype=wp.int32, device=device) for _ in range(2))
        values = wp.zeros(total * self._width, dtype=wp.float64, device=device)
        if total:
            offsets = wp.array(np.cumsum(counts) - counts, dtype=wp.int32, device=device)
            lists = {"offsets": offsets, "entry_rows": rows, "blocks": blocks, "values": values}
            window.run(self._passes.links, whole=True, **given, **lists)
        return rows.numpy(), blocks.numpy(), values.numpy().reshape(-1, self._width)

    def _find_response(self, rows: np.ndarray, blocks: np.ndarray, values: np.ndarray, velocity: Sequence[wp.array]) -> None:
        bodies, grid, dimension, width = self.bodies.bodies, self.grid, self.grid.dimension, self._width
        self.moved = len(rows) > self.columns.capacity
        if self.moved:
            self.columns.reserve(round(SPARE * len(rows)))
        self.columns.assign(rows, blocks, values)
        axes, cells = np.divmod(rows, grid.size)
        k, j, i = np.unravel_index(cells, grid.shape)
        places = (np.stack((i, j, k), axis=-1) + np.array(grid.origin) - 0.5 - 0.5 * np.eye(3)[axes]) * grid.spacing
        at = [field.numpy().ravel() for field in velocity]
        speeds = np.array([at[axis][cell] for axis, cell in zip(axes, cells, strict=True)])
        self._drag, responses = np.zeros((len(bodies), width, width)), []
        pulled = np.zeros((len(bodies), width))
        for n, body in enumerate(bodies):
            own = blocks == n
            arms = places[own] - body.position
            arms[:, dimension:] = 0.0
            turns = np.cross(np.eye(3)[None], arms[:, None])[np.arange(len(arms)), :, axes[own]]  # by the axis of the turn
            motions = np.concatenate((np.eye(3)[axes[own]][:, :dimension], turns[:, 2:] if dimension == 2 else turns), axis=1)
            drag = values[own].T @ motions
            self._drag[n], pulled[n] = 0.5 * (drag + drag.T), speeds[own] @ values[own]
            m = self._scale * body.inverse_mass(dimension)
            responses.append(np.linalg.solve(np.eye(width) + m @ self._drag[n], m))
        self._before = np.array([body.velocities(dimension) for body in bodies])
        self._pulled = pulled - np.einsum("bij,bj->bi", self._drag, self._before)
        W = scipy.linalg.block_diag(*responses)
        self._weights = 0.5 * (W + W.T)
        self._response.assign(self._weights)

    def answer(self, residual: wp.array, change: wp.array) -> None:
        """Add to a residual what bodies do that move as the liquid's velocity, changed by so much, asks."""
        self.change = self._weights @ (self._pulled.ravel() + self.columns.gather(change).numpy())
        self._factors.assign(self.change)
        self.columns.scatter(self._factors, residual, residual)

    def subtract(self, p: wp.array, q: wp.array, launch: Launch) -> None:
        """q -= C W C'p."""
        self.columns.gather(p, launch=launch)
        launch(weigh_kernel, self.columns.rank, [self._response, self.columns.sums, self._factors], device=self.grid.device)
        self.columns.scatter(self._factors, q, q, sign=-1.0, launch=launch)

    def push(self, change: wp.array) -> None:
        """Give the bodies the impulses of a step that changed the liquid's velocity by so much."""
        moved = self.change.reshape(self._before.shape)
        pulled = self._pulled + self.columns.gather(change).numpy().reshape(moved.shape) - np.einsum("bij,bj->bi", self._drag, moved)
        for body, impulse in zip(self.bodies.bodies, self._scale * pulled, strict=True):
            body.apply_impulse(impulse)
