"""Estimates of `check` against the run: steps and bytes; warnings about scenes."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from default_run import slow
from small_runs import run_into
from warp_lcp.cli.commands import app
from warp_lcp.grid.triangle_mesh import builtin_mesh
from warp_lcp.render.recording import Recording
from warp_lcp.run.check import start
from warp_lcp.run.estimate import (
    doubts,
    estimate_run,
    expected_bytes,
    expected_growth,
    expected_step,
    expected_steps,
    in_words,
)
from warp_lcp.scene.scene_file import dump_scene, load_scene

FACTOR = 1.5
POOL = {
    "scene": {"simulator": "fluids"},
    "time": {"duration": 0.2},
    "domain": {"size": [1.0, 0.5], "resolution": 24},
    "liquid": [{"shape": "box", "min": [0.0, 0.0], "max": [1.0, 0.2]}],
}


def told(**tables):
    scene = load_scene(POOL | tables)
    return list(doubts(scene, start(scene, "cpu")))


@pytest.mark.parametrize(
    "name",
    ["column-collapse-2d", slow("tap-and-drain"), slow("dam-break-2d"), slow("splash-in-circle")],
)
def test_steps_and_bytes_are_those_of_the_run(name: str, tmp_path: Path) -> None:
    scene = load_scene(name, ["domain.resolution=32"])
    simulation = start(scene, "cpu")
    steps, size = (
        expected_steps(scene, simulation),
        expected_bytes(scene, simulation, expected_steps(scene, simulation)),
    )
    record = run_into(scene, tmp_path / "run")
    taken = sum(file.stat().st_size for file in (tmp_path / "run").rglob("*") if file.is_file())
    assert 1 / FACTOR < steps / record.steps < FACTOR
    assert 1 / FACTOR < size / taken < FACTOR


def test_whitewater_counts_in_bytes_and_words(tmp_path: Path) -> None:
    """Its mean number is that of the run within a factor of two; `max_particles` bounds it."""
    keys = ["domain.resolution=48", "time.duration=1.5", "whitewater.lifetime=1.0"]
    scene = load_scene("dam-break-2d", keys)
    simulation = start(scene, "cpu")
    size = expected_bytes(scene, simulation, expected_steps(scene, simulation))
    bare = load_scene("dam-break-2d", keys[:2])
    assert size > 1.05 * expected_bytes(bare, start(bare, "cpu"), 0)
    assert "particles of whitewater" in dict(estimate_run(scene, simulation))["disk"]
    few = load_scene("dam-break-2d", [*keys, "whitewater.max_particles=10"])
    assert few.whitewater_estimate == 10
    folder = tmp_path / "run"
    run_into(scene, folder)
    files = list((folder / "frames").glob("whitewater_*.vtu"))
    mean = sum(len(Recording(folder).whitewater(n).points) for n in range(len(files))) / len(files)
    assert 0.5 < scene.whitewater_estimate / mean < 2.0
    taken = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    assert 1 / FACTOR < size / taken < FACTOR


def test_twice_the_cells_take_more_steps_and_more_frames_take_more_bytes() -> None:
    coarse, fine, often = (
        load_scene("dam-break-2d", [o])
        for o in ("domain.resolution=64", "domain.resolution=256", "time.frames_per_second=300")
    )
    steps = [expected_steps(scene, start(scene, "cpu")) for scene in (coarse, fine, often)]
    assert steps[1] > 2 * steps[0]
    assert steps[2] >= often.time.frame_count
    size = [
        expected_bytes(scene, start(scene, "cpu"), 0)
        for scene in (load_scene("dam-break-2d"), often)
    ]
    assert size[1] > 4 * size[0]


def test_a_measured_step_makes_the_whole_run() -> None:
    scene = load_scene(POOL)
    lines = dict(estimate_run(scene, start(scene, "cpu"), seconds=2.0))
    assert "as measured, 2e+03 ms a step" in lines["whole run"]
    assert set(lines) == {"steps", "whole run", "disk"}


def test_surface_tension_shortens_the_steps() -> None:
    drop = load_scene(POOL | {"surface_tension": {"coefficient": 1e6}})
    assert expected_steps(drop, start(drop, "cpu")) > 3 * expected_steps(
        load_scene(POOL), start(load_scene(POOL), "cpu")
    )


def test_source_inflow_counts_half_and_less_if_it_leaves() -> None:
    stream = {"shape": "box", "min": [0.1, 0.3], "max": [0.3, 0.4], "velocity": [0.0, -2.0]}
    full, leaks = (
        load_scene(POOL | {"source": [stream], "domain": POOL["domain"] | tables})
        for tables in ({}, {"open": ["right"]})
    )
    most, first = full.particle_estimate(), full.particle_estimate(later=False)
    assert expected_growth(full) == pytest.approx(0.5 * (most + first) / first)
    assert 1.0 < expected_growth(leaks) < expected_growth(full)
    alone = load_scene(POOL)
    at_start = start(full, "cpu"), start(alone, "cpu")
    assert expected_step(full, at_start[0]) > expected_step(alone, at_start[1])
    # Frames have the mean number of particles; they take most of the bytes.
    size, least = (
        expected_bytes(scene, simulation, 0)
        for scene, simulation in zip((full, alone), at_start, strict=True)
    )
    assert size / least == pytest.approx(expected_growth(full), rel=0.06)


@pytest.mark.parametrize(
    ("size", "words"),
    [
        (12_345, "0.0123 MB"),
        (1.5e6, "1.5 MB"),
        (2e9, "2 GB"),
        (2.38e12, "2.38 TB"),
        (5e15, "5e+03 TB"),
    ],
)
def test_bytes_are_shown_in_the_largest_unit_of_at_least_one(size: float, words: str) -> None:
    assert in_words(size) == words


def test_a_usual_scene_has_no_warnings() -> None:
    assert told() == []
    for name in ("dam-break-2d", "splash-in-circle", "hourglass-2d", "floating-bodies-2d"):
        scene = load_scene(name)
        assert list(doubts(scene, start(scene, "cpu"))) == []


def test_suspicious_settings_are_reported() -> None:
    assert told(time={"duration": 500.0}) == [
        "15,000 frames: time.duration 500 s at time.frames_per_second 30; is this intended?"
    ]
    half = told(solid=[{"shape": "box", "min": [0.0, 0.0], "max": [0.625, 0.5]}])
    assert half == ["liquid[0] (box): 62 % of it lies inside solids and is left out"]
    tiny = {"shape": "sphere", "center": [0.5, 0.1], "radius": 0.045, "invert": True}
    full = told(solid=[tiny])
    assert full[0].startswith("solids fill 9")
    assert "invert = true" in full[0]


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda v, t: (v, [*t[:9, ::-1], *t[9:]]), "turned 9 of 9216 triangles that disagreed"),
        slow((lambda v, t: (v, [*t, *t[:20]]), "dropped 20 repeated triangles")),
        slow(
            (
                lambda v, t: ([*v, *(0.9 * v + [0.3, 0.0, 0.0])], [*t, *(t + len(v))]),
                "triangles cross others",
            )
        ),
        slow((lambda v, t: (v, t[:, ::-1]), "the mesh was inside out; turned")),
    ],
)
def test_mesh_defects_are_reported_with_their_repair(spoil, words, tmp_path: Path) -> None:
    """Report of a defective mesh, with its repair.

    Flipped and repeated triangles are repaired by the run itself; self-intersecting surfaces have a
    rule.
    """
    torus = builtin_mesh("torus")
    vertices, triangles = spoil(torus.vertices, torus.triangles)
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in (map(float, p) for p in vertices)]
    lines += ["f " + " ".join(str(int(n) + 1) for n in triangle) for triangle in triangles]
    (tmp_path / "torus.obj").write_text("\n".join(lines) + "\n")
    mesh = {
        "shape": "mesh",
        "file": str(tmp_path / "torus.obj"),
        "scale": 0.4,
        "translate": [0.6, 0.3, 0.5],
    }
    liquid = {"shape": "box", "min": [0.0, 0.0, 0.0], "max": [0.2, 0.6, 1.0]}
    scene = load_scene(
        POOL
        | {
            "domain": {"size": [1.0, 1.0, 1.0], "resolution": 16},
            "liquid": [liquid],
            "solid": [mesh],
        }
    )
    (tmp_path / "scene.toml").write_text(dump_scene(scene))
    outcome = CliRunner().invoke(app, ["check", str(tmp_path / "scene.toml"), "--device", "cpu"])
    assert outcome.exit_code == 0, outcome.output
    assert any(words in line for line in outcome.output.splitlines() if line.startswith("note"))
    assert "whole run" in outcome.output
