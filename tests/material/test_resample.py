"""Run resumed on another grid: mass, momentum and a linear velocity stay.

The run reports the resampling.
"""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from default_run import covering
from small_liquids import advance, box, create, scene
from small_runs import run_into
from warp_lcp.material.resample import resampled
from warp_lcp.run.folder import OutputError
from warp_lcp.run.progress import ProgressLines
from warp_lcp.scene.scene_file import load_scene

BALL = {"shape": "sphere", "center": [0.7, 0.2], "radius": 0.15}
GRADIENT = np.array([[0.0, 3.0, 0.0], [-2.0, 1.0, 0.0], [0.0, 0.0, 0.0]])  # of u and v


def dam(resolution: int, **tables: Any) -> Any:
    """Return a dam beside a ball, on a grid whose walls differ for each resolution."""
    return create(
        scene(
            size=[1.0, 0.5],
            resolution=resolution,
            liquid=[box([0.0, 0.0], [0.375, 0.375])],
            **({"solid": [BALL]} | tables),
        )
    )


def everywhere(points: np.ndarray) -> np.ndarray:
    return np.ones(len(points), dtype=bool)


@pytest.mark.parametrize("resolution", [8, 12, 16, 24, 32])
def test_mass_momentum_and_a_linear_velocity_stay(resolution):
    old, new = dam(16, solid=[]), dam(resolution, solid=[])
    state = old.state()
    velocity = np.array([1.0, -0.5, 0.0]) + state["position"] @ GRADIENT.T
    state |= {"velocity": velocity.astype(np.float32)}
    state |= {
        f"affine_{axis}": np.tile(GRADIENT[axis].astype(np.float32), (old.particles.count, 1))
        for axis in range(2)
    }
    arrays, moved = resampled(
        state, new.grid, everywhere, spacing=old.grid.spacing, per_axis=2, random_seed=7
    )
    count = len(arrays["position"])
    mass = old.particles.count * old.particle_mass
    assert abs(count * new.particle_mass - mass) <= 0.5001 * new.particle_mass
    np.testing.assert_allclose(arrays["velocity"].mean(axis=0), velocity.mean(axis=0), atol=1e-6)
    # A velocity linear in space, continued by its gradient, is exact at every new position.
    error = arrays["velocity"] - (np.array([1.0, -0.5, 0.0]) + arrays["position"] @ GRADIENT.T)
    assert np.abs(error - error.mean(axis=0)).max() < 1e-5
    # A uniform shift corrects the center of mass, which moves by far less than a cell.
    center = arrays["position"].mean(axis=0) - state["position"].mean(axis=0)
    np.testing.assert_allclose(error.mean(axis=0), -GRADIENT @ center, atol=1e-5)
    assert np.abs(center).max() < 0.1 * new.grid.spacing
    assert moved < 0.01 * count
    assert {array.dtype for array in arrays.values()} == {np.dtype(np.float32)}
    assert {array.shape for array in arrays.values()} == {(count, 3)}
    assert arrays.keys() == {"position", "velocity", "affine_0", "affine_1"}


def test_a_finer_grid_is_filled_evenly():
    """Even filling of a finer grid.

    At twice the resolution there are four for one: each new cell inside the liquid holds about four
    again, and none is empty.
    """
    old, new = dam(16, solid=[]), dam(32, solid=[])
    arrays, _ = resampled(
        old.state(), new.grid, everywhere, spacing=old.grid.spacing, per_axis=2, random_seed=7
    )
    cells = np.floor(arrays["position"][:, :2] / new.grid.spacing).astype(int)
    counts = np.zeros((32, 16), dtype=int)
    np.add.at(counts, tuple(cells.T), 1)
    inside = counts[:11, :11]
    assert inside.min() >= 1
    assert 0.9 * 4 < inside.mean() < 1.1 * 4
    assert counts[13:].sum() == 0  # at most the share of a particle at the surface


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("cells", "tables"),
    covering(
        [(16, 24), (24, 16), (16, 32), (32, 20)],
        [{}, {"solids": "voxel"}, {"particles": {"transfer": "flip"}}],
    ),
)
def test_a_simulation_goes_on(cells, tables):
    before, after = cells
    old = dam(before, **tables)
    advance(old, 0.25)  # the front is at the ball
    new = dam(after, **tables)
    notes = new.resample(old.state())
    assert notes[0].startswith(
        f"resampled from cells of {old.grid.spacing:.4g} m to {new.grid.spacing:.4g} m: "
        f"{new.particles.count}"
    )
    assert (new.time, new.step_count) == (old.time, old.step_count)
    assert new.admits(new.particles.position.numpy().astype(np.float64)).mean() > 0.99
    at = new.particles.totals()
    assert at.mean_square_speed == pytest.approx(old.particles.totals().mean_square_speed, rel=0.05)
    np.testing.assert_allclose(
        at.center, old.particles.totals().center, atol=0.2 * max(old.grid.spacing, new.grid.spacing)
    )
    rows = advance(new, 0.35)
    assert rows[-1]["mass"] == pytest.approx(old.particles.count * old.particle_mass, rel=2e-3)
    again = dam(after, **tables)
    again.restore(new.state())  # a resampled state is a state like any other
    assert again.step(0.005) == new.step(0.005)


def test_another_liquid_is_refused():
    state = dam(16).state()
    for other in (dam(24, particles={"per_axis": 3}), dam(24, particles={"transfer": "pic"})):
        with pytest.raises(
            ValueError, match="domain, number of particles a cell or transfer differ"
        ):
            other.resample(state)


SHORT = ["domain.resolution=24", "time.duration=0.3", "output.checkpoint_every=5"]


def go(out: Path, *overrides: str, resume: bool = False, steps: int = 10**6) -> Any:
    left = iter(range(steps, -1, -1))
    scene = load_scene("dam-break-2d", [*SHORT, *overrides])
    observer = ProgressLines(Console(quiet=True))
    return run_into(scene, out, observer=observer, resume=resume, stop=lambda: next(left) <= 1)


def test_a_run_is_resumed_on_another_grid_and_says_so(tmp_path):
    out = tmp_path / "out"
    assert go(out, steps=8).status == "stopped"
    result = go(out, "domain.resolution=32", resume=True)
    assert result.status == "finished"
    found = json.loads((out / "run.json").read_text())
    assert (found["resumed_from_step"], found["resampled_from_resolution"]) == (8, 24)
    assert "domain.resolution: 24 before, 32 now" in found["changed"]
    assert any(
        text.startswith("resampled from cells of 0.06667 m to 0.05 m") for text in found["warnings"]
    )
    with open(out / "log.csv", newline="") as file:
        mass = {int(row["step"]): float(row["mass"]) for row in csv.DictReader(file)}
    assert mass[9] == pytest.approx(mass[8], rel=2e-3)
    # Its own checkpoints are on the new grid.
    again = go(out, "domain.resolution=32", "time.duration=0.35", resume=True)
    assert again.resampled_from_resolution is None
    with pytest.raises(OutputError, match=r"domain.size: .* before"):
        go(out, "domain.size=[1.6, 1.6]", resume=True)


def test_the_same_seed_resamples_to_the_same_bits(tmp_path):
    states = []
    for name in ("a", "b"):
        go(tmp_path / name, steps=8)
        go(tmp_path / name, "domain.resolution=48", resume=True, steps=3)
        states.append(dict(np.load(max((tmp_path / name / "checkpoints").glob("step_*.npz")))))
    assert states[0].keys() == states[1].keys()
    assert all(np.array_equal(states[0][name], states[1][name]) for name in states[0])
