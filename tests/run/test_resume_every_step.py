"""Runs resumed after every step: equal next step, row of the log and frame.

They are equal bit for bit.
"""

import pytest

from drawn_scenes import drawn
from every_step import differences_by_step
from warp_lcp.fluids.scene import LiquidScene
from warp_lcp.scene.scene_file import built_in_scenes, load_scene

CELLS = {
    "jet": 128,
    "mesh-obstacle": 15,
    "pouring-pile": 18,
    "retracting-wall": 25,
    "river": 256,
    "waterfall": 32,
    "wave-maker": 30,
}  # along the longest side, where 24 and 12 are too small
IN_BAND = {
    "scene": {"simulator": "fluids"},
    "time": {"duration": 1.0, "frames_per_second": 20},
    "domain": {"size": [1.6, 0.8], "resolution": 48},
    "particles": {"narrow_band": {"width": 4}},
    "density_correction": {},
    "liquid": [{"shape": "box", "min": [0.0, 0.0], "max": [1.6, 0.6]}],
}


@pytest.mark.parametrize("name", ["column-collapse-2d", "retracting-wall", "tap-and-drain"])
def test_built_in_scenes(name):
    scene = load_scene(name, [f"domain.resolution={CELLS.get(name, 24)}"])
    assert differences_by_step(scene, 9, 4) == {}


def test_a_solid_that_moves_through_a_band():
    """Moving solid in a band.

    The interior counts the cells at the solid's current place, not at that of the scene.
    """
    solid = {
        "shape": "sphere",
        "center": [0.8, 0.25],
        "radius": 0.12,
        "motion": {"kind": "translation", "velocity": [1.2, 0.3]},
    }
    assert (
        differences_by_step(LiquidScene.model_validate(IN_BAND | {"solid": [solid]}), 17, 4) == {}
    )


def test_a_band_whose_surface_pulls_itself_together():
    """Band with surface tension.

    The effect on the particles' gradients includes the cells of newly added particles.
    """
    column = [{"shape": "box", "min": [0.0, 0.0], "max": [0.75, 0.6]}]
    tables = IN_BAND | {"surface_tension": {"coefficient": 0.07}, "liquid": column}
    assert differences_by_step(LiquidScene.model_validate(tables), 13, 2) == {}


@pytest.mark.slow
@pytest.mark.parametrize("name", built_in_scenes())
def test_all_built_in_scenes(name):
    cells = CELLS.get(name, 12 if load_scene(name).dimension == 3 else 24)
    assert differences_by_step(load_scene(name, [f"domain.resolution={cells}"]), 30) == {}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100))
def test_drawn_scenes(seed):
    assert differences_by_step(drawn(seed), 30, 2) == {}
