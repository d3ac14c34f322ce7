"""When one rank fails, all end, with one message: a rank that is left alone would wait forever for the others."""

from __future__ import annotations

import sys
import time
import traceback
from collections.abc import Callable
from types import TracebackType
from typing import Any

from warp_lcp.distributed.ranks import Ranks

FAILED = 1
WRONG_INPUT = 2
INTERRUPTED = 130  # what shells call a program that Ctrl-C ended
PATIENCE = 2.0  # [s] that a failed rank waits for the others to fail too: ranks that refuse the same input do so at the same time
PAUSE = 0.01  # [s] between two looks


class Guard:
    """A context in which an exception that not all ranks raise ends them all, by MPI's Abort.

    If all ranks raise the same, which wrong input makes them do, rank 0 goes on with the exception and the others end silently with its
    exit code. Otherwise each rank that failed says so with its number. Ctrl-C counts as a failure. mpiexec sees when a rank is killed.

    Args:
        ranks: all of them; entering is collective.
        say: takes the message.
        wrong_input: exceptions that blame the input; they end the ranks with exit code 2 instead of 1 and are told without a traceback.

    Example:
        >>> from warp_lcp.distributed.guard import Guard
        >>> def main(ranks):
        ...     with Guard(ranks, print):
        ...         ranks.agree("the scene", "text")
    """

    def __init__(self, ranks: Ranks, say: Callable[[str], object], *, wrong_input: tuple[type[Exception], ...] = (ValueError,)) -> None:
        self.ranks, self.say, self.wrong_input = ranks, say, wrong_input
        self._line: Any = None  # a communicator of its own: ranks that did not fail may be anywhere in the other one

    def __enter__(self) -> Guard:
        """Open a line between the ranks."""
        if self.ranks.size > 1:
            self._line = self.ranks.comm.Dup()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """End all ranks if this one failed.

        Raises:
            SystemExit: on all ranks but 0, when all have failed alike.
        """
        if self._line is None:
            return
        if error is None or self.exit_code(error) == 0:
            self._line.Free()
            return
        text, code = self._text(error), self.exit_code(error)
        if not self._others_failed():
            self._abort(text, code)
        told = self._line.allgather(text)
        if any(other != told[0] for other in told):
            self._abort(text, code)
        if not self.ranks.first:
            raise SystemExit(code)

    def exit_code(self, error: BaseException) -> int:
        """Return the exit code that an exception stands for."""
        if isinstance(error, KeyboardInterrupt):
            return INTERRUPTED
        if isinstance(error, self.wrong_input):
            return WRONG_INPUT
        code = getattr(error, "exit_code", getattr(error, "code", FAILED))  # of typer.Exit, of SystemExit
        return code if isinstance(code, int) else FAILED

    def _text(self, error: BaseException) -> str:
        """Return what is said of an exception."""
        if isinstance(error, self.wrong_input):
            return str(error)
        if isinstance(error, KeyboardInterrupt):
            return "interrupted"
        return "".join(traceback.format_exception(error)).rstrip()

    def _others_failed(self) -> bool:
        """Return whether all others fail within the patience."""
        arrived = self._line.Ibarrier()
        end = time.monotonic() + PATIENCE
        while not arrived.Test():
            if time.monotonic() > end:
                return False
            time.sleep(PAUSE)
        return True

    def _abort(self, text: str, code: int) -> None:
        """Say what happened, and end all ranks."""
        self.say(f"rank {self.ranks.rank} of {self.ranks.size}: {text}\nall ranks end")
        sys.stdout.flush()
        sys.stderr.flush()
        self.ranks.comm.Abort(code)
