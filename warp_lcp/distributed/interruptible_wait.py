"""Waits for other ranks that can be observed and interrupted."""

from __future__ import annotations

import ctypes
import math
import time
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from mpi4py import MPI

# Seconds that a wait polls: between two operations ranks rarely differ by more.
AWAKE = 1e-3
SHARE = 1 / 16  # length of a sleep of a waiting rank, relative to its wait so far
LONGEST = 5e-3  # longest sleep [s]


class InterruptibleWait:
    """State of collective operations: whether this process is inside one.

    Others read it, such as a `Watchdog`.

    Attributes:
        native: entries and exits of operations in native code, and the error of the first one that
            has failed, 0 while none has.

    >>> waiting = InterruptibleWait()
    >>> with waiting("a sum"):
    ...     waiting.name, waiting.count
    ('a sum', 1)
    >>> waiting.name, waiting.count
    ('', 2)
    """

    def __init__(self) -> None:
        self._name, self._count, self._next = "", 0, ""
        self.native = (ctypes.c_uint64 * 2)()

    @property
    def name(self) -> str:
        """Name of the operation, "" outside."""
        return "an exchange among launches" if self.native[0] % 2 else self._name

    @property
    def count(self) -> int:
        """Number of entries and exits so far."""
        return self._count + int(self.native[0])

    def __call__(self, name: str) -> Self:
        """Return the context of an operation of this name."""
        self._next = name
        return self

    def __enter__(self) -> Self:
        self._name = self._next
        self._count += 1
        return self

    def __exit__(self, *error: object) -> None:
        self._name = ""
        self._count += 1


waiting = InterruptibleWait()  # MPI's world is one per process, and only its main thread uses MPI


def finish(request: MPI.Request, seconds: float = math.inf) -> bool:
    """Wait for an MPI request for some seconds; return whether it has ended.

    The wait does not use a core.
    """
    begun = time.monotonic()
    while not request.Test():
        waited = time.monotonic() - begun
        if waited > seconds:
            return False
        if waited > AWAKE:
            time.sleep(min(SHARE * waited, LONGEST))
    return True
