"""Interrupted and resumed runs of a liquid: same bytes as uninterrupted ones."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from default_run import slow
from small_liquids import box, create, scene
from small_runs import StepCounter, run_into, written_files
from warp_lcp.scene.scene_file import load_scene

MOVING = [
    "domain.resolution=60",
    "time.duration=0.4",
    "output.checkpoint_every=5",
    "pressure.smoothing=1",
    "particles.transfer=flip",
]
TANK = ["domain.resolution=24", "time.duration=0.12", "output.checkpoint_every=5"]
OVERRIDES = ["domain.resolution=32", "time.duration=0.3", "output.checkpoint_every=5"]


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        slow(("dam-break-2d", OVERRIDES)),
        slow(("dam-break", [*OVERRIDES, "time.duration=0.1"])),
        ("splash-in-circle", [*OVERRIDES, "particles.transfer=flip", "pressure.surface=voxel"]),
        slow(("retracting-wall", MOVING)),
        ("retracting-wall", [*MOVING, "density_correction.every=2", "particles.reseed.every=1"]),
        slow(("stirred-tank", TANK)),
        ("tap-and-drain", [*OVERRIDES, "time.duration=1.2"]),
        ("splash-unilateral", ["domain.resolution=40", *OVERRIDES[1:]]),
    ],
)
def test_resumed_equals_uninterrupted(name: str, overrides: list[str], tmp_path: Path) -> None:
    scene = load_scene(name, overrides)
    uninterrupted, parts = tmp_path / "whole", tmp_path / "parts"
    assert run_into(scene, uninterrupted, observer=StepCounter()).status == "finished"
    watch = StepCounter()
    first = run_into(scene, parts, observer=watch, stop=lambda: watch.steps >= 3)
    assert first.status == "stopped"
    rest = StepCounter()
    second = run_into(scene, parts, observer=rest, resume=True)
    assert second.status == "finished"
    assert second.resumed_from_step == 3
    assert watch.steps + rest.steps == second.steps
    assert written_files(uninterrupted) == written_files(parts)


BALL = {"shape": "sphere", "center": [0.7, 0.3, 0.5], "radius": 0.15}


@pytest.mark.default_cases(4)
@pytest.mark.parametrize(
    ("dimension", "tables"),
    [
        (2, {}),
        slow(
            (
                2,
                {
                    "solid": [
                        BALL | {"motion": {"kind": "translation", "velocity": [-0.8, 0.2, 0.0]}}
                    ]
                },
            )
        ),
        # A level set that reaches farther than a step.
        (2, {"pressure": {"smoothing": 8}, "cfl": 0.5}),
        (2, {"particles": {"transfer": "flip"}, "pressure": {"surface": "voxel"}}),
        slow((3, {"pressure": {"smoothing": 1}})),
        (3, {"pressure": {"model": "unilateral"}, "solid": [BALL]}),
        (2, {"density_correction": {}, "particles": {"reseed": {"min": 4, "max": 4}}}),
        (
            2,
            {
                "density_correction": {"every": 2},
                "solid": [BALL | {"motion": {"kind": "translation", "velocity": [-0.8, 0.2, 0.0]}}],
            },
        ),
        slow((3, {"density_correction": {}, "solids": "voxel"})),
        slow((3, {"solids": "voxel", "cfl": 4.0})),
    ],
)
def test_nothing_but_the_state_is_remembered(dimension: int, tables: dict[str, Any]) -> None:
    """Equal steps of a fresh simulation from any state.

    Fields hold nothing of earlier positions of the liquid.
    """

    def cut_down(solid: dict[str, Any]) -> dict[str, Any]:
        motion = solid.get("motion")
        moved = {"motion": motion | {"velocity": motion["velocity"][:dimension]}} if motion else {}
        return solid | {"center": solid["center"][:dimension]} | moved

    solids = [cut_down(solid) for solid in tables.get("solid", [BALL])]
    drop = box([0.1] * dimension, [0.4] * dimension, velocity=[3.0, 2.0, 1.0][:dimension])
    resolution = 24 if dimension == 2 else 16
    old = create(
        scene(
            size=[1.0] * dimension,
            resolution=resolution,
            liquid=[drop],
            **(tables | {"solid": solids}),
        )
    )
    for number in range(8):
        if number == 5:  # the window jumps and shrinks
            position = old.particles.position.numpy().copy()
            position[:, 1] = 0.6 * position[:, 1] + 0.01
            old.particles.position.assign(position)
            assert old.boundary.admits(position).mean() > 0.5
        new = create(old.scene)
        new.restore(old.state())
        dt = min(old.stable_dt(), 0.02)
        assert new.step(dt) == old.step(dt)
        for name, value in new.state().items():
            np.testing.assert_array_equal(value, old.state()[name], err_msg=name)
