"""Messages about kernels: one line while they compile for the first time."""

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

from default_run import slow
from warp_lcp.kernels.log_filter import KernelMessages, install_log_filter

SCRIPT = """
import numpy as np
import warp as wp
import warp_lcp as wl
import warp_lcp.grid.surface_mesh_kernels
result = wl.solve(wl.LCP(np.eye(3) * 2.0, np.array([-1.0, 1.0, -1.0]), lower=0.0), \
wl.ProjectedSOR(order="magnitude"))
wp.load_module("warp_lcp.grid.surface_mesh", "cpu")
print(result.status.name)
"""
BANNER = 'Warp 1.19.0 initialized:\n   Devices:\n     "cpu" : "x86_64"'
MODULE = "Module {} 0f1e2d3 load on device '{}' took 12.34 ms  ({})"


class MessageLog:
    """Logger that stores messages."""

    def __init__(self) -> None:
        self.messages: list[str] = []

    def say(self, message: str, *_: object, **__: object) -> None:
        self.messages.append(message)

    debug = info = warning = error = say


def messages() -> tuple[KernelMessages, MessageLog, io.StringIO]:
    said, stream = MessageLog(), io.StringIO()
    return KernelMessages(said, stream), said, stream


@pytest.mark.slow
def test_a_script_has_one_message_of_its_kernels_and_no_compiler_warning(tmp_path: Path) -> None:
    for compiles in (1, 0):
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT],
            capture_output=True,
            text=True,
            check=False,
            env=os.environ | {"WARP_CACHE_PATH": str(tmp_path)},
        )
        assert done.stdout == "CONVERGED\n", done.stderr
        said = done.stderr.splitlines()
        assert len(said) == compiles, done.stderr
        assert all(
            line.startswith("compiling kernels for cpu") and str(tmp_path) in line for line in said
        )


@pytest.mark.parametrize(
    ("made", "stream"),
    [
        slow(("wl.DenseOperator(np.eye(2), device='cpu')", "open")),
        slow(("wl.DenseOperator(np.eye(2), device='cpu')", "closed")),
        (
            "wl.DirectEnumeration; from warp_lcp.grid.staggered import StaggeredGrid; "
            "StaggeredGrid((2, 2, 1), 1.0, 2, device='cpu')",
            "open",
        ),
    ],
)
def test_a_missing_driver_is_not_mentioned(made: str, stream: str) -> None:
    script = (
        f"import os, numpy as np, warp_lcp as wl; {'os.close(2); ' * (stream == 'closed')}{made}"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout == done.stderr == ""


def test_one_line_a_device_and_only_for_what_is_compiled() -> None:
    heard, log, stream = messages()
    with wp.ScopedLogLevel(wp.LOG_INFO):
        heard.info(BANNER)
        heard.info(MODULE.format("warp_lcp.sweep", "cpu", "cached"))
        assert stream.getvalue() == ""
        for name in ("granular.stress_2d_float32_step", "fluids.pressure", "warp.utils"):
            heard.info(MODULE.format(name, "cpu", "compiled"))
        assert stream.getvalue().count("\n") == 1
        heard.info(MODULE.format("warp_lcp.sweep", "cuda:0", "compiled"))
        assert stream.getvalue().count("\n") == 2
    assert log.messages == []


@pytest.mark.parametrize(
    "message", [MODULE.format("__main__", "cpu", "compiled"), "mine took 3.00 ms", "fluids are wet"]
)
def test_messages_of_other_libraries_pass(message: str) -> None:
    heard, said, stream = messages()
    with wp.ScopedLogLevel(wp.LOG_INFO):
        heard.info(message)
    heard.warning("careful", UserWarning)
    heard.error("wrong")
    assert said.messages == [message, "careful", "wrong"]
    assert stream.getvalue() == ""


def test_at_debug_level_all_messages_pass() -> None:
    heard, said, stream = messages()
    everything = [BANNER, MODULE.format("warp_lcp.sweep", "cpu", "compiled")]
    with wp.ScopedLogLevel(wp.LOG_DEBUG):
        for message in everything:
            heard.info(message)
    assert said.messages == everything
    assert stream.getvalue() == ""


def test_a_logger_that_a_program_has_set_stays() -> None:
    mine = MessageLog()
    with wp.ScopedLogger(mine):
        install_log_filter()
        assert wp.get_logger() is mine
    with wp.ScopedLogger(mine):
        wp.set_logger(None)
        install_log_filter()
        assert isinstance(wp.get_logger(), KernelMessages)
