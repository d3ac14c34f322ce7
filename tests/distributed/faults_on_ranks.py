"""The command line on ranks, of which one meets a fault: FAULT="rank kind place number", the number-th time that it comes to the place.

Places: `file`, an operation on a file in the folder `out`; `wait`, the start of an operation of all
ranks; `wait-end`, its end; `step`. Then the program writes the time into the file `fault`. The
scene of dots is simulated by `dots_on_ranks`, others as everywhere.
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
from warp_lcp.distributed.waiting import Waiting
from warp_lcp.run import loop

# audit events: raised before the system is asked
OPERATIONS = {"open", "os.rename", "os.remove", "os.mkdir", "os.truncate"}
SIGNALS = {
    "killed": signal.SIGKILL,
    "stopped": signal.SIGSTOP,
    "crashed": signal.SIGSEGV,
    "asked": signal.SIGTERM,
}
# to mpiexec
TO_ALL = {
    "Ctrl-C": signal.SIGINT,
    "ended": signal.SIGTERM,
    "launcher-killed": signal.SIGKILL,
    "stop": signal.SIGUSR1,
}
KINDS = (*SIGNALS, *TO_ALL, "late", "bug", "disk", "disk-full", "small-files")
PLACES = ("file", "wait", "wait-end", "step")
HEARD = threading.Event()  # a signal that this process handles


class Fault:
    """What befalls this rank, once.

    Args:
        kind: one of KINDS.
        number: of the time at which it does.
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
            HEARD.wait(5.0)  # mpiexec takes a while to hand it on
        elif self.kind == "late":
            time.sleep(1e4)
        elif self.kind == "bug":
            raise KeyError("no such key")
        elif self.kind == "small-files":
            resource.setrlimit(resource.RLIMIT_FSIZE, (2000, resource.RLIM_INFINITY))
        else:
            raise OSError(errno.ENOSPC, "No space left on device")


def listen() -> None:
    """Note when handlers of signals are called that are set from here on."""
    real = signal.signal

    def hearing(number: int, handler: Any) -> Any:
        def handled(*arguments: Any) -> None:
            HEARD.set()
            handler(*arguments)

        return real(number, handled if callable(handler) else handler)

    signal.signal = hearing  # type: ignore[assignment]


def lay_in_wait(place: str, fault: Fault) -> None:
    """Have a fault come at a place."""
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
        "wait": (Waiting, "__enter__"),
        "wait-end": (Waiting, "__exit__"),
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
        lay_in_wait(place, Fault(kind, int(number)))
    if "dots.toml" in words:
        dots_on_ranks.main(words)
    else:
        cli.app(words)


if __name__ == "__main__":
    main(sys.argv[1:])
