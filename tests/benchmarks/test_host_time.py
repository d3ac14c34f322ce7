"""Host time of a step by stage: counts, and exact replays of native calls."""

import time
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from warp_lcp.benchmarks.host import (
    ALLOCATIONS,
    CALLS,
    COPIES,
    COUNTS,
    LAUNCHES,
    OPERATIONS,
    OUTSIDE,
    READS,
    StageTimer,
    StepRecorder,
    scene_records,
)
from warp_lcp.kernels.launch_graph import CommandBuffer
from warp_lcp.kernels.vectors import ADD, rows_of
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.simulator import simulators

pytestmark = pytest.mark.cpu_form("native calls are the CPU's")


@pytest.fixture
def addition():
    """Return x, all zeros, and the bound pass x += 1."""
    x, z = wp.zeros(8, dtype=wp.float32, device="cpu"), wp.ones(8, dtype=wp.float32, device="cpu")
    bound = ADD.bind(rows_of(x), z=z, x=x)
    bound.launch()
    x.zero_()
    return x, bound


def test_calls_are_counted_in_the_stage_that_makes_them(addition):
    x, bound = addition
    program = CommandBuffer(x.device)
    bound.launch(program.launch)
    bound.launch(program.launch)
    timer = StageTimer()
    with StepRecorder(timer, 0) as recorder, timer.stage(OUTSIDE):
        x.fill_(2.0)
        with timer.stage("pressure"):
            bound.launch()
            program.run()
            with timer.stage("within"):
                # The fill inside `zeros` is not counted.
                made = wp.zeros(4, dtype=wp.float32, device="cpu")
            made.numpy()
        wp.copy(made, made)
    made.numpy()
    assert recorder.counts == {
        OUTSIDE: {COPIES: 2},
        "pressure": {CALLS: 2, OPERATIONS: 3, READS: 1},
        "within": {ALLOCATIONS: 1},
    }
    assert x.numpy().tolist() == [5.0] * 8  # 2, and one for each operation


def test_launches_by_warp_are_counted_by_whatever_name(addition):
    def launched(launch=wp.launch):
        launch(bound.form.kernel, (1, 1, 1), [bound.layout, bound.fields], device="cpu")

    bound = addition[1]
    recorded = wp.launch(
        bound.form.kernel, (1, 1, 1), [bound.layout, bound.fields], device="cpu", record_cmd=True
    )
    with StepRecorder(StageTimer(), 0) as recorder:
        launched()
        recorded.launch()
    launched()
    assert recorder.counts == {OUTSIDE: {LAUNCHES: 2}}


def test_a_replayed_call_leaves_what_it_would_leave_once(addition):
    x, bound = addition
    timer = StageTimer()
    with StepRecorder(timer, 3) as recorder, timer.stage("sum"):
        for _ in range(2):
            bound.launch()
    assert x.numpy().tolist() == [2.0] * 8
    assert recorder.counts == {"sum": {CALLS: 2, OPERATIONS: 2}}
    assert recorder.native.keys() == {"sum"}
    assert recorder.native["sum"] > 0.0


def test_stages_exclude_those_within_them(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "process_time", lambda: now[0])
    timer = StageTimer()
    with timer.stage("whole"):
        now[0] += 0.25
        with timer.stage("part"):
            now[0] += 2.0
        now[0] += 0.5
        assert timer.current == "whole"
    assert timer.current == OUTSIDE
    assert timer.seconds["part"] == 2.0
    assert timer.seconds["whole"] == 0.75


def test_a_measured_step_is_the_step():
    scene = load_scene("dam-break-2d", ["domain.resolution=12"])
    plain, measured = (
        simulators()["fluids"].create(scene, device="cpu", folder=Path()) for _ in range(2)
    )
    measured.watch = timer = StageTimer()
    for _ in range(2):
        plain.step(0.01)
        with StepRecorder(timer, 1):
            measured.step(0.01)
    expected, found = plain.state(), measured.state()
    assert expected.keys() == found.keys()
    assert all(np.array_equal(expected[name], found[name]) for name in expected)


def test_records_of_a_scene():
    step, *stages = scene_records("dam-break-2d", 12, "cpu", steps=2, rounds=2)
    solve = next(record for record in stages if record.facts["stage"] == "pressure solve")
    assert solve.name == "dam-break-2d, 12 cells: pressure solve"
    assert (
        0 < solve.figures["native"].value < solve.figures["host"].value < step.figures["host"].value
    )
    assert solve.figures[OPERATIONS].value >= solve.figures[CALLS].value > 0
    for kind in COUNTS:
        assert step.figures[kind].value == pytest.approx(
            sum(record.figures[kind].value for record in stages)
        )
    for wrong in ({"steps": 0, "rounds": 1}, {"steps": 1, "rounds": 0}):
        with pytest.raises(ValueError, match="= 0: must be >= 1"):
            scene_records("dam-break-2d", 12, "cpu", **wrong)
