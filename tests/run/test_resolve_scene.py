"""Resumed runs keep --set overrides; new ones replace them, with a message."""

import json
import random
from pathlib import Path

import pytest

from command_line import invoke
from warp_lcp.run.folder import OutputError
from warp_lcp.run.resolve_scene import ResolvedScene, resolve_scene, scene_to_resume
from warp_lcp.scene.scene_file import dump_scene, keys


def ran(out: Path, given: ResolvedScene) -> None:
    """Write the files of a run that matter here."""
    out.mkdir(exist_ok=True)
    (out / "scene.toml").write_text(dump_scene(given.scene))
    (out / "run.json").write_text(json.dumps({"overrides": given.overrides}))


def edit(file: Path, **changes: str) -> None:
    """Set keys, whose names are unique in a file, to other values."""
    lines = file.read_text().splitlines()
    file.write_text(
        "\n".join(
            f"{name} = {changes[name]}" if (name := line.partition(" = ")[0]) in changes else line
            for line in lines
        )
    )


def frames(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in out.glob("frames/*")}


@pytest.mark.parametrize("way", ["the scene", "the folder's scene", "no scene"])
def test_resume_without_repeating_set_is_the_same_run(scene_file, tmp_path, way):
    run = ["--device", "cpu", "--set", "domain.resolution=16", "--set", "time.dt_max=0.01"]
    assert (
        invoke("run", scene_file, "--out", tmp_path / "whole", *run, "--frames", 2).exit_code == 0
    )
    out = tmp_path / "parts"
    assert invoke("run", scene_file, "--out", out, *run, "--frames", 1).exit_code == 0
    named = {"the scene": [scene_file], "the folder's scene": [out / "scene.toml"], "no scene": []}[
        way
    ]
    result = invoke("run", *named, "--out", out, "--device", "cpu", "--frames", 2, "--resume")
    assert result.exit_code == 0, result.stderr
    assert ("earlier --set values: domain.resolution=16, time.dt_max=0.01" in result.stderr) == (
        way == "the scene"
    )
    assert "changed" not in result.stderr
    record = json.loads((out / "run.json").read_text())
    assert (record["changed"], record["resampled_from_resolution"]) == ([], None)
    assert [entry["set"] for entry in record["overrides"]] == [
        "domain.resolution=16",
        "time.dt_max=0.01",
    ]
    assert (out / "scene.toml").read_text() == (tmp_path / "whole" / "scene.toml").read_text()
    assert frames(out) == frames(tmp_path / "whole")


def test_changed_overrides_take_effect_and_are_reported(scene_file, tmp_path):
    out = tmp_path / "out"
    assert (
        invoke(
            "run",
            scene_file,
            "--out",
            out,
            "--device",
            "cpu",
            "--set",
            "time.dt_max=0.01",
            "--frames",
            1,
        ).exit_code
        == 0
    )
    edit(scene_file, duration="0.6")
    result = invoke(
        "run",
        scene_file,
        "--out",
        out,
        "--device",
        "cpu",
        "--frames",
        2,
        "--resume",
        "--set",
        "output.checkpoint_every=3",
    )
    assert result.exit_code == 0, result.stderr
    expected = ["output.checkpoint_every: 4 before, 3 now", "time.duration: 0.5 before, 0.6 now"]
    assert json.loads((out / "run.json").read_text())["changed"] == expected
    assert all(f"changed: {line}" in result.stderr for line in expected)


def test_an_edit_of_what_was_overridden_counts(scene_file, tmp_path):
    out, source = tmp_path / "out", str(scene_file)
    ran(out, resolve_scene(source, ["time.duration=1.0", "time.dt_max=0.01"]))
    edit(scene_file, duration="2.0")
    given = scene_to_resume(out, source, [])
    assert (given.scene.time.duration, given.scene.time.dt_max, given.kept) == (
        2.0,
        0.01,
        ["time.dt_max=0.01"],
    )


def test_another_resolution_is_asked_for_by_name(scene_file, tmp_path):
    out, source = tmp_path / "out", str(scene_file)
    ran(out, resolve_scene(source, ["domain.resolution=16"]))
    (out / "run.json").write_text("{}")  # of a version that did not store it
    with pytest.raises(
        OutputError,
        match=r"domain.resolution is 16, but 8 in .*dots.toml: use --set domain.resolution=8 to "
        r"resample",
    ):
        scene_to_resume(out, source, [])
    for resolution in (8, 16, 32):
        given = scene_to_resume(out, source, [f"domain.resolution={resolution}"])
        assert given.scene.domain.resolution == resolution
    ran(out, given)
    assert scene_to_resume(out, source, []).scene.domain.resolution == 32
    edit(scene_file, resolution="64")
    with pytest.raises(OutputError, match=r"domain.resolution is 32, but 64 in "):
        scene_to_resume(out, source, [])


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "SCENE is missing"),
        (["--resume"], "needs SCENE or --out DIR"),
        (["--resume", "--out", "{out}"], "there is no run to resume"),
    ],
)
def test_without_a_scene(dots, tmp_path, arguments, expected):
    result = invoke("run", *(argument.format(out=tmp_path / "none") for argument in arguments))
    assert result.exit_code == 2
    assert expected in result.stderr
    assert not (tmp_path / "none").exists()


VALUES = {
    "duration": ["0.5", "1.0", "2.0"],
    "dt_max": ["0.02", "0.01", "0.005"],
    "checkpoint_every": ["4", "9", "12"],
}
TABLE = {"duration": "time", "dt_max": "time", "checkpoint_every": "output"}


@pytest.mark.parametrize("seed", range(5200, 5240))
def test_the_last_override_counts(dots, scene_file, tmp_path, seed):
    """Last value of a key.

    Whatever was set or edited before, a key has its last value, by --set or in the file.
    """
    rng, source, out = random.Random(seed), str(scene_file), tmp_path / "out"
    in_file = {name: values[0] for name, values in VALUES.items()}
    expected, settled = dict(in_file), True
    for part in range(8):
        route = "scene" if part == 0 else rng.choice(["scene", "scene", "own", "none"])
        if route == "scene" and settled:  # edits are read before anything else is set
            for name in rng.sample(list(VALUES), rng.choice([0, 0, 1])):
                value = rng.choice(VALUES[name])
                expected[name] = expected[name] if value == in_file[name] else value
                in_file[name] = value
            edit(scene_file, **in_file)
        given = {
            name: rng.choice(VALUES[name])
            for name in rng.sample(list(VALUES), rng.choice([0, 1, 2]))
        }
        expected |= given
        overrides = [f"{TABLE[name]}.{name}={value}" for name, value in given.items()]
        settled = route == "scene"
        named = {"scene": source, "own": str(out / "scene.toml"), "none": None}[route]
        found = (
            resolve_scene(source, overrides)
            if part == 0
            else scene_to_resume(out, named, overrides)
        )
        values = keys(found.scene)
        assert {name: float(values[f"{TABLE[name]}.{name}"]) for name in VALUES} == {
            name: float(v) for name, v in expected.items()
        }, part
        ran(out, found)
