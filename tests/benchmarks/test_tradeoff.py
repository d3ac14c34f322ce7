"""Suite `tradeoff`: settings, Pareto front, and small runs."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from default_run import slow
from warp_lcp.benchmarks import tradeoff
from warp_lcp.benchmarks.harness import report
from warp_lcp.benchmarks.harness.timing import Options
from warp_lcp.benchmarks.tradeoff import solves
from warp_lcp.benchmarks.tradeoff.runs import Runs, front_of
from warp_lcp.benchmarks.tradeoff.settings import TradeoffSetting, settings_of
from warp_lcp.cli import commands as cli
from warp_lcp.scene.scene_file import load_scene

pytestmark = pytest.mark.usefixtures("only_new_objects")


def options(**changes: object) -> Options:
    return Options(
        **({"device": "cpu", "sizes": (16,), "repeat": 1, "say": lambda text: None} | changes)
    )  # type: ignore[arg-type]


def test_the_pareto_front_against_all_pairs() -> None:
    rng = np.random.default_rng(8123)
    for _ in range(20):
        points = [(float(x), float(y)) for x, y in rng.integers(0, 12, (40, 2))]
        best = {
            p for p in points if not any(q != p and q[0] <= p[0] and q[1] <= p[1] for q in points)
        }
        found = [points[i] for i in front_of(points)]
        assert set(found) == best
        assert found == sorted(best)


@pytest.mark.parametrize("name", tradeoff.SCENES)
def test_the_scene_accepts_all_sixty_settings(name: str) -> None:
    settings = settings_of(load_scene(name).scene.simulator)
    assert len(settings) >= 60
    assert len({setting.name for setting in settings}) == len(settings)
    for setting in settings:
        resolution = round(setting.scale * tradeoff.SCENES[name])
        assert (
            load_scene(
                name, [f"domain.resolution={resolution}", *setting.overrides]
            ).domain.resolution
            == resolution
        )


def test_axes_that_are_compared() -> None:
    words = " ".join(setting.name for setting in settings_of("fluids"))
    for key in (
        "time.cfl",
        "solver.tolerance",
        "solver.precision",
        "solver.method",
        "pressure.model",
        "pressure.surface",
        "resolution x",
    ):
        assert key in words
    with pytest.raises(ValueError, match="simulator smoke: has no settings"):
        settings_of("smoke")


def test_a_run_is_compared_with_its_own_reference_and_the_finest() -> None:
    runs = Runs("dam-break-2d", 16, 3, options())
    long, short = runs.measure(
        [
            TradeoffSetting("a", ("time.dt_max=0.04", "time.cfl=8")),
            TradeoffSetting("b", ("time.dt_max=0.004", "time.cfl=0.5")),
        ]
    )
    for run in (long, short):
        assert len(run.seconds) == 1
        assert run.bytes > 16 * 8 * 50  # fields of the grid alone
    far, near = runs.figures(long), runs.figures(short)
    assert far["distance"].value > near["distance"].value > 0.0
    assert near["distance_to_finest"].value > near["distance"].value  # error of the grid itself
    assert far["steps"].value < near["steps"].value
    refused = runs.measure([TradeoffSetting("c", ("time.cfl=1", "liquid.0.max=[9.0]"))])[0]
    assert refused.trial is None
    assert "liquid" in refused.failed
    assert runs.figures(refused) == {}


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the suite small."""
    kept = [
        TradeoffSetting(f"cfl {cfl:g}", (f"time.cfl={cfl:g}", f"time.dt_max={0.005 * cfl:g}"))
        for cfl in (4.0, 1.0)
    ]
    monkeypatch.setattr(tradeoff, "settings_of", lambda simulator: kept)
    monkeypatch.setattr(solves, "grid_methods", lambda: ("projected-multigrid", "psor"))
    monkeypatch.setattr(solves.RecordedPressures, "tolerances", (1e-1, 1e-3, 1e-5))
    monkeypatch.setattr(solves.RecordedSteps, "tolerances", (1e-1, 1e-5))
    monkeypatch.setattr(solves.RecordedSteps, "tried", ("accelerated-projection",))


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["dam-break-2d", slow("column-collapse-2d")])
def test_the_files_of_a_small_suite(scene: str, few: None, tmp_path: Path) -> None:
    asked = options(scene=scene)
    results = tradeoff.measure(asked, tmp_path)
    report.write("tradeoff", tradeoff.TITLE, results, tmp_path)
    records = {r["name"]: r for r in json.loads((tmp_path / "tradeoff.json").read_text())}
    ran = [r for r in records.values() if r.get("kind") == "run"]
    assert len(ran) == 5
    assert all(r["figures"]["seconds"]["value"] > 0.0 and r["resolution"] == 16 for r in ran)
    solved = [r for r in records.values() if r.get("kind") == "solve"]
    curves: dict[tuple[str, str], list[float]] = {}
    for r in solved:
        assert r["figures"]["residual"]["value"] <= (
            1.1 * r["tolerance"] if scene.startswith("dam") else 0.1
        )
        curves.setdefault((r["method"], r["precision"]), []).append(r["figures"]["error"]["value"])
    for errors in curves.values():
        # Sand is accurate to 2e-4 at once.
        assert errors[-1] < (0.1 if scene.startswith("dam") else 0.5) * errors[0]
    if scene.startswith("dam"):
        assert records[f"{scene} solve reference"]["figures"]["residual"]["value"] < 1e-11
    pages = {path.name for path in tmp_path.glob(f"tradeoff-{scene}*")}
    assert pages == {
        f"tradeoff-{scene}-run-distance-to-finest.png",
        f"tradeoff-{scene}-solve-error.png",
    }
    text = (tmp_path / "tradeoff.md").read_text()
    assert "| Pareto" in text
    assert f"## {scene}: presets" in text


def test_a_scene_option_needs_a_suite_that_runs_scenes() -> None:
    result = CliRunner().invoke(cli.app, ["bench", "kernels", "dam-break"])
    assert result.exit_code == 2
    assert "dam-break: the suite kernels has its own scenes" in result.stderr
    result = CliRunner().invoke(cli.app, ["bench", "tradeoff", "dam-brake"])
    assert result.exit_code == 2
    assert "did you mean 'dam-break'?" in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("scene", tradeoff.SCENES)
def test_the_whole_suite_at_a_small_size(scene: str, tmp_path: Path) -> None:
    result = CliRunner().invoke(
        cli.app,
        ["bench", "tradeoff", scene, "--size", "16", "--repeat", "1", "--out", str(tmp_path)],
    )
    assert result.exit_code == 0, result.stderr
    records = json.loads((tmp_path / "tradeoff.json").read_text())
    ran = [r for r in records if r.get("kind") == "run" and r["figures"]]
    assert len(ran) >= 55
