"""What a user sees of a run: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Protocol, Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
from rich.table import Column

from warp_lcp.result import SolveStatus
from warp_lcp.run.log import Value
from warp_lcp.run.terminal import say
from warp_lcp.scene.foreign import one_line

RESIDUALS = "coupled_residual", "solve_residual"  # the first that a log has is the one that the scene's tolerance is of
CONVERGED = SolveStatus.CONVERGED.name
WINDOW = 20.0  # seconds of the recent past that the time left is judged by


class Observer(Protocol):
    """Someone who watches a run."""

    def note(self, text: str) -> None:
        """Take a remark."""

    def start(self, time: float, end: float) -> None:
        """Learn the time [s] that the run begins and ends at."""

    def step(self, row: Mapping[str, Value]) -> None:
        """Take a step's row of the log."""

    def frame(self, index: int, last: int) -> None:
        """Learn that a frame is taken; its files follow."""


class TimeLeft:
    """The wall time that a run still needs, at the rate of its recent past: a run grows slower when its liquid spreads."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        """Begin without knowledge."""
        self._clock = clock
        self._marks: deque[tuple[float, float]] = deque()
        self._end = 0.0

    def start(self, time: float, end: float) -> None:
        """Begin at a simulated time [s] that is to reach `end`. The first step, which loads kernels, does not count."""
        self._end = end
        self._marks.clear()

    def advance(self, time: float) -> None:
        """Note that the run has reached a simulated time [s]."""
        now = self._clock()
        self._marks.append((now, time))
        while len(self._marks) > 2 and self._marks[1][0] < now - WINDOW:
            self._marks.popleft()

    def seconds(self) -> float | None:
        """Return the seconds left, or None before there is a rate."""
        if len(self._marks) < 2:
            return None
        (begun, before), (now, reached) = self._marks[0], self._marks[-1]
        if reached <= before:
            return None
        return (self._end - reached) * (now - begun) / (reached - before)

    def __str__(self) -> str:
        """Return the time left as h:mm:ss."""
        left = self.seconds()
        if left is None:
            return "-:--:--"
        minutes, seconds = divmod(round(left), 60)
        return f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}"


class Lines:
    """A plain line for each frame."""

    def __init__(self, console: Console) -> None:
        """Write to `console`."""
        self._console = console
        self._left = TimeLeft()
        self._row: Mapping[str, Value] = {}

    def __enter__(self) -> Self:
        """Return the observer itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Do nothing."""

    def note(self, text: str) -> None:
        """Write a remark."""
        self._write(one_line(text))

    def start(self, time: float, end: float) -> None:
        """Learn the time [s] that the run begins and ends at."""
        self._left.start(time, end)

    def step(self, row: Mapping[str, Value]) -> None:
        """Remember a step's row of the log."""
        self._row = row
        self._left.advance(_number(row, "time"))

    def frame(self, index: int, last: int) -> None:
        """Write a line."""
        self._write(
            f"frame {index}/{last}  t {_number(self._row, 'time'):.4g} s  {describe(self._row)}  {self._left} left"
            if self._row
            else f"frame {index}/{last}"
        )

    def _write(self, text: str) -> None:
        say(self._console, text)


class Bar:
    """A bar of simulated time, the last step's numbers and the time left."""

    def __init__(self, console: Console) -> None:
        """Draw on `console`."""
        text = TextColumn("{task.description}", table_column=Column(no_wrap=True))
        bar = BarColumn(bar_width=None, table_column=Column(ratio=1))  # what the text leaves of the line
        percent = TaskProgressColumn(table_column=Column(no_wrap=True, width=4))
        self._console = console
        self._progress = Progress(bar, percent, text, console=console, refresh_per_second=4, expand=True)
        self._task = self._progress.add_task("first step: loading kernels", total=None)
        self._left = TimeLeft()

    def __enter__(self) -> Self:
        """Begin to draw."""
        self._progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Leave the last state of the bar on the terminal."""
        self._progress.stop()

    def note(self, text: str) -> None:
        """Write a remark above the bar."""
        say(self._console, one_line(text))

    def start(self, time: float, end: float) -> None:
        """Learn the time [s] that the run begins and ends at."""
        self._left.start(time, end)
        self._progress.update(self._task, total=end, completed=time)

    def step(self, row: Mapping[str, Value]) -> None:
        """Show a step's numbers."""
        time = _number(row, "time")
        self._left.advance(time)
        self._progress.update(self._task, completed=time, description=escape(f"{self._left} left  {describe(row)}"))

    def frame(self, index: int, last: int) -> None:
        """Do nothing: the bar shows the time."""


def describe(row: Mapping[str, Value]) -> str:
    """Return a step's numbers as a line; what the simulation does not log is left out."""
    parts = [f"step {row['step']}", f"dt {_number(row, 'dt'):.2g} s"]
    if isinstance(row.get("solve_iterations"), int):
        parts.append(f"{row['solve_iterations']} iterations")
    if (residual := residual_of(row)) is not None:
        parts.append(f"residual {residual:.1e}" + f" ({row.get('solve_status')})" * missed(row))
    return "  ".join(parts)


def residual_of(row: Mapping[str, Value]) -> float | None:
    """Return what a step's solve left, in the unit of the scene's tolerance; None if there was no solve."""
    found = next((row[name] for name in RESIDUALS if isinstance(row.get(name), float)), None)
    return found if isinstance(found, float) else None


def missed(row: Mapping[str, Value]) -> bool:
    """Return whether a step's solve ended short of its tolerance."""
    return (row.get("solve_status") or CONVERGED) != CONVERGED


def _number(row: Mapping[str, Value], name: str) -> float:
    value = row[name]
    assert isinstance(value, (int, float))
    return float(value)
