"""Impulses of contacts at the level of velocities: Coulomb friction in boxes, solved as an LCP with bounds that depend on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse.csgraph import connected_components

from warp_lcp.affine_bounds import AffineBounds
from warp_lcp.grid.motion import Motion, Pose
from warp_lcp.operators.dense import DenseOperator
from warp_lcp.problem import LCP
from warp_lcp.rigid.body import PLANAR, BodyMotion, RigidBody
from warp_lcp.rigid.contact_shape import ContactShape
from warp_lcp.rigid.contacts import Touch, between, on_planes
from warp_lcp.rigid.surroundings import Surroundings
from warp_lcp.solve import Solver, solve
from warp_lcp.solvers.blocked_gauss_seidel import BlockedGaussSeidel
from warp_lcp.solvers.nncg import NNCG
from warp_lcp.stopping import StoppingCriteria

NEAR = 1e-2  # of the smallest body's size: gaps up to it are contacts, besides those that speeds may close in a step
AHEAD = 2.0  # of the way that speeds and gravity make in a step: what a material gives a body is not known before it is solved for
SLOP = 1e-5  # of a body's size: overlap that is left alone
RATE = 0.3  # part of a larger overlap that a step removes
START_OVERLAP = 1e-3  # of a body's size, with which it may start: files round their numbers
BOUNCE = 2.0  # of gravity's speed in a step: slower impacts do not bounce, so that bodies come to rest
BEARS = 1e-6  # of the largest impulse of a body: contacts with less do not hold it
EXACT = StoppingCriteria(rtol=1e-7, max_iterations=400, patience=400)  # a stack then drifts by 1e-7 of its size in a second
ROUGH = StoppingCriteria(rtol=1e-2, max_iterations=30, patience=30)  # for overlaps, which take several steps anyway
ONE_BLOCK = 6  # unknowns that are solved exactly, as of the two contacts of a box in the plane
YIELDS = 1e-6  # of B, along tangents: how friction is shared between contacts then is unique, and rest creeps by 1e-7 m/s at most
ALONG_SLIP = 1e-6  # of gravity's speed in a step: a slower slip has no direction
SIDEWAYS = 1e-6  # of gravity, along a contact's plane


@dataclass(frozen=True, eq=False)
class Touching:
    """The contacts of a step, k of them; a contact's rows are its normal and `dimension` - 1 tangents.

    Args:
        first: body that the normal points into, shape (k,).
        second: body that it comes from, -1 where that is none, shape (k,).
        gap: [m], shape (k,).
        size: of the smaller body [m], shape (k,).
        friction: Coulomb's coefficient, shape (k,).
        J: relative velocities of the bodies' velocities, shape (dimension k, n bodies * their velocities).
        wall: what surroundings that move add to them [m/s], shape (dimension k,).
        target: normal velocity that is the least [m/s]: what closes the gap, or bounces, shape (k,).
    """

    first: np.ndarray
    second: np.ndarray
    gap: np.ndarray
    size: np.ndarray
    friction: np.ndarray
    J: np.ndarray
    wall: np.ndarray
    target: np.ndarray

    def __len__(self) -> int:
        """Return the number of contacts."""
        return len(self.gap)


class ContactSolve:
    """Find contacts and solve for their impulses.

    Args:
        bodies: all.
        shapes: of the bodies as placed.
        surroundings: what else there is.
        dimension: 2 or 3.

    Attributes:
        residual: of the last problem, relative to that of no impulses; 0 without contacts.
    """

    def __init__(self, bodies: Sequence[RigidBody], shapes: Sequence[ContactShape], surroundings: Surroundings, dimension: int) -> None:
        self.bodies, self.shapes, self.surroundings, self.dimension = list(bodies), list(shapes), surroundings, dimension
        self.residual = 0.0
        self._motions = [BodyMotion(body) for body in bodies]
        self._reach = [shape.reach(body.properties.center) for body, shape in zip(bodies, shapes, strict=True)]

    def check_start(self, time: float) -> None:
        """Refuse bodies that overlap at the start.

        Raises:
            ValueError: which, and with what.
        """
        for i, (body, shape) in enumerate(zip(self.bodies, self.shapes, strict=True)):
            most = START_OVERLAP * shape.size
            for obstacle, touch in self._with_surroundings(i, time, [0.0] * len(self.surroundings.obstacles)):
                if len(touch) and touch.gap.min() < -most:
                    raise ValueError(f"{body.name} reaches {-touch.gap.min():.3g} m into {obstacle.name} at the start: they must lie apart")
            for j in range(i):
                touch, other = self._pair(i, j, 0.0), self.bodies[j].name
                if len(touch) and touch.gap.min() < -most:
                    raise ValueError(f"{body.name} overlaps {other} by {-touch.gap.min():.3g} m at the start: bodies must lie apart")

    def find(self, time: float, dt: float, gravity: np.ndarray) -> Touching:
        """Return where bodies touch now or may in the step.

        Args:
            time: of the state [s].
            dt: time step [s].
            gravity: [m/s^2], shape (3,); the bodies' velocities are those before it acts.
        """
        falls = float(np.linalg.norm(gravity)) * dt
        size = [shape.size for shape in self.shapes]
        near = NEAR * min(size)
        way = [
            AHEAD * dt * (float(np.linalg.norm(b.velocity)) + float(np.linalg.norm(b.angular_velocity)) * reach + falls)
            for b, reach in zip(self.bodies, self._reach, strict=True)
        ]
        found: list[tuple[int, int, Touch, Motion | None]] = []
        for i in range(len(self.bodies)):
            margins = [near + way[i] + AHEAD * self._obstacle_way(obstacle.motion, time, dt) for obstacle in self.surroundings.obstacles]
            found += [(i, -1, touch, obstacle.motion) for obstacle, touch in self._with_surroundings(i, time, margins)]
            found += [(i, j, self._pair(i, j, near + way[i] + way[j]), None) for j in range(i)]
        return self._assembled([entry for entry in found if len(entry[2])], time, dt, gravity)

    def push_apart(self, touching: Touching, start: np.ndarray | None = None) -> np.ndarray:
        """Solve for the impulses of contacts and give them to the bodies; return them [N s], shape (dimension k,).

        Args:
            touching: the contacts.
            start: impulses to start from; none if None.
        """
        self.residual = 0.0
        k, dim = len(touching), self.dimension
        if k == 0:
            return np.zeros(0)
        W = self._inverse_mass()
        J = touching.J
        b = J @ self._velocities() + touching.wall
        b[::dim] -= touching.target
        r, self.residual = solve_contacts(J @ W @ J.T, b, touching.friction, dim, stopping=EXACT, start=start)
        self._give(J.T @ r)
        return r

    def separation(self, touching: Touching, dt: float) -> list[np.ndarray]:
        """Return the smallest ways (m, rad) of the bodies, in the metric of their masses, that reduce overlaps at the end of a step.

        They give no velocity, so no energy of motion; a frictionless problem like that of the impulses.
        """
        n, dofs, dim = len(self.bodies), 3 * self.dimension - 3, self.dimension
        still = [np.zeros(dofs) for _ in range(n)]
        if not len(touching):
            return still
        J = touching.J[::dim]
        gap = touching.gap + dt * (J @ self._velocities() + touching.wall[::dim])
        deep = gap < -SLOP * touching.size
        if not deep.any():
            return still
        W = self._inverse_mass()
        b = np.where(deep, RATE * gap, np.maximum(gap, 0.0))
        x, _ = solve_contacts(J @ W @ J.T, b, np.zeros(len(b)), 1, stopping=ROUGH)
        return list((W @ (J.T @ x)).reshape(n, dofs))

    def hold(self, touching: Touching, impulses: np.ndarray) -> None:
        """Let contacts that bear against walls and other solids take what impulses would move into them, for each body by itself."""
        dim, dofs = self.dimension, 3 * self.dimension - 3
        rows = impulses.reshape(-1, dim)
        for number, body in enumerate(self.bodies):
            mine = (touching.first == number) & (touching.second < 0)
            if not mine.any():
                continue
            bears = mine & (rows[:, 0] > BEARS * rows[mine, 0].max())
            sticks = bears[:, None] & (np.abs(rows[:, 1:]) < touching.friction[:, None] * rows[:, :1] * (1.0 - BEARS))
            held = np.concatenate([bears[:, None], sticks], axis=1).ravel()
            if not held.any():
                continue
            J = touching.J[held][:, number * dofs : (number + 1) * dofs]
            W = body.free_inverse_mass(dim)
            body.hold = np.eye(dofs) - J.T @ np.linalg.pinv(J @ W @ J.T, rcond=1e-9, hermitian=True) @ J @ W

    def _assembled(self, found: list[tuple[int, int, Touch, Motion | None]], time: float, dt: float, gravity: np.ndarray) -> Touching:
        """Return the contacts with their Jacobian."""
        falls = float(np.linalg.norm(gravity)) * dt
        dim, n, dofs = self.dimension, len(self.bodies), 3 * self.dimension - 3
        count = sum(len(touch) for _, _, touch, _ in found)
        jacobian, walls = np.zeros((count, dim, n, dofs)), np.zeros((count, dim))
        first, second, friction, size, bounce = (np.zeros(count) for _ in range(5))
        at = 0
        for i, j, touch, motion in found:
            rows = slice(at, at + len(touch))
            at += len(touch)
            moved = _carried(motion, touch.point, time, dt)
            slip = self._point_velocity(i, touch.point) - (self._point_velocity(j, touch.point) if j >= 0 else moved)
            frames = _frames(touch.normal, slip, dim, ALONG_SLIP * falls, gravity)
            jacobian[rows, :, i] = self._rows(i, touch.point, frames)
            if j >= 0:
                jacobian[rows, :, j] = -self._rows(j, touch.point, frames)
            walls[rows] = -np.einsum("kij,kj->ki", frames, moved)
            first[rows], second[rows] = i, j
            pair = [self.bodies[i], *([self.bodies[j]] if j >= 0 else [])]
            friction[rows] = np.sqrt(pair[0].friction * pair[-1].friction)
            bounce[rows] = max(body.restitution for body in pair)
            size[rows] = min(self.shapes[number].size for number in ([i, j] if j >= 0 else [i]))
        gap = Touch.joined([touch for _, _, touch, _ in found]).gap
        J, wall = jacobian.reshape(count * dim, n * dofs), walls.reshape(-1)
        approach = J[::dim] @ self._velocities() + wall[::dim]
        target = -np.maximum(gap, 0.0) / dt
        hits = (approach < -BOUNCE * falls) & (gap + dt * approach < 0.0) & (bounce > 0.0)
        target = np.where(hits, np.maximum(target, -bounce * approach), target)
        return Touching(first.astype(int), second.astype(int), gap, size, friction, J, wall, target)

    def _rows(self, number: int, points: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """Return the velocities of points of a body along the frames' vectors for its velocities, shape (k, dimension, velocities)."""
        arms = points - self.bodies[number].position
        both = np.concatenate([frames, np.cross(arms[:, None], frames)], axis=2)
        return both if self.dimension == 3 else both[:, :, PLANAR]

    def _point_velocity(self, number: int, points: np.ndarray) -> np.ndarray:
        body = self.bodies[number]
        return np.asarray(body.velocity + np.cross(body.angular_velocity, points - body.position))

    def _pose(self, number: int) -> Pose:
        return self._motions[number].pose(self.bodies[number].time)

    def _with_surroundings(self, number: int, time: float, margins: Sequence[float]) -> list[tuple[Any, Touch]]:
        """Return each obstacle with the points where a body touches it."""
        shape, pose, found = self.shapes[number], self._pose(number), []
        for obstacle, margin in zip(self.surroundings.obstacles, margins, strict=True):
            there = obstacle.pose(time)
            if obstacle.shape is None:
                points, normals = there.apply(obstacle.points), obstacle.normals @ there.rotation.T
                touch = on_planes(shape, pose, points, normals, margin, self.dimension)
            else:
                touch = between(shape, pose, obstacle.shape, there, margin, self.dimension)
            found.append((obstacle, touch))
        return found

    def _pair(self, i: int, j: int, margin: float) -> Touch:
        """Return where two bodies touch, normals into body i."""
        apart = float(np.linalg.norm(self.bodies[i].position - self.bodies[j].position)) - self._reach[i] - self._reach[j]
        if apart > margin:
            return Touch.joined([])
        return between(self.shapes[i], self._pose(i), self.shapes[j], self._pose(j), margin, self.dimension)

    def _obstacle_way(self, motion: Motion | None, time: float, dt: float) -> float:
        """Return how far points near the bodies go with an obstacle in a step [m]."""
        if motion is None:
            return 0.0
        places = np.array([body.position for body in self.bodies])
        return dt * float(np.linalg.norm(_carried(motion, places, time, dt), axis=1).max())

    def _inverse_mass(self) -> np.ndarray:
        dofs = 3 * self.dimension - 3
        W = np.zeros((len(self.bodies) * dofs,) * 2)
        for number, body in enumerate(self.bodies):
            rows = slice(number * dofs, (number + 1) * dofs)
            W[rows, rows] = body.free_inverse_mass(self.dimension)
        return W

    def _velocities(self) -> np.ndarray:
        return np.concatenate([body.velocities(self.dimension) for body in self.bodies])

    def _give(self, impulses: np.ndarray) -> None:
        for body, impulse in zip(self.bodies, impulses.reshape(len(self.bodies), -1), strict=True):
            body.push(impulse)


def solve_contacts(
    B: np.ndarray, b: np.ndarray, friction: np.ndarray, dimension: int, *, stopping: StoppingCriteria, start: np.ndarray | None = None
) -> tuple[np.ndarray, float]:
    """Return impulses of contacts and the largest residual of a problem, relative to that of none.

    Bodies that touch no other, by way of others neither, are problems of their own: small ones are solved exactly, others by nonlinear
    conjugate gradients on projected sweeps. One that is not reached is taken as it is.

    Args:
        B: velocities at contacts from impulses, the rows of a contact consecutive: normal, then tangents; shape (n, n).
        b: velocities without impulses, less those that are the least [m/s], shape (n,).
        friction: Coulomb's coefficient of each contact, shape (n / dimension,).
        dimension: rows of a contact; 1: there is no friction.
        stopping: when a problem is done.
        start: impulses to start from; none if None.
    """
    x, residual = np.zeros(len(b)), 0.0
    contact = np.arange(len(b)) // dimension
    B = 0.5 * (B + B.T) + np.diag(np.where(np.arange(len(b)) % dimension > 0, YIELDS * np.diag(B), 0.0))
    count, island = connected_components((B != 0.0) | (contact[:, None] == contact), directed=False)
    for number in range(count):
        rows = np.flatnonzero(island == number)
        tangential = np.arange(len(rows)) % dimension > 0
        normal = np.where(tangential, np.arange(len(rows)) // dimension * dimension, -1)
        bounds = AffineBounds.friction(normal, friction[contact[rows]], 0.0, np.inf) if dimension > 1 else (0.0, np.inf)
        problem = LCP(DenseOperator(B[np.ix_(rows, rows)], device="cpu"), b[rows], *bounds)
        exact = len(rows) <= ONE_BLOCK
        method: Solver = BlockedGaussSeidel(blocks=len(rows), precision="double") if exact else NNCG(precision="double")
        result = solve(problem, method, stopping=stopping, x0=None if start is None else start[rows])
        x[rows], residual = result.x.numpy(), max(residual, result.relative_residual)
    return x, residual


def _carried(motion: Motion | None, points: np.ndarray, time: float, dt: float) -> np.ndarray:
    """Return the mean velocities of points that a solid takes along in a step [m/s], shape (k, 3)."""
    if motion is None:
        return np.zeros_like(points)
    way = motion.pose(time + dt).after(motion.pose(time).inverse())
    return np.asarray((way.apply(points) - points) / dt)


def _frames(normal: np.ndarray, slip: np.ndarray, dimension: int, slow: float, gravity: np.ndarray) -> np.ndarray:
    """Return normal and tangents of contacts, shape (k, dimension, 3).

    In space the first tangent is along the slip, where there is none along what gravity would make slip: boxes of friction then are as wide
    as the cone where it counts.
    """
    if dimension == 2:
        return np.stack([normal, np.stack([-normal[:, 1], normal[:, 0], np.zeros(len(normal))], axis=1)], axis=1)
    u = np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
    for way, least in ((gravity, SIDEWAYS * float(np.linalg.norm(gravity))), (slip, slow)):
        along = way - (way * normal).sum(axis=1)[:, None] * normal
        u = np.where((np.linalg.norm(along, axis=1) > least)[:, None], along, u)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return np.stack([normal, u, np.cross(normal, u)], axis=1)
