"""Particle simulations: the parts of a step besides the material's own solve."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TypedDict

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.grid.active_rows import ActiveRows
from warp_lcp.grid.particle_ids import ParticleIds
from warp_lcp.grid.particle_loops import MARGIN
from warp_lcp.grid.particles import Particles, ParticleTotals
from warp_lcp.grid.staggered import ActiveWindow, StaggeredGrid, Window
from warp_lcp.grid.transfer import accelerate, faces_to_particles, particles_to_faces
from warp_lcp.kernels.launch_graph import LaunchGraph, copy
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.material.domain_window import DomainWindow, carry_over, cells_between, pace_of, travel
from warp_lcp.material.particle_assembly import (
    GridComponents,
    make_flights,
    make_particle_volume,
    make_surface_mesh,
)
from warp_lcp.material.particle_checkpoints import ParticleCheckpoints
from warp_lcp.material.particle_log import CompletedStep, Row, columns, solve_row, totals_row
from warp_lcp.material.particle_redistribution import ParticleRedistribution
from warp_lcp.material.particle_scene import ParticleScene
from warp_lcp.material.particle_state import particle_trouble
from warp_lcp.material.sources import Drain, Outlets, Source
from warp_lcp.material.spray import Spray
from warp_lcp.material.velocity_extrapolation import LayerCallback, SprayViscosity
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.simulation import NoStopwatch, SimulationFailed, StepFailed, Stopwatch

# Largest relative residual of bodies' contacts. Above it gravity's velocity of a step is wrong by a
# hundredth, and bodies creep.
CONTACTS_MISSED = 1e-2


class ParticleSimulationOptions(TypedDict, total=False):
    """Optional arguments of `ParticleSimulation`, see there."""

    make_parts: Callable[[StaggeredGrid], GridComponents] | None
    outlets: Outlets | None
    bodies: RigidBodies | None
    coverage: DomainWindow | None
    spray: Spray | None
    notes: Sequence[str]


class ParticleSimulation(ParticleCheckpoints):
    """Simulation of particles on a staggered grid, without the material's own solve.

    A subclass calls the parts of a step in its own `step`. Particles have the velocities of the
    middle of the last step; the grid has, in a step, those of its middle. Forces act for `kick_dt`,
    half of the last step and half of this one; then particles move for the whole step (the leapfrog
    of Verlet). One solve a step gives a scheme that is its own inverse in time, whatever the steps'
    lengths: airborne material moves along its parabola.

    The grid's part defines the cells that this process works on. On several ranks, making a
    simulation, `stable_dt`, `step`, `mark`, `frame` and `restore_pieces` are collective. They give
    every rank the same numbers, or raise the same error on all. Rows of the log are of the whole
    material; a frame has this rank's particles and cells. Data of other ranks are exchanged where
    they are needed: particles within a cell of the cut before the transfer to the faces; velocities
    and weights of the faces; the material's fields of cells; the solve, which is one solve of all
    ranks; the velocity after the solve, and again while it is extrapolated into air and walls. The
    same kernels compute with the same numbers in the same order as one process does. Runs on
    different numbers of ranks therefore differ only by rounding in the solver and in sums over all
    particles.

    A step calls `begin_step`, `window` and `particles_to_grid`; changes `velocity` by the laws of
    its material; then calls `extrapolate_velocity`, `grid_to_particles` and `move`, and returns the
    log columns of `logged`. Until `move` the state is unchanged except for the order of the
    particles, so that a solve may fail. The whole step is in the context `attempt`.

    For rigid bodies, `begin_step` starts their step and `move` ends it. In between, the subclass
    gives them the impulses of its solve and calls `solve_contacts`.

    With `parts`, `particles`, `outlets` and `bodies` of `particle_assembly` the class has the
    clock, time step, checkpoints, resampling, notes and columns of a Simulation; the subclass
    defines `step` and `frame`.

    Args:
        scene: the scene.
        grid: the initial grid.
        parts: the parts that belong to that grid: walls and solids, sources, a narrow band.
        particles: this process's material at the start.
        make_parts: makes the parts of another grid; None if the grid never changes.
        outlets: drains and open sides.
        bodies: solids of the boundary that the material moves.
        coverage: chooses the grid window; None if the grid never changes.
        spray: carries particles that need no grid; None if there is none.
        notes: notes for the start of a run.

    Attributes:
        particles: the material, without its spray.
        births: ids that have been given and their times; None if particles have no ids.
        velocity: velocity of the last step on the faces, one field a component [m/s].
        weights: weights of the particles on each component's faces, in the last step.
        flights: conserves the momenta of airborne bodies; None if it is off.
        gravity: [m/s^2], shape (3,).
        particle_mass: [kg]; 2-D: [kg/m].
        layers: number of layers of faces to which the velocity is extrapolated into air and walls.
        reach: distance from particles, in cells, within which a step writes to cells; more than
            `layers` where a subclass needs it.
        time: [s].
        step_count: steps done.
        last_dt: length of the last step [s], 0 before the first.
        kick_dt: time for which forces act in the current step [s].
        watch: stopwatch of the stages of a step.
        sides: periodic sides; None if there are none.
        diagnostics: functions that are called before the totals of moved particles, to launch work
            that is read with them.
        vicinity: active row segments, the cells that a step must visit; None for all cells around
            the particles.
        spray_viscosity: viscous stress on spray beside the material; None without viscosity.
    """

    vicinity: ActiveRows | None = None
    spray_viscosity: SprayViscosity | None = None

    def __init__(
        self,
        scene: ParticleScene,
        grid: StaggeredGrid,
        parts: GridComponents,
        particles: Particles,
        *,
        make_parts: Callable[[StaggeredGrid], GridComponents] | None = None,
        outlets: Outlets | None = None,
        bodies: RigidBodies | None = None,
        coverage: DomainWindow | None = None,
        spray: Spray | None = None,
        notes: Sequence[str] = (),
    ) -> None:
        """Allocate the fields, fill running sources and sort the particles."""
        self.scene, self.particles, self.outlets, self.bodies = scene, particles, outlets, bodies
        self._bodies_at_start = (
            [body.state() for body in bodies.bodies] if bodies is not None else []
        )
        self.time, self.step_count, self.last_dt, self.kick_dt = 0.0, 0, 0.0, 0.0
        self._make_parts = make_parts
        self.diagnostics: list[Callable[[], None]] = []
        self._velocity_before = np.zeros(3)  # mean of the particles at the start of the step [m/s]
        self.watch: Stopwatch = NoStopwatch()
        self.gravity = np.array([*scene.physics.gravity, 0.0][:3])
        self.particle_mass = (
            scene.physics.density * grid.cell_volume / scene.particles.per_axis**grid.dimension
        )
        self.births = ParticleIds() if particles.ids is not None else None
        self.layers = self.reach = math.ceil(scene.time.cfl) + 2
        self._coverage, self.spray = coverage, spray or Spray(grid, (), 0, active=False)
        others = set(vars(self))
        self.allocate(grid, parts)
        self._laid = vars(self).keys() - others  # attributes that belong to a grid
        self._notes = list(notes)
        if self.sources is not None:
            self.sources.emit(particles, None, self.time)
        particles.sort()
        particles.exchange.count()
        if self.births is not None:
            cells = particles.exchange.last_cells(0)
            self.births.give(particles, 0, grid.part, self.time, cells)

    def allocate(self, grid: StaggeredGrid, parts: GridComponents) -> None:
        """Allocate the parts that belong to a grid; subclasses add theirs."""
        scene, self.grid, self.boundary = self.scene, grid, parts.boundary
        self.sources, self.band = parts.sources, parts.band
        self._faces_know = False  # the velocity of the particles, around them
        self._columns: tuple[str, ...] | None = None  # columns of the log, after their first use
        # [m]. A tent at the very end would reach beyond the stored cells.
        self._ends = grid.extent - 0.5 * MARGIN * grid.spacing
        self.active, self.kicks = ActiveWindow(grid.everywhere), [Scalar() for _ in range(3)]
        self.sides, at_once = parts.boundary.sides, grid.part.at_once
        self._transfer_to_grid = LaunchGraph(
            grid.device, self._launch_particles_to_grid, at_once=at_once
        )
        self._extrapolation = LaunchGraph(grid.device, self._launch_extrapolation, at_once=at_once)
        # Near barriers FLIP copies velocities; a recorded launch would copy a fixed number.
        at_once |= grid.barriers is not None
        self._transfer_to_particles = LaunchGraph(
            grid.device, self._launch_grid_to_particles, at_once=at_once
        )
        self.velocity, self.weights = grid.faces(), grid.faces()
        self._saved = grid.faces() if scene.particles.transfer == "flip" else None
        # Active rows need a grid without ranks, without an interior and without periodic axes.
        if not (grid.part.shared or self.band is not None or scene.endless):
            self.vicinity = ActiveRows(grid, self.vicinity)
        self.flights = make_flights(scene, grid, self.boundary)
        self.rearrangement = ParticleRedistribution(scene, grid, self.boundary)
        self.surface_mesh = make_surface_mesh(scene, grid, self.boundary)
        self.particle_volume = make_particle_volume(scene, grid, self.boundary)

    @abstractmethod
    def own_columns(self) -> tuple[str, ...]:
        """Return the names of the log's columns that the material's own models fill."""

    def regrid(self, grid: StaggeredGrid, state: Mapping[str, np.ndarray] | None = None) -> None:
        """Continue on another grid of the same domain.

        Args:
            grid: the other one.
            state: the state to continue from; None for the current one.
        """
        before, kept = self.grid, self._fields() if state is None else state
        self._move_window(grid)
        if state is None:
            self.rearrangement.expect(kept)
            self._take_fields(carry_over(kept, before, grid, self._fields()))

    def _move_window(self, grid: StaggeredGrid) -> None:
        """Allocate another grid; its fields have no values yet."""
        assert self._make_parts is not None, "this grid is kept"
        for name in self._laid - {"vicinity"}:  # so that their memory is there for what comes
            delattr(self, name)
        bodies = self.bodies.bodies if self.bodies is not None else []
        now = [body.state() for body in bodies]
        for body, state in zip(bodies, self._bodies_at_start, strict=True):
            body.restore(state)  # the cells of a source are those that are open at the start
        self.allocate(grid, self._make_parts(grid))
        for body, state in zip(bodies, now, strict=True):
            body.restore(state)
        self.particles.move_to(grid)
        self.boundary.place(self.time)

    def _follow(self, totals: ParticleTotals, dt: float) -> None:
        """Change the grid or the boxes of ranks, if needed.

        The grid changes if the material leaves it in a step, or if it is much too large.

        The required cells are the box around all particles, grown on each side by reach + 3 cells
        and the most cells that the material can move in the step.
        """
        if self.grid.part.should_rebalance(self.step_count):
            self.rebalance()
        if self._coverage is None or (
            self._coverage.domain == self.grid
            and not self._coverage.active
            and not self.scene.domain.boundless
        ):
            return
        way = travel(totals.max_speed, float(np.linalg.norm(self.gravity)), dt, self.grid.spacing)
        # `window`, one cell off the grid's end, and the cells that the step adds.
        grow = self.reach + 3 + way
        low, high = cells_between(totals.low, totals.high, self.grid.spacing, grow)
        if self.scene.domain.boundless and (trouble := self._coverage.beyond(high)):
            raise SimulationFailed(f"step {self.step_count}: {trouble}")
        filled = totals.count / self.scene.particles.per_axis**self.grid.dimension
        grid = self._coverage.around(
            low, high, self.grid, pace_of(totals, dt, self.grid.spacing), filled=filled
        )
        if grid != self.grid:
            with self.watch.stage("regridding", *self.velocity):
                self.regrid(grid)

    def stable_dt(self) -> float:
        """Return the CFL time step: CFL dx / (v_max + sqrt(CFL g dx)) [s].

        v_max is the largest speed of the material, and of solids and sources in the near future.
        A liquid near moving thin solids goes at most one cell in their frame, see
        `warp_lcp.grid.thin_walls.ThinWalls.longest_step`.
        """
        cfl, dx = self.scene.time.cfl, self.grid.spacing
        with self.watch.stage("diagnostics", self.particles.position, self.particles.velocity):
            totals = (
                self.particles.totals()
                if self.band is None
                else self.band.with_interior(self.particles.totals())
            )
        driven = [
            part.top_speed(self.time, self.scene.time.dt_max)
            for part in (self.boundary, self.sources)
            if part is not None
        ]
        # Gravity's own speed counts, so that the time step of a material at rest is bounded.
        speed = max(totals.max_speed, *driven) + math.sqrt(
            cfl * math.sqrt(self.gravity @ self.gravity) * dx
        )
        dt = cfl * dx / speed if speed > 0.0 else math.inf
        thin = self.boundary.thin
        if thin is None or not (thin.moves and self.scene.keeps_volume):
            return dt
        with self.watch.stage("diagnostics", self.particles.position, self.particles.velocity):
            longest = thin.longest_step(
                self.particles.position,
                self.particles.velocity,
                self.time,
                min(dt, self.scene.time.dt_max),
                (cfl + 1.0) * dx,
            )
        return min(dt, longest)

    def events(self, until: float) -> list[float]:
        """Return the times [s] of events later than now, up to `until`.

        Events are starts and stops of sources and drains, and jumps of a solid's velocity.
        """
        timed: list[Source | Drain] = [
            *(self.sources.sources if self.sources else ()),
            *(self.outlets.drains if self.outlets else ()),
        ]
        times = (
            *self.boundary.kinks,
            *(time for part in timed for time in (part.start, part.stop)),
        )
        return [time for time in times if self.time < time <= until]

    @abstractmethod
    def step(self, dt: float) -> Row:
        """Advance by dt [s]; return the row of the log."""

    def rebalance(self) -> None:
        """Continue in better boxes of ranks, if there are any; collective.

        The busiest rank then has least work; the gain must be large enough.
        """
        with self.watch.stage("repartitioning", self.particles.position):
            part = self.grid.part.rebalance(
                self.particles, self.scene.particles.per_axis**self.grid.dimension
            )
            if part is not None:
                self.repartition(part)

    @contextmanager
    def attempt(self) -> Iterator[None]:
        """Return a context for a step that restores bodies and removes ghosts on failure."""
        try:
            yield
        except (StepFailed, SimulationFailed):
            self.particles.drop_ghosts()
            if self.bodies is not None:
                self.bodies.restore_step()
            raise

    def begin_step(self, dt: float) -> ParticleTotals:
        """Check time step and particles, arrange the particles, and return sums over them.

        Args:
            dt: time step [s].

        Raises:
            StepFailed: the bodies' contacts are far from solved.
            SimulationFailed: something is not finite, or a particle has left the domain.
            ValueError: dt is not positive.
        """
        if not (math.isfinite(dt) and dt > 0.0):
            raise ValueError(f"dt = {dt}: must be a positive time [s]")
        totals = self.checked_totals("at the start of")
        self.particles.totals_stay(False)
        if self.spray.active:
            with self.watch.stage("spray", self.particles.position):
                totals = self.spray.exchange(self.particles, totals, self.step_count, self.time, dt)
        self.kick_dt, self._velocity_before = (
            0.5 * (self.last_dt + dt),
            self.spray.with_own(totals).velocity,
        )
        self._follow(totals, dt)
        with self.watch.stage("sort", *self.particles.arrays().values()):
            self.particles.arrange(self.step_count)
        if self.bodies is not None:
            with self.watch.stage("bodies"):
                self.bodies.begin_step(self.time, dt, self.gravity, self.kick_dt)
                self._check_contacts()
        return totals

    def solve_contacts(self) -> None:
        """Solve the rigid bodies' contacts with the impulses of the material.

        Nothing has moved yet.

        Raises:
            StepFailed: they are far from solved; the bodies are where they were before the step.
        """
        if self.bodies is not None:
            with self.watch.stage("bodies"):
                self.bodies.solve_contacts()
                self._check_contacts()

    def _check_contacts(self) -> None:
        assert self.bodies is not None
        residual = self.bodies.contact_residual
        if residual > CONTACTS_MISSED:
            raise StepFailed(
                f"the rigid bodies' contacts are solved to a relative residual of {residual:.2e} "
                f"only (allowed: {CONTACTS_MISSED}): "
                "bodies of very different masses press on each other"
            )

    def window(self, totals: ParticleTotals) -> Window:
        """Return the cells that particles can touch in a step, as the `active` window."""
        self.active.move_to(self._reached(totals))
        return self.active

    def _reached(self, totals: ParticleTotals) -> Window:
        """Return the cells that particles can touch in a step."""
        low, high = (self.particles.cell_of(corner) for corner in (totals.low, totals.high))
        box = self.grid.window(low, high, grow=self.reach + 2, shift=1)
        return (
            box
            if self.vicinity is None
            else self.vicinity.window(box, self.particles, self.reach + 2, self.step_count)
        )

    def top_speed(self, totals: ParticleTotals) -> float:
        """Return the scale of the velocities after `particles_to_grid` [m/s]."""
        return totals.max_speed + self.kick_dt * math.sqrt(self.gravity @ self.gravity)

    def particles_to_grid(self, window: Window) -> None:
        """Transfer particle velocities to the faces (P2G); apply gravity for `kick_dt`."""
        p = self.particles
        with self.watch.stage(
            "particles-to-grid", *p.arrays().values(), *self.velocity, *self.weights
        ):
            for kick, change in zip(self.kicks, self.gravity * self.kick_dt, strict=True):
                kick.value = float(change)
            # Gravity may change its direction between steps.
            acts = tuple(kick.value != 0.0 for kick in self.kicks)
            self._transfer_to_grid.run(window, variant=(window.near is None, acts, p.runs is None))

    def _launch_particles_to_grid(self, window: Window) -> None:
        p = self.particles
        order = {"offsets": p.offsets, "runs": p.runs}
        particles_to_faces(
            self.grid,
            p.position,
            p.velocity,
            p.affine,
            self.velocity,
            self.weights,
            window=window,
            **order,
        )
        if self.band is not None:
            self.band.blend(window, self.velocity, self.weights)
        for field, saved in zip(self.velocity, self._saved or (), strict=False):
            copy(saved, field)
        accelerate(window, self.velocity, self.weights, self.kicks)
        self.grid.part.fill(*self.velocity, *self.weights, *(self._saved or ()))

    def extrapolate_velocity(
        self,
        window: Window,
        known: Sequence[wp.array],
        kind: wp.array,
        contact: wp.array,
        dt: float = 0.0,
    ) -> None:
        """Extrapolate the velocity from the valid faces of a solve into air and walls.

        See `warp_lcp.material.velocity_extrapolation`.

        Args:
            window: faces to consider.
            known: int8 of each component (updated): 1 on valid faces, 0 on others, -1 inside solids
                of whole cells.
            kind: int8 of AIR, FLUID, SOLID.
            contact: uint8 of TOUCHES_NOTHING, HELD, RELEASED, see
                `warp_lcp.material.boundary_kernels`.
            dt: time step [s] that particles then move by.

        Raises:
            StepFailed: it is so fast that particles would leave the ghost cells of a rank.
        """
        with self.watch.stage(
            "extrapolation",
            *self.velocity,
            *self.weights,
            *known,
            kind,
            contact,
            *self.boundary.open,
        ):
            self._extrapolation.run(window, list(known), kind, contact, variant=window.near is None)
        cells = self.grid.part.cells_too_far(self.velocity, dt)
        if cells > 0.0:
            material, layers = self.scene.materials()[0], self.grid.part.layers - 1
            raise StepFailed(
                f"step {self.step_count}: {material} would move {cells:.1f} cells, more than the "
                f"ghost layers of a rank, {layers}"
            )

    def _launch_extrapolation(
        self, window: Window, known: list[wp.array], kind: wp.array, contact: wp.array
    ) -> None:
        self._continue(window, known, kind, contact, self._layer_filled())
        if self.sources is not None:
            self.sources.impose_velocity(self.velocity, [])
        self.grid.part.fill(*self.velocity)

    def _continue(
        self,
        window: Window,
        known: list[wp.array],
        kind: wp.array,
        contact: wp.array,
        join: LayerCallback | None,
    ) -> None:
        """Extrapolate the velocity among the boundary's walls.

        `join` is called after each layer.
        """
        self.boundary.extrapolate_velocity(
            window,
            self.velocity,
            self.weights,
            known,
            kind,
            contact,
            self.layers,
            join,
            self.spray_viscosity,
        )

    def _layer_filled(self) -> LayerCallback | None:
        """Return a function that is called after each layer of extrapolated faces.

        Its arguments are the marks and the field of a component. It fills ghost cells and periodic
        sides; None if there is nothing to fill.
        """
        refill, sides = self.grid.part.refill(), self.sides
        if refill is None or sides is None:
            return refill if sides is None else sides.wrap

        def join(marks: wp.array, field: wp.array) -> None:
            refill(marks, field)
            sides.wrap(marks, field)

        return join

    def exchange(
        self, window: Window, kind: wp.array, phi: wp.array | None, contact: wp.array
    ) -> None:
        """Exchange particles with the interior of a narrow band, if there is one.

        Arguments as of `warp_lcp.material.narrow_band.NarrowBand`.
        """
        if self.band is not None:
            with self.watch.stage(
                "narrow band", *self.particles.arrays().values(), self.band.depth
            ):
                self.band.exchange(
                    self.particles, window, kind, phi, contact, self.step_count, self._saved or ()
                )
                if self.births is not None:
                    begin = self.particles.count - self.band.fresh
                    cells = self.particles.exchange.last_cells(begin, self.band.behind)
                    self.births.give(self.particles, begin, self.grid.part, self.time, cells)

    def grid_to_particles(self, window: Window, kind: wp.array, dt: float) -> None:
        """Find airborne bodies; transfer the faces' velocity to the particles (G2P).

        Args:
            window: window of the step.
            kind: int8 of AIR, FLUID, SOLID, of the step's solve.
            dt: time step [s].
        """
        particles = self.particles
        particles.drop_ghosts()
        if self.flights is not None:
            with self.watch.stage("bodies in flight", particles.position):
                self.flights.begin(
                    particles, window, self.weights, kind, dt, self.gravity * self.kick_dt
                )
        self._faces_know = True
        with self.watch.stage("grid-to-particles", *particles.arrays().values(), *self.velocity):
            self._transfer_to_particles.run()

    def _launch_grid_to_particles(self) -> None:
        p, flip = self.particles, self.scene.particles.flip_ratio if self._saved else 0.0
        faces_to_particles(
            self.grid, self.velocity, p.position, p.velocity, p.affine, saved=self._saved, flip=flip
        )

    def move(
        self,
        dt: float,
        window: Window,
        density: wp.array | None = None,
        contact: wp.array | None = None,
    ) -> Row:
        """Move particles and solids by dt [s], and finish the step.

        Particles are exchanged with sources and outlets and redistributed; the clock advances.

        Args:
            dt: time step [s].
            window: window of the step.
            density: density of the particles before they move, in units of that at rest; None if it
                is not known.
            contact: uint8 of TOUCHES_NOTHING, HELD, RELEASED: the contact with walls in the step;
                None if it is not known.

        Returns:
            The log entries of the step and of the particles.

        Raises:
            SimulationFailed: something is not finite, or a particle has left the domain.
        """
        early = self._monitored and self.rearrangement.corrects_alone(self.step_count)
        self.monitor_density(window, density)
        with self.watch.stage("advection", self.particles.position, *self.velocity):
            self.carry(dt)
        if self.band is not None:
            with self.watch.stage("narrow band", self.band.depth, *self.velocity):
                self.band.carry(self.velocity, dt)
        exchanged = (
            self._exchange(dt) if self.outlets is not None or self.sources is not None else {}
        )
        if not early:
            after = self._totals_after_move("after")
            stopped, pushed, stuck = self.collision_counts()
        rearranged: Row = {"max_density": self.rearrangement.max_density}
        if self.rearrangement.due(self.step_count):
            fill = self.band.fill_interior if self.band is not None else None
            window = self._everywhere() if early else self.window(after)
            rearranged |= self.rearrangement.apply(
                self.particles, window, self.step_count, dt, self.watch, fill, contact
            )
            # The density correction may push particles out through open sides.
            if self.outlets is not None:
                exchanged["departed"] += int(
                    self.grid.part.ranks.sum(self.outlets.remove_departed(self.particles))
                )
            if early:
                # As read with the solve, before particles have been displaced.
                stopped, pushed, stuck = self.collision_counts()
            if (
                early
                or self.rearrangement.moved
                or self.outlets is not None
                or self.grid.part.shared
            ):
                after = self._totals_after_move("after the density correction of")
        self.particles.totals_stay(True)
        self.time += dt
        self.step_count += 1
        self.last_dt = dt
        return (
            self._totals_row(after, dt)
            | {"stopped": stopped, "pushed": pushed, "stuck": stuck}
            | rearranged
            | exchanged
        )

    def monitor_density(self, window: Window, density: wp.array | None) -> None:
        """Measure the density at the start of a step, unless it has been measured.

        Nothing has moved yet.

        Args:
            window: around the particles.
            density: density of the particles, in units of that at rest, where it is known.
        """
        with self.watch.stage("density monitor", self.particles.position):
            self.rearrangement.measure_density(self.step_count, density, self.particles, window)

    @property
    def _monitored(self) -> bool:
        """Whether the density was measured on a GPU, and particle numbers stay the same.

        The density correction then needs no readback between the move and the correction.
        """
        count_changes = (
            self.grid.part.shared
            or self.band is not None
            or self.outlets is not None
            or self.sources is not None
            or self.spray.active
        )
        return (
            self.grid.device.is_cuda
            and not count_changes
            and self.rearrangement.has_looked(self.step_count)
        )

    def _everywhere(self) -> Window:
        """Return all cells, as the step's `active` window."""
        self.active.move_to(self.grid.everywhere)
        return self.active

    def _totals_after_move(self, when: str) -> ParticleTotals:
        for launch in self.diagnostics:
            launch()
        return self.checked_totals(when)

    def carry(self, dt: float) -> None:
        """Move particles and solids by dt [s]; airborne bodies keep their momenta."""
        if self.bodies is not None:
            self.bodies.end_step(dt)
            if trouble := self.bodies.stop_reason(self.scene.domain.size, self.scene.endless):
                raise SimulationFailed(f"step {self.step_count}: {trouble}")
            self.bodies.leave()
        self.boundary.advect(self.velocity, dt, self.time + dt, self.particles.position)
        self.spray.fly(self.gravity * self.kick_dt, dt)
        if self.flights is not None:
            with self.watch.stage("bodies in flight", self.particles.position):
                self.flights.end(self.particles, self.velocity)
            if self.boundary.thin is not None:
                self.boundary.thin.stop(self.particles.position, still=not self.boundary.moves)

    def collision_counts(self) -> tuple[int, int, int]:
        """Return numbers of particles that met a wall, were pushed, and are stuck.

        They are those of all ranks. The counts are those of the last `carry`.
        """
        met, pushed, stuck = self.grid.part.ranks.sum(
            np.array(self.boundary.collision_counts())
        ).tolist()
        return met, pushed, stuck

    def solve_row(self, result: wl.SolveResult | None) -> Row:
        """Return the log entries of a step's solve; empty if there was none."""
        return {} if result is None else {"solver": self.scene.solver.method} | solve_row(result)

    def logged(self, row: Row) -> Row:
        """Return the entries of a row that have log columns, in their order."""
        bodies = self.bodies.row() if self.bodies is not None else {}
        found = row | bodies
        if self._columns is None:
            self._columns = self.columns()
        return {name: found.get(name) for name in self._columns}

    def columns(self) -> tuple[str, ...]:
        """Return the names of the log's columns.

        See `warp_lcp.material.particle_log.columns`.
        """
        optional_columns = {
            **{
                "stopped": True,
                "pushed": self.boundary.moves,
                "stuck": self.boundary.moves,
                "interior_density": self.band is not None,
            },
            **dict.fromkeys(self.rearrangement.columns(), True),
            "spray": self.spray.active,
            "emitted": bool(self.scene.source),
            "drained": bool(self.scene.drain),
            "departed": bool(self.scene.domain.open),
        }
        return columns(
            self.own_columns(),
            optional_columns,
            self.bodies.columns() if self.bodies is not None else (),
        )

    def notes(self) -> list[str]:
        """Return warnings and notes for the start of a run."""
        cells, covered = (
            " x ".join(map(str, n[: self.grid.dimension]))
            for n in (self.grid.domain_counts, self.grid.counts)
        )
        follows = self.grid.whole is not None and not self.grid.part.shared
        part = f", of which the grid covers {covered} around the material" if follows else ""
        first = (
            f"{sum(self.particles.exchange.counts)} particles, {cells} cells of "
            f"{self.grid.spacing:.4g} m{part}"
        )
        return [first, *self.grid.part.notes(), *self.scene.notes(), *self._notes]

    def checked_totals(self, when: str) -> ParticleTotals:
        """Return sums over the particles.

        Args:
            when: where in the step, such as `after`, for the message.

        Raises:
            SimulationFailed: a value is not finite, a particle lies outside the domain, or not all
                are there; on all ranks.
        """
        with self.watch.stage("diagnostics", self.particles.position, self.particles.velocity):
            totals = self.particles.totals()
        end = self._ends
        inside = all(
            low >= 0.0 and high <= most
            for low, high, most in zip(
                totals.low[: self.grid.dimension], totals.high, end, strict=False
            )
        )
        if not (totals.finite and inside):
            told = self.grid.part.ranks.collect(
                particle_trouble(self.particles, self.grid, totals, end)
            )
            raise SimulationFailed(
                f"{when} step {self.step_count}: {next((text for text in told if text), '')}"
            )
        if totals.count != self.particles.exchange.expected:
            expected = self.particles.exchange.expected
            raise SimulationFailed(
                f"{when} step {self.step_count}: {totals.count} particles are left of {expected}"
            )
        return totals if self.band is None else self.band.with_interior(totals)

    def _exchange(self, dt: float) -> dict[str, int]:
        """Remove particles at outlets, add those of sources; return global counts."""
        span, drained, departed = (self.time, self.time + dt), 0, 0
        with self.watch.stage("sources and outlets", self.particles.position):
            for outlets in [] if self.outlets is None else [self.outlets]:
                for particles in (self.particles, self.spray.particles):
                    swallowed, gone = outlets.apply(particles, *span)
                    drained, departed = drained + swallowed, departed + gone
            emitted = self.sources.emit(self.particles, *span) if self.sources is not None else 0
        new = emitted
        emitted, drained, departed = self.grid.part.ranks.sum(
            np.array([emitted, drained, departed])
        ).tolist()
        if emitted:
            self._give_ids(new, self.time + dt)
        return {"emitted": emitted, "drained": drained, "departed": departed}

    def _totals_row(self, totals: ParticleTotals, dt: float) -> Row:
        moved = CompletedStep(
            self.particle_mass, self.gravity, self._velocity_before, dt, self.kick_dt
        )
        density, flying = (
            self.band.mean_density if self.band is not None else None,
            self.spray.particles.count,
        )
        row = totals_row(
            self.spray.with_own(totals),
            moved,
            sum(self.particles.exchange.counts) + flying,
            self.grid.spacing,
        )
        return row | {"interior_density": density, "spray": flying}

    def admits(self, points: np.ndarray) -> np.ndarray:
        """Return at which points [m], shape (n, 3), a particle may be."""
        i, j, k = np.clip(self.particles.cells_of(points), -1, self.grid.counts).T + 1
        free = self.boundary.base.numpy()[k, j, i] != wl.SOLID
        if self.grid.barriers is not None:
            free |= self.grid.barriers.near.numpy()[k, j, i] > 0
        admitted: np.ndarray = free & self.boundary.admits(points)
        return admitted
