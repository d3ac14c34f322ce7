"""Complementarity problem of contacts with boxed Coulomb friction.

The bounds are affine in the normal impulses.

The problem is solved by the method of `warp_lcp.solvers.nncg` on B = J J' + diag(e), in a separate
loop (`headers/contact_impulses.h`) with the same formula of beta (`snippets.h`). It differs in
three ways: rows are products with J at bodies, so that a sweep costs the entries of J, not those of
B; contacts are swept in their order, not by colors; and an island of bodies is solved by one thread
in one launch, which evaluates the residual every 8 sweeps. `wl.NNCG` on the assembled B takes 390,
510 and 890 us an iteration with 20, 200 and 1,000 contacts, this loop 2.6, 26 and 110 us. The
number of sweeps is about the ratio of masses in contact, times the square of a stack's height;
harder problems are solved by sparse systems in `contact_newton`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.host_kernel import HostKernel
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.rigid.contact_newton import ContactNewton

if TYPE_CHECKING:
    from warp_lcp.rigid.joints import JointRows

# Relative to the diagonal of B, along tangents: makes the distribution of friction over contacts
# unique. Bodies at rest creep by 1e-7 m/s at most.
YIELDS = 1e-6
MANY = 20_000  # sweeps, if no other method converges
KERNELS = KernelFile(Path(__file__).parent / "headers/contact_impulses.h")
NNCG = KERNELS["warp_lcp.rigid.contacts.nncg"]


class ContactImpulses(NamedTuple):
    """Result of a contact solve.

    Attributes:
        impulses: [N s], shape (k, rows); with joints a flat array that ends with those of the
            joints [N s, N m s], shape (k rows + m,).
        residual: the largest residual of an island, relative to that of no impulses.
        iterations: the most iterations of an island: sweeps, and steps of Newton's methods.
    """

    impulses: np.ndarray
    residual: float
    iterations: int


@dataclass(frozen=True, eq=False)
class JointPart:
    """Joint rows of a contact problem: y = B x + b, lower <= x <= upper.

    Args:
        rows: in the format of contact rows: J times a factor of the inverse masses.
        b: velocities without impulses, plus position correction [m/s, rad/s], shape (m,).
    """

    rows: JointRows
    b: np.ndarray


@dataclass(frozen=True, eq=False)
class ContactProblem:
    """Contact problem y = B x + b with x_n >= 0 and |x_t| <= mu x_n.

    The rows of each of the k contacts are its normal and its tangents. B = J J' + YIELDS diag(J J')
    along tangents. J maps the bodies' velocities to those at contacts, and is multiplied by a
    factor of the inverse masses.

    Args:
        first: body of each contact, shape (k,).
        second: the other body, or `bodies` for an obstacle, shape (k,).
        one: rows of J for the first body, shape (k, rows, q).
        other: rows of J for the second body, shape (k, rows, q).
        b: velocities without impulses, less the smallest allowed ones [m/s], shape (k, rows).
        friction: Coulomb's coefficient, shape (k,).
        bodies: number of bodies.
        joints: rows of joints, which `solve` does not support; None without joints.
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

        The sorted rows are shared.
        """
        other = replace(self, b=b)
        other.__dict__["sorted_rows"] = self.sorted_rows
        return other

    @cached_property
    def sorted_rows(self) -> tuple[np.ndarray, ...]:
        """Rows of the contacts, sorted by islands.

        Order and starts as of `islands`; in that order J of both bodies, the diagonal of B besides
        J J', the diagonal of B, and the friction.
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
            group = _components(
                self.first[pairs].tolist(), self.second[pairs].tolist(), self.bodies
            )[group]
        order = np.argsort(group, kind="stable")
        group = group[order]
        # First contact of each group.
        starts = np.flatnonzero(np.concatenate([group[:1] >= 0, group[1:] != group[:-1]]))
        return order, np.append(starts, len(order))

    def part(self, contacts: np.ndarray) -> ContactProblem:
        """Return the problem of some contacts, with only their bodies."""
        first, second = self.first[contacts], self.second[contacts]
        bodies = np.unique(np.concatenate([first, second[second < self.bodies]]))
        number = np.full(self.bodies + 1, len(bodies))
        number[bodies] = np.arange(len(bodies))
        fields = (
            self.one[contacts],
            self.other[contacts],
            self.b[contacts],
            self.friction[contacts],
        )
        return ContactProblem(number[first], number[second], *fields, len(bodies))

    def solve(
        self, stopping: StoppingCriteria, start: np.ndarray | None = None, unsolved: float = np.inf
    ) -> ContactImpulses:
        """Return impulses, residual and number of iterations.

        For an island that misses the tolerance, the impulses with the least residual are returned,
        and the residual tells.

        Args:
            stopping: criteria of NNCG; only `rtol` and `max_iterations` are used.
            start: initial impulses, shape (k, rows); 0 if None.
            unsolved: residual of an island above which Newton's methods continue, to `rtol`.

        Raises:
            ValueError: the problem has joints.
        """
        if self.joints is not None:
            raise ValueError(
                "joints: the default solver (NNCG sweeps and Newton) handles only contacts; give "
                "RigidBodies another solver"
            )
        k, rows, q = self.one.shape
        order, starts, J, *others = self.sorted_rows
        x = np.zeros((k, rows)) if start is None else start[order]
        fields = (x, J, self.b[order], *others)
        work, indices = (
            np.zeros(3 * k * rows + (self.bodies + 1) * q),
            (self.first[order], self.second[order], starts),
        )
        sizes = {"tasks": len(starts) - 1, "q": q, "dim": rows, "contacts": k}
        reals, found = SWEEPS.run(
            (*fields, work), indices, **sizes, rtol=stopping.rtol, most=stopping.max_iterations
        )
        x, residual, rounds = (
            reals[: k * rows].reshape(k, rows).copy(),
            *(field.copy() for field in found),
        )
        for island in np.flatnonzero(residual > unsolved):
            mine = slice(starts[island], starts[island + 1])
            x[mine], residual[island], more = self.part(order[mine])._improve_by_newton(
                stopping.rtol, x[mine]
            )
            rounds[island] += more
        result = np.empty((k, rows))
        result[order] = x
        return ContactImpulses(
            result, float(residual.max(initial=0.0)), int(rounds.max(initial=0.0))
        )

    def _improve_by_newton(self, rtol: float, x: np.ndarray) -> ContactImpulses:
        """Improve the impulses of the sweeps by Newton's methods.

        Active sets solve contacts at rest in a few steps, starting from the sweeps. Interior points
        solve problems with a distant start. Both stall where a column topples and bodies hit each
        other; then many sweeps come close enough for active sets.
        """
        newton = ContactNewton(self, x)
        newton.active_set(rtol)
        newton.interior_point(rtol)
        sweeps = 0
        if newton.residual > rtol:
            swept = self.solve(
                StoppingCriteria(rtol=rtol, max_iterations=MANY), newton.x.reshape(x.shape)
            )
            newton.evaluate(swept.impulses.ravel())
            newton.active_set(rtol)
            sweeps = swept.iterations
        return ContactImpulses(newton.x.reshape(x.shape), newton.residual, newton.steps + sweeps)


SWEEPS = HostKernel(NNCG)


def _components(first: list[int], second: list[int], bodies: int) -> np.ndarray:
    """Return the least body of each body's component, shape (bodies,).

    Components are those of the graph of pairs.
    """
    least = list(range(bodies))
    for pair in zip(first, second, strict=True):
        low, high = sorted(_root(least, body) for body in pair)
        least[high] = low
    return np.array([_root(least, body) for body in range(bodies)])


def _root(least: list[int], body: int) -> int:
    """Return the root of a body, with path compression (union-find)."""
    end = body
    while least[end] != end:
        end = least[end]
    while least[body] != end:
        least[body], body = end, least[body]
    return end
