"""Tables of a scene: accepted values, and messages of refusals."""

import copy
import math
import pickle
from functools import partial
from typing import Any

import pytest

from scene_tables import scene_error
from warp_lcp.scene.scene import Scene, SceneError, validate
from warp_lcp.scene.shapes import BoxTable, SolidProperties, shaped

BASE: dict[str, Any] = {
    "scene": {"simulator": "dots"},
    "time": {"duration": 1.0},
    "domain": {"size": [1.6, 0.8], "resolution": 64},
}
BOX = {"shape": "box", "min": [0.0, 0.0], "max": [0.4, 0.4]}


def build(changes: dict[str, Any]) -> Scene:
    """Return the base scene with keys replaced; `time.cfl` is a key of a table."""
    data = copy.deepcopy(BASE)
    for path, value in changes.items():
        table, _, key = path.partition(".")
        if key:
            data.setdefault(table, {})[key] = value
        else:
            data[table] = value
    return validate(Scene, data, "dam.toml")


error = partial(scene_error, build)


def test_defaults_and_derived_numbers():
    scene = build({})
    assert (scene.dimension, scene.cell_counts, scene.spacing) == (2, (64, 32, 1), 0.025)
    assert scene.physics.gravity == [0.0, -9.81]
    assert scene.time.frame_count == 30
    assert (scene.solver.method, scene.domain.wall, scene.output.checkpoint_every) == (
        "projected-multigrid",
        "separating",
        50,
    )


def test_three_dimensions():
    scene = build({"domain.size": [1.6, 0.8, 0.4]})
    assert scene.cell_counts == (64, 32, 16)
    assert scene.physics.gravity == [0.0, -9.81, 0.0]


@pytest.mark.parametrize(
    ("size", "rounded", "cells"),
    [
        ([1.6, 0.83], [1.6, 0.85], (64, 34, 1)),
        ([1.6, 0.001], [1.6, 0.025], (64, 1, 1)),
        ([0.3, 1.6, 0.776], [0.3, 1.6, 0.8], (12, 64, 32)),
    ],
)
def test_sides_are_rounded_up_to_whole_cells_with_a_note(size, rounded, cells):
    scene = build({"domain.size": size})
    assert scene.domain.size == pytest.approx(rounded, rel=1e-12)
    assert scene.cell_counts == cells
    axis = next(a for a, (one, other) in enumerate(zip(size, rounded, strict=True)) if one != other)
    assert scene.notes() == [
        f"domain.size[{axis}] = {size[axis]:g} is rounded up to {rounded[axis]:g}, "
        f"{cells[axis]} cells of 0.025 m"
    ]
    assert pickle.loads(pickle.dumps(scene)) == scene
    again = validate(Scene, scene.model_dump(exclude_unset=True), "again.toml")
    assert again.domain.size == scene.domain.size
    assert again.notes() == []


def test_sides_of_whole_cells_up_to_rounding_stay():
    scene = build({"domain.size": [0.7, 0.1 + 0.2], "domain.resolution": 70})
    assert scene.domain.size == [0.7, 0.1 + 0.2]
    assert scene.notes() == []


def test_frame_times_end_with_the_run():
    time = build({"time.duration": 0.11, "time.frames_per_second": 30.0}).time
    assert time.frame_count == 4
    assert [time.frame_time(k) for k in range(5)] == [0.0, 1 / 30, 2 / 30, 3 / 30, 0.11]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"time.cfl": 0}, "time.cfl = 0: must be at least 0.001 (Courant number, usually 1 to 4)"),
        ({"time.duration": math.nan}, "time.duration = NaN: must be finite (simulated time [s])"),
        ({"time.dt_max": math.inf}, "time.dt_max = Infinity: must be finite"),
        ({"time.duration": "2"}, 'time.duration = "2": must be a number'),
        ({"time.duration": True}, "time.duration = true: must be a number"),
        ({"time": {}}, "time.duration: is missing"),
        ({"time": 3}, "time = 3: must be a table"),
        ({"domain.resolution": 64.5}, "domain.resolution = 64.5: must be a whole number"),
        (
            {"domain.wall": "glue"},
            "domain.wall = \"glue\": must be 'separating', 'free-slip' or 'sticky'",
        ),
        ({"domain.size": [1.6]}, "domain.size = [1.6]: must have at least 2 entries"),
        ({"domain.size": [1.6, -0.8]}, "domain.size[1] = -0.8: must be greater than 0"),
        ({"domain.size": 1.6}, "domain.size = 1.6: must be a list"),
        (
            {"physics.gravity": [0.0, 0.0, -9.81]},
            "physics.gravity = [0.0, 0.0, -9.81]: must have 2 entries, as domain.size has",
        ),
        ({"time.dt_min": 0.1}, "time.dt_min = 0.1: must not exceed time.dt_max = 0.02"),
        ({"output.grid": 1}, "output.grid = 1: must be true or false"),
        ({"solver.tolerance": 1.0}, "solver.tolerance = 1.0: must be less than 1"),
        ({"scene.name": 3}, "scene.name = 3: must be text in quotes"),
    ],
)
def test_refused_values_name_key_value_and_what_is_allowed(changes, expected):
    assert error(changes).startswith(f"dam.toml: {expected}")


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"time.dtmax": 1}, "time.dtmax: unknown key; did you mean 'dt_max'?"),
        (
            {"time.zzz": 1},
            "time.zzz: unknown key; choose from cfl, dt_max, dt_min, duration, frames_per_second",
        ),
        ({"outptu": {}}, "outptu: unknown key; did you mean 'output'?"),
        (
            {"solid": [{**BOX, "wal": "separating"}]},
            "solid[0].wal: unknown key; did you mean 'wall'?",
        ),
    ],
)
def test_unknown_keys_suggest(changes, expected):
    assert error(changes) == f"dam.toml: {expected}"


@pytest.mark.parametrize(
    ("changes", "path"),
    [
        ({"sand": [BOX]}, "sand"),
        ({"friction": {"model": "cone"}}, "friction"),
        ({"domain.friction": 0.5}, "domain.friction"),
        ({"domain.periodic": [True, False]}, "domain.periodic[0] = true"),
    ],
)
def test_keys_of_another_simulator_are_no_typo(changes, path):
    assert error(changes) == f'dam.toml: {path}: needs scene.simulator = "granular"'


def test_unsupported_features_may_be_set_to_off():
    scene = build({"domain.periodic": [False, False]})
    assert scene.domain.periodic == [False, False]
    assert (
        error({"domain.periodic": [False]})
        == "dam.toml: domain.periodic = [false]: must have 2 entries"
    )


def test_all_errors_are_listed():
    with pytest.raises(SceneError) as caught:
        build({"time.cfl": 0, "domain.wal": "x", "solid": [{"shape": "sphere", "center": [0, 0]}]})
    assert {problem.path for problem in caught.value.problems} == {
        "time.cfl",
        "domain.wal",
        "solid[0].radius",
    }
    assert str(caught.value).splitlines()[0] == "dam.toml: 3 errors"


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ({"shape": "bx"}, "solid[0].shape = \"bx\": unknown shape; did you mean 'box'?"),
        (
            {"radius": 1.0},
            "solid[0].shape: is missing; choose from box, capsule, mesh, plane, sphere",
        ),
        (
            {**BOX, "max": [0.4, 0.0]},
            "solid[0].max = [0.4, 0.0]: must be greater than min = [0.0, 0.0] along every axis",
        ),
        (
            {**BOX, "max": [0.4, 0.4, 0.4]},
            "solid[0].max = [0.4, 0.4, 0.4]: must have 2 entries in 2-D",
        ),
        (
            {**BOX, "rotate": [0.0, 90.0, 0.0]},
            "solid[0].rotate = [0.0, 90.0, 0.0]: must be one number in 2-D",
        ),
        ({**BOX, "scale": 0}, "solid[0].scale = 0: must be greater than 0"),
        (
            {"shape": "sphere", "center": [0, 0], "radius": -1},
            "solid[0].radius = -1: must be greater than 0 (radius [m])",
        ),
        (
            {"shape": "capsule", "from": [0, 0], "radius": 1},
            "solid[0].to: is missing (end of the axis [m])",
        ),
        (
            {"shape": "capsule", "from": [0, 0], "to": [0, 0], "radius": 1},
            'solid[0].to = [0.0, 0.0]: must differ from "from"',
        ),
        (
            {"shape": "plane", "point": [0, 0], "normal": [0, 0]},
            "solid[0].normal = [0.0, 0.0]: must not be zero",
        ),
    ],
)
def test_refused_shapes(shape, expected):
    assert error({"solid": [shape]}).startswith(f"dam.toml: {expected}")


def test_an_array_of_tables_is_asked_for():
    assert "must be an array of tables, written [[solid]]" in error({"solid": BOX})


def test_angles_are_numbers_or_lists():
    scene = build({"solid": [{**BOX, "rotate": 30}, {**BOX, "rotate": [45.0]}]})
    assert [solid.rotate for solid in scene.solid] == [[30.0], [45.0]]


def test_a_scene_does_not_change():
    scene = build({})
    with pytest.raises(ValueError, match="frozen"):
        scene.time.duration = 3.0


def test_enclosed_volume_counts_what_is_inside_the_domain():
    sphere = {"shape": "sphere", "center": [0.0, 0.0], "radius": 0.5}
    scene = build(
        {
            "solid": [
                {**BOX, "translate": [1.4, 0.0]},
                {**BOX, "translate": [-1.0, 0.0]},
                {**sphere, "invert": True},
            ]
        }
    )
    volumes = [scene.enclosed_volume(solid) for solid in scene.solid]
    assert volumes == pytest.approx([0.08, 0.0, 1.28])
    errors = scene.shape_errors("liquid", scene.solid, inside=True)
    assert [error.place for error in errors] == [("liquid", 1)]


def test_shapes_become_geometry_in_place():
    scene = build({"solid": [{**BOX, "scale": 2.0, "rotate": 90, "translate": [1.0, 0.0]}]})
    bounds = scene.solid[0].bounds(2)
    assert bounds is not None
    assert bounds[:, :2].ravel() == pytest.approx([0.2, 0.0, 1.0, 0.8])


def test_tables_of_shapes_have_names_by_which_they_are_pickled():
    scene = build({"solid": [{**BOX, "wall": "sticky"}]})
    solid = scene.solid[0]
    assert type(solid) is shaped(SolidProperties, BoxTable)
    assert f"{type(solid).__module__}.{type(solid).__name__}" == "warp_lcp.scene.shapes.SolidBox"
    assert type(solid).__doc__ == "Solid: box between two corners."
    assert pickle.loads(pickle.dumps(solid)) == solid == copy.deepcopy(solid)
