"""Launches and readbacks of a step, counted in the emulation of CUDA on the CPU.

`python -m benchmarks.gpu_model --readbacks [SCENE ...]` prints the table of `docs/gpu.md`.
"""

from benchmarks import emulated_cuda  # must precede the package

# ruff: isort: split

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import numpy as np

from warp_lcp.kernels.launch_graph import LaunchGraph
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.simulator import simulators

FIRST, COUNTED = 3, 7  # steps before the counted ones: they load kernels and capture graphs
LONGEST = 0.004  # longest step [s]


class CountedScene(NamedTuple):
    """Scene of a row of the table: its name, overrides and cells along x."""

    scene: str
    overrides: tuple[str, ...] = ()
    cells: int = 32


# Less than the actual density: the correction moves particles in each step.
CROWDED = "density_correction.max_density=0.9"
LIGHT = tuple(f"solid.{n}.density=60" for n in range(4))  # [kg/m^3]
# Bodies of less than three cells would be met as exact shapes, by more launches: 96 cells in 2-D.
SCENES = {
    "`dam-break`": CountedScene("dam-break"),
    "`dam-break`, density correction": CountedScene("dam-break", (CROWDED,)),
    "`column-collapse` (80 iterations)": CountedScene("column-collapse", cells=16),
    "`sliding-drop`": CountedScene("sliding-drop"),
    "`splash-unilateral`": CountedScene("splash-unilateral"),
    "`floating-bodies`, density correction": CountedScene("floating-bodies", (CROWDED,)),
    "`floating-bodies-2d`": CountedScene("floating-bodies-2d", cells=96),
    "`floating-bodies-2d`, 60 kg/m^3": CountedScene("floating-bodies-2d", LIGHT, cells=96),
    "`honey-coil`": CountedScene("honey-coil"),
    "`balls-on-sand-2d`": CountedScene("balls-on-sand-2d"),
}


def counts(row: CountedScene, *, graphs: bool) -> np.ndarray:
    """Return calls, readbacks and allocations of each counted step, shape (COUNTED, 3).

    Args:
        row: of the table.
        graphs: whether the stretches of a step are graphs.
    """
    scene = load_scene(row.scene, [f"domain.resolution={row.cells}", *row.overrides])
    steps = []
    with mock.patch.object(LaunchGraph, "on_device", graphs):
        kind = simulators()[scene.scene.simulator]
        simulation = kind.create(scene, device="cpu", folder=Path.cwd())
        for _ in range(FIRST + COUNTED):
            emulated_cuda.meter.clear()
            simulation.step(min(simulation.stable_dt(), LONGEST))
            meter = emulated_cuda.meter
            steps.append([meter["calls"], meter["readbacks"], meter["allocations"]])
    return np.array(steps[FIRST:])


def span(values: np.ndarray) -> str:
    """Return the usual number, or the range of several; the largest is apart if it is rare.

    A number is rare if one step of all has it.
    """
    usual, last = np.sort(values)[:-1], int(values.max())
    low, high = int(usual.min()), int(usual.max())
    text = str(low) if low == high else f"{low} to {high}"
    return text if last == high else f"{text}, once {last}"


def table(names: Iterable[str]) -> Iterator[str]:
    """Yield the lines of the table, of the named scenes or of all."""
    head = ("scene", "launches, step graphs", "launches, without", "readbacks", "allocations")
    yield f"| {' | '.join(head)} |"
    yield "|---" * len(head) + "|"
    chosen = tuple(names)
    for title, row in SCENES.items():
        if chosen and row.scene not in chosen:
            continue
        on, off = (counts(row, graphs=graphs) for graphs in (True, False))
        columns = [span(on[:, 0]), span(off[:, 0]), span(on[:, 1]), span(off[:, 2])]
        yield f"| {title} | {' | '.join(columns)} |"
