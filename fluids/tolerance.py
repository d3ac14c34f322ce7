"""Pressure tolerance from the time discretization error."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.vectors import Communicator, Reduction, convert, rows_of
from warp_lcp.problem.operator_protocol import Operator

KERNELS = KernelFile(Path(__file__).parent / "headers/pressure.h")
CHANGE = KERNELS["tolerance.change"]
FRACTION = 0.1  # share of the time step's error that the solve may add
# Relative residual of the first steps, when no change has been measured. A liquid at rest must stay
# at rest.
FIRST = 1e-4
# Smallest relative residual: below it the rounding of the faces dominates.
LEAST = 1e-6
# Largest relative residual: the step after a collision must not be solved too loosely.
MOST = 0.1


class TimeErrorTolerance:
    """Automatic tolerance: a fraction of the time discretization error.

    A step assumes a constant acceleration by the pressure. To first order its velocity error is
    half of the change of this acceleration from one step to the next. The first guess of a solve is
    the last step's pressure, x0 = x_last kick_dt / kick_dt_last, so that

        time error = 1/2 ||G (x - x0)||,   ||G e||^2 = e'A e,

    with G the gradient: in the energy norm of A, the error in x is the error in the velocity. It is
    measured after the solve, and used for the next step, scaled by (kick_dt / kick_dt_last)^2 if
    that step is shorter.

    The remaining error e of a solve has the residual r = A e. Multigrid cycles leave errors of
    wavelengths near the cell size, for which A is of order one: in forty steps of dam-break-2d,
    splash-in-circle, mesh-obstacle and wave-maker, ||G e|| = 0.12 to 1.0 ||r|| after one to six
    cycles. So a solve ends when ||r|| <= FRACTION time error, a test without extra cost.

    Liquid at rest and in free fall has residuals of rounding noise, which the absolute tolerance
    covers.

    Args:
        size: number of elements of a stored field.
        device: their device.
        comm: communicator; None if serial.

    Attributes:
        used: relative residual that was the criterion of the last solve.
    """

    def __init__(self, size: int, device: wp.Device, comm: Communicator | None = None) -> None:
        self.used = FIRST
        self._error: float | None = None
        # Whether there was a previous step, and whether `_sum` has an error that was not read yet.
        self._warm = self._change = False
        self._unknowns = 1
        self._reference = 0.0  # residual of the last step at x = 0, root mean square [m/s]
        self._sum = DeviceScalar(device)
        self._reduction = Reduction(size, device, self._sum.array, comm=comm)

    def criteria(self, ratio: float, atol: float) -> dict[str, float]:
        """Return `rtol` and `atol` of a solve; `atol` is a root mean square [m/s].

        Args:
            ratio: kick_dt / kick_dt_last; 0 without a last step.
            atol: rounding error, root mean square [m/s].
        """
        self._warm = ratio > 0.0
        if not self._warm or self.time_error is None:
            return {"rtol": FIRST, "atol": atol}
        shorter = min(ratio, 1.0)
        allowed = min(FRACTION * self.time_error * shorter**2, MOST * self._reference * shorter)
        return {"rtol": LEAST, "atol": max(atol, allowed)}

    def measure(
        self,
        A: Operator,
        result: wl.SolveResult,
        criteria: wl.StoppingCriteria,
        fields: list[wp.array],
        unknowns: int,
    ) -> None:
        """Estimate the time discretization error from a solution.

        It computes e'A e for e = x - x0, the squared norm of the velocity change; `time_error`
        reads the sum later, without a wait here.

        Args:
            A: the operator.
            result: the solve's result.
            criteria: its stopping criteria.
            fields: its first guess and another stored float64 field (both overwritten).
            unknowns: their number.
        """
        reference = (
            result.residual / result.relative_residual if result.relative_residual > 0.0 else 0.0
        )
        self.used = criteria.tolerance(reference) / reference if reference > 0.0 else 0.0
        self._reference = reference / max(unknowns, 1) ** 0.5
        self._unknowns, self._change = max(unknowns, 1), self._warm
        if not self._warm:  # the start of motion is no change of an acceleration
            self._error = None
            return
        change, product = (field.flatten() for field in fields)
        x = result.x.flatten()
        if x.dtype is not wp.float64:  # methods in single precision
            convert(x, product)
            x = product
        CHANGE.bind(rows_of(x), x=x, guess=change).launch()
        A.apply(change, product)
        self._reduction.dot(change, product, 0)
        self._sum.changed()

    @property
    def time_error(self) -> float | None:
        """Error of the last step, root mean square over the cells [m/s].

        None before the first step.
        """
        if self._change:
            self._change, self._error = (
                False,
                0.5 * float(np.sqrt(max(float(self._sum.numpy()[0]), 0.0) / self._unknowns)),
            )
        return self._error

    def state(self) -> np.ndarray:
        """Return the state, shape (2,); -1: no error estimate yet."""
        return np.array([-1.0 if self.time_error is None else self.time_error, self._reference])

    def restore(self, state: np.ndarray) -> None:
        """Restore the result of `state`."""
        self._error, self._reference, self._change = (
            float(state[0]) if state[0] >= 0.0 else None,
            float(state[1]),
            False,
        )
