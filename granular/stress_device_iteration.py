"""Heavy-ball steps of a stress solve that run on the device without the host."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_lcp.granular import stress_kernels as kernels
from warp_lcp.granular.stress import MOST_MOMENTUM, Stress
from warp_lcp.kernels.launch_graph import CommandBuffer, LaunchGraph, launch, loops_on_device
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.recorded_arguments import Scalar

if TYPE_CHECKING:
    from warp_lcp.granular.stress_methods import HeavyBallProjectedGradient


class StressDeviceIteration:
    """Steps of a solve with all decisions on the device.

    The decisions are those of `coupled.MomentumWorkspace`. On CUDA a solve is one graph: the
    residual at the start, a loop of periods of steps until a residual is due, and that residual;
    the host reads once. On the CPU a thread pool executes the loop as one table.

    Args:
        stress: the problem; on ranks only on the CPU, with equal decisions from sums over all
            ranks.
        method: settings of the steps.
    """

    def __init__(self, stress: Stress, method: HeavyBallProjectedGradient) -> None:
        self._stress, self._method, device = stress, method, stress.packing.grid.device
        self._decisions = DeviceScalar(device, kernels.DECISIONS)
        self._going = wp.zeros(1, dtype=wp.int32, device=device)
        self._limits = wp.array(method.calm, dtype=wp.float64, device=device)
        self._scalars = [Scalar() for _ in range(7)]  # arguments of the kernel from `limit_` on
        self._beginning, self._resuming = (
            LaunchGraph(device, record)
            for record in (self._launch_beginning, self._launch_resumption)
        )
        self._period: CommandBuffer | None = None  # period of which the loop is made
        self._loop = CommandBuffer(device)

    @staticmethod
    def suits(stress: Stress) -> bool:
        """Return whether the device can run steps without the host.

        The device must support loops; on ranks, only the CPU does.
        """
        grid = stress.packing.grid
        return loops_on_device(grid.device) and not (stress.shared and grid.device.is_cuda)

    def begin(self, tolerance: float, most: int, *, early: float = 1.0) -> None:
        """Evaluate the residual of the current stresses, and run steps until it is due.

        Args:
            tolerance: tolerance of the residual [m/s].
            most: most steps of the solve.
            early: factor on the first target of the estimate.
        """
        stress, method = self._stress, self._method
        stress.set_steps(*method.steps(stress))
        limit, least, still, unloaded = math.inf, method.least, 0.0, tolerance
        if stress.cold:
            limit, least, still, unloaded = (
                method.momentum_limit(stress),
                method.cold,
                kernels.STILL_SHARE * tolerance,
                0.0,
            )
        for number, value in zip(
            self._scalars, (limit, tolerance, least, still, unloaded, most, early), strict=True
        ):
            number.value = float(value)
        self._make_loop()
        self._beginning.run()
        if not stress.packing.grid.device.is_cuda and self._going.numpy()[0]:
            stress.start_from_now()
        self._repeat()

    def resume(self) -> None:
        """Run more steps, after a residual that misses the tolerance."""
        self._make_loop()
        self._resuming.run()
        self._repeat()

    def decisions(self) -> np.ndarray:
        """Return the device's decisions, by the slots of `stress_kernels`; waits for it."""
        return self._decisions.numpy()

    def _repeat(self) -> None:
        """Run the steps on the CPU; on CUDA they have been launched."""
        if not self._stress.packing.grid.device.is_cuda:
            self._loop.run_while(self._going)
        self._decisions.changed()
        if self._stress.bodies is not None:
            self._stress.bodies.changed()

    def _make_loop(self) -> None:
        """Build the loop for the current walls: a period of steps and the decisions."""
        period, device = self._stress.period(), self._stress.packing.grid.device
        if self._period is period:
            return
        self._stress.check()  # must not be built while launches are recorded
        self._period, self._loop = period, CommandBuffer(device)
        self._loop.extend(period)
        s, method = self._stress, self._method
        check, fields = (
            method.check_every * kernels.PERIOD,
            [s.momentum, self._decisions.array, self._limits, self._going],
        )
        inputs = [s.counts, s.numbers, *fields, check, method.patience, method.wait]
        self._loop.launch(kernels.decide_kernel, 1, inputs, device=device)
        self._beginning.forget()
        self._resuming.forget()

    def _launch_beginning(self) -> None:
        """Launch the start of a solve, and on CUDA its steps."""
        s, device = self._stress, self._stress.packing.grid.device
        pressure_step, shear_step, lookahead = self._method.steps(s)
        s.check().run()
        fields = [s.total, s.counts, s.numbers, s.momentum, self._decisions.array, self._going]
        arguments = [
            pressure_step,
            shear_step,
            lookahead,
            self._method.momentum,
            MOST_MOMENTUM,
            *self._scalars,
        ]
        launch(kernels.begin_steps_kernel, 1, [*fields, *arguments], device=device)
        if device.is_cuda:
            s.start_from_now()
            self._launch_steps()

    def _launch_resumption(self) -> None:
        """Launch the continuation of a solve, and on CUDA its steps."""
        device = self._stress.packing.grid.device
        launch(kernels.resume_steps_kernel, 1, [self._decisions.array, self._going], device=device)
        if device.is_cuda:
            self._launch_steps()

    def _launch_steps(self) -> None:
        """Launch the loop and the final residual on CUDA."""
        s = self._stress
        self._loop.run_while(self._going)
        s.check().run()
        launch(
            kernels.keep_sums_kernel,
            1,
            [s.total, self._decisions.array, kernels.LAST],
            device=s.packing.grid.device,
        )
