"""Tuning: distance between runs, search among settings, command."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from command_line import invoke
from warp_lcp.run import tune as tuning
from warp_lcp.run.trial import (
    MaterialSnapshot,
    RunDifferences,
    Trial,
    _TrialRun,
    look_times,
    spread,
    trial,
)
from warp_lcp.scene.presets import price_table
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.simulation import SimulationFailed, StepFailed

SMALL = ["domain.resolution=32", "time.duration=0.2"]


def made(distance: float, seconds: float, drift: float = 0.0) -> Trial:
    """Return a run whose distance from made(0.0, ...) is `distance`."""
    mass = np.array([1.0 - distance, distance])
    looks = tuple(MaterialSnapshot(time, mass, 1.0, 0.5) for time in (0.0, 0.1, 0.2))
    return Trial(seconds, 10, 10, 10, looks, 0.0, volume=(1.0, 1.0 + drift))


def test_points_are_spread_with_their_mass_and_center() -> None:
    rng = np.random.default_rng(5309)
    points = rng.uniform(0.3, 0.7, (200, 3))
    box = 0.1
    shares = spread(points, [1.0, 1.0, 1.0], box)
    assert shares.shape == (10, 10, 10)
    assert shares.sum() == pytest.approx(1.0, rel=1e-12)
    centers = (np.arange(10) + 0.5) * box
    for axis in range(3):
        along = shares.sum(axis=tuple({0, 1, 2} - {axis}))
        assert along @ centers == pytest.approx(points[:, axis].mean(), rel=1e-12)
    assert spread(np.zeros((0, 2)), [1.0, 0.5], box).sum() == 0.0
    assert spread(np.array([[0.0, 1.0]]), [1.0, 1.0], box)[0, 9] == pytest.approx(1.0)


@pytest.mark.parametrize(("moved", "distance"), [(0.0, 0.0), (0.05, 0.5), (0.1, 1.0), (0.3, 1.0)])
def test_the_distance_of_a_point_that_moves(moved: float, distance: float) -> None:
    runs = [
        Trial(
            1.0,
            1,
            1,
            1,
            tuple(
                MaterialSnapshot(t, 3.0 * spread(np.array([[x, 0.45]]), [1.0, 1.0], 0.1), 1.0, x)
                for t in (0.0, 1.0)
            ),
            0.0,
        )
        for x in (0.25, 0.25 + moved)
    ]
    assert runs[1].distance(runs[0]) == pytest.approx(distance, abs=1e-9)
    assert runs[1].front_error(runs[0]) == pytest.approx(moved)


def test_runs_with_other_sample_times_are_not_compared() -> None:
    scene = load_scene("dam-break-2d", SMALL)
    a, b = trial(scene, device="cpu", frames=2), trial(scene, device="cpu", frames=2, box=0.2)
    with pytest.raises(ValueError, match="in different boxes or at different times"):
        a.distance(b)


def test_a_trial_is_the_run() -> None:
    """Trial equal to the run.

    The same steps as in a run, reproducible, and the mass of the liquid in its boxes.
    """
    scene = load_scene("dam-break-2d", SMALL)
    first, again = (trial(scene, device="cpu", frames=3) for _ in range(2))
    assert first.steps == again.steps
    assert again.distance(first) == 0.0
    assert [look.time for look in first.looks[1:]] == pytest.approx(look_times(scene, 3))
    masses = [look.mass.sum() for look in first.looks]
    assert masses == pytest.approx([0.4 * 0.6 * 1000.0] * 4, rel=1e-9)
    assert first.looks[-1].front > first.looks[0].front
    assert first.volume_drift == pytest.approx(0.0, abs=0.1)
    assert first.penetration == 0.0


def test_a_lone_drop_is_not_the_front(monkeypatch: pytest.MonkeyPatch) -> None:
    """Front of 200 particles up to 0.4 m, and one at 0.9 m: among the 200."""
    x = np.append(np.linspace(0.0, 0.4, 200), 0.9)
    points = np.stack([x, np.full_like(x, 0.1), np.zeros_like(x)], axis=1)
    monkeypatch.setattr(_TrialRun, "_points", lambda self: points)
    scene = load_scene("dam-break-2d", [*SMALL[:1], "time.duration=0.02"])
    front = trial(scene, device="cpu", frames=1).looks[-1].front
    assert 0.38 < front < 0.4


class ModeledTrials:
    """Replacement of trials: distance and seconds by a formula of cfl and tolerance.

    Args:
        distance: distance at a cfl of 1.
        fails: least cfl at which runs fail.
    """

    def __init__(self, distance: float, fails: float = np.inf, drift: float = 0.0) -> None:
        self.distance, self.fails, self.drift = distance, fails, drift
        self.ran: list[tuple[float, float]] = []

    def __call__(self, scene: Scene, **options: Any) -> Trial:
        cfl, tolerance = scene.time.cfl, float(scene.solver.tolerance)
        if cfl <= price_table()["fluids"].reference["time.cfl"]:
            return made(0.0, 100.0)
        self.ran.append((cfl, tolerance))
        if cfl >= self.fails:
            raise StepFailed("too long")
        return made(
            self.distance * cfl + 0.005 * (tolerance > 1e-2),
            (1.0 - 0.1 * float(np.log10(tolerance))) / cfl,
            self.drift * cfl,
        )


def tuned(monkeypatch: pytest.MonkeyPatch, model: ModeledTrials) -> tuning.TuningResult:
    monkeypatch.setattr(tuning, "trial", model)
    return tuning.tune(load_scene("dam-break-2d"), accuracy="standard", device="cpu")


@pytest.mark.parametrize("distance", [0.0001, 0.0037, 0.006, 0.0101, 0.019, 0.05])
def test_the_longest_step_within_the_bound_is_found(
    distance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = ModeledTrials(distance)
    found = tuned(monkeypatch, model)
    bound = price_table()["fluids"].presets["standard"].distance
    longest = max(cfl for cfl, _ in price_table()["fluids"].steps if distance * cfl <= bound)
    assert found.met
    assert found.scene.time.cfl == found.chosen.settings["time.cfl"] == longest
    loosest = 0.1 if distance * longest + 0.005 <= bound else 0.01
    assert found.scene.solver.tolerance == loosest
    assert found.scene.time.dt_max == dict(price_table()["fluids"].steps)[longest]
    assert len(set(model.ran)) < len(price_table()["fluids"].steps)


def test_settings_that_fail_are_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    found = tuned(monkeypatch, ModeledTrials(0.0001, fails=4.0))
    assert found.met
    assert found.scene.time.cfl == 3.0
    assert found.failed
    assert all("too long" in line for line in found.failed)


def test_the_volume_counts_too(monkeypatch: pytest.MonkeyPatch) -> None:
    found = tuned(monkeypatch, ModeledTrials(0.0001, drift=-0.02))
    assert found.scene.time.cfl == 2.0  # 0.05 of the volume are allowed
    assert found.chosen.trial.volume_error(found.reference) == pytest.approx(0.04)


class NoisyTrials(ModeledTrials):
    """Replacement of trials with a distance of the reference runs.

    Runs as good as the reference are at this distance from it; all others have it in addition to
    their own.

    Args:
        noise: distance of runs as good as the reference.
    """

    def __init__(self, distance: float, noise: float, drift: float = 0.0) -> None:
        super().__init__(distance, drift=drift)
        self.noise, self.references = noise, 0

    def __call__(self, scene: Scene, **options: Any) -> Trial:
        reference = price_table()["fluids"].reference["time.cfl"]
        if scene.time.cfl <= reference:
            self.references += 1
            return made(self.noise if scene.time.cfl < 0.85 * reference else 0.0, 100.0)
        ran = super().__call__(scene, **options)
        return made(
            float(np.hypot(ran.distance(made(0.0, 1.0)), self.noise)),
            ran.seconds,
            self.drift * scene.time.cfl,
        )


def test_if_no_setting_is_accurate_enough_the_most_accurate_is_chosen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = tuned(monkeypatch, ModeledTrials(0.5))
    assert not found.met
    nearest = min(c.distance for c in found.tried)
    header, *rows = found.rows()
    assert [row[header.index("distance")] for row in rows] == [
        f"{c.distance:.4f}" for c in found.tried
    ]
    assert len(header) == len(rows[0])
    assert nearest <= found.chosen.distance <= 1.05 * nearest
    assert found.scene.time.cfl == price_table()["fluids"].steps[-1][0]
    assert found.scene.solver.tolerance == 0.1, (
        "which costs the nearest a fiftieth of the distance, and saves time"
    )
    assert found.noise is not None
    assert found.noise.distance == 0.0
    words = " ".join(found.verdict("standard"))
    assert words.startswith("nearest of the settings tried, but not standard: time.cfl=0.5")
    assert f"distance by a factor of {found.chosen.distance / 0.03:.2g}" in words
    assert "volume or packing by a factor" not in words
    with pytest.raises(SimulationFailed, match="no settings ran to the end of frame"):
        tuned(monkeypatch, ModeledTrials(0.5, fails=0.3))


def test_the_gain_of_shorter_steps_suggests_the_next_change(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    falls = tuned(monkeypatch, StepErrorTrials(0.0, 0.2)).verdict("standard")[-1]
    assert (
        falls == "the distance decreases with the step: shorter steps than those tried would help"
    )
    stays = tuned(monkeypatch, StepErrorTrials(0.2, 0.01)).verdict("standard")[-1]
    assert "half or less: increase domain.resolution instead" in stays
    assert stays.startswith("4 times as many steps left 93 % of the distance")


class StepErrorTrials(ModeledTrials):
    """Replacement of trials: 10 / cfl steps, and an irreducible part of the distance.

    Args:
        stays: irreducible part of the distance.
        falls: remaining part of the distance at a cfl of 1.
    """

    def __init__(self, stays: float, falls: float) -> None:
        super().__init__(falls)
        self.stays = stays

    def __call__(self, scene: Scene, **options: Any) -> Trial:
        cfl = scene.time.cfl
        if cfl <= price_table()["fluids"].reference["time.cfl"]:
            return made(0.0, 100.0)
        return replace(made(self.stays + self.distance * cfl, 1.0 / cfl), steps=round(10.0 / cfl))


@pytest.mark.parametrize("distance", [0.019, 0.024, 0.035])
def test_accuracy_is_limited_by_the_distance_of_references(
    distance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No run nearer to the references than they are to each other.

    The longest step whose own distance meets the bound is found beneath a noise of four times the
    bound, since distances add up in quadrature.
    """
    model = NoisyTrials(distance, noise=0.12)
    found = tuned(monkeypatch, model)
    bound = price_table()["fluids"].presets["standard"].distance
    assert found.scene.time.cfl == max(
        cfl for cfl, _ in price_table()["fluids"].steps if distance * cfl <= bound
    )
    assert found.met
    assert found.noise is not None
    assert found.bounds.distance == pytest.approx(np.hypot(0.12, bound))
    assert found.noise.distance == pytest.approx(0.12)
    assert model.references == 3
    assert found.chosen.distance > bound
    words = found.verdict("standard")
    assert words[0].startswith("within the noise of the reference, but not standard: ")
    assert (
        f"distance by a factor of {found.chosen.distance / bound:.2g}; but runs as accurate as the "
        "reference differ by 0.12" in words[2]
    )
    far = tuned(monkeypatch, NoisyTrials(0.5, noise=0.12))
    assert not far.met


def test_the_reference_is_not_doubted_where_its_bounds_are_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = NoisyTrials(0.0001, noise=0.01)
    found = tuned(monkeypatch, model)
    assert model.references == 1
    assert found.noise is None
    assert found.bounds == RunDifferences(0.03, 0.05)
    assert found.verdict("standard")[0].startswith("standard: time.cfl=8 ")


def test_the_command_writes_a_scene_that_runs(tmp_path: Path) -> None:
    out = tmp_path / "tuned.toml"
    options = [
        "--device",
        "cpu",
        "--set",
        "domain.resolution=32",
        "--frames",
        4,
        "--accuracy",
        "preview",
        "--out",
        out,
    ]
    result = invoke("tune", "dam-break-2d", *options)
    assert result.exit_code == 0, result.stderr
    assert "preview: time.cfl=" in result.stdout
    assert "distance: displaced fraction of the mass" in result.stdout
    scene = load_scene(out)
    assert scene.domain.resolution == 32
    assert f"time.cfl={scene.time.cfl:g}" in result.stdout
    comments = [line for line in out.read_text().splitlines() if line.startswith("#")]
    assert comments[0].startswith("# Tuned for preview accuracy on cpu:")
    rerun = trial(scene, device="cpu", frames=4)
    reference = trial(
        load_scene(
            "dam-break-2d",
            [
                "domain.resolution=32",
                "time.cfl=0.25",
                "time.dt_max=0.0025",
                "solver.tolerance=1e-8",
            ],
        ),
        device="cpu",
        frames=4,
    )
    assert rerun.distance(reference) <= price_table()["fluids"].presets["preview"].distance


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["dam-break-3d"], "no such built-in scene"),
        (["dam-break-2d", "--accuracy", "best"], "--accuracy"),
        (["dam-break-2d", "--frames", "0"], "--frames"),
        (["dam-break-2d", "--out", "nowhere/tuned.toml"], "must be a file in an existing folder"),
    ],
)
def test_wrong_input_exits_with_2(arguments: list[str], message: str) -> None:
    result = invoke("tune", *arguments)
    assert result.exit_code == 2
    assert message in result.stderr
