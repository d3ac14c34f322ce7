"""Raise an exception on all ranks if one raises.

An error on one rank ends the operation on all of them with a message that names the rank, so that
no rank waits for ever.
"""

from __future__ import annotations

import functools
import math
import socket
import traceback
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Concatenate, ParamSpec, Protocol, TypeVar

from warp_lcp.distributed.interruptible_wait import finish, waiting
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.distributed.watchdog import Watchdog

# Seconds that a rank waits for the others after a failure. They may be inside MPI, which cannot be
# interrupted.
PATIENCE = 5.0
SHOWN = 3  # failures in one message
ValueT = TypeVar("ValueT")


class RankFailed(RuntimeError):
    """An unexpected error of another rank.

    The message names the rank and the error.
    """


@dataclass(frozen=True)
class RankException:
    """Error of a rank.

    Args:
        kind: of the exception.
        text: of its message.
        errno: of the system's error, if it is one.
        planned: it ends the run with its message alone.
        told: an inner block has told all ranks already.
    """

    kind: type[BaseException]
    text: str
    errno: int | None
    planned: bool
    told: bool


class Collective:
    """Collective blocks of code: an exception on one rank is raised on all ranks.

    At the end of a block the ranks exchange its outcome. If it failed on some ranks, all raise: the
    error's own class if that is among `planned`, with a message that names the rank; else
    `RankFailed`. If a rank fails while the others are inside a collective operation, it waits
    PATIENCE seconds for them and then aborts all processes.

    Args:
        ranks: the ranks.
        planned: expected errors, which are reported without a traceback.
        last_words: called with the message before the processes are aborted.

    Attributes:
        failed: the ranks on which the last block failed.
        watchdog: deadlock watchdog, or None.

    >>> alone = Collective.for_one_process()
    >>> with alone.together():
    ...     raise OSError("the disk is full")
    Traceback (most recent call last):
    OSError: the disk is full
    """

    def __init__(
        self,
        ranks: Ranks,
        planned: tuple[type[Exception], ...] = (OSError,),
        last_words: Callable[[str], object] = lambda text: None,
    ) -> None:
        """Duplicate the communicator, so that its messages are not mixed with others."""
        self.ranks = ranks
        self.last_words = last_words
        self._planned = planned
        self._own = Ranks(ranks.comm.Dup()) if ranks.size > 1 else ranks
        self.failed: list[int] = []
        self.watchdog: Watchdog | None = None
        self._depth = 0
        self._raised: BaseException | None = None  # exception that a block has raised on all ranks

    @classmethod
    def for_one_process(cls) -> Collective:
        """Return the collective of a single process; needs no MPI."""
        return cls(Ranks(SimpleNamespace(rank=0, size=1)))

    def together(self) -> AbstractContextManager[None]:
        """Return the context of a block that all ranks execute."""
        return self._block(named=True)

    def root_only(self) -> AbstractContextManager[None]:
        """Return the context of a block that the root rank executes for all."""
        return self._block(named=False)

    def exchange(self, value: ValueT) -> list[ValueT]:
        """Gather an object of every rank."""
        return self._own.collect(value)

    def share(self, value: ValueT) -> ValueT:
        """Broadcast the object of the root rank."""
        return self._own.share(value)

    def share_of_device(self, device: str) -> float:
        """Return the fraction of the work on this rank's device.

        Other ranks of the same machine may use the same device.
        """
        places = self.exchange((socket.gethostname(), device))
        return places.count(places[self.ranks.rank]) / len(places)

    @contextmanager
    def _block(self, *, named: bool) -> Iterator[None]:
        self._depth += 1
        try:
            yield
        except BaseException as error:
            self._leave(error, named=named)
            raise
        self._leave(None, named=named)

    def _leave(self, error: BaseException | None, *, named: bool) -> None:
        """End a block.

        Args:
            error: exception that ends it on this rank.
            named: name the failed rank in the message.

        Raises:
            BaseException: the exception of other ranks, or of this one with a message that names
                the rank.
        """
        failure = self._failure(error)
        found = self._gather_outcomes(error, failure)
        self._depth -= 1
        if self.ranks.size == 1:
            self.failed = [] if failure is None else [0]
            return
        failed = [(rank, other) for rank, other in enumerate(found) if other is not None]
        self.failed = [rank for rank, _ in failed]
        if not failed:
            return
        self._raised = error
        fresh = [(rank, other) for rank, other in failed if not other.told]
        if failure is not None and (failure.told or not fresh):
            return  # the exception is raised unchanged
        if error is not None and failure is not None and not failure.planned:
            error.add_note(f"on rank {self.ranks.rank} of {self.ranks.size}")
            return
        same = len(failed) == self.ranks.size and all(other == failed[0][1] for _, other in failed)
        if same or (failure is not None and not named):
            return
        self._raised = _joined(fresh or failed, named)
        raise self._raised from error

    def _failure(self, error: BaseException | None) -> RankException | None:
        if error is None:
            return None
        planned = isinstance(error, self._planned)
        kind = type(error) if planned else RankFailed
        text = str(error) if planned else f"{type(error).__name__}: {error}"
        errno = error.errno if isinstance(error, OSError) else None
        return RankException(kind, text, errno, planned, error is self._raised)

    def _gather_outcomes(
        self, error: BaseException | None, failure: RankException | None
    ) -> list[RankException | None]:
        """Gather the outcome of a block on every rank."""
        if self.ranks.size == 1:
            return [failure]
        while True:
            with waiting("the end of a block"):
                met = finish(self._own.comm.Ibarrier(), math.inf if error is None else PATIENCE)
            if error is not None and not met:
                self._end_all(error)
            found: list[tuple[int, RankException | None]] = self._own.collect(
                (self._depth, failure)
            )
            if max(depth for depth, _ in found) <= self._depth or failure is None:
                return [other for _, other in found]
            # A rank that failed between two blocks meets ranks that were still inside one: they
            # gather once more.

    def _end_all(self, error: BaseException) -> None:
        text = (
            str(error)
            if isinstance(error, self._planned)
            else "".join(traceback.format_exception(error)).rstrip()
        )
        self.end_all(f"rank {self.ranks.rank} of {self.ranks.size}: {text}\nall ranks are aborted")

    def local_exception(self, error: BaseException) -> BaseException:
        """Return the exception to raise for a block's error; the same on all ranks."""
        self._raised = error
        return error

    def end_all(self, text: str) -> None:
        """Abort all processes on all machines, with a message."""
        self.last_words(text)
        self.ranks.comm.Abort(1)


def _joined(failed: list[tuple[int, RankException]], named: bool) -> BaseException:
    """Return one exception for the failures of some ranks."""
    first = failed[0][1]
    texts = list(_lines(failed)) if named else [first.text]
    # Without __init__, whose arguments differ between exceptions.
    error = first.kind.__new__(first.kind)
    error.args = ("; ".join(texts),)
    if isinstance(error, OSError):
        error.errno = first.errno
    return error


def _lines(failed: list[tuple[int, RankException]]) -> Iterator[str]:
    """Yield a line for each different message."""
    ranks: dict[str, list[int]] = {}
    for rank, failure in failed:
        ranks.setdefault(failure.text, []).append(rank)
    for text, those in list(ranks.items())[:SHOWN]:
        yield (
            f"rank {those[0]}: {text}"
            if len(those) == 1
            else f"ranks {', '.join(map(str, those))}: {text}"
        )
    if len(ranks) > SHOWN:
        yield f"and {len(ranks) - SHOWN} other messages"


class HasCollective(Protocol):
    """An object of which the ranks have one each."""

    @property
    def collective(self) -> Collective:
        """Collective blocks of the ranks."""


HasCollectiveT = TypeVar("HasCollectiveT", bound=HasCollective)
ArgumentsT = ParamSpec("ArgumentsT")
ResultT = TypeVar("ResultT")


def on_root(
    method: Callable[Concatenate[HasCollectiveT, ArgumentsT], ResultT],
) -> Callable[Concatenate[HasCollectiveT, ArgumentsT], ResultT | None]:
    """Run a method on the root rank alone; errors are raised on all ranks.

    The object has a `collective`. The other ranks get None.
    """

    @functools.wraps(method)
    def collective(
        self: HasCollectiveT, *arguments: ArgumentsT.args, **options: ArgumentsT.kwargs
    ) -> ResultT | None:
        with self.collective.root_only():
            return method(self, *arguments, **options) if self.collective.ranks.is_root else None

    return collective
