"""Steps of a scene with many starts and stops.

The log has no tiny steps, and an interrupted run has the same steps.
"""

import csv
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from small_liquids import box, create, scene
from small_runs import run_into
from warp_lcp.run.progress import ProgressLines
from warp_lcp.run.stepping import SHARE

FRAMES = 30.0


def busy(end: float = 0.2) -> Any:
    """Return a scene with a pool, a tap, a drain and a slide.

    Their times are close to frames and to each other.
    """
    slide = {
        "kind": "keyframes",
        "times": [0.0666, 0.1251, 0.12513],
        "translate": [[0.0, 0.0], [0.1, 0.0], [0.1, 0.0]],
    }
    return scene(
        size=[1.0, 1.0],
        resolution=16,
        time={"duration": end, "frames_per_second": FRAMES, "dt_max": 0.012},
        liquid=[box([0.0, 0.0], [1.0, 0.25])],
        source=[box([0.0, 0.5], [0.125, 0.625], velocity=[1.0, 0.0], start=0.03337, stop=0.10004)],
        drain=[box([0.875, 0.0], [1.0, 0.125], start=0.0, stop=0.14)],
        solid=[box([0.4, 0.3], [0.5, 0.7], motion=slide)],
        output={"particles": False, "grid": False},
    )


def steps(folder: Path) -> np.ndarray:
    """Return start and end of each step of a log [s], shape (n, 2)."""
    with (folder / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    ends = np.array([float(row["time"]) for row in rows])
    return np.column_stack([ends - [float(row["dt"]) for row in rows], ends])


def test_a_busy_run_has_no_slivers_and_goes_on_with_the_same_steps(tmp_path: Path) -> None:
    model = busy()
    run_into(model, tmp_path / "through", observer=ProgressLines(Console(quiet=True)))
    through = steps(tmp_path / "through")
    lengths, ends = through[:, 1] - through[:, 0], through[:, 1]
    assert lengths[1:].min() > 0.8 * SHARE * 0.012
    assert (lengths[1:] > 0.8 * SHARE * lengths[:-1]).all()
    assert (lengths[:-1] > 0.8 * SHARE * lengths[1:]).all()
    for time in [*(np.arange(1, 7) / FRAMES), 0.12513, 0.14]:
        assert np.abs(ends - time).min() < 1e-12
    assert np.abs(ends[:, None] - [0.03337, 0.0666, 0.10004]).min() > 1e-6  # too close to frames

    asked = count(1)
    run_into(
        model,
        tmp_path / "again",
        observer=ProgressLines(Console(quiet=True)),
        stop=lambda: next(asked) >= len(ends) // 2,
    )
    run_into(model, tmp_path / "again", observer=ProgressLines(Console(quiet=True)), resume=True)
    assert np.array_equal(steps(tmp_path / "again"), through)


@pytest.mark.parametrize("phase", [0.1, 0.4, 0.6, 0.9])
def test_a_jet_flies_on_whenever_in_a_step_its_source_stops(phase: float) -> None:
    """Jet whose source stops within a step.

    A source that pushed with the share of its velocity for the part of the step would hold back the
    jet.
    """
    dt, velocity = 0.01, 1.5
    source = box([0.0, 0.5], [0.125, 0.625], velocity=[velocity, 0.0], stop=(5 + phase) * dt)
    simulation = create(
        scene(
            size=[1.0, 1.0],
            resolution=16,
            liquid=[],
            source=[source],
            physics={"gravity": [0.0, 0.0]},
        )
    )
    for _ in range(10):
        simulation.step(dt)
    assert simulation.particles.count > 16
    np.testing.assert_allclose(simulation.particles.velocity.numpy()[:, 0], velocity, rtol=1e-3)
