"""The time of a step that the list of prices predicts, against the measured one, on the built-in scenes: none of them made the list.

python -m warp_lcp.benchmarks.predictions          # prints the table; those of `python -m warp_lcp.benchmarks.models` go to docs/models.md
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

from warp_lcp.benchmarks.models import create, markdown, step_seconds_of
from warp_lcp.benchmarks.record import Record, Results, Table
from warp_lcp.benchmarks.timing import Figure, Options
from warp_lcp.material.particle_scene import ParticleScene
from warp_lcp.run.loop import SAME_TIME
from warp_lcp.run.stepping import plan_dt
from warp_lcp.scene.models import predicted_seconds, prices
from warp_lcp.scene.scene_file import built_in_scenes, load_scene

TITLE = "Predicted and measured"
ENOUGH = 4.0  # seconds of steps, of a run's beginning
NEAR = 1.5  # times


def measured_seconds(scene: ParticleScene, device: str) -> tuple[float, float]:
    """Return the mean seconds of a step but for the first, which loads kernels, and of the iterations of its solve."""
    simulation = create(scene, device)
    seconds: list[float] = []
    iterations: list[int] = []
    for frame in range(1, scene.time.frame_count + 1):
        while scene.time.frame_time(frame) - simulation.time > SAME_TIME / scene.time.frames_per_second and sum(seconds[1:]) < ENOUGH:
            dt = plan_dt(simulation.stable_dt(), scene.time.frame_time(frame) - simulation.time, scene.time)
            spent, row = step_seconds_of(simulation, dt)
            seconds.append(spent)
            iterations.append(int(row["solve_iterations"] or 0))
    return sum(seconds[1:]) / (len(seconds) - 1), sum(iterations) / len(iterations)


def measure(options: Options, out: Path) -> Results:
    """Run the beginnings of the built-in scenes of a plane, whose steps are short."""
    records, rows = [], []
    for name in sorted(built_in_scenes()):
        scene = load_scene(name)
        if not isinstance(scene, ParticleScene) or scene.dimension != 2:
            continue
        options.say(name)
        cells, particles = math.prod(scene.cell_counts), scene.particle_estimate()
        told = predicted_seconds(scene.models(), prices(scene.scene.simulator, scene.dimension), cells, particles)
        taken, iterations = measured_seconds(scene, options.device)
        figures = {"predicted": Figure(told, "s"), "measured": Figure(taken, "s"), "ratio": Figure(told / taken)}
        records.append(Record(name, figures | {"iterations": Figure(iterations)}, {"cells": cells, "particles": particles}))
        rows.append([name, f"{cells:,}", f"{iterations:.0f}", f"{1e3 * told:.1f}", f"{1e3 * taken:.1f}", f"{told / taken:.2f}"])
    near = sum(1.0 / NEAR <= record.figures["ratio"].value <= NEAR for record in records)
    remark = (
        f"A step by the list of prices and its mean over up to {ENOUGH:g} s of steps of scenes that the list was not made on: {near} of "
        f"{len(records)} within a factor of {NEAR:g}. What the list cannot know is how many iterations a solve takes."
    )
    return Results(records, [Table(TITLE, ["scene", "cells", "iterations", "ms, predicted", "ms, measured", "ratio"], rows, remark)])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    given = parser.parse_args()
    sys.stdout.write(f"{markdown(measure(Options(given.device, (), 1, lambda text: None), Path()).tables[0])}\n")


if __name__ == "__main__":
    main()
