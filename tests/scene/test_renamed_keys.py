"""Old names of scene keys: read with a warning.

`warp-lcp check --fix` rewrites them.
"""

import tomllib
import warnings

import pytest
from typer.testing import CliRunner

from warp_lcp.cli.commands import app
from warp_lcp.granular.scene import SandScene
from warp_lcp.scene.renamed_keys import RenamedKeyWarning, fix_text
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.table import SceneError

SCENE = """# a heap
[scene]
simulator = "granular"
description = "angle_of repose"  # no key

[domain]
size = [1.0, 1.0]
resolution = 16

[time]
duration = 0.01

[material]   # of grains
angle_of = "plane-strain"  # of a test
friction_angle = 30.0

[[sand]]
shape = "box"
min = [0.0, 0.0]
max = [0.5, 0.5]
"""
SCENE_TABLES = tomllib.loads(SCENE)
FORMS = {
    "table": SCENE,
    "quoted": SCENE.replace("angle_of =", '"angle_of" ='),
    "inline": SCENE.replace(
        '[material]   # of grains\nangle_of = "plane-strain"  # of a test\nfriction_angle = 30.0\n',
        "",
    ).replace("# a heap\n", 'material = { angle_of = "plane-strain", friction_angle = 30.0 }\n'),
    "dotted at the top": SCENE.replace(
        '[material]   # of grains\nangle_of = "plane-strain"  # of a test\nfriction_angle = 30.0\n',
        "",
    ).replace("# a heap\n", 'material.angle_of = "plane-strain"\nmaterial.friction_angle = 30.0\n'),
}


def test_old_names_mean_what_the_new_ones_mean(tmp_path):
    old, new = tmp_path / "old.toml", tmp_path / "new.toml"
    old.write_text(SCENE)
    new.write_text(SCENE.replace("angle_of =", "friction_angle_test ="))
    with pytest.warns(
        RenamedKeyWarning,
        match=r"material\.angle_of is now material\.friction_angle_test; `warp-lcp check --fix",
    ):
        read = load_scene(old)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        expected = load_scene(new)
    assert read.material == expected.material
    assert read.material.friction_angle_test == "plane-strain"
    with pytest.warns(RenamedKeyWarning, match=r"material\.angle_of = .* is now"):
        assert (
            load_scene(SCENE_TABLES, ["material.angle_of=repose"]).material.friction_angle_test
            == "simple-shear"
        )


@pytest.mark.parametrize("form", FORMS)
def test_fixed_text_keeps_all_else(form):
    text, renamed = fix_text(FORMS[form], SandScene, "heap.toml")
    assert renamed == ["material.angle_of is now material.friction_angle_test"]
    assert text.replace("friction_angle_test", "angle_of") == FORMS[form]
    assert tomllib.loads(text)["scene"]["description"] == "angle_of repose"
    assert fix_text(text, SandScene, "heap.toml") == (text, [])


@pytest.mark.parametrize("form", FORMS)
def test_values_that_meant_something_else_are_fixed(form, tmp_path):
    """`angle_of = "repose"` was the angle of layers, which is that of simple shear now."""
    old = FORMS[form].replace('"plane-strain"', '"repose"')
    text, renamed = fix_text(old, SandScene, "heap.toml")
    assert renamed == [
        'material.angle_of = "repose" is now material.friction_angle_test = "simple-shear"'
    ]
    assert text.replace("friction_angle_test", "angle_of") == old.replace(
        '"repose"', '"simple-shear"'
    )
    assert fix_text(text, SandScene, "heap.toml") == (text, [])
    # The value under the new name keeps its meaning.
    new = SCENE.replace('angle_of = "plane-strain"', 'friction_angle_test = "repose"')
    assert fix_text(new, SandScene, "heap.toml") == (new, [])
    file = tmp_path / "heap.toml"
    file.write_text(old)
    with pytest.warns(RenamedKeyWarning, match=r'angle_of = "repose" is now .* "simple-shear"'):
        assert load_scene(file).material.friction_angle_test == "simple-shear"


def test_text_that_cannot_be_rewritten_is_refused():
    with pytest.raises(
        SceneError,
        match=r"material\.angle_of: is the old name of material\.friction_angle_test, which is "
        r"there too",
    ):
        fix_text(
            SCENE.replace("friction_angle = 30.0", 'friction_angle_test = "repose"'),
            SandScene,
            "heap.toml",
        )
    with pytest.raises(
        SceneError, match=r"rename by hand: material\.angle_of to material\.friction_angle_test"
    ):
        fix_text(SCENE.replace("angle_of repose", "angle_of = repose"), SandScene, "heap.toml")


def test_check_reports_old_names_and_fix_rewrites_them(tmp_path):
    file = tmp_path / "heap.toml"
    file.write_text(SCENE)
    done = CliRunner().invoke(app, ["check", str(file)])
    assert done.exit_code == 0
    assert (
        "material.angle_of is now material.friction_angle_test; `warp-lcp check --fix"
        in " ".join(done.stderr.split())
    )
    done = CliRunner().invoke(app, ["check", "--fix", str(file)])
    assert done.exit_code == 0
    assert "material.angle_of is now material.friction_angle_test" in done.stdout
    assert not done.stderr
    assert file.read_text() == SCENE.replace("angle_of =", "friction_angle_test =")
    assert (
        "nothing: no key has an old name"
        in CliRunner().invoke(app, ["check", "--fix", str(file)]).stdout
    )
    done = CliRunner().invoke(app, ["check", "--fix", "dam-break"])
    assert done.exit_code == 2
    assert "--fix needs a scene file" in done.stderr
