"""Deadline of the current solve: a time limit that nested loops can query.

The outer loop (`warp_lcp.problem.solve_loop`) sets the deadline. The inner loops of a method call
`check_time`, or end early where `time_is_up` returns True. The deadline is a context variable, not
an argument, because Krylov methods, principal systems and the solves of blocks have no access to
the outer loop, and a nested solve must end with the outer one.
"""

from __future__ import annotations

import math
import time
from contextvars import ContextVar, Token
from typing import Any

now = time.perf_counter  # seconds; the one clock that limits are measured by


class DeadlineReached(Exception):
    """The solve under way has no time left; the outer loop catches it."""


class Deadline:
    """Context that limits the wall time of the solves within it.

    `check_time` and `time_is_up` read the innermost deadline.

    Args:
        seconds: time limit from now; inf: no limit of its own. A deadline never ends later than
            that of the enclosing solve.
        comm: communicator of a distributed solve, see `warp_lcp.kernels.vectors.Communicator`:
            time is up on all ranks as soon as it is up on one. None if serial.
    """

    def __init__(self, seconds: float = math.inf, comm: Any = None) -> None:
        outer = _running.get()
        self.ends, self._comm = now() + seconds, comm
        if outer is not None and outer.ends < self.ends:
            self.ends, self._comm = outer.ends, outer._comm
        self._token: Token[Deadline | None] | None = None

    def left(self) -> float:
        """Return the seconds left, >= 0; inf without a limit."""
        if self.ends == math.inf:
            return math.inf
        left = max(0.0, self.ends - now())
        return left if self._comm is None else -float(self._comm.max(-left))

    def __enter__(self) -> Deadline:
        """Make this the current deadline."""
        self._token = _running.set(self)
        return self

    def __exit__(self, *error: object) -> None:
        """Restore the enclosing deadline."""
        assert self._token is not None
        _running.reset(self._token)


_running: ContextVar[Deadline | None] = ContextVar("deadline", default=None)


def seconds_left() -> float:
    """Return the seconds left to the current solve, >= 0; inf without a limit."""
    running = _running.get()
    return math.inf if running is None else running.left()


def is_collective() -> bool:
    """Return whether ranks must query the deadline together.

    Then each rank must call these functions equally often.
    """
    running = _running.get()
    return running is not None and running.ends != math.inf and running._comm is not None


def time_is_up() -> bool:
    """Return whether the current solve has no time left.

    For loops that have a result to return when they end early.
    """
    return seconds_left() == 0


def check_time() -> None:
    """Raise DeadlineReached if the current solve has no time left.

    The work of the current step is discarded.

    Raises:
        DeadlineReached: the time limit is reached.
    """
    if time_is_up():
        raise DeadlineReached
