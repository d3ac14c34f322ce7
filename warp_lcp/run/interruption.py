"""Signal handling: stop after the current step, with a checkpoint.

Before the end of the first step a run stops at once.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Sequence
from types import FrameType, TracebackType
from typing import Self

Handler = Callable[[int, FrameType | None], object] | int | None  # of `signal.signal`

# Batch systems also send the user signals.
ENDING = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGUSR1", "SIGUSR2", "SIGXCPU")
SIGNALS = tuple(number for number in signal.Signals if number.name in ENDING)
OVER = b"\0"
GRACE = 1.0  # seconds for native code to return before a process without results is ended
FAILED = 1


class RunInterrupted(KeyboardInterrupt):
    """A signal arrived before the end of the first step; the text is its name."""


class Interruption:
    """Context in which signals stop a run.

    Called after each step, it returns the name of the signal, "" without one.

    Before the first call no result can be lost, and the compilation of kernels may take long: there
    a signal raises `RunInterrupted`. Python handles a signal only after the compiler has returned,
    which may take many seconds. A separate thread therefore reports the signal at once and, if
    `last` is given, ends the process when Python does not handle it soon. Ignored signals, such as
    SIGHUP under nohup, stay ignored. A second Ctrl-C does not wait for the end of the step.

    Args:
        say: gets a line for the user.
        at_once: raise before the end of the first step; not on ranks, which wait for each other.
        last: called with the signal's name before a process in a compiler is ended; None: the
            process is not ended.
        signals: names of the signals.
    """

    name: str  # name of the first signal; "" without one

    def __init__(
        self,
        say: Callable[[str], None],
        *,
        at_once: bool = True,
        last: Callable[[str], None] | None = None,
        signals: Sequence[signal.Signals] = SIGNALS,
    ) -> None:
        self._say, self._early, self._last, self._signals = say, at_once, last, signals
        self._handled = threading.Event()
        self.name = ""
        self._previous: dict[signal.Signals, Handler] = {}

    def __call__(self) -> str:
        """Return the name of the first signal."""
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
            # None is a handler that Python has not installed and cannot restore.
            if signal.getsignal(number) not in (signal.SIG_IGN, None):
                self._previous[number] = signal.signal(number, self._handle_signal)
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

    def _handle_signal(self, signal_number: int, frame: FrameType | None) -> None:
        number = signal.Signals(signal_number)
        # SIGTERM may arrive several times, for the process and for its group.
        if number == signal.SIGINT:
            signal.signal(number, self._previous[number])
        self._handled.set()
        if not self.name:
            self.name = number.name
            if self._early:
                raise RunInterrupted(number.name)

    def _announce(self) -> None:
        """Report the signal, once."""
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
            if early and self._last is not None and not self._handled.wait(GRACE):
                self._last(number.name)
                # Nothing else ends a compiler; no step is lost, and no result file is half-written.
                os._exit(FAILED)
            while os.read(self._read, 1) != OVER:
                pass
            return
