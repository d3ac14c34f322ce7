"""A solver of newton for liquid that lets go of walls, in which the bodies of a model float and sink."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverBase
from newton.solvers.experimental.coupled import CouplingInterface, SolverCoupled, SolverCoupledProxy

from warp_lcp.fluids import SIMULATOR, LiquidScene, LiquidSimulation
from warp_lcp.fluids.scene import COUPLED_METHODS
from warp_lcp.grid.voxelize import PlacedSolid
from warp_lcp.material.particle_assembly import placed_solids
from warp_lcp.material.particle_log import Row
from warp_lcp.newton.bodies import WorldBodies
from warp_lcp.newton.shapes import geometries, reaches_into, united
from warp_lcp.scene.scene_file import SceneSource, load_scene
from warp_lcp.scene.shapes import SolidSphere
from warp_lcp.simulation import StepFailed

RETRIES = 6  # halvings of a step that fails
DEFAULTS: dict[str, Any] = {"scene": {"simulator": "fluids"}, "time": {"duration": 1.0}}
WHOLE = 1e-9  # of a step: what rounding leaves of it
# of cells and radians, and of what gravity gives in a step: bodies that differ by less move alike
ALIKE = 1e-2
# [m/s, rad/s]: what float32 leaves of a velocity from which impulses have been taken back
ROUNDING = 1e-5
MOVES, POSED = (
    ("body_q", "body_qd", "particle_q", "particle_qd", "joint_q", "joint_qd"),
    newton.StateFlags.BODY_Q,
)


class SolverLiquid(SolverBase, CouplingInterface):
    """Liquid in a box of a newton world; its bodies displace it, and its pressure moves them.

    Pressure and bodies are one problem, see `warp_lcp.fluids.coupling`: it knows the bodies'
    masses, so that added mass makes nothing unstable. Alone, `step` lets bodies move by gravity,
    `body_f` and the liquid, without contacts and joints. `coupled` returns newton's
    `SolverCoupledProxy` of it and of a solver for these: the liquid starts from the velocities that
    contacts and joints leave.

    Args:
        model: of newton. Shapes that collide with shapes displace the liquid: those of bodies, and
            what stands in the box.
        scene: the liquid, as tables, a file or a name: its domain from 0 to `domain.size` in 3-D,
            `[[liquid]]`, and whatever else a scene may have but rigid bodies. Gravity is the
            model's; `scene` and `time` may be left out of tables.
        origin: where in the world the domain's low corner is [m].
        bodies: numbers of those that the liquid holds; all that have shapes unless given.

    Attributes:
        simulation: the liquid, in coordinates of its domain.
        bodies: those that it holds.
        row: the last step's row of the log.

    Raises:
        ValueError: the scene or a shape is not for this.
    """

    def __init__(
        self,
        model: Any,
        scene: SceneSource,
        *,
        origin: Sequence[float] = (0.0, 0.0, 0.0),
        bodies: Sequence[int] | None = None,
    ) -> None:
        super().__init__(model)
        if model.world_count > 1:
            raise ValueError(f"the model has {model.world_count} worlds: expected one")
        gravity = f"physics.gravity={self._gravity().tolist()}"
        self.scene = load_scene(
            {**DEFAULTS, **scene} if isinstance(scene, Mapping) else scene, [gravity]
        )
        self._origin, self._chosen = np.asarray(origin, dtype=np.float64), bodies
        self.row: Row = {}
        self._coupled = self._restarts = self._again = False
        # whether the next step is the first since the coupler has set the bodies' poses
        self._begins = True
        self._kept: dict[str, np.ndarray] = {}
        self._asked: np.ndarray | None = None
        self.simulation, self.bodies = self._create()

    @classmethod
    def coupled(
        cls,
        model: Any,
        rigid: Callable[[Any], SolverBase],
        scene: SceneSource,
        *,
        origin: Sequence[float] = (0.0, 0.0, 0.0),
        iterations: int = 2,
    ) -> SolverCoupledProxy:
        """Return a solver of a world with liquid: `rigid` moves the bodies, the liquid pushes them.

        Args:
            model: of newton, whose bodies with shapes the liquid holds.
            rigid: makes the bodies' solver of a view of the model, say `SolverXPBD`.
            scene: as of the class, like the rest.
            origin: likewise.
            iterations: how often both take a step; the first time the bodies' solver only guesses
                what the liquid gives. 1 is cheaper, and bodies far lighter than the liquid then
                swing for some steps after a jolt.
        """
        bodies, joints, particles = (
            list(range(count))
            for count in (model.body_count, model.joint_count, model.particle_count)
        )
        held = sorted(body for body in geometries(model, np.zeros(3)) if body >= 0)
        entries = [
            SolverCoupled.Entry("rigid", rigid, bodies=bodies, joints=joints, particles=particles),
            SolverCoupled.Entry("liquid", lambda view: cls(view, scene, origin=origin)),
        ]
        proxies = [SolverCoupledProxy.Proxy("rigid", "liquid", bodies=held)]
        return SolverCoupledProxy(
            model, entries, SolverCoupledProxy.Config(proxies, iterations=iterations)
        )

    def step(
        self,
        state_in: Any,
        state_out: Any,
        control: Any,
        contacts: Any,
        dt: float,
        *,
        observables: Any = None,
    ) -> None:
        """Advance liquid and bodies by dt [s], in as many steps of the liquid as its CFL number asks for.

        `state_in.body_f` acts besides gravity; `control` and `contacts` are of no meaning.
        Kinematic bodies move as their velocities say, and keep their poses. The liquid's own state
        is this solver's, not `state_in`'s.

        Raises:
            RuntimeError: a graph is being captured.
            StepFailed: the pressure's solve failed, with shorter steps too.
            SimulationFailed: something is not finite, or has left the domain.
        """
        if not (math.isfinite(dt) and dt > 0.0):
            raise ValueError(f"dt = {dt}: must be a positive time [s]")
        if wp.get_device(str(self.model.device)).is_capturing:
            raise RuntimeError(
                "a step of liquid copies data from the device and cannot run inside a captured "
                "graph, `wp.ScopedCapture`"
            )
        simulation, bodies = self.simulation, self.bodies
        for name in MOVES:
            here, there = getattr(state_in, name, None), getattr(state_out, name, None)
            if here is not None and there is not None and here is not there:
                wp.copy(there, here)
        if bodies is None:
            self._begin(None, dt)
            self._advance(dt)
            return
        poses, velocities = state_in.body_q.numpy(), state_in.body_qd.numpy()
        forces = None if state_in.body_f is None else state_in.body_f.numpy()
        asked = bodies.asked(poses, velocities, forces, dt)
        if self._begin(asked, dt):
            if bodies.take(poses, velocities, forces, simulation.time):
                simulation.boundary.place(simulation.time)
            self._advance(dt)
        poses, velocities = poses.copy(), velocities.copy()
        bodies.give(poses, velocities)
        state_out.body_q.assign(poses)
        state_out.body_qd.assign(velocities)

    def particles(self) -> wp.array:
        """Return where the liquid's particles are in the world [m], wp.vec3, for a viewer's `log_points`."""
        points = self.simulation.points().points.astype(np.float64) + self._origin
        return wp.array(points.astype(np.float32), dtype=wp.vec3, device=self.model.device)

    def notify_model_changed(self, flags: int) -> None:
        """Take other masses or gravity from the model; shapes stay what they were."""
        changes = newton.ModelFlags
        if self.bodies is not None and flags & (
            changes.BODY_INERTIAL_PROPERTIES | changes.BODY_PROPERTIES
        ):
            self.bodies.refresh(self.model)
        if flags & changes.MODEL_PROPERTIES:
            self.simulation.gravity[:] = self._gravity()

    def reset(self, state: Any, world_mask: Any = None, flags: Any = None) -> None:
        """Put the liquid back to where it was at the start, unless no world is reset; bodies are where the next state has them."""
        super().reset(state, world_mask, flags)
        if world_mask is None or world_mask.numpy().any():
            self.simulation, self.bodies = self._create()
            self.simulation.gravity[:] = self._gravity()

    def coupling_notify_iteration_restarts(self, enabled: bool) -> None:
        """Learn that a coupler steps this solver, and whether it repeats steps."""
        self._coupled, self._restarts = True, enabled

    def coupling_notify_input_state_update(
        self, state: Any, flags: Any, *, iteration_restart: bool = False, dt: float = 0.0
    ) -> None:
        """Learn that bodies have new poses, and whether the coupler repeats the step."""
        self._begins |= bool(int(flags) & POSED)
        self._again |= iteration_restart and dt > 0.0

    def coupling_harvest_proxy_wrenches(
        self,
        body_local_to_proxy_global: Any,
        out_body_f: Any,
        *,
        body_qd_before: Any,
        state: Any,
        state_out: Any,
        contacts: Any,
        dt: float,
    ) -> None:
        """Return the liquid's impulses of the step as forces: what it gave is what the bodies' own solver takes."""
        if self.bodies is None:
            return
        forces, proxies = (
            out_body_f.numpy().copy(),
            body_local_to_proxy_global.numpy()[self.bodies.indices],
        )
        forces[proxies[proxies >= 0]] = (self.bodies.impulses / dt)[proxies >= 0]
        out_body_f.assign(forces)

    def _create(self) -> tuple[LiquidSimulation, WorldBodies | None]:
        """Build the liquid among the shapes of the model."""
        scene, model, origin = self.scene, self.model, self._origin
        if not isinstance(scene, LiquidScene) or scene.dimension != 3:
            raise ValueError("scene: must be a 3-D scene of liquid")
        if scene.domain.solids != "cut-cell" or scene.solver.method not in COUPLED_METHODS:
            raise ValueError(
                'scene: bodies need domain.solids = "cut-cell" and one of '
                f"{', '.join(COUPLED_METHODS)} as solver.method"
            )
        if any(solid.is_body for solid in scene.solid):
            raise ValueError(
                "scene.solid: rigid bodies come from the model; solids of the scene must have no "
                "mass or density"
            )
        shapes = geometries(model, origin)
        standing = [
            shape
            for shape in shapes.pop(-1, [])
            if reaches_into(shape, np.array(scene.domain.size))
        ]
        chosen = sorted(shapes) if self._chosen is None else [int(body) for body in self._chosen]
        if missing := [body for body in chosen if body not in shapes]:
            raise ValueError(f"bodies: {missing} have no shapes that collide with shapes")
        held = {body: united(shapes[body]) for body in chosen}
        placed, separating = placed_solids(scene, Path()), scene.domain.wall == "separating"
        placed += [
            PlacedSolid(geometry=shape, separating=separating, name=f"shape {n} of the world")
            for n, shape in enumerate(standing)
        ]
        bodies = WorldBodies(model, origin, held, first=1 + len(placed)) if held else None
        if bodies is not None:
            movers = zip(bodies.bodies, held.values(), bodies.motions, strict=True)
            placed += [
                PlacedSolid(geometry=shape, separating=separating, name=body.name, motion=motion)
                for body, shape, motion in movers
            ]
        # their walls matter
        stand, move = (
            SolidSphere(shape="sphere", center=[0.0] * 3, radius=1.0, mass=mass)
            for mass in (None, 1.0)
        )
        solids = [*scene.solid, *[stand] * len(standing), *[move] * len(held)]
        whole = scene.model_copy(update={"solid": solids})
        return SIMULATOR.assemble(
            whole, placed, bodies, device=str(model.device), folder=Path()
        ), bodies

    def _begin(self, asked: np.ndarray | None, dt: float) -> bool:
        """Be where the step begins; return whether it is to be taken, not repeated with bodies that move as they did, contacts or not.

        Args:
            asked: of `WorldBodies.asked`.
            dt: [s].
        """
        if self._begins or not self._coupled:
            if self._again:
                self._again = self._begins = False
                falls = ROUNDING + ALIKE * dt * float(np.linalg.norm(self.simulation.gravity))
                alike = np.repeat([ALIKE * self.scene.spacing, ALIKE, falls], [3, 4, 6])
                if (
                    asked is not None
                    and self._asked is not None
                    and (np.abs(asked - self._asked) < alike).all()
                ):
                    return False
                self.simulation.restore(self._kept)
            elif self._restarts:
                self._kept = self.simulation.state()
            self._asked = asked
            if self.bodies is not None:
                self.bodies.impulses[:] = 0.0
        else:
            self._asked = None  # one of several steps
        self._begins = False
        return True

    def _advance(self, dt: float) -> None:
        simulation, end, least = self.simulation, self.simulation.time + dt, dt / 2**RETRIES
        step = math.inf
        while (remaining := end - simulation.time) > WHOLE * dt:
            step = min(simulation.stable_dt(), self.scene.time.dt_max, 2.0 * step)
            count = math.ceil(remaining / step * (1.0 - WHOLE))
            while True:
                # forces act for as long as bodies move, as newton has it
                simulation.last_dt = remaining / count
                try:
                    self.row = simulation.step(remaining / count)
                    break
                except StepFailed:
                    count *= 2
                    if remaining / count < least:
                        raise
            step = remaining / count

    def _gravity(self) -> np.ndarray:
        """Return the gravity of the model's bodies [m/s^2], shape (3,)."""
        worlds = self.model.body_world.numpy() if self.model.body_count else []
        return np.asarray(
            self.model.gravity.numpy()[worlds[0] if len(worlds) else 0], dtype=np.float64
        )
