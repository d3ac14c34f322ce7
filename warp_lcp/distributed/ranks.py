"""Collective operations of the processes that share a problem."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, TypeVar, cast

import numpy as np
import warp as wp

from warp_lcp.distributed.interruptible_wait import waiting
from warp_lcp.distributed.launch import petsc
from warp_lcp.distributed.messages import sum_operation
from warp_lcp.kernels.thread_pool import Operation

if TYPE_CHECKING:
    from mpi4py import MPI
    from petsc4py import PETSc


ValueT = TypeVar("ValueT")
NumbersT = TypeVar("NumbersT", float, np.ndarray)


@dataclass(frozen=True)
class Ranks:
    """Ranks of an MPI communicator.

    All methods are collective: every rank must call them, in the same order, and gets the same
    result.

    Every rank sends its part to all and adds the parts in rank order, so that all ranks have the
    same bits and take the same decisions.

    Args:
        comm: of mpi4py.
    """

    comm: MPI.Comm

    @classmethod
    def world(cls) -> Ranks:
        """Return the ranks that `mpiexec` has started.

        Raises:
            ImportError: petsc4py or mpi4py cannot be imported; the message says how to install
                them.
        """
        return cls(_world().tompi4py())

    @property
    def rank(self) -> int:
        """Number of this process, from 0."""
        return int(self.comm.rank)

    @property
    def size(self) -> int:
        """Number of ranks."""
        return int(self.comm.size)

    @property
    def is_root(self) -> bool:
        """Whether this is rank 0, which writes files and prints."""
        return self.rank == 0

    def gather(self, values: float | Sequence[float] | np.ndarray) -> np.ndarray:
        """Return an array of every rank (MPI allgather).

        All arrays have the same shape; the result has shape (ranks, *values.shape).
        """
        mine = np.ascontiguousarray(values)
        if self.size == 1:
            return mine[None].copy()
        everyone = np.empty((self.size, *mine.shape), dtype=mine.dtype)
        with waiting("a gather"):
            self.comm.Allgather(mine, everyone)
        return everyone

    def collect(self, value: ValueT) -> list[ValueT]:
        """Return an object of every rank, in rank order; objects must be picklable."""
        if self.size == 1:
            return [value]
        with waiting("a gather"):
            return list(self.comm.allgather(value))

    def share(self, value: ValueT) -> ValueT:
        """Return the object of the root rank (broadcast); it must be picklable."""
        if self.size == 1:
            return value
        with waiting("a broadcast"):
            return self.comm.bcast(value)

    def sum(self, values: NumbersT) -> NumbersT:
        """Return the sum over the ranks of a number or an array."""
        return self._shaped(self.gather(values).sum(axis=0), values)

    def sum_operation(self, sums: np.ndarray) -> Operation:
        """Return an operation that replaces float64 sums by their sum over the ranks.

        It works in place and runs among the launches of the thread pool.
        """
        return sum_operation(self.comm, sums)

    def total(self, counts: np.ndarray) -> np.ndarray:
        """Return the sum over the ranks of an integer array; exact in any order."""
        everyone = np.empty_like(counts)
        with waiting("a sum"):
            self.comm.Allreduce(counts, everyone)
        return everyone

    def max(self, values: NumbersT) -> NumbersT:
        """Return the maximum over the ranks, entry by entry; NaN if any is NaN."""
        return self._shaped(self.gather(values).max(axis=0), values)

    def min(self, values: NumbersT) -> NumbersT:
        """Return the minimum over the ranks, entry by entry; NaN if any is NaN."""
        return self._shaped(self.gather(values).min(axis=0), values)

    def any(self, condition: bool) -> bool:
        """Return whether a condition holds on any rank."""
        return bool(self.gather(np.array(bool(condition), dtype=np.uint8)).any())

    def join(self, key: bytes) -> bytes:
        """Return a 16-byte key computed from the keys of all ranks."""
        mine = np.frombuffer(hashlib.blake2b(key, digest_size=16).digest(), dtype=np.uint8)
        return hashlib.blake2b(self.gather(mine).tobytes(), digest_size=16).digest()

    def agree(self, name: str, value: object) -> None:
        """Check that a picklable value is the same on all ranks.

        Raises:
            ValueError: it is not; on all ranks.
        """
        mine = np.frombuffer(
            hashlib.blake2b(pickle.dumps(value), digest_size=16).digest(), dtype=np.uint8
        )
        found = self.gather(mine)
        others = np.flatnonzero((found != found[0]).any(axis=1))
        if others.size:
            raise ValueError(
                f"{name} on rank {others[0]} differs from rank 0: start all ranks with the same "
                "command and files"
            )

    def free_ended(self) -> None:
        """Free PETSc objects that Python has released on every rank.

        PETSc frees such objects collectively.
        """
        if self.size > 1:
            petsc().garbage_cleanup(self.comm)

    def in_rows(self, count: int) -> Ranks:
        """Return the consecutive ranks of this rank's group.

        A group begins at a multiple of its number of ranks.
        """
        return _in_rows(self.comm.py2f(), count)

    @staticmethod
    def _shaped(found: np.ndarray, values: NumbersT) -> NumbersT:
        return cast(NumbersT, found if np.ndim(values) else found.item())


@cache
def _in_rows(handle: int, count: int) -> Ranks:
    """Return a communicator of some ranks.

    It is created once: MPI has room for some thousand communicators.
    """
    from mpi4py import MPI

    comm = MPI.Comm.f2py(handle)
    with waiting("making a communicator"):
        return Ranks(comm.Split(comm.rank // count, comm.rank))


@cache
def _world() -> PETSc.Comm:
    """Return PETSc's own communicator of all ranks, kept for the life of this process.

    PETSc creates it with the first object on a communicator, which is a collective operation, and
    frees it with the last one. Python frees objects at another time on each rank: a rank that has
    none left would wait for the others to create it again.
    """
    return petsc().COMM_WORLD.duplicate()


def device_of_rank(ranks: Ranks, name: str | None = None) -> str:
    """Return the Warp device of this rank; collective.

    Ranks on GPUs exchange ghost cells through the host's memory. More than one GPU has not been
    tested so far.

    Args:
        ranks: all of them.
        name: `cpu`; `cuda`: the GPUs of a machine, assigned round-robin to its ranks; `cuda:N`:
            that one on every machine; None: GPUs where there are some.

    Raises:
        ValueError: the machine of this rank has no such device; the message names the rank.
    """
    with waiting("finding the ranks of a machine"):
        of_machine = ranks.comm.Split_type(_shared())
    number = int(of_machine.rank)
    of_machine.Free()
    found = [device.alias for device in wp.get_cuda_devices()]
    try:
        return device_by_number(name, number, found)
    except ValueError as error:
        raise ValueError(f"{error} (rank {ranks.rank})") from error


def device_by_number(name: str | None, number: int, gpus: list[str]) -> str:
    """Return the device of a rank, by its number on its machine.

    Args:
        name: requested device, as `device_of_rank` takes it.
        number: of the rank among those of its machine.
        gpus: GPUs of the machine.

    Raises:
        ValueError: there is no such device.

    Example:
        >>> [device_by_number("cuda", number, ["cuda:0", "cuda:1"]) for number in range(3)]
        ['cuda:0', 'cuda:1', 'cuda:0']
    """
    if name == "cpu" or (name is None and not gpus):
        return "cpu"
    if name in (None, "cuda") and gpus:
        return gpus[number % len(gpus)]
    if name in gpus:
        return str(name)
    raise ValueError(
        f"--device {name}: there is no such device on this machine; choose from "
        f"{', '.join([*gpus, 'cpu'])}"
    )


def _shared() -> int:
    from mpi4py import MPI

    return int(MPI.COMM_TYPE_SHARED)
