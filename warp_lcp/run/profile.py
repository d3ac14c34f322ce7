"""Profile of a run: seconds and bytes by stage."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import warp as wp

from warp_lcp.files.atomic import write_text
from warp_lcp.kernels.thread_pool import get_threads, shared_seconds
from warp_lcp.run.terminal import table_lines

PROFILE = "profile.json"
KERNELS = "kernels, loaded"  # stage of modules that Warp compiles or loads
LOADED = re.compile(r"Module .* took ([0-9.]+) ms")  # message of Warp for each module


@dataclass
class ProfileStage:
    """Time and memory traffic of a stage.

    Args:
        beside: whether it ran on another thread.
        calls: number of calls.
        seconds: total time.
        first_seconds: time of the first call, which may allocate.
        bytes: least memory traffic: its arrays, each counted once per call, or its files.
        shared: part of `seconds` with all CPU threads at work.
    """

    beside: bool = False
    calls: int = 0
    seconds: float = 0.0
    first_seconds: float = 0.0
    bytes: int = 0
    shared: float = 0.0

    def add(self, seconds: float) -> None:
        """Add a call of some seconds."""
        self.first_seconds = self.first_seconds if self.calls else seconds
        self.calls += 1
        self.seconds += seconds


class KernelLoadTimes:
    """Warp logger that sums compile and load times of kernels.

    All messages are forwarded.

    Attributes:
        loads: number of module loads.
    """

    def __init__(self) -> None:
        self.loads = ProfileStage()
        self._logger, self._level = wp.get_logger(), wp.config.log_level

    def debug(self, message: str) -> None:
        """Forward a message to the previous logger."""
        if self._level <= wp.LOG_DEBUG:
            self._logger.debug(message)

    def info(self, message: str) -> None:
        """Forward a message, and count it if it reports a module."""
        if found := LOADED.search(message):
            self.loads.add(float(found[1]) * 1e-3)
        if self._level <= wp.LOG_INFO:
            self._logger.info(message)

    def warning(
        self, message: str, category: type[Warning] | None = None, stacklevel: int = 1
    ) -> None:
        """Forward a message to the previous logger."""
        if self._level <= wp.LOG_WARNING:
            self._logger.warning(message, category, stacklevel=stacklevel + 1)

    def error(self, message: str) -> None:
        """Forward a message to the previous logger."""
        self._logger.error(message)


class Profiler:
    """Timer of stages; the device is synchronized at the begin and end of each.

    Args:
        device: a Warp device, such as `cuda:0`.

    Attributes:
        stages: stages by name, in the order of their first calls.
    """

    def __init__(self, device: str) -> None:
        self.stages: dict[str, ProfileStage] = {}
        self._device = wp.get_device(device)
        self._loads = ProfileStage()

    @contextmanager
    def kernels_apart(self) -> Iterator[None]:
        """Count compile and load times of kernels as a separate stage."""
        kernels = KernelLoadTimes()
        self.stages[KERNELS] = self._loads = kernels.loads
        with wp.ScopedLogger(kernels), wp.ScopedLogLevel(min(wp.config.log_level, wp.LOG_INFO)):
            yield

    @contextmanager
    def stage(self, name: str, *arrays: wp.array | None) -> Iterator[None]:
        """Measure a stage of the run's own thread."""
        self._wait()
        loading, start_time, shared = self._loads.seconds, time.perf_counter(), shared_seconds()
        try:
            yield
        finally:
            self._wait()
            stage = self.stages.setdefault(name, ProfileStage())
            stage.add(time.perf_counter() - start_time - (self._loads.seconds - loading))
            stage.shared += shared_seconds() - shared
            stage.bytes += sum(
                array.size * wp.types.type_size_in_bytes(array.dtype)
                for array in arrays
                if array is not None
            )

    @contextmanager
    def beside(self, name: str) -> Iterator[None]:
        """Measure a stage on another thread."""
        begun = time.perf_counter()
        try:
            yield
        finally:
            self.stages.setdefault(name, ProfileStage(beside=True)).add(time.perf_counter() - begun)

    def add_file_sizes(self, name: str, *files: Path) -> None:
        """Add the sizes of files to a stage; a missing file counts as 0."""
        for file in files:
            with suppress(FileNotFoundError):
                self.stages[name].bytes += file.stat().st_size

    def table(self, steps: int, seconds: float) -> str:
        """Return a table of the stages, and of the remaining time.

        Args:
            steps: number of steps of the run.
            seconds: time of the run.
        """
        rows = []
        for name, stage in self.stages.items():
            share = (
                f"{stage.shared / stage.seconds:.0%}"
                if stage.seconds > 0.0 and get_threads() > 1 and not stage.beside
                else ""
            )
            rows.append(
                (
                    f"({name})" if stage.beside else name,
                    *_figures(stage.seconds, stage.bytes, steps, seconds),
                    share,
                )
            )
        rest = seconds - sum(stage.seconds for stage in self.stages.values() if not stage.beside)
        rows += [
            ("rest", *_figures(rest, 0, steps, seconds), ""),
            ("all", *_figures(seconds, 0, steps, seconds), ""),
        ]
        heads = (
            "stage",
            "seconds",
            "share",
            "ms a step",
            "MB a step",
            "GB/s",
            f"on {get_threads()} threads",
        )
        return (
            table_lines(heads, rows)
            if get_threads() > 1
            else table_lines(heads[:-1], [row[:-1] for row in rows])
        )

    def write(self, folder: Path, steps: int, seconds: float) -> None:
        """Write profile.json.

        Args:
            folder: folder of the run.
            steps: number of steps of the run.
            seconds: time of the run.

        Raises:
            OSError: the file cannot be written.
        """
        stages = [{"stage": name, **vars(stage)} for name, stage in self.stages.items()]
        data = {
            "device": self._device.alias,
            "threads": get_threads(),
            "steps": steps,
            "seconds": seconds,
            "stages": stages,
        }
        write_text(folder / PROFILE, json.dumps(data, indent=2) + "\n")

    def _wait(self) -> None:
        if self._device.is_cuda:
            wp.synchronize_device(self._device)


def _figures(
    seconds: float, moved: int, steps: int, total: float
) -> tuple[str, str, str, str, str]:
    """Return the figures of a stage as texts.

    Time [s], share, time per step [ms], traffic per step [MB], speed [GB/s].
    """
    each = max(steps, 1)
    speed = f"{moved / seconds / 1e9:.2f}" if moved and seconds > 0.0 else ""
    share = f"{seconds / total:.1%}" if total > 0.0 else ""
    return (
        f"{seconds:.3f}",
        share,
        f"{seconds / each * 1e3:.3f}",
        f"{moved / each / 1e6:.2f}" if moved else "",
        speed,
    )
