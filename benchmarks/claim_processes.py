"""Checks in processes of their own, several at the same time, until a time limit.

A process that crashes, or leaves a device unusable, ends no other check.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

PAUSE = 0.05  # between two looks at the processes [s]


@dataclass(frozen=True)
class ClaimProcess:
    """A process to run.

    Attributes:
        name: of the check.
        command: of the process.
        alone: whether no other process may run at the same time, because it measures times.
    """

    name: str
    command: Sequence[str]
    alone: bool = False


def run_all(
    tasks: Sequence[ClaimProcess], folder: Path, workers: int, seconds: float
) -> Iterator[tuple[str, int | None]]:
    """Run processes in their order; yield the name of each and its exit status as it ends.

    The status is None if a process was stopped at the limit, or did not begin before it.

    Args:
        tasks: processes.
        folder: working directory.
        workers: number of processes at the same time.
        seconds: time limit of all together [s].
    """
    waiting, running = list(tasks), dict[str, subprocess.Popen[bytes]]()
    end, alone = time.monotonic() + seconds, False
    try:
        while waiting or running:
            while waiting and len(running) < workers and not alone:
                if running and waiting[0].alone:
                    break
                task = waiting.pop(0)
                alone = task.alone
                running[task.name] = subprocess.Popen(
                    task.command, cwd=folder, start_new_session=True
                )
            if time.monotonic() > end:
                break
            time.sleep(PAUSE)
            for name, process in list(running.items()):
                if process.poll() is not None:
                    del running[name]
                    alone = False
                    yield name, process.returncode
    finally:
        for process in running.values():
            stop(process)
    for name in [*running, *(task.name for task in waiting)]:
        yield name, None


def stop(process: subprocess.Popen[bytes]) -> None:
    """End a process and the processes that it has started."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
