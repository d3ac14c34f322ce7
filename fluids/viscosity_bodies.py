"""Rigid bodies that a thick liquid drags along, and that drag it: their velocities are unknowns of the viscous step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.linalg
import warp as wp

from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.material.boundary import CutBoundary
from warp_lcp.operators.low_rank import BlockColumns, weigh_kernel
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.rows.program import Launch

SPARE = 1.5  # room for links, times those there are when there is none left


class BodyDrag:
    """Solve for liquid and bodies together, see `fluids.viscosity`.

    A link from a face to a wall weighs c and pulls the body by c (u - g'V), g the velocities of its unit motions where the link meets it.
    With C = sum of c g over links, D of c g g', and m = rho dx^d M^-1 the body's velocity is V = V1 + m (C'u - D V), so that a change of the
    liquid's velocity changes it by

        dV = W C'du,   W = (1 + m D)^-1 m,

    and the liquid's equations lose C W C', symmetric like the rest. Beside a wall links carry mu du/dn, not the traction of the stress, which
    is -mu w x n more on a wall that turns with w, n into the liquid: all around a body a torque of -2 mu volume w. D has it link by link.

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
        self, level: Any, distance: Sequence[wp.array], slip: Sequence[wp.array], velocity: Sequence[wp.array], where: Any, tau: float
    ) -> None:
        """Find the links of a step, and how the bodies answer to the liquid's velocity as it is."""
        grid, width = self.grid, self._width
        block = self.boundary.cut.moving_block()
        found: list[tuple[np.ndarray, ...]] = []
        centers = np.array([body.position for body in self.bodies.bodies])
        given = where | {"body": self._body, "center": wp.array(centers.ravel(), dtype=wp.float64, device=grid.device)}
        given |= {"cell": level.cell, "planes": grid.planes, "dx": grid.spacing, "width": width, "counts": self._counts}
        given |= dict(zip(("before_x", "before_y", "before_z"), grid.origin, strict=True))
        for axis in range(grid.dimension if block is not None else 0):
            assert block is not None
            window = grid.window(*block, grow=1).common(grid.domain)
            if window is None:
                continue
            of = given | level.across(axis) | {"axis": axis, "d": distance[axis], "h": slip[axis], "diagonal": level.diagonal[axis]}
            of |= {"wall": self.boundary.cut.wall[axis], "from_": axis * grid.size}
            nothing = dict.fromkeys(("offsets", "entry_rows", "blocks", "ways", "values", "weights"))
            self._counts.zero_()
            window.run(self._passes.links, whole=True, **of, **nothing)
            counts = self._counts.numpy()
            total = int(counts.sum())
            if not total:
                continue
            offsets = wp.array(np.cumsum(counts) - counts, dtype=wp.int32, device=grid.device)
            rows, blocks, ways = (wp.zeros(total, dtype=wp.int32, device=grid.device) for _ in range(3))
            values, weights = (wp.zeros(n, dtype=wp.float64, device=grid.device) for n in (total * width, total))
            lists = {"offsets": offsets, "entry_rows": rows, "blocks": blocks, "ways": ways, "values": values, "weights": weights}
            window.run(self._passes.links, whole=True, **of, **lists)
            found.append((rows.numpy(), blocks.numpy(), values.numpy().reshape(-1, width), weights.numpy(), ways.numpy()))
        rows, blocks, values, weights, ways = (np.concatenate(parts) for parts in zip(*found, strict=True)) if found else _nothing(width)
        self._find_response(rows, blocks, values, weights, ways, velocity, tau)

    def _find_response(
        self,
        rows: np.ndarray,
        blocks: np.ndarray,
        values: np.ndarray,
        weights: np.ndarray,
        ways: np.ndarray,
        velocity: Sequence[wp.array],
        tau: float,
    ) -> None:
        bodies, dimension = self.bodies.bodies, self.grid.dimension
        self.moved = len(rows) > self.columns.capacity
        if self.moved:
            self.columns.reserve(round(SPARE * len(rows)))
        self.columns.assign(rows, blocks, values)
        pulled = np.zeros((len(bodies), self._width))
        at = [field.numpy().ravel() for field in velocity]
        speeds = np.array([at[row // self.grid.size][row % self.grid.size] for row in rows])
        np.add.at(pulled, blocks, values * speeds[:, None])
        drags, responses = [], []
        motions, turns = values / weights[:, None], np.zeros_like(values)
        axes, normals = rows // self.grid.size, np.zeros((len(rows), 3))
        normals[np.arange(len(rows)), ways >> 1] = 1 - 2 * (ways & 1)
        for n, rotation in zip(
            range(2, 3) if dimension == 2 else range(3, 6), np.eye(3)[-1:] if dimension == 2 else np.eye(3), strict=True
        ):
            turns[:, n] = np.cross(rotation, normals)[np.arange(len(rows)), axes]
        for n, body in enumerate(bodies):
            own = blocks == n
            more = tau * self.grid.spacing * motions[own].T @ turns[own]
            drag = motions[own].T @ values[own] + 0.5 * (more + more.T)
            m = self._scale * body.inverse_mass(dimension)
            drags.append(drag)
            responses.append(np.linalg.solve(np.eye(self._width) + m @ drag, m))
        self._drag = np.array(drags)
        before = np.array([body.velocities(dimension) for body in bodies])
        self._before, self._pulled = before, pulled - np.einsum("bij,bj->bi", self._drag, before)
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


def _nothing(width: int) -> tuple[np.ndarray, ...]:
    return np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.int32), np.zeros((0, width)), np.zeros(0), np.zeros(0, dtype=np.int32)
