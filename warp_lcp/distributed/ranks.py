"""The processes that share a problem, and what they find out about each other."""

from __future__ import annotations

import hashlib
import pickle
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.distributed.launch import petsc
from warp_lcp.distributed.messages import adding
from warp_lcp.distributed.waiting import waiting
from warp_lcp.rows.team import Operation


@dataclass(frozen=True)
class Ranks:
    """The ranks of a communicator. All methods are collective: every rank calls them, in the same order, and gets the same answer.

    Sums are made in the order of the ranks from what each has sent to all, so that every rank has the same bits and takes the same
    decisions.

    Args:
        comm: of mpi4py.
    """

    comm: Any

    @classmethod
    def world(cls) -> Ranks:
        """Return the ranks that `mpiexec` has started.

        Raises:
            ImportError: petsc4py or mpi4py cannot be imported; the message says how to install them.
        """
        return cls(_world().tompi4py())

    @property
    def rank(self) -> int:
        """This process's number, from 0."""
        return int(self.comm.rank)

    @property
    def size(self) -> int:
        """How many ranks there are."""
        return int(self.comm.size)

    @property
    def is_root(self) -> bool:
        """Whether this is the root rank, which writes and tells for all."""
        return self.rank == 0

    def gather(self, values: Any) -> np.ndarray:
        """Return numbers of every rank, which each has equally many of, shape (ranks, *values.shape)."""
        mine = np.ascontiguousarray(values)
        if self.size == 1:
            return mine[None].copy()
        everyone = np.empty((self.size, *mine.shape), dtype=mine.dtype)
        with waiting("a gather"):
            self.comm.Allgather(mine, everyone)
        return everyone

    def collect(self, value: Any) -> list[Any]:
        """Return what each rank has given, of any type that can be pickled."""
        if self.size == 1:
            return [value]
        with waiting("a gather"):
            return list(self.comm.allgather(value))

    def share(self, value: Any) -> Any:
        """Return what the root rank has given, of any type that can be pickled."""
        if self.size == 1:
            return value
        with waiting("a broadcast"):
            return self.comm.bcast(value)

    def sum(self, values: Any) -> Any:
        """Return sums over the ranks of a number or an array."""
        return self._shaped(self.gather(values).sum(axis=0), values)

    def adding(self, sums: np.ndarray) -> Operation:
        """Return what replaces float64 sums by those over the ranks, in place, as an operation of the team."""
        return adding(self.comm, sums)

    def total(self, counts: np.ndarray) -> np.ndarray:
        """Return sums over the ranks of an array of integers, whose order does not matter."""
        everyone = np.empty_like(counts)
        with waiting("a sum"):
            self.comm.Allreduce(counts, everyone)
        return everyone

    def max(self, values: Any) -> Any:
        """Return the largest of the ranks' numbers, entry by entry; NaN where one is."""
        return self._shaped(self.gather(values).max(axis=0), values)

    def min(self, values: Any) -> Any:
        """Return the smallest of the ranks' numbers, entry by entry; NaN where one is."""
        return self._shaped(self.gather(values).min(axis=0), values)

    def any(self, condition: bool) -> bool:
        """Return whether it holds on some rank."""
        return bool(self.gather(np.uint8(bool(condition))).any())

    def join(self, key: bytes) -> bytes:
        """Return a key of 16 bytes that stands for those of all ranks."""
        mine = np.frombuffer(hashlib.blake2b(key, digest_size=16).digest(), dtype=np.uint8)
        return hashlib.blake2b(self.gather(mine).tobytes(), digest_size=16).digest()

    def agree(self, name: str, value: Any) -> None:
        """Check that a value, of a type that can be pickled, is the same on all ranks.

        Raises:
            ValueError: it is not; on all ranks.
        """
        mine = np.frombuffer(hashlib.blake2b(pickle.dumps(value), digest_size=16).digest(), dtype=np.uint8)
        found = self.gather(mine)
        others = np.flatnonzero((found != found[0]).any(axis=1))
        if others.size:
            raise ValueError(f"{name} on rank {others[0]} is not what it is on rank 0: start all ranks with the same command and files")

    def free_ended(self) -> None:
        """Free what PETSc keeps of objects that Python has ended on every rank, which it does for all ranks at once."""
        if self.size > 1:
            petsc().garbage_cleanup(self.comm)

    def in_rows(self, count: int) -> Ranks:
        """Return those of so many ranks one after another that this one is among, the first of them a multiple of the number."""
        return _in_rows(self.comm.py2f(), count)

    @staticmethod
    def _shaped(found: np.ndarray, values: Any) -> Any:
        return found if np.ndim(values) else found.item()


@cache
def _in_rows(handle: int, count: int) -> Ranks:
    """Return some ranks of a communicator; made once, as MPI has room for some thousand of them."""
    from mpi4py import MPI

    comm = MPI.Comm.f2py(handle)
    with waiting("a communicator of some ranks"):
        return Ranks(comm.Split(comm.rank // count, comm.rank))


@cache
def _world() -> Any:
    """Return PETSc's own communicator of all ranks, for the life of this process.

    PETSc would make it with the first object on a communicator, which all ranks must do together, and free it with the last one. Python
    ends objects on each rank at another time: with none left on one rank, that rank would wait for the others to make it again.
    """
    return petsc().COMM_WORLD.duplicate()


def device_of_rank(ranks: Ranks, name: str | None = None) -> str:
    """Return the device of this rank; collective.

    Ranks on GPUs exchange ghost cells through the host's memory. None has run on more than one GPU so far.

    Args:
        ranks: all of them.
        name: `cpu`; `cuda`: the GPUs of a machine in turns, one a rank; `cuda:N`: that one on every machine; None: GPUs where there
            are some.

    Raises:
        ValueError: the machine of this rank has no such device; the message names the rank.
    """
    with waiting("what finds the ranks of a machine"):
        of_machine = ranks.comm.Split_type(_shared())
    number = int(of_machine.rank)
    of_machine.Free()
    found = [device.alias for device in wp.get_cuda_devices()]
    try:
        return dealt(name, number, found)
    except ValueError as error:
        raise ValueError(f"{error} (rank {ranks.rank})") from error


def dealt(name: str | None, number: int, found: list[str]) -> str:
    """Return the device of the rank of this number on its machine.

    Args:
        name: what was asked for, as `device_of_rank` takes it.
        number: of the rank among those of its machine.
        found: GPUs of the machine.

    Raises:
        ValueError: there is no such device.

    Example:
        >>> [dealt("cuda", number, ["cuda:0", "cuda:1"]) for number in range(3)]
        ['cuda:0', 'cuda:1', 'cuda:0']
    """
    if name == "cpu" or (name is None and not found):
        return "cpu"
    if name in (None, "cuda") and found:
        return found[number % len(found)]
    if name in found:
        return str(name)
    raise ValueError(f"--device {name}: there is no such device on this machine; choose from {', '.join([*found, 'cpu'])}")


def _shared() -> int:
    from mpi4py import MPI

    return int(MPI.COMM_TYPE_SHARED)
