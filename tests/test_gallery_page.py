"""The gallery of the documentation shows every built-in scene."""

import json
import re
from importlib.resources import files
from pathlib import Path

DOCS = Path(__file__).parents[1] / "docs"


def test_every_built_in_scene_has_a_picture_and_figures():
    scenes = {
        entry.name.removesuffix(".toml")
        for entry in files("warp_lcp.scene.scenes").iterdir()
        if entry.name.endswith(".toml")
    }
    page = (DOCS / "gallery.md").read_text()
    assert set(re.findall(r"^## (\S+)$", page, flags=re.M)) == scenes
    assert (
        set(re.findall(r"\]\(gallery/(\S+)\.webp\)", page))
        == scenes
        == {path.stem for path in (DOCS / "gallery").glob("*.webp")}
    )
    assert set(re.findall(r"^warp-lcp run (\S+)", page, flags=re.M)) < scenes
    figures = json.loads((DOCS / "gallery" / "figures.json").read_text())["scenes"]
    assert scenes == figures.keys()
    assert all(entry["seconds"] > 0 and entry["megabytes"] > 0 for entry in figures.values())
