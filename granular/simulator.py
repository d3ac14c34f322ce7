"""Simulator plug-in `granular`: sand by particles on a staggered grid."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Unpack, cast

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.granular.bodies import SandBodies
from warp_lcp.granular.packing import Packing
from warp_lcp.granular.report import SandReport
from warp_lcp.granular.runout import DepositFront, ParticlePercentiles
from warp_lcp.granular.scene import SandScene
from warp_lcp.granular.stress import Stress, YieldSet
from warp_lcp.granular.stress_methods import METHODS, StressWorkspace
from warp_lcp.granular.wall_friction import SandSolids
from warp_lcp.grid.extrapolate import complete
from warp_lcp.grid.grid_part import ONE_PROCESS
from warp_lcp.grid.level_set import particle_density
from warp_lcp.grid.particles import SORTED, Particles, ParticleTotals
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.kernels.joined_graphs import joined
from warp_lcp.kernels.launch_graph import LaunchGraph, copy
from warp_lcp.material.domain_window import start_of
from warp_lcp.material.particle_assembly import (
    GridComponents,
    make_bodies,
    make_boundary,
    make_outlets,
    make_particles,
    make_sources,
    make_spray,
    placed_solids,
)
from warp_lcp.material.particle_log import Row
from warp_lcp.material.particle_simulation import ParticleSimulation, ParticleSimulationOptions
from warp_lcp.material.velocity_extrapolation import LayerCallback, extend_velocity
from warp_lcp.operators.grid_poisson import FLUID
from warp_lcp.problem.method_protocol import Solver, Workspace
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.rigid.body import PLANAR
from warp_lcp.scene.scene import Scene
from warp_lcp.simulation import Cells, Part, SimulationFailed, StepFailed, missed_by_far

if TYPE_CHECKING:
    from warp_lcp.distributed.ranks import Ranks

METHODS_ON_RANKS = ("accelerated-projection",)  # methods that solve on several ranks
# Fixed cost of a step, in cells full of sand.
STEP_WORK = 1 << 9
FRONT = 99.0  # percentile of the particles that defines runout and height
# Largest accepted residual, in units of rho g dx: velocities are then wrong by as much as gravity
# adds in a step.
FAR = 1.0
# Share of the speed of moving solids, likewise: a solid that starts at 20 m/s drives sand much
# faster than gravity does, and the residual of the solve is in proportion to that speed.
DRIVEN = 0.005
JAMMED = (
    "solids or a source may enclose sand: move them less or slower; deep sand may need more "
    "solver.max_iterations"
)
STANDING = 0.05  # of sqrt(g dx): velocity scale of the residual without gravity
DIAGNOSTICS = ("yielded", "dissipation", "predicted_excess", "front")  # columns for the log only
COLUMNS = (
    "coupled_residual",
    "velocity_error",
    "staggering_iterations",
    *DIAGNOSTICS,
    "max_fraction",
    "runout",
    "height",
)


class SandSimulation(ParticleSimulation):
    """Simulation of sand; implements `warp_lcp.simulation.Simulation`.

    A step transfers mass and velocity of the particles to the grid, solves for pressure and
    friction together, transfers the resulting velocity back to the particles and moves them.

    Args:
        scene: the scene.
        grid: the initial grid.
        parts: the fields and models on that grid; `solids`: walls with contact and friction.
        particles: the initial sand.
        more: arguments of `ParticleSimulation`.

    Attributes:
        packing: density of the sand.
        stress: stresses of the sand.
        carried: rigid bodies in the stress solve; None without any.
        outcome: result of the last solve.
    """

    scene: SandScene

    def __init__(
        self,
        scene: SandScene,
        grid: StaggeredGrid,
        parts: GridComponents,
        particles: Particles,
        **more: Unpack[ParticleSimulationOptions],
    ) -> None:
        """Allocate the fields and find the cells with sand."""
        self.method = METHODS[scene.solver.method]()
        self._at_rest = scene.particles.per_axis**grid.dimension
        self._percentiles = (
            ParticlePercentiles(grid.device)
            if grid.device.is_cuda and not grid.part.shared
            else None
        )
        super().__init__(scene, grid, parts, particles, **more)
        if self._percentiles is not None:
            self.diagnostics.append(self._measure_front)
            self._measure_front()
        self._start = self._front()[0]
        self.mark()

    def allocate(self, grid: StaggeredGrid, parts: GridComponents) -> None:
        """Allocate the fields of a grid."""
        super().allocate(grid, parts)
        assert parts.solids is not None, "made by `make_parts`"
        scene, self.solids = self.scene, parts.solids
        self._base, self.density = grid.field(wp.int8), grid.field()
        self._completion, self._density_to_grid = (
            LaunchGraph(grid.device, record, at_once=grid.part.at_once)
            for record in (self._launch_completion, self._launch_density)
        )
        self.packing = Packing(
            grid, self._base, self.boundary.capacity, sides=self.sides, cut=self.solids.cut
        )
        self.carried = None if self.bodies is None else SandBodies(grid, self.bodies.numbers)
        box, rate = scene.friction.model == "box", scene.friction.dynamic_angle is not None
        self.stress = Stress(
            self.packing, self.solids.walls, box=box, rate=rate, bodies=self.carried
        )
        self.outcome = SandReport(self.stress)
        self._deposit = DepositFront(grid)
        self._work: StressWorkspace | None = None  # of the current method
        self._made_by: Solver | None = None
        inner = (slice(1, -1),) * 3
        wp.copy(self.packing.kind[inner], self.solids.base[inner])

    def regrid(self, grid: StaggeredGrid, state: Mapping[str, np.ndarray] | None = None) -> None:
        """Continue on another grid window of the domain; see the base class."""
        super().regrid(grid, state)
        self._place_solids()
        wp.copy(self._base, self.solids.base)

    def mark(self) -> None:
        """Mark the cells that hold sand, for frames before the first step; collective."""
        with self.particles.exchange.with_ghosts(SORTED):
            self._place_solids()
            wp.copy(self._base, self.solids.base)
            self._find_density(self.grid.everywhere)
            self.packing.update(self.density, self.velocity, 1.0)

    def _reached(self, totals: ParticleTotals) -> Window:
        """Return the window of cells that particles can reach in a step."""
        window = super()._reached(totals)
        return window if self.sides is None else self.sides.widen(window)

    def particles_to_grid(self, window: Window) -> None:
        """Transfer the particles' velocity to the faces and apply gravity."""
        super().particles_to_grid(window)
        with self.watch.stage("particles-to-grid", *self.velocity, *self.weights):
            self._completion.run(window, variant=window.near is None)

    def _launch_completion(self, window: Window) -> None:
        """Launch the velocity of faces that have mass, but no particle weight."""
        if self.sides is not None:
            self.sides.average(self.velocity, self.weights, self._saved or ())
        # Faces farther out have mass but no particle weight.
        complete(
            window,
            self.velocity,
            self.weights,
            self.outcome.known,
            self._layer_filled(),
            barriers=self.grid.barriers,
        )

    def carry(self, dt: float) -> None:
        """Move particles and solids by dt [s]."""
        super().carry(dt)
        if self.sides is not None:
            self.sides.carry(self.particles.position)

    def step(self, dt: float) -> Row:
        """Advance by dt [s].

        Stresses that miss their tolerance are accepted (the log's coupled_residual has their
        residual), unless the residual exceeds both `FAR` and `DRIVEN` and they would add energy to
        the sand. They are computed before any particle moves, so that a failed solve leaves the
        state unchanged, except for the order of the particles.

        Raises:
            StepFailed: the stresses are far from balance; a smaller dt may be tried.
            SimulationFailed: something is not finite, or a particle has left the domain.
            ValueError: dt is not positive.
        """
        with self.attempt(), joined(self.grid.device):
            return self._step(dt)

    def _step(self, dt: float) -> Row:
        """Advance by dt [s]; see `step`.

        Order of a step: particles to grid, with gravity; packing; stress solve and its velocity;
        contacts of bodies; extrapolation; grid to particles; motion of particles and solids. If a
        later part fails, the stresses are rolled back.
        """
        before = self.begin_step(dt)
        window = self.window(before)
        self.particles_to_grid(window)
        solved = self._solve(window, dt)
        self._measure_stresses()
        try:
            self.extrapolate_velocity(
                window, self.outcome.known, self.packing.kind, self.outcome.contact, dt
            )
        except StepFailed:
            self.stress.roll_back()
            raise
        if self.sources is not None:
            self.sources.impose_velocity(self.velocity, [], self.packing.kind)
        self.grid_to_particles(window, self.packing.kind, dt)
        below, most = self._mass_below(), self._largest_fraction()
        row = self.move(dt, window, self.density) | self._measured()
        self._place_solids()
        runout, height = self._front()
        rate = self._flow_rate(below, row, dt)
        return self.logged(
            row
            | solved
            | {
                "max_fraction": most,
                "runout": runout - self._start,
                "height": height,
                "flow_rate": rate,
            }
        )

    def _measure_stresses(self) -> None:
        """Launch the computation of stress values that only the log needs."""
        if self.scene.output.diagnostics:
            with self.watch.stage("diagnostics", self.packing.flags, self.stress.now):
                self.outcome.measure()
                self._deposit.find(self.packing.fraction)

    def _measured(self) -> Row:
        """Return stress values that only the log needs."""
        if not self.scene.output.diagnostics:
            return {}
        report = self.outcome.report(self.scene.physics.density * self.grid.cell_volume)
        return report | {"front": self._deposit.read()}

    def _measure_front(self) -> None:
        """Launch the percentiles of runout and height, on CUDA."""
        if self._percentiles is not None:
            self._percentiles.find(self.particles, percentile_place(self.particles.count))

    def own_columns(self) -> tuple[str, ...]:
        """Return the log columns of stresses and shape of the sand.

        coupled_residual: natural residual of pressure and friction together, root mean square over
        the cells with sand, in units of rho g dx; velocity_error: estimate of the velocity's root
        mean square error, in units of g dt, see `Stress.take_residual`; solve_residual: relative to
        that at the start of the solve; staggering_iterations: iterations of the coupled method;
        yielded, dissipation, predicted_excess: see `SandReport.report`; front [m]: x up to which
        the deposit is connected at the start of the step, see `DepositFront`; max_fraction:
        largest fraction of a cell at the start of the step, relative to the densest packing; runout
        [m]: 99th percentile of x less that at the start; height [m]: 99th percentile of y;
        flow_rate [kg/s; kg/(s m) in 2-D]: mass below the gauge, or without a gauge the mass that
        left through drains and open sides.
        """
        columns = tuple(
            name for name in COLUMNS if self.scene.output.diagnostics or name not in DIAGNOSTICS
        )
        return (
            (*columns, "flow_rate")
            if self.scene.gauge or self.scene.drain or self.scene.domain.open
            else columns
        )

    def frame(self) -> list[Part]:
        """Return the parts of a frame: particles and cells, surface and volume.

        Cells have the fraction of grains, pressure [Pa] and yield ratio of the last solve. Surface
        and volume are written if the scene asks for them.
        """
        grid, points = self.grid, self.points()
        fields = {
            "fraction": self.packing.fraction.numpy() * self.scene.max_fraction,
            "pressure": self.pressures().astype(np.float32),
            "yield_ratio": self.outcome.ratio.numpy(),
        }
        i, j, k = np.clip(self.particles.cells_of(points.points), -1, self.grid.counts).T + 1
        for name, field in fields.items():
            points.fields[name] = field[k, j, i]
        cells = self._sand_cells()
        at = tuple(cells.T)
        selected_fields = {name: field[at] for name, field in fields.items()}
        return [
            points,
            Cells(
                "grid",
                cells[:, ::-1] - 1 + grid.origin,
                grid.spacing,
                grid.dimension,
                selected_fields,
                self.image_counts,
                grid.part.corners,
            ),
            *self.surfaces(),
            *self.volumes(),
            *self.body_surfaces(),
        ]

    def _sand_cells(self) -> np.ndarray:
        """Return this process's cells with sand in frames, shape (n, 3).

        Indices (k, j, i) in the stored shape.
        """
        part = self.grid.part
        return np.argwhere(part.box_of(self.packing.kind.numpy()) == FLUID) + np.array(
            part.owned.low
        )

    def pressures(self) -> np.ndarray:
        """Return the pressure p = rho dx x / dt [Pa] of the last solve.

        In the stored shape; zero before the first step.
        """
        scale = (
            self.scene.physics.density * self.grid.spacing / self.stress.kick_dt
            if self.stress.kick_dt > 0.0
            else 0.0
        )
        return np.asarray(self.stress.now.numpy()[0] * scale)

    def own_state(self) -> dict[str, np.ndarray]:
        """Return the stresses and the frame data of the last solve."""
        packing = self.packing
        return {
            "stress": self.stress.now.numpy().copy(),
            "stress_dt": np.array(self.stress.kick_dt),
            "cells": packing.kind.numpy().copy(),
            "fraction": packing.fraction.numpy().copy(),
            "yield_ratio": self.outcome.ratio.numpy().copy(),
            "front_at_start": np.array(self._start),
        }

    def restore_own(self, state: Mapping[str, np.ndarray]) -> None:
        """Restore the arrays of `own_state`."""
        self.stress.now.assign(state["stress"])
        self.stress.kick_dt = float(state["stress_dt"])
        self.packing.kind.assign(state["cells"])
        self.packing.fraction.assign(state["fraction"])
        self.packing.forget_window()
        self.outcome.ratio.assign(state["yield_ratio"])
        self.grid.part.fill(self.stress.now)
        self.grid.part.fill(self.packing.kind, self.packing.fraction, self.outcome.ratio)
        self._start = float(state["front_at_start"])

    def _take_clock(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue at the time of a state, with its bodies and moving solids."""
        super()._take_clock(state)
        self._place_solids()

    def _place_solids(self) -> None:
        """Place the moving solids at their current positions."""
        if self.solids.moves:
            cut = self.solids.cut
            listed = 0 if cut is None else cut.count
            left = self.solids.place(self.time)
            self.stress.forget_tractions(left)
            longer = cut is not None and cut.count != listed
            if longer or self.solids.walls is not self.stress.walls:
                self.stress.set_walls(self.solids.walls)
            if self.carried is not None and self.bodies is not None:
                centers = np.array([body.position for body in self.bodies.bodies])
                self.carried.place(self.solids.host_index, centers, self.solids.walls)

    def _gains(self, scale: float, dt: float) -> bool:
        """Return whether the stresses accelerate sand beyond all of its sources of speed.

        These are the speeds of sand, solids, sources and bodies before the step, and that due to
        gravity (`scale`, m/s). Walls redirect velocities: a component may become as large as the
        magnitude of the velocity before, here that of the largest components.
        """
        packing, own = self.packing, self._own
        moving = [own(inverse) > 0.0 for inverse in packing.inverse]
        after, before = (
            [
                float(np.abs(own(u)[at]).max(initial=0.0))
                for u, at in zip(velocity, moving, strict=True)
            ]
            for velocity in (self.stress.checked.u, packing.start)
        )
        others = self._speed_of_solids(dt)
        fastest, *before = self._largest([max(after), *before])
        bodies = self.bodies.top_speed(0.0) if self.bodies is not None else 0.0
        return fastest > math.hypot(*before) + scale + others + bodies

    def _speed_of_solids(self, dt: float) -> float:
        """Return the largest velocity component of the solids' faces [m/s]; collective.

        For solids that cut cells, their largest speed in the step of length `dt` [s].
        """
        own = self._own
        if self.solids.cut is not None and self.solids.moves:
            return self._largest([self.boundary.top_speed(self.time, dt)])[0]
        fastest = max(
            (float(np.abs(own(component)).max()) for component in self.solids.velocity), default=0.0
        )
        return self._largest([fastest])[0]

    def solve_stress(self, scale: float) -> wl.SolveResult:
        """Solve for the stresses to the tolerance of the scene.

        It is relative to `scale` [m/s]: g dt corresponds to a pressure of rho g dx.
        """
        solver = self.scene.solver
        stopping = wl.StoppingCriteria(
            rtol=0.0, atol=solver.tolerance * scale, max_iterations=solver.max_iterations
        )
        # The first solve on a grid, or the method has changed.
        if self._made_by is not self.method:
            self._work, self._made_by = self.method.init(self.stress), self.method
        assert self._work is not None
        self._work.velocity_tolerance = solver.allowed_velocity_error * scale
        return wl.solve(
            self.stress, self.method, stopping=stopping, workspace=cast(Workspace, self._work)
        )

    def _solve(self, window: Window, dt: float) -> Row:
        """Solve for the stresses, and read their velocity; return log values.

        Order: density and packing, with the current velocities of solids and sources; rigid bodies;
        stress solve; acceptance, see `step`; projected velocity; contacts. The yield set is in
        units of impulses over rho dx [m/s].
        """
        packing, stress, solids, scene = self.packing, self.stress, self.solids, self.scene
        with self.watch.stage("packing", self.density, packing.fraction, *self.velocity):
            self._density_to_grid.run(
                window, variant=(window.near is None, self.particles.runs is None)
            )
            solids.begin_step(self.time, dt)
            if self.sources is not None:
                self.sources.supply(self.time + 0.5 * dt, self.velocity, self._base)
                self.sources.impose_velocity(solids.velocity, [])
            packing.update(self.density, self.velocity, dt, solids.velocity, window)
            self._begin_bodies(dt)
        if (
            self.grid.device.is_cuda
            and self.flights is not None
            and self.sources is None
            and not self.grid.part.shared
        ):
            # The number of airborne parts is read together with the solve's results.
            with self.watch.stage("bodies in flight", packing.kind):
                self.flights.find(window, self.weights, packing.kind)
        impulse = self.kick_dt / (scene.physics.density * self.grid.spacing)  # of a stress of 1 Pa
        growth = scene.growth(self.grid.spacing, self.kick_dt)
        bound = YieldSet(
            scene.slope,
            scene.intercept * impulse,
            scene.material.tensile_strength * impulse,
            **growth,
        )
        g = float(np.linalg.norm(self.gravity))
        scale = g * self.kick_dt if g > 0.0 else STANDING * math.sqrt(self.grid.spacing)
        with self.watch.stage(
            "stress", stress.now, *packing.mass, *packing.inverse, *packing.start
        ):
            stress.begin(bound, self.gravity, dt, self.kick_dt)
            solved = self.solve_stress(scale)
        residual, first = (
            math.hypot(*(part / scale for part in stress.last_residual)),
            solved.history[0].residual / scale,
        )
        if solved.status is wl.SolveStatus.NON_FINITE:
            raise SimulationFailed(
                f"step {self.step_count}: the stresses are not finite after {solved.iterations} "
                "iterations"
            )
        if (
            solved.status is not wl.SolveStatus.CONVERGED
            and residual > FAR
            and residual * scale > DRIVEN * self._speed_of_solids(dt)
            and self._gains(scale, dt)
        ):
            stress.roll_back()
            left = (
                f"residual of {residual:.2e} rho g dx (tolerance {scene.solver.tolerance}) and "
                "would add energy to the sand"
            )
            raise missed_by_far("stress", solved.status, solved.iterations, left, JAMMED)
        with self.watch.stage("projection", *self.velocity):
            self.outcome.write_outcome(self.velocity)
            self._push_bodies(dt)
        try:
            self.solve_contacts()
        except StepFailed:
            stress.roll_back()
            raise
        return {
            "solver": scene.solver.method,
            "solve_status": solved.status.name,
            "solve_iterations": solved.iterations,
            "solve_residual": residual / first if first > 0.0 else 0.0,
            "coupled_residual": residual,
            "velocity_error": stress.velocity_error / scale,
            "staggering_iterations": solved.iterations,
        }

    def _begin_bodies(self, dt: float) -> None:
        """Pass velocity and inverse mass of the bodies to the stress solve."""
        if self.carried is None or self.bodies is None:
            return
        dimension, bodies = self.grid.dimension, self.bodies.bodies
        self.carried.begin(
            self.packing,
            self.velocity,
            self.weights,
            density=self.scene.physics.density,
            velocity=bodies.velocities() if dimension == 3 else bodies.velocities()[:, PLANAR],
            inverse_mass=bodies.inverse_masses(dimension),
            dt=dt,
        )

    def _push_bodies(self, dt: float) -> None:
        """Apply the impulses of the sand to the bodies, and update their faces."""
        if self.carried is None or self.bodies is None:
            return
        self.bodies.bodies.apply_impulses(self.carried.impulses())
        self.solids.begin_step(self.time, dt)
        if self.sources is not None:
            self.sources.impose_velocity(self.solids.velocity, [])

    def _launch_density(self, window: Window) -> None:
        self._find_density(window)
        copy(self._base, self.solids.base)

    def _find_density(self, window: Window) -> None:
        """Compute the particles' density in the cells of a window."""
        particle_density(self.grid, self.particles, window, self._at_rest, self.density)
        if self.sides is not None:
            self.sides.add(self.density)
        self.grid.part.fill(self.density)

    def _continue(
        self,
        window: Window,
        known: list[wp.array],
        kind: wp.array,
        contact: wp.array,
        join: LayerCallback | None,
    ) -> None:
        """Extrapolate the velocity beside walls according to the stresses' contact."""
        s = self.solids
        if s.cut is not None:
            super()._continue(window, known, kind, contact, join)
        else:
            walls = s.index, s.separating, s.velocity
            extend_velocity(
                window,
                self.velocity,
                self.weights,
                known,
                kind,
                contact,
                *walls,
                self.layers,
                join=join,
            )

    def _front(self) -> tuple[float, float]:
        """Return the 99th percentile of x and of y [m]."""
        if self._percentiles is not None:
            return self._percentiles.read()
        if self.grid.part.shared:
            return self._front_of_all()
        position = self.particles.position.numpy()
        if not len(position):
            return 0.0, 0.0
        nth = percentile_place(len(position))
        return float(np.partition(position[:, 0], nth)[nth]), float(
            np.partition(position[:, 1], nth)[nth]
        )

    def _front_of_all(self) -> tuple[float, float]:
        """Return the percentiles of all ranks' particles.

        Each rank contributes the values that may lie beyond the percentile.
        """
        position, ranks = self.particles.position.numpy()[:, :2], self.grid.part.ranks
        count = int(ranks.sum(len(position)))
        beyond = count - percentile_place(count)
        if count == 0:
            return 0.0, 0.0
        first = max(len(position) - beyond, 0)
        farthest = np.partition(position, first, axis=0)[first:] if len(position) else position
        everyone = np.concatenate(ranks.collect(farthest))
        x, y = np.partition(everyone, len(everyone) - beyond, axis=0)[len(everyone) - beyond]
        return float(x), float(y)

    def _mass_below(self) -> float:
        """Return the mass below the gauge [kg; kg/m in 2-D], 0 without one."""
        if self.scene.gauge is None:
            return 0.0
        below = np.count_nonzero(self.particles.position.numpy()[:, 1] < self.scene.gauge.height)
        return float(self.grid.part.ranks.sum(int(below))) * self.particle_mass

    def _flow_rate(self, below: float, row: Row, dt: float) -> float:
        left = sum(int(row.get(name) or 0) for name in ("drained", "departed")) * self.particle_mass
        return (self._mass_below() - below + left) / dt

    def _largest_fraction(self) -> float:
        """Return the largest fraction of a cell, relative to the densest packing."""
        return self._largest([self.packing.densest])[0]

    def _own(self, field: wp.array) -> np.ndarray:
        """Return the part of a field that only this process has."""
        return np.asarray(self.grid.part.known_of(field.numpy()))

    def _largest(self, values: list[float]) -> list[float]:
        """Return the elementwise maximum over all processes."""
        return [float(value) for value in self.grid.part.ranks.max(np.array(values))]


def percentile_place(count: int) -> int:
    """Return the index in sorted numbers of the percentile of runout and height."""
    return min(int(count * FRONT / 100.0), count - 1)


class GranularSimulator:
    """Simulator plug-in for sand that flows and comes to rest."""

    name = "granular"
    summary = "sand that flows, piles up and comes to rest"
    scene_model = SandScene

    def create(
        self, scene: Scene, *, device: str, folder: Path, ranks: Ranks | None = None
    ) -> SandSimulation:
        """Build the simulation of a scene; on ranks, this rank's part (collective).

        Args:
            scene: the scene, a SandScene.
            device: a Warp device's name.
            folder: folder of the files that the scene names.
            ranks: MPI ranks that share the simulation, with the same scene on each; None for one
                process.

        Raises:
            ValueError: the scene cannot be simulated, or not on ranks; the message names the key
                and what is allowed. On all ranks.
        """
        if not isinstance(scene, SandScene):
            raise ValueError("scene.simulator: granular needs a scene of sand")
        placed = placed_solids(scene, folder)
        bodies = make_bodies(scene, placed, partial(RigidBodies, ranks=ranks or ONE_PROCESS))
        cuts = scene.solver.method == "accelerated-projection"
        warnings: list[str] = []

        def make_parts(grid: StaggeredGrid) -> GridComponents:
            """Build walls, solids and sources on a grid."""
            boundary, notes = make_boundary(scene, grid, folder, solids=placed)
            solids = SandSolids(
                grid,
                placed,
                boundary,
                scene.wall_frictions(),
                prescribed=bool(scene.source),
                cuts=cuts,
            )
            warnings[:] = [*notes, *solids.notes]
            return GridComponents(
                boundary, make_sources(scene, grid, boundary, folder), solids=solids
            )

        if ranks is None:
            coverage, grid = start_of(scene, device)
        else:
            # Imported here, since it needs an optional package.
            from warp_lcp.distributed.balance import Balance
            from warp_lcp.distributed.particle_assembly import part_of

            outputs = {"surface": scene.output.surface, "volume": scene.output.volume}
            shown = [key for key, on in outputs.items() if scene.endless and on]
            # Surface and volume would end at sides that ranks do not have.
            refused = [f"output.{key} where an axis is periodic" for key in shown]
            if scene.endless and scene.correction is not None:
                # Its operator has no periodic axes on ranks.
                refused.append(
                    "the density correction where an axis is periodic (density_correction.every = "
                    "0 switches it off)"
                )
            balance = Balance(fixed=STEP_WORK)
            coverage, grid = (
                None,
                part_of(
                    scene, ranks, device, methods=METHODS_ON_RANKS, refused=refused, balance=balance
                ).grid,
            )
        parts = make_parts(grid)
        particles, notes = make_particles(scene, grid, parts.boundary, folder)
        outlets, spray = make_outlets(scene, grid, folder), make_spray(scene, coverage, placed)
        return SandSimulation(
            scene,
            grid,
            parts,
            particles,
            make_parts=make_parts,
            outlets=outlets,
            bodies=bodies,
            coverage=coverage,
            spray=spray,
            notes=(*warnings, *notes),
        )
