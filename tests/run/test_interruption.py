"""Signals that end a run: a checkpoint, a true status and a message.

Before the first step the run ends at once.
"""

import json
import os
import signal
import threading
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from small_runs import read_record, run_into
from warp_lcp.cli import commands as cli
from warp_lcp.run import interruption
from warp_lcp.run.folder import mark_ended
from warp_lcp.run.interruption import SIGNALS, Interruption

EACH = pytest.mark.parametrize("number", SIGNALS, ids=lambda number: number.name)


@pytest.fixture(autouse=True)
def nothing_is_ignored():
    """Restore the default signals, as in a terminal.

    nohup ignores SIGHUP; shells ignore SIGINT and SIGQUIT for background processes.
    """
    fresh = {
        number: signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
        for number in SIGNALS
    }
    before = {number: signal.signal(number, handler) for number, handler in fresh.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def run(scene_file, tmp_path):
    def call(*more: object) -> Result:
        arguments = [
            "run",
            scene_file,
            "--out",
            tmp_path / "out",
            "--device",
            "cpu",
            "--set",
            "time.duration=0.2",
            *more,
        ]
        return CliRunner().invoke(cli.app, [str(argument) for argument in arguments])

    return call


def at(step: int, *numbers: signal.Signals) -> Any:
    def before_step(simulation: Any, dt: float) -> None:
        if simulation.step_count == step:
            for number in numbers:
                signal.raise_signal(number)

    return before_step


@pytest.mark.default_cases(4)
@EACH
def test_after_a_step(dots, run, tmp_path, number):
    handlers = [signal.getsignal(each) for each in SIGNALS]
    dots.before_step = at(5, number)
    result = run()
    assert result.exit_code == 1
    assert result.stderr.count(f"{number.name}: stopping after this step") == 1
    assert f"stopped: interrupted by {number.name}\n" in result.stderr
    found = read_record(tmp_path / "out")
    assert (found["status"], found["reason"], found["steps"]) == (
        "stopped",
        f"interrupted by {number.name}",
        6,
    )
    assert (tmp_path / "out" / "checkpoints" / "step_000006.npz").is_file()
    assert [signal.getsignal(each) for each in SIGNALS] == handlers
    dots.before_step = at(-1)
    assert run("--resume").exit_code == 0
    assert read_record(tmp_path / "out")["resumed_from_step"] == 6


@pytest.mark.default_cases(4)
@EACH
@pytest.mark.parametrize("frames", [1, 10])
def test_before_the_first_step_has_ended(dots, run, tmp_path, number, frames):
    dots.before_step = at(0, number)
    result = run("--frames", frames)
    assert result.exit_code == 1
    assert f"{number.name}: stopping before the first step has ended" in result.stderr
    found = read_record(tmp_path / "out")
    assert (found["status"], found["steps"]) == ("stopped", 0)
    assert found["reason"] == f"interrupted by {number.name} during the first step"
    dots.before_step = at(-1)
    assert run("--resume", "--frames", frames).exit_code == 0


def test_before_the_first_step_of_a_part(dots, run, tmp_path):
    assert run("--frames", 2).exit_code == 0
    begun = read_record(tmp_path / "out")["steps"]
    dots.before_step = at(begun, signal.SIGTERM)
    assert run("--resume").exit_code == 1
    assert (read_record(tmp_path / "out")["status"], read_record(tmp_path / "out")["steps"]) == (
        "stopped",
        begun,
    )


def test_before_the_run_has_begun(dots, run, tmp_path, monkeypatch):
    create = dots.create
    monkeypatch.setattr(
        dots,
        "create",
        lambda *more, **options: (signal.raise_signal(signal.SIGTERM), create(*more, **options))[1],
    )
    result = run()
    assert result.exit_code == 1
    assert "stopped: interrupted by SIGTERM before the run began" in result.stderr
    assert not (tmp_path / "out" / "run.json").exists()


def test_several_signals_are_one(dots, run, tmp_path):
    dots.before_step = at(5, signal.SIGTERM, signal.SIGINT, signal.SIGTERM)
    result = run()
    assert result.stderr.count("stopping after this step") == 1
    assert read_record(tmp_path / "out")["reason"] == "interrupted by SIGTERM"


def test_a_second_ctrl_c_does_not_wait(dots, run, tmp_path):
    dots.before_step = at(5, signal.SIGINT, signal.SIGINT)
    assert run().exit_code == 1
    assert read_record(tmp_path / "out")["status"] == "failed"
    assert read_record(tmp_path / "out")["steps"] == 5


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="Windows")
def test_ignored_signals_stay_ignored(dots, run, tmp_path):
    """Ignored signals stay ignored, as under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        dots.before_step = at(5, signal.SIGHUP)
        assert run().exit_code == 0
    finally:
        signal.signal(signal.SIGHUP, before)
    assert read_record(tmp_path / "out")["status"] == "finished"


def test_a_compiler_is_not_waited_for(monkeypatch):
    """Signals during a compilation.

    Python runs a signal handler only after native code has returned.
    """

    class CompilingInterruption(Interruption):
        def _handle_signal(self, signal_number: int, frame: Any) -> None:
            pass

    messages, ended = [], threading.Event()
    monkeypatch.setattr(interruption, "GRACE", 0.01)
    monkeypatch.setattr(os, "_exit", lambda code: (messages.append(code), ended.set()))
    with CompilingInterruption(messages.append, last=messages.append):
        signal.raise_signal(signal.SIGINT)
        ended.wait()
    assert messages == ["SIGINT: stopping before the first step has ended", "SIGINT", 1]


def test_the_record_of_a_run_that_is_ended(run, tmp_path):
    assert run("--frames", 0).exit_code == 0
    mark_ended(tmp_path / "out", "stopped", "interrupted by SIGINT during the first step")
    assert read_record(tmp_path / "out")["status"] == "finished"
    (tmp_path / "out" / "run.json").write_text(
        json.dumps({**read_record(tmp_path / "out"), "status": "running"})
    )
    mark_ended(tmp_path / "out", "stopped", "interrupted by SIGINT during the first step")
    found = read_record(tmp_path / "out")
    assert (found["status"], found["reason"]) == (
        "stopped",
        "interrupted by SIGINT during the first step",
    )
    mark_ended(tmp_path, "stopped", "interrupted by SIGINT")  # of a run that has not begun


def test_ranks_wait_for_each_other():
    with Interruption(lambda text: None, at_once=False) as stop:
        signal.raise_signal(signal.SIGTERM)
        assert stop() == "SIGTERM"


def test_callers_of_the_library_need_not_name_a_signal(scene_file, tmp_path):
    from test_run import RemarkObserver, load_scene

    assert (
        run_into(
            load_scene(scene_file), tmp_path / "out", observer=RemarkObserver(), stop=lambda: True
        ).reason
        == "interrupted"
    )
