"""Examples of the README, as they stand."""

import tomllib
from pathlib import Path

import pytest

import warp_lcp as wl
from code_blocks import blocks, run
from warp_lcp.material.particle_scene import ParticleScene
from warp_lcp.scene.scene_file import load_scene

README = Path(__file__).parents[1] / "README.md"


def test_it_is_short_and_counts_the_methods():
    text = README.read_text()
    assert text.count("\n") <= 120
    assert f"[{len(wl.METHODS)} methods]" in text
    assert (
        f">{len(wl.METHODS)} methods: init, step<"
        in (README.parent / "docs" / "architecture.svg").read_text()
    )


@pytest.mark.parametrize("code", blocks(README, "python"))
def test_python_examples_run(code, capsys):
    run(code, README)
    assert capsys.readouterr().out.startswith("CONVERGED")


@pytest.mark.parametrize("text", blocks(README, "toml"))
def test_scene_examples_are_valid(text, tmp_path):
    file = tmp_path / "my-scene.toml"
    file.write_text(text)
    assert tomllib.loads(text)
    scene = load_scene(str(file), [])
    assert isinstance(scene, ParticleScene)
    assert scene.cell_counts[0] == scene.domain.resolution
