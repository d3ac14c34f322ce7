"""Natural residual of a grid problem, with free set and right-hand side."""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import nullcontext

import numpy as np

from warp_lcp.kernels import BoundKernel, Rows
from warp_lcp.kernels.launch_graph import Launch, as_one_table, launch_now
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import Reduction
from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.operator_protocol import HasStencil
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.subproblems import grid_step_kernels as kernels


class ResidualAndActiveSet(NaturalResidual):
    """Natural residual, free set and right-hand side on it, in one pass.

    Attributes:
        classified: whether the last evaluation let unknowns at a bound leave the free set; after
            `start`, whether the next one will.
        free_set: version of the free set and of the operator: it grows when one of them changes.
        active: number of held unknowns.
        energy: x'Ax/2 + b'x.
    """

    _minimum_map = False

    def __init__(self, problem: LCP, A: HasStencil, hierarchy: Hierarchy, *, rounded: bool) -> None:
        super().__init__(problem)
        self._A, self._finest, self._hierarchy, self._version = (
            A,
            hierarchy.finest,
            hierarchy,
            A.version,
        )
        self._rounded, self._b = rounded, problem.b
        self._away: DeviceArray | None = None
        self._reading = DeviceScalar(A.device, kernels.SLOTS)
        self.scalars = self._reading.array
        places = A.stencil.rows.places
        self.sums = Reduction(
            problem.layout.size,
            A.device,
            self.scalars,
            columns=4,
            threads=places,
            comm=problem.layout.comm,
        )
        self.classified, self.free_set, self.active, self.energy, self._norm_of_b = (
            False,
            1,
            0,
            0.0,
            0.0,
        )
        self.size = 1.0  # divisor of the right-hand side

    def start(self, x: DeviceArray, *, keep: bool) -> None:
        """Set x to clip(x, l, u) or clip(0, l, u).

        A guess is classified, a cold start is not.
        """
        self.renew()
        with as_one_table(x.device, self.problem.layout.comm):
            super().start(x, keep=keep)
            if not keep:
                self.launch_square_of_b()
        self.classified = keep
        if not keep:
            self.share_bounds()
            self._norm_of_b = float(np.sqrt(self.square_of_b.numpy()[0]))
            self.set(kernels.SIZE, self._norm_of_b or 1.0)
            self.set(kernels.STEP, 0.0)

    def share_bounds(self, launch: Launch = launch_now) -> None:
        """Fill the ghost cells of the bounds.

        The ghost cells of x then move in the same way as the cells that they represent.
        """
        ghosts, (lower, _, upper, _, code) = self._A.stencil.ghosts, self.problem.bounds.operands
        for bound in (lower, upper, code):
            if ghosts is not None and bound.size:
                ghosts.fill_task(bound).launch(launch)

    def renew(self) -> None:
        """Read the operator again if it has changed."""
        if self.has_new_operator():
            self._hierarchy.refresh()

    def has_new_operator(self) -> bool:
        """Return whether the operator has changed.

        The caller then refreshes the hierarchy.
        """
        if self._version == self._A.version:
            return False
        self._version, self.free_set = self._A.version, self.free_set + 1
        return True

    def norm_of_b(self) -> float:
        """Return ||b|| over the unknowns."""
        return self._norm_of_b

    def evaluate(self, x: DeviceArray, classify: bool | None = None) -> float:
        """Compute the norm of the natural residual, free set and right-hand side at x.

        Args:
            x: stored field.
            classify: whether unknowns at a bound leave the free set; None: as in the last
                evaluation.
        """
        classify = self.classified if classify is None else classify
        plain = (
            type(self).assess is ResidualAndActiveSet.assess
        )  # subclasses may launch by Warp alone
        with as_one_table(x.device, self.problem.layout.comm) if plain else nullcontext():
            self.assess(x, classify=classify)
        return self.read(classified=classify)

    def assess(self, x: DeviceArray, *, classify: bool, launch: Launch = launch_now) -> None:
        """Launch the evaluation at x; `read` returns its results."""
        self._A.stencil.wrap(x, launch=launch)
        kernels.ADVANCE.launch(None, self._evaluate_kernel(x, classify), launch=launch)
        self.sums.add_up(int(kernels.NORM), columns=4, launch=launch)

    def update(
        self, x: DeviceArray, direction: DeviceArray, *, launch: Launch = launch_now
    ) -> None:
        """Launch the step from x along the new conjugate direction."""
        self._update_kernel(self._A.stencil.rows, x, direction).launch(launch)

    def advance(
        self, x: DeviceArray, direction: DeviceArray, *, classify: bool, launch: Launch = launch_now
    ) -> None:
        """Launch the step and the evaluation at its end.

        One launch on the CPU, unless periodic ghost cells must be filled between. Ghost cells that
        represent cells of other ranks take the step by themselves; those of x and of the correction
        are filled.
        """
        p, s = self.problem, self._A.stencil
        if p.device.is_cuda or any(s.periodic):
            self.update(x, direction, launch=launch)
            self.assess(x, classify=classify, launch=launch)
            return
        for axis, end in s.ghosts.cuts if s.ghosts is not None else ():
            self._update_kernel(Rows.beyond(s.padding, p.device, axis, end), x, direction).launch(
                launch
            )
        kernels.ADVANCE.launch(
            self._update_kernel(s.rows, x, direction),
            self._evaluate_kernel(x, classify),
            launch=launch,
        )
        self.sums.add_up(int(kernels.NORM), columns=4, launch=launch)

    def _update_kernel(self, rows: Rows, x: DeviceArray, direction: DeviceArray) -> BoundKernel:
        bounds = self.problem.bounds.operands
        return kernels.UPDATE.bind(
            rows, bounds=bounds, x=x, z=self._finest.x, q=direction, scalars=self.scalars
        )

    def _evaluate_kernel(self, x: DeviceArray, classify: bool) -> BoundKernel:
        """Return the kernel that evaluates the residual at x, with its arguments."""
        p, finest = self.problem, self._finest
        return kernels.ASSESS.bind(
            self._A.stencil.rows,
            stencil=self._A.stencil,
            bounds=p.bounds.operands,
            x=x,
            b=self._b,
            unknown=p.unknown,
            free=finest.stencil.d,
            g=finest.b,
            changed=finest.changed.flatten(),
            away=self._away,
            scalars=self.scalars,
            classify=classify,
            out=self.sums.partials,
            MINIMUM_MAP=self._minimum_map,
            ROUNDED=self._rounded,
        )

    def read(self, *, classified: bool) -> float:
        """Read the results of an evaluation; return the norm.

        A step that is not finite was not taken, and its norm is NaN.

        Args:
            classified: the evaluation's `classify`.
        """
        self._reading.changed()
        scalars = self._reading.numpy()
        return self.store_evaluation(
            [*scalars[:4], scalars[int(kernels.STEP)], scalars[int(kernels.SIZE)]],
            classified=classified,
        )

    def store_evaluation(
        self, row: Iterable[float], norm_of_b: float | None = None, *, classified: bool
    ) -> float:
        """Store the results of an evaluation, see `device_iteration.keep_row`.

        Returns the norm.
        """
        self.classified = classified
        square, moved, active, twice, step, size = map(float, row)
        self.energy, self.size, self.active = 0.5 * twice, size, int(active)
        if moved > 0:
            self.free_set += 1
        if norm_of_b is not None:
            self._norm_of_b = norm_of_b
        return self.mark_evaluated(float(np.sqrt(square)) if math.isfinite(step) else math.nan)

    def set(self, slot: int, value: float) -> None:
        """Write a scalar to its slot on the device."""
        if self.scalars.device.is_cpu:
            self.scalars.numpy()[int(slot)] = value
        else:
            self.scalars[int(slot) : int(slot) + 1].fill_(value)
        if slot == kernels.SIZE:
            self.set(kernels.PER_SIZE, 1.0 / value if value else math.inf)
