"""Projected multigrid ahead of its host: a GPU takes truncated steps, and begins a solve, as long as there is nothing to decide."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_lcp.multigrid.cycle_passes import CLEAR
from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.operators.grid_poisson import GridPoisson
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.problem.stopping import MeanCriteria, StoppingCriteria
from warp_lcp.rows.program import Conditional, Program, loops_on_device
from warp_lcp.rows.readings import Reading
from warp_lcp.solvers import projected_multigrid_kernels as kernels

if TYPE_CHECKING:
    from warp_lcp.solvers.projected_multigrid_workspace import MultigridWorkspace

EPS = float(np.finfo(np.float64).eps)
ORDINARY = 1e-100  # the least residual that is taken for one: the squares of smaller ones vanish, which the loop looks into
RATIOS = 1e-6, 1e6  # of a guess's residual to b within which corrections in float32 neither overflow nor vanish
ROWS = 32  # at most


class RunAhead:
    """What the device does without its host, and what the host has not looked at of it yet.

    A step follows a step where residual and energy are the least so far, the tolerance is missed and the free set does not creep: then the
    host, which judges all of that again when it comes, would have taken the same one. Everything else is left to it.

    Args:
        work: whose steps they are; its operator is a grid's, in one process.

    Attributes:
        rows: evaluations that the host has not looked at, see `projected_multigrid_kernels.keep_row`.
    """

    def __init__(self, work: MultigridWorkspace) -> None:
        self._work, device = work, work.A.device
        self.rows = deque[np.ndarray]()
        self._found, self._judged = Reading(device, ROWS * int(kernels.ROW)), Reading(device, kernels.JUDGED)
        self._going, self._stale = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(2))
        self._loops: dict[int, Program] = {}  # by the step's program

    @staticmethod
    def suits(work: MultigridWorkspace) -> bool:
        """Return whether the device can do without its host: where graphs have loops, on a grid in one process."""
        plain = type(work.hierarchy) is Hierarchy and isinstance(work.problem.A, GridPoisson) and work.exact
        return plain and work.problem.layout.across is None and loops_on_device(work.A.device)

    def steps(self, tolerance: float, left: int) -> bool:
        """Take a step and what follows it, at most `left`; return False, with nothing done, where kernels have yet to be loaded."""
        loop = self._loop()
        if loop is None:
            return False
        work, r = self._work, self._work.residual
        given = [int(r.stale), min(left, ROWS), tolerance, *work.descent.standing, work.descent.noise]
        wp.launch(kernels.resume_kernel, 1, [self._judged.array, self._going, self._stale, *given], device=work.A.device)
        self._run(loop)
        return True

    def begin(self, guess: wp.array[Any], criteria: StoppingCriteria | MeanCriteria, left: int) -> float | None:
        """Begin a solve from a guess, and take steps; return the residual at clip(0, l, u), None where the loop has to begin again.

        Args:
            guess: stored field that is not the iterate.
            criteria: when steps are done.
            left: steps at most.
        """
        loop, work, r = self._loop(), self._work, self._work.residual
        if loop is None:
            return None
        p, device, x = work.problem, work.A.device, work.x
        p.bounds.encode()
        r.renew()
        NaturalResidual.start(r, x, keep=False)
        r.launch_square_of_b()
        wp.launch(kernels.take_unit_kernel, 1, [r.scalars, r.square_of_b.array], device=device)
        r.classify = False
        r.assess(x)
        wp.launch(kernels.keep_row_kernel, 1, [r.scalars, self._found.array, 0], device=device)
        none_floats = p.A.component_finder.look(work.scratch)  # type: ignore[attr-defined]  # of a GridPoisson
        faults = p.look_at(guess)
        p.layout.copy(x, guess)
        NaturalResidual.start(r, x, keep=True)
        r.classify = True
        r.assess(x)
        if work.scratch is not None:
            CLEAR.bind(work.flat, x=work.scratch[1]).launch()
        counted = criteria.counted if isinstance(criteria, MeanCriteria) else None
        given = [int(r.stale), min(left + 2, ROWS), criteria.rtol, criteria.atol, counted, work.descent.noise]
        memory = [r.scalars, self._found.array, self._judged.array, self._going, self._stale]
        wp.launch(kernels.begin_kernel, 1, [*memory, *given], device=device)
        self._run(loop)
        reference, first = (math.sqrt(row[int(kernels.NORM)]) for row in (self.rows[0], self.rows[1]))
        size = math.sqrt(r.square_of_b.numpy()[0])
        usual = p.bounds.stays and none_floats() and not faults() and math.isfinite(size) and 4 * EPS * size < reference < math.inf
        if not (usual and reference > ORDINARY and RATIOS[0] * size < first < RATIOS[1] * size):
            self.rows.clear()
            r.stale = True  # nobody knows what the hierarchy is of
            return None
        for _ in range(2):
            r.take(self.rows.popleft(), size)
        return reference

    def _run(self, loop: Program) -> None:
        """Launch the loop, and take over the rows that there are then."""
        loop.run_while(self._going)
        for reading in (self._found, self._judged):
            reading.changed()
        count = int(self._judged.numpy()[int(kernels.TAKEN)])
        self.rows.extend(self._found.numpy()[: count * int(kernels.ROW)].reshape(count, -1).copy())

    def _loop(self) -> Program | None:
        """Return the program of a step among others, None while parts of it have not run."""
        work = self._work
        step, rebuild = work.step_program(), work.hierarchy.rebuilding
        if not (step.has_run and rebuild.has_run):
            return None
        if id(step) not in self._loops:
            loop = self._loops[id(step)] = Program(work.A.device)
            loop.record(Conditional(self._stale, rebuild))
            loop.extend(step)
            memory = [work.residual.scalars, self._found.array, self._judged.array, self._going, self._stale]
            loop.launch(kernels.judge_kernel, 1, memory, device=work.A.device)
        return self._loops[id(step)]
