"""Launches that are recorded once and run again: on the CPU 2 us each instead of 20, and nothing at all once they are a graph."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from typing import Any, Protocol

import warp as wp

from warp_lcp.deadline import check_time

CPU_RUNS_BEFORE_CAPTURE = 24  # recording a CPU graph costs about as much as it saves in so many runs


def loops_on_device(device: wp.Device) -> bool:
    """Return whether loops run on the device, without the host: on CUDA, from driver 12.4.

    A CPU graph can loop as well, but would hold up Ctrl-C for all of a loop to save a microsecond an iteration.
    """
    return bool(device.is_cuda and wp.is_conditional_graph_supported())


class Launch(Protocol):
    """Launches a kernel now, as `wp.launch` does, or records it, as `Program.launch` does."""

    def __call__(self, kernel: Any, dim: Any, inputs: Any, *, device: Any, block_dim: int = ...) -> Any:
        """Launch the kernel now, or record its launch."""


@dataclass(frozen=True)
class Task:
    """What the host does between launches: exchange with other processes, say."""

    function: Callable[[], object]

    def launch(self, launch: Launch = wp.launch) -> None:
        """Do it now, or record it between the launches."""
        perform(self.function, launch)


def perform(function: Callable[[], object], launch: Launch) -> None:
    """Call a function now if `launch` launches now, else record the call between the launches."""
    program = getattr(launch, "__self__", None)
    if isinstance(program, Program):
        program.record(function)
    else:
        function()


class Program:
    """A sequence of kernel launches with fixed arguments.

    Functions that launch take `launch: Launch = wp.launch`; handed `program.launch`, they record instead. The first run loads every
    kernel, so that later a graph can be captured: at once on CUDA, where launches cost most, after some runs on the CPU. Where the host
    has tasks between launches, see `perform`, there is a graph for each stretch without one.

    Args:
        device: where the kernels run.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self._commands: list[Any] = []
        self._arguments: list[Any] = []  # a recorded launch holds addresses only
        self._runs, self._replaced = 0, False
        self._graph: Any = None
        self._loops: dict[int, Any] = {}  # graphs by the address of their condition

    def __len__(self) -> int:
        """Return the number of launches."""
        return len(self._commands)

    def launch(self, kernel: Any, dim: Any, inputs: Any, *, device: Any, block_dim: int = 256) -> None:
        """Record a launch, and keep its arguments alive."""
        self._arguments.append(inputs)
        self._commands.append(wp.launch(kernel, dim, inputs, device=device, block_dim=block_dim, record_cmd=True))

    def record(self, function: Callable[[], object]) -> None:
        """Record a task of the host."""
        self._commands.append(Task(function))

    def extend(self, other: Program) -> None:
        """Append the launches of another program."""
        self._commands += other._commands
        self._arguments += other._arguments

    def run(self) -> None:
        """Launch everything once, as a graph where one has been made."""
        if self._graph is not None:
            wp.capture_launch(self._graph)
            return
        self._launch()
        self._runs += 1
        if self._runs < (1 if self.device.is_cuda else CPU_RUNS_BEFORE_CAPTURE) or self._replaced:
            return
        if self._has_tasks:
            self._replace()
        else:
            self._graph = self._captured(self._commands)

    def run_while(self, condition: wp.array[Any]) -> None:
        """Launch everything again and again while the condition is not 0; the launches update it.

        Where loops run on the device, all but the first call are one graph, and return before it has ended.

        Args:
            condition: shape (1,), wp.int32.
        """
        if self._runs == 0 or self._has_tasks or not loops_on_device(self.device):  # the first run loads the kernels
            wp.capture_while(condition, self._run_in_time)
            return
        if condition.ptr not in self._loops:
            with wp.ScopedCapture(device=self.device, force_module_load=False) as capture:
                wp.capture_while(condition, self._launch)
            self._loops[condition.ptr] = capture.graph
        wp.capture_launch(self._loops[condition.ptr])

    def _run_in_time(self) -> None:
        check_time()
        self.run()

    @property
    def _has_tasks(self) -> bool:
        return any(isinstance(command, Task) for command in self._commands)

    def _captured(self, commands: Sequence[Any]) -> Any:
        """Return the graph of some launches."""
        with wp.ScopedCapture(device=self.device, force_module_load=False) as capture:
            for command in commands:
                command.launch()
        return capture.graph

    def _replace(self) -> None:
        """Make a graph of every stretch of launches between tasks."""
        commands: list[Any] = []
        for is_task, group in groupby(self._commands, lambda command: isinstance(command, Task)):
            stretch = list(group)
            commands += stretch if is_task or len(stretch) == 1 else [Task(partial(wp.capture_launch, self._captured(stretch)))]
        self._commands, self._replaced = commands, True

    def _launch(self) -> None:
        for command in self._commands:
            command.launch()
