"""Simulator plug-in `fluids`: liquids by particles on a staggered grid."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, Unpack

import numpy as np

import warp_lcp as wl
from warp_lcp.fluids.forces import SolidForces, WallSums
from warp_lcp.fluids.models import (
    LiquidModel,
    make_pressure,
    make_stokes,
    make_surface,
    make_tension,
    make_viscosity,
    make_whitewater,
    whitewater_reach,
)
from warp_lcp.fluids.pressure import Projection
from warp_lcp.fluids.probes import Probes
from warp_lcp.fluids.scene import LiquidScene
from warp_lcp.fluids.stokes import STOKES_COLUMNS, StokesSolve
from warp_lcp.fluids.surface_tension import REACH
from warp_lcp.fluids.viscosity import VISCOUS_COLUMNS, Viscosity
from warp_lcp.fluids.wall_drag import WallDrag
from warp_lcp.grid.grid_part import ONE_PROCESS
from warp_lcp.grid.particles import SORTED, Particles
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.grid.voxelize import PlacedSolid
from warp_lcp.kernels.joined_graphs import joined
from warp_lcp.kernels.launch_graph import LaunchGraph, copy
from warp_lcp.material.boundary_kernels import RELEASED, TOUCHES_NOTHING
from warp_lcp.material.domain_window import start_of
from warp_lcp.material.particle_assembly import (
    GridComponents,
    make_bodies,
    make_boundary,
    make_narrow_band,
    make_outlets,
    make_particles,
    make_sources,
    make_spray,
    placed_solids,
    start_band,
)
from warp_lcp.material.particle_log import Row
from warp_lcp.material.particle_simulation import ParticleSimulation, ParticleSimulationOptions
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.scene.scene import Scene
from warp_lcp.simulation import Cells, Part, SimulationFailed, missed_by_far

if TYPE_CHECKING:
    from warp_lcp.distributed.ranks import Ranks
    from warp_lcp.distributed.subdomain import Subdomain
    from warp_lcp.material.particle_pieces import Piece


# Methods that solve on several ranks.
METHODS_ON_RANKS = ("projected-multigrid", "minimum-map-newton")
MOST_PARTS = 8  # most viscous solves in a step that is much shorter than the last one


class LiquidSimulation(ParticleSimulation):
    """Simulation of a liquid; implements `warp_lcp.simulation.Simulation`.

    Args:
        scene: the scene.
        grid: the initial grid.
        parts: the fields and models on that grid.
        particles: the initial liquid.
        solids: the solids of the scene, if forces on them are output.
        models: user models, see `warp_lcp.fluids.models.LiquidModel`.
        more: arguments of `ParticleSimulation`.

    Attributes:
        surface: the free surface.
        forces: force output of each solid; None if off.
        tension: surface tension; None if off.
        whitewater: spray, foam and bubbles; None if off.
        projection: the pressure solve and its fields.
        record: callback that gets the problem of each step before its solve; optional.
    """

    scene: LiquidScene

    def __init__(
        self,
        scene: LiquidScene,
        grid: StaggeredGrid,
        parts: GridComponents,
        particles: Particles,
        *,
        solids: Sequence[PlacedSolid] = (),
        models: Sequence[LiquidModel] = (),
        **more: Unpack[ParticleSimulationOptions],
    ) -> None:
        tell = scene.output.forces or (scene.drags is not None and more.get("bodies") is not None)
        self.models = tuple(models)
        self.forces = SolidForces(solids, grid.dimension) if tell else None
        self.whitewater = make_whitewater(scene, grid)
        super().__init__(scene, grid, parts, particles, **more)
        self.record: Callable[[Mapping[str, np.ndarray]], object] | None = None
        self.reach = max(
            self.layers, 2 * scene.pressure.smoothing, 0 if self.tension is None else REACH
        )
        self.measured: dict[str, Row] = {}
        if self.stokes is not None and self.stokes.unsupported:
            self._notes.append(
                "viscosity.splitting_tolerance has no effect with bodies thinner than a cell: "
                "pressure and viscosity act one after the other"
            )
        if self.tension is not None:
            longest = self.tension.longest_step()
            self._notes.append(f"surface tension: steps of at most {longest:.3g} s")
            settings = scene.surface_tension
            angle = 90.0 if settings is None else settings.contact_angle
            if grid.barriers is not None and angle != 90.0:
                thin = ", ".join(grid.barriers.names)
                self._notes.append(
                    f"surface_tension.contact_angle is 90 on {thin}, thinner than a cell"
                )
            if scene.time.dt_min > longest:
                self._notes.append(
                    f"time.dt_min = {scene.time.dt_min:g} s is longer, and steps would be "
                    f"unstable: use {0.1 * longest:.1g}"
                )
        self.mark()

    def allocate(self, grid: StaggeredGrid, parts: GridComponents) -> None:
        """Allocate the fields of a grid."""
        super().allocate(grid, parts)
        self.surface = make_surface(self.scene, grid, self.boundary, self._fill_density())
        self._surface_graph = LaunchGraph(
            grid.device, self._launch_surface, at_once=grid.part.at_once
        )
        self.tension = make_tension(self.scene, grid, self.boundary, self.surface)
        self.projection = make_pressure(
            self.scene, grid, self.boundary, self.surface, self.weights, self.bodies
        )
        self.probes = Probes(self.scene.probe, self.gravity, grid) if self.scene.probe else None
        drags, physics = self.scene.drags, self.scene.physics
        asked = self.forces is not None or drags is not None
        self.wall_sums = WallSums(grid, self.boundary, 1 + len(self.scene.solid)) if asked else None
        self.wall_drag = (
            WallDrag(grid, self.boundary, drags, physics.density) if drags is not None else None
        )
        self.viscosity = make_viscosity(self.scene, grid, self.boundary, self.surface, self.bodies)
        # Velocity before viscosity and pressure, for a second solve, see `_releases_bodies`.
        viscous_bodies = self.viscosity is not None and self.bodies is not None
        self._velocity_at_start = grid.faces() if viscous_bodies else []
        self.spray_viscosity = None if self.viscosity is None else self.viscosity.of_spray()
        self.stokes = make_stokes(
            self.scene,
            grid,
            self.boundary,
            self.surface,
            self.viscosity,
            self.projection,
            self.bodies,
        )
        if self.whitewater is not None:
            self.whitewater.allocate(grid)
        # Airborne momentum and spray corrections assume gravity alone.
        if self.models:
            self.flights = None
        for model in self.models:
            model.allocate(self)
        if self.tension is not None:
            self.projection.jump, self.projection.adhesion = (
                self.tension.jump,
                self.tension.adhesion,
            )

    def particles_to_grid(self, window: Window) -> None:
        """Transfer velocity and viscosity of particles to the grid; apply gravity."""
        super().particles_to_grid(window)
        if self.viscosity is not None and self.viscosity.mixed is not None:
            self.viscosity.mixed.transfer(self.particles, window)

    def stable_dt(self) -> float:
        """Return the longest stable time step for advection and surface tension [s]."""
        dt = super().stable_dt()
        return dt if self.tension is None else min(dt, self.tension.longest_step())

    def mark(self) -> None:
        """Mark the liquid cells; collective."""
        with self.particles.exchange.with_ghosts(SORTED):
            self.surface.begin(self.grid.everywhere)
            self._mark_cells(self.grid.everywhere)
            self.projection.show()

    def step(self, dt: float) -> Row:
        """Advance by dt [s].

        The pressure is solved before any particle moves, so that a failed solve changes at most the
        order of the particles.

        Raises:
            StepFailed: a solve missed its criteria; a smaller dt may be tried.
            SimulationFailed: something is not finite, a particle has left the domain, or enclosed
                liquid would have to change its volume.
            ValueError: dt is not positive.
        """
        with self.attempt(), joined(self.grid.device):
            return self._step(dt)

    def _step(self, dt: float) -> Row:
        """Advance by dt [s]; see `step`.

        Order of a step: particles to grid, with gravity; free surface and surface tension; user
        models; viscosity; pressure and projection; wall impulses and wall drag; extrapolation of
        the velocity; grid to particles; motion of particles and solids. Rigid bodies get their
        impulses from viscosity and pressure, and contacts are solved after both.
        """
        before = self.begin_step(dt)
        if self.forces is not None:
            self.forces.begin(self.time)
        window = self.window(before)
        self.particles_to_grid(window)
        speed = self.top_speed(before)
        self._find_surface(window)
        model_row = self._act(window, dt)
        if self.grid.device.is_cuda and self.surface.density is not None:
            # Counted here, to be read back together with the solve.
            self.monitor_density(window, self.surface.density)
        if self.projection.coupling is not None:
            with self.watch.stage("bodies"):
                self.projection.coupling.take_along(self.velocity, self.projection.kind)
        projected, viscous = self._solve_flow(window, dt, speed)
        if self._releases_bodies(dt):
            projected, viscous = self._solve_flow(window, dt, speed)
        if self.scene.output.diagnostics:
            with self.watch.stage("diagnostics", self.projection.kind):
                self.surface.measure()  # before solids move
                if self.tension is not None:
                    self.tension.measure(window, self.projection.kind)
        walls = self._apply_wall_forces(window, dt)
        self.solve_contacts()
        self.extrapolate_velocity(
            window, self.projection.known, self.projection.kind, self.projection.contact, dt
        )
        if self.projection.coupling is not None:
            self.projection.coupling.move_buried(self.velocity, self.projection.known)
        if self.stokes is not None:
            self.stokes.keep_end(self.velocity)
        self._measure()
        self.exchange(window, self.projection.kind, self.surface.phi, self.projection.contact)
        self.grid_to_particles(window, self.projection.kind, dt)
        if self.tension is not None:
            self.tension.damp_velocity_gradients(self.particles, dt)
        liquid_cells = window.current  # the move changes the active window
        row = (
            self.move(dt, window, self.surface.density, self.projection.contact)
            | self._advance_whitewater(liquid_cells, dt)
            | self.solve_row(projected.result)
            | viscous
            | walls
            | model_row
        )
        if self.scene.output.diagnostics:
            row |= {
                "max_divergence": projected.max_outflow / self.grid.spacing,
                "volume": self.surface.volume(projected.unknowns),
            }
            if self.tension is not None:
                row |= {"surface_energy": self.tension.energy()}
        automatic = self.projection.automatic
        if automatic is not None and projected.result is not None:
            row |= {"tolerance": automatic.used, "time_error": automatic.time_error}
        return self.logged(row | {"active": projected.released})

    def tables(self) -> dict[str, tuple[str, ...]]:
        """Return the columns of the tables besides the log.

        `measured` has the last row of each table. `time` is that of pressures, levels and forces:
        the beginning of the step. Velocities are those of its middle.
        """
        measured = {
            "probes": self.probes,
            "forces": self.forces if self.scene.output.forces else None,
        }
        return {
            name: ("step", "time", *found.columns())
            for name, found in measured.items()
            if found is not None
        }

    def _advance_whitewater(self, window: Window, dt: float) -> Row:
        """Move spray, foam and bubbles after a step; return their log values."""
        if self.whitewater is None:
            return Row()
        with self.watch.stage("whitewater", self.whitewater.particles.position, *self.velocity):
            return self.whitewater.advance(self, window, dt)

    def _measure(self) -> None:
        """Fill the rows of the tables, if any."""
        clock: Row = {"step": self.step_count + 1, "time": self.time}
        if self.probes is not None:
            with self.watch.stage("probes", *self.velocity, self.projection.pressure):
                self.measured["probes"] = clock | self.probes.row(self)
        if self.forces is not None and self.scene.output.forces:
            self.forces.impulses = np.asarray(self.grid.part.ranks.sum(self.forces.impulses))
            self.measured["forces"] = clock | self.forces.row(self.kick_dt)

    def _apply_wall_forces(self, window: Window, dt: float) -> Row:
        """Collect the pressure impulses on solids, and apply wall drag.

        This comes before closed faces get other velocities.

        Returns:
            The log values of the wall drag.
        """
        sums, forces, part = self.wall_sums, self.forces, self.grid.part
        window, row = part.faces(window), Row()
        if sums is None:
            return row
        with self.watch.stage(
            "walls", *self.velocity, self.projection.pressure, self.boundary.touch
        ):
            if forces is not None and self.scene.output.forces:
                forces.add_pressure(sums, window, self)
            if self.wall_drag is not None:
                fields = self.velocity, self.projection, self.surface.phi
                points = forces.references if forces is not None else None
                row["drag_work"], dragged = self.wall_drag.act(
                    sums, window, *fields, self.kick_dt, points
                )
                if forces is not None and dragged is not None:
                    forces.add(dragged)
                if self.bodies is not None and dragged is not None:
                    SolidForces.push(self.bodies, np.asarray(part.ranks.sum(dragged)))
                    # The velocities of the bodies have changed.
                    self.boundary.begin_step(self.time, dt)
                part.fill(*self.velocity)
        return {name: float(part.ranks.sum(float(value or 0.0))) for name, value in row.items()}

    def own_columns(self) -> tuple[str, ...]:
        """Return the log columns of pressure and volume.

        active: wall cells that separate; max_divergence [1/s]: of the other FLUID cells after the
        projection; volume [m^3; m^2 in 2-D]: of the FLUID cells, or inside the surface if this is
        finer than cells. With an automatic tolerance: tolerance, the relative residual used as the
        criterion, and time_error [m/s], the velocity error due to the length of the step. With
        viscosity: iterations and residual of its solve, the energy dissipated in the step, and the
        work of moving walls on the liquid [J; J/m in 2-D]. With wall drag: drag_work, the energy
        that it takes from the liquid in the step [J; J/m in 2-D]. With whitewater: particles of
        each kind, and those removed in the step because there were too many.
        """
        model_columns = tuple(name for model in self.models for name in model.columns)
        drags = ("drag_work",) if self.scene.drags is not None else ()
        columns = (
            ("active", "max_divergence", "volume", *drags)
            if self.scene.output.diagnostics
            else ("active", *drags)
        )
        if self.tension is not None and self.scene.output.diagnostics:
            columns = (*columns, "surface_energy")
        columns = columns if self.viscosity is None else (*columns, *VISCOUS_COLUMNS)
        columns = columns if self.stokes is None else (*columns, *STOKES_COLUMNS)
        automatic = () if self.projection.automatic is None else ("tolerance", "time_error")
        whitewater = () if self.whitewater is None else self.whitewater.columns
        return (*columns, *automatic, *whitewater, *model_columns)

    def frame(self) -> list[Part]:
        """Return the parts of a frame: particles, liquid cells, surface and volume.

        Cells are those of the last solve; surface and volume are optional. Particles have velocity,
        speed and, where it differs, viscosity [Pa s]. Cells have pressure [Pa], wall and released
        flags.
        """
        cells, grid = self.projection.fluid_cells(), self.grid
        at = tuple(cells.T)
        contact = self.projection.contact.numpy()[at]
        fields = {
            "pressure": self.projection.pressures(self.scene.physics.density)[at],
            "wall": (contact != TOUCHES_NOTHING).astype(np.uint8),
            "released": (contact == RELEASED).astype(np.uint8),
        }
        points = self.points()
        if self.scene.viscosity is not None and self.particles.kept is not None:
            points.fields["viscosity"] = (
                self.scene.viscosity.value * self._particle_arrays()["kept"][:, 0]
            )
        return [
            points,
            Cells(
                "grid",
                cells[:, ::-1] - 1 + grid.origin,
                grid.spacing,
                grid.dimension,
                fields,
                self.image_counts,
                grid.part.corners,
            ),
            *([] if self.whitewater is None else [self.whitewater.points()]),
            *self.surfaces(),
            *self.volumes(),
            *self.body_surfaces(),
        ]

    def own_state(self) -> dict[str, np.ndarray]:
        """Return the state of the pressure: first guess of the next solve and frame data."""
        stokes = {} if self.stokes is None else self.stokes.state()
        return self.projection.state() | stokes

    def restore_own(self, state: Mapping[str, np.ndarray]) -> None:
        """Restore the arrays of `own_state`."""
        self.projection.restore(dict(state))
        if self.stokes is not None:
            self.stokes.restore(state)

    def state(self) -> dict[str, np.ndarray]:
        """Return the arrays of a checkpoint, with those of whitewater."""
        return super().state() | ({} if self.whitewater is None else self.whitewater.state())

    def _take_clock(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue with the time, the bodies and the whitewater of a state.

        On ranks, pieces have the whitewater, see `restore_pieces`.
        """
        if self.whitewater is not None and not self.grid.part.shared:
            self.whitewater.restore(state)
        super()._take_clock(state)

    def restore_pieces(self, pieces: Sequence[Piece]) -> None:
        """Continue from the pieces of all ranks of a run; collective.

        Whitewater continues too.
        """
        super().restore_pieces(pieces)
        if self.whitewater is not None and self.grid.part.shared:
            self.whitewater.restore_pieces(pieces)

    def repartition(self, part: Subdomain) -> None:
        """Continue in other boxes of the same ranks, with the whitewater; collective."""
        super().repartition(part)
        if self.whitewater is not None:
            self.whitewater.migrate()

    def _find_surface(self, window: Window) -> None:
        """Mark liquid cells, set their face velocities, and apply surface tension."""
        projection = self.projection
        with self.watch.stage("surface", self.particles.key, projection.kind):
            self.surface.begin(window)
            self._surface_graph.run(
                window, variant=(window.near is None, self.particles.runs is None)
            )
        if self.tension is not None:
            with self.watch.stage("surface tension", *self.velocity, self.tension.jump):
                self.tension.act(self.velocity, window, projection.kind, self.kick_dt)

    def _act(self, window: Window, dt: float) -> Row:
        """Apply the user models; return their log values."""
        row = Row()
        for model in self.models:
            with self.watch.stage(type(model).__name__, *self.velocity):
                row |= model.act(self, window, dt)
        return row

    def _mark_cells(self, window: Window) -> None:
        """Mark liquid cells; ghost cells get the marks of their owners."""
        self.surface.mark(self.particles, window, self.projection.kind)
        self.grid.part.fill(
            self.projection.kind, *([] if self.surface.phi is None else [self.surface.phi])
        )

    def _launch_surface(self, window: Window) -> None:
        """Launch the marking of liquid cells, and the velocities of their faces."""
        self._mark_cells(window)
        self.surface.complete(window, self.velocity, self.weights, self.projection.known)

    def _solve_flow(self, window: Window, dt: float, speed: float) -> tuple[Projection, Row]:
        """Apply viscosity and pressure, one after the other or at once.

        Returns:
            The projection of the step, and the log values of the viscous and the coupled solve.
        """
        if self.viscosity is None:
            return self._project(window, dt, speed), {}
        self._keep_start(self.viscosity)
        viscous, stokes = Row(), self.stokes
        continues = stokes is not None and stokes.continues
        first = self._project(window, dt, speed, measured=not continues)
        if first.result is not None:
            if stokes is not None and continues:
                projected, coupled = self._couple(stokes, first, window, dt, from_last=True)
                if projected is not first:
                    nothing = dict(zip(VISCOUS_COLUMNS, (0, 0.0, 0.0, 0.0), strict=True))
                    return projected, nothing | coupled
            viscous = self._apply_viscosity(self.viscosity, window, dt, speed)
        projected = self._project(window, dt, speed)
        if stokes is not None and viscous and projected.result is not None:
            projected, coupled = self._couple(stokes, projected, window, dt)
            viscous |= coupled
        return projected, viscous

    def _releases_bodies(self, dt: float) -> bool:
        """Release bodies that viscous liquid lifts off their supports, and undo the solves.

        Returns whether there are any: the flow is to be solved again with the bodies free.
        Velocities that gravity reaches in a step do not count.
        """
        if self.viscosity is None or self.bodies is None:
            return False
        kick = self.kick_dt * math.sqrt(self.gravity @ self.gravity)
        with self.watch.stage("bodies"):
            released = self.bodies.release_lifted(kick)
        if released:
            for u, before in zip(self.velocity, self._velocity_at_start, strict=True):
                copy(u, before)
            if self.forces is not None:
                self.forces.impulses = self._impulses_before.copy()
            if self.stokes is not None:
                self.stokes.continues = False  # the last step's bodies were held
        return released

    def _keep_start(self, viscosity: Viscosity) -> None:
        """Store what the step begins with, before the first projection."""
        for before, u in zip(self._velocity_at_start, self.velocity, strict=False):
            copy(before, u)
        viscosity.begin_step(self.kick_dt)
        viscosity.store_velocity(self.velocity)
        if self.stokes is not None:
            self.stokes.keep_start(self.velocity, self.kick_dt)
        if self.forces is not None:
            self._impulses_before = self.forces.impulses.copy()
        self._momenta_before = np.empty(0) if self.bodies is None else self.bodies.bodies.momenta()

    def _apply_viscosity(
        self, viscosity: Viscosity, window: Window, dt: float, speed: float
    ) -> Row:
        """Apply viscosity after the first projection; return its log values.

        The first pressure solve finds which walls hold the liquid: viscosity acts on the projected
        velocity. Its change is then added to the velocity before that projection, and the pressure
        is solved again. So the pressure balances viscous stresses too, and walls separate according
        to the sum of both.
        """
        projection, momenta = self.projection, self._momenta_before
        self.extrapolate_velocity(window, projection.known, projection.kind, projection.contact)
        # A step much shorter than the last one, such as a retry, still has to make up for half of
        # that step: several solves, none stiffer than this step's own length requires.
        parts, total = min(max(1, int(self.kick_dt / dt)), MOST_PARTS), None
        for part in range(parts):
            if part:
                viscosity.keep_change()
                momenta = self._move_on(viscosity, momenta, dt)
            with self.watch.stage("viscosity", *self.velocity, projection.kind, projection.contact):
                arguments = (
                    self.velocity,
                    window,
                    projection.kind,
                    projection.contact,
                    self.kick_dt / parts,
                    speed,
                )
                result = viscosity.solve(*arguments, last=part + 1 == parts)
            if not result.converged:
                residual = (
                    f"relative residual of {result.relative_residual:.2e} (tolerance "
                    f"{viscosity.tolerance})"
                )
                raise missed_by_far(
                    "viscous",
                    result.status,
                    result.iterations,
                    residual,
                    "a shorter step is less stiff",
                )
            if self.forces is not None and self.scene.output.forces:
                self.forces.add(
                    viscosity.impulses(
                        self.velocity, projection.kind, projection.contact, self.forces.references
                    )
                )
            total = result if total is None else result.after(total)
        assert total is not None
        if self.stokes is not None:
            self.stokes.keep_viscous(self.velocity)
        viscosity.undo(self.velocity)
        if self.bodies is not None:
            self.bodies.bodies.restore_momenta(momenta)
        viscosity.push_bodies()
        return dict(zip(VISCOUS_COLUMNS, total.row(), strict=True))

    def _couple(
        self,
        stokes: StokesSolve,
        projected: Projection,
        window: Window,
        dt: float,
        *,
        from_last: bool = False,
    ) -> tuple[Projection, Row]:
        """Solve for velocity and pressure at once if the split step is not accurate enough.

        `from_last`: after the first projection, from the result of the last step.

        Returns:
            The projection of the step, which is `projected` if no coupled solve is used, and its
            log values.
        """

        def moved() -> None:
            if self.bodies is not None:
                self.boundary.begin_step(self.time, dt)

        projection = self.projection
        with self.watch.stage("coupled solve", *self.velocity, projection.pressure):
            result = (
                stokes.couple_from_last(self.velocity, window, self.kick_dt, moved)
                if from_last
                else stokes.solve(self.velocity, self.kick_dt, moved)
            )
            if result.used:
                assert projected.result is not None
                if self.forces is not None and self.scene.output.forces:
                    self.forces.impulses = self._impulses_before + stokes.impulses(
                        self.velocity, self.forces.references
                    )
                residual = projected.result.residual
                projected = projection.correct(
                    self.velocity, window, dt, self.kick_dt, residual, moved
                )
                self._held(projected)
        return projected, Row(result.row())

    def _move_on(self, viscosity: Viscosity, momenta: np.ndarray, dt: float) -> np.ndarray:
        """Apply the impulses of one of several viscous solves of a step to the bodies.

        Returns their momenta before the first solve with these impulses added.
        """
        if self.bodies is None:
            return momenta
        before = self.bodies.bodies.momenta()
        viscosity.push_bodies()
        # The velocities of the bodies have changed.
        self.boundary.begin_step(self.time, dt)
        return momenta + self.bodies.bodies.momenta() - before

    def _project(
        self, window: Window, dt: float, speed: float, *, measured: bool = True
    ) -> Projection:
        """Solve for the pressure and project the velocity.

        The bodies get the impulses of the pressure first, so that closed faces have the bodies' new
        velocities in the projection. Without unknowns, all liquid is spray and only the sources'
        faces are set. `measured`: see `PressureProjection.solve`.
        """
        projection, watch = self.projection, self.watch
        with watch.stage("pressure set-up", *self.velocity, *projection.fields()):
            self.boundary.begin_step(self.time, dt)
            if self.sources is not None:
                self.sources.supply(self.time + 0.5 * dt, self.velocity, projection.kind)
            there = projection.prepare(self.velocity, dt, self.kick_dt, window)
        if not there or (self.grid.device.is_cpu and projection.counted() == 0):
            return self._held(projection.leave())
        if self.grid.device.is_cuda and self.flights is not None:
            with watch.stage("bodies in flight", projection.kind):
                self.flights.find(window, self.weights, projection.kind)
        if self.record is not None:
            with watch.stage("recording", *projection.fields()):
                clock = {
                    "step": np.array(self.step_count),
                    "time": np.array(self.time),
                    "dt": np.array(float(dt)),
                }
                self.record(projection.recorded(speed) | clock)
        with watch.stage("pressure solve", *projection.fields()):
            result, criteria = projection.solve(speed, measured=measured)
        # A GPU has not waited for the number of unknowns.
        if projection.counted() == 0:
            return self._held(projection.leave())
        if not result:
            self._explain(result)
        if self.bodies is not None:
            with watch.stage("bodies"):
                projection.push_bodies(result)
                # The velocities of the bodies have changed.
                self.boundary.begin_step(self.time, dt)
        with watch.stage(
            "projection",
            *self.velocity,
            *projection.known,
            projection.pressure,
            projection.kind,
            projection.contact,
        ):
            return self._held(projection.project(self.velocity, window, result, criteria))

    def _held(self, projected: Projection) -> Projection:
        """Reset the velocities of the sources' faces, and show their cells as liquid."""
        if self.sources is not None:
            self.sources.impose_velocity(
                self.velocity, self.projection.known, self.projection.cells
            )
        return projected

    def _explain(self, result: wl.SolveResult) -> NoReturn:
        """Raise the error that explains a failed solve.

        Raises:
            StepFailed: a smaller dt may be tried.
            SimulationFailed: no dt helps.
        """
        cells = (
            self.projection.not_finite()
            if result.status is wl.SolveStatus.NON_FINITE
            else np.zeros((0, 3))
        )
        if len(cells):
            where = tuple(int(c) for c in cells[0])
            raise SimulationFailed(
                f"step {self.step_count}: the velocity on the faces of cell (x, y, z) = {where} is "
                f"not finite ({len(cells)} cells)"
            )
        # No smaller dt helps.
        if result.status is wl.SolveStatus.INFEASIBLE and (self.boundary.velocity or self.sources):
            raise SimulationFailed(
                f"step {self.step_count}: liquid fills a closed space whose volume changes, by "
                "moving walls or sources; "
                'leave air in it, or set wall = "separating" for a wall that moves away'
            )
        residual = (
            f"relative residual of {result.relative_residual:.2e} (tolerance "
            f"{self.projection.tolerance})"
        )
        raise missed_by_far(
            "pressure", result.status, result.iterations, residual, result.status.value
        )


class FluidsSimulator:
    """Simulator plug-in for liquids that separate from walls."""

    name = "fluids"
    summary = "liquids that separate from walls"
    scene_model = LiquidScene

    def create(
        self,
        scene: Scene,
        *,
        device: str,
        folder: Path,
        ranks: Ranks | None = None,
        wall_velocity: np.ndarray | None = None,
        models: Sequence[LiquidModel] = (),
    ) -> LiquidSimulation:
        """Build the simulation of a scene; on ranks, this rank's part (collective).

        Args:
            scene: the scene, a LiquidScene.
            device: a Warp device's name.
            folder: folder of the files that the scene names.
            ranks: MPI ranks that share the simulation, with the same scene on each; None for one
                process.
            wall_velocity: velocity [m/s] of the domain's wall and of each solid, shape (1 + solids,
                3), constant; the solids' cells stay fixed. None if all are at rest.
            models: user models, see `warp_lcp.fluids.models.LiquidModel`.

        Raises:
            ValueError: the scene cannot be simulated, or not on ranks; the message names the key
                and what is allowed. On all ranks.
        """
        if not isinstance(scene, LiquidScene):
            raise ValueError("scene.simulator: fluids needs a scene of liquid")
        solids = placed_solids(scene, folder)
        bodies = make_bodies(scene, solids, partial(RigidBodies, ranks=ranks or ONE_PROCESS))
        return self.assemble(
            scene,
            solids,
            bodies,
            device=device,
            folder=folder,
            ranks=ranks,
            wall_velocity=wall_velocity,
            models=models,
        )

    def assemble(
        self,
        scene: LiquidScene,
        solids: Sequence[PlacedSolid],
        bodies: RigidBodies | None,
        *,
        device: str,
        folder: Path,
        ranks: Ranks | None = None,
        wall_velocity: np.ndarray | None = None,
        models: Sequence[LiquidModel] = (),
    ) -> LiquidSimulation:
        """Build the simulation of a scene from placed solids and bodies.

        `bodies` are those that the liquid moves; other arguments as in `create`. `scene.solid`, in
        the same order, has the boundary condition of each solid.
        """
        warnings: list[str] = []

        def make_parts(grid: StaggeredGrid) -> GridComponents:
            boundary, warnings[:] = make_boundary(scene, grid, folder, wall_velocity, solids=solids)
            return GridComponents(
                boundary,
                make_sources(scene, grid, boundary, folder),
                make_narrow_band(scene, grid, boundary, folder),
            )

        if ranks is None:
            coverage, grid = start_of(scene, device)
        else:
            # Imported here, since it needs an optional package.
            from warp_lcp.distributed.particle_assembly import part_of

            coverage, grid = (
                None,
                part_of(
                    scene,
                    ranks,
                    device,
                    methods=METHODS_ON_RANKS,
                    smoothing=scene.pressure.smoothing,
                    reach=whitewater_reach(scene),
                ).grid,
            )
        parts = make_parts(grid)
        without = start_band(scene, grid, parts.boundary, folder, parts.band)
        particles, notes = make_particles(scene, grid, parts.boundary, folder, without)
        outlets, spray = (
            make_outlets(scene, grid, folder),
            None if models else make_spray(scene, coverage, solids),
        )
        return LiquidSimulation(
            scene,
            grid,
            parts,
            particles,
            make_parts=make_parts,
            solids=solids,
            outlets=outlets,
            bodies=bodies,
            coverage=coverage,
            spray=spray,
            models=models,
            notes=[*warnings, *notes],
        )
