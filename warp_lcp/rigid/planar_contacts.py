"""Native contact search and solve for a few bodies in a plane.

The results are those of `ContactDetection` and `ContactSolve.assembled`, equal in bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.host_kernel import HostKernel
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.rigid.box_contacts import FACE_FIRST, PARALLEL
from warp_lcp.rigid.contact_detection import (
    FLAT,
    LEVEL,
    LOWER,
    MORE,
    MOST,
    MUCH_LOWER,
    OTHER_SIDE,
    SAME,
    ContactDetection,
    ContactPoints,
    DetectedContacts,
)
from warp_lcp.rigid.contact_problem import YIELDS
from warp_lcp.rigid.contact_shape import ON_SURFACE
from warp_lcp.rigid.contacts import SAME_PLACE, Contacts
from warp_lcp.rigid.obstacles import Obstacle
from warp_lcp.rigid.supported_contacts import BEARS

# Factor on the displacement by velocities and gravity in a step, since the impulses of a material
# are not known before its solve.
AHEAD = 2.0
FEW = 64  # bodies: with more, pairs are found by sorting
WIDTHS = (1, 1, 1, 3, 3, 1, 6, 6, 6, 2, 1, 1, 1, 1)  # numbers of a contact, field by field
FIND = HostKernel(
    KernelFile(Path(__file__).parent / "headers/planar_contacts.h")[
        "warp_lcp.rigid.planar_contacts.find"
    ],
    AHEAD=AHEAD,
    ON_SURFACE=ON_SURFACE,
    PARALLEL=PARALLEL,
    FACE_FIRST=FACE_FIRST,
    LOWER=LOWER,
    MUCH_LOWER=MUCH_LOWER,
    LEVEL=LEVEL,
    SAME=SAME,
    OTHER_SIDE=OTHER_SIDE,
    FLAT=FLAT[2],
    MORE=MORE,
    MOST_OF_PAIR=MOST[2],
)
SLOP = 1e-5  # relative to a body's size: overlap that is not corrected
RATE = 0.3  # fraction of a larger overlap that a step removes
# Criteria for overlaps, which take several steps anyway.
ROUGH = StoppingCriteria(rtol=1e-2, max_iterations=30)
PUSH = HostKernel(
    KernelFile(Path(__file__).parent / "headers/contact_impulses.h")[
        "warp_lcp.rigid.planar_impulses.push"
    ],
    YIELDS=YIELDS,
    SAME_PLACE=SAME_PLACE,
    SLOP=SLOP,
    BEARS=BEARS,
    RATE=RATE,
    ROUGH_RTOL=ROUGH.rtol,
    ROUGH_MOST=ROUGH.max_iterations,
)


@dataclass(frozen=True, eq=False)
class PlanarImpulses:
    """Result of a push, with the values that the rest of a step needs.

    Args:
        contacts: contacts of the step.
        impulses: impulses of the contacts [N s], shape (k, 2).
        residual: the largest residual of an island, relative to that of no impulses.
        iterations: the most iterations of an island.
        dt: length of the step [s].
        values: values of the bodies after the push.
        ways: displacements that reduce overlaps at the end of the step (m, rad), shape (n, 3); None
            if no contact will overlap by more than `SLOP`.
        memory: rows for a `ContactMemory`, shape (k, 8).
        squares: G'J'JG of the rows J that support a body against walls and solids, and the diagonal
            of the root G of its inverse mass, by body; None if supported bodies touch others.
    """

    contacts: Contacts
    impulses: np.ndarray
    residual: float
    iterations: int
    dt: float
    values: np.ndarray
    ways: np.ndarray | None
    memory: np.ndarray
    squares: dict[int, tuple[np.ndarray, np.ndarray]] | None


class PlanarContacts:
    """Contact search for a few boxes, discs and capsules in a plane.

    Args:
        detection: detection of the bodies' contacts, for which `holds` is true.
        reach: largest distance of each body's points from its center of mass [m], shape (n,).
    """

    def __init__(self, detection: ContactDetection, reach: np.ndarray) -> None:
        self.bodies, self.obstacles = detection.bodies, detection.obstacles
        bodies, shapes = self.bodies, detection.shapes
        middle = [0.5 * (shape.low + shape.high) for shape in shapes]
        half = [0.5 * (shape.high - shape.low) - shape.radius for shape in shapes]
        of_bodies = [[body.friction for body in bodies], [body.restitution for body in bodies]]
        of_shapes = [shape.numbers for shape in shapes]
        fixed: tuple[Any, ...] = (
            bodies.mass,
            bodies.inverse_inertia,
            bodies.center,
            middle,
            half,
            reach,
            *of_bodies,
            of_shapes,
        )
        self._fixed = np.concatenate([np.ravel(of) for of in fixed])
        self._planes = np.array(
            [len(obstacle.points) if obstacle.shape is None else -1 for obstacle in self.obstacles],
            dtype=np.int32,
        )
        self.still = all(obstacle.motion is None for obstacle in self.obstacles)
        self._standing = [
            self._placed(obstacle, 0.0) if obstacle.motion is None else None
            for obstacle in self.obstacles
        ]
        # The obstacles if all are at rest, and the margin around them.
        self._around: tuple[float, np.ndarray] | None = None
        self._capacity = 8 * (len(shapes) + 8)  # contacts
        self._masses = np.concatenate(
            [
                np.ravel(of)
                for of in (
                    bodies.mass,
                    bodies.inverse_inertia,
                    np.linalg.cholesky(bodies.inverse_inertia),
                )
            ]
        )

    @staticmethod
    def holds(detection: ContactDetection) -> bool:
        """Return whether these bodies and obstacles are supported."""
        shapes = (
            *detection.shapes,
            *(obstacle.shape for obstacle in detection.obstacles if obstacle.shape is not None),
        )
        return (
            detection.dimension == 2
            and not detection.every
            and len(detection.shapes) <= FEW
            and all(s.numbers is not None for s in shapes)
        )

    @staticmethod
    def _placed(obstacle: Obstacle, time: float) -> np.ndarray:
        """Return the kernel's numbers of an obstacle, without its margin.

        Planes have their points and normals in the world; a shape has its own numbers, the pose,
        and the center and the half size |R| h of the box around it [m].
        """
        pose, shape = obstacle.pose(time), obstacle.shape
        if shape is None:
            return np.concatenate(
                [pose.apply(obstacle.points).ravel(), (obstacle.normals @ pose.rotation.T).ravel()]
            )
        reach = np.abs(pose.rotation) @ (0.5 * (shape.high - shape.low))
        of_pose = [
            pose.rotation.ravel(),
            pose.translation,
            pose.apply(0.5 * (shape.low + shape.high)),
            reach,
        ]
        return np.concatenate([shape.numbers, *of_pose])

    def _obstacles(self, time: float, margins: Sequence[float]) -> np.ndarray:
        """Return the kernel's numbers of all obstacles.

        Each with the gap up to which a body at rest touches it [m].
        """
        if self.still and self._around is not None and self._around[0] == margins[0]:
            return self._around[1]
        placed = [
            self._placed(o, time) if of is None else of
            for o, of in zip(self.obstacles, self._standing, strict=True)
        ]
        rows = np.concatenate(
            [part for margin, of in zip(margins, placed, strict=True) for part in ((margin,), of)]
            or [np.zeros(0)]
        )
        if self.still and len(margins):
            self._around = margins[0], rows
        return rows

    def find(
        self, time: float, dt: float, falls: float, near: float, brought: Sequence[float]
    ) -> tuple[DetectedContacts, Contacts] | None:
        """Return the contacts, and the same with rows for obstacles at rest.

        Args:
            time: time of the state [s].
            dt: time step [s].
            falls: speed that gravity adds in a step [m/s].
            near: gap up to which bodies at rest touch each other [m].
            brought: largest displacement of each obstacle [m].

        Returns:
            The contacts; None if this search does not support them.
        """
        n, capacity = len(self.bodies), self._capacity
        obstacles = self._obstacles(time, [near + way for way in brought])
        state = (self.bodies.values, self._fixed, obstacles)
        sizes = {
            "count": n,
            "obstacles": len(self.obstacles),
            "length_of_obstacles": len(obstacles),
            "capacity": capacity,
        }
        reals, (total,) = FIND.run(
            state,
            (self._planes,),
            work=10 * n + sum(WIDTHS) * capacity,
            dt=dt,
            falls=falls,
            near=near,
            **sizes,
        )
        k, begin = int(total[0]), 103 * n + len(obstacles) + 10 * n
        if k < 0:
            return None
        fields = []
        for width in WIDTHS:
            fields.append(reals[begin : begin + width * k].copy())
            begin += width * capacity
        first, second, which = (field.astype(np.int64) for field in fields[:3])
        point, normal, gap = fields[3].reshape(k, 3), fields[4].reshape(k, 3), fields[5]
        frames = fields[6].reshape(k, 2, 3)
        # In the memory order of `ContactSolve.assembled`, on which the summation order of BLAS
        # depends.
        one, other = (
            np.ascontiguousarray(rows.reshape(k, 2, 3).transpose(2, 0, 1)).transpose(1, 2, 0)
            for rows in fields[7:9]
        )
        wall, target, friction, restitution, size = fields[9].reshape(k, 2), *fields[10:]
        found = DetectedContacts(first, second, which, ContactPoints(point, normal, gap))
        return found, Contacts(
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
            restitution,
            np.zeros(k),
        )

    def push(
        self,
        contacts: Contacts,
        before: np.ndarray,
        resumed: bool,
        stopping: StoppingCriteria,
        unsolved: float,
        dt: float,
    ) -> PlanarImpulses | None:
        """Push the bodies apart by nonlinear conjugate gradients on sweeps.

        Args:
            contacts: contacts of the step.
            before: initial impulses [N s], shape (k, 2), if `resumed`; else those of a
                `ContactMemory`, shape (m, 8).
            resumed: see `before`.
            stopping: criteria of NNCG.
            unsolved: largest residual for which the impulses are applied.
            dt: length of the step [s].

        Returns:
            The result; None if the residual is larger, and then the bodies are unchanged.
        """
        c, n, k = contacts, len(self.bodies), len(contacts)
        of_contacts = (
            c.point,
            c.frames,
            c.size,
            c.one,
            c.other,
            c.wall,
            c.target,
            c.friction,
            c.gap,
        )
        given, work = (
            (self.bodies.values, self._masses, *of_contacts, before),
            45 * k + 26 * (n + 1),
        )
        reals, (worst, iterations, deep, stacked) = PUSH.run(
            given,
            (c.first, c.second),
            work=work,
            places=5 * k + n + 2,
            count=n,
            contacts=k,
            old=0 if resumed else len(before),
            resumed=resumed,
            rtol=stopping.rtol,
            most=stopping.max_iterations,
            unsolved=unsolved,
            dt=dt,
        )
        if not worst[0] <= unsolved:
            return None
        values = reals[: 26 * n].reshape(n, 26).copy()
        self.bodies.values[:] = values
        begin = 45 * n + 27 * k + before.size
        ends = list(accumulate((begin, 2 * k, 8 * k, 9 * n, 3 * (n + 1), 3 * n, n)))
        impulses, memory, squares, roots, ways, holding = (
            reals[start:end].copy() for start, end in pairwise(ends)
        )
        active = np.flatnonzero(holding).tolist() if not stacked[0] else None
        of_body = (
            None
            if active is None
            else {
                i: (squares[9 * i : 9 * i + 9].reshape(3, 3), roots[3 * i : 3 * i + 3])
                for i in active
            }
        )
        apart = ways.reshape(n, 3) if deep[0] else None
        solved = impulses.reshape(k, 2), float(worst[0]), int(iterations[0])
        return PlanarImpulses(contacts, *solved, dt, values, apart, memory.reshape(k, 8), of_body)
