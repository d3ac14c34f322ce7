"""A liquid's run that is interrupted and resumed writes the same bytes as one that is not."""

from pathlib import Path

import pytest

from warp_lcp.driver.run import run_scene
from warp_lcp.driver.scene_file import load_scene


class Silent:
    """An observer that counts steps."""

    def __init__(self):
        self.steps = 0

    def note(self, text):
        assert text

    def start(self, time, end):
        assert end > time

    def step(self, row):
        self.steps += 1

    def frame(self, index, last):
        assert index <= last


MOVING = ["domain.resolution=60", "time.duration=0.4", "output.checkpoint_every=5", "pressure.smoothing=1", "particles.transfer=flip"]
TANK = ["domain.resolution=24", "time.duration=0.12", "output.checkpoint_every=5"]
OVERRIDES = ["domain.resolution=32", "time.duration=0.3", "output.checkpoint_every=5"]


def written(folder: Path) -> dict[str, bytes]:
    """Return frames, collections and the last checkpoint by name."""
    files = [*folder.glob("frames/*"), *folder.glob("*.pvd"), sorted(folder.glob("checkpoints/*.npz"))[-1]]
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("dam-break-2d", OVERRIDES),
        ("dam-break", [*OVERRIDES, "time.duration=0.1"]),
        ("splash-in-circle", [*OVERRIDES, "particles.transfer=flip", "pressure.surface=voxel"]),
        ("retracting-wall", MOVING),
        ("stirred-tank", TANK),
    ],
)
def test_resumed_equals_uninterrupted(name: str, overrides: list[str], tmp_path: Path) -> None:
    scene = load_scene(name, overrides)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert run_scene(scene, whole, device="cpu", observer=Silent()).status == "finished"
    watch = Silent()
    first = run_scene(scene, parts, device="cpu", observer=watch, stop=lambda: watch.steps >= 3)
    assert first.status == "stopped"
    rest = Silent()
    second = run_scene(scene, parts, device="cpu", observer=rest, resume=True)
    assert second.status == "finished"
    assert second.resumed_from_step == 3
    assert watch.steps + rest.steps == second.steps
    assert written(whole) == written(parts)
