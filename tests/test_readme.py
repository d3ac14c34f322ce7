"""The README's examples work as they stand."""

import re
import tomllib
from pathlib import Path

import pytest

from warp_lcp.driver.particle_scene import ParticleScene
from warp_lcp.driver.scene_file import load_scene

README = Path(__file__).parents[1] / "README.md"


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README.read_text(), flags=re.S)


@pytest.mark.parametrize("code", blocks("python"))
def test_python_examples_run(code, capsys):
    exec(compile(code, str(README), "exec"), {})
    assert capsys.readouterr().out.startswith("CONVERGED")


@pytest.mark.parametrize("text", blocks("toml"))
def test_scene_examples_are_valid(text, tmp_path):
    file = tmp_path / "my-scene.toml"
    file.write_text(text)
    assert tomllib.loads(text)
    scene = load_scene(str(file), [])
    assert isinstance(scene, ParticleScene)
    assert scene.cell_counts[0] == scene.domain.resolution


def test_pictures_exist():
    names = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", README.read_text())
    assert names
    assert all((README.parent / name).is_file() for name in names)
