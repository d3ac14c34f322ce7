"""Runs of a scene with many settings: what they cost, and how far what they show is from a reference run."""

from __future__ import annotations

import gc
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache

from warp_lcp.benchmarks.harness.machine import array_bytes
from warp_lcp.benchmarks.harness.timing import Figure, Options
from warp_lcp.benchmarks.tradeoff.settings import REFERENCE, Setting
from warp_lcp.run.trial import BIN, Trial, trial
from warp_lcp.scene.presets import changed, price_table
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.table import SceneError
from warp_lcp.simulation import SimulationFailed, StepFailed

FRAMES = 18


@dataclass
class Run:
    """What a setting took."""

    setting: Setting  # the setting
    trial: Trial | None = None  # of its first run
    seconds: list[float] = field(default_factory=list)  # of all its runs
    bytes: int = 0  # of device arrays at the end
    failed: str = ""  # why it has no trial


class Runs:
    """A scene's runs and their references.

    Args:
        name: the scene's name or file.
        resolution: cells along its longest side, what settings scale.
        frames: of a run.
        options: device and repeats.
    """

    def __init__(self, name: str, resolution: int, frames: int, options: Options) -> None:
        self.name, self.resolution, self.frames, self.options = name, resolution, frames, options
        self.box = BIN * self.scene().spacing
        self.reference = cache(self._reference)

    def scene(self, overrides: Sequence[str] = (), scale: float = 1.0) -> Scene:
        """Return the scene with other values, at a scaled resolution."""
        return load_scene(self.name, [f"domain.resolution={round(scale * self.resolution)}", *overrides])

    def measure(self, settings: Sequence[Setting]) -> list[Run]:
        """Run all settings, in turns."""
        runs = [Run(setting) for setting in settings]
        for turn in range(self.options.repeat):
            for number, run in enumerate(runs):
                if run.failed:
                    continue
                if number % 20 == 0:
                    self.options.say(f"{self.name}, round {turn + 1} of {self.options.repeat}: setting {number + 1} of {len(runs)}")
                self._add(run)
        return runs

    def figures(self, run: Run) -> dict[str, Figure]:
        """Return a run's figures; without it, none."""
        ran = run.trial
        if ran is None:
            return {}
        own, finest = self.reference(run.setting.scale), self.reference(REFERENCE)
        found = {
            "seconds": Figure.least(run.seconds, "s"),
            "steps": Figure(ran.steps),
            "iterations": Figure(ran.iterations),
            "linear_iterations": Figure(ran.linear_iterations),
            "bytes": Figure(run.bytes, "B"),
            "residual": Figure(ran.residual),
            "distance": Figure(ran.distance(own)),
            "distance_to_finest": Figure(ran.distance(finest)),
            "energy_error": Figure(ran.energy_error(own)),
            "front": Figure(ran.looks[-1].front - ran.looks[0].front, "m"),
            "front_error": Figure(ran.front_error(own), "m"),
        }
        more = {"volume_drift": ran.volume_drift, "packing": ran.packing, "penetration": ran.penetration}
        return found | {name: Figure(value) for name, value in more.items() if value is not None}

    def _reference(self, scale: float) -> Trial:
        """Return the run of the smallest steps and tolerance at a resolution."""
        scene = self.scene(scale=scale)
        self.options.say(f"{self.name}: reference at resolution {scene.domain.resolution}")
        return trial(
            changed(scene, price_table()[scene.scene.simulator].reference), device=self.options.device, frames=self.frames, box=self.box
        )

    def _add(self, run: Run) -> None:
        """Run a setting once more."""
        gc.collect()
        before, after = array_bytes(), []
        try:
            if not run.seconds:  # loads kernels
                trial(self.scene(run.setting.overrides, run.setting.scale), device=self.options.device, frames=1, box=self.box)
            scene = self.scene(run.setting.overrides, run.setting.scale)
            ran = trial(scene, device=self.options.device, frames=self.frames, box=self.box, inspect=lambda _: after.append(array_bytes()))
        except (SceneError, StepFailed, SimulationFailed) as error:
            run.failed = str(error).replace("\n", " ")
            return
        run.trial, run.bytes = ran, after[0] - before
        run.seconds.append(ran.seconds)


def front_of(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return which points no other one beats in both coordinates (the Pareto front), by growing first coordinate."""
    best, found = float("inf"), []
    for index in sorted(range(len(points)), key=lambda i: points[i]):
        if points[index][1] < best:
            best = points[index][1]
            found.append(index)
    return found
