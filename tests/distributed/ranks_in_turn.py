"""Ranks that take turns in one process, a thread each, without MPI."""

import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

WAIT = 60.0  # [s] limit of a wait


class ExchangeTable:
    """Exchange of values between threads that take turns."""

    def __init__(self, size: int) -> None:
        self.turn, self.barrier, self.laid = threading.Lock(), threading.Barrier(size), {}

    def exchange(self, rank: int, value: Any) -> dict[int, Any]:
        """Return the values of all ranks."""
        self.laid[rank] = value
        self._meet()
        found = dict(self.laid)
        self._meet()
        return found

    def _meet(self) -> None:
        if self.barrier.parties == 1:
            return
        self.turn.release()
        try:
            self.barrier.wait(timeout=WAIT)
        finally:
            self.turn.acquire()


class RankInTurn:
    """Communicator and mailbox of a rank, as far as `Ranks` needs them."""

    def __init__(self, rank: int, size: int, table: ExchangeTable | None = None) -> None:
        self.rank, self.size, self._table = rank, size, table or ExchangeTable(size)

    def Allgather(self, mine: np.ndarray, everyone: np.ndarray) -> None:  # noqa: N802  mpi4py's name
        """Gather arrays."""
        everyone[...] = np.stack(self.allgather(mine.copy()))

    def allgather(self, mine: Any) -> list[Any]:
        """Gather anything."""
        laid = self._table.exchange(self.rank, mine)
        return [laid[rank] for rank in range(self.size)]

    def swap(self, outgoing: Mapping[int, np.ndarray]) -> list[np.ndarray]:
        """Exchange messages."""
        laid = self._table.exchange(
            self.rank, {rank: sent.copy() for rank, sent in outgoing.items()}
        )
        return [laid[rank][self.rank] for rank in sorted(outgoing)]


def on_ranks(size: int, work: Callable[[RankInTurn], Any]) -> list[Any]:
    """Return the results of some work on each rank.

    Only one rank computes at a time.
    """
    table, results, errors = ExchangeTable(size), [None] * size, []

    def run(rank: int) -> None:
        with table.turn:
            try:
                results[rank] = work(RankInTurn(rank, size, table))
            except BaseException as error:
                errors.append(error)
                table.barrier.abort()

    threads = [threading.Thread(target=run, args=(rank,)) for rank in range(size)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]
    return results
