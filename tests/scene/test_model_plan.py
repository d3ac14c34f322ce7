"""Messages of `check` about a scene's models, and its price list."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from particle_scenes import particle_scenes
from warp_lcp.benchmarks.models import offers
from warp_lcp.cli import commands as cli
from warp_lcp.material.particle_scene import ParticleScene
from warp_lcp.run.check import check_scene
from warp_lcp.scene.models import ModelCost, SceneModel, model_lines, predicted_seconds, prices
from warp_lcp.scene.scene_file import load_scene

CELLS, PARTICLES = 1000, 4000
LISTED = {
    "base": ModelCost(cell_seconds=1e-6, particle_seconds=1e-6, cell_bytes=100.0),
    "walls": ModelCost(cell_seconds=2e-6, cell_bytes=50.0),
    "band": ModelCost(particle_seconds=-1e-7, cell_bytes=-20.0),
}


def test_prices_add_up() -> None:
    models = [
        SceneModel("walls", "asked for"),
        SceneModel("band", "asked for"),
        SceneModel("unknown", "asked for"),
        SceneModel("walls", "", built=False),
    ]
    assert predicted_seconds(models, LISTED, CELLS, PARTICLES) == pytest.approx(5e-3 + 2e-3 - 4e-4)
    assert predicted_seconds(models, {}, CELLS, PARTICLES) == 0.0, "nothing is known"
    bodies = SceneModel("walls", "three of them", count=3)
    assert predicted_seconds([bodies], LISTED, CELLS, PARTICLES) == pytest.approx(5e-3 + 3 * 2e-3)
    assert model_lines([bodies], LISTED, CELLS, PARTICLES, memory=200_000)[0][1].endswith(
        "75 % of memory, 6 ms a step (55 %)"
    )


def test_a_plan_line_has_reason_and_cost() -> None:
    models = [
        SceneModel("walls", "asked for"),
        SceneModel("surface", "there is none", built=False),
        SceneModel("band", "too"),
    ]
    lines = model_lines(models, LISTED, CELLS, PARTICLES, memory=200_000)
    assert lines[0] == ("model", "walls: asked for; 25 % of memory, 2 ms a step (30 %)")
    assert lines[1] == ("not built", "surface: there is none")
    assert lines[2] == ("model", "band: too; 0 % of memory, 0 ms a step (0 %)"), (
        "what saves takes nothing"
    )
    assert lines[3] == ("step", "about 6.6 ms by the cost table, on one core, all models together")


def test_a_measured_step_scales_the_prices() -> None:
    lines = model_lines(
        [SceneModel("walls", "asked for")], LISTED, CELLS, PARTICLES, memory=200_000, measured=14e-3
    )
    assert lines == [
        ("model", "walls: asked for; 25 % of memory, 4 ms a step (29 %)"),
        ("step", "about 14 ms here, all models together"),
    ]


@pytest.mark.parametrize("simulator", ["fluids", "granular"])
@pytest.mark.parametrize("dimension", [2, 3])
def test_every_model_that_is_measured_has_its_price(simulator: str, dimension: int) -> None:
    listed = prices(simulator, dimension)
    assert set(listed) == {"base", *offers(simulator, dimension)}
    assert listed["base"].seconds(CELLS, PARTICLES) > 0.0
    assert listed["cut cells"].bytes(CELLS, PARTICLES) > 0


@pytest.mark.parametrize("name", particle_scenes())
def test_every_built_in_scene_lists_its_models(name: str) -> None:
    scene, lines = check_scene(name)
    assert isinstance(scene, ParticleScene)
    names = [line.partition(":")[0] for word, line in lines if word == "model"]
    assert names == [model.name for model in scene.models() if model.built]
    assert ("rigid bodies" in names) == any(solid.is_body for solid in scene.solid)
    assert "moving solids" in names or "rigid bodies" not in names, "a body moves, too"
    assert all(
        model.count == sum(solid.is_body for solid in scene.solid)
        for model in scene.models()
        if model.name == "rigid bodies"
    )
    assert ("cut cells" in names) == (bool(scene.solid) and scene.domain.solids == "cut-cell")
    assert sum(word == "step" for word, _ in lines) == 1


def test_the_command_prints_the_plan() -> None:
    shown = CliRunner().invoke(
        cli.app, ["check", "dam-break-2d", "--set", "density_correction.every=1"]
    )
    assert shown.exit_code == 0
    assert "density correction: [density_correction]; " in shown.stdout
    assert load_scene("dam-break-2d").solver.tolerance == 1e-4
