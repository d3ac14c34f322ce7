"""Runs of a scene with many settings: cost, and distance from a reference run."""

from __future__ import annotations

import gc
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache

from warp_lcp.benchmarks.harness.machine import array_bytes
from warp_lcp.benchmarks.harness.record import BenchmarkRecord
from warp_lcp.benchmarks.harness.timing import Figure, Options
from warp_lcp.benchmarks.tradeoff.settings import REFERENCE, TradeoffSetting
from warp_lcp.files import Tables
from warp_lcp.run.trial import BIN, Trial, trial
from warp_lcp.scene.presets import changed, price_table
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.table import SceneError
from warp_lcp.simulation import SimulationFailed, StepFailed


@dataclass
class TradeoffRun:
    """Runs of one setting."""

    setting: TradeoffSetting  # the setting
    trial: Trial | None = None  # result of its first run
    seconds: list[float] = field(default_factory=list)  # seconds of all its runs
    bytes: int = 0  # device arrays at the end
    failed: str = ""  # why it has no trial


class Runs:
    """Runs of a scene with all settings, and their reference runs.

    Args:
        name: the scene's name or file.
        resolution: cells along its longest side; settings scale it.
        frames: number of frames of a run.
        options: device and number of repeats.
    """

    def __init__(self, name: str, resolution: int, frames: int, options: Options) -> None:
        self.name, self.resolution, self.frames, self.options = name, resolution, frames, options
        self.box = BIN * self.scene().spacing
        self.reference = cache(self._reference)

    def scene(self, overrides: Sequence[str] = (), scale: float = 1.0) -> Scene:
        """Return the scene with other values, at a scaled resolution."""
        return load_scene(
            self.name, [f"domain.resolution={round(scale * self.resolution)}", *overrides]
        )

    def measure(self, settings: Sequence[TradeoffSetting]) -> list[TradeoffRun]:
        """Run all settings, interleaved."""
        runs = [TradeoffRun(setting) for setting in settings]
        for turn in range(self.options.repeat):
            for number, run in enumerate(runs):
                if run.failed:
                    continue
                if number % 20 == 0:
                    self.options.say(
                        f"{self.name}, round {turn + 1} of {self.options.repeat}: setting "
                        f"{number + 1} of {len(runs)}"
                    )
                self._add(run)
        return runs

    def figures(self, run: TradeoffRun) -> dict[str, Figure]:
        """Return a run's figures; none if it has failed."""
        ran = run.trial
        if ran is None:
            return {}
        own, finest = self.reference(run.setting.scale), self.reference(REFERENCE)
        values = {
            "seconds": Figure.least(run.seconds, "s"),
            "bytes": Figure(run.bytes, "B"),
            "distance": Figure(ran.distance(own)),
            "distance_to_finest": Figure(ran.distance(finest)),
            "energy_error": Figure(ran.energy_error(own)),
            "front": Figure(ran.looks[-1].front - ran.looks[0].front, "m"),
            "front_error": Figure(ran.front_error(own), "m"),
        }
        names = (
            "steps",
            "iterations",
            "linear_iterations",
            "residual",
            "volume_drift",
            "packing",
            "penetration",
        )
        return values | {
            name: Figure(value) for name in names if (value := getattr(ran, name)) is not None
        }

    def record(self, run: TradeoffRun) -> BenchmarkRecord:
        """Return the record of a run."""
        setting, scene = run.setting, self.scene().scene.name
        facts: Tables = {
            "scene": scene,
            "kind": "run",
            "curve": setting.curve,
            "settings": setting.name,
        }
        facts |= {
            "device": self.options.device,
            "frames": self.frames,
            "resolution": round(setting.scale * self.resolution),
        }
        facts |= {"scale": setting.scale} | ({"failed": run.failed} if run.failed else {})
        return BenchmarkRecord(f"{scene} {setting.curve}: {setting.name}", self.figures(run), facts)

    def _reference(self, scale: float) -> Trial:
        """Return the reference at a resolution: smallest steps and tolerance."""
        scene = self.scene(scale=scale)
        self.options.say(f"{self.name}: reference at resolution {scene.domain.resolution}")
        best = changed(scene, price_table()[scene.scene.simulator].reference)
        return trial(best, device=self.options.device, frames=self.frames, box=self.box)

    def _add(self, run: TradeoffRun) -> None:
        """Run a setting once more."""
        gc.collect()
        before, after = array_bytes(), list[int]()
        try:
            scene = self.scene(run.setting.overrides, run.setting.scale)
            if not run.seconds:  # loads the kernels
                trial(scene, device=self.options.device, frames=1, box=self.box)
            ran = trial(
                scene,
                device=self.options.device,
                frames=self.frames,
                box=self.box,
                inspect=lambda _: after.append(array_bytes()),
            )
        except (SceneError, StepFailed, SimulationFailed) as error:
            run.failed = str(error).replace("\n", " ")
            return
        run.trial, run.bytes = ran, after[0] - before
        run.seconds.append(ran.seconds)


def front_of(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the Pareto front: points that no other one beats in both coordinates.

    They are in order of the first coordinate.
    """
    best, found = float("inf"), []
    for index in sorted(range(len(points)), key=lambda i: points[i]):
        if points[index][1] < best:
            best = points[index][1]
            found.append(index)
    return found
