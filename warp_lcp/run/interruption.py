"""Signal handling: stop after the current step, with a checkpoint.

Before the end of the first step a run stops at once.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Sequence
from types import FrameType, TracebackType
from typing import Any, Self

# batch systems send those of the user's, too
ENDING = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGUSR1", "SIGUSR2", "SIGXCPU")
SIGNALS = tuple(number for number in signal.Signals if number.name in ENDING)
OVER = b"\0"
GRACE = 1.0  # seconds that native code may take before a process that has nothing to lose is ended
FAILED = 1


class Interrupted(KeyboardInterrupt):
    """A signal came before the first step had ended; the text is its name."""


class Interruption:
    """Context in which signals stop a run.

    Called after each step, it returns the name of the signal, "" if none.

    Until it is called first there is nothing to lose, and much to wait for, as kernels are
    compiled: there a signal raises `Interrupted`. Python hands a signal on only once the compiler
    is back, which may take many seconds, so a thread of its own says at once that it has come, and
    ends the process, if asked to, when it is not handed on soon. What ignores a signal, as nohup
    does SIGHUP, goes on ignoring it. A second Ctrl-C does not wait for the step's end.

    Args:
        say: takes a line for the user.
        at_once: raise before the first step has ended; ranks, which wait for each other, do not.
        last: called with the signal's name before a process that compiles is ended; None: it is not
            ended.
        signals: which of them.
    """

    name: str  # of the signal that came first; "" if none

    def __init__(
        self,
        say: Callable[[str], None],
        *,
        at_once: bool = True,
        last: Callable[[str], None] | None = None,
        signals: Sequence[signal.Signals] = SIGNALS,
    ) -> None:
        self._say, self._early, self._last, self._signals = say, at_once, last, signals
        self._taken = threading.Event()
        self.name = ""
        self._previous: dict[signal.Signals, Any] = {}

    def __call__(self) -> str:
        """Return the name of the signal that came first."""
        self._early = False
        return self.name

    def __enter__(self) -> Self:
        self._read, self._write = os.pipe()
        if hasattr(os, "set_blocking"):
            os.set_blocking(self._write, False)
        self._wakeup = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        self._thread = threading.Thread(target=self._announce, name="signals", daemon=True)
        self._thread.start()
        for number in self._signals:
            # None: a handler that Python has not installed and cannot restore
            if signal.getsignal(number) not in (signal.SIG_IGN, None):
                self._previous[number] = signal.signal(number, self._take)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._wakeup)
        os.write(self._write, OVER)
        self._thread.join()
        os.close(self._read)
        os.close(self._write)

    def _take(self, given: int, frame: FrameType | None) -> None:
        number = signal.Signals(given)
        # SIGTERM may come several times, to the process and to its group
        if number == signal.SIGINT:
            signal.signal(number, self._previous[number])
        self._taken.set()
        if not self.name:
            self.name = number.name
            if self._early:
                raise Interrupted(number.name)

    def _announce(self) -> None:
        """Say which signal has come, once."""
        while (given := os.read(self._read, 1)) != OVER:
            number = signal.Signals(given[0])
            if number not in self._previous:
                continue
            again = "; press Ctrl-C again to end now" if number == signal.SIGINT else ""
            early = self._early
            self._say(
                f"{number.name}: stopping "
                f"{'before the first step has ended' if early else f'after this step{again}'}"
            )
            if early and self._last is not None and not self._taken.wait(GRACE):
                self._last(number.name)
                # nothing less ends a compiler; no step is lost, and no file that counts is
                # half-written
                os._exit(FAILED)
            while os.read(self._read, 1) != OVER:
                pass
            return
