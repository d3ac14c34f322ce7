"""Simulation of bodies that inverse kinematics moves.

The angles of hinges move points of bodies to targets, within the limits of the hinges.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from warp_lcp.contacts.articulated_figure import ArticulatedFigure
from warp_lcp.contacts.inverse_kinematics import InverseKinematics, ReachedPose
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.rigid.joints import WORLD, Joint
from warp_lcp.rigid.outline import BodySurface
from warp_lcp.simulation import NoStopwatch, Part, SimulationFailed, Stopwatch, Surface

MARK = 0.03  # relative to the figure's reach: half the size of a target's marker
COLUMNS = ("target_error", "solver", "solve_status", "solve_iterations", "solve_residual")


@dataclass(frozen=True, eq=False)
class TargetPath:
    """Target path of a point of a body.

    Args:
        body: number of the body.
        point: point of the body, as placed [m], shape (3,).
        times: increasing [s], shape (m,).
        places: positions at those times, with linear interpolation [m], shape (m, 3).
    """

    body: int
    point: np.ndarray
    times: np.ndarray
    places: np.ndarray

    def place(self, time: float) -> np.ndarray:
        """Return the target position at a time [s], shape (3,)."""
        return np.array([np.interp(time, self.times, along) for along in self.places.T])


def tree_of(joints: Sequence[Joint], bodies: int) -> list[int]:
    """Return the joints' numbers, each after that of the body that carries it.

    Raises:
        ValueError: a body has no hinge as its first body, or several; a joint is no hinge; or
            bodies form a ring.
    """
    joint_of_body = {joint.first: number for number, joint in enumerate(joints)}
    if sorted(joint.first for joint in joints) != list(range(bodies)) or any(
        joint.kind != "hinge" for joint in joints
    ):
        raise ValueError(
            "every body must be the first body of exactly one hinge, and there must be no other "
            "joints"
        )
    order: list[int] = []
    while len(order) < bodies:
        placed = {joints[number].first for number in order} | {WORLD}
        more = [
            number
            for body, number in sorted(joint_of_body.items())
            if body not in placed and joints[number].second in placed
        ]
        if not more:
            raise ValueError(
                "hinges must form trees rooted at fixed solids or in space; some form a loop"
            )
        order += more
    return order


def figure_of(
    joints: Sequence[Joint], order: Sequence[int], targets: Sequence[TargetPath], dimension: int
) -> ArticulatedFigure:
    """Return the articulated figure of hinges and targets, in the order of `tree_of`."""
    place = {joints[number].first: index for index, number in enumerate(order)}
    hinges = [joints[number] for number in order]
    parents = tuple(place.get(hinge.second, -1) for hinge in hinges)
    anchors = np.array([hinge.anchor for hinge in hinges])
    offsets = np.array(
        [
            a - (anchors[parent] if parent >= 0 else 0.0)
            for a, parent in zip(anchors, parents, strict=True)
        ]
    )
    carriers = tuple(place[target.body] for target in targets)
    tips = np.array(
        [target.point - anchors[carrier] for target, carrier in zip(targets, carriers, strict=True)]
    )
    axes = np.array([hinge.axis for hinge in hinges])
    lower, upper = np.array([hinge.limits for hinge in hinges]).T
    return ArticulatedFigure(parents, axes, offsets, carriers, tips, lower, upper, dimension)


class KinematicSimulation:
    """Simulation of bodies on hinges by inverse kinematics ([Book] 1.3.4).

    Each step computes the angles of the hinges from those of the step before.

    Args:
        bodies: bodies of the scene, with its joints.
        targets: at least one.
        solver: solver for the angles.
        method: its name in the log.
        dt: the longest step [s].

    Attributes:
        time: time of the state [s].
        step_count: number of steps.
        watch: measures the stages of a step.
        theta: angles of the hinges, in the order of `tree_of` [rad], shape (n,).
    """

    def __init__(
        self,
        bodies: RigidBodies,
        targets: Sequence[TargetPath],
        solver: InverseKinematics,
        method: str,
        dt: float,
    ) -> None:
        self.bodies, self.targets, self._solver, self._method, self._dt = (
            bodies,
            list(targets),
            solver,
            method,
            dt,
        )
        self._order = tree_of(bodies.joints, len(bodies.bodies))
        self.figure = figure_of(bodies.joints, self._order, self.targets, bodies.dimension)
        self.theta = np.zeros(self.figure.hinges)
        self.time, self.step_count = 0.0, 0
        self.watch: Stopwatch = NoStopwatch()

    def stable_dt(self) -> float:
        """Return the longest step [s], a constant."""
        return self._dt

    def step(self, dt: float) -> dict[str, float | int | str | None]:
        """Advance by dt [s] and return a row of the log.

        Raises:
            SimulationFailed: an angle is not finite.
        """
        with self.watch.stage("angles"):
            goals = self._goals(self.time + dt)
            pose = self._solver.solve(self.figure, goals, self.theta)
        if not np.isfinite(pose.theta).all():
            raise SimulationFailed(f"step {self.step_count + 1}: an angle is not finite")
        self.theta, self.time, self.step_count = pose.theta, self.time + dt, self.step_count + 1
        with self.watch.stage("motion"):
            self._place(dt)
        return self._row(pose, goals)

    def columns(self) -> tuple[str, ...]:
        """Return the names of the log's columns.

        target_error: the largest distance of a point from its target [m]. solve_iterations: number
        of problems solved, one for each update of the angles; solve_residual: the projected
        gradient [rad] of half the squared distances. For the bodies' columns see
        `RigidBodies.columns`.
        """
        return (*COLUMNS, *self.bodies.columns())

    def frame(self) -> list[Part]:
        """Return the surfaces of the bodies, and markers of the targets.

        Markers are octahedra (squares in 2-D), numbered in `body` after the bodies.
        """
        own, marks = (
            self.bodies.surfaces(),
            [self._mark(number) for number in range(len(self.targets))],
        )
        surface = BodySurface.joined([own, *marks])
        return [Surface("bodies", surface.points, surface.corners, surface.fields)]

    def state(self) -> dict[str, np.ndarray]:
        """Return everything that `restore` needs."""
        clock = np.array([self.time])
        return {
            "clock": clock,
            "step_count": np.array(self.step_count),
            "angles": self.theta,
            **self.bodies.state(),
        }

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from `state`.

        Raises:
            ValueError: the state belongs to other bodies.
        """
        angles = np.asarray(state.get("angles", []), dtype=np.float64)
        if angles.shape != self.theta.shape:
            raise ValueError(
                f"the state has {angles.size} angles: this scene has {self.theta.size} hinges"
            )
        self.bodies.restore(state)
        self.theta, self.time, self.step_count = (
            angles.copy(),
            float(state["clock"][0]),
            int(state["step_count"]),
        )

    def notes(self) -> list[str]:
        """Return facts for the start of a run."""
        return [
            f"inverse kinematics: {self.figure.hinges} hinges, {len(self.targets)} targets, reach "
            f"{self.figure.reach:g} m"
        ]

    def _goals(self, time: float) -> np.ndarray:
        return np.array([target.place(time) for target in self.targets])[:, : self.bodies.dimension]

    def _place(self, dt: float) -> None:
        """Place the bodies at the current angles, with the mean velocities of the step.

        Poses follow from the root of each tree to its ends. Velocities are differences of poses
        over dt.

        With parent p of a body: R = R_p exp([theta a]x), anchor = anchor_p + R_p offset and x =
        anchor + R (center - joint anchor) [m]. Then v = (x - x_before) / dt [m/s], w = log(R
        R_before') / dt [rad/s], and the momenta are m v and I w. The inertia I is that of the new
        rotation, so that the poses come first.
        """
        turns: list[np.ndarray] = []
        anchors: list[np.ndarray] = []
        figure = self.figure
        for index, (number, parent) in enumerate(zip(self._order, figure.parents, strict=True)):
            carrier, at = (
                (turns[parent], anchors[parent]) if parent >= 0 else (np.eye(3), np.zeros(3))
            )
            turns.append(
                carrier @ Rotation.from_rotvec(self.theta[index] * figure.axes[index]).as_matrix()
            )
            anchors.append(at + carrier @ figure.offsets[index])
            joint = self.bodies.joints[number]
            body = self.bodies.bodies[joint.first]
            position = anchors[-1] + turns[-1] @ (body.properties.center - joint.anchor)
            spin = Rotation.from_matrix(turns[-1] @ body.rotation.T).as_rotvec() / dt
            velocity = (position - body.position) / dt
            body.angle += dt * float(spin[2])
            body.position, body.rotation, body.time = position, turns[-1], self.time
            body.momentum, body.angular_momentum = (
                body.properties.mass * velocity,
                body.inertia @ spin,
            )

    def _mark(self, number: int) -> BodySurface:
        """Return the marker of a target.

        It is an octahedron, in 2-D a square, whose corners lie MARK * reach [m] from the target
        along the axes.
        """
        size, dimension = MARK * self.figure.reach, self.bodies.dimension
        ends = np.concatenate([np.eye(3), -np.eye(3)])[:, :] * size
        if dimension == 2:
            points, corners = ends[[0, 1, 3, 4]], np.array([[0, 1], [1, 2], [2, 3], [3, 0]])
        else:
            points = ends
            corners = np.array(
                [
                    [0, 1, 2],
                    [1, 3, 2],
                    [3, 4, 2],
                    [4, 0, 2],
                    [1, 0, 5],
                    [3, 1, 5],
                    [4, 3, 5],
                    [0, 4, 5],
                ]
            )
        fields = {
            "body": np.full(len(points), len(self.bodies.bodies) + number, dtype=np.int32),
            "velocity": np.zeros((len(points), 3), dtype=np.float32),
        }
        return BodySurface(
            (points + self.targets[number].place(self.time)).astype(np.float32),
            corners.astype(np.int32),
            fields,
        )

    def _row(self, pose: ReachedPose, goals: np.ndarray) -> dict[str, float | int | str | None]:
        """Return a row of the log."""
        off = np.linalg.norm(self.figure.positions(self.theta) - goals, axis=1)
        model_row: dict[str, float | int | str | None] = {
            "target_error": float(off.max()),
            "solver": self._method,
            "solve_status": pose.status.name,
            "solve_iterations": pose.iterations,
            "solve_residual": pose.projected_gradient,
        }
        return model_row | self.bodies.row()
