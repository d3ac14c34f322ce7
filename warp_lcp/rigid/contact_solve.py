"""Velocity-level contact impulses: detection, solve, supported bodies."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from warp_lcp.grid.motion import Motion
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.rigid.body import AXES, PLANAR, BodyStates, cross, in_space, lengths, rotation_by
from warp_lcp.rigid.contact_detection import (
    NONE,
    ContactDetection,
    DetectedContacts,
    UncheckedPose,
    between,
)
from warp_lcp.rigid.contact_problem import ContactImpulses, ContactProblem, JointPart
from warp_lcp.rigid.contacts import ContactMemory, Contacts, contact_frames
from warp_lcp.rigid.joints import Joint, JointRows, joined_pairs
from warp_lcp.rigid.planar_contacts import AHEAD, RATE, ROUGH, SLOP, PlanarContacts, PlanarImpulses
from warp_lcp.rigid.supported_contacts import SINGULAR, SupportedContacts

# Relative to the smallest body's size: gaps up to this are contacts, besides those that velocities
# may close in a step.
NEAR = 1e-2
START_OVERLAP = 1e-3  # relative to a body's size: overlap allowed at the start, due to rounding
# Relative to the speed that gravity adds in a step: slower impacts do not bounce, so that bodies
# come to rest.
BOUNCE = 2.0
# Relative to gravity: limit of the acceleration at a contact; more is due to another impact.
FALL = 1.5
# A stack then drifts by 1e-7 of its size in a second.
EXACT = StoppingCriteria(rtol=1e-7, max_iterations=600)
UNSOLVED = 1e-5  # residual of sweeps above which Newton's methods are used
TINY = 1e-6  # relative to a step: least time after an impact
ALONG_SLIP = 1e-6  # relative to the speed of gravity in a step: a slower slip has no direction
SIDEWAYS = 1e-6  # relative to gravity, along a contact's plane
# Relative to the smallest body's size, and in rad: tolerance of joint errors at the end of a step.
JOINED = 1e-9
ROUNDS = 8  # most solves of a step until its joints hold at its end


# Takes a problem and the initial impulses.
ImpulseSolver = Callable[[ContactProblem, np.ndarray], ContactImpulses]


def sweeps_and_newton(problem: ContactProblem, start: np.ndarray) -> ContactImpulses:
    """Solve by nonlinear conjugate gradients on sweeps, then by Newton's methods.

    Newton's methods run only if sweeps do not reach the tolerance.
    """
    return problem.solve(EXACT, start, UNSOLVED)


class ContactSolve:
    """Contact detection and solve for impulses.

    Args:
        detection: detection of the bodies' contacts.
        solver: solver for the impulses of a step; overlaps, and resting contacts during a bounce,
            have solvers of their own.
        joints: joints between the bodies; bodies of a joint do not collide, nor do bodies rigidly
            connected by fixed joints.

    Attributes:
        residual: residual of the last problem, relative to that of no impulses; 0 without contacts
            and joints.
        iterations: iterations of the last step; 0 without contacts and joints.
        memory: impulses of the last step.
        joint_rows: joint rows of the last step; None without joints, or before the first step.
        joint_impulses: impulses of these rows [N s, N m s], shape (m,).
        reach: largest distance of each body's points from its center of mass [m], shape (n,).
    """

    def __init__(
        self,
        detection: ContactDetection,
        solver: ImpulseSolver = sweeps_and_newton,
        joints: Sequence[Joint] = (),
    ) -> None:
        self.detection, self.bodies, self.dimension = (
            detection,
            detection.bodies,
            detection.dimension,
        )
        self.residual, self.iterations, self.memory, self._solver = (
            0.0,
            0,
            ContactMemory(len(self.bodies)),
            solver,
        )
        self.joints, self._joined = tuple(joints), joined_pairs(joints, len(self.bodies))
        self.joint_rows: JointRows | None = None
        self.joint_impulses = np.zeros(sum(joint.row_count(self.dimension) for joint in joints))
        bodies, shapes = self.bodies, detection.shapes
        self.reach = np.array(
            [
                shape.reach(body.properties.center)
                for body, shape in zip(bodies, shapes, strict=True)
            ]
        )
        self._size = np.array([shape.size for shape in shapes])
        self._near = NEAR * float(self._size.min(initial=np.inf))
        self._friction = np.array([body.friction for body in bodies])
        self._bounce = np.array([body.restitution for body in bodies])
        # The roots, and the rotations that they belong to.
        self._found_roots: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        # Contacts, roots and problem of `push_apart`.
        self._last: tuple[Contacts, np.ndarray, ContactProblem] | None = None
        self._pushed: PlanarImpulses | None = None  # result of the last `push_apart`
        self._planar = (
            PlanarContacts(detection, self.reach) if PlanarContacts.holds(detection) else None
        )
        self._roots_of_inertias = np.linalg.cholesky(bodies.inverse_inertia)

    def check_start(self, time: float) -> None:
        """Raise an error if bodies overlap at the start.

        Raises:
            ValueError: names the bodies that overlap.
        """
        nothing = np.zeros(len(self.bodies))
        contacts = self._apart(
            self.detection.find(time, nothing, np.zeros(len(self.detection.obstacles)))
        )
        overlapping = -contacts.points.gap > START_OVERLAP * self._size[contacts.first]
        if not overlapping.any():
            return
        k = int(overlapping.argmax())
        number, other, which = (
            int(contacts.first[k]),
            int(contacts.second[k]),
            int(contacts.obstacle[k]),
        )
        of_pair = (
            (contacts.first == number) & (contacts.second == other) & (contacts.obstacle == which)
        )
        name, deep = self.bodies[number].name, -float(contacts.points.gap[of_pair].min())
        if which != NONE:
            raise ValueError(
                f"{name} reaches {deep:.3g} m into {self.detection.obstacles[which].name} at the "
                "start: they must lie apart"
            )
        raise ValueError(
            f"{name} overlaps {self.bodies[other].name} by {deep:.3g} m at the start: bodies must "
            "lie apart"
        )

    def find(
        self, time: float, dt: float, gravity: np.ndarray, gone: np.ndarray | None = None
    ) -> Contacts:
        """Return current contacts and those possible within the step.

        Args:
            time: time of the state [s].
            dt: time step [s].
            gravity: [m/s^2], shape (3,); the bodies' velocities are those before it acts.
            gone: removed bodies, which have no contacts, shape (n,); None without any.
        """
        falls, near = math.sqrt(gravity @ gravity) * dt, self._near
        brought = [
            AHEAD * self._obstacle_way(obstacle.motion, time, dt)
            for obstacle in self.detection.obstacles
        ]
        all_inside = gone is None or not gone.any()
        planar = self._planar if all_inside else None
        if (
            planar is not None
            and (touching := planar.find(time, dt, falls, near, brought)) is not None
        ):
            detected, contacts = touching
            return (
                contacts
                if planar.still and not self._joined
                else self.assembled(self._apart(detected), time, dt, gravity)
            )
        six = self.bodies.velocities()
        speeds, spins = lengths(six[:, :3]), lengths(six[:, 3:])
        ways = AHEAD * dt * (speeds + spins * self.reach + falls)
        detected = self._apart(self.detection.find(time, ways, near + np.array(brought), near))
        if gone is not None and not all_inside:
            out = np.append(gone, False)
            detected = detected.where(~(out[detected.first] | out[detected.second]))
        return self.assembled(detected, time, dt, gravity)

    def approach(self, contacts: Contacts) -> np.ndarray:
        """Return normal velocities at contacts [m/s], shape (k,), for `bounce`.

        Negative: approaching; 0 if nothing bounces.
        """
        bounces = contacts.restitution.any()  # otherwise `bounce` does nothing
        return contacts.velocities(self._velocities())[:, 0] if bounces else np.zeros(len(contacts))

    def bounce(
        self,
        contacts: Contacts,
        approach: np.ndarray,
        dt: float,
        kick_dt: float,
        gravity: np.ndarray,
    ) -> np.ndarray:
        """Set the rebound velocity and time of impacts (updates the contacts).

        The bodies' velocities are those after gravity has acted on them for `kick_dt`, in the
        middle of the step. A gap closes by v t + a t^2 / 2 with v at the step's beginning. Where it
        is 0, at t = `when`, the speed v_i = v + a t becomes -e v_i. At the end of the step it is -e
        v_i + a (dt - t), so the target in the middle of a step without an impact is -e v_i + a (dt
        / 2 - t). The positions still have the motion before the impact until t, and that after it
        later, see `detour`.

        Args:
            contacts: the contacts of the step.
            approach: normal velocities before gravity acted [m/s], shape (k,).
            dt: time step [s].
            kick_dt: time that gravity has acted [s].
            gravity: [m/s^2], shape (3,).

        Returns:
            Impulses of the other contacts before the impacts [N s], shape (k, dimension).
        """
        before = np.zeros((len(contacts), self.dimension))
        if not contacts.restitution.any():
            return before
        g, gap, e = float(np.linalg.norm(gravity)), contacts.gap, contacts.restitution
        may = (
            (e > 0.0)
            & (approach < -BOUNCE * g * dt)
            & (gap + dt * (approach - FALL * g * kick_dt) < 0.0)
        )
        if not may.any():
            return before
        b = contacts.velocities(self._velocities())
        free = b[:, 0].copy()
        b[:, 0] -= contacts.target
        problem, resting, V = (
            self._problem(contacts, b, contacts.friction),
            np.flatnonzero(~may),
            self._velocities(),
        )
        if len(resting):  # supported bodies do not fall
            before[resting] = problem.part(resting).solve(EXACT).impulses
            V = V + self._answer(contacts.on_bodies(before, len(self.bodies)))
            free = contacts.velocities(V)[:, 0]
        a = np.clip((free - approach) / kick_dt, -FALL * g, FALL * g)
        v = approach + a * (kick_dt - 0.5 * dt)
        gap = np.maximum(gap, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):  # for contacts that do not meet
            t = 2.0 * gap / (np.sqrt(np.maximum(v**2 - 2.0 * a * gap, 0.0)) - v)
        hits = may & (t >= 0.0) & (t <= dt)
        t = np.where(hits, t, 0.0)
        for k in np.flatnonzero(hits & (contacts.second < len(self.bodies))).tolist():
            self._advance_contact(contacts, k, float(t[k]), V)
        free[hits] = contacts.velocities(V)[hits, 0]
        after, rest = -e * (free + a * (t - 0.5 * dt)), dt - t
        # Smaller bounces, not apart at the end of the step, are ignored.
        hits &= (after > 0.0) & (after + 0.5 * a * rest >= 0.0)
        contacts.target[hits] = (after + a * (0.5 * dt - t))[hits]
        order, starts = problem.islands()
        # Contacts of an island with an impact act at its time.
        for begin, end in pairwise(starts):
            mine = order[begin:end]
            if hits[mine].any():
                contacts.when[mine] = np.where(hits[mine], t[mine], t[mine][hits[mine]].mean())
        # Contacts moved by an impact elsewhere: gaps close from that time on.
        along = ~hits & (contacts.when > 0.0)
        left = np.maximum(contacts.gap + contacts.when * free, 0.0)[along] / np.maximum(
            dt - contacts.when[along], TINY * dt
        )
        # Contacts that separate before must not separate less after, or r (u before + u after) / 2
        # would add energy.
        contacts.target[along] = np.where(free[along] > 0.0, np.minimum(-left, -free[along]), -left)
        return before

    def _advance_contact(self, contacts: Contacts, k: int, t: float, V: np.ndarray) -> None:
        """Move contact k of two bodies to their positions at time t of the step.

        V are the velocities, shape (n, q); the rows of the contact are updated. Both bodies get the
        impulse at one point, so that angular momentum is conserved: the points of the bodies that
        meet at t are still apart.
        """
        pair = [int(contacts.first[k]), int(contacts.second[k])]
        bodies, shapes = (
            [self.bodies[number] for number in pair],
            [self.detection.shapes[number] for number in pair],
        )
        six, now = (
            np.array([in_space(V[number]) for number in pair]),
            np.array([body.position for body in bodies]),
        )
        at = now + t * six[:, :3]
        places = []
        for body, velocity, position in zip(bodies, six, at, strict=True):
            R = rotation_by(t * velocity[3:]) @ body.rotation
            places.append(UncheckedPose(R, position - R @ body.properties.center))
        margin = abs(float(contacts.gap[k])) + NEAR * float(contacts.size[k])
        found = between(shapes[0], places[0], shapes[1], places[1], margin, self.dimension)
        point, normal = contacts.point[k] + (at - now).mean(axis=0), contacts.frames[k, 0]
        if len(found):
            nearest = int(lengths(found.point - point).argmin())
            point, normal = found.point[nearest], found.normal[nearest]
        arms = point - at
        speeds = six[:, :3] + cross(six[:, 3:], arms)
        frames = contact_frames(normal[None], self.dimension, ((speeds[:1] - speeds[1:], 0.0),))
        contacts.frames[k], contacts.one[k] = frames[0], _rows(arms[:1], frames, self.dimension)[0]
        contacts.other[k] = -_rows(arms[1:], frames, self.dimension)[0]

    def detour(
        self, contacts: Contacts, before: np.ndarray, impulses: np.ndarray
    ) -> np.ndarray | None:
        """Return displacement errors of bodies due to impacts within the step.

        The difference to the motion with the velocities after impacts (m, rad), shape (n, q); None
        for zero. An impact at time t of the step has changed velocities by M^-1 J' r, and bodies
        have moved without it until then. With the target of `bounce` this is exact for parabolas
        before and after.

        Args:
            contacts: the contacts of the step.
            before: impulses without the impacts, see `bounce` [N s], shape (k, dimension).
            impulses: impulses with the impacts.
        """
        if not contacts.when.any():
            return None
        return -self._answer(
            contacts.on_bodies(contacts.when[:, None] * (impulses - before), len(self.bodies))
        )

    def push_apart(
        self,
        contacts: Contacts,
        start: np.ndarray | None = None,
        *,
        dt: float = 0.0,
        kick_dt: float = 0.0,
    ) -> np.ndarray:
        """Solve for contact and joint impulses and apply them to the bodies.

        Returns those of contacts [N s], shape (k, dimension).

        Args:
            contacts: the contacts.
            start: initial impulses; those of the last step if None.
            dt: time step [s], at whose end joints must hold; required with joints.
            kick_dt: time that torques of motors have acted [s].
        """
        self.residual, self.iterations = 0.0, 0
        if not len(contacts) and not self.joints:
            return np.zeros((0, self.dimension))
        if self._planar is not None and not self.joints and self._solver is sweeps_and_newton:
            before = self.memory.values if start is None else start
            self._pushed = solved = self._planar.push(
                contacts, before, start is not None, EXACT, UNSOLVED, dt
            )
            if solved is not None:
                self.residual, self.iterations = solved.residual, solved.iterations
                return solved.impulses
        b = contacts.velocities(self._velocities())
        b[:, 0] -= contacts.target
        start = self.memory.initial_impulses(contacts, self.bodies) if start is None else start
        problem = self._problem_of_step(contacts, b)
        if self.joints:
            impulses, pushes = self._hold_joints(problem, contacts, start, dt, kick_dt)
        else:
            impulses, self.residual, self.iterations = self._solver(problem, start)
            pushes = contacts.on_bodies(impulses, len(self.bodies))
        self.bodies.push(pushes)
        return impulses

    def _hold_joints(
        self,
        problem: ContactProblem,
        contacts: Contacts,
        start: np.ndarray,
        dt: float,
        kick_dt: float,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the impulses of contacts, and the total impulses on each body.

        The totals include those of joints, shape (n, q). Impulses of joints act along the rows J of
        the step's beginning, such that errors e are 0 at its end (the SHAKE method: second order,
        energy does not drift). e is not linear in velocities: the problem is solved again with c =
        e / dt - J v' for the last v', where y = J v' + c. Limits are treated likewise with the
        distance to them.
        """
        n, q = len(self.bodies), self._roots().shape[1]
        rows = JointRows.joined(
            [joint.rows(self.bodies, kick_dt, self.dimension) for joint in self.joints]
        )
        J, V, motors = rows.jacobian(n), self._velocities(), rows.motors
        bias, free = rows.bias(dt), J @ V.ravel()
        x = np.concatenate([start.ravel(), self.joint_impulses])
        for _ in range(ROUNDS):
            result = self._solver(
                replace(problem, joints=JointPart(self._weighted(rows), free + bias)), x
            )
            x = result.impulses
            impulses, joint_impulses = x[: start.size].reshape(start.shape), x[start.size :]
            pushes = contacts.on_bodies(impulses, n) + (J.T @ joint_impulses).reshape(n, q)
            after = (
                rows.errors(self._moved(pushes, dt), self.dimension) / dt
                - J @ (V + self._answer(pushes)).ravel()
            )
            after[motors] = bias[motors]
            off = dt * float(np.abs(after - bias).max())
            bias = after
            self.residual, self.iterations = result.residual, self.iterations + result.iterations
            if off <= JOINED * min(1.0, float(self._size.min())):
                break
        self.joint_rows, self.joint_impulses = rows, joint_impulses
        return impulses, pushes

    def motor_torques(self) -> dict[int, float]:
        """Return the torque of each motor in the last step [N m], by joint number.

        0 before the first step.
        """
        torques, rows = dict.fromkeys(range(len(self.joints)), 0.0), self.joint_rows
        if rows is not None:
            owners = np.repeat(
                np.arange(len(self.joints)),
                [joint.row_count(self.dimension) for joint in self.joints],
            )
            for row in np.flatnonzero(rows.motors).tolist():
                joint = int(owners[row])
                torques[joint] = self.joints[joint].motor_torque * float(
                    self.joint_impulses[row] / rows.upper[row]
                )
        return torques

    def _moved(self, pushes: np.ndarray, dt: float) -> BodyStates:
        """Return the bodies after impulses, shape (n, q), and a motion of dt [s]."""
        moved = self.bodies.copied()
        moved.push(pushes)
        moved.advance(dt)
        return moved

    def store_impulses(self, contacts: Contacts, impulses: np.ndarray) -> None:
        """Store impulses, shape (k, dimension), as the start of the next step."""
        if self._pushed is not None and self._pushed.impulses is impulses:
            self.memory.store(self._pushed.memory)
        else:
            self.memory.keep(contacts, impulses, self.bodies)

    def separation(
        self, contacts: Contacts, dt: float, detour: np.ndarray | None = None
    ) -> np.ndarray | None:
        """Return the smallest displacements that reduce overlaps at the end of a step.

        (m, rad), in the metric of the bodies' masses. They add no velocity, and thus no kinetic
        energy. The problem is frictionless, and otherwise that of the impulses. Shape (n, q); None
        for no displacements.

        Args:
            contacts: the contacts of the step.
            dt: time step [s].
            detour: displacement errors of the bodies in the step, see `detour`.
        """
        pushed, bodies = self._pushed, self.bodies
        if not len(contacts):
            return None
        if (
            pushed is not None
            and pushed.contacts is contacts
            and pushed.dt == dt
            and detour is None
        ):
            if np.array_equal(pushed.values, bodies.values):  # no impulse since `push_apart`
                return pushed.ways
        velocities = self._velocities() if detour is None else self._velocities() + detour / dt
        gap = contacts.gap + dt * contacts.velocities(velocities)[:, 0]
        deep = gap < -SLOP * contacts.size
        if not deep.any():
            return None
        b = np.where(deep, RATE * gap, np.maximum(gap, 0.0))
        if self.joints:
            return self._joined_separation(contacts, b, dt)
        problem = self._problem(contacts, b[:, None], np.zeros(len(b)))
        return self._answer(contacts.on_bodies(problem.solve(ROUGH).impulses, len(self.bodies)))

    def _joined_separation(self, contacts: Contacts, b: np.ndarray, dt: float) -> np.ndarray:
        """Return the displacements of `separation` that keep joints together.

        `b` are the gaps to reach [m], shape (k,).
        """
        moved = self._moved(np.zeros_like(self._velocities()), dt)
        rows = JointRows.joined([joint.rows(moved, dt, self.dimension) for joint in self.joints])
        rows = rows.where(rows.equations)
        gaps = np.column_stack([b, np.zeros((len(b), self.dimension - 1))])
        problem = replace(
            self._problem(contacts, gaps, np.zeros(len(b))),
            joints=JointPart(self._weighted(rows), rows.error),
        )
        x, n = self._solver(problem, np.zeros(gaps.size + len(rows))).impulses, len(self.bodies)
        apart = contacts.on_bodies(x[: gaps.size].reshape(gaps.shape), n)
        return self._answer(apart + (rows.jacobian(n).T @ x[gaps.size :]).reshape(n, -1))

    def absorb_impulses(self, contacts: Contacts, impulses: np.ndarray) -> None:
        """Let contacts with walls and solids absorb impulses into them.

        Each body is treated separately. A supported body supports the bodies in contact with it
        along directions in which it cannot move: a stack on the floor is supported up to its top.

        With the inverse mass M^-1 = G G' of a body and the rows J of its supports, the eigenvectors
        V of G'J'J G with eigenvalues > 0 are the supported directions. The body keeps
        hold = 1 - G^-T V V' G' of an impulse. Bodies are treated from the walls outward, breadth
        first, since a body supports others only where its own supports are known.
        """
        pushed = self._pushed
        if pushed is not None and pushed.impulses is impulses and pushed.squares is not None:
            for number, (square, root) in pushed.squares.items():
                values, V = np.linalg.eigh(square)
                V = V[:, values > SINGULAR * values.max()]
                self.bodies[number].hold = np.eye(3) - ((1.0 / root)[:, None] * V) @ V.T * root
        elif len(contacts):
            firm = SupportedContacts.of(contacts, impulses, len(self.bodies))
            roots = self._roots()
            waiting = np.unique(contacts.first[firm.first.any(axis=1)]).tolist()
            while waiting:
                number = waiting.pop(0)
                body, G = self.bodies[number], roots[number]
                squares, V = np.linalg.eigh(firm.square(contacts, number, G))
                # Directions that contacts support, in the metric of the mass.
                V = V[:, squares > SINGULAR * squares.max()]
                body.hold = np.eye(len(G)) - np.linalg.inv(G).T @ V @ V.T @ G.T
                reached = firm.spread(contacts, number, G, G - G @ V @ V.T)
                waiting += [
                    other
                    for other in reached
                    if other not in waiting and self.bodies[other].hold is None
                ]

    def _problem_of_step(self, contacts: Contacts, b: np.ndarray) -> ContactProblem:
        """Return the problem of the contacts of a step.

        It is solved twice: before and after the material's impulses.
        """
        roots = self._roots()
        if self._last is None or self._last[0] is not contacts or self._last[1] is not roots:
            self._last = contacts, roots, self._problem(contacts, b, contacts.friction)
            return self._last[2]
        return self._last[2].at(b)

    def _problem(self, contacts: Contacts, b: np.ndarray, friction: np.ndarray) -> ContactProblem:
        """Return the problem of the first rows of each contact.

        As many rows as b has, shape (k, rows).
        """
        one, other = (rows[:, : b.shape[1]] for rows in (contacts.one, contacts.other))
        first, second = contacts.first, contacts.second
        roots = self._all_roots()[1]
        return ContactProblem(
            first, second, one @ roots[first], other @ roots[second], b, friction, len(self.bodies)
        )

    def _weighted(self, rows: JointRows) -> JointRows:
        """Return joints' rows times the roots of the inverse masses."""
        roots = self._all_roots()[1]
        return replace(
            rows, one=rows.one @ roots[rows.first], other=rows.other @ roots[rows.second]
        )

    def _apart(self, found: DetectedContacts) -> DetectedContacts:
        """Return the contacts of pairs that are not connected by joints."""
        return found.without(self._joined)

    def assembled(
        self, detected: DetectedContacts, time: float, dt: float, gravity: np.ndarray | None
    ) -> Contacts:
        """Return the contacts with their rows.

        Tangents are along the slip, or along gravity if it is given.

        The velocity at a contact is
        v_first + w_first x r_first - v_second - w_second x r_second - v_wall [m/s], with r from the
        centers of mass [m]. The least normal velocity closes the gap in the step:
        target = -max(gap, 0) / dt. A pair has friction sqrt(mu_first mu_second), the larger
        restitution and the smaller size; beside an obstacle the body's own values count.
        """
        falls, n, dim = (
            0.0 if gravity is None else float(np.linalg.norm(gravity)) * dt,
            len(self.bodies),
            self.dimension,
        )
        first, second = detected.first, detected.second
        point, normal, gap = detected.points.point, detected.points.normal, detected.points.gap
        moved = np.zeros_like(point)
        for number, obstacle in enumerate(self.detection.obstacles):
            if obstacle.motion is not None and (here := detected.obstacle == number).any():
                moved[here] = _carried(obstacle.motion, point[here], time, dt)
        at = np.concatenate([self.bodies.position, np.zeros((1, 3))])
        first_arms, second_arms = point - at[first], point - at[second]
        ways: tuple[tuple[np.ndarray, float], ...] = ()
        if gravity is not None and dim == 3:  # in a plane there is one tangent
            six = np.concatenate([self.bodies.velocities(), np.zeros((1, 6))])
            slip = (
                six[first, :3]
                + cross(six[first, 3:], first_arms)
                - six[second, :3]
                - cross(six[second, 3:], second_arms)
                - moved
            )
            ways = (
                (gravity, SIDEWAYS * float(np.linalg.norm(gravity))),
                (slip, ALONG_SLIP * falls),
            )
        frames = contact_frames(normal, dim, ways)
        one, other = _rows(first_arms, frames, dim), -_rows(second_arms, frames, dim)
        standing = second == n
        other[standing] = 0.0
        wall = -(frames @ moved[:, :, None])[:, :, 0]
        partner = np.where(standing, first, second)
        size, bounce = (
            pick(values[first], values[partner])
            for pick, values in ((np.minimum, self._size), (np.maximum, self._bounce))
        )
        friction = np.sqrt(self._friction[first] * self._friction[partner])
        target = -np.maximum(gap, 0.0) / dt
        return Contacts(
            first,
            second,
            point,
            frames,
            gap,
            size,
            friction,
            one,
            other,
            wall,
            target,
            bounce,
            np.zeros(len(gap)),
        )

    def _obstacle_way(self, motion: Motion | None, time: float, dt: float) -> float:
        """Return the displacement of an obstacle near the bodies in a step [m]."""
        if motion is None:
            return 0.0
        return dt * float(lengths(_carried(motion, self.bodies.position, time, dt)).max())

    def _answer(self, pushes: np.ndarray) -> np.ndarray:
        """Return M^-1 times impulses, shape (n, q) both."""
        roots = self._roots()
        return np.asarray((roots @ (roots.swapaxes(1, 2) @ pushes[:, :, None]))[:, :, 0])

    def _roots(self) -> np.ndarray:
        """Return G with G G' the inverse mass of each body, shape (n, q, q)."""
        return self._all_roots()[0]

    def _all_roots(self) -> tuple[np.ndarray, np.ndarray]:
        """Return `_roots`, and the same with a zero matrix for obstacles.

        Shape (n + 1, q, q).
        """
        rotation = self.bodies.rotation
        if self._found_roots is None or not np.array_equal(self._found_roots[0], rotation):
            roots = np.zeros((len(self.bodies), 6, 6))
            roots[:, AXES, AXES] = 1.0 / np.sqrt(self.bodies.mass)[:, None]
            roots[:, 3:, 3:] = rotation @ self._roots_of_inertias
            roots = roots if self.dimension == 3 else roots[:, PLANAR][:, :, PLANAR]
            self._found_roots = (
                rotation.copy(),
                roots,
                np.concatenate([roots, np.zeros((1, *roots.shape[1:]))]),
            )
        return self._found_roots[1:]

    def _velocities(self) -> np.ndarray:
        six = self.bodies.velocities()
        return six if self.dimension == 3 else six[:, PLANAR]


def _rows(arms: np.ndarray, frames: np.ndarray, dimension: int) -> np.ndarray:
    """Return rows that map a body's velocities to those of points along frames.

    `arms` lead from the body's center to the points; shape (k, dimension, q).
    """
    both = np.concatenate([frames, cross(arms[:, None], frames)], axis=2)
    return both if dimension == 3 else both[:, :, PLANAR]


def _carried(motion: Motion, points: np.ndarray, time: float, dt: float) -> np.ndarray:
    """Return the mean velocities of points fixed to a solid in a step.

    [m/s], shape (k, 3).
    """
    way = motion.pose(time + dt).after(motion.pose(time).inverse())
    return np.asarray((way.apply(points) - points) / dt)
