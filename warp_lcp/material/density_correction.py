"""Density correction: LCP for a displacement that removes overfull cells.

The module also has a monitor of the density ([Book] 1.3.3).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import no_type_check

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.grid.barrier_fields import FAR
from warp_lcp.grid.domain_sides import PeriodicSides
from warp_lcp.grid.level_set import Fill, particle_density
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import ActiveWindow, DirtyRegion, StaggeredGrid, Window
from warp_lcp.grid.window_reduction import WindowReduction
from warp_lcp.kernels import KernelFile, StencilKernel
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.launch_graph import LaunchGraph, copy, launch
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.material.boundary import Boundary
from warp_lcp.material.boundary_kernels import RELEASED
from warp_lcp.operators.grid_poisson import AIR, FLUID, SOLID
from warp_lcp.problem.method_protocol import Solver
from warp_lcp.problem.stopping import MeanCriteria
from warp_lcp.settings import renamed_names

CONSTANTS = {"FLUID": FLUID, "SOLID": SOLID, "AIR": AIR, "RELEASED": RELEASED} | {
    # Least density by which displacements are divided: thin spray need not take up the excess of a
    # full cell.
    "LEAST_DENSITY": 0.5,
    "LEAST_CAPACITY": 0.1,  # least capacity by which densities are divided there
    "HALF": 0.5,  # share of what a cell can hold; a cell with less is at the surface
    "FAR": int(FAR),  # mark of cells away from thin solids
}


KERNELS = KernelFile(Path(__file__).parent / "headers/particle_models.h", CONSTANTS)
PREPARE = KERNELS["warp_lcp.material.density_correction.prepare_correction"]
EVEN = KERNELS["warp_lcp.material.density_correction.even"]
CROWD = KERNELS["warp_lcp.material.crowding.crowd"]


@functools.cache
def displacement_pass(cut: bool) -> StencilKernel:
    """Return the kernel of the displacement; with `cut`, faces have open fractions."""
    name = "warp_lcp.material.density_correction"
    return KERNELS.kernel(f"{name}.displace", module=name + "_cut" * cut, constants={"CUT": cut})


@forward_kernel(module="warp_lcp.material.density_correction.count")
@no_type_check
def add_kernel(
    a: wp.array(dtype=wp.float64), b: wp.array(dtype=wp.float64), sum: wp.array(dtype=wp.float64)
):
    """Add up two numbers."""
    sum[0] = a[0] + b[0]


LONGEST = 0.5  # cells by which a correction moves a particle at most
# Root mean square excess of overfull cells that is not worth a solve, relative to a cell.
EXCESS = 1e-3
# Fraction of the diagonal. It gives closed pockets a solution, and leaves 0.5 % of the excess 45
# cells deep.
SHIFT = 1e-5


class DensityMonitor:
    """Density monitor: fraction of the material in overfull cells.

    `measure` and `read_densities` are collective.

    Args:
        grid: the grid.
        boundary: solids and walls.
        particles_a_cell: number of particles in a cell of material at rest.
        max_density: largest density of a cell, in units of the density at rest.
    """

    def __init__(
        self, grid: StaggeredGrid, boundary: Boundary, *, particles_a_cell: int, max_density: float
    ) -> None:
        self.grid, self.boundary, self.particles_a_cell, self.max_density = (
            grid,
            boundary,
            particles_a_cell,
            max_density,
        )
        self._crowd = WindowReduction(CROWD, grid, grid.part.owned)
        self._density: wp.array | None = None
        # Result of the last `measure`, once it has been read.
        self._known: tuple[float, float] | None = None
        self._trail, self._cells = DirtyRegion(grid.part.owned), ActiveWindow(grid.domain)
        self._measuring = LaunchGraph(grid.device, self._launch)

    def measure(self, density: wp.array | None, particles: Particles, window: Window) -> None:
        """Measure the density; `read_densities` then returns the result.

        Args:
            density: density of the particles, in units of that at rest, float32; computed here if
                None.
            particles: the material; where the density is computed here they must not have moved
                since they were sorted.
            window: cells that hold all particles, with two to spare on each side.
        """
        if density is None:
            density = self._density = self.grid.field() if self._density is None else self._density
            density_of_all(
                self.grid, self.boundary.sides, particles, window, self.particles_a_cell, density
            )
        self._known = None
        self._cells.move_to(self._trail.through(window))
        self._measuring.run(density, variant=self._cells.near is None)
        self._crowd.changed()

    def _launch(self, density: wp.array) -> None:
        b = self.boundary
        self._crowd.launch(
            self._cells, base=b.base, density=density, capacity=b.capacity, most=self.max_density
        )

    def read_densities(self) -> tuple[float, float]:
        """Return the fraction of material above the limit, and the largest density.

        The density at rest is 1.
        """
        if self._known is None:
            # Excess over the limits, total amount, largest density.
            everyone = self.grid.part.ranks.gather(self._crowd.read())
            above, held = everyone[:, :2].sum(axis=0).tolist()
            self._known = above / held if held > 0.0 else 0.0, float(everyone[:, 2].max())
        return self._known


def density_of_all(
    grid: StaggeredGrid,
    sides: PeriodicSides | None,
    particles: Particles,
    window: Window,
    particles_a_cell: int,
    density: wp.array,
) -> None:
    """Compute the density of all processes' particles; collective.

    Args:
        grid: the grid.
        sides: its periodic sides; None if there are none.
        particles: as of `particle_density`, like the other arguments.
        window: likewise.
        particles_a_cell: likewise.
        density: likewise (written); also complete beside periodic sides.
    """
    particles.exchange_ghost_positions()
    joined_density(grid, sides, particles, window, particles_a_cell, density)
    particles.drop_ghosts()


def joined_density(
    grid: StaggeredGrid,
    sides: PeriodicSides | None,
    particles: Particles,
    window: Window,
    particles_a_cell: int,
    density: wp.array,
) -> None:
    """Launch the density of particles, with the ghosts of other processes among them.

    Beside a periodic side a kernel reaches beyond the domain. What it adds to the ring there
    belongs to the cells at the opposite side. Arguments as of `density_of_all`.
    """
    particle_density(grid, particles, window, particles_a_cell, density)
    if sides is not None:
        sides.add(density)
    grid.part.fill(density)


@dataclass(frozen=True, slots=True)
class DensityFields:
    """Fields of the problem that moves material out of overfull cells.

    Attributes:
        kind: int8 cell types of the problem (written).
        b: right-hand side (written).
        x: solution of the last problem, the start of this one.
        density: density of the material, in units of that at rest, float32.
        capacity: open fraction of each cell's kernel, float32; None for 1.
        inside: cells deep inside, which may lack material; None if there are none.
    """

    kind: wp.array
    b: wp.array
    x: wp.array
    density: wp.array
    capacity: wp.array | None
    inside: wp.array | None


@dataclass(frozen=True)
class Correction:
    """Result of a density correction.

    Attributes:
        result: result of the solve; None if no cell was overfull and nothing has moved.
        over_full: cells above the largest density, and cells deep inside below the least.
        max_density: before the correction, in units of the density at rest: 1 and the most by which
            a cell exceeds what fits beside walls.
    """

    result: wl.SolveResult | None
    over_full: int
    max_density: float


class DensityCorrection:
    """Density correction: moves particles out of overfull cells.

    With rho the particles' density on the grid, in units of that at rest, a displacement d = -grad
    x / rho makes it

        rho - div(rho d) = rho + lap x,

    ([Book] eq. (1.116) has the other sign, which would draw particles together), and no cell may
    hold more than rho_max of its capacity:

        0 <= x_i complementary to y_i = sum over faces of a_f (x_i - x_neighbor) + rho_max
        capacity_i - rho_i >= 0,

    with a_f the open fraction of a face. Every open cell that a particle's kernel reaches is an
    unknown, also at the surface; x = 0 in the others. There is no suction, so the surface needs no
    condition. Particles move by d = -(x_right - x_left) / max(rho_face, 1/2), at most half a cell,
    and along walls that they meet. Their velocities stay unchanged, so momentum is conserved.

    With `even` a cell has the equation y_i = 0 instead, if it and all cells around it are more than
    half full: inside a liquid that keeps its volume. The equation moves the excess over rho_max, or
    the deficit below 2 - rho_max, to or from the surface, and leaves the density of other cells
    unchanged; x may have either sign. Without `even` the voids that a flow creates are not closed,
    every cell is truncated at rho_max from above alone, and the liquid grows: a thin pool by 5 %. A
    wall that separates has a surface as well, and nothing is drawn to it.

    The operator, the method and its hierarchy are the pressure's. Where solids cut cells, pockets
    between them may be closed and count particles beyond a thin wall; SHIFT keeps their problem
    solvable.

    Along periodic axes densities, x and d continue at the opposite side, and so does the operator.
    Periodic axes alone do not make it singular: the surface is still there, x = 0 above it. Only
    material that fills the room between two walls has constants in its null space, as in any closed
    room.

    Args:
        grid: the grid.
        boundary: solids and walls.
        solver: settings of the method.
        particles_a_cell: number of particles in a cell of material at rest.
        max_density: rho_max, > 0. A material at rest whose particles lie at random would grow with
            1.
        gain: factor of what a cell holds too much, >= 1: a kernel spreads what a single cell gives
            away, so that its density falls by less than the problem says.
        even: whether cells inside the material are to hold neither too much nor too little.
        every: steps from one correction to the next.
        tolerance: relative residual at which a solve is done.
        max_iterations: limit of iterations of the method; the best iterate is taken then.

    Attributes:
        x: the last solution [cells^2], float64, the guess of the next.
        density: density of the particles before the last correction, float32.
        displacement: displacement of the last correction on the faces of each axis [m], float32.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        boundary: Boundary,
        solver: Solver,
        *,
        particles_a_cell: int,
        max_density: float,
        gain: float = 1.0,
        even: bool = False,
        every: int = 1,
        tolerance: float = 1e-2,
        max_iterations: int = 20,
    ) -> None:
        self.grid, self.boundary, self.solver = grid, boundary, solver
        self.particles_a_cell, self.max_density, self.gain = particles_a_cell, max_density, gain
        self.every = every
        self.tolerance, self.max_iterations = tolerance, max_iterations
        self.x, self._b = grid.field(wp.float64), grid.field(wp.float64)
        self.density, self.displacement, self._kind = (
            grid.field(),
            grid.faces(),
            grid.field(wp.int8),
        )
        wp.copy(self._kind, boundary.base)
        self._displace = displacement_pass(bool(boundary.open))
        self._over, self._lacking = WindowReduction(PREPARE, grid), WindowReduction(EVEN, grid)
        self._inside = self._own_side = self._lower = None
        self._counted = (
            wp.zeros(1, dtype=wp.float64, device=grid.device)
            if even and grid.device.is_cuda
            else None
        )
        if even:  # the ring stays as it is
            self._inside = wp.array(
                boundary.base.numpy() == SOLID, dtype=wp.uint8, device=grid.device
            )
            self._own_side = grid.field(wp.uint8) if grid.barriers is not None else None
            self._lower = grid.field(wp.float64)
        self._shift = (
            wp.full(grid.shape, SHIFT, dtype=wp.float32, device=grid.device)
            if boundary.open or even
            else None
        )
        # Made when there is material, since an empty problem is refused.
        self._problem: wl.LCP | None = None
        self._solved = grid.part.owned  # the cells of the problem
        # Fields of a rank's part, and those of its problem.
        self._copied: list[tuple[wp.array, wp.array]] = []
        self._copied_faces: list[tuple[wp.array, wp.array]] = []
        # Open fractions of faces, and those of the problem beside periodic sides.
        self._joined_faces: list[tuple[wp.array, wp.array]] = []
        self._guess = grid.part.box_like(self.x).flatten()
        self._way = Scalar()  # factor on the displacement [m]
        launches = (
            self._launch_preparation,
            self._launch_displacement,
            self._copy_cells,
            self._copy_faces,
        )
        graphs = (LaunchGraph(grid.device, f, at_once=grid.part.at_once) for f in launches)
        self._preparation, self._displacing, self._copying, self._copying_faces = graphs

    def apply(
        self,
        particles: Particles,
        window: Window,
        *,
        fill: Fill | None = None,
        contact: wp.array | None = None,
        share: float = 1.0,
    ) -> Correction:
        """Correct the particles' positions.

        Args:
            particles: the material (moved). If they are indexed they are sorted first.
            window: cells that hold all particles, with two to spare on each side.
            fill: adds the density of liquid without particles in a window.
            contact: uint8, RELEASED where walls separate, see `warp_lcp.material.boundary_kernels`;
                None if no wall separates.
            share: fraction of the displacement by which particles move.
        """
        if particles.offsets is not None:
            # The particles have moved. Gathering needs the order, and gives the same bits on every
            # run.
            particles.sort()
        particles.exchange_ghost_positions()
        variant = window.near is None, contact is None, particles.runs is None
        self._preparation.run(particles, window, fill, contact, variant=variant)
        particles.drop_ghosts()
        self._over.changed()
        if self._inside is not None:
            self._lacking.changed()
        result = self._solve_counting() if self._begins_on_gpu() else None
        over_full, most = self._count_wrong_cells()
        if over_full == 0:
            self.x.zero_()
            return Correction(None, 0, most)
        result = self._solve(over_full) if result is None else result
        # A closed room is too full: the excess has no way out.
        if result.status in (wl.SolveStatus.INFEASIBLE, wl.SolveStatus.NON_FINITE):
            self.x.zero_()
            return Correction(result, over_full, most)
        self._way.value = share * self.grid.spacing
        self._displacing.run(result.x)
        self._displace_particles(particles)
        return Correction(result, over_full, most)

    def _launch_displacement(self, x: wp.array) -> None:
        """Launch the computation of the displacement on all faces.

        d_i = dx (x_(i-1) - x_i) / the mean filled share, in m, with at most LONGEST cells in all
        directions together.
        """
        self._store_solution(x)
        longest = LONGEST / self.grid.dimension**0.5
        for axis, field in enumerate(self.displacement):
            open_ = self.boundary.open[axis] if self.boundary.open else None
            self.grid.domain.run(
                self._displace,
                x=self.x,
                kind=self._kind,
                open=open_,
                density=self.density,
                capacity=self.boundary.capacity,
                axis=axis,
                most=longest,
                dx=self._way,
                d=field,
            )
        self._wrap(*self.displacement)

    def _launch_preparation(
        self, particles: Particles, window: Window, fill: Fill | None, contact: wp.array | None
    ) -> None:
        """Launch the density and the set-up of the problem."""
        joined_density(
            self.grid, self.boundary.sides, particles, window, self.particles_a_cell, self.density
        )
        if fill is not None:
            fill(window, self.density)
        self._prepare(contact)

    def _displace_particles(self, particles: Particles) -> None:
        self.boundary.displace(self.displacement, particles.position)
        if self.boundary.sides is not None:
            self.boundary.sides.carry(particles.position)

    def _wrap(self, *fields: wp.array) -> None:
        """Launch the filling of the ring of fields beyond periodic sides, if there are any."""
        if self.boundary.sides is not None:
            self.boundary.sides.wrap(*fields)

    def _store_solution(self, x: wp.array) -> None:
        """Store the solution of the problem."""
        part = self.grid.part
        part.store(x, self.x, self._guess)
        part.fill(self._kind)
        self._wrap(self.x, self._kind)

    def _prepare(self, contact: wp.array | None) -> None:
        """Set up the problem, and count overfull cells.

        A cell is overfull if its density, relative to rest, is above `max_density`. One deep inside
        lacks material below `least` = min(max_density, 2 - max_density).
        """
        b, most = self.boundary, self.max_density
        fields = DensityFields(self._kind, self._b, self.x, self.density, b.capacity, self._inside)
        self._over.launch(
            self._solved, fields, base=b.base, contact=contact, most=most, gain=self.gain
        )
        if self._inside is not None:
            self.grid.part.fill(self._inside)  # before those deep inside are told by them
            self._wrap(self._inside)
            if self.grid.barriers is not None:
                self.grid.barriers.surround(self._solved, self._inside, self._own_side)
            least, planes = min(most, 2.0 - most), self.grid.planes - 1
            self._lacking.launch(
                self._solved,
                fields,
                own_side=self._own_side,
                least=least,
                planes=planes,
                lower=self._lower,
            )
            if self._counted is not None:
                launch(
                    add_kernel,
                    1,
                    [self._over.on_device(), self._lacking.on_device(), self._counted],
                    device=self.grid.device,
                )

    def _count_wrong_cells(self) -> tuple[int, float]:
        """Count the cells that are overfull or lack material deep inside; collective.

        Returns their number, and the largest density.
        """
        lacking = 0.0
        if self._inside is not None:
            (lacking,) = self._lacking.read()
        full, densest = self._over.read()
        everyone = self.grid.part.ranks.gather(np.array([full + lacking, densest]))
        return int(everyone[:, 0].sum()), float(everyone[:, 1].max())

    def _solve(self, over_full: int) -> wl.SolveResult:
        if self._problem is None:
            self._problem = self._make_problem()
            self._work = self.solver.init(self._problem)
        self._take_cells()
        criteria = wl.StoppingCriteria(
            rtol=self.tolerance, atol=EXCESS * over_full**0.5, max_iterations=self.max_iterations
        )
        return self._solved_to(criteria)

    def _begins_on_gpu(self) -> bool:
        """Return whether a GPU starts the solve before the host knows of overfull cells."""
        return self._problem is not None and not self.grid.part.shared and self._work.begins_on_gpu

    def _solve_counting(self) -> wl.SolveResult:
        """Solve while the cells are counted, with one readback for both.

        If the count is 0, nothing is solved.
        """
        self._take_cells()
        counted = self._over.on_device() if self._inside is None else self._counted
        criteria = MeanCriteria(
            rtol=self.tolerance,
            atol=EXCESS,
            max_iterations=self.max_iterations,
            count=lambda: self._count_wrong_cells()[0],
            counted=counted,
        )
        return self._solved_to(criteria)

    def _solved_to(self, criteria: wl.StoppingCriteria | MeanCriteria) -> wl.SolveResult:
        assert self._problem is not None
        return wl.solve(
            self._problem, self.solver, stopping=criteria, x0=self._guess, workspace=self._work
        )

    def _take_cells(self) -> None:
        """Copy the cells, and solids beside them, to the problem."""
        self._copying.run()
        if self.boundary.moves:
            self._copying_faces.run()
        self._operator.update(self._cells)

    def _make_problem(self) -> wl.LCP:
        part, opened = self.grid.part, self.boundary.open
        self._cells, b = part.box_like(self._kind), part.box_like(self._b)
        lower, shift = (
            None if field is None else part.box_like(field) for field in (self._lower, self._shift)
        )
        faces = [part.box_like(field) for field in opened]
        sides = self.boundary.sides
        around = (False,) * 3 if sides is None else tuple(axis in sides.axes for axis in range(3))
        if sides is not None:
            faces = [wp.empty_like(field) for field in opened]
            self._joined_faces = [*zip(opened, faces, strict=True)]
        if part.shared:
            pairs = [
                (self._kind, self._cells),
                (self._b, b),
                (self._lower, lower),
                (self._shift, shift),
            ]
            pairs.append((self.x, self._guess.reshape(b.shape)))
            self._copied = [(field, box) for field, box in pairs if field is not None]
            self._copied_faces = [*zip(opened, faces, strict=True)]
        self._copy_cells()
        self._copy_faces()
        named = dict(zip(("face_x", "face_y", "face_z"), faces, strict=False))
        self._operator = part.poisson(
            self.grid.interior(self._cells.numpy()), shift=shift, periodic=around, **named
        )
        return wl.LCP(self._operator, b, 0.0 if lower is None else lower, np.inf)

    def _copy_cells(self) -> None:
        """Copy the fields of a rank's part to its problem."""
        for field, box in self._copied:
            self.grid.part.copy_to_box(field, box)

    def _copy_faces(self) -> None:
        """Copy the faces' open fractions to a rank's problem, or to one with periodic sides.

        The first and the last faces of a periodic axis are the same faces. Their fractions may
        differ a little, since solids may; those of the first face hold.
        """
        for field, box in self._copied_faces:
            self.grid.part.copy_to_box(field, box)
        for field, joined in self._joined_faces:
            copy(joined, field)
            self._wrap(joined)


__getattr__ = renamed_names(__name__, Crowding="DensityMonitor")
