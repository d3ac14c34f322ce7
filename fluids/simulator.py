"""Liquid on a staggered grid, carried by particles: the plug-in `fluids`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import warp_lcp as wl
from fluids.boundary import Boundary, WholeCells
from fluids.cut_boundary import CutBoundary
from fluids.gravity import accelerate
from fluids.pressure import PressureProjection, Projection
from fluids.pressure_kernels import RELEASED, TOUCHES_NOTHING
from fluids.scene import LiquidScene
from fluids.surface import FreeSurface, GhostFluidSurface, WholeCellSurface
from warp_lcp.driver.profile import NoStopwatch, Stopwatch
from warp_lcp.driver.scene import Scene, Solver
from warp_lcp.driver.simulator import Cells, Points, SimulationFailed, StepFailed
from warp_lcp.grid.cut_cells import CutCells
from warp_lcp.grid.particles import MARGIN, Particles, ParticleTotals, seed
from warp_lcp.grid.solids import Geometry
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.grid.transfer import faces_to_particles, particles_to_faces
from warp_lcp.grid.voxelize import PlacedSolid, inside, placement_notes, voxelize

COLUMNS = (
    "particles",
    "mass",
    "kinetic_energy",
    "potential_energy",
    "center_of_mass_y",
    "max_speed",
    "cfl",
    "solver",
    "solve_status",
    "solve_iterations",
    "linear_iterations",
    "solve_residual",
    "active",
    "max_divergence",
    "volume",
    "stopped",
)


class LiquidSimulation:
    """A liquid in progress; implements `warp_lcp.driver.simulator.Simulation`.

    Args:
        scene: what to simulate.
        grid: its grid.
        boundary: its solids and the domain's walls.
        particles: the liquid at the start.
        notes: facts for the start of a run.

    Attributes:
        particles: the liquid.
        velocity: of the last step on the faces, one field a component [m/s].
        projection: the pressure's fields.
        time: [s].
        step_count: steps done.
        watch: what the stages of a step are measured with.
    """

    def __init__(
        self,
        scene: LiquidScene,
        grid: StaggeredGrid,
        boundary: Boundary,
        particles: Particles,
        *,
        notes: list[str] | None = None,
    ) -> None:
        """Allocate the fields and find the liquid's cells."""
        self.scene, self.grid, self.boundary, self.particles = scene, grid, boundary, particles
        self.time, self.step_count = 0.0, 0
        self.watch: Stopwatch = NoStopwatch()
        self._notes = list(notes or [])
        self.gravity = np.array([*scene.physics.gravity, 0.0][:3])
        self.particle_mass = scene.physics.density * grid.cell_volume / scene.particles.per_axis**grid.dimension  # [kg], 2-D: [kg/m]
        self.velocity, self.weights = grid.faces(), grid.faces()
        self._saved = grid.faces() if scene.particles.transfer == "flip" else None
        self.surface = _surface(scene, grid, boundary)
        settings = scene.solver
        self.projection = PressureProjection(
            grid, boundary, _method(settings), tolerance=settings.tolerance, max_iterations=settings.max_iterations, phi=self.surface.phi
        )
        self.layers = math.ceil(scene.time.cfl) + 2
        particles.sort()
        self.surface.mark(particles, grid.everywhere, self.projection.kind)
        self.projection.show()

    def stable_dt(self) -> float:
        """Return CFL dx / (v_max + sqrt(CFL g dx)) [s]; v_max is of the liquid and of solids in the time to come.

        Gravity's own speed counts, so that a liquid at rest does not take off.
        """
        cfl, dx = self.scene.time.cfl, self.grid.spacing
        with self.watch.stage("diagnostics", self.particles.position, self.particles.velocity):
            totals = self.particles.totals()
        solids = self.boundary.top_speed(self.time, self.scene.time.dt_max)
        speed = max(totals.max_speed, solids) + math.sqrt(cfl * float(np.linalg.norm(self.gravity)) * dx)
        return cfl * dx / speed if speed > 0.0 else math.inf

    def step(self, dt: float) -> dict[str, float | int | str | None]:
        """Advance by dt [s].

        The pressure is solved before any particle moves, so that a failed solve leaves the state as it was, but for the particles' order.

        Raises:
            StepFailed: the solve missed its criteria; a smaller dt may be tried.
            SimulationFailed: something is not finite, a particle has left the domain, or enclosed liquid would have to change its volume.
            ValueError: dt is not positive.
        """
        if not (math.isfinite(dt) and dt > 0.0):
            raise ValueError(f"dt = {dt}: must be a positive time [s]")
        before = self._checked_totals("at the start of")
        particles, watch = self.particles, self.watch
        with watch.stage("sort", *particles.arrays().values()):
            particles.arrange(self.step_count)
        window = self._window(before)
        with watch.stage("particles-to-grid", *particles.arrays().values(), *self.velocity, *self.weights):
            self._transfer(window, dt)
        projected = self._project(window, dt, before.max_speed + dt * float(np.linalg.norm(self.gravity)))
        volume = self._volume(projected)
        p, wall = self.projection, self.boundary
        with watch.stage("extrapolation", *self.velocity, *self.weights, *p.known, p.kind, p.contact, *wall.open):
            wall.extend(window, self.velocity, self.weights, p.known, p.kind, p.contact, self.layers)
        with watch.stage("grid-to-particles", *particles.arrays().values(), *self.velocity):
            flip = self.scene.particles.flip_ratio if self._saved else 0.0
            faces_to_particles(
                self.grid, self.velocity, particles.position, particles.velocity, particles.affine, saved=self._saved, flip=flip
            )
        with watch.stage("advection", particles.position, *self.velocity):
            moved = wall.advect(self.velocity, dt, self.time + dt, particles.position)
        after = self._checked_totals("after")
        self.time += dt
        self.step_count += 1
        return self._row(dt, after, projected, volume, moved)

    def columns(self) -> tuple[str, ...]:
        """Return the names of the log's columns.

        SI units; in 2-D mass, energies and volume are per meter of depth. Energies are the particles' own; potential_energy is 0 at the
        origin. solve_residual is relative to the right-hand side's, which in free fall is rounding noise that is not iterated on: it may
        then be up to 1. volume counts FLUID cells, or lies inside the surface where that is finer than cells. active: wall cells that let
        go; max_divergence [1/s]: of the other FLUID cells after the projection; stopped: particles that met a wall; pushed: those that a
        moving solid swept along; stuck: those inside solids that found no way out, between solids that close, say.
        """
        return (*COLUMNS, "pushed", "stuck") if self.boundary.moves else COLUMNS

    def frame(self) -> list[Points | Cells]:
        """Return the particles (velocity, speed) and the liquid's cells of the last solve (pressure [Pa], wall and released flags)."""
        position, velocity = self.particles.position.numpy().copy(), self.particles.velocity.numpy().copy()
        points = Points("particles", position, {"velocity": velocity, "speed": np.linalg.norm(velocity, axis=1)})
        cells = self.projection.fluid_cells()
        at = tuple(cells.T)
        contact = self.projection.contact.numpy()[at]
        fields = {
            "pressure": self.projection.pressures(self.scene.physics.density)[at],
            "wall": (contact != TOUCHES_NOTHING).astype(np.uint8),
            "released": (contact == RELEASED).astype(np.uint8),
        }
        return [points, Cells("grid", cells[:, ::-1] - 1, self.grid.spacing, self.grid.dimension, fields)]

    def state(self) -> dict[str, np.ndarray]:
        """Return what `restore` needs to continue bit for bit on the CPU."""
        particles = {name: array.numpy().copy() for name, array in self.particles.arrays().items()}
        clock = {"time": np.array(self.time), "step_count": np.array(self.step_count), "signature": self._signature()}
        return clock | particles | self.projection.state()

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from `state`.

        Raises:
            ValueError: the arrays do not belong to this scene.
        """
        expected = self.state()
        missing = sorted(expected.keys() - state.keys())
        if missing:
            raise ValueError(f"the state lacks {', '.join(missing)}: it does not belong to this scene")
        if not np.array_equal(state["signature"], expected["signature"]):
            raise ValueError("the state's grid, spacing, number of particles a cell or transfer differ from this scene's")
        for name, value in expected.items():
            given = np.asarray(state[name])
            if given.shape != value.shape or given.dtype != value.dtype:
                found, wanted = f"{given.dtype}{given.shape}", f"{value.dtype}{value.shape}"
                raise ValueError(f"the state's {name} is {found}: this scene has {wanted}")
            if given.dtype.kind == "f" and not np.isfinite(given).all():
                raise ValueError(f"the state's {name} holds values that are not finite")
        if not self.boundary.moves and not np.array_equal(state["cells"] == wl.SOLID, expected["cells"] == wl.SOLID):
            raise ValueError("the state's solids are not this scene's")
        for name, array in self.particles.arrays().items():
            array.assign(state[name])
        self.projection.restore({name: np.asarray(state[name]) for name in ("pressure", "pressure_dt", "cells", "contact")})
        self.time, self.step_count = float(state["time"]), int(state["step_count"])
        self.boundary.place(self.time)

    def notes(self) -> list[str]:
        """Return warnings and facts worth a line at the start of a run."""
        nx, ny, nz = self.grid.counts
        cells = f"{nx} x {ny}" + (f" x {nz}" if self.grid.dimension == 3 else "")
        return [f"{self.particles.count} particles, {cells} cells of {self.grid.spacing:.4g} m", *self._notes]

    def _window(self, totals: ParticleTotals) -> Window:
        """Return the cells that the particles can touch in a step."""
        low, high = (self.particles.cells_of(corner[None])[0] + 1 for corner in (totals.low, totals.high))
        return self.grid.window(low, high, grow=max(self.layers, 2 * self.scene.pressure.smoothing) + 2)

    def _transfer(self, window: Window, dt: float) -> None:
        """Bring the particles' velocities to the faces, and let gravity act on them."""
        particles, grid = self.particles, self.grid
        particles_to_faces(
            grid, particles.position, particles.velocity, particles.affine, self.velocity, self.weights, window=window,
            offsets=particles.offsets,
        )  # fmt: skip
        for field, saved in zip(self.velocity, self._saved or (), strict=False):
            wp.copy(saved, field)
        accelerate(window, self.velocity, self.weights, self.gravity * dt)

    def _project(self, window: Window, dt: float, speed: float) -> Projection:
        """Solve for the pressure and project the velocity."""
        projection, watch = self.projection, self.watch
        with watch.stage("surface", self.particles.key, projection.kind):
            self.surface.mark(self.particles, window, projection.kind)
            self.surface.complete(window, self.velocity, self.weights, projection.known)
        with watch.stage("pressure set-up", *self.velocity, *projection.fields()):
            self.boundary.begin_step(self.time, dt)
            unknowns = projection.prepare(self.velocity, dt)
        if unknowns == 0:
            return projection.leave(dt)
        with watch.stage("pressure solve", *projection.fields()):
            result, criteria = projection.solve(speed, unknowns)
        if not result:
            if result.status is wl.SolveStatus.NON_FINITE:
                self._explain_not_finite()
            if result.status is wl.SolveStatus.INFEASIBLE and self.boundary.velocity:  # speeds that do not fit: no dt helps
                raise SimulationFailed(
                    f"step {self.step_count}: liquid fills a closed space, and walls move so that its volume would have to change; leave "
                    'air in it, or give the wall that moves away from it wall = "separating"'
                )
            raise StepFailed(
                f"step {self.step_count}: the pressure solve ended with {result.status.name} after {result.iterations} iterations at a "
                f"relative residual of {result.relative_residual:.2e} (tolerance {self.projection.tolerance:.1e}): {result.status.value}"
            )
        with watch.stage("projection", *self.velocity, *projection.known, projection.pressure, projection.kind, projection.contact):
            return projection.project(self.velocity, dt, window, result, criteria, unknowns)

    def _volume(self, projected: Projection) -> float:
        """Return the liquid's volume [m^3; m^2 in 2-D] at the start of the step, before solids move."""
        with self.watch.stage("diagnostics", self.projection.kind):
            return self.surface.volume(projected.unknowns)

    def _explain_not_finite(self) -> None:
        cells = self.projection.not_finite()
        if len(cells):
            where = tuple(int(c) for c in cells[0])
            raise SimulationFailed(
                f"step {self.step_count}: the velocity on the faces of cell (x, y, z) = {where} is not finite ({len(cells)} cells)"
            )

    def _checked_totals(self, when: str) -> ParticleTotals:
        """Return sums over the particles.

        Raises:
            SimulationFailed: a value is not finite or a particle lies outside the domain.
        """
        with self.watch.stage("diagnostics", self.particles.position, self.particles.velocity):
            totals = self.particles.totals()
        axes = slice(self.grid.dimension)
        size = np.array(self.grid.counts) * self.grid.spacing
        end = size - 0.5 * MARGIN * self.grid.spacing  # a tent at the very end would reach beyond what is stored
        if totals.finite and (totals.low[axes] >= 0.0).all() and (totals.high[axes] <= end[axes]).all():
            return totals
        position, velocity = self.particles.position.numpy(), self.particles.velocity.numpy()
        if totals.bad_velocities:
            field, bad = "velocity", ~((velocity.astype(np.float64) ** 2).sum(axis=1) <= np.finfo(np.float32).max)
        elif totals.bad_positions:
            field, bad = "position", ~np.isfinite(position).all(axis=1)
        else:
            field, bad = "position", ((position < 0.0) | (position > end))[:, axes].any(axis=1)
        first = int(np.flatnonzero(bad)[0])
        where = self._cell_of(first)
        wrong = "outside the domain" if totals.finite else "not finite"
        count = int(bad.sum())
        raise SimulationFailed(f"{when} step {self.step_count}: {field} is {wrong} in cell (x, y, z) = {where} ({count} particles)")

    def _cell_of(self, particle: int) -> tuple[int, ...]:
        """Return the cell that a particle was last sorted into, counted from 0."""
        k, j, i = np.unravel_index(int(self.particles.key.numpy()[particle]), self.grid.shape)
        return int(i) - 1, int(j) - 1, int(k) - 1

    def _row(
        self, dt: float, totals: ParticleTotals, projected: Projection, volume: float, moved: tuple[int, int, int]
    ) -> dict[str, float | int | str | None]:
        mass = totals.count * self.particle_mass
        result = projected.result
        row: dict[str, float | int | str | None] = {
            "particles": totals.count,
            "mass": mass,
            "kinetic_energy": 0.5 * mass * totals.mean_square_speed,
            "potential_energy": -mass * float(self.gravity @ totals.center),
            "center_of_mass_y": float(totals.center[1]),
            "max_speed": totals.max_speed,
            "cfl": totals.max_speed * dt / self.grid.spacing,
            "active": projected.released,
            "max_divergence": projected.max_outflow / self.grid.spacing,
            "volume": volume,
            "stopped": moved[0],
            "pushed": moved[1],
            "stuck": moved[2],
        }
        if result is not None:
            row |= {
                "solver": self.scene.solver.method,
                "solve_status": result.status.name,
                "solve_iterations": result.iterations,
                "linear_iterations": result.linear_iterations,
                "solve_residual": result.relative_residual,
            }
        return {name: row.get(name) for name in self.columns()}

    def _signature(self) -> np.ndarray:
        """Return numbers that tell this scene's arrays from another's."""
        settings = self.scene.particles
        transfer = ("apic", "flip", "pic").index(settings.transfer)
        return np.array([*self.grid.counts, self.grid.dimension, self.grid.spacing, settings.per_axis, transfer], dtype=np.float64)


def _method(settings: Solver) -> Any:
    """Return the solver that a scene names."""
    return wl.METHODS[settings.method](precision=settings.precision)


def _surface(scene: LiquidScene, grid: StaggeredGrid, boundary: Boundary) -> FreeSurface:
    """Return the free surface that a scene asks for."""
    count = scene.particles.per_axis**grid.dimension
    if scene.pressure.surface == "ghost-fluid":
        return GhostFluidSurface(grid, boundary, particles_a_cell=count, smoothing=scene.pressure.smoothing)
    return WholeCellSurface(grid, boundary, particles_a_cell=count)


def _region(geometry: Geometry, boundary: Boundary, device: wp.Device) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that tells which points lie in a geometry and outside solids."""

    def holds(points: np.ndarray) -> np.ndarray:
        result = inside([geometry], points, device=device)
        result[result] = boundary.admits(points[result])
        return result

    return holds


def _boundary(scene: LiquidScene, grid: StaggeredGrid, folder: Path, wall_velocity: np.ndarray | None) -> tuple[Boundary, tuple[str, ...]]:
    """Return solids and walls as the scene asks for them, and warnings."""
    placed = [
        PlacedSolid(
            geometry=solid.to_geometry(folder, scene.dimension),
            separating=(solid.wall or scene.domain.wall) == "separating",
            name=f"solid[{number}] ({solid.shape})",
            motion=solid.motion.to_motion(scene.dimension) if solid.motion else None,
        )
        for number, solid in enumerate(scene.solid)
    ]
    separating = scene.domain.wall == "separating"
    if scene.domain.solids == "cut-cell":
        if wall_velocity is not None:
            raise ValueError('wall_velocity: only for solids = "voxel"; solids that cut cells have a motion')
        cut = CutCells(grid, placed, wall_separating=separating)
        if not cut.whole_cells:
            return CutBoundary(grid, cut), cut.notes
    solids = voxelize(grid.counts, grid.spacing, grid.dimension, placed, wall_separating=separating, device=grid.device)
    return WholeCells(grid, solids, wall_velocity), solids.notes


def _seed(scene: LiquidScene, grid: StaggeredGrid, boundary: Boundary, folder: Path) -> tuple[Particles, list[str]]:
    """Return the particles of all liquids, and warnings."""
    geometries = [liquid.to_geometry(folder, scene.dimension) for liquid in scene.liquid]
    regions = [_region(geometry, boundary, grid.device) for geometry in geometries]
    notes: list[str] = []
    for number, (liquid, geometry) in enumerate(zip(scene.liquid, geometries, strict=True)):
        notes += placement_notes(geometry, f"liquid[{number}] ({liquid.shape})", grid.counts, grid.spacing, grid.dimension)
    settings = scene.particles
    open_cells = grid.interior(boundary.base.numpy()) != wl.SOLID
    position, owner = seed(
        grid, regions, open_cells, per_axis=settings.per_axis, jitter=settings.jitter, random_seed=settings.seed
    )  # fmt: skip
    counts = np.bincount(owner, minlength=len(geometries))
    for number, count in enumerate(counts):
        if count == 0:
            raise ValueError(
                f"liquid[{number}] ({scene.liquid[number].shape}) holds no particle: it is too small for cells of {grid.spacing:.4g} m, or "
                "lies in solids, outside the domain or in an earlier liquid"
            )
    start = np.array([[*(liquid.velocity or [0.0, 0.0]), 0.0][:3] for liquid in scene.liquid], dtype=np.float32)
    return Particles(grid, position, start[owner], affine=settings.transfer == "apic"), notes


class FluidsSimulator:
    """The plug-in for liquids that let go of their walls."""

    name = "fluids"
    summary = "liquids that let go of their walls"
    scene_model = LiquidScene

    def create(self, scene: Scene, *, device: str, folder: Path, wall_velocity: np.ndarray | None = None) -> LiquidSimulation:
        """Build a simulation of `scene`.

        Args:
            scene: a LiquidScene.
            device: a Warp device's name.
            folder: where the files are that the scene names.
            wall_velocity: velocity [m/s] of the domain's wall and of each solid, shape (1 + solids, 3), constant; the solids' cells stay
                where they are. None: all stand still.

        Raises:
            ValueError: the scene cannot be simulated; the message names the key and what is allowed.
        """
        if not isinstance(scene, LiquidScene):
            raise ValueError("scene.simulator: fluids needs a scene of liquid")
        grid = StaggeredGrid(scene.cell_counts, scene.spacing, scene.dimension, device)
        boundary, warnings = _boundary(scene, grid, folder, wall_velocity)
        particles, notes = _seed(scene, grid, boundary, folder)
        return LiquidSimulation(scene, grid, boundary, particles, notes=[*warnings, *notes])
