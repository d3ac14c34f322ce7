"""Rigid bodies in the pressure solve: displaced volume and pressure impulses."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.fluids import coupling_kernels as kernels
from warp_lcp.fluids.carried_liquid import CarriedLiquid
from warp_lcp.fluids.forces import walls_of
from warp_lcp.grid.staggered import ActiveWindow, StaggeredGrid
from warp_lcp.kernels.host_array import HostArray
from warp_lcp.kernels.launch_graph import LaunchGraph, call, clear, launch
from warp_lcp.material.boundary import CutBoundary
from warp_lcp.operators.low_rank import BlockColumns
from warp_lcp.rigid.bodies import RigidBodies

LEAST = 4096  # least capacity for entries on a GPU, which counts them during the solve
SPARE = 1.5  # factor on the number of entries when the buffer is enlarged


class BodyCoupling:
    """Coupling of rigid bodies and liquid by one pressure.

    The method is that of [Batty, Bertails & Bridson 2007]. A body's velocity after the pressure's
    impulse I = rho dx^d U'x is V* + M^-1 I, with x in m/s. The outflow of a cell gains U V. The
    entry U_iq is the sum over the faces of cell i of s_f (1 - a_f) times the velocity of unit
    motion q at the face's center, with s_f = +-1 outward. With b from V* the outflow is

        y = b + (A + rho dx^d U M^-1 U') x.

    The operator is symmetric and positive semi-definite like A. Liquid and body exchange opposite
    impulses on the same faces: momentum is conserved exactly, and energy up to the residual y.

    Args:
        grid: the grid.
        boundary: its solids, with the bodies among them.
        bodies: the bodies.
        density: density of the liquid [kg/m^3].
        share: factor on U V in the outflow, for a problem in terms of mass, see
            `fluids.unilateral_pressure`.
        open_parts: fields in place of the open fractions of the faces of each component.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        boundary: CutBoundary,
        bodies: RigidBodies,
        density: float,
        *,
        share: float = 1.0,
        open_parts: Sequence[wp.array] = (),
    ) -> None:
        self.grid, self.boundary, self.bodies, self._solved = (
            grid,
            boundary,
            bodies,
            grid.part.owned,
        )
        self._scale, self._share = density * grid.cell_volume, share
        barriers, self.carried = boundary.barriers, None
        if barriers is not None and not set(barriers.walls.numbers).isdisjoint(bodies.numbers):
            self.carried = CarriedLiquid(grid, barriers, bodies, density)
        self.width = 3 if grid.dimension == 2 else 6
        low, high = np.array(self._solved.low) - 1, np.array(self._solved.high) + 1
        self.columns = BlockColumns(
            int(np.prod(high - low)), len(bodies.bodies), self.width, wp.float64, grid.device
        )
        if grid.device.is_cuda:
            self.columns.reserve(LEAST)
        body = np.full(1 + len(boundary.cut.solids), -1, dtype=np.int32)
        body[bodies.numbers] = np.arange(len(bodies.bodies))
        S = kernels.CoupledBodies()
        S.walls, S.bodies = walls_of(grid, boundary), len(bodies.bodies)
        if open_parts:
            walls = S.walls
            walls.open_x, walls.open_y, walls.open_z = (*open_parts, open_parts[0])[:3]
            S.walls = walls
        S.low, S.rows, S.row = wp.vec3i(*low.tolist()), int((high - low)[1]), int((high - low)[2])
        S.body = wp.array(body, dtype=wp.int32, device=grid.device)
        self._center = HostArray(len(bodies.bodies), wp.vec3d, grid.device)
        S.center = self._center.array
        self._solids = S
        rows = grid.shape[0] * grid.shape[1]
        self._counts, self._offsets = (
            wp.zeros(rows, dtype=wp.int32, device=grid.device) for _ in range(2)
        )
        self._low: wl.LowRankOperator | None = None
        self._flat: wp.array | None = None  # flat values of the last solution
        # Field of cell kinds whose entries the host has not counted yet, see `grow_entries`.
        self._pending: wp.array | None = None
        self._beside, self._enclosing = ActiveWindow(grid.domain), ActiveWindow(grid.domain)
        self._counting = LaunchGraph(grid.device, self._launch_count)
        self._entering = LaunchGraph(grid.device, self._launch_entries)
        self._gathering = LaunchGraph(grid.device, self._launch_gather)
        self._holding = LaunchGraph(grid.device, self._launch_enclosed)

    def join(self, A: wl.GridPoisson) -> wl.SumOperator:
        """Return the operator A + rho dx^d U M^-1 U' of liquid and bodies.

        `update` updates it in place.
        """
        self._low = wl.LowRankOperator.of_blocks(A, self.columns, self._weights())
        self._gathering.at_once = self.columns.comm is not None
        return wl.SumOperator(A, self._low)

    def update(self, kind: wp.array) -> None:
        """Update U for the placed solids, and M^-1.

        Args:
            kind: int8 of AIR, FLUID, SOLID.
        """
        self._center.host[:] = self.bodies.bodies.position
        self._center.send()
        block = self._block()
        window = None if block is None else self.grid.window(*block).common(self._solved)
        if window is None:
            self.columns.count.zero_()
        else:
            self._beside.move_to(window)
            self._enter(kind)
        self._pending = kind if window is not None and self.grid.device.is_cuda else None
        if self._low is not None:
            self._low.update(self._weights(), symmetric=True)

    def grow_entries(self) -> bool:
        """Write the entries of U again if they exceeded the buffer of a GPU.

        Returns:
            Whether entries were missing, so that the solve must be repeated.
        """
        kind, self._pending = self._pending, None
        if kind is None or self.columns.wanted() <= self.columns.capacity:
            return False
        self._enter_all(kind)
        if self._low is not None:
            self._low.update()
        return True

    def _enter(self, kind: wp.array) -> None:
        """Write the entries of U for the cells of the window.

        A GPU does not wait for their number, see `grow_entries`.
        """
        columns = self.columns
        self._counting.run(kind, variant=columns.capacity)
        columns.counting()
        if self.grid.device.is_cuda:
            self._entering.run(kind, variant=columns.rows.ptr)
        else:
            self._enter_all(kind)

    def _enter_all(self, kind: wp.array) -> None:
        """Write all counted entries of U."""
        columns, total = self.columns, self.columns.wanted()
        if total > columns.capacity:
            columns.reserve(round(SPARE * total))
            columns.count.fill_(total)
        if total:
            self._entering.run(kind, variant=columns.rows.ptr)

    def _launch_count(self, kind: wp.array) -> None:
        """Count the entries of each row of cells, and compute their offsets."""
        clear(self._counts)
        self._beside.launch_rows(
            kernels.enter_kernel, [self._solids, kind, self._counts, None, None, None, None]
        )
        first, device = 0, self.grid.device  # the first row, whose offset is 0
        if device.is_cuda:
            call(partial(wp.utils.array_scan, self._counts, self._offsets, inclusive=False))
            first = len(self._counts) - 1
        launch(
            kernels.offsets_kernel,
            1,
            [first, self._counts, self._offsets, self.columns.capacity, self.columns.count],
            device=device,
        )

    def _launch_entries(self, kind: wp.array) -> None:
        entries = [self.columns.rows, self.columns.blocks, self.columns.values]
        self._beside.launch_rows(
            kernels.enter_kernel, [self._solids, kind, self._counts, self._offsets, *entries]
        )

    def push(self, x: wp.array) -> None:
        """Apply the impulses of x = kick_dt p / (rho dx) [m/s] to the bodies."""
        products = self._low.products_at(x) if self._low is not None else None
        if products is None:
            if self._flat is None or self._flat.ptr != x.ptr:
                self._flat = x.flatten()
            self._gathering.run(self._flat, variant=self.columns.rows.ptr)
            products = self.columns.summed()
        impulses = self._scale * products.reshape(-1, self.width)
        if self.carried is not None:
            impulses = self.carried.share(impulses)
        self.bodies.bodies.apply_impulses(impulses)

    def _launch_gather(self, x: wp.array) -> None:
        self.columns.gather(x, launch=launch)

    def move_buried(self, velocity: Sequence[wp.array], known: Sequence[wp.array]) -> None:
        """Move particles that a body has buried along with it; collective.

        Below a body that rests on a floor only gravity would act on them.

        Args:
            velocity: velocity of each component [m/s] (updated on closed faces away from the
                liquid).
            known: int8, > 0 where the velocity has been extrapolated.
        """
        block = self._block()
        if block is not None:
            self._enclosing.move_to(self.grid.window(*block, grow=1))
            self._holding.run(velocity, known)
        # Ranks get the extrapolated values from the owners of the cells.
        self.grid.part.fill(*velocity)

    def _launch_enclosed(self, velocity: Sequence[wp.array], known: Sequence[wp.array]) -> None:
        for fields in zip(self.boundary.open, self.boundary.velocity, known, velocity, strict=True):
            self._enclosing.launch(kernels.enclosed_kernel, list(fields))

    def take_along(self, velocity: Sequence[wp.array], kind: wp.array) -> None:
        """Share the momentum of liquid beside thin bodies with them.

        Before the pressure acts; collective.

        Args:
            velocity: u* of each component [m/s].
            kind: int8 of AIR, FLUID, SOLID.
        """
        if self.carried is not None:
            self.carried.update(velocity, kind)

    def _block(self) -> tuple[list[int], list[int]] | None:
        """Return the first and last cell (x, y, z) beside moving solids; None without any."""
        block = self.boundary.cut.moving_block()
        if self.carried is None or self.boundary.barriers is None:
            return block
        near = self.boundary.barriers.reach.common(self.grid.domain)
        if near is None:
            return block
        low, high = [*near.low[::-1]], [n - 1 for n in near.high[::-1]]
        if block is not None:
            low, high = [*map(min, low, block[0])], [*map(max, high, block[1])]
        return low, high

    def _weights(self) -> np.ndarray:
        """Return rho dx^d M^-1 of all bodies, block diagonal."""
        inverses = self.bodies.bodies.inverse_masses(self.grid.dimension)
        if self.carried is not None:
            inverses = self.carried.inverse_masses(inverses)
        n = np.arange(len(inverses))
        blocks = np.zeros((len(n), self.width, len(n), self.width))
        blocks[n, :, n] = self._share * self._scale * inverses
        return blocks.reshape(len(n) * self.width, -1)
