"""Command line on ranks with an injected fault on one of them.

FAULT="rank kind place number": the fault occurs the number-th time at the place. Places: `file`, an
operation on a file in the folder `out`; `wait`, the start of a collective operation; `wait-end`,
its end; `step`. Then the program writes the time into the file `fault`. `dots_on_ranks` simulates
the scene of dots; other scenes have their own simulator.
"""

from __future__ import annotations

import errno
import os
import resource
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

import dots_on_ranks

from warp_lcp.cli import commands as cli
from warp_lcp.distributed import launch
from warp_lcp.distributed.interruptible_wait import InterruptibleWait
from warp_lcp.run import loop

# Audit events are raised before the system call.
OPERATIONS = {"open", "os.rename", "os.remove", "os.mkdir", "os.truncate"}
SIGNALS = {
    "killed": signal.SIGKILL,
    "stopped": signal.SIGSTOP,
    "crashed": signal.SIGSEGV,
    "asked": signal.SIGTERM,
}
# Signals to mpiexec.
TO_ALL = {
    "Ctrl-C": signal.SIGINT,
    "ended": signal.SIGTERM,
    "launcher-killed": signal.SIGKILL,
    "stop": signal.SIGUSR1,
}
KINDS = (*SIGNALS, *TO_ALL, "late", "bug", "disk", "disk-full", "small-files")
PLACES = ("file", "wait", "wait-end", "step")
HEARD = threading.Event()  # a signal that this process handles


class RankFault:
    """Fault of this rank, which occurs once.

    Args:
        kind: a name of KINDS.
        number: visit of the place at which the fault occurs.
    """

    def __init__(self, kind: str, number: int) -> None:
        self.kind, self.left, self._lock = kind, number, threading.Lock()

    def __call__(self) -> None:
        with self._lock:
            self.left -= 1
            if self.left > 0 or (self.left < 0 and self.kind != "disk-full"):
                return
        if self.left == 0:
            Path("fault").write_text(f"{time.time()}")
        if self.kind in SIGNALS:
            os.kill(os.getpid(), SIGNALS[self.kind])
        elif self.kind in TO_ALL:
            os.kill(os.getppid(), TO_ALL[self.kind])
            HEARD.wait(5.0)  # mpiexec takes a while to forward it
        elif self.kind == "late":
            time.sleep(1e4)
        elif self.kind == "bug":
            raise KeyError("no such key")
        elif self.kind == "small-files":
            resource.setrlimit(resource.RLIMIT_FSIZE, (2000, resource.RLIM_INFINITY))
        else:
            raise OSError(errno.ENOSPC, "No space left on device")


def listen() -> None:
    """Record when signal handlers are called that are set from here on."""
    real = signal.signal

    def hearing(number: int, handler: Any) -> Any:
        def handled(*arguments: Any) -> None:
            HEARD.set()
            handler(*arguments)

        return real(number, handled if callable(handler) else handler)

    signal.signal = hearing  # type: ignore[assignment]


def lay_in_wait(place: str, fault: RankFault) -> None:
    """Install a fault at a place."""
    if place == "file":
        out = str(Path("out").resolve())

        def audit(event: str, arguments: tuple[Any, ...]) -> None:
            if (
                event in OPERATIONS
                and isinstance(arguments[0], str | os.PathLike)
                and os.path.abspath(arguments[0]).startswith(out)
            ):
                fault()

        sys.addaudithook(audit)
        return
    where, name = {
        "wait": (InterruptibleWait, "__enter__"),
        "wait-end": (InterruptibleWait, "__exit__"),
        "step": (loop, "take_step"),
    }[place]
    real = getattr(where, name)

    def meanwhile(*arguments: Any, **options: Any) -> Any:
        fault()
        return real(*arguments, **options)

    setattr(where, name, meanwhile)


def main(words: list[str]) -> None:
    """Run a command of the command line."""
    rank, kind, place, number = os.environ["FAULT"].split()
    if launch.rank_here() == int(rank):
        listen()
        lay_in_wait(place, RankFault(kind, int(number)))
    if "dots.toml" in words:
        dots_on_ranks.main(words)
    else:
        cli.app(words)


if __name__ == "__main__":
    main(sys.argv[1:])
