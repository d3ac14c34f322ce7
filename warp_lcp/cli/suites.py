"""What the command line asks of a suite of benchmarks, and how it finds one: the entry-point group `warp_lcp.benchmarks`."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol, runtime_checkable

from warp_lcp.scene.simulator import entry_points, plug_ins

GROUP = "warp_lcp.benchmarks"


@runtime_checkable
class Benchmark(Protocol):
    """A suite of measurements: its name, what it measures, and how long it takes and what it needs."""

    name: str
    summary: str
    takes: str

    def run(
        self,
        *,
        device: str,
        out: Path,
        sizes: tuple[int, ...] = (),
        repeat: int = 5,
        scene: str = "",
        seed: int | None = None,
        shared: bool = False,
        threads: int | None = None,
    ) -> list[Path]:
        """Measure, and return the files written to `out`: NAME.json, NAME.md and plots.

        Args:
            device: Warp device.
            out: folder of the files.
            sizes: cells along a side; the suite's own without any.
            repeat: samples of each timing.
            scene: the only one to measure, of a suite that runs scenes; a name or a file.
            seed: first one of the random problems, of a suite that draws them; new ones without.
            shared: measure on several ranks, of a suite that can.
            threads: of the CPU; one without, and of the suite threads all.

        Raises:
            ValueError: an option is out of range.
            RuntimeError: a measurement failed.
        """

    def compare(self, old: Path, new: Path) -> str:
        """Return a table of the figures in two results with the bounds of noise.

        Raises:
            ValueError: a file is no result of a suite.
        """


def benchmarks() -> dict[str, Benchmark]:
    """Return the installed suites by name."""
    return plug_ins(GROUP, Benchmark, "a suite of benchmarks")


def suite_names() -> list[str]:
    """Return the names of the installed suites, which are not loaded."""
    return sorted({entry.name for entry in entry_points(group=GROUP)})
