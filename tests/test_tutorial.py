"""Every block of the tutorial, as it stands: Python, scenes and commands."""

import csv
import json
import re
import shlex
from pathlib import Path

import pytest

from code_blocks import blocks, run
from command_line import succeed

TUTORIAL = Path(__file__).parents[1] / "docs" / "tutorial.md"
SCENES = blocks(TUTORIAL, "toml")
COMMANDS = [
    shlex.split(line, comments=True)[1:]
    for block in blocks(TUTORIAL, "sh")
    for line in block.splitlines()
    if re.match(r"warp-lcp ", line)
]
# The text's films take longer.
SHORTER = ["--set", "time.duration=0.05", "--set", "domain.resolution=24"]


@pytest.mark.parametrize("code", blocks(TUTORIAL, "python"))
def test_python_examples_run(code, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(code, TUTORIAL)
    out = capsys.readouterr().out
    assert out.startswith("CONVERGED") or "not rough" in code or out.endswith("finished\n")


def test_the_text_shows_the_output_of_the_first_problem(capsys):
    run(blocks(TUTORIAL, "python")[0], TUTORIAL)
    assert f"`{capsys.readouterr().out.strip()}`" in TUTORIAL.read_text()


def test_there_are_scenes_of_both_materials():
    assert [re.search(r'simulator = "(\w+)"', text)[1] for text in SCENES] == ["fluids", "granular"]


@pytest.mark.parametrize("text", SCENES)
def test_scenes_run(text, tmp_path):
    scene = tmp_path / "scene.toml"
    scene.write_text(text)
    succeed("check", str(scene))
    succeed("run", str(scene), "--out", str(tmp_path / "out"), *SHORTER)
    assert json.loads((tmp_path / "out" / "run.json").read_text())["status"] == "finished"
    with (tmp_path / "out" / "log.csv").open() as log:
        assert list(csv.DictReader(log))
    assert (tmp_path / "out" / "particles.pvd").is_file()
    assert (tmp_path / "out" / "grid.pvd").is_file()


def test_commands_work(tmp_path, monkeypatch):
    """Commands in the text's order, in one folder.

    The folder holds the scenes under the names in the text.
    """
    monkeypatch.chdir(tmp_path)
    Path("crate.toml").write_text(SCENES[0])
    Path("sand.toml").write_text(SCENES[1])
    assert [words[0] for words in COMMANDS] == [
        "run",
        "render",
        "check",
        "run",
        "render",
        "render",
        "run",
        "render",
    ]
    for words in COMMANDS:
        if words[0] == "render":
            pytest.importorskip("pyvista")
        succeed(*words, *(SHORTER if words[0] == "run" else []))
    assert {path.name for path in tmp_path.iterdir()} == {
        "dam",
        "crate",
        "sand",
        "crate.toml",
        "sand.toml",
        "dam.gif",
        "crate.gif",
    }
    assert (tmp_path / "crate" / "images" / "sheet.png").is_file()


def test_the_scene_with_a_body_has_one(tmp_path):
    """Scene with a body, at the text's resolution, until the crate meets the water."""
    scene = tmp_path / "crate.toml"
    scene.write_text(SCENES[0])
    succeed("run", str(scene), "--out", str(tmp_path / "out"), "--frames", "3")
    with (tmp_path / "out" / "log.csv").open() as log:
        rows = list(csv.DictReader(log))
    assert float(rows[-1]["body0_y"]) < 0.35 - 0.04
    assert float(rows[-1]["body0_angle"]) > 3.0
    assert (tmp_path / "out" / "bodies.pvd").is_file()
    assert (tmp_path / "out" / "surface.pvd").is_file()
