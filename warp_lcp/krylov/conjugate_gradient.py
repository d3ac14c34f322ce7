"""Preconditioned conjugate gradients on the device.

The scalars and the decision to continue are on the device; an iteration is one program.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Protocol, no_type_check, runtime_checkable

import numpy as np
import warp as wp

from warp_lcp.deadline import check_time
from warp_lcp.kernels import KernelFile, Rows
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.fields import zeros_like
from warp_lcp.kernels.launch_graph import CommandBuffer, Launch, LaunchGraph, clear
from warp_lcp.kernels.launch_graph import launch as launch_recorded
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import Communicator, Reduction, rows_of

RZ, PQ, RZ_OLD = wp.constant(0), wp.constant(1), wp.constant(2)  # slots of the device scalars
# The slots of the decision to continue begin here, with the square of the residual.
RR = wp.constant(3)
# The tolerance, the least norm so far, the iterations done, and their limit.
TOLERANCE, BEST, ITERATIONS, LIMIT = (wp.constant(int(RR) + i) for i in range(1, 5))
BY_ERROR = wp.constant(8)
SLOTS = 9

# Growth of the carried residual over its least: A or M is not positive definite to this precision.
GROWTH = wp.constant(wp.float64(1e3))


@no_type_check
@wp.func
def first_iteration(
    scalars: wp.array(dtype=wp.float64), rr: int, tolerance: wp.float64, limit: int
):
    """Initialize the slots from the residual's square on.

    Returns whether an iteration follows.
    """
    scalars[rr] = wp.float64(wp.inf)
    scalars[rr + 1] = tolerance
    scalars[rr + 2] = wp.float64(wp.inf)
    scalars[rr + 3] = wp.float64(0.0)
    scalars[rr + 4] = wp.float64(limit)
    return wp.where(limit > 0, 1, 0)


@no_type_check
@wp.func
def next_iteration(scalars: wp.array(dtype=wp.float64), rr: int):
    """Count an iteration; return whether another one follows.

    None follows if the norm is at most the tolerance, has grown GROWTH times over its least, or is
    not finite, or if the limit is reached.
    """
    scalars[rr + 3] += wp.float64(1.0)
    norm = wp.sqrt(scalars[rr])
    best = scalars[rr + 2]
    enough = norm <= scalars[rr + 1] or norm >= GROWTH * best or scalars[rr + 3] >= scalars[rr + 4]
    scalars[rr + 2] = wp.min(best, norm)
    return wp.where(enough or not wp.isfinite(norm), 0, 1)


@no_type_check
@forward_kernel(module="warp_lcp.conjugate_gradient")
def begin_kernel(
    scalars: wp.array(dtype=wp.float64),
    going: wp.array(dtype=int),
    tolerance: wp.float64,
    limit: int,
    by_error: int,
):
    """Initialize before the first iteration: no old direction."""
    scalars[BY_ERROR] = wp.float64(by_error)
    scalars[RZ_OLD] = wp.float64(0.0)
    going[0] = first_iteration(scalars, RR, tolerance, limit)


@no_type_check
@forward_kernel(module="warp_lcp.conjugate_gradient")
def end_kernel(scalars: wp.array(dtype=wp.float64), going: wp.array(dtype=int)):
    """Store r'z for beta after an iteration; decide whether another one follows.

    If `by_error`, the decision uses r'z of the start of the iteration.
    """
    if scalars[BY_ERROR] > wp.float64(0.0):
        if scalars[ITERATIONS] == wp.float64(0.0):
            scalars[TOLERANCE] = scalars[TOLERANCE] * wp.sqrt(scalars[RZ])
        scalars[RR] = scalars[RZ]
    scalars[RZ_OLD] = scalars[RZ]
    going[0] = next_iteration(scalars, RR)


PLACES = {"RZ": int(RZ), "RZ_OLD": int(RZ_OLD), "PQ": int(PQ)}
KERNELS = KernelFile(Path(__file__).parent / "headers/krylov.h", PLACES)
DIRECTION = KERNELS["conjugate_gradient.direction"]
UPDATE = KERNELS["conjugate_gradient.update"]


class LinearMap(Protocol):
    """Linear map q = A p on stored fields.

    It uses `launch` if it consists of kernel launches only.
    """

    def __call__(self, p: DeviceArray, q: DeviceArray, /, *, launch: Launch = ...) -> None:
        """Write q = A p."""


class KrylovPreconditioner(Protocol):
    """Preconditioner z = M r, M symmetric positive definite.

    It reads its own field `r` and writes its own field `z`.
    """

    r: DeviceArray
    z: DeviceArray

    def apply(self) -> None:
        """Write z = M r."""


@runtime_checkable
class RecordedPreconditioner(KrylovPreconditioner, Protocol):
    """Preconditioner whose launches are recorded.

    Attributes:
        program: writes z = M r.
    """

    @property
    def program(self) -> CommandBuffer: ...  # noqa: D102


class ConjugateGradient:
    """Preconditioned conjugate gradients for symmetric positive semi-definite A.

    The right-hand side is the preconditioner's field `r`, which becomes the residual; the solution
    is `x`. From x = 0, p = 0 an iteration is

        z = M r,   p = z + beta p,   x += alpha p,   r -= alpha A p

    with beta such that p is conjugate to the last direction, and alpha such that x minimizes along
    p. This class launches a pass for each operation; a subclass overrides `_turn` and `_move` by
    fused passes. The device decides after each iteration whether another one follows. Where graphs
    have loops the host waits once a solve, otherwise it reads that decision in each iteration.

    Args:
        product: A.
        preconditioner: M. If it is recorded (has a `program`), so must A be, and an iteration is
            one program.
        weight: residuals are measured as ||weight^(1/2) r||, field like r >= 0; None: all 1.
            Otherwise rows that a large shift makes stiff would decide when to stop.
        rows: of the unknowns, where fields contain other cells, such as ghost cells; None: all of a
            field.
        comm: communicator; None if serial.
    """

    _end_kernel: ClassVar[wp.Kernel] = end_kernel

    def __init__(
        self,
        product: LinearMap,
        preconditioner: KrylovPreconditioner,
        *,
        weight: DeviceArray | None = None,
        rows: Rows | None = None,
        comm: Communicator | None = None,
    ) -> None:
        self._product, self._preconditioner, self._rows, r = (
            product,
            preconditioner,
            rows,
            preconditioner.r,
        )
        self._allocate(r, SLOTS, int(RR))
        self._q, self._shared = zeros_like(r), comm is not None
        self._reduction = Reduction(
            r.size,
            r.device,
            self._scalars.array,
            threads=None if rows is None else rows.places,
            comm=comm,
        )
        rows = rows or rows_of(r)
        self._direction = DIRECTION.bind(
            rows, z=preconditioner.z, direction=self._p, scalars=self._scalars.array
        )
        self._update = UPDATE.bind(
            rows,
            direction=self._p,
            q=self._q,
            w=weight,
            x=self.x,
            r=r,
            scalars=self._scalars.array,
            out=self._reduction.partials,
        )

    def _allocate(self, r: DeviceArray, slots: int, square: int) -> None:
        """Allocate x, p and device scalars.

        From slot `square` on these are r'r and the numbers of `next_iteration`.
        """
        self.device, self.x, self._p = r.device, zeros_like(r), zeros_like(r)
        self._scalars, self._square, self._shared = DeviceScalar(r.device, slots), square, False
        # Tolerance, limit of iterations, whether the error decides.
        self._goal = [Scalar() for _ in range(3)]
        self._beginning = LaunchGraph(r.device, self._launch_beginning)
        self._going = wp.zeros(1, dtype=wp.int32, device=r.device)
        self._program: CommandBuffer | None = None

    def solve(
        self, tolerance: float, max_iterations: int, *, by_error: bool = False
    ) -> tuple[int, float]:
        """Iterate from x = 0 until the residual norm is at most the tolerance.

        Also ends if the norm is not a number, or has grown by GROWTH over its least.

        Args:
            tolerance: of the norm.
            max_iterations: maximum number of iterations.
            by_error: whether (r'M r)^(1/2) decides, the error's energy norm as M sees it, a step
                late, by a tolerance relative to that of the start. In a stiff system a small
                residual may leave a large error in modes with small eigenvalues.

        Returns:
            The iterations done and the norm of the carried residual, an estimate that rounding
            bounds from below.
        """
        self.start(tolerance, max_iterations, by_error=by_error)
        return self.read()

    def start(self, tolerance: float, max_iterations: int, *, by_error: bool = False) -> None:
        """Launch the iterations; `read` then returns the result.

        Arguments as of `solve`.
        """
        for number, value in zip(
            self._goal, (tolerance, max_iterations, int(by_error)), strict=True
        ):
            number.value = value
        if self._program is None:
            self._program = self._recorded()
        self._beginning.run()
        if self._program is None:
            wp.capture_while(self._going, self._iterate)
        elif not self._loops_with_beginning:
            self._program.run_while(self._going)
        self._scalars.changed()

    def read(self) -> tuple[int, float]:
        """Return iterations and norm after `start`; waits for the device."""
        scalars = self._scalars.numpy()
        return int(scalars[self._square + ITERATIONS - RR]), float(np.sqrt(scalars[self._square]))

    @property
    def _loops_with_beginning(self) -> bool:
        """Whether the iterations are launched with the start, in one graph."""
        return self.device.is_cuda and self._program is not None and not self._shared

    def _launch_beginning(self) -> None:
        """Launch the start: x = 0, and the decision whether to iterate.

        On a GPU the iterations, too.
        """
        clear(self.x, self._p, self._q)  # A writes its own rows only
        inputs = [self._scalars.array, self._going, *self._goal]
        launch_recorded(begin_kernel, 1, inputs, device=self.device)
        if self._loops_with_beginning and self._program is not None:
            self._program.run_while(self._going)

    def _recorded(self) -> CommandBuffer | None:
        """Return an iteration as a program; None if the preconditioner is not recorded."""
        if not isinstance(self._preconditioner, RecordedPreconditioner):
            return None
        cycle = self._preconditioner.program
        program = CommandBuffer(self.device)
        program.extend(cycle)
        self._advance(program.launch)
        return program

    def _iterate(self) -> None:
        """Launch an iteration whose preconditioner is not recorded."""
        check_time()
        self._preconditioner.apply()
        self._advance(wp.launch)

    def _advance(self, launch: Launch) -> None:
        """Launch the part of an iteration after z = M r."""
        self._turn(launch)
        self._move(launch)
        launch(self._end_kernel, 1, [self._scalars.array, self._going], device=self.device)

    def _turn(self, launch: Launch) -> None:
        """Compute p = z + beta p and q = A p.

        beta = r'z / (r'z)_old; the product p'q gives alpha = r'z / p'q.
        """
        self._reduction.dot(
            self._preconditioner.r, self._preconditioner.z, int(RZ), rows=self._rows, launch=launch
        )
        self._direction.launch(launch)
        self._product(self._p, self._q, launch=launch)
        self._reduction.dot(self._p, self._q, int(PQ), rows=self._rows, launch=launch)

    def _move(self, launch: Launch) -> None:
        """Update x += alpha p and r -= alpha q; sum r'r."""
        self._update.launch(launch)
        self._reduction.add_up(int(RR), launch=launch)
