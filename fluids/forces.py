"""Forces and torques of the liquid on solids and walls, one row per step.

They are written to `forces.csv`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_lcp.fluids import forces_kernels as kernels
from warp_lcp.fluids.thin_forces_kernels import thin_pressure_kernel
from warp_lcp.fluids.wall_kernels import WallKernelFields
from warp_lcp.grid.cell_kernel import scan
from warp_lcp.grid.signed_distance import Geometry
from warp_lcp.grid.staggered import StaggeredGrid, Window, three_components
from warp_lcp.grid.voxelize import PlacedSolid
from warp_lcp.kernels.launch_graph import LaunchGraph, clear
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.material.boundary import Boundary, CutBoundary, WholeCells
from warp_lcp.material.particle_log import Row
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.rigid.body import PLANAR, BodyMotion

if TYPE_CHECKING:
    from warp_lcp.fluids.simulator import LiquidSimulation

SPARE = 1.5  # factor on the number of entries when the buffer is enlarged


def walls_of(grid: StaggeredGrid, boundary: Boundary) -> WallKernelFields:
    """Return the solids of a boundary as `wall_kernels.WallKernelFields`."""
    S = WallKernelFields()
    S.planes, S.spacing, S.origin = grid.planes, grid.spacing, wp.vec3i(*grid.origin)
    if isinstance(boundary, CutBoundary):
        cut = boundary.cut
        S.open_x, S.open_y, S.open_z = (*cut.open, *cut.open[:1])[:3]
        S.wall_x, S.wall_y, S.wall_z = (*cut.wall, *cut.wall[:1])[:3]
        S.distance = cut.distance
        if cut.moves:
            S.moving = cut.moving
        if (barriers := boundary.barriers) is not None:
            S.number_x, S.number_y, S.number_z = three_components(barriers.number)
            S.below_x, S.below_y, S.below_z = three_components(barriers.below)
            S.above_x, S.above_y, S.above_z = three_components(barriers.above)
    else:
        assert isinstance(boundary, WholeCells)
        S.index = boundary.solids.index
    return S


class WallSums:
    """Sum impulses on closed parts of faces by solid, in a deterministic order.

    The sums do not depend on the number of threads. A kernel is launched twice, with one thread per
    row: to count its entries, and to write them. After the cells its arguments are `walls`,
    reference points, counts, offsets, owners and values (the last three are null while it counts),
    then further arguments.

    Args:
        grid: the grid.
        boundary: its solids.
        solids: their number, including the domain's walls.
    """

    def __init__(self, grid: StaggeredGrid, boundary: Boundary, solids: int) -> None:
        self.grid, self.solids, self.walls = grid, solids, walls_of(grid, boundary)
        rows = grid.shape[0] * grid.shape[1]
        self._counts, self._offsets = (
            wp.zeros(rows, dtype=wp.int32, device=grid.device) for _ in range(2)
        )
        self._about = wp.zeros(solids, dtype=wp.vec3d, device=grid.device)
        self._counting, self._writing = (
            LaunchGraph(grid.device, record) for record in (self._count, self._write)
        )
        self._reserve(0)

    def launch_sums(
        self,
        kernel: wp.Kernel,
        window: Window,
        references: np.ndarray,
        kernel_args: Sequence[object],
    ) -> np.ndarray:
        """Return the sums of a kernel's entries, shape (solids, 6).

        The first three columns are impulses [N s], the others their moments about `references` [N m
        s].

        Args:
            kernel: the kernel that finds the entries.
            window: cells that the kernel visits.
            references: a point of each solid [m], shape (solids, 3).
            kernel_args: further arguments.
        """
        self._about.assign(references)
        self._counting.run(kernel, window, list(kernel_args), variant=window.near is None)
        total = int(self._offsets.numpy()[-1]) + int(self._counts.numpy()[-1])
        if total == 0:
            return np.zeros((self.solids, 6))
        if total > len(self._owners):
            self._reserve(round(SPARE * total))
        self._writing.run(kernel, window, list(kernel_args), variant=window.near is None)
        owners, values = self._owners.numpy()[:total], self._values.numpy()[:total]
        return np.stack(
            [np.bincount(owners, weights=column, minlength=self.solids) for column in values.T],
            axis=-1,
        )

    def _count(self, kernel: wp.Kernel, window: Window, kernel_args: list[object]) -> None:
        """Launch a kernel that counts entries, and compute the offsets of the rows."""
        clear(self._counts)
        window.launch_rows(
            kernel, [self.walls, self._about, self._counts, None, None, None, *kernel_args]
        )
        scan(self._counts, self._offsets, inclusive=False)

    def _write(self, kernel: wp.Kernel, window: Window, kernel_args: list[object]) -> None:
        """Launch a kernel that writes its entries."""
        window.launch_rows(
            kernel,
            [
                self.walls,
                self._about,
                self._counts,
                self._offsets,
                self._owners,
                self._values,
                *kernel_args,
            ],
        )

    def launch(self, kernel: wp.Kernel, window: Window, given: Sequence[object]) -> None:
        """Launch a kernel for its other effects; its entries are only counted."""
        window.launch_rows(kernel, [self.walls, None, self._counts, None, None, None, *given])

    def _reserve(self, count: int) -> None:
        self._owners = wp.zeros(count, dtype=wp.int32, device=self.grid.device)
        self._values = wp.zeros((count, 6), dtype=wp.float64, device=self.grid.device)
        self._writing.forget()


class SolidForces:
    """Sum each solid's impulses in a step, and return forces and torques.

    The pressure of a cell acts on the closed parts of its faces. Their sum over a cell is the
    vector area of the wall in it, for cut and for whole cells, so that liquid and wall receive
    exactly opposite impulses.

    The pressure is extrapolated from the cell's center to the wall. On walls of whole cells and of
    the domain, half a cell away, it gains the impulse that stops the liquid in between: 1/2 rho
    dx^d (u* - u_s) on a closed face, with u* the velocity before the projection. The floor of a
    pool so carries the full weight. On solids that cut cells it is extrapolated with the
    hydrostatic gradient. Rigid bodies get the impulses of the coupling, without this extrapolation.

    Divided by the time that forces act in a step, impulses are forces at the beginning of the step:
    the trapezoidal rule over the forces of a table gives the impulse. Where two solids touch within
    a cell, either may have the part that is buried between them; their sum is right.

    Torques are about a point of the solid: the center of mass of a rigid body; for another solid
    the center of the box around it in the scene, moved with the solid; the origin for the domain,
    for half spaces and for inverted shapes.

    Args:
        solids: in the order of their numbers, 1 + s; number 0 is the domain.
        dimension: 2 or 3.

    Attributes:
        impulses: sums of the step so far [N s, N m s], shape (1 + solids, 6); in 2-D per meter of
            depth.
        references: reference points of the torques [m], shape (1 + solids, 3).
    """

    def __init__(self, solids: Sequence[PlacedSolid], dimension: int) -> None:
        self._solids, self._dimension = tuple(solids), dimension
        self._centers = np.array(
            [np.zeros(3), *(_center(solid.geometry, dimension) for solid in solids)]
        )
        self.impulses, self.references = np.zeros((1 + len(solids), 6)), self._centers
        self._kick = [Scalar() for _ in range(3)]
        # Flags of rigid bodies among the solids; allocated when the device is known.
        self._bodies: wp.array | None = None

    def columns(self) -> tuple[str, ...]:
        """Return the column names of forces [N] and torques [N m].

        In 3-D `domain_fx`, `solid0_fx` and so on [N], and `domain_tx` and so on [N m]; in 2-D _fx
        and _fy [N/m] and _torque [N].
        """
        parts = (
            ("fx", "fy", "torque") if self._dimension == 2 else ("fx", "fy", "fz", "tx", "ty", "tz")
        )
        return tuple(
            f"{name}_{part}"
            for name in ("domain", *(f"solid{n}" for n in range(len(self._solids))))
            for part in parts
        )

    def begin(self, time: float) -> None:
        """Begin a step at a time [s], before models add impulses and solids move."""
        self.impulses, self.references = np.zeros_like(self.impulses), self._centers.copy()
        for number, solid in enumerate(self._solids, start=1):
            if isinstance(solid.motion, BodyMotion):
                self.references[number] = solid.motion.body.position
            elif solid.motion is not None:
                self.references[number] = solid.motion.pose(time).apply(
                    self._centers[number][None]
                )[0]

    def add(self, impulses: np.ndarray) -> None:
        """Add the impulses of a model's traction on each solid in the step.

        Shape (1 + solids, 6), [N s] and [N m s] about `references`.
        """
        self.impulses += impulses

    def add_pressure(self, sums: WallSums, window: Window, simulation: LiquidSimulation) -> None:
        """Add the impulses of a step's pressure.

        Closed faces must still have their velocity before the projection.
        """
        velocity, projection, scale = (
            simulation.velocity,
            simulation.projection,
            simulation.scene.physics.density * sums.grid.cell_volume,
        )
        if self._bodies is None:
            bodies = [False, *(isinstance(s.motion, BodyMotion) for s in self._solids)]
            self._bodies = wp.array(bodies, dtype=wp.uint8, device=sums.grid.device)
        kernel_args = [
            self._bodies,
            simulation.boundary.touch,
            projection.pressure,
            *(*velocity, velocity[0])[:3],
        ]
        for number, change in zip(self._kick, simulation.gravity * simulation.kick_dt, strict=True):
            number.value = float(change)
        self.add(
            sums.launch_sums(
                kernels.pressure_kernel, window, self.references, [*kernel_args, *self._kick, scale]
            )
        )
        if sums.grid.barriers is not None:
            thin = [simulation.boundary.touch, projection.pressure, *self._kick, scale]
            self.add(sums.launch_sums(thin_pressure_kernel, window, self.references, thin))

    @staticmethod
    def push(bodies: RigidBodies, impulses: np.ndarray) -> None:
        """Apply impulses to the rigid bodies that no other model applies.

        The shape is that of `impulses`.
        """
        six = impulses[bodies.numbers]
        bodies.bodies.apply_impulses(six if bodies.dimension == 3 else six[:, PLANAR])

    def row(self, kick_dt: float) -> Row:
        """Return forces and torques of a step in which forces acted for `kick_dt` [s]."""
        shown = self.impulses if self._dimension == 3 else self.impulses[:, PLANAR]
        return dict(zip(self.columns(), (shown / kick_dt).ravel().tolist(), strict=True))


def _center(geometry: Geometry, dimension: int) -> np.ndarray:
    """Return the center of the box around a shape [m], shape (3,).

    The origin if the shape has no finite box.
    """
    bounds, center = geometry.bounds(), np.zeros(3)
    if bounds is not None and np.isfinite(bounds[:, :dimension]).all():
        center[:dimension] = bounds[:, :dimension].mean(axis=0)
    return center
