"""Launches that are recorded once and run again: on the CPU by a team of threads in native code, on CUDA as a graph."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from typing import Any, Protocol

import warp as wp

from warp_lcp.deadline import check_time
from warp_lcp.rows.team import CELLS, Entry, Operation, Stage, Table, arguments_of, launched_alone, ranges, team


def loops_on_device(device: wp.Device) -> bool:
    """Return whether loops run on the device, without the host: on CUDA, from driver 12.4.

    Native code could loop on the CPU as well, but would hold up Ctrl-C for all of a loop to save a microsecond an iteration.
    """
    return bool(device.is_cuda and wp.is_conditional_graph_supported())


class Launch(Protocol):
    """Launches a kernel now, as `wp.launch` does, or records it, as `Program.launch` does."""

    def __call__(self, kernel: Any, dim: Any, inputs: Any, *, device: Any, block_dim: int = ...) -> Any:
        """Launch the kernel now, or record its launch."""


@dataclass(frozen=True)
class Task:
    """What the host does between launches: exchange with other processes, say.

    Args:
        function: does it.
        operation: makes what the team can do in its place, on the CPU; None: nothing can.
    """

    function: Callable[[], object]
    operation: Callable[[], Operation] | None = None

    def launch(self, launch: Launch = wp.launch) -> None:
        """Do it now, or record it between the launches."""
        recorded = isinstance(getattr(launch, "__self__", None), Program) and team() is not None
        perform(self.operation() if recorded and self.operation else self.function, launch)


@dataclass(frozen=True)
class Conditional:
    """A program that is launched if a number on the device is not 0: in a graph without the host."""

    condition: wp.array[Any]
    program: Program

    def launch(self) -> None:
        """Launch it, or record that in the graph that is being captured."""
        wp.capture_if(self.condition, self.program._launch)


def perform(what: Callable[[], object] | Operation, launch: Launch) -> None:
    """Call a function, or have the team do an operation, now if `launch` launches now; else record it among the launches."""
    program = getattr(launch, "__self__", None)
    if isinstance(program, Program):
        program.record(what)
    elif isinstance(what, Operation):
        run_table(Table([what]))
    else:
        what()


def run_table(table: Table) -> None:
    """Have the team work through a table."""
    at_work = team()
    assert at_work is not None, "a table is made for a team"
    at_work.run(table)


def launch_ranges(
    kernel: Any, dim: tuple[int, ...], cells: int, inputs: list[Any], *, device: Any, launch: Launch | None, ordered: bool
) -> None:
    """Launch a kernel whose first argument begins with the range of tasks that a thread takes, or record it.

    Args:
        kernel: with as many coordinates of a thread as `dim` has.
        dim: of the launch where there is no such range.
        cells: what a task costs, in cells of a usual pass.
        inputs: arguments.
        device: where.
        launch: of a program; None: now.
        ordered: whether tasks write what others read or write.
    """
    tasks = math.prod(dim)
    if device.is_cuda or team() is None or (launch is None and tasks * cells < 4 * CELLS):
        (launch or wp.launch)(kernel, dim, inputs, device=device)
    elif tasks:
        made = wp.launch(kernel, (1,) * len(dim), inputs, device=device, record_cmd=True)
        stage = Stage(Entry(made), arguments_of(made), inputs, tasks // dim[0], dim[0])
        perform(ranges(stage, cells, ordered=ordered), launch or wp.launch)


class Program:
    """A sequence of kernel launches with fixed arguments.

    Functions that launch take `launch: Launch = wp.launch`; handed `program.launch`, they record instead. On the CPU the team works through
    a table of them, on CUDA a graph is captured once the first run has loaded every kernel. Where the host has tasks between launches, see
    `perform`, there is a table or a graph for each stretch without one.

    Args:
        device: where the kernels run.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self._commands: list[Any] = []
        self._arguments: list[Any] = []  # a recorded launch holds addresses only
        self._runs = 0
        self._stretches: list[Callable[[], object]] | None = None
        self._loops: dict[int, Callable[[], object]] = {}  # what launches their graph, by the address of their condition

    def __len__(self) -> int:
        """Return the number of launches."""
        return len(self._commands)

    def launch(self, kernel: Any, dim: Any, inputs: Any, *, device: Any, block_dim: int = 256) -> None:
        """Record a launch, and keep its arguments alive."""
        self._arguments.append(inputs)
        made = wp.launch(kernel, dim, inputs, device=device, block_dim=block_dim, record_cmd=True)
        self.record(made if self.device.is_cuda or team() is None else launched_alone(made))

    def record(self, what: Any) -> None:
        """Record a recorded launch, an operation of the team or a task of the host."""
        self._commands.append(Task(what) if callable(what) else what)
        self._stretches = None

    @property
    def has_run(self) -> bool:
        """Whether it has run, so that all of its kernels are loaded."""
        return self._runs > 0

    def extend(self, other: Program) -> None:
        """Append the launches of another program."""
        self._commands += other._commands
        self._arguments += other._arguments
        self._stretches = None

    def run(self) -> None:
        """Launch everything once."""
        if self._stretches is None and self.device.is_cuda and self._runs == 0:
            self._launch()
        else:
            if self._stretches is None:
                self._stretches = self._prepared()
            for stretch in self._stretches:
                stretch()
        self._runs += 1

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
            self._loops[condition.ptr] = self._captured_loop(condition)
        self._loops[condition.ptr]()

    def _captured_loop(self, condition: wp.array[Any]) -> Callable[[], object]:
        """Return what launches a graph that repeats the launches."""
        with wp.ScopedCapture(device=self.device, force_module_load=False) as capture:
            wp.capture_while(condition, self._launch)
        return partial(wp.capture_launch, capture.graph)

    def _run_in_time(self) -> None:
        check_time()
        self.run()

    @property
    def _has_tasks(self) -> bool:
        return any(isinstance(command, Task) for command in self._commands)

    def _prepared(self) -> list[Callable[[], object]]:
        """Return a graph, a table or the launches of every stretch between tasks, and the tasks."""
        made: list[Callable[[], object]] = []
        for is_task, group in groupby(self._commands, lambda command: isinstance(command, Task)):
            stretch = list(group)
            if is_task:
                made += [task.function for task in stretch]
            elif self.device.is_cuda:
                made.append(partial(wp.capture_launch, self._captured(stretch)))
            elif all(isinstance(command, Operation) for command in stretch):
                made.append(partial(run_table, Table(stretch)))
            else:
                made += [command.launch for command in stretch]
        return made

    def _captured(self, commands: Sequence[Any]) -> Any:
        """Return the graph of some launches."""
        with wp.ScopedCapture(device=self.device, force_module_load=False) as capture:
            for command in commands:
                command.launch()
        return capture.graph

    def _launch(self) -> None:
        for command in self._commands:
            command.launch()
