"""Liquid on a staggered grid, carried by particles: the plug-in `fluids`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import warp as wp

import warp_lcp as wl
from fluids.assembly import make_boundary, make_outlets, make_particles, make_pressure, make_sources, make_surface
from fluids.boundary import Boundary
from fluids.density_correction import DensityCorrection
from fluids.gravity import accelerate
from fluids.outlets import Outlets
from fluids.pressure import Projection
from fluids.pressure_kernels import RELEASED, TOUCHES_NOTHING
from fluids.resample import resampled, resampling_notes
from fluids.reseeding import Reseeding
from fluids.scene import LiquidScene
from fluids.sources import Sources
from warp_lcp.driver.profile import NoStopwatch, Stopwatch
from warp_lcp.driver.scene import Scene
from warp_lcp.driver.simulator import Cells, Points, SimulationFailed, StepFailed
from warp_lcp.grid.particles import MARGIN, Particles, ParticleTotals
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.grid.transfer import faces_to_particles, particles_to_faces

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


CORRECTION_COLUMNS = ("density_status", "density_iterations", "max_density")


class LiquidSimulation:
    """A liquid in progress; implements `warp_lcp.driver.simulator.Simulation`.

    Args:
        scene: what to simulate.
        grid: its grid.
        boundary: its solids and the domain's walls.
        particles: the liquid at the start.
        sources: where liquid comes in.
        outlets: where it leaves.
        notes: facts for the start of a run.

    Attributes:
        particles: the liquid.
        velocity: of the last step on the faces, one field a component [m/s].
        projection: the pressure's fields.
        time: [s].
        step_count: steps done.
        watch: what the stages of a step are measured with.
        record: takes the problem of each step before it is solved, if it is set.
    """

    def __init__(
        self,
        scene: LiquidScene,
        grid: StaggeredGrid,
        boundary: Boundary,
        particles: Particles,
        *,
        sources: Sources | None = None,
        outlets: Outlets | None = None,
        notes: list[str] | None = None,
    ) -> None:
        """Allocate the fields and find the liquid's cells."""
        self.scene, self.grid, self.boundary, self.particles = scene, grid, boundary, particles
        self.sources, self.outlets = sources, outlets
        self.time, self.step_count = 0.0, 0
        self.watch: Stopwatch = NoStopwatch()
        self.record: Callable[[Mapping[str, np.ndarray]], object] | None = None
        self._notes = list(notes or [])
        self.gravity = np.array([*scene.physics.gravity, 0.0][:3])
        self.particle_mass = scene.physics.density * grid.cell_volume / scene.particles.per_axis**grid.dimension  # [kg], 2-D: [kg/m]
        self.velocity, self.weights = grid.faces(), grid.faces()
        self._saved = grid.faces() if scene.particles.transfer == "flip" else None
        self.surface = make_surface(scene, grid, boundary)
        self.projection = make_pressure(scene, grid, boundary, self.surface, self.weights)
        self.reseeding, self.correction = _reseeding(scene, grid, boundary), _correction(scene, grid, boundary)
        self.layers = math.ceil(scene.time.cfl) + 2
        if sources is not None:
            sources.emit(particles, None, self.time)
        particles.sort()
        self.surface.mark(particles, grid.everywhere, self.projection.kind)
        self.projection.show()

    def stable_dt(self) -> float:
        """Return CFL dx / (v_max + sqrt(CFL g dx)) [s]; v_max is of the liquid and of solids in the time to come.

        Gravity's own speed counts, so that a liquid at rest does not take off. A step ends when a source or drain starts or stops.
        """
        cfl, dx = self.scene.time.cfl, self.grid.spacing
        with self.watch.stage("diagnostics", self.particles.position, self.particles.velocity):
            totals = self.particles.totals()
        solids = self.boundary.top_speed(self.time, self.scene.time.dt_max)
        speed = max(totals.max_speed, solids) + math.sqrt(cfl * float(np.linalg.norm(self.gravity)) * dx)
        event = min((part.next_event(self.time) for part in (self.sources, self.outlets) if part is not None), default=math.inf)
        return min(cfl * dx / speed if speed > 0.0 else math.inf, event - self.time)

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
            if self.sources is not None:
                self.sources.hold(self.velocity, [])
        with watch.stage("grid-to-particles", *particles.arrays().values(), *self.velocity):
            flip = self.scene.particles.flip_ratio if self._saved else 0.0
            faces_to_particles(
                self.grid, self.velocity, particles.position, particles.velocity, particles.affine, saved=self._saved, flip=flip
            )
        with watch.stage("advection", particles.position, *self.velocity):
            moved = wall.advect(self.velocity, dt, self.time + dt, particles.position)
        exchanged = self._exchange(dt)
        after = self._checked_totals("after")
        row = self._rearrange(after)
        if row:
            after = self._checked_totals("after the density correction of")
        self.time += dt
        self.step_count += 1
        return self._row(dt, after, projected, volume, moved, row | exchanged)

    def columns(self) -> tuple[str, ...]:
        """Return the names of the log's columns.

        SI units; in 2-D mass, energies and volume are per meter of depth. Energies are the particles' own; potential_energy is 0 at the
        origin. solve_residual is relative to the right-hand side's, which in free fall is rounding noise that is not iterated on: it may
        then be up to 1. volume counts FLUID cells, or lies inside the surface where that is finer than cells. active: wall cells that let
        go; max_divergence [1/s]: of the other FLUID cells after the projection; stopped: particles that met a wall; pushed: those that a
        moving solid swept along; stuck: those inside solids that found no way out, between solids that close, say. max_density: before the
        density correction of the step, of liquid at rest 1; reseeded: particles that went to a neighboring cell; emitted, drained,
        departed: those that sources have added in the step, that drains have swallowed, and that have left through open sides.
        """
        columns = (*COLUMNS, "pushed", "stuck") if self.boundary.moves else COLUMNS
        if self.reseeding is not None:
            columns = (*columns, "reseeded")
        columns = (*columns, *CORRECTION_COLUMNS) if self.correction is not None else columns
        exchanged = {"emitted": self.scene.source, "drained": self.scene.drain, "departed": self.scene.domain.open}
        return (*columns, *(name for name, used in exchanged.items() if used))

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
        correction = {"density_correction": self.correction.x.numpy().copy()} if self.correction is not None else {}
        return clock | particles | self.projection.state() | correction

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
            if name in self.particles.arrays() and (self.sources or self.outlets):
                value = np.empty((len(state["position"]), 3), dtype=value.dtype)  # their number changes
            if given.shape != value.shape or given.dtype != value.dtype:
                found, wanted = f"{given.dtype}{given.shape}", f"{value.dtype}{value.shape}"
                raise ValueError(f"the state's {name} is {found}: this scene has {wanted}")
            if given.dtype.kind == "f" and not np.isfinite(given).all():
                raise ValueError(f"the state's {name} holds values that are not finite")
        if not self.boundary.moves and not np.array_equal(state["cells"] == wl.SOLID, expected["cells"] == wl.SOLID):
            raise ValueError("the state's solids are not this scene's")
        self.particles.assign(state)
        self.projection.restore({name: np.asarray(state[name]) for name in ("pressure", "pressure_dt", "cells", "contact")})
        if self.correction is not None:
            self.correction.x.assign(state["density_correction"])
        self.time, self.step_count = float(state["time"]), int(state["step_count"])
        self.boundary.place(self.time)

    def resample(self, state: Mapping[str, np.ndarray]) -> list[str]:
        """Continue from the state of the same scene on another grid: with other particles, and without a pressure to start from.

        Raises:
            ValueError: the state differs in more than the grid, or no particle is left.
        """
        before, now = np.asarray(state.get("signature", np.zeros(7))), self._signature()
        size = before[:3] * before[4], now[:3] * now[4]
        if not np.array_equal(before[[3, 5, 6]], now[[3, 5, 6]]) or not np.allclose(*(side[: self.grid.dimension] for side in size)):
            raise ValueError("the state's domain, number of particles a cell or transfer differ from this scene's")
        self.time, self.step_count = float(state["time"]), int(state["step_count"])
        self.boundary.place(self.time)
        settings, wanted = self.scene.particles, self.particles.arrays().keys()
        arrays, moved = resampled(
            {name: np.asarray(state[name]) for name in wanted}, self.grid, self._admits, spacing=float(before[4]),
            per_axis=settings.per_axis, random_seed=settings.seed + self.step_count,
        )  # fmt: skip
        self.particles.assign(arrays)
        self.particles.sort()
        self.surface.mark(self.particles, self.grid.everywhere, self.projection.kind)
        self.projection.show()
        return resampling_notes(len(state["position"]), self.particles.count, moved, float(before[4]), self.grid)

    def _admits(self, points: np.ndarray) -> np.ndarray:
        """Tell which points [m], shape (n, 3), a particle may be at."""
        i, j, k = self.particles.cells_of(points).T + 1
        return (self.boundary.base.numpy()[k, j, i] != wl.SOLID) & self.boundary.admits(points)

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
            if self.sources is not None:
                self.sources.supply(self.time, self.velocity, projection.kind)
            unknowns = projection.prepare(self.velocity, dt)
        if unknowns == 0:
            return self._held(projection.leave(dt))
        if self.record is not None:
            with watch.stage("recording", *projection.fields()):
                clock = {"step": np.array(self.step_count), "time": np.array(self.time), "dt": np.array(float(dt))}
                self.record(projection.recorded(speed, unknowns) | clock)
        with watch.stage("pressure solve", *projection.fields()):
            result, criteria = projection.solve(speed, unknowns)
        if not result:
            if result.status is wl.SolveStatus.NON_FINITE:
                self._explain_not_finite()
            if result.status is wl.SolveStatus.INFEASIBLE and (self.boundary.velocity or self.sources):  # no dt helps
                raise SimulationFailed(
                    f"step {self.step_count}: liquid fills a closed space, and walls move or sources run so that its volume would have "
                    'to change; leave air in it, or give the wall that moves away from it wall = "separating"'
                )
            raise StepFailed(
                f"step {self.step_count}: the pressure solve ended with {result.status.name} after {result.iterations} iterations at a "
                f"relative residual of {result.relative_residual:.2e} (tolerance {self.projection.tolerance:.1e}): {result.status.value}"
            )
        with watch.stage("projection", *self.velocity, *projection.known, projection.pressure, projection.kind, projection.contact):
            return self._held(projection.project(self.velocity, dt, window, result, criteria, unknowns))

    def _held(self, projected: Projection) -> Projection:
        """Give the sources' faces their velocity back, and show their cells as liquid."""
        if self.sources is not None:
            self.sources.hold(self.velocity, self.projection.known, self.projection.shown)
        return projected

    def _rearrange(self, totals: ParticleTotals) -> dict[str, float | int | str | None]:
        """Even out the particles and move them apart, if the scene asks for it and it is time; return what the log says of it."""
        particles = self.particles
        row: dict[str, float | int | str | None] = {}
        if self.reseeding is not None and self.step_count % self.reseeding.every == 0:
            with self.watch.stage("reseeding", *particles.arrays().values()):
                row["reseeded"] = self.reseeding.apply(particles, self._window(totals), self.step_count)
        correction = self.correction
        if correction is not None and self.step_count % correction.every == 0:
            with self.watch.stage("density correction", particles.position, correction.density, correction.x, *correction.displacement):
                done = correction.apply(particles, self._window(totals))
            row["density_status"] = done.result.status.name if done.result is not None else "NOTHING_TO_DO"
            row["density_iterations"] = done.result.iterations if done.result is not None else 0
            row["max_density"] = done.max_density
        return row

    def _exchange(self, dt: float) -> dict[str, float | int | str | None]:
        """Remove the particles that have left in the step and add those that have come in; return what the log says of it."""
        drained = departed = emitted = 0
        if self.outlets is None and self.sources is None:
            return {}
        with self.watch.stage("sources and outlets", self.particles.position):
            if self.outlets is not None:
                drained, departed = self.outlets.apply(self.particles, self.time + dt)
            if self.sources is not None:
                emitted = self.sources.emit(self.particles, self.time, self.time + dt)
        return {"emitted": emitted, "drained": drained, "departed": departed}

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
        self,
        dt: float,
        totals: ParticleTotals,
        projected: Projection,
        volume: float,
        moved: tuple[int, int, int],
        corrected: dict[str, float | int | str | None],
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
            **corrected,
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


def _reseeding(scene: LiquidScene, grid: StaggeredGrid, boundary: Boundary) -> Reseeding | None:
    """Return what evens out the particles if a scene asks for it."""
    settings = scene.particles.reseed
    if settings is None:
        return None
    at_rest = scene.particles.per_axis**grid.dimension
    least, most = scene.particles.reseed_range(grid.dimension)
    return Reseeding(grid, boundary, least=least, most=most, particles_a_cell=at_rest, every=settings.every)


def _correction(scene: LiquidScene, grid: StaggeredGrid, boundary: Boundary) -> DensityCorrection | None:
    """Return the density correction if a scene asks for one."""
    settings = scene.density_correction
    if settings is None:
        return None
    count = scene.particles.per_axis
    most = settings.largest(count)
    solver = wl.ProjectedMultigrid(precision=scene.solver.precision)
    return DensityCorrection(
        grid, boundary, solver, particles_a_cell=count**grid.dimension, max_density=most, every=settings.every,
        tolerance=settings.tolerance,
    )  # fmt: skip


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
        boundary, warnings = make_boundary(scene, grid, folder, wall_velocity)
        particles, notes = make_particles(scene, grid, boundary, folder)
        sources, outlets = make_sources(scene, grid, boundary, folder), make_outlets(scene, grid, folder)
        return LiquidSimulation(scene, grid, boundary, particles, sources=sources, outlets=outlets, notes=[*warnings, *notes])
