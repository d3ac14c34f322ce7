"""What a liquid does to each solid and to the domain's walls: forces and torques, a row a step of `forces.csv`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_lcp.fluids import forces_kernels as kernels
from warp_lcp.fluids.thin_forces_kernels import thin_pressure_kernel
from warp_lcp.fluids.wall_kernels import Walls
from warp_lcp.grid.cell_kernel import scan
from warp_lcp.grid.solids import Geometry
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.grid.voxelize import PlacedSolid
from warp_lcp.material.boundary import Boundary, CutBoundary, WholeCells
from warp_lcp.material.particle_log import Row
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.rigid.body import PLANAR, BodyMotion
from warp_lcp.rows.memory import Scalar
from warp_lcp.rows.program import LaunchGraph, clear

if TYPE_CHECKING:
    from warp_lcp.fluids.simulator import LiquidSimulation

SPARE = 1.5  # room for entries, times those there are when there is none left


def walls_of(grid: StaggeredGrid, boundary: Boundary) -> Any:
    """Return the solids of a boundary as kernels take them, `wall_kernels.Walls`."""
    S = Walls()
    S.planes, S.spacing, S.origin = grid.planes, grid.spacing, wp.vec3i(*grid.origin)
    if isinstance(boundary, CutBoundary):
        cut = boundary.cut
        S.open_x, S.open_y, S.open_z = (*cut.open, *cut.open[:1])[:3]
        S.wall_x, S.wall_y, S.wall_z = (*cut.wall, *cut.wall[:1])[:3]
        S.distance = cut.distance
        if cut.moves:
            S.moving = cut.moving
        if (barriers := boundary.barriers) is not None:
            for axis, number, below, above in zip(
                "xyz", barriers.number, barriers.below, barriers.above, strict=False
            ):
                setattr(S, f"number_{axis}", number)
                setattr(S, f"below_{axis}", below)
                setattr(S, f"above_{axis}", above)
    else:
        assert isinstance(boundary, WholeCells)
        S.index = boundary.solids.index
    return S


class WallSums:
    """Add up what kernels find on closed parts of faces, by solid; the same on every run, whatever the threads.

    A kernel is launched twice, with a thread a row: to count its entries, and to write them. It
    takes, behind the cells, `walls`, reference points, counts, offsets, owners and values (the last
    three null when it counts) and what else is given.

    Args:
        grid: the grid.
        boundary: its solids.
        solids: how many, the domain's walls among them.
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

    def take(
        self, kernel: wp.Kernel, window: Window, references: np.ndarray, given: Sequence[Any]
    ) -> np.ndarray:
        """Return the sums of a kernel's entries, shape (solids, 6): impulses [N s] and, about `references`, their moments [N m s].

        Args:
            kernel: what finds them.
            window: cells that it visits.
            references: a point of each solid [m], shape (solids, 3).
            given: further arguments.
        """
        self._about.assign(references)
        self._counting.run(kernel, window, list(given), variant=window.near is None)
        total = int(self._offsets.numpy()[-1]) + int(self._counts.numpy()[-1])
        if total == 0:
            return np.zeros((self.solids, 6))
        if total > len(self._owners):
            self._reserve(round(SPARE * total))
        self._writing.run(kernel, window, list(given), variant=window.near is None)
        owners, values = self._owners.numpy()[:total], self._values.numpy()[:total]
        return np.stack(
            [np.bincount(owners, weights=column, minlength=self.solids) for column in values.T],
            axis=-1,
        )

    def _count(self, kernel: wp.Kernel, window: Window, given: list[Any]) -> None:
        """Launch the count of a kernel's entries, and find where those of each row begin."""
        clear(self._counts)
        window.launch_rows(
            kernel, [self.walls, self._about, self._counts, None, None, None, *given]
        )
        scan(self._counts, self._offsets, inclusive=False)

    def _write(self, kernel: wp.Kernel, window: Window, given: list[Any]) -> None:
        """Launch what writes a kernel's entries."""
        window.launch_rows(
            kernel,
            [
                self.walls,
                self._about,
                self._counts,
                self._offsets,
                self._owners,
                self._values,
                *given,
            ],
        )

    def launch(self, kernel: wp.Kernel, window: Window, given: Sequence[Any]) -> None:
        """Launch a kernel for what else it does; its entries are counted only."""
        window.launch_rows(kernel, [self.walls, None, self._counts, None, None, None, *given])

    def _reserve(self, count: int) -> None:
        self._owners = wp.zeros(count, dtype=wp.int32, device=self.grid.device)
        self._values = wp.zeros((count, 6), dtype=wp.float64, device=self.grid.device)
        self._writing.forget()


class SolidForces:
    """Collect a step's impulses on each solid, whatever model finds them, and tell forces and torques.

    The pressure of a cell acts on the parts of its faces that are closed, whose sum over a cell is
    the vector area of the wall in it: what it pushes off the wall there is what it pushes the
    liquid with, without loss, whether walls cut cells or fill them. It is continued from the cell's
    center to the wall. Half a cell from a wall of whole cells, or the domain's, it takes what stops
    the liquid in between: 1/2 rho dx^d (u* - u_s) on a closed face, of which u* is the velocity
    before the projection, and a pool's floor so bears all of it. To solids that cut cells it goes
    on by the pressure at rest's gradient; rigid bodies are told what the coupling gives them,
    without that.

    Divided by the time that forces act in a step impulses are forces at its beginning: what the
    trapezoidal rule makes of a table's forces is the impulse. Where two solids touch within a cell
    either may have what is buried between them; their sum is right.

    A torque is about the solid's own point: a rigid body's center of mass; of another solid the
    center of the box around it as the scene places it, which its motion takes along; the origin for
    the domain, for half spaces, and for what is all but a shape.

    Args:
        solids: in the order of their numbers, 1 + s; the domain is number 0.
        dimension: 2 or 3.

    Attributes:
        impulses: in the step so far [N s, N m s], shape (1 + solids, 6); in 2-D per meter of depth.
        references: the solids' own points [m], shape (1 + solids, 3).
    """

    def __init__(self, solids: Sequence[PlacedSolid], dimension: int) -> None:
        self._solids, self._dimension = tuple(solids), dimension
        self._centers = np.array(
            [np.zeros(3), *(_center(solid.geometry, dimension) for solid in solids)]
        )
        self.impulses, self.references = np.zeros((1 + len(solids), 6)), self._centers
        self._kick = [Scalar() for _ in range(3)]
        # whether each solid is a rigid body, once the device is known
        self._bodies: wp.array | None = None

    def columns(self) -> tuple[str, ...]:
        """Return `domain_fx`, `solid0_fx` and so on, [N], and `domain_tx` and so on, [N m]; 2-D: _fx, _fy [N/m], _torque [N]."""
        parts = (
            ("fx", "fy", "torque") if self._dimension == 2 else ("fx", "fy", "fz", "tx", "ty", "tz")
        )
        return tuple(
            f"{name}_{part}"
            for name in ("domain", *(f"solid{n}" for n in range(len(self._solids))))
            for part in parts
        )

    def begin(self, time: float) -> None:
        """Begin a step at a time [s], before models add to it and solids move."""
        self.impulses, self.references = np.zeros_like(self.impulses), self._centers.copy()
        for number, solid in enumerate(self._solids, start=1):
            if isinstance(solid.motion, BodyMotion):
                self.references[number] = solid.motion.body.position
            elif solid.motion is not None:
                self.references[number] = solid.motion.pose(time).apply(
                    self._centers[number][None]
                )[0]

    def add(self, impulses: np.ndarray) -> None:
        """Add what a model's traction has given each solid in the step, [N s, N m s] about `references`, shape (1 + solids, 6)."""
        self.impulses += impulses

    def add_pressure(self, sums: WallSums, window: Window, simulation: LiquidSimulation) -> None:
        """Add what a step's pressure has given; the velocity of closed faces must be that before the projection still."""
        velocity, projection, scale = (
            simulation.velocity,
            simulation.projection,
            simulation.scene.physics.density * sums.grid.cell_volume,
        )
        if self._bodies is None:
            bodies = [False, *(isinstance(s.motion, BodyMotion) for s in self._solids)]
            self._bodies = wp.array(bodies, dtype=wp.uint8, device=sums.grid.device)
        given = [
            self._bodies,
            simulation.boundary.touch,
            projection.pressure,
            *(*velocity, velocity[0])[:3],
        ]
        for number, change in zip(self._kick, simulation.gravity * simulation.kick_dt, strict=True):
            number.value = float(change)
        self.add(
            sums.take(
                kernels.pressure_kernel, window, self.references, [*given, *self._kick, scale]
            )
        )
        if sums.grid.barriers is not None:
            thin = [simulation.boundary.touch, projection.pressure, *self._kick, scale]
            self.add(sums.take(thin_pressure_kernel, window, self.references, thin))

    @staticmethod
    def push(bodies: RigidBodies, impulses: np.ndarray) -> None:
        """Give rigid bodies impulses that they have not got otherwise, of the shape of `impulses`."""
        six = impulses[bodies.numbers]
        bodies.bodies.apply_impulses(six if bodies.dimension == 3 else six[:, PLANAR])

    def row(self, kick_dt: float) -> Row:
        """Return forces and torques of the step, in which forces acted for `kick_dt` [s]."""
        shown = self.impulses if self._dimension == 3 else self.impulses[:, PLANAR]
        return dict(zip(self.columns(), (shown / kick_dt).ravel().tolist(), strict=True))


def _center(geometry: Geometry, dimension: int) -> np.ndarray:
    """Return the center of the box around a shape [m], the origin if there is none, shape (3,)."""
    bounds, center = geometry.bounds(), np.zeros(3)
    if bounds is not None and np.isfinite(bounds[:, :dimension]).all():
        center[:dimension] = bounds[:, :dimension].mean(axis=0)
    return center
