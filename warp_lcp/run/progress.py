"""Progress of a run: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from datetime import timedelta
from types import TracebackType
from typing import Protocol, Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn
from rich.table import Column

from warp_lcp.files.size_limits import one_line
from warp_lcp.problem.result import SolveStatus
from warp_lcp.run.log import Value
from warp_lcp.run.terminal import print_text

# The first of these columns in a log is the one that the scene's tolerance bounds.
RESIDUALS = "coupled_residual", "solve_residual"
CONVERGED = SolveStatus.CONVERGED.name
LINE_EVERY = 5.0  # seconds between two lines of a count
WINDOW = 20.0  # seconds of the recent past that the estimate uses


class Observer(Protocol):
    """Observer of a run."""

    def note(self, text: str) -> None:
        """Receive a remark for the user."""

    def start(self, time: float, end: float) -> None:
        """Receive the start and end time [s] of the run."""

    def step(self, row: Mapping[str, Value]) -> None:
        """Receive a step's log row."""

    def frame(self, index: int, last: int) -> None:
        """Receive the number of a frame, before its files are written."""


def time_left(progress: Progress) -> str:
    """Return the estimated remaining wall time, at the recent rate.

    The first step, which loads kernels, does not count.
    """
    left = progress.tasks[0].time_remaining
    return f"{timedelta(seconds=left) if left is not None else '-:--:--'} left"


class ProgressLines:
    """Progress as plain lines, one per frame."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._progress = Progress(console=console, speed_estimate_period=WINDOW)  # never displayed
        self._task = self._progress.add_task("", total=None)
        self._row: Mapping[str, Value] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Do nothing."""

    def note(self, text: str) -> None:
        """Print a remark on a line of its own."""
        self._write(one_line(text))

    def start(self, time: float, end: float) -> None:
        """Store the start and end time [s] of the run."""
        _begin(self._progress, time, end)

    def step(self, row: Mapping[str, Value]) -> None:
        """Store a step's log row."""
        self._row = row
        self._progress.update(self._task, completed=_number(row, "time"))

    def frame(self, index: int, last: int) -> None:
        """Print a line with the frame, its time and the last step's numbers."""
        self._write(
            f"frame {index}/{last}  t {_number(self._row, 'time'):.4g} s  {describe(self._row)}  "
            f"{time_left(self._progress)}"
            if self._row
            else f"frame {index}/{last}"
        )

    def _write(self, text: str) -> None:
        print_text(self._console, text)


class ProgressBar:
    """Progress bar of simulated time, with the last step's numbers and time left."""

    def __init__(self, console: Console) -> None:
        text = TextColumn("{task.description}", table_column=Column(no_wrap=True))
        # The rest of the line.
        bar = BarColumn(bar_width=None, table_column=Column(ratio=1))
        percent = TaskProgressColumn(table_column=Column(no_wrap=True, width=4))
        self._console = console
        self._progress = Progress(
            bar,
            percent,
            text,
            console=console,
            refresh_per_second=4,
            expand=True,
            speed_estimate_period=WINDOW,
        )
        self._task = self._progress.add_task("first step: loading kernels", total=None)

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Leave the last state of the bar on the terminal."""
        self._progress.stop()

    def note(self, text: str) -> None:
        """Print a remark above the bar."""
        print_text(self._console, one_line(text))

    def start(self, time: float, end: float) -> None:
        """Store the start and end time [s] of the run."""
        _begin(self._progress, time, end)

    def step(self, row: Mapping[str, Value]) -> None:
        """Show a step's numbers and the time left beside the bar."""
        self._progress.update(self._task, completed=_number(row, "time"))
        self._progress.update(
            self._task, description=escape(f"{time_left(self._progress)}  {describe(row)}")
        )

    def frame(self, index: int, last: int) -> None:
        """Do nothing: the bar shows the time."""


class ProgressCounter:
    """Counter of finished items: a changing line on a terminal, else plain lines.

    Plain lines are printed every few seconds.

    Args:
        console: console for the lines.
        doing: name of the work, such as `drawing`.
        things: name of the items, such as `images`.
        clock: returns seconds.
    """

    def __init__(
        self, console: Console, doing: str, things: str, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._console, self._doing, self._things, self._clock = console, doing, things, clock
        self._status = console.status(doing)
        # Never displayed.
        self._progress = Progress(console=console, get_time=clock, speed_estimate_period=WINDOW)
        self._task = self._progress.add_task("", total=None)

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._status.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Clear the changing line."""
        self._status.stop()

    def __call__(self, done: int, of: int) -> None:
        """Update the number of finished items; the first call, with 0, starts."""
        if not done:
            _begin(self._progress, 0.0, of)
            self._last_report = self._clock()
            return
        self._progress.update(self._task, completed=done)
        text = f"{self._doing}: {done} of {of} {self._things}  {time_left(self._progress)}"
        if self._console.is_terminal:
            self._status.update(text)
        elif done < of and self._clock() - self._last_report >= LINE_EVERY:
            self._last_report = self._clock()
            print_text(self._console, text)


def _begin(progress: Progress, time: float, end: float) -> None:
    """Start the progress at a simulated time [s], up to `end`."""
    progress.reset(TaskID(0), total=end, completed=time)  # type: ignore[arg-type]


def describe(row: Mapping[str, Value]) -> str:
    """Return a step's numbers as a line, without missing columns."""
    parts = [f"step {row['step']}", f"dt {_number(row, 'dt'):.2g} s"]
    if isinstance(row.get("solve_iterations"), int):
        parts.append(f"{row['solve_iterations']} iterations")
    if (residual := residual_of(row)) is not None:
        parts.append(f"residual {residual:.1e}" + f" ({row.get('solve_status')})" * missed(row))
    return "  ".join(parts)


def residual_of(row: Mapping[str, Value]) -> float | None:
    """Return the residual of a step's solve; None without a solve.

    In the unit of the scene's tolerance.
    """
    found = next((row[name] for name in RESIDUALS if isinstance(row.get(name), float)), None)
    return found if isinstance(found, float) else None


def missed(row: Mapping[str, Value]) -> bool:
    """Return whether a step's solve missed its tolerance."""
    return (row.get("solve_status") or CONVERGED) != CONVERGED


def _number(row: Mapping[str, Value], name: str) -> float:
    value = row[name]
    assert isinstance(value, (int, float))
    return float(value)
