"""Stages, their seconds and bytes."""

import json
import time
from typing import ClassVar

import pytest
import warp as wp

from warp_lcp.run.profile import KERNELS, Profiler
from warp_lcp.simulation import NoStopwatch


def test_stages_add_up(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    profile = Profiler("cpu")
    field, vectors = (
        wp.zeros(10, dtype=wp.float32, device="cpu"),
        wp.zeros((2, 3), dtype=wp.vec3, device="cpu"),
    )
    for _ in range(3):
        with profile.stage("a", field, None, vectors):
            now[0] += 0.002
        with profile.stage("b"):
            pass
    a, b = profile.stages["a"], profile.stages["b"]
    assert (a.calls, a.bytes, b.calls, b.bytes) == (3, 3 * (40 + 72), 3, 0)
    assert (a.seconds, a.first_seconds) == pytest.approx((0.006, 0.002))
    assert b.seconds == 0.0
    assert not a.beside


def test_a_stage_that_fails_is_counted():
    profile = Profiler("cpu")
    with pytest.raises(ValueError, match="no"), profile.stage("a"):
        raise ValueError("no")
    assert profile.stages["a"].calls == 1


def test_files_and_other_threads(tmp_path):
    profile = Profiler("cpu")
    (tmp_path / "x").write_bytes(bytes(100))
    with profile.beside("written"):
        pass
    profile.add_file_sizes("written", tmp_path / "x", tmp_path / "x")
    assert profile.stages["written"].bytes == 200
    assert profile.stages["written"].beside


def test_the_table_accounts_for_all_of_the_time(monkeypatch):
    monkeypatch.setattr("warp_lcp.run.profile.get_threads", lambda: 1)
    profile = Profiler("cpu")
    for name, seconds, moved in (("a", 1.0, 4e9), ("b", 2.0, 0)):
        with profile.stage(name):
            pass
        profile.stages[name].seconds, profile.stages[name].bytes = seconds, int(moved)
    with profile.beside("c"):
        pass
    profile.stages["c"].seconds = 3.0
    lines = [line.split() for line in profile.table(100, 4.0).splitlines()]
    assert lines[0] == ["stage", "seconds", "share", "ms", "a", "step", "MB", "a", "step", "GB/s"]
    assert lines[1] == ["a", "1.000", "25.0%", "10.000", "40.00", "4.00"]
    assert lines[2] == ["b", "2.000", "50.0%", "20.000"]
    assert lines[3][:3] == ["(c)", "3.000", "75.0%"]
    assert lines[4] == ["rest", "1.000", "25.0%", "10.000"]
    assert lines[5][:2] == ["all", "4.000"]
    assert profile.table(0, 0.0).splitlines()[1].split()[:2] == ["a", "1.000"]
    monkeypatch.setattr("warp_lcp.run.profile.get_threads", lambda: 3)
    profile.stages["b"].shared = 1.5
    lines = [line.split() for line in profile.table(100, 4.0).splitlines()]
    assert lines[0][-3:] == ["on", "3", "threads"]
    assert [line[-1] for line in lines[1:3]] == ["0%", "75%"]


def test_the_file_has_every_stage(tmp_path):
    profile = Profiler("cpu")
    with profile.stage("a"):
        pass
    profile.write(tmp_path, 7, 1.5)
    data = json.loads((tmp_path / "profile.json").read_text())
    assert (data["device"], data["steps"], data["seconds"]) == ("cpu", 7, 1.5)
    assert [stage["stage"] for stage in data["stages"]] == ["a"]
    assert data["stages"][0].keys() == {
        "stage",
        "beside",
        "calls",
        "seconds",
        "first_seconds",
        "bytes",
        "shared",
    }


def test_kernels_that_load_are_a_stage_of_their_own():
    @wp.kernel(module="unique")
    def fill(a: wp.array(dtype=wp.float32)):
        a[wp.tid()] = 3.0

    class RecordingLogger:
        messages: ClassVar[list[str]] = []

        def say(self, message, *_, **__):
            self.messages.append(message)

        debug = info = warning = error = say

    profile, field = Profiler("cpu"), wp.zeros(4, dtype=wp.float32, device="cpu")
    with (
        wp.ScopedLogger(RecordingLogger()),
        wp.ScopedLogLevel(wp.LOG_WARNING),
        profile.kernels_apart(),
    ):
        level = wp.config.log_level
        begun = time.perf_counter()
        with profile.stage("fill"):
            wp.launch(fill, 4, [field], device="cpu")
        seconds = time.perf_counter() - begun
        wp.get_logger().info("not asked for")
        wp.get_logger().error("heard")
    kernels, stage = profile.stages[KERNELS], profile.stages["fill"]
    assert level == wp.LOG_INFO
    assert kernels.calls == 1
    assert kernels.seconds > 0.0
    assert 0.0 <= stage.seconds <= seconds - 0.99 * kernels.seconds
    assert RecordingLogger.messages == ["heard"]
    assert profile.table(1, seconds).splitlines()[1].startswith(KERNELS)


def test_without_a_profile_nothing_is_measured(monkeypatch, tmp_path):
    def no_clock():
        raise AssertionError("the clock was read")

    monkeypatch.setattr(time, "perf_counter", no_clock)
    watch = NoStopwatch()
    with watch.stage("a", None), watch.beside("b"):
        watch.add_file_sizes("b", tmp_path / "not there")
    assert watch.stage("a") is watch.stage("b")


@pytest.mark.cuda
def test_a_gpu_is_waited_for():
    profile = Profiler("cuda:0")
    big = wp.zeros(1 << 28, dtype=wp.float32, device="cuda:0")
    with profile.stage("fill", big):
        for _ in range(20):
            big.fill_(1.0)
    assert profile.stages["fill"].seconds > 20 * big.size * 4 / 20e12  # no memory is that fast
