"""Drag along walls, for liquids whose boundary layer no grid resolves: a quadratic law beside walls that hold the liquid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.fluids.forces import WallSums
from warp_lcp.fluids.pressure import PressureProjection
from warp_lcp.fluids.wall_drag_kernels import Drag, drag_kernel
from warp_lcp.grid.staggered import StaggeredGrid, Window, three_components
from warp_lcp.material.boundary import Boundary, CutBoundary, WholeCells
from warp_lcp.rows.memory import Scalar
from warp_lcp.rows.program import LaunchGraph, clear, copy


class WallDrag:
    """Slow down the liquid beside walls: a shear stress c_f / 2 rho |u| u, with u the velocity along the wall relative to it.

    Beside a wall lie FLUID cells with a closed part of a face, unless they are RELEASED. A cell
    hands each piece of wall in it, of area A, to its two faces of a component in proportion to what
    they leave open, and a face with the liquid's volume V between its two cells has

        du/dt = -k |u| u,   k = (sum of c_f / 2 times its shares of A) / V,

    solved at once, u / (1 + dt k |u|): exact for one wall, and never faster than before, however
    long the step. What faces lose walls get. Where solids cut a cell all of them are one plane,
    with the vector area of what they close and the normal along it: beside corners too, and not in
    gaps of one cell, where it cancels.

    V is that of the liquid in the face's cells as the surface lies, so that a sheet of thickness h
    slows down as u0 / (1 + c_f/2 u0 t / h) whether it fills its cells or not, if h is at most a
    cell. Of a deeper flow the cells beside the wall alone slow down, and u is theirs.

    Args:
        grid: the grid.
        boundary: its solids.
        coefficients: c_f of the domain's walls and of each solid, shape (1 + solids,).
        density: of the liquid [kg/m^3].
    """

    def __init__(
        self, grid: StaggeredGrid, boundary: Boundary, coefficients: Sequence[float], density: float
    ) -> None:
        self.grid, self._mass = grid, density * grid.cell_volume
        self._before = grid.faces()
        self._losses = wp.zeros(grid.shape[0] * grid.shape[1], dtype=wp.float64, device=grid.device)
        D = Drag()
        D.coefficient = wp.array(
            0.5 * np.asarray(coefficients), dtype=wp.float32, device=grid.device
        )
        if isinstance(boundary, CutBoundary):
            D.turn, D.shift = boundary.cut.turn, boundary.cut.shift
        else:
            assert isinstance(boundary, WholeCells)
            still = np.zeros((len(coefficients), 3))
            D.shift = wp.array(
                still if boundary.wall_velocity is None else boundary.wall_velocity,
                dtype=wp.vec3,
                device=grid.device,
            )
            D.turn = wp.zeros(len(coefficients), dtype=wp.mat33, device=grid.device)
        self._drag, self._dt = D, Scalar()
        self._slowing, self._keeping = (
            LaunchGraph(grid.device, self._slow_down),
            LaunchGraph(grid.device, self._keep),
        )

    def act(
        self,
        sums: WallSums,
        window: Window,
        velocity: Sequence[wp.array],
        projection: PressureProjection,
        phi: wp.array | None,
        dt: float,
        references: np.ndarray | None,
    ) -> tuple[float, np.ndarray | None]:
        """Slow down the projected faces.

        Args:
            sums: adds up impulses.
            window: cells that hold all liquid.
            velocity: of each component [m/s] (updated where it is projected).
            projection: that has just been made.
            phi: as of the free surface.
            dt: how long the drag acts [s].
            references: the solids' points, see `SolidForces`; None: nobody asks for impulses.

        Returns:
            The energy that faces lose [J; J/m in 2-D], and the impulses on each solid, as of
            `WallSums.take`; None: nobody asks.
        """
        self._dt.value = dt
        if references is None:
            self._slowing.run(sums, window, velocity, projection, phi, variant=window.near is None)
            return float(self._losses.numpy().sum()), None
        impulses = np.zeros((sums.solids, 6))
        self._keeping.run(velocity)
        for given in self._given(sums, velocity, projection, phi, apply=False):
            impulses += sums.take(drag_kernel, window, references, given)
        return float(self._losses.numpy().sum()), impulses

    def _slow_down(
        self,
        sums: WallSums,
        window: Window,
        velocity: Sequence[wp.array],
        projection: PressureProjection,
        phi: wp.array | None,
    ) -> None:
        """Launch the drag without the output of impulses."""
        self._keep(velocity)
        for given in self._given(sums, velocity, projection, phi, apply=True):
            sums.launch(drag_kernel, window, given)

    def _keep(self, velocity: Sequence[wp.array]) -> None:
        """Launch copies of the velocity as it was, and begin with no losses."""
        for before, field in zip(self._before, velocity, strict=True):
            copy(before, field)
        clear(self._losses)

    def _given(
        self,
        sums: WallSums,
        velocity: Sequence[wp.array],
        projection: PressureProjection,
        phi: wp.array | None,
        *,
        apply: bool,
    ) -> list[list[Any]]:
        """Return what the kernel takes for each component."""
        D = self._drag
        D.walls, D.kind, D.contact, D.phi = sums.walls, projection.kind, projection.contact, phi
        D.u, D.v, D.w = three_components(self._before)
        D.known_u, D.known_v, D.known_w = three_components(projection.known)
        faces = enumerate(zip(velocity, projection.known, strict=True))
        return [
            [D, axis, self._dt, self._mass, int(apply), field, known, self._losses]
            for axis, (field, known) in faces
        ]
