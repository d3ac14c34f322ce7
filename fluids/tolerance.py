"""How exact a step's pressure has to be: a stated part of the error that the time step makes anyway."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

import warp_lcp as wl
from fluids.tolerance_kernels import change_kernel
from warp_lcp.vectors import Reduction, launch_spans

FRACTION = 0.1  # of the time step's error that the solve may leave; measured on five scenes, see docs/models.md
FIRST = 1e-4  # relative residual where no pressure comes before: a liquid that is at rest shall stay so
LEAST = 1e-6  # relative residual that is never asked to be smaller: below, rounding on the faces is what is left


class TimeErrorTolerance:
    """Stop a solve when the velocity error that it leaves is FRACTION of the step's own error in time.

    A step takes the acceleration by the pressure as constant: of first order, its error in the velocity is half of what that changes by
    from one step to the next. The first guess of a solve is just the last step's pressure, x0 = x_last dt / dt_last, so that

        time error = 1/2 ||G (x - x0)||,   ||G e||^2 = e'A e,

    with G the gradient on the open faces: in the energy norm of A an error in x is one in the velocity. The residual r = A e of what a
    solve leaves and that of its guess are reduced alike, ||G e|| / ||G (x - x0)|| ~ ||r|| / ||r(x0)||, for what multigrid leaves is spread
    over all lengths as the change is. So a solve is done when ||r|| <= FRACTION / 2 ||r(x0)||, which costs nothing to test.

    Where the guess is no better than zero its residual does not count but that of zero. Liquid at rest and in free fall has residuals of
    rounding noise, which the absolute tolerance covers.

    Args:
        size: elements of a stored field.
        device: where they live.

    Attributes:
        used: relative residual that the last solve was held to.
        time_error: of the last step, root mean square over the cells [m/s]; None: no pressure came before.
    """

    def __init__(self, size: int, device: wp.Device) -> None:
        self.used = FIRST
        self.time_error: float | None = None
        self._sum = wp.zeros(1, dtype=wp.float64, device=device)
        self._reduction = Reduction(size, device, self._sum)

    def criteria(self, *, warm: bool, atol: float, max_iterations: int) -> wl.StoppingCriteria:
        """Return when a solve is done.

        Args:
            warm: whether the guess is the last step's pressure.
            atol: absolute tolerance [m/s].
            max_iterations: of the method.
        """
        if not warm:
            return wl.StoppingCriteria(rtol=FIRST, atol=atol, max_iterations=max_iterations)
        return wl.StoppingCriteria(rtol=LEAST, guess_rtol=0.5 * FRACTION, atol=atol, max_iterations=max_iterations)

    def measure(self, A: Any, result: wl.SolveResult, criteria: wl.StoppingCriteria, fields: list[wp.array], unknowns: int) -> None:
        """Find the step's error in time from a result.

        Args:
            A: the operator.
            result: of the solve.
            criteria: of the solve.
            fields: its first guess and another stored float64 field (both overwritten).
            unknowns: of the problem.
        """
        reference = result.residual / result.relative_residual if result.relative_residual > 0.0 else 0.0
        self.used = criteria.tolerance(reference, result.history[0].residual) / reference if reference > 0.0 else 0.0
        if criteria.guess_rtol == 0.0:
            self.time_error = None
            return
        change, product = (field.flatten() for field in fields)
        launch_spans(change_kernel, self._reduction.spans, [result.x.flatten(), change], [], change.device)
        A.apply(change, product)
        self._reduction.dot(change, product, 0)
        square = max(float(self._sum.numpy()[0]), 0.0)
        self.time_error = 0.5 * float(np.sqrt(square / max(unknowns, 1)))
