"""Complementarity problem of contacts with boxed Coulomb friction.

The bounds are affine in the normal impulses.

It is solved by `warp_lcp.solvers.nncg` on B = J J' + diag(e), whose rows live at bodies: a sweep costs the entries of J, not those of B,
and an island of bodies is solved by one thread in one launch. Contacts of a pile are so few that launches would take all of the time:
0.2 ms an iteration where the arithmetic takes 0.002 ms. Sweeps need about as many iterations as the ratio of masses that touch, times the
square of a stack's height; the rest is solved by sparse systems in `contact_newton`.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import warp as wp

from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.rigid.contact_newton import ContactNewton
from warp_lcp.rows import KernelFile, Rows
from warp_lcp.rows.memory import Scalar, rows_memory
from warp_lcp.rows.program import LaunchGraph

if TYPE_CHECKING:
    from warp_lcp.rigid.joints import JointRows

YIELDS = 1e-6  # of B, along tangents: how friction is shared between contacts then is unique, and rest creeps by 1e-7 m/s at most
MANY = 20_000  # sweeps, where nothing else helps
KERNELS = KernelFile(Path(__file__).parent / "headers/contact_nncg.h")
NNCG = KERNELS["warp_lcp.rigid.contacts.nncg"]


class ContactImpulses(NamedTuple):
    """Result of a contact solve.

    Attributes:
        impulses: [N s], shape (k, rows); where there are joints, these flat and then those of joints [N s, N m s], shape (k rows + m,).
        residual: the largest of an island, relative to that of no impulses.
        iterations: the most of an island: sweeps, and steps of Newton's methods.
    """

    impulses: np.ndarray
    residual: float
    iterations: int


@dataclass(frozen=True, eq=False)
class JointPart:
    """Joint rows of a contact problem: y = B x + b, lower <= x <= upper.

    Args:
        rows: as those of contacts, times a factor of the inverse masses.
        b: velocities without impulses, plus position correction [m/s, rad/s], shape (m,).
    """

    rows: JointRows
    b: np.ndarray


class SweepWorkspace(threading.local):
    """Arrays and recorded launch of the NNCG kernel; each Python thread has its own."""

    def __init__(self) -> None:
        self._room = [0, 0, 0]
        self._q, self._dim, self._contacts, self._rtol, self._most = (Scalar() for _ in range(5))
        self._islands = 0

    def run(
        self, fields: Sequence[np.ndarray], work: int, indices: Sequence[np.ndarray], shape: tuple[int, int, int],
        stopping: StoppingCriteria,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
        """Return impulses, shape (contacts, dim), and residuals and rounds of the islands.

        Args:
            fields: what `reals` of the kernel holds before its work, impulses to start from first.
            work: size of the kernel's work in `reals`.
            indices: what `indices` of the kernel holds, the islands' starts last.
            shape: number of contacts, of a contact's rows, and of a body's velocities.
            stopping: the tolerance and the most iterations.
        """
        contacts, dim, q = shape
        filled, numbers, islands = sum(f.size for f in fields), sum(map(len, indices)), len(indices[-1]) - 1
        self._reserve(filled + work, numbers, islands)
        np.concatenate([np.ravel(field) for field in fields], out=self._reals[:filled])
        self._reals[filled : filled + work] = 0.0
        np.concatenate(indices, out=self._indices[:numbers], casting="same_kind")
        self._q.value, self._dim.value, self._contacts.value = q, dim, contacts
        self._rtol.value, self._most.value = stopping.rtol, stopping.max_iterations
        self._residual[:islands] = self._rounds[:islands] = 0.0
        if islands != self._islands:
            self._islands = islands
            self._rows.take(Rows.entries(islands, self._device).single)
        self._graph.run()
        x = self._reals[: contacts * dim].reshape(contacts, dim)
        return x.copy(), self._residual[:islands].copy(), self._rounds[:islands].copy()

    def _launch(self) -> None:
        rows = replace(Rows.entries(self._islands, self._device), memory=self._rows)
        reals, indices, residual, rounds = self._arrays
        NNCG.bind(
            rows, reals=reals, indices=indices, residual=residual, rounds=rounds, q=self._q, dim=self._dim, contacts=self._contacts,
            rtol=self._rtol, most=self._most,
        ).launch()  # fmt: skip

    def _reserve(self, *sizes: int) -> None:
        if all(size <= room for size, room in zip(sizes, self._room, strict=True)):
            return
        reals, indices, islands = self._room = [max(2 * size, room) for size, room in zip(sizes, self._room, strict=True)]
        self._reals, self._indices = np.zeros(reals), np.zeros(indices, dtype=np.int32)
        self._residual, self._rounds = np.zeros(islands), np.zeros(islands)
        self._arrays = [_warp(values) for values in (self._reals, self._indices, self._residual, self._rounds)]
        self._device = wp.get_device("cpu")
        self._rows, self._islands = rows_memory(self._device), 0  # not before: an import must not start Warp
        self._graph = LaunchGraph(self._device, self._launch)


@dataclass(frozen=True, eq=False)
class ContactProblem:
    """Contact problem y = B x + b with x_n >= 0 and |x_t| <= mu x_n.

    The rows of each of the k contacts are its normal and its tangents.

    B = J J' + YIELDS diag(J J') along tangents, J = what velocities of bodies make at contacts, times a factor of the inverse masses.

    Args:
        first: body of each contact, shape (k,).
        second: the other one, `bodies` where it is none, shape (k,).
        one: rows of J for the first body, shape (k, rows, q).
        other: for the second, shape (k, rows, q).
        b: velocities without impulses, less those that are the least [m/s], shape (k, rows).
        friction: Coulomb's coefficient, shape (k,).
        bodies: their number.
        joints: further rows, which `solve` does not take; None: there are none.
    """

    first: np.ndarray
    second: np.ndarray
    one: np.ndarray
    other: np.ndarray
    b: np.ndarray
    friction: np.ndarray
    bodies: int
    joints: JointPart | None = None

    def at(self, b: np.ndarray) -> ContactProblem:
        """Return the problem of the same contacts with other velocities b.

        The sorted rows are taken over.
        """
        other = replace(self, b=b)
        other.__dict__["sorted_rows"] = self.sorted_rows
        return other

    @cached_property
    def sorted_rows(self) -> tuple[np.ndarray, ...]:
        """Rows of the contacts, sorted by islands.

        Order and starts as of `islands`; in that order J of both bodies, the diagonal of B besides J J', that of B, and the friction.
        """
        k, rows, _ = self.one.shape
        order, starts = self.islands()
        diagonal, yields = (values.reshape(k, rows)[order] for values in self.yields())
        J = np.concatenate([self.one[order], self.other[order]], axis=2)
        return order, starts, J, yields, diagonal, self.friction[order]

    def yields(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the diagonal of B and its part besides J J', shape (k rows,) each."""
        own = np.square(self.one).sum(axis=2) + np.square(self.other).sum(axis=2)
        more = YIELDS * own
        more[:, 0] = 0.0
        return (own + more).ravel(), more.ravel()

    def islands(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the contacts sorted by islands of touching bodies, and island starts."""
        pairs = self.second < self.bodies
        group = self.first
        if pairs.any():
            group = _components(self.first[pairs].tolist(), self.second[pairs].tolist(), self.bodies)[group]
        order = np.argsort(group, kind="stable")
        group = group[order]
        starts = np.flatnonzero(np.concatenate([group[:1] >= 0, group[1:] != group[:-1]]))  # where a group begins
        return order, np.append(starts, len(order))

    def part(self, contacts: np.ndarray) -> ContactProblem:
        """Return the problem of some contacts, with only their bodies."""
        first, second = self.first[contacts], self.second[contacts]
        bodies = np.unique(np.concatenate([first, second[second < self.bodies]]))
        number = np.full(self.bodies + 1, len(bodies))
        number[bodies] = np.arange(len(bodies))
        fields = (self.one[contacts], self.other[contacts], self.b[contacts], self.friction[contacts])
        return ContactProblem(number[first], number[second], *fields, len(bodies))

    def solve(self, stopping: StoppingCriteria, start: np.ndarray | None = None, unsolved: float = np.inf) -> ContactImpulses:
        """Return impulses, residual and number of iterations.

        An island that does not reach the tolerance is taken at its least residual, which says so.

        Args:
            stopping: of NNCG, of which `rtol` and `max_iterations` count.
            start: impulses to start from, shape (k, rows); none if None.
            unsolved: residual of an island above which Newton's methods go on, to `rtol`.

        Raises:
            ValueError: there are joints.
        """
        if self.joints is not None:
            raise ValueError("joints: the default solver (NNCG sweeps and Newton) handles only contacts; give RigidBodies another solver")
        k, rows, q = self.one.shape
        order, starts, J, *others = self.sorted_rows
        x = np.zeros((k, rows)) if start is None else start[order]
        fields = (x, J, self.b[order], *others)
        work, indices = 3 * k * rows + (self.bodies + 1) * q, (self.first[order], self.second[order], starts)
        x, residual, rounds = SWEEPS.run(fields, work, indices, (k, rows, q), stopping)
        for island in np.flatnonzero(residual > unsolved):
            mine = slice(starts[island], starts[island + 1])
            x[mine], residual[island], more = self.part(order[mine])._go_on(stopping.rtol, x[mine])
            rounds[island] += more
        result = np.empty((k, rows))
        result[order] = x
        return ContactImpulses(result, float(residual.max(initial=0.0)), int(rounds.max(initial=0.0)))

    def _go_on(self, rtol: float, x: np.ndarray) -> ContactImpulses:
        """Return better impulses than those that sweeps have found, their residual, and the iterations that they took.

        Active sets solve what rests, from what sweeps have left, in a few steps, interior points what they start too far from. Where a
        column topples and bodies hit each other these jam, and many sweeps come near enough for active sets.
        """
        newton = ContactNewton(self, x)
        newton.active_set(rtol)
        newton.interior_point(rtol)
        sweeps = 0
        if newton.residual > rtol:
            swept = self.solve(StoppingCriteria(rtol=rtol, max_iterations=MANY), newton.x.reshape(x.shape))
            newton.take(swept.impulses.ravel())
            newton.active_set(rtol)
            sweeps = swept.iterations
        return ContactImpulses(newton.x.reshape(x.shape), newton.residual, newton.steps + sweeps)


SWEEPS = SweepWorkspace()


def _components(first: list[int], second: list[int], bodies: int) -> np.ndarray:
    """Return for each body the least one that links to it through pairs of bodies, shape (bodies,)."""
    least = list(range(bodies))
    for pair in zip(first, second, strict=True):
        low, high = sorted(_root(least, body) for body in pair)
        least[high] = low
    return np.array([_root(least, body) for body in range(bodies)])


def _root(least: list[int], body: int) -> int:
    """Follow links to smaller bodies to their end, and shorten them."""
    end = body
    while least[end] != end:
        end = least[end]
    while least[body] != end:
        least[body], body = end, least[body]
    return end


def _warp(values: np.ndarray) -> wp.array[Any]:
    """Return contiguous values as Warp sees them, in the same memory."""
    return wp.array(values, dtype=wp.float64 if values.dtype == np.float64 else wp.int32, device="cpu", copy=False)
