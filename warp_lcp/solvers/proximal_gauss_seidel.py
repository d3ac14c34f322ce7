"""Proximal Gauss-Seidel sweeps over contacts with circular friction cones.

All contacts of a color are updated in parallel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import warp as wp

from warp_lcp.kernels import BoundKernel, KernelFile, Rows, StencilKernel
from warp_lcp.kernels.launch_graph import CommandBuffer, Launch, launch_now
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import Reduction, rows_of
from warp_lcp.problem.frictional_contact import FrictionalContact
from warp_lcp.problem.method_protocol import Precision, Step
from warp_lcp.settings import Count, Settings, Share

f64, i32 = wp.float64, wp.int32
KERNELS = KernelFile(Path(__file__).parent / "headers/proximal_gauss_seidel.h")
# Contacts of a task on the CPU, and the number of cells of a usual pass that cost as much as one.
GRAIN, COST = 32, 128
# Of the state: two squared changes, the factor of all r-factors, the squared residual.
FACTOR, LEFT, STATE = 2, 3, 4
BETTER = 0.9  # of the least residual: progress
LEAST = 0.05  # of the first r-factors


@cache
def passes(dim: int, q: int) -> SimpleNamespace:
    """Return the kernels for contacts of `dim` rows and bodies of q velocities."""
    module, constants = (
        f"warp_lcp.proximal_gauss_seidel_{dim}_{q}",
        {"DIM": dim, "Q": q, "FACTOR": FACTOR},
    )
    names = ("sweep", "residual", "gather")
    return SimpleNamespace(
        **{
            name: KERNELS.kernel(
                f"warp_lcp.proximal_gauss_seidel.{name}", module=module, constants=constants
            )
            for name in names
        }
    )


CARRY = KERNELS["proximal_gauss_seidel.carry"]
FOLLOW = KERNELS["proximal_gauss_seidel.follow"]


@dataclass(frozen=True, kw_only=True)
class ProximalGaussSeidel(Settings):
    """Gauss-Seidel sweeps of proximal maps: contacts with circular friction cones.

    [Book] 1.1.4, 1.3.5; Erleben 2017.

    A sweep updates each contact once, with the velocities after the updates before it:

        r_n <- max(0, r_n - rho_n u_n),
        r_t <- the nearest point of |r_t| <= mu r_n to r_t - rho_t u_t,

    with r-factors rho_n = 1 / B_nn and rho_t = 1 / (the largest eigenvalue of B_tt) of the
    contact's own block of B = J J' + diag(e); for spheres that solves it exactly. B is not
    assembled: bodies store w = J'r, and a contact changes that of its two bodies. Contacts that
    share no body have one color and are updated in parallel, by all threads or a GPU; their order,
    and every bit of the result, depends on the contacts alone.

    Sweeps are accelerated as `NNCG` accelerates them, by g = r - sweep(r), beta = |g|^2 /
    |g_old|^2, r <- r + beta p, p <- beta p - g, and p <- 0 where beta > 1 [Silcowitz-Hansen et al.
    2010]; the residual is that after a sweep, where r is in its cones. Where it has stayed above
    0.9 of its least for `wait` sweeps, as in a cycle of sweeps, all r-factors shrink, down to a
    twentieth. There is no proof of convergence for mu > 0. The residual, recomputed in float64 from
    r alone, is that of `FrictionalContact.residual`.

    Args:
        accelerate: whether sweeps are accelerated; plain ones took more than three times as many
            for 1,000 spheres in a box.
        check_every: sweeps between evaluations of the residual; a step of the method, so that
            limits are met in multiples of it.
        wait: sweeps without progress after which r-factors shrink.
        shrink: factor by which they shrink.
    """

    problems: ClassVar = FrictionalContact
    needs: ClassVar[str] = "contacts of bodies, a FrictionalContact"

    accelerate: bool = True
    check_every: Count = 8
    wait: Count = 200
    shrink: Share = 0.7

    def init(self, problem: FrictionalContact) -> ContactWorkspace:
        """Return a workspace: contacts by color, and recorded sweeps."""
        return ContactWorkspace(problem, self)

    def step(self, problem: FrictionalContact, work: ContactWorkspace, x: DeviceArray) -> Step:
        """Sweep `check_every` times."""
        work.sweep()
        return Step("sweep", self.check_every, iterations=self.check_every)


@dataclass(frozen=True, slots=True)
class ContactFields:
    """Contacts in the order of their colors, and their impulses.

    Attributes:
        J: rows of both bodies of each contact, shape (k dim 2 q,).
        b: relative velocity without impulses, shape (k dim,).
        e: compliance of each row, shape (k dim,).
        laws: mu, both r-factors and the residual's scale of each contact, shape (4 k,).
        contact: number of each contact in the problem, int32, shape (k,).
        one: first body of each contact, int32, shape (k,).
        other: second body of each contact, int32, shape (k,).
        w: J'r of each body, shape ((bodies + 1) q,).
        r: impulses as the problem numbers contacts, shape (k dim,).
    """

    J: DeviceArray
    b: DeviceArray
    e: DeviceArray
    laws: DeviceArray
    contact: DeviceArray
    one: DeviceArray
    other: DeviceArray
    w: DeviceArray
    r: DeviceArray


class ContactWorkspace:
    """Workspace of the method: impulses and body velocities.

    Contacts are stored in the order of their colors.

    Args:
        problem: the contacts.
        method: the method.

    Attributes:
        x: impulses in the problem's numbering, shape (k, dim).
        order: contacts color by color.
        starts: where each color begins, and the end.
        norm, current: of the residual, as `wl.solve` reads them.
    """

    precision = Precision.DOUBLE

    def __init__(self, problem: FrictionalContact, method: ProximalGaussSeidel) -> None:
        self.problem, self.method, self.residual = problem, method, self
        self.norm, self.current, device = np.inf, False, problem.device
        k, dim, q = problem.one.shape
        self.order, self.starts = colors(problem.first, problem.second, problem.bodies)
        self.x, self._best = (wp.zeros((k, dim), dtype=f64, device=device) for _ in range(2))
        self._g, self._way = (wp.zeros(k * dim, dtype=f64, device=device) for _ in range(2))
        self._w, self._before, self._turn = (
            wp.zeros((problem.bodies + 1) * q, dtype=f64, device=device) for _ in range(3)
        )
        self._state = wp.zeros(STATE, dtype=f64, device=device)
        self._fields, self._passes = self._contacts(), passes(dim, q)
        self._changes = Reduction(k * dim, device, self._state)
        every = self._rows(0, k)
        self._squares = Reduction(k, device, self._state, threads=max(every.places, 1))
        self._gather = self._gather_kernel()
        self._left = self._passes.residual.bind(every, self._fields, out=self._squares.partials)
        self._program = CommandBuffer(device)
        for count in range(method.check_every):
            self._record(count % 2)
        self._compute_residual(self._program.launch)

    def _contacts(self) -> ContactFields:
        """Return the contacts in the layout of the kernels, color by color.

        The r-factors are rho_n = 1 / B_nn and rho_t = 1 / (largest eigenvalue of B_tt), with
        B_tt = J_t J_t' + diag(e_t) over both bodies; the scale of a contact's residual is the mean
        diagonal of B.
        """
        p, order = self.problem, self.order
        k, dim, _ = p.one.shape
        J, diagonal = np.concatenate([p.one[order], p.other[order]], axis=2), p.diagonal[order]
        own = J[:, 1:] @ J[:, 1:].swapaxes(1, 2) + p.yields[order][:, 1:, None] * np.eye(dim - 1)
        largest = np.linalg.eigvalsh(own)[:, -1] if dim > 1 else np.ones(k)
        laws = np.column_stack(
            [p.friction[order], 1.0 / diagonal[:, 0], 1.0 / largest, diagonal.mean(axis=1)]
        )
        reals = J, p.b[order], p.yields[order], laws
        rows, b, e, laws_ = (
            wp.array(np.ascontiguousarray(v).ravel(), dtype=f64, device=p.device) for v in reals
        )
        numbers = order, p.first[order], p.second[order]
        contact, one, other = (
            wp.array(v.astype(np.int32), dtype=i32, device=p.device) for v in numbers
        )
        return ContactFields(rows, b, e, laws_, contact, one, other, self._w, self.x.flatten())

    def _gather_kernel(self) -> BoundKernel:
        """Return the kernel that computes w = J'r body by body."""
        p, fields = self.problem, self._fields
        both = np.stack([p.first[self.order], p.second[self.order]], axis=1).ravel()
        sides = np.argsort(both, kind="stable")[: np.count_nonzero(both < p.bodies)]
        starts = np.searchsorted(both[sides], np.arange(p.bodies + 1))
        first, listed = (
            wp.array(v.astype(np.int32), dtype=i32, device=p.device) for v in (starts, sides)
        )
        gather: StencilKernel = self._passes.gather
        return gather.bind(self._rows(0, p.bodies), fields, starts=first, sides=listed)

    def _rows(self, begin: int, end: int) -> Rows:
        """Return the contacts, or bodies, begin <= s < end."""
        device = self.problem.device
        made = Rows.box((0, 0, begin), (1, 1, end), device, cells=None if device.is_cuda else GRAIN)
        return replace(made, weight=COST)

    def _record(self, now: int) -> None:
        """Record a sweep, after a move along the last direction.

        `now` and 1 - now are the slots of the last squared change and of the one before.
        """
        launch, fields, state = self._program.launch, self._fields, self._state
        if self.method.accelerate:
            CARRY.bind(
                rows_of(self._g), g=self._g, r=fields.r, way=self._way, state=state, now=now
            ).launch(launch)
            FOLLOW.bind(
                rows_of(self._w),
                w=self._w,
                before=self._before,
                way=self._turn,
                state=state,
                now=now,
            ).launch(launch)
        for begin, end in zip(self.starts[:-1].tolist(), self.starts[1:].tolist(), strict=True):
            rows, bodies = self._rows(begin, end), self.problem.bodies
            self._passes.sweep.bind(rows, fields, g=self._g, state=state, bodies=bodies).launch(
                launch
            )
        if self.method.accelerate:
            self._changes.dot(self._g, self._g, 1 - now, launch=launch)

    def _compute_residual(self, launch: Launch = launch_now) -> None:
        """Compute w and the squared residual from the impulses alone."""
        self._gather.launch(launch)
        self._left.launch(launch)
        self._squares.add_up(LEFT, launch=launch)

    def _read(self) -> float:
        self.norm, self.current = float(np.sqrt(self._state.numpy()[LEFT])), True
        return self.norm

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Reset the directions and r-factors of the last solve."""
        self._factor, self._least, self._idle = 1.0, self.norm, 0
        self._set_off()

    def _set_off(self) -> None:
        """Write the r-factors to the device, and reset the direction."""
        self._state.assign([0.0, 0.0, self._factor, 0.0])
        for field in (self._g, self._way, self._turn):
            field.zero_()
        wp.copy(self._before, self._w)

    def sweep(self) -> None:
        """Sweep, read the residual, and shrink r-factors where it makes no progress."""
        # The program reads the last squared change from the same slot.
        if self.method.accelerate and self.method.check_every % 2:
            self._swap()
        self._program.run()
        if self._read() < BETTER * self._least:
            self._least, self._idle = self.norm, 0
            return
        self._idle += self.method.check_every
        if self._idle >= self.method.wait and self._factor > LEAST:
            self._factor, self._idle = max(self.method.shrink * self._factor, LEAST), 0
            self._set_off()

    def _swap(self) -> None:
        state = self._state.numpy().copy()
        self._state.assign(state[[1, 0, FACTOR, LEFT]])

    def evaluate(self, x: DeviceArray) -> float:
        """Return the residual's norm at x, recomputed in float64 from x alone."""
        self._compute_residual()
        return self._read()

    def rounding_floor(self, x: DeviceArray, epsilon: float) -> float:
        """Return the rounding floor of the residual: epsilon (|J| |J|' |r| + |b|)."""
        J, r = abs(self.problem.jacobian), np.abs(x.numpy()).ravel()
        return float(epsilon * np.linalg.norm(J @ (J.T @ r) + np.abs(self.problem.b.ravel())))

    def keep(self) -> None:
        """Store the impulses as the best ones."""
        wp.copy(self._best, self.x)

    def restore(self) -> None:
        """Set the impulses to the best ones."""
        wp.copy(self.x, self._best)


def colors(first: np.ndarray, second: np.ndarray, bodies: int) -> tuple[np.ndarray, np.ndarray]:
    """Return contacts color by color, and where each color begins.

    The starts include the end. Each contact has the first color that its two bodies do not have
    yet, so that there are fewer colors than twice the largest number of contacts of a body.

    Args:
        first: body of each contact, shape (k,).
        second: the other body, `bodies` if there is none.
        bodies: their number.
    """
    colors_of_body, color = [0] * (bodies + 1), np.empty(len(first), dtype=np.int64)
    for k, (i, j) in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
        both = colors_of_body[i] | colors_of_body[j]
        free = ~both & (both + 1)  # the lowest bit that neither has
        color[k] = free.bit_length() - 1
        colors_of_body[i] |= free
        if j < bodies:
            colors_of_body[j] |= free
    order = np.argsort(color, kind="stable")
    return order, np.searchsorted(color[order], np.arange(color.max(initial=-1) + 2))
