"""Interface of benchmark suites, with the entry-point group of plug-ins.

The group is `warp_lcp.benchmarks`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol, runtime_checkable

from warp_lcp.scene.simulator import entry_points, plug_ins

GROUP = "warp_lcp.benchmarks"


@runtime_checkable
class Benchmark(Protocol):
    """Benchmark suite: name, quantities measured, expected time and packages needed."""

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
        """Run the benchmark and return the files written to `out`.

        NAME.json, NAME.md and plots.

        Args:
            device: Warp device.
            out: folder of the files.
            sizes: cells along a side; default: those of the suite.
            repeat: samples of each timing.
            scene: the only one to measure, for a suite that runs scenes; a name or a file.
            seed: first one of the random problems, for a suite that draws them; default: new ones.
            shared: measure on several ranks, if the suite supports it.
            threads: threads of the CPU; default: one, and all for the suite threads.

        Raises:
            ValueError: an option is out of range.
            RuntimeError: a measurement failed.
        """

    def compare(self, old: Path, new: Path) -> str:
        """Return a table that compares two results, with noise bounds.

        Raises:
            ValueError: a file is not a result of a suite.
        """


def benchmarks() -> dict[str, Benchmark]:
    """Return the installed suites by name."""
    return plug_ins(GROUP, Benchmark, "a suite of benchmarks")


def suite_names() -> list[str]:
    """Return the names of the installed suites without loading them."""
    return sorted({entry.name for entry in entry_points(group=GROUP)})
