"""What `warp-lcp tune` finds, against the best of all its settings, on scenes that the presets were not made on."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.machine import machine
from benchmarks.record import Record, Results, Table
from benchmarks.timing import Figure, Options
from warp_lcp.driver.presets import PresetName, Prices, changed, price_table
from warp_lcp.driver.scene import Scene
from warp_lcp.driver.scene_file import load_scene
from warp_lcp.driver.simulator import SimulationFailed, StepFailed
from warp_lcp.driver.trial import trial
from warp_lcp.driver.tune import CORRECTED_EVERY, FRAMES, Tuning, near_enough, tune

TITLE = "Tuned settings against the best of all"
SCENES = {
    "retracting-wall": 60,
    "ceiling-drop": 32,
    "inclined-layer": 32,
    "mesh-obstacle": 20,
    "sand-on-mesh": 16,
}  # cells along the longest side
ACCURACY: PresetName = "standard"
MOST = 1.2  # times the best
NEAR = 1.5  # times the shortest: what is timed again


@dataclass
class Timed:
    """Settings of the whole sweep, the shortest time of their runs, their distance, and whether that and the volume are near enough."""

    settings: dict[str, Any]
    seconds: float
    distance: float
    met: bool

    def words(self) -> str:
        """Return the settings in a line."""
        return " ".join(f"{key}={value:g}" for key, value in self.settings.items())


def measure(options: Options, out: Path) -> Results:
    """Tune each scene, then run all settings of the sweep, and time those near the best again, in turns with what tuning chose."""
    records, rows, failures = [machine(options.device, elements=1 << 22, repeat=options.repeat)], [], []
    for name in [options.scene] if options.scene else SCENES:
        overrides = [f"domain.resolution={max(options.sizes, default=SCENES.get(name, 0))}"] if options.sizes or name in SCENES else []
        scene = load_scene(name, overrides)
        options.say(f"{name}: tuning")
        tuning = tune(scene, accuracy=ACCURACY, device=options.device)
        own = Timed(tuning.chosen.settings, tuning.chosen.seconds, tuning.chosen.distance, tuning.met)
        swept = _sweep(scene, tuning, options)
        best = _best(scene, own, [s for s in swept if s.met], options)
        ratio = own.seconds / best.seconds
        figures = {
            "tuned": Figure(own.seconds, "s"),
            "best": Figure(best.seconds, "s"),
            "ratio": Figure(ratio),
            "distance": Figure(own.distance),
            "best_distance": Figure(best.distance),
            "bound": Figure(tuning.preset.distance),
            "trials": Figure(len(tuning.tried) + 1),
            "swept": Figure(len(swept)),
        }
        records.append(Record(name, figures, {"tuned_settings": own.words(), "best_settings": best.words(), "met": tuning.met}))
        verdict = f"{ratio:.2f}" if tuning.met else "nothing near enough"
        found = [own.words(), f"{own.seconds:.3f}", f"{own.distance:.4f}", f"{len(tuning.tried)}"]
        rows.append([name, *found, best.words(), f"{best.seconds:.3f}", f"{best.distance:.4f}", f"{len(swept)}", verdict])
        if tuning.met and ratio > MOST:
            failures.append(f"{name}: tuning takes {ratio:.2f} times the best")
        if not tuning.met and any(s.met for s in swept):
            failures.append(f"{name}: tuning found nothing near enough, though there is")
    columns = ["scene", "tuned", "seconds", "distance", "trials", "best of all", "seconds", "distance", "settings", "ratio"]
    remark = f"Accuracy {ACCURACY}; the ratio must be at most {MOST:g}. Seconds: the least of all timings, in turns."
    return Results(records, [Table(TITLE, columns, rows, remark)], failures=failures)


def _all_settings(scene: Scene, prices: Prices, tuned: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Return every combination of steps, tolerances and density corrections; what else was tuned stays."""
    corrections = CORRECTED_EVERY if getattr(scene, "density_correction", None) is not None else (None,)
    for (cfl, dt_max), tolerance, every in itertools.product(prices.steps, prices.tolerances, corrections):
        correction = {} if every is None else {"density_correction.every": every}
        yield {**tuned, "time.cfl": cfl, "time.dt_max": dt_max, "solver.tolerance": tolerance, **correction}


def _sweep(scene: Scene, tuning: Tuning, options: Options) -> list[Timed]:
    """Run all settings once."""
    found = []
    for settings in _all_settings(scene, price_table()[scene.scene.simulator], tuning.chosen.settings):
        try:
            ran = trial(changed(scene, settings), device=options.device, frames=FRAMES)
        except (StepFailed, SimulationFailed) as error:
            options.say(f"{settings}: {error}")
            continue
        found.append(Timed(settings, ran.seconds, ran.distance(tuning.reference), near_enough(ran, tuning.reference, tuning.preset)))
    options.say(f"{scene.scene.name}: {len(found)} settings")
    return found


def _best(scene: Scene, own: Timed, met: list[Timed], options: Options) -> Timed:
    """Time the tuned settings and those near the best again; return the best, which may be the tuned ones."""
    shortest = min([own.seconds, *(s.seconds for s in met)])
    near = [own, *(s for s in met if s.seconds <= NEAR * shortest and s.settings != own.settings)]
    for _ in range(options.repeat):
        for timed in near:
            timed.seconds = min(timed.seconds, trial(changed(scene, timed.settings), device=options.device, frames=FRAMES).seconds)
    return min(near, key=lambda s: s.seconds)
