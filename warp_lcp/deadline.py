"""How long solves may take: the deadline of the solve under way, which everything inside it may ask about.

The outer loop (`warp_lcp.problem.solve`) sets it; a method's inner loops call `check_time`, or end
early by `time_is_up`. It reaches them by a context variable, not as an argument: Krylov methods,
principal systems and the solves of blocks know nothing of the loop they are in, and a solve within
a solve must end with the outer one.
"""

from __future__ import annotations

import math
import time
from contextvars import ContextVar, Token
from typing import Any

now = time.perf_counter  # seconds; the one clock that limits are measured by


class TimeIsUp(Exception):
    """The solve under way has no time left; the outer loop catches it."""


class Deadline:
    """When a solve must end; a context within which `check_time` and `time_is_up` ask it.

    Args:
        seconds: from now; inf: no limit of its own. It never ends later than the solve that it is
            part of.
        across: who solves together, see `warp_lcp.rows.vectors.Across`: time is up for all as soon
            as it is for one. None: nobody else.
    """

    def __init__(self, seconds: float = math.inf, across: Any = None) -> None:
        outer = _running.get()
        self.ends, self._across = now() + seconds, across
        if outer is not None and outer.ends < self.ends:
            self.ends, self._across = outer.ends, outer._across
        self._token: Token[Deadline | None] | None = None

    def left(self) -> float:
        """Return the seconds left, >= 0; inf without a limit."""
        if self.ends == math.inf:
            return math.inf
        left = max(0.0, self.ends - now())
        return left if self._across is None else -float(self._across.max(-left))

    def __enter__(self) -> Deadline:
        """Ask this one from here on."""
        self._token = _running.set(self)
        return self

    def __exit__(self, *error: object) -> None:
        """Ask the outer one again."""
        assert self._token is not None
        _running.reset(self._token)


_running: ContextVar[Deadline | None] = ContextVar("deadline", default=None)


def seconds_left() -> float:
    """Return the seconds left to the solve under way, >= 0; inf without a limit."""
    running = _running.get()
    return math.inf if running is None else running.left()


def is_collective() -> bool:
    """Return whether ranks must look at the deadline of the solve under way together, so as often as each other."""
    running = _running.get()
    return running is not None and running.ends != math.inf and running._across is not None


def time_is_up() -> bool:
    """Return whether the solve under way has no time left: for loops that have something to return when they end early."""
    return seconds_left() == 0


def check_time() -> None:
    """Raise TimeIsUp if the solve under way has no time left: what the step has done so far is dropped.

    Raises:
        TimeIsUp: it has none.
    """
    if time_is_up():
        raise TimeIsUp
