"""Presets: values that they set, and growing error with speed.

Explicit keys stay unchanged.
"""

from pathlib import Path

import pytest

from particle_scenes import particle_scenes
from warp_lcp.run.check import check_scene
from warp_lcp.run.trial import trial
from warp_lcp.scene.presets import PRESETS, changed, price_table, value_of
from warp_lcp.scene.scene_file import dump_scene, load_scene
from warp_lcp.scene.table import SceneError

SCENE = """
[scene]
simulator = "fluids"
[time]
duration = 0.2
frames_per_second = 30
[domain]
size = [1.0, 0.5]
resolution = 32
[[liquid]]
shape = "box"
min = [0.0, 0.0]
max = [0.375, 0.375]
"""


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    file = tmp_path / "dam.toml"
    file.write_text(SCENE)
    return file


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", particle_scenes())
def test_every_scene_takes_every_preset(name: str, preset: str) -> None:
    plain, scene = load_scene(name), load_scene(name, [f"solver.preset={preset}"])
    assert scene.solver.preset == preset
    for key, value in price_table()[scene.scene.simulator].presets[preset].settings.items():
        now, before = value_of(scene, key), value_of(plain, key)
        assert now in (value, before)
        assert (now is None) == (before is None), f"{key}: a preset turns nothing on or off"


@pytest.mark.parametrize("simulator", ["fluids", "granular"])
def test_presets_go_from_fast_to_accurate(simulator: str) -> None:
    prices = price_table()[simulator]
    for key in ("time.cfl", "time.dt_max", "solver.tolerance"):
        values = [*(prices.presets[name].settings[key] for name in PRESETS), prices.reference[key]]
        assert values == sorted(set(values), reverse=True), key
    for bound in ("distance", "volume"):
        values = [getattr(prices.presets[name], bound) for name in PRESETS]
        assert values == sorted(set(values), reverse=True)
    assert [cfl for cfl, _ in prices.steps] == sorted(
        {cfl for cfl, _ in prices.steps}, reverse=True
    )
    assert list(prices.tolerances) == sorted(set(prices.tolerances), reverse=True)


def test_keys_of_the_scene_override_the_preset(scene_file: Path) -> None:
    settings = price_table()["fluids"].presets["final"].settings
    scene = load_scene(scene_file, ["solver.preset=final", "time.cfl=3.5"])
    assert scene.time.cfl == 3.5
    assert scene.time.dt_max == settings["time.dt_max"]
    assert scene.solver.tolerance == settings["solver.tolerance"]
    assert scene.density_correction is None
    on = load_scene(scene_file, ["solver.preset=final", "density_correction.every=5"])
    assert on.density_correction is not None
    assert on.density_correction.every == 5
    assert on.density_correction.tolerance == settings["density_correction.tolerance"]


def test_without_a_preset_nothing_changes(scene_file: Path) -> None:
    scene = load_scene(scene_file)
    assert scene.solver.preset is None
    assert (scene.time.cfl, scene.time.dt_max, scene.solver.tolerance) == (2.0, 0.02, 1e-4)
    assert "preset" not in dict(scene.plan())


def test_the_plan_shows_the_origin_of_each_value(scene_file: Path) -> None:
    _, lines = check_scene(str(scene_file), ["solver.preset=preview", "time.cfl=3.5"])
    assert (
        dict(lines)["preset"]
        == "preview: time.dt_max 0.04, solver.tolerance 0.01; the scene's own: time.cfl 3.5"
    )


def test_a_scene_that_is_written_back_keeps_its_values(scene_file: Path) -> None:
    scene = load_scene(scene_file, ["solver.preset=preview", "time.cfl=3.5"])
    scene_file.write_text(dump_scene(scene))
    assert load_scene(scene_file) == scene


def test_an_unknown_preset_is_refused(scene_file: Path) -> None:
    with pytest.raises(
        SceneError, match=r"solver\.preset = \"fast\": must be 'preview', 'standard' or 'final'"
    ):
        load_scene(scene_file, ["solver.preset=fast"])


def test_presets_do_not_enable_disabled_models(scene_file: Path) -> None:
    scene = changed(load_scene(scene_file), {"time.cfl": 0.75, "density_correction.every": 3})
    assert scene.time.cfl == 0.75
    assert scene.density_correction is None


def test_faster_presets_take_fewer_steps_and_lie_further_away(scene_file: Path) -> None:
    """Faster presets: fewer steps and a larger distance.

    Steps are counted, not seconds; distances are from the reference run of the same resolution.
    """
    scene = load_scene(scene_file)
    prices = price_table()["fluids"]
    reference = trial(changed(scene, prices.reference), device="cpu", frames=6)
    runs = {
        name: trial(changed(scene, prices.presets[name].settings), device="cpu", frames=6)
        for name in PRESETS
    }
    distances = [runs[name].distance(reference) for name in PRESETS]
    assert distances[0] > distances[1] > distances[2] > 0.0
    assert all(
        distance <= prices.presets[name].distance
        for name, distance in zip(PRESETS, distances, strict=True)
    )
    assert runs["preview"].steps * 4 <= runs["final"].steps
