"""Suite `tradeoff`: cost of accuracy.

It compares seconds, iterations and bytes with residuals, errors and the visible results of a run.
"""

from __future__ import annotations

from pathlib import Path

from warp_lcp.benchmarks.harness.machine import machine
from warp_lcp.benchmarks.harness.record import Results
from warp_lcp.benchmarks.harness.timing import Options
from warp_lcp.benchmarks.tradeoff.charts import (
    preset_table,
    run_chart,
    run_table,
    solve_chart,
    solve_table,
)
from warp_lcp.benchmarks.tradeoff.runs import Runs
from warp_lcp.benchmarks.tradeoff.settings import TradeoffSetting, settings_of
from warp_lcp.benchmarks.tradeoff.solves import measure_solves
from warp_lcp.scene.presets import PRESETS, TRIAL_FRAMES, price_table
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.simulation import StepFailed

TITLE = "What accuracy costs"
SCENES = {"dam-break": 32, "column-collapse-2d": 48}  # cells along the longest side
QUICK = 16  # cells below which the runs are short, to test the suite
QUICK_FRAMES = 3


def measure(options: Options, out: Path) -> Results:
    """Run the scenes with all settings."""
    records = [machine(options.device, elements=1 << 22, repeat=options.repeat)]
    results = Results(records, [])
    for name in [options.scene] if options.scene else SCENES:
        resolution = max(
            options.sizes, default=SCENES.get(name) or load_scene(name).domain.resolution
        )
        frames = TRIAL_FRAMES if resolution > QUICK else QUICK_FRAMES
        _measure_scene(name, resolution, frames, options, results)
    return results


def _measure_scene(
    name: str, resolution: int, frames: int, options: Options, results: Results
) -> None:
    """Add the results of a scene."""
    runs = Runs(name, resolution, frames, options)
    scene = runs.scene()
    settings = settings_of(scene.scene.simulator)
    presets = [
        TradeoffSetting(f"preset {preset}", _overrides(scene.scene.simulator, preset))
        for preset in PRESETS
    ]
    measured = runs.measure([*presets, *settings])
    scene_records = [runs.record(run) for run in measured]
    if not any(run.trial for run in measured):
        raise StepFailed(f"{name}: no setting ran: {measured[0].failed}")
    solves, title = measure_solves(scene, options, frames), scene.scene.name
    results.records.extend([*scene_records, *solves])
    results.tables.extend(
        [
            preset_table(title, scene_records),
            run_table(title, scene_records),
            solve_table(title, solves),
        ]
    )
    results.charts.extend([*run_chart(title, scene_records), *solve_chart(title, solves)])


def _overrides(simulator: str, preset: str) -> tuple[str, ...]:
    """Return a preset's settings without those of models that a scene may lack."""
    settings = price_table()[simulator].presets[preset].settings
    return tuple(
        f"{key}={value:g}"
        for key, value in settings.items()
        if not key.startswith("density_correction")
    )
