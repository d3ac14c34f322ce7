"""Interleaved timing of things that are compared.

Each is timed once in a round, so that a slow moment of a shared machine affects all of them.
"""

from __future__ import annotations

import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from types import ModuleType
from unittest.mock import patch

import warp as wp

# [s] Shorter work is repeated up to this time, to hide the cost of clock and launch.
SHORTEST_SAMPLE = 2e-3


@dataclass(frozen=True)
class Options:
    """Options of a suite."""

    device: str  # Warp device
    sizes: tuple[int, ...]  # cells along a side; empty for the default sizes
    repeat: int  # samples of each timing
    say: Callable[[str], object]  # prints a line of progress
    scene: str = ""  # name or file of the scene; empty for the default scenes
    seed: int | None = None  # first seed of random problems; None for one never drawn before


@dataclass(frozen=True)
class Figure:
    """Measured or counted number."""

    value: float  # the median
    unit: str = ""  # unit of value, low and high; empty for counts and ratios
    low: float | None = None  # smallest sample
    high: float | None = None  # largest sample
    samples: int = 1  # number of samples

    @staticmethod
    def of(samples: Sequence[float], unit: str = "") -> Figure:
        """Return the median with its range; one sample has no range."""
        if len(samples) == 1:
            return Figure(samples[0], unit)
        return Figure(statistics.median(samples), unit, min(samples), max(samples), len(samples))

    @staticmethod
    def least(samples: Sequence[float], unit: str = "") -> Figure:
        """Return the smallest sample with the range."""
        return replace(Figure.of(samples, unit), value=min(samples))

    @property
    def range(self) -> tuple[float, float]:
        """Smallest and largest sample."""
        return (
            (self.value, self.value)
            if self.low is None or self.high is None
            else (self.low, self.high)
        )

    def as_dict(self) -> dict[str, float | int | str]:
        """Return the entries of a file."""
        more = (
            {}
            if self.low is None or self.high is None
            else {"min": self.low, "max": self.high, "samples": self.samples}
        )
        return {"value": self.value, "unit": self.unit, **more}

    @staticmethod
    def from_dict(kept: Mapping[str, float | int | str]) -> Figure:
        """Return a figure from the entries of a file."""
        low, high = (float(kept[name]) if name in kept else None for name in ("min", "max"))
        return Figure(
            float(kept["value"]), str(kept.get("unit", "")), low, high, int(kept.get("samples", 1))
        )

    def __str__(self) -> str:
        """Return the number with its range."""
        text = f"{self.value:.4g}{f' {self.unit}' if self.unit else ''}"
        return (
            text
            if self.low is None or self.samples == 1
            else f"{text} ({self.low:.4g} to {self.high:.4g})"
        )


def in_turns(work: Mapping[str, Callable[[], object]], repeat: int) -> dict[str, list[float]]:
    """Return the seconds of each piece of work, interleaved in `repeat` rounds.

    An unmeasured run comes before each sample, so that the caches hold the same data whatever ran
    before.
    """
    times: dict[str, list[float]] = {name: [] for name in work}
    runs = {}
    for name, run in work.items():
        run()
        runs[name] = max(1, min(1000, int(SHORTEST_SAMPLE / max(seconds(run), 1e-7))))
    for _ in range(repeat):
        for name, run in work.items():
            run()
            begun = time.perf_counter()
            for _ in range(runs[name]):
                run()
            times[name].append((time.perf_counter() - begun) / runs[name])
    return times


def seconds(run: Callable[[], object]) -> float:
    """Return the wall time of one run [s]."""
    begun = time.perf_counter()
    run()
    return time.perf_counter() - begun


def ratios(a: Sequence[float], b: Sequence[float]) -> Figure:
    """Return a / b of samples of the same rounds."""
    return Figure.of([x / y for x, y in zip(a, b, strict=True)])


def clock(device: str) -> Callable[[], float]:
    """Return a clock [s]; on a CPU that of the process.

    Other programs do not affect CPU time.
    """
    return time.perf_counter if wp.get_device(device).is_cuda else time.process_time


@contextmanager
def timed(
    device: str, functions: dict[str, tuple[ModuleType | type, str]]
) -> Iterator[dict[str, list[float]]]:
    """Time every call of functions that callers look up in a module or a class.

    Args:
        device: device to synchronize around each call.
        functions: module or class and name of each function, by label.

    Yields:
        Seconds of the calls so far, by label.
    """
    seconds: dict[str, list[float]] = defaultdict(list)

    def watch(label: str, function: Callable[..., object]) -> Callable[..., object]:
        def call(*args: object, **options: object) -> object:
            wp.synchronize_device(device)
            begun = time.perf_counter()
            try:
                return function(*args, **options)
            finally:
                wp.synchronize_device(device)
                seconds[label].append(time.perf_counter() - begun)

        return call

    with ExitStack() as stack:
        for label, (module, name) in functions.items():
            stack.enter_context(patch.object(module, name, watch(label, getattr(module, name))))
        yield seconds
