"""Estimates of `check` against the run."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from command_line import invoke
from default_run import slow
from warp_lcp.benchmarks.harness.machine import array_bytes, forget_peak
from warp_lcp.cli import commands as cli
from warp_lcp.files import size_limits as claims
from warp_lcp.fluids.simulator import FluidsSimulator
from warp_lcp.run import check, devices
from warp_lcp.run.check import check_memory, check_scene
from warp_lcp.run.trial import MOST, step_seconds
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.table import SceneError
from warp_lcp.simulation import StepFailed


@pytest.mark.usefixtures("only_new_objects")
@pytest.mark.parametrize(
    ("name", "every"), [("dam-break-2d", 0), ("dam-break", 1), slow(("mesh-obstacle", 1))]
)
def test_the_parts_add_up_to_what_a_simulation_takes(name: str, every: int) -> None:
    """Sum of the parts: memory of a simulation.

    Without its table the density correction allocates its part when it first acts.
    """
    scene = load_scene(name, [f"density_correction.every={every}"])
    forget_peak()
    before = array_bytes()
    simulation = FluidsSimulator().create(scene, device="cpu", folder=Path.cwd())
    simulation.step(1e-3)
    taken = array_bytes() - before
    assert sum(scene.memory_parts().values()) == pytest.approx(taken, rel=0.25)


def test_the_plan_has_a_line_for_each_part() -> None:
    _, lines = check_scene("mesh-obstacle")
    parts = {word.strip() for word, _ in lines if word.startswith("  ")}
    assert parts == {
        "grid",
        "pressure",
        "surface",
        "solids",
        "particles",
        "density correction",
        "bodies in flight",
    }
    without, _ = check_scene("mesh-obstacle", ["density_correction.every=0"])
    assert parts - set(without.memory_parts()) == {"density correction"}
    with_more, _ = check_scene(
        "dam-break-2d", ["density_correction.every=2", "particles.reseed.every=2"]
    )
    assert set(with_more.memory_parts()) == parts - {"solids"} | {"reseeding"}


def test_sources_count_later() -> None:
    scene, lines = check_scene("tap-and-drain")
    simulation = FluidsSimulator().create(scene, device="cpu", folder=Path.cwd())
    assert dict(lines)["particles"].startswith(
        f"{simulation.particles.count} at the start, at most 3,912, "
    )
    later, _ = check_scene("tap-and-drain", ["source.0.start=0.5"])
    assert dict(later.plan())["particles"].startswith("0 at the start, ")


def test_scenes_beyond_the_memory_are_refused_unless_forced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = load_scene("dam-break-2d")
    needed = scene.memory_estimate()
    monkeypatch.setattr(check, "free_memory", lambda device: needed)
    check_memory(scene, "cpu")
    monkeypatch.setattr(check, "free_memory", lambda device: needed - 1)
    check_memory(scene, "cpu", share=0.9)  # of ranks, some on another machine
    with pytest.raises(SceneError, match="most of it for pressure, density correction"):
        check_memory(scene, "cpu")
    out = tmp_path / "out"
    for arguments in (
        ["check", "dam-break-2d", "--device", "cpu"],
        ["run", "dam-break-2d", "--device", "cpu", "--out", out, "--frames", 0],
    ):
        refused = invoke(*arguments)
        assert refused.exit_code == cli.WRONG_INPUT
        assert "--force-memory" in refused.stderr
        assert not out.exists(), "a refused run leaves nothing"
        assert invoke(*arguments, "--force-memory").exit_code == 0
    assert out.is_dir()


def test_a_scene_of_unknown_memory_is_not_refused(
    dots: Any, scene_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(check, "free_memory", lambda device: 0)
    scene = load_scene(scene_file)
    check_memory(scene, "cpu")
    assert scene.memory_estimate() == 0


def test_without_free_memory_figures_no_scene_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = devices.free_memory("cpu")
    assert found is None or found > 2**20
    # Limits of the machine, and of this process.
    for source in ("MEMORY", "OWN_SIZE"):
        monkeypatch.setattr(claims, source, tmp_path / "nothing")
    assert devices.free_memory("cpu") is None
    check_memory(load_scene("dam-break", ["domain.resolution=4096"]), "cpu")


def test_the_time_of_a_step_leaves_the_first_out(
    dots: Any, scene_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]

    def move_on(simulation: Any, dt: float) -> None:
        now[0] += 0.002 if simulation.step_count else 0.5

    dots.before_step = move_on
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    seconds, steps = step_seconds(load_scene(scene_file), device="cpu")
    assert steps == MOST
    assert seconds == pytest.approx(0.002)


def test_long_steps_are_few(dots: Any, scene_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("warp_lcp.run.trial.ENOUGH", 0.0)
    assert step_seconds(load_scene(scene_file), device="cpu")[1] == 3


def test_check_calibrates_on_request_and_says_when_a_step_fails(
    dots: Any, scene_file: Path
) -> None:
    assert "seconds a step" not in invoke("check", scene_file, "--device", "cpu").stdout
    shown = invoke("check", scene_file, "--device", "cpu", "--calibrate")
    assert shown.exit_code == 0
    assert f"on cpu, the median of {MOST}" in shown.stdout

    def fail(simulation: Any, dt: float) -> None:
        raise StepFailed("no luck")

    dots.before_step = fail
    failed = invoke("check", scene_file, "--device", "cpu", "--calibrate")
    assert failed.exit_code == cli.FAILED
    assert "no luck" in failed.stderr
