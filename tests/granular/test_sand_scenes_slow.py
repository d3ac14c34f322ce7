"""Built-in scenes of sand from begin to end.

The solves meet their tolerance, the sand comes to rest, and nothing is lost.
"""

import csv
from pathlib import Path

import numpy as np
import pytest

from small_runs import StepCounter, run_into
from warp_lcp.scene.scene_file import load_scene


def run(name: str, folder: Path, *overrides: str) -> dict[str, np.ndarray]:
    """Run a scene and return the numeric columns of its log."""
    assert (
        run_into(load_scene(name, list(overrides)), folder, observer=StepCounter()).status
        == "finished"
    )
    with open(folder / "log.csv", newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    columns = (
        "dt",
        "mass",
        "coupled_residual",
        "dissipation",
        "predicted_excess",
        "max_fraction",
        "runout",
        "height",
        "max_speed",
    )
    columns = (*columns, "kinetic_energy", *(["flow_rate"] if "flow_rate" in rows[0] else []))
    return {name: np.array([float(row[name]) for row in rows]) for name in columns}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "column-collapse-2d",
        "hourglass-2d",
        "column-collapse",
        "pouring-pile",
        "sand-on-mesh",
        "hourglass",
    ],
)
def test_a_scene_from_beginning_to_end(name: str, tmp_path: Path) -> None:
    log = run(name, tmp_path / "run")
    assert np.mean(log["coupled_residual"] <= 1e-3) >= 0.9
    assert log["coupled_residual"].max() <= 0.1
    assert log["dissipation"].min() >= -1e-3 * log["dissipation"].max()
    assert log["predicted_excess"].max() <= 3e-2
    assert np.median(log["max_fraction"]) <= 1.25
    if name != "pouring-pile":
        np.testing.assert_allclose(log["mass"], log["mass"][0], rtol=1e-12)


@pytest.mark.slow
def test_the_planar_column_runs_as_far_as_experiments_say_and_rests(tmp_path: Path) -> None:
    """Runout and rest of the planar column, against experiments.

    For a = 2 the runout is 1.2 a to 1.8 a widths [Lube et al. 2005; Lajeunesse et al. 2005],
    widened by a fifth. In the end almost nothing moves.
    """
    log = run("column-collapse-2d", tmp_path / "run", "time.duration=2.5")
    assert 0.8 * 2.4 <= log["runout"][-1] / 0.25 <= 1.2 * 3.6
    mass = log["mass"][-1]
    # [m/s], of a pile from 0.5 m.
    assert np.sqrt(2.0 * log["kinetic_energy"][-1] / mass) < 0.01 * 0.5
    assert log["height"][-1] == pytest.approx(0.25, abs=0.05)


@pytest.mark.slow
def test_sand_runs_through_a_funnel_at_a_constant_rate(tmp_path: Path) -> None:
    """Constant rate of sand through a funnel.

    It does not depend on the height, unlike that of a liquid: the mean rates of equal times differ
    by less than a tenth.
    """
    log = run("hourglass-2d", tmp_path / "run", "time.duration=1.0")
    time, fallen = np.cumsum(log["dt"]), np.cumsum(log["flow_rate"] * log["dt"])
    rates = np.diff(np.interp([0.3, 0.45, 0.6, 0.75, 0.9], time, fallen)) / 0.15
    assert np.ptp(rates) < 0.2 * rates.mean()
    assert abs(rates - rates.mean()).max() < 0.1 * rates.mean()
