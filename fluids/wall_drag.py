"""Quadratic wall drag of liquids whose boundary layer the grid does not resolve."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from warp_lcp.fluids.forces import WallSums
from warp_lcp.fluids.pressure import PressureProjection
from warp_lcp.fluids.wall_drag_kernels import WallDragFields, drag_kernel
from warp_lcp.grid.staggered import StaggeredGrid, Window, three_components
from warp_lcp.kernels.launch_graph import LaunchGraph, clear, copy
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.material.boundary import Boundary, CutBoundary, WholeCells


class WallDrag:
    """Wall drag: a shear stress c_f / 2 rho |u| u on the liquid beside walls.

    The velocity u is that along the wall relative to it. Cells beside a wall are FLUID cells with a
    closed part of a face, unless they are RELEASED. Each piece of wall in a cell, of area A, is
    distributed to the cell's two faces of a component in proportion to their open fractions. With
    the liquid's volume V between the two cells of a face

        du/dt = -k |u| u,   k = (sum of c_f / 2 times its shares of A) / V.

    This is solved implicitly, u / (1 + dt k |u|): exact for one wall, and never an acceleration,
    however long the step. The momentum that faces lose is applied to the walls. Where solids cut a
    cell, all of them are one plane, with the vector area of what they close and the normal along
    it. This also holds beside corners, but not in gaps of one cell, where the vector area cancels.

    V follows from the free surface, so that a sheet of thickness h slows down as u0 / (1 + c_f/2 u0
    t / h) whether it fills its cells or not, if h is at most a cell. In a deeper flow only the
    cells beside the wall are decelerated, and u is their velocity.

    Args:
        grid: the grid.
        boundary: its solids.
        coefficients: c_f of the domain's walls and of each solid, shape (1 + solids,).
        density: density of the liquid [kg/m^3].
    """

    def __init__(
        self, grid: StaggeredGrid, boundary: Boundary, coefficients: Sequence[float], density: float
    ) -> None:
        self.grid, self._mass = grid, density * grid.cell_volume
        self._before = grid.faces()
        self._losses = wp.zeros(grid.shape[0] * grid.shape[1], dtype=wp.float64, device=grid.device)
        D = WallDragFields()
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
            LaunchGraph(grid.device, self._launch_velocity_copy),
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
            sums: sums of impulses.
            window: cells that hold all liquid.
            velocity: velocity of each component [m/s] (updated where it is projected).
            projection: the projection of the step.
            phi: distance to the free surface, see `FreeSurface.phi`.
            dt: time that the drag acts [s].
            references: reference points of the solids, see `SolidForces`; None if force output is
                off.

        Returns:
            The energy that faces lose [J; J/m in 2-D], and the impulses on each solid, see
            `WallSums.take`; None if force output is off.
        """
        self._dt.value = dt
        if references is None:
            self._slowing.run(sums, window, velocity, projection, phi, variant=window.near is None)
            return float(self._losses.numpy().sum()), None
        impulses = np.zeros((sums.solids, 6))
        self._keeping.run(velocity)
        for given in self._given(sums, velocity, projection, phi, apply=False):
            impulses += sums.launch_sums(drag_kernel, window, references, given)
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
        self._launch_velocity_copy(velocity)
        for given in self._given(sums, velocity, projection, phi, apply=True):
            sums.launch(drag_kernel, window, given)

    def _launch_velocity_copy(self, velocity: Sequence[wp.array]) -> None:
        """Launch copies of the velocity, and reset the losses."""
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
    ) -> list[list[object]]:
        """Return the kernel's arguments for each component."""
        D = self._drag
        D.walls, D.kind, D.contact, D.phi = sums.walls, projection.kind, projection.contact, phi
        D.u, D.v, D.w = three_components(self._before)
        D.known_u, D.known_v, D.known_w = three_components(projection.known)
        faces = enumerate(zip(velocity, projection.known, strict=True))
        return [
            [D, axis, self._dt, self._mass, int(apply), field, known, self._losses]
            for axis, (field, known) in faces
        ]
