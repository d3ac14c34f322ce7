"""Two trees in turns: what is timed, and the files that are left; the work itself needs a GPU."""

import json
from pathlib import Path
from typing import Any

import warp_lcp as wl
from benchmarks import gpu_turns
from warp_lcp.scene.scene_file import built_in_scenes


def test_listed_methods_and_scenes_exist() -> None:
    found = list(gpu_turns.pieces(gpu_turns.WorkSizes()))
    assert all(hasattr(wl, name) for kind, name, _ in found if kind != "step")
    assert set(gpu_turns.SCENES.values()) <= set(built_in_scenes())
    assert len(found) == len(set(found)) == 3 + 9 + len(gpu_turns.METHODS) - 1


def test_files_are_written_after_each_piece_of_work(tmp_path: Path) -> None:
    turns = gpu_turns.InterleavedTurns(tmp_path, ["one", "other"], left_out=["step sand 256"])
    found: dict[str, dict[str, Any]] = {
        "one": {"ms": 5.25, "iterations": 9, "status": "CONVERGED"},
        "other": {"ms": 10.0, "iterations": 200, "status": "MAX_ITERATIONS"},
    }
    turns.add(("cold solve", "ProjectedMultigrid", 128), found)
    turns.add(("step", "sand", 64), {"one": {"ms": 12.0}, "other": {"error": "ValueError: wrong"}})
    page = (tmp_path / "turns.md").read_text()
    row = "| cold solve: ProjectedMultigrid | 128 | 5.25 in 9 | 10 in 200, MAX_ITERATIONS |"
    assert row in page
    assert "| step: sand | 64 | 12 | ValueError: wrong |" in page
    assert "Left out, for the time was over: step sand 256." in page
    kept = json.loads((tmp_path / "turns.json").read_text())
    assert [work["cells"] for work in kept["work"]] == [128, 64]
    assert kept["work"][0]["found"] == found
