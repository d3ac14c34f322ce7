"""Launches that are recorded once and run again: on the CPU 2 us each instead of 20, and nothing at all once they are a graph."""

from __future__ import annotations

from typing import Any, Protocol

import warp as wp

CPU_RUNS_BEFORE_CAPTURE = 24  # recording a CPU graph costs about as much as it saves in so many runs


class Launch(Protocol):
    """Launches a kernel now, as `wp.launch` does, or records it, as `Program.launch` does."""

    def __call__(self, kernel: Any, dim: Any, inputs: Any, *, device: Any, block_dim: int = ...) -> Any:
        """Launch or record."""


class Program:
    """A sequence of kernel launches with fixed arguments.

    Functions that launch take `launch: Launch = wp.launch`; handed `program.launch`, they record instead. The first run loads every
    kernel, so that later a graph can be captured: at once on CUDA, where launches cost most, after some runs on the CPU.

    Args:
        device: where the kernels run.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self._commands: list[Any] = []
        self._arguments: list[Any] = []  # a recorded launch holds addresses only
        self._runs = 0
        self._graph: Any = None

    def __len__(self) -> int:
        """Return the number of launches."""
        return len(self._commands)

    def launch(self, kernel: Any, dim: Any, inputs: Any, *, device: Any, block_dim: int = 256) -> None:
        """Record a launch."""
        self._arguments.append(inputs)
        self._commands.append(wp.launch(kernel, dim, inputs, device=device, block_dim=block_dim, record_cmd=True))

    def extend(self, other: Program) -> None:
        """Append the launches of another program."""
        self._commands += other._commands
        self._arguments += other._arguments

    def run(self) -> None:
        """Launch everything."""
        if self._graph is not None:
            wp.capture_launch(self._graph)
            return
        for command in self._commands:
            command.launch()
        self._runs += 1
        if self._runs >= (1 if self.device.is_cuda else CPU_RUNS_BEFORE_CAPTURE):
            with wp.ScopedCapture(device=self.device, force_module_load=False) as capture:
                for command in self._commands:
                    command.launch()
            self._graph = capture.graph
