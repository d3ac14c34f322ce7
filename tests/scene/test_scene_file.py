"""Scene files: found, parsed, overridden, and written back."""

import json
from pathlib import Path

import numpy as np
import pytest

from warp_lcp.scene.scene_file import built_in_scenes, check_shapes, dump_scene, keys, load_scene
from warp_lcp.scene.table import SceneError


def write(path: Path, text: str) -> Path:
    path.write_text(path.read_text() + text)
    return path


def test_the_file_names_the_scene(scene_file):
    assert load_scene(scene_file).scene.name == "dots"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "damm-break",
            "damm-break: no such file, and no such built-in scene; did you mean 'dam-break'?",
        ),
        ("x" * 9, "no such built-in scene; choose from arched-snake, "),
        ("missing.toml", "missing.toml: there is no such file"),
        ("folder/missing", "folder/missing: there is no such file"),
    ],
)
def test_missing_files_are_reported(dots, text, expected):
    with pytest.raises(SceneError) as caught:
        load_scene(text)
    assert expected in str(caught.value)


def test_a_folder_is_no_scene(dots, tmp_path):
    with pytest.raises(SceneError, match="is a folder, not a scene file"):
        load_scene(tmp_path)


def test_toml_errors_name_the_line(scene_file):
    with pytest.raises(SceneError, match=r"dots.toml: is not valid TOML: .*line 1[0-9]"):
        load_scene(write(scene_file, "\n[time\n"))


def test_other_encodings_are_refused(scene_file):
    scene_file.write_bytes(b"# caf\xe9")
    with pytest.raises(SceneError, match=r"is not UTF-8 text \(byte 5\)"):
        load_scene(scene_file)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "scene.simulator: is missing; choose from dots"),
        ("scene = 3", "scene.simulator: is missing; choose from dots"),
        (
            '[scene]\nsimulator = "dts"',
            "scene.simulator = \"dts\": no such simulator; did you mean 'dots'?",
        ),
        ("[scene]\nsimulator = [1]", "scene.simulator = [1]: no such simulator"),
    ],
)
def test_the_simulator_decides(scene_file, text, expected):
    scene_file.write_text(text)
    with pytest.raises(SceneError) as caught:
        load_scene(scene_file)
    assert expected in str(caught.value)


def test_overrides_are_toml_values_or_words(scene_file):
    write(scene_file, '[[solid]]\nshape = "box"\nmin = [0, 0]\nmax = [0.5, 0.5]\n')
    overrides = [
        "time.duration=0.25",
        "domain.wall=free-slip",
        "solid.0.max=[0.75, 0.5]",
        "physics.gravity = [1.0, 0]",
        'scene.description="a=b"',
    ]
    scene = load_scene(scene_file, overrides)
    assert (scene.time.duration, scene.domain.wall, scene.solid[0].max) == (
        0.25,
        "free-slip",
        [0.75, 0.5],
    )
    assert (scene.physics.gravity, scene.scene.description) == ([1.0, 0.0], "a=b")


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("time.cfl", "--set time.cfl: must read section.key=value"),
        ("cfl=1", "--set cfl=1: must read section.key=value"),
        ("time.cfll=1", "time.cfll: unknown key; did you mean 'cfl'?"),
        ("tim.cfl=1", "tim: unknown key; did you mean 'time'?"),
        ("time.cfl=fast", 'time.cfl = "fast": must be a number'),
        ("time.duration.x=1", "--set time.duration.x: time.duration has no keys: it is 0.5"),
        (
            "domain.size.7=1",
            "--set domain.size.7: is not an entry of domain.size; there are entries 0 to 1",
        ),
        ("solid.0.max=1", "must be an array of tables, written [[solid]]"),
    ],
)
def test_wrong_overrides(scene_file, override, expected):
    with pytest.raises(SceneError) as caught:
        load_scene(scene_file, [override])
    assert expected in str(caught.value)


def test_the_resolved_scene_reads_back_equal(scene_file):
    write(
        scene_file,
        '[[solid]]\nshape = "capsule"\nfrom = [0, 0]\nto = [0.5, 0.5]\nradius = 0.1\nrotate = 30\n',
    )
    scene = load_scene(scene_file, ["time.dt_min=1e-7"])
    copy = scene_file.with_name("copy.toml")
    copy.write_text(dump_scene(scene))
    assert load_scene(copy) == scene
    assert keys(scene) == keys(load_scene(copy))


def test_keys_are_written_as_in_messages(scene_file):
    write(scene_file, '[[solid]]\nshape = "sphere"\ncenter = [0, 0]\nradius = 0.1\n')
    found = keys(load_scene(scene_file, ["time.cfl=4.0", "solid.0.wall=free-slip"]))
    assert (found["time.cfl"], found["solid[0].wall"], found["solid[0].center"]) == (
        4.0,
        "free-slip",
        [0.0, 0.0],
    )
    assert "solid[0].motion" not in found


def test_mesh_files_become_absolute(scene_file, monkeypatch, tmp_path):
    (tmp_path / "thing.obj").write_text("v 0 0 0\n")
    text = 'size = [1.0, 1.0, 1.0]\nresolution = 8\n[[solid]]\nshape = "mesh"\nfile = "thing.obj"\n'
    scene_file.write_text('[scene]\nsimulator = "dots"\n[time]\nduration = 1.0\n[domain]\n' + text)
    monkeypatch.chdir(tmp_path.parent)
    scene = load_scene(scene_file)
    assert scene.solid[0].file == str(tmp_path / "thing.obj")
    with pytest.raises(SceneError, match=r"solid\[0\]"):
        check_shapes(scene, "dots.toml")  # one vertex encloses nothing
    (tmp_path / "thing.obj").unlink()
    with pytest.raises(SceneError, match=r"solid\[0\].file = .*thing.obj.*: there is no such file"):
        load_scene(scene_file)


@pytest.mark.parametrize("name", list(built_in_scenes()))
def test_built_in_scenes_are_valid(name):
    scene = load_scene(name)
    assert scene.scene.name == name
    assert scene.scene.description
    # Minutes, not hours, on two cores.
    assert np.prod(getattr(scene, "covered_counts", 0)) < 200_000
    check_shapes(scene, name)


def test_the_documented_scenes_exist():
    promised = {
        "dam-break-2d",
        "dam-break",
        "ceiling-drop",
        "splash-in-circle",
        "water-labyrinth",
        "splash-in-square",
        "mesh-obstacle",
    }
    promised |= {"wave-maker", "retracting-wall", "stirred-tank"}
    promised |= {
        "column-collapse-2d",
        "column-collapse",
        "hourglass-2d",
        "hourglass",
        "pouring-pile",
        "sand-on-mesh",
    }
    assert promised <= built_in_scenes().keys()


NAMES = [
    "../../../x",
    "a/b",
    "a\\b",
    "/etc/x",
    "..",
    ".",
    "...",
    ".x",
    "x.",
    " x",
    "x ",
    "a\0b",
    "a\nb",
    "\x1b[2J",
    "a:b",
]
NAMES += ["*", "x" * 61, "~/x", "a\u0300"]


@pytest.mark.parametrize("name", NAMES, ids=ascii)
def test_names_that_leave_the_folder_are_refused(scene_file, name):
    with pytest.raises(SceneError, match=r"scene\.name = .*: must be a name of at most 60 letters"):
        load_scene(scene_file, [f"scene.name={json.dumps(name)}"])
    written = scene_file.read_text().replace("[scene]", f"[scene]\nname = {json.dumps(name)}")
    scene_file.write_text(written)
    with pytest.raises(SceneError, match=r"scene\.name"):
        load_scene(scene_file)


@pytest.mark.parametrize(
    "name", ["dam-break", "Dam break 2", "v1.2_b", "\u00fcber", "\u6c34", "x" * 60]
)
def test_names(scene_file, tmp_path, name):
    assert load_scene(scene_file, [f"scene.name={json.dumps(name)}"]).scene.name == name
    file = tmp_path / f"{name}.toml"
    file.write_text(scene_file.read_text())
    assert load_scene(file).scene.name == name


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("a (1).toml", "a -1-"),
        ("..x.toml", "x"),
        ("...toml", "scene"),
        ("a=b.toml", "a-b"),
        ("u\u0308.toml", "\u00fc"),
        ("x" * 99 + ".toml", "x" * 60),
    ],
    ids=ascii,
)
def test_the_name_of_a_file_becomes_one(scene_file, tmp_path, file, name):
    (tmp_path / file).write_text(scene_file.read_text())
    assert load_scene(tmp_path / file).scene.name == name
    assert load_scene(tmp_path / file, ['scene.name=""']).scene.name == name
