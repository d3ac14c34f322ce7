"""Newton solver for a liquid, in which the bodies of a model float and sink."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverBase
from newton.solvers.experimental.coupled import CouplingInterface, SolverCoupled, SolverCoupledProxy

from warp_lcp.extras.newton.bodies import WorldBodies
from warp_lcp.extras.newton.shapes import geometries, reaches_into, union_of
from warp_lcp.fluids import SIMULATOR, LiquidScene, LiquidSimulation
from warp_lcp.fluids.scene import COUPLED_METHODS
from warp_lcp.grid.voxelize import PlacedSolid
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.material.particle_assembly import placed_solids
from warp_lcp.material.particle_log import Row
from warp_lcp.scene.scene_file import SceneSource, load_scene
from warp_lcp.scene.shapes import SolidProperties, SphereTable, shaped
from warp_lcp.simulation import StepFailed

RETRIES = 6  # halvings of the time step after a failure
DEFAULTS: dict[str, dict[str, object]] = {
    "scene": {"simulator": "fluids"},
    "time": {"duration": 1.0},
}
WHOLE = 1e-9  # relative to a step: rounding
# Relative to cells, radians, and the velocity that gravity adds in a step: smaller differences of
# the bodies' states do not matter.
ALIKE = 1e-2
# [m/s, rad/s]: float32 accuracy of a velocity after impulses were subtracted.
ROUNDING = 1e-5
MOVES, POSED = (
    ("body_q", "body_qd", "particle_q", "particle_qd", "joint_q", "joint_qd"),
    newton.StateFlags.BODY_Q,
)


class SolverLiquid(SolverBase, CouplingInterface):
    """Liquid in a box of a newton world, coupled with the bodies of the model.

    Bodies displace the liquid, and its pressure moves them. Pressure and bodies are one problem,
    see `warp_lcp.fluids.coupling`: it includes the bodies' masses, so that added mass does not
    cause instabilities. Used alone, `step` moves bodies by gravity, `body_f` and the liquid,
    without contacts and joints. `coupled` returns newton's `SolverCoupledProxy` of this solver and
    one for contacts and joints: the liquid starts from the velocities after contacts and joints.

    Args:
        model: the newton model. Shapes that collide with shapes displace the liquid: those of
            bodies, and static ones in the box.
        scene: the liquid, as tables, a file or a name: its domain from 0 to `domain.size` in 3-D,
            `[[liquid]]`, and all other tables except rigid bodies. Gravity is the model's; `scene`
            and `time` can be omitted from tables.
        origin: position of the domain's low corner in the world [m].
        bodies: numbers of the bodies in the liquid. Default: all that have shapes.

    Attributes:
        simulation: the liquid, in coordinates of its domain.
        bodies: the bodies in the liquid.
        row: log row of the last step.

    Raises:
        ValueError: the scene or a shape is not supported.
    """

    def __init__(
        self,
        model: newton.Model,
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
        self._coupled = self._restarts = self._restart = False
        # Whether the next step is the first since the coupler has set the bodies' poses.
        self._begins = True
        self._saved_state: dict[str, np.ndarray] = {}
        self._requested: np.ndarray | None = None
        self.simulation, self.bodies = self._create()

    @classmethod
    def coupled(
        cls,
        model: newton.Model,
        rigid: Callable[[newton.Model], SolverBase],
        scene: SceneSource,
        *,
        origin: Sequence[float] = (0.0, 0.0, 0.0),
        iterations: int = 2,
    ) -> SolverCoupledProxy:
        """Return a solver of a world with liquid, coupled with a rigid-body solver.

        Args:
            model: the newton model, whose bodies with shapes are in the liquid.
            rigid: creates the rigid-body solver for a view of the model, such as `SolverXPBD`.
            scene: see the class.
            origin: see the class.
            iterations: number of alternating steps. In the first one the rigid-body solver only
                estimates the liquid's impulses. 1 is cheaper, but bodies much lighter than the
                liquid then oscillate for some steps after a jolt.
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
        state_in: newton.State,
        state_out: newton.State,
        control: newton.Control,
        contacts: newton.Contacts,
        dt: float,
        *,
        observables: object = None,
    ) -> None:
        """Advance liquid and bodies by dt [s], in as many substeps as CFL requires.

        `state_in.body_f` acts besides gravity; `control` and `contacts` are ignored. Kinematic
        bodies have their given velocities, and keep their poses. The liquid's own state is stored
        in this solver, not in `state_in`.

        Raises:
            RuntimeError: a graph is being captured.
            StepFailed: the pressure solve failed, also with shorter steps.
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
        asked = bodies.requested_state(poses, velocities, forces, dt)
        if self._begin(asked, dt):
            if bodies.set_state(poses, velocities, forces, simulation.time):
                simulation.boundary.place(simulation.time)
            self._advance(dt)
        poses, velocities = poses.copy(), velocities.copy()
        bodies.give(poses, velocities)
        state_out.body_q.assign(poses)
        state_out.body_qd.assign(velocities)

    def particles(self) -> wp.array:
        """Return the positions of the liquid's particles in the world [m], wp.vec3.

        For a viewer's `log_points`.
        """
        points = self.simulation.points().points.astype(np.float64) + self._origin
        return wp.array(points.astype(np.float32), dtype=wp.vec3, device=self.model.device)

    def notify_model_changed(self, flags: int) -> None:
        """Update masses or gravity from the model; shapes are not updated."""
        changes = newton.ModelFlags
        if self.bodies is not None and flags & (
            changes.BODY_INERTIAL_PROPERTIES | changes.BODY_PROPERTIES
        ):
            self.bodies.refresh(self.model)
        if flags & changes.MODEL_PROPERTIES:
            self.simulation.gravity[:] = self._gravity()

    def reset(
        self,
        state: newton.State,
        world_mask: DeviceArray | None = None,
        flags: newton.StateFlags | None = None,
    ) -> None:
        """Reset the liquid to its initial state, unless no world is reset.

        The next state sets the bodies.
        """
        super().reset(state, world_mask, flags)
        if world_mask is None or world_mask.numpy().any():
            self.simulation, self.bodies = self._create()
            self.simulation.gravity[:] = self._gravity()

    def coupling_notify_iteration_restarts(self, enabled: bool) -> None:
        """Set whether a coupler drives this solver and repeats steps."""
        self._coupled, self._restarts = True, enabled

    def coupling_notify_input_state_update(
        self,
        state: newton.State,
        flags: newton.StateFlags,
        *,
        iteration_restart: bool = False,
        dt: float = 0.0,
    ) -> None:
        """Note that bodies have new poses, and whether the coupler repeats the step."""
        self._begins |= bool(int(flags) & POSED)
        self._restart |= iteration_restart and dt > 0.0

    def coupling_harvest_proxy_wrenches(
        self,
        body_local_to_proxy_global: DeviceArray,
        out_body_f: DeviceArray,
        *,
        body_qd_before: DeviceArray,
        state: newton.State,
        state_out: newton.State,
        contacts: newton.Contacts,
        dt: float,
    ) -> None:
        """Return the liquid's impulses of the step as forces.

        The rigid-body solver gets exactly these impulses.
        """
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
        united_shapes = {body: union_of(shapes[body]) for body in chosen}
        placed, separating = placed_solids(scene, Path()), scene.domain.wall == "separating"
        placed += [
            PlacedSolid(geometry=shape, separating=separating, name=f"shape {n} of the world")
            for n, shape in enumerate(standing)
        ]
        bodies = (
            WorldBodies(model, origin, united_shapes, first=1 + len(placed))
            if united_shapes
            else None
        )
        if bodies is not None:
            movers = zip(bodies.bodies, united_shapes.values(), bodies.motions, strict=True)
            placed += [
                PlacedSolid(geometry=shape, separating=separating, name=body.name, motion=motion)
                for body, shape, motion in movers
            ]
        # Placeholders in the list of solids, of which only the wall conditions matter.
        ball = shaped(SolidProperties, SphereTable)
        stand, move = (
            ball(shape="sphere", center=[0.0] * 3, radius=1.0, mass=mass) for mass in (None, 1.0)
        )
        solids = [*scene.solid, *[stand] * len(standing), *[move] * len(united_shapes)]
        whole = scene.model_copy(update={"solid": solids})
        return SIMULATOR.assemble(
            whole, placed, bodies, device=str(model.device), folder=Path()
        ), bodies

    def _begin(self, requested: np.ndarray | None, dt: float) -> bool:
        """Restore the state at the beginning of the step; return whether to run it.

        It is not run if the coupler repeats it and the bodies move as before, with or without
        contacts.

        Args:
            requested: the result of `WorldBodies.asked`.
            dt: time step [s].
        """
        if self._begins or not self._coupled:
            if self._restart:
                self._restart = self._begins = False
                falls = ROUNDING + ALIKE * dt * float(np.linalg.norm(self.simulation.gravity))
                alike = np.repeat([ALIKE * self.scene.spacing, ALIKE, falls], [3, 4, 6])
                if (
                    requested is not None
                    and self._requested is not None
                    and (np.abs(requested - self._requested) < alike).all()
                ):
                    return False
                self.simulation.restore(self._saved_state)
            elif self._restarts:
                self._saved_state = self.simulation.state()
            self._requested = requested
            if self.bodies is not None:
                self.bodies.impulses[:] = 0.0
        else:
            self._requested = None  # one of several substeps
        self._begins = False
        return True

    def _advance(self, dt: float) -> None:
        """Run steps of the liquid over dt [s], with shorter steps after a failure.

        Steps are equal in length, at most the stable one and twice the last one. A failed step is
        halved up to RETRIES times.
        """
        simulation, end, least = self.simulation, self.simulation.time + dt, dt / 2**RETRIES
        step = math.inf
        while (remaining := end - simulation.time) > WHOLE * dt:
            step = min(simulation.stable_dt(), self.scene.time.dt_max, 2.0 * step)
            count = math.ceil(remaining / step * (1.0 - WHOLE))
            while True:
                # In newton, forces act for the whole motion of the bodies.
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
