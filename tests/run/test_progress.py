"""Remaining time, and the progress line of a step."""

import io

import pytest
from rich.console import Console
from rich.progress import Progress

from warp_lcp.run.progress import (
    WINDOW,
    ProgressBar,
    ProgressCounter,
    ProgressLines,
    describe,
    time_left,
)

ROW = {
    "step": 3,
    "time": 0.5,
    "dt": 0.01,
    "solve_iterations": 5,
    "solve_residual": 2.5e-5,
    "volume": None,
}


def test_time_left_follows_the_recent_rate():
    now = 0.0
    progress = Progress(get_time=lambda: now, speed_estimate_period=WINDOW, disable=True)
    task = progress.add_task("", total=None)
    progress.reset(task, total=10.0)

    def advance(time):
        progress.update(task, completed=time)
        return progress.tasks[0].time_remaining

    assert time_left(progress) == "-:--:-- left"
    now = 60.0  # a long first step, which compiles
    assert advance(0.1) is None
    for step in range(1, 11):
        now += 1.0
        left = advance(0.1 + 0.2 * step)
    assert left == pytest.approx((10.0 - 2.1) / 0.2, abs=1.0)
    for step in range(1, 41):  # it grows ten times slower: older steps count less
        now += 1.0
        left = advance(2.1 + 0.02 * step)
    assert left == pytest.approx((10.0 - 2.9) / 0.02, rel=0.01)
    assert time_left(progress) == "0:05:55 left"


def test_describe_leaves_out_what_is_not_there():
    assert describe(ROW) == "step 3  dt 0.01 s  5 iterations  residual 2.5e-05"
    assert describe({"step": 1, "time": 0.5, "dt": 0.01}) == "step 1  dt 0.01 s"


def test_the_residual_shown_is_the_one_that_the_tolerance_is_of():
    sand = ROW | {"solve_status": "STAGNATED", "solve_residual": 9.4e-3, "coupled_residual": 2e-3}
    assert describe(sand).endswith("residual 2.0e-03 (STAGNATED)")
    assert describe(sand | {"solve_status": "CONVERGED", "coupled_residual": 8e-4}).endswith(
        "residual 8.0e-04"
    )
    assert (
        describe(
            {"step": 1, "time": 0.5, "dt": 0.01, "solve_status": None, "coupled_residual": None}
        )
        == "step 1  dt 0.01 s"
    )


def test_lines_have_one_a_frame():
    stream = io.StringIO()
    with ProgressLines(Console(file=stream, width=200)) as lines:
        lines.start(0.0, 1.0)
        lines.note("a [note]")
        lines.frame(0, 2)
        lines.step(ROW)
        lines.step(ROW)
        lines.frame(1, 2)
    text = stream.getvalue().splitlines()
    assert text[:2] == ["a [note]", "frame 0/2"]
    assert text[2].startswith("frame 1/2  t 0.5 s  step 3")
    assert len(text) == 3


def test_bar_shows_the_step():
    stream = io.StringIO()
    with ProgressBar(Console(file=stream, width=200, force_terminal=True)) as bar:
        bar.start(0.0, 1.0)
        bar.note("a [note]")
        bar.step(ROW)
        bar.frame(1, 2)
    assert "a [note]" in stream.getvalue()
    assert "50%" in stream.getvalue()
    assert "5 iterations" in stream.getvalue()


def test_a_count_has_a_line_now_and_then():
    stream, now = io.StringIO(), 0.0
    with ProgressCounter(
        Console(file=stream, width=200), "drawing", "images", lambda: now
    ) as count:
        count(0, 12)
        for done in range(1, 13):
            now += 2.0
            count(done, 12)
    # Each 5 s later than the one before, and not the end, which has its own message.
    told_of = [3, 6, 9]
    lines = [f"drawing: {done} of 12 images  0:00:{2 * (12 - done):02d} left" for done in told_of]
    assert stream.getvalue().splitlines() == lines
    quiet = io.StringIO()
    with ProgressCounter(
        Console(file=quiet, quiet=True), "drawing", "images", lambda: now
    ) as count:
        count(0, 2)
        now += 60.0
        count(1, 2)
    assert quiet.getvalue() == ""


def test_a_count_changes_in_place_on_a_terminal():
    stream = io.StringIO()
    with ProgressCounter(
        Console(file=stream, width=200, force_terminal=True), "drawing", "images"
    ) as told:
        told(0, 4)
        told(2, 4)
    assert "drawing" in stream.getvalue()
    assert "\x1b[2K" in stream.getvalue()  # the line is erased
