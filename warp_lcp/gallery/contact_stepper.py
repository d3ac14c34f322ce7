"""Velocity-level time stepper of rigid bodies: semi-implicit Euler, any method.

For experiments with contact methods. It is no general engine: one coefficient of friction, no
restitution.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_lcp.gallery.rigid_world import Assembly, World
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import Solver
from warp_lcp.problem.result import SolveStatus
from warp_lcp.problem.solve_loop import solve
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.rigid.contact_models import BoxedModel, ContactModel, ContactSystem
from warp_lcp.solvers.psor import ProjectedSOR

STABILIZATIONS = ("baumgarte", "split", "none")


@dataclass(frozen=True)
class StepReport:
    """Report of a contact step.

    Args:
        time: time at its end [s].
        contacts: number of contacts.
        iterations: iterations of the method.
        residual: residual of the model's problem, relative to that of x = clip(0, l, u).
        status: status of the solve.
        impulses: impulses r of the contacts and joints [N s].
    """

    time: float
    contacts: int
    iterations: int
    residual: float
    status: SolveStatus
    impulses: np.ndarray


class ContactStepper:
    """Time stepper of rigid bodies with contacts.

    A step detects contacts, solves for impulses, changes velocities, and moves the bodies: v' = v +
    dt g + M^-1 J'r, x' = x + dt v'.

    Overlaps are removed by position correction. "baumgarte" adds a part of the overlap over dt to
    the problem itself, which remains as velocity. "split" moves bodies by the velocities of a
    second, frictionless problem, which are discarded (50 sweeps of projected Gauss-Seidel). "none"
    does not correct overlaps. Impulses start from those of the previous step at the same contacts,
    see `ContactMemory`.

    Args:
        world: the world; its state is updated.
        method: a method of `wl.METHODS` for the model's problem, or a function that returns one for
            a system, since blocks depend on it; projected Gauss-Seidel if None.
        model: friction model.
        dt: time step [s].
        stabilization: "baumgarte", "split" or "none".
        rate: fraction of an overlap or a joint's error that is removed in a step, in [0, 1].
        stopping: stopping criteria; 1e-6 and 500 iterations if None.
        warm: whether impulses start from those of the previous step.
        device: Warp device; the CPU if None.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> from warp_lcp.gallery.contact_scenes import box_stack
        >>> world = box_stack(1)
        >>> report = ContactStepper(world, dt=0.01).step()
        >>> weight = world.bodies[0].properties.mass * 9.81 * 0.01
        >>> print(report.contacts, abs(report.impulses[::3].sum() - weight) < 1e-4 * weight)
        4 True
    """

    def __init__(
        self,
        world: World,
        method: Solver | Callable[[ContactSystem], Solver] | None = None,
        *,
        model: ContactModel | None = None,
        dt: float = 0.01,
        stabilization: str = "baumgarte",
        rate: float = 0.2,
        stopping: StoppingCriteria | None = None,
        warm: bool = True,
        device: wp.DeviceLike = None,
    ) -> None:
        if stabilization not in STABILIZATIONS:
            raise ValueError(
                f"stabilization = {stabilization!r}: must be one of {', '.join(STABILIZATIONS)}"
            )
        if not (dt > 0 and 0 <= rate <= 1):
            raise ValueError(f"dt = {dt}, rate = {rate}: must be > 0 and in [0, 1]")
        self.world, self.dt, self.rate, self.warm = world, dt, rate, warm
        self.method = ProjectedSOR(omega=1.0) if method is None else method
        self.model: ContactModel = model or BoxedModel()
        self.stabilization, self.device = stabilization, device or "cpu"
        self.stopping = stopping or StoppingCriteria(rtol=1e-6, max_iterations=500, patience=500)
        self.time = 0.0
        # Joint impulses of the last step; those of contacts are in the world's memory.
        self._joints: np.ndarray | None = None

    def step(self) -> StepReport:
        """Advance the world by dt and return the report of the solve.

        Order of a step: contacts and their problem; impulses; velocities; position correction;
        motion.
        """
        world, dt = self.world, self.dt
        assembly = world.assemble(dt, rate=self.rate if self.stabilization == "baumgarte" else 0.0)
        system = assembly.system
        r, iterations, residual, status = np.zeros(len(system.q)), 0, 0.0, SolveStatus.CONVERGED
        if r.size:
            r, iterations, residual, status = self._solve(assembly)
        moving = np.flatnonzero(~world.fixed).tolist()
        impulses = (assembly.J.T @ r).reshape(-1, 6)
        for i in moving:
            world.bodies[i].accelerate(np.array(world.gravity), dt)
            world.bodies[i].push(impulses[i])
        world.contact_solve.memory.keep(
            assembly.contacts, r[: 3 * system.contacts].reshape(-1, 3), world.bodies
        )
        self._joints = r[system.joints]
        ways = dt * self._separation() if self.stabilization == "split" and r.size else None
        for i in moving:
            world.bodies[i].advance(dt)
            if ways is not None:
                world.bodies[i].shift(ways[i])
        self.time += dt
        return StepReport(self.time, system.contacts, iterations, residual, status, r)

    def _solve(self, assembly: Assembly) -> tuple[np.ndarray, int, float, SolveStatus]:
        """Return impulses, iterations, relative residual and status of the problem."""
        system = assembly.system
        method = self.method if isinstance(self.method, Solver) else self.method(system)
        problem = self.model.problem(system).lcp(device=self.device)
        x0 = (
            self.model.guess(system, self._guess(assembly))
            if self.warm and self._joints is not None
            else None
        )
        result = solve(problem, method, stopping=self.stopping, x0=x0)
        return (
            self.model.impulses(system, result.x.numpy()),
            result.iterations,
            result.relative_residual,
            result.status,
        )

    def _guess(self, assembly: Assembly) -> np.ndarray:
        """Return impulses of the previous step where they exist, 0 elsewhere."""
        joints = assembly.system.joints
        known = (
            self._joints
            if self._joints is not None and len(self._joints) == len(joints)
            else np.zeros(len(joints))
        )
        return np.concatenate(
            [
                self.world.contact_solve.memory.initial_impulses(
                    assembly.contacts, self.world.bodies
                ).ravel(),
                known,
            ]
        )

    def _separation(self) -> np.ndarray:
        """Return velocities that remove overlaps and errors of joints, shape (n, 6).

        They solve a frictionless problem of bodies at rest.
        """
        assembly = self.world.assemble(self.dt, rate=self.rate)
        system = assembly.system
        keep = np.concatenate([system.normals, system.joints])
        bias = assembly.bias[keep]
        if not (bias < 0).any() and not system.joints.size:
            return np.zeros_like(assembly.falling)
        lower = np.concatenate([np.zeros(system.contacts), system.lower])
        upper = np.concatenate([np.full(system.contacts, np.inf), system.upper])
        problem = LCP(
            SparseOperator(system.B[keep][:, keep], device=self.device), bias, lower, upper
        )
        stopping = StoppingCriteria(rtol=1e-3, max_iterations=50, patience=50)
        x = solve(problem, ProjectedSOR(omega=1.0), stopping=stopping).x.numpy()
        return np.asarray(assembly.response[:, keep] @ x).reshape(-1, 6)
