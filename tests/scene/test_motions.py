"""Key `motion` of a solid: accepted values, messages of refusals, positions."""

import json
from functools import partial

import numpy as np
import pytest
from typer.testing import CliRunner

from scene_tables import scene_error
from warp_lcp.cli import commands as cli
from warp_lcp.grid import motion as motions
from warp_lcp.scene.scene import Scene, SceneError, validate
from warp_lcp.scene.scene_file import dump_scene, load_scene

KINDS = ("keyframes", "rotation", "sinusoid", "translation")


def build(motion: object, dimension: int = 2, solids: str = "cut-cell") -> Scene:
    data = {
        "scene": {"simulator": "dots"},
        "time": {"duration": 1.0},
        "domain": {"size": [1.6, 0.8, 0.8][:dimension], "resolution": 16, "solids": solids},
        "solid": [
            {"shape": "sphere", "center": [0.2] * dimension, "radius": 0.1, "motion": motion}
        ],
    }
    return validate(Scene, data, "dam.toml")


error = partial(scene_error, build)


def place(motion: dict, time: float, point: list[float]) -> list[float]:
    """Return the position at a time of a point of the solid as placed."""
    dimension = len(point)
    read = build(motion, dimension).solid[0].motion.to_motion(dimension)
    assert isinstance(read, motions.Motion)
    return read.pose(time).apply(np.array([*point, 0.0][:3]))[:dimension].tolist()


@pytest.mark.parametrize(
    ("motion", "time", "point", "expected"),
    [
        ({"kind": "translation", "velocity": [1.0, -2]}, 0.25, [0.0, 0.0], [0.25, -0.5]),
        (
            {"kind": "translation", "velocity": [1.0, 0.0], "start": 0.5, "stop": 0.75},
            9.0,
            [0.0, 1.0],
            [0.25, 1.0],
        ),
        ({"kind": "rotation", "rate": 90.0, "center": [1.0, 0.0]}, 1.0, [2.0, 0.0], [1.0, 1.0]),
        (
            {"kind": "rotation", "rate": 90, "center": [0, 0, 0], "axis": [0, 5, 0], "stop": 1},
            3.0,
            [1.0, 1.0, 0.0],
            [0.0, 1.0, -1.0],
        ),
        ({"kind": "sinusoid", "period": 2.0, "amplitude": [0.3, 0.0]}, 0.5, [0.0, 1.0], [0.3, 1.0]),
        (
            {"kind": "sinusoid", "period": 2.0, "amplitude": [0.3, 0.0], "phase": 90},
            0.0,
            [0.0, 1.0],
            [0.3, 1.0],
        ),
        (
            {"kind": "sinusoid", "period": 2.0, "angle": 90.0, "center": [0.0, 1.0]},
            1.5,
            [1.0, 1.0],
            [0.0, 0.0],
        ),
        (
            {"kind": "sinusoid", "period": 4, "angle": 90, "center": [0, 0, 0], "axis": [1, 0, 0]},
            1,
            [0.0, 1.0, 0.0],
            [0.0, 0.0, 1.0],
        ),
        (
            {"kind": "keyframes", "times": [0.0, 2.0], "translate": [[0, 0], [1, 2]]},
            0.5,
            [0.0, 0.0],
            [0.25, 0.5],
        ),
        (
            {
                "kind": "keyframes",
                "times": [0, 2],
                "translate": [[0, 0], [1, 2]],
                "interpolation": "smooth",
            },
            0.5,
            [0.0, 0.0],
            [0.15625, 0.3125],
        ),
        (
            {"kind": "keyframes", "times": [0, 1], "rotate": [0, 450], "center": [0, 0]},
            1,
            [1.0, 0.0],
            [0.0, 1.0],
        ),
        (
            {
                "kind": "keyframes",
                "times": [0, 1],
                "rotate": [[0, 0, 0], [90, 0, 90]],
                "center": [0, 0, 0],
            },
            1,
            [0.0, 1.0, 0.0],
            [0.0, 0.0, 1.0],
        ),
    ],
)
def test_motions_become_poses(motion, time, point, expected):
    np.testing.assert_allclose(place(motion, time, point), expected, atol=1e-14)


@pytest.mark.parametrize(
    ("motion", "expected"),
    [
        ({}, f".kind: is missing; choose from {', '.join(KINDS)}"),
        (3, " = 3: must be a table"),
        ({"kind": "rotate"}, ".kind = \"rotate\": unknown kind; did you mean 'rotation'?"),
        ({"kind": "orbit"}, f'.kind = "orbit": unknown kind; choose from {", ".join(KINDS)}'),
        ({"kind": "translation"}, ".velocity: is missing"),
        (
            {"kind": "translation", "velocity": [1.0, 0.0], "stopp": 1},
            ".stopp: unknown key; did you mean 'stop'?",
        ),
        (
            {"kind": "translation", "velocity": [1.0, 0.0, 0.0]},
            ".velocity = [1.0, 0.0, 0.0]: must have 2 entries in 2-D",
        ),
        (
            {"kind": "translation", "velocity": [1.0, 0.0], "stop": 0},
            ": stop must be later than start = 0.0 s, not 0.0",
        ),
        (
            {"kind": "translation", "velocity": [1.0, float("inf")]},
            ".velocity[1] = Infinity: must be finite",
        ),
        ({"kind": "rotation", "rate": 90.0}, ".center: is missing (point of the axis [m])"),
        (
            {"kind": "rotation", "rate": "90", "center": [0, 0]},
            '.rate = "90": must be a number (angular velocity [degrees/s]',
        ),
        (
            {"kind": "rotation", "rate": 90.0, "center": [0, 0], "axis": [0, 0, 1]},
            ".axis = [0.0, 0.0, 1.0]: must be left out in 2-D",
        ),
        ({"kind": "sinusoid", "amplitude": [1, 0]}, ".period: is missing"),
        (
            {"kind": "sinusoid", "period": 0, "amplitude": [1, 0]},
            ".period = 0: must be greater than 0 (period [s])",
        ),
        ({"kind": "sinusoid", "period": 1}, ": a sinusoid needs amplitude, angle or both"),
        (
            {"kind": "sinusoid", "period": 1, "angle": 9},
            ".center: is missing: the point [m] to turn about, since there is angle",
        ),
        (
            {"kind": "sinusoid", "period": 1, "amplitude": [1, 0], "center": [0, 0]},
            ".center = [0.0, 0.0]: has no effect without angle",
        ),
        ({"kind": "keyframes", "times": [0, 1]}, ": keyframes need translate, rotate or both"),
        (
            {"kind": "keyframes", "times": [0, 1, 1], "translate": [[0, 0]] * 3},
            ".times = [0.0, 1.0, 1.0]: must increase",
        ),
        (
            {"kind": "keyframes", "times": [0], "translate": [[0, 0]]},
            ".times = [0]: must have at least 2 entries",
        ),
        (
            {"kind": "keyframes", "times": [0, 1], "translate": [[0, 0]]},
            ".translate = [[0.0, 0.0]]: must have 2 entries, one for each time",
        ),
        (
            {"kind": "keyframes", "times": [0, 1], "translate": [[0, 0], [0, 0, 1]]},
            ".translate[1] = [0.0, 0.0, 1.0]: must have 2 entries",
        ),
        (
            {"kind": "keyframes", "times": [0, 1], "rotate": [0, 90]},
            ".center: is missing: the point [m] to turn about, since there is rotate",
        ),
        (
            {"kind": "keyframes", "times": [0, 1], "rotate": [0, [1, 2]], "center": [0, 0]},
            ".rotate[1] = [1.0, 2.0]: must be one number in 2-D",
        ),
        (
            {
                "kind": "keyframes",
                "times": [0, 1],
                "translate": [[0, 0]] * 2,
                "interpolation": "cubic",
            },
            ".interpolation = \"cubic\": must be 'linear' or 'smooth'",
        ),
    ],
)
def test_refused_motions(motion, expected):
    assert error(motion).startswith(f"dam.toml: solid[0].motion{expected}")


@pytest.mark.parametrize(
    ("motion", "expected"),
    [
        (
            {"kind": "rotation", "rate": 1, "center": [0, 0, 0]},
            ".axis: is missing: the direction to turn about, such as [0.0, 1.0, 0.0]",
        ),
        (
            {"kind": "rotation", "rate": 1, "center": [0, 0, 0], "axis": [0, 0, 0]},
            ": axis must not be zero",
        ),
        (
            {"kind": "rotation", "rate": 1, "center": [0, 0, 0], "axis": [0, 1]},
            ".axis = [0, 1]: must have at least 3 entries",
        ),
        ({"kind": "sinusoid", "period": 1, "angle": 9, "center": [0, 0, 0]}, ".axis: is missing"),
        (
            {
                "kind": "keyframes",
                "times": [0, 1],
                "rotate": [[0, 0, 0], [0, 200, 0]],
                "center": [0, 0, 0],
            },
            ": rotate must change by less than 180 degrees from one keyframe to the next",
        ),
    ],
)
def test_refused_motions_in_space(motion, expected):
    assert error(motion, dimension=3).startswith(f"dam.toml: solid[0].motion{expected}")


def test_solids_of_whole_cells_do_not_move():
    text = error({"kind": "translation", "velocity": [1.0, 0.0]}, solids="voxel")
    assert (
        text
        == 'dam.toml: solid[0].motion: needs domain.solids = "cut-cell": solids that fill whole '
        "cells cannot move"
    )


def test_liquid_has_no_motion():
    data = {
        "scene": {"simulator": "fluids"},
        "time": {"duration": 1.0},
        "domain": {"size": [1.0, 1.0], "resolution": 8},
    }
    data["liquid"] = [
        {
            "shape": "box",
            "min": [0.0, 0.0],
            "max": [1.0, 0.5],
            "motion": {"kind": "translation", "velocity": [1.0, 0.0]},
        }
    ]
    from warp_lcp.fluids.scene import LiquidScene

    with pytest.raises(SceneError, match=r"liquid\[0\].motion: unknown key"):
        validate(LiquidScene, data, "dam.toml")


TOML = """
[scene]
simulator = "dots"
[time]
duration = 0.5
[domain]
size = [1.0, 1.0]
resolution = 8
solids = "cut-cell"
[[solid]]
shape = "box"
min = [0.1, 0.1]
max = [0.2, 0.2]
motion = { kind = "keyframes", times = [0, 1], rotate = [0, 90], \
translate = [[0, 0], [0.1, 0]], center = [0.1, 0.1] }
[[solid]]
shape = "sphere"
center = [0.5, 0.5]
radius = 0.1
[solid.motion]
kind = "rotation"
rate = 20.0
center = [0.4, 0.5]
"""


def test_a_scene_file_keeps_its_motions(dots, tmp_path):
    source, copy = tmp_path / "scene.toml", tmp_path / "copy.toml"
    source.write_text(TOML)
    scene = load_scene(source, ["solid.1.motion.rate=-30"])
    assert [solid.motion.kind for solid in scene.solid] == ["keyframes", "rotation"]
    assert scene.solid[1].motion.rate == -30.0
    copy.write_text(dump_scene(scene))
    assert load_scene(copy) == scene


def test_the_schema_lists_the_kinds():
    result = CliRunner().invoke(cli.app, ["schema"])
    assert result.exit_code == 0
    schema = json.loads(result.stdout)
    motion = schema["$defs"]["SolidSphere"]["properties"]["motion"]["anyOf"][0]
    assert motion["discriminator"]["propertyName"] == "kind"
    assert tuple(sorted(motion["discriminator"]["mapping"])) == KINDS
    assert "motion" not in schema["$defs"]["LiquidSphere"]["properties"]
