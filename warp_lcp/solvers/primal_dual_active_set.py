"""Primal-dual active set method with detection of cycles.

It is Newton's method on the minimum map with full steps.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import warp as wp

from warp_lcp.deadline import time_is_up
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.operators.dense import DenseOperator
from warp_lcp.problem.bounds import INFINITE, Bounds
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import Step
from warp_lcp.problem.operator_protocol import HasRows, HasScale, has
from warp_lcp.problem.result import SolveStatus
from warp_lcp.settings import Share
from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton, NewtonWorkspace
from warp_lcp.subproblems.active_set_kernels import projected_move
from warp_lcp.subproblems.correction_system import CorrectionSystem
from warp_lcp.subproblems.dense_problem import DenseProblem, pivots_of
from warp_lcp.subproblems.reduced_system import NewtonSettings

LOWER, FREE, UPPER = -1, 0, 1  # places of an unknown in least-index pivoting
STUCK = 2  # steps on one set that do not reduce the residual: its free block is singular
PIVOTS = 50  # least-index pivots per unknown after which A counts as no P-matrix
# Growth of the residual beyond that of whole steps on regular blocks (5e5 on a grid of 1000^2).
BLOWN = 1e7
SLACK = 1e-12  # relative to the largest |x| and |y|: smaller violations are rounding


@dataclass(frozen=True, kw_only=True)
class PrimalDualActiveSet(NewtonSettings):
    """Primal-dual active set method (Hintermueller, Ito, Kunisch 2003).

    It guesses the active set from x and y, solves for the rest, and repeats until the guess stays.

    With the natural residual's d, unknown i is held at l_i if x_i - y_i / d_i < l_i, at u_i if it
    is above u_i, else it is free: y_i = 0. This is MinimumMapNewton's step without search or
    projection, and shares its implementation. If A is an M-matrix, the method ends after finitely
    many steps from any start; on other P-matrices it may cycle. If a set recurs without a smaller
    residual, dense problems continue by least-index principal pivoting (Murty 1974; with bounds
    Judice and Pires), which is finite for every P-matrix but may be slow; others end with
    STAGNATED.

    A solve also ends with STAGNATED where a free block is singular, which never occurs in a
    P-matrix: the set stays while the residual does not fall, the residual grows by 1e7, or the
    block's condition number exceeds 1e12. After a cold start on a grid, the first steps are
    projected multigrid cycles.

    `linear_iterations` counts as in MinimumMapNewton; a least-index pivot counts one.

    Args:
        precision: "mixed": iterate float64, corrections float32; "double"; or "single": the iterate
            rounded to float32 as well. Dense problems are solved in float64.
        monotone_cycles: projected cycles of a cold start on a grid; see MinimumMapNewton for sparse
            matrices.
        eta: each linear solve reduces its residual by this factor, or to the accuracy that the
            whole solve still needs.
        max_linear_iterations: maximum number of conjugate-gradient iterations of one step.
        cycle: settings of multigrid cycles.
        stop_if_singular: end with STAGNATED where a free block is singular; False: pivot on by
            least squares, for matrices that only rounding makes singular.
    """

    needs: ClassVar[str] = "M-matrix, or P-matrix where dense"
    definite: ClassVar[bool] = True
    preconditioned: ClassVar[bool] = True

    eta: Share = 0.01
    stop_if_singular: bool = True

    def as_newton(self) -> MinimumMapNewton:
        """Return the MinimumMapNewton method for operators that are not dense."""
        return MinimumMapNewton(
            **{name: value for name, value in vars(self).items() if name != "stop_if_singular"}
        )

    def init(self, problem: LCP) -> ActiveSetWorkspace:
        """Return a workspace.

        Raises:
            ValueError: as in MinimumMapNewton.
        """
        return ActiveSetWorkspace(problem, self.as_newton(), stop_if_singular=self.stop_if_singular)

    def step(self, problem: LCP, work: ActiveSetWorkspace, x: DeviceArray) -> Step:
        """Take a monotone cycle after a cold start, then full steps.

        Least-index pivots follow a recurring set.
        """
        return work.step()


class ActiveSetWorkspace(NewtonWorkspace):
    """Workspace of the method for one problem.

    Attributes:
        places: LOWER, FREE or UPPER of each unknown in least-index pivoting; None before the first
            cycle.
        cycled: whether a set has recurred.
        first: the residual's norm before the first step.
    """

    system: CorrectionSystem
    places: np.ndarray | None = None

    def __init__(self, problem: LCP, settings: MinimumMapNewton, *, stop_if_singular: bool) -> None:
        super().__init__(problem, settings, CorrectionSystem(problem, settings))
        self._stops, self._watched = (
            stop_if_singular,
            stop_if_singular and has(problem.A, HasRows) and has(problem.A, HasScale),
        )

    def start(
        self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None
    ) -> None:
        """Reset the sets; the operator may have changed."""
        super().start(warm=warm, tolerance=tolerance, floating=floating)
        self._target = tolerance
        self._seen: dict[bytes, float] = {}  # residual norms by fingerprint of the active set
        self._last, self._moved, self._stuck, self._pivots = b"", True, 0, 0
        self.cycled, self.places, self.first = False, None, 0.0
        self._unbounded = Bounds(self.problem.layout, *INFINITE).operands

    def newton_step(self) -> Step:
        """Classify, solve on the free set, take the whole step.

        After a cycle: least-index pivots.
        """
        if self.places is not None:
            return self.least_index_step(self.x)
        step = super().newton_step()
        held = step.linear_iterations == 0 and step.failure is None  # all unknowns are held
        if held and self._cycles(self.x) and isinstance(self.problem.A, DenseOperator):
            return self.least_index_step(self.x)
        return step

    def move(self, iterations: int) -> Step:
        """Take the whole step, without a search.

        The base class has classified the unknowns and solved on the free set.
        """
        p, x, system = self.problem, self.x, self.system
        cycles, step = self._cycles(x), replace(system.accept(iterations), name="active set")
        if self._stops and self._stuck >= STUCK:
            return replace(step, failure=SolveStatus.STAGNATED)
        if cycles and isinstance(p.A, DenseOperator):
            return self.least_index_step(x)
        if cycles:
            return replace(step, failure=SolveStatus.STAGNATED)
        if self._watched:
            wp.copy(system.start_of_step, x)
        # At the end x is within rounding of the bounds.
        bounds = self._unbounded if self._moved else p.bounds.operands
        projected_move(system.sums.rows, bounds, x, system.principal.e, system.size, x)
        system.settle()
        self.round_iterate()
        norm = self.residual.evaluate(x)
        if self._watched and not norm <= BLOWN * self.first:  # the free block is nearly singular
            wp.copy(x, system.start_of_step)
            self.residual.evaluate(x)
            return replace(step, failure=SolveStatus.STAGNATED)
        if norm <= self._target:  # x may violate its bounds by what the criteria allow
            self.residual.start(x, keep=True)
            self.round_iterate()
        # Whole steps may first raise the residual.
        return replace(step, interim=step.interim or (self._watched and self._moved))

    def _cycles(self, x: DeviceArray) -> bool:
        """Return whether the active set has recurred, now or before.

        A recurrence counts unless the residual has fallen by half since.
        """
        key, norm = self._fingerprint(x), self.norms[-1]
        self.first = self.first or norm
        self._moved, self._last = key != self._last, key
        self._stuck = self._stuck + 1 if not self._moved and norm > 0.9 * self._seen[key] else 0
        self.cycled = self.cycled or (
            self._moved and key in self._seen and norm > 0.5 * self._seen[key]
        )
        self._seen[key] = norm
        return self.cycled

    def _fingerprint(self, x: DeviceArray) -> bytes:
        """Return a hash that identifies an active set."""
        free = self.system.free.numpy() != 0
        at_upper = ~free & (x.numpy() == self.problem.upper.numpy())
        return hashlib.blake2b(
            np.packbits(free).tobytes() + np.packbits(at_upper).tobytes(), digest_size=16
        ).digest()

    def least_index_step(self, x: DeviceArray) -> Step:
        """Take least-index pivots: the first violating unknown changes its place.

        An unknown's place is l, u, or F for free: y_F = 0, x = l or u elsewhere. It is violated by
        x_F beyond a bound, by y < 0 at l and y > 0 at u. On a P-matrix the sequence is finite. The
        step is interim until no condition is violated.
        """
        problem = DenseProblem.read(self.problem)
        data, units = problem.scaled()
        if self.places is None:
            free, at = self.system.free.numpy()[problem.rows] != 0, x.numpy()[problem.rows]
            self.places = np.where(free, FREE, np.where(at == problem.upper, UPPER, LOWER))
        pivots, most = 0, pivots_of(None, len(data.b)) * 8
        values, violated, singular = _basic_solution(data, self.places)
        while (
            violated.size and pivots < most and not (singular and self._stops) and not time_is_up()
        ):
            self.places[violated[0]] = _other_place(data, self.places, values, int(violated[0]))
            values, violated, singular = _basic_solution(data, self.places)
            pivots += 1
        self._pivots += pivots
        lost = singular or not np.isfinite(values).all() or self._pivots > PIVOTS * len(data.b)
        if not np.isfinite(values).all() or (lost and violated.size):  # A is no P-matrix
            return Step("least index", pivots, None, SolveStatus.STAGNATED)
        stored = x.numpy().copy()
        stored[problem.rows] = units * np.clip(values, data.lower, data.upper)
        x.assign(stored)
        self.round_iterate()
        # Counts only if rounding keeps the criteria from being met.
        failure = None if violated.size else SolveStatus.STAGNATED
        return Step(
            "least index",
            pivots,
            int(np.count_nonzero(self.places != FREE)),
            failure,
            interim=bool(violated.size),
        )


def _basic_solution(data: DenseProblem, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return the basic solution of the places, its violations, and singularity.

    x has y = 0 on the free unknowns and its bounds on the others. The violations are indices of the
    unknowns whose conditions do not hold. The last value says whether x is not unique.
    """
    singular = False
    x = np.where(places == LOWER, data.lower, np.where(places == UPPER, data.upper, 0.0))
    free = np.flatnonzero(places == FREE)
    if free.size:
        y = data.affine(x)[free]
        block = data.A[np.ix_(free, free)]
        singular = bool(np.linalg.cond(block) > 1e12)
        x[free] = (
            -np.linalg.lstsq(block, y, rcond=1e-12)[0] if singular else -np.linalg.solve(block, y)
        )
    y = data.affine(x)
    tiny_x, tiny_y = (
        SLACK * max(1.0, np.abs(x).max(initial=0.0)),
        SLACK * np.abs(data.b).max(initial=0.0),
    )
    wrong = np.where(
        places == FREE, (x < data.lower - tiny_x) | (x > data.upper + tiny_x), places * y > tiny_y
    )
    return x, np.flatnonzero(wrong), singular


def _other_place(data: DenseProblem, places: np.ndarray, x: np.ndarray, i: int) -> int:
    """Return the new place of a violating unknown."""
    if places[i] != FREE:
        return FREE
    return LOWER if x[i] < data.lower[i] else UPPER
