"""Interrupted and resumed runs of sand: same bytes as uninterrupted ones.

A state holds all relevant data.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from default_run import slow
from small_runs import StepCounter, run_into, written_files
from small_sands import box, create, scene
from warp_lcp.scene.scene_file import load_scene

FAST = ["output.checkpoint_every=5", "solver.max_iterations=60"]
SLIDER = {
    **box([0.55, -0.1], [0.65, 0.3]),
    "motion": {"kind": "translation", "velocity": [-0.6, 0.0]},
}
DISC = {"shape": "sphere", "center": [0.7, 0.3, 0.5], "radius": 0.15}


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        (
            "column-collapse-2d",
            [
                "domain.resolution=32",
                "time.duration=0.1",
                "particles.transfer=flip",
                "particles.reseed.every=1",
            ],
        ),
        slow(("hourglass-2d", ["domain.resolution=48", "time.duration=0.1"])),
        ("pouring-pile", ["domain.resolution=16", "time.duration=0.12", "source.0.stop=0.08"]),
        slow(("sand-on-mesh", ["domain.resolution=16", "time.duration=0.12"])),
    ],
)
def test_resumed_sand_equals_uninterrupted(name: str, overrides: list[str], tmp_path: Path) -> None:
    model = load_scene(name, [*overrides, *FAST])
    uninterrupted, parts = tmp_path / "whole", tmp_path / "parts"
    assert run_into(model, uninterrupted, observer=StepCounter()).status == "finished"
    watch = StepCounter()
    assert (
        run_into(model, parts, observer=watch, stop=lambda: watch.steps >= 13).status == "stopped"
    )
    second = run_into(model, parts, observer=StepCounter(), resume=True)
    assert (second.status, second.resumed_from_step) == ("finished", 13)
    assert written_files(uninterrupted) == written_files(parts)


@pytest.mark.default_cases(3)
@pytest.mark.parametrize(
    ("dimension", "tables"),
    [
        (2, {}),
        slow((2, {"friction_model": "box"})),
        # A simulation that is created after the solid has moved away.
        (2, {"solid": [SLIDER], "density_correction": {}}),
        (2, {"solver": {"method": "interleaved-sweeps", "max_iterations": 60}}),
        (
            2,
            {
                "particles": {"transfer": "flip", "reseed": {"every": 1}},
                "density_correction": {"every": 2},
            },
        ),
        slow((2, {"solids": "voxel", "solid": [DISC]})),
        slow(
            (
                3,
                {
                    "solid": [
                        DISC | {"motion": {"kind": "translation", "velocity": [-0.8, 0.2, 0.0]}}
                    ]
                },
            )
        ),
        (3, {"density_correction": {}}),
    ],
)
def test_nothing_but_the_state_of_sand_is_remembered(
    dimension: int, tables: dict[str, Any]
) -> None:
    """Equal steps of a fresh simulation from any state.

    Fields hold nothing of earlier positions of the sand.
    """
    tables = dict(tables)
    if "friction_model" in tables:
        tables["friction"] = 0.4
        tables["material"] = {"cohesion": 50.0}
        tables.pop("friction_model")
    tables.setdefault("solver", {"max_iterations": 60})
    if dimension == 2 and "solid" in tables:
        tables["solid"] = [
            s | {"center": s["center"][:2]} if "center" in s else s for s in tables["solid"]
        ]
    sand = [box([0.1] * dimension, [0.4] * dimension, velocity=[1.0, -1.0, 0.5][:dimension])]
    old = create(
        scene(size=[1.0] * dimension, resolution=24 if dimension == 2 else 12, sand=sand, **tables)
    )
    for number in range(12):
        if number == 8:  # the window moves and shrinks
            position = old.particles.position.numpy().copy()
            position[:, 1] = 0.6 * position[:, 1] + 0.01
            old.particles.position.assign(position)
        if number % 3 == 2:
            new = create(old.scene)
            new.restore(old.state())
            dt = min(old.stable_dt(), 0.005)
            assert new.stable_dt() == old.stable_dt()
            assert new.step(dt) == old.step(dt)
            for name, value in new.state().items():
                np.testing.assert_array_equal(value, old.state()[name], err_msg=name)
            for a, b in zip(new.frame(), old.frame(), strict=True):
                for name, field in a.fields.items():
                    np.testing.assert_array_equal(field, b.fields[name], err_msg=name)
        else:
            old.step(min(old.stable_dt(), 0.005))


def test_a_frame_after_restoring_is_that_before() -> None:
    old = create(scene(size=[1.0, 0.5], resolution=16, sand=[box([0.0, 0.0], [0.375, 0.375])]))
    for _ in range(5):
        old.step(2e-3)
    new = create(old.scene)
    new.restore(old.state())
    for a, b in zip(new.frame(), old.frame(), strict=True):
        assert a.fields.keys() == b.fields.keys()
        for name, field in a.fields.items():
            np.testing.assert_array_equal(field, b.fields[name], err_msg=name)


def test_sand_goes_on_another_grid() -> None:
    """Sand resumed on another grid.

    It has twice the cells along an axis, as many particles per cell, the same mass within the
    sampling, and solids at their current places.
    """
    tables = {"solid": [SLIDER], "solver": {"max_iterations": 60}}
    sand = [box([0.0, 0.0], [0.5, 0.25], velocity=[0.3, 0.0])]
    old = create(scene(size=[1.0, 0.5], resolution=32, sand=sand, **tables))
    for _ in range(40):
        old.step(4e-3)
    new = create(scene(size=[1.0, 0.5], resolution=64, sand=sand, **tables))
    notes = new.resample(old.state())
    assert any("32" in note or "64" in note for note in notes) or notes
    mass = new.particles.count * new.particle_mass
    assert mass == pytest.approx(old.particles.count * old.particle_mass, rel=0.05)
    solid = new.solids.base.numpy()[1, 1, 1:-1] == 2
    # Lower side of the first cell that the slider fills.
    assert 0.0 <= np.flatnonzero(solid).min() / 64 - (0.55 - 0.6 * old.time) < 1.0 / 64
    row = new.step(1e-3)
    assert row["particles"] == new.particles.count
