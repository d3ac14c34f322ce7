"""Which device a rank computes on."""

from __future__ import annotations

import warp as wp

from warp_lcp.distributed.ranks import Ranks


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
