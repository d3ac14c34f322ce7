"""Global and constant memory of emulated kernels."""

from __future__ import annotations

import bisect
import ctypes
import re
import struct
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

PARAMETERS = 0x210  # offset of a kernel's parameters in constant memory
NEAR = 65536  # bytes beside memory that are read as 0
# Generic addresses of local and of shared memory, above those of the host; each window has 4 GiB.
LOCAL_WINDOW, SHARED_WINDOW = 1 << 48, 1 << 49
STACK = 1 << 20  # address in local memory where a thread's stack begins; it grows downward


class EmulatedMemory:
    """Copies of arrays at their addresses.

    Writes are kept apart and override the copies.
    """

    def __init__(self, arrays: Iterable[tuple[int, np.ndarray]]) -> None:
        self._spans = sorted(
            ((at, np.ascontiguousarray(a).view(np.uint8).reshape(-1)) for at, a in arrays),
            key=lambda span: span[0],
        )
        self.written: dict[int, int] = {}
        self.shared: dict[int, int] = {}

    def read(self, at: int, count: int) -> bytes:
        """Return bytes of memory.

        Bytes up to 64 KiB outside of an array are 0: guarded loads read them and drop the values.

        Raises:
            KeyError: there is no array near the address.
        """
        found = bytearray(self.stored(at, count))
        for k in range(count):
            if at + k in self.written:
                found[k] = self.written[at + k]
        return bytes(found)

    def stored(self, at: int, count: int) -> bytes:
        """Return bytes of the copies alone.

        Raises:
            KeyError: there is no array near the address.
        """
        for begin, data in self._spans:
            if begin <= at and at + count <= begin + len(data):
                return data[at - begin : at - begin + count].tobytes()
        if not any(begin - NEAR <= at < begin + len(data) + NEAR for begin, data in self._spans):
            raise KeyError(f"no memory at {at:#x}")
        return bytes(count)

    def write(self, at: int, data: bytes) -> None:
        """Write bytes."""
        self.written.update((at + k, byte) for k, byte in enumerate(data))


class ProcessMemory(EmulatedMemory):
    """Memory of this process at its addresses; writes are kept apart."""

    def __init__(self) -> None:
        super().__init__(())
        self._begins: list[int] = []
        self._ends: list[int] = []

    def _look_up(self) -> None:
        lines = Path("/proc/self/maps").read_text().splitlines()
        found = [re.match(r"([0-9a-f]+)-([0-9a-f]+) r", line) for line in lines]
        spans = sorted((int(one[1], 16), int(one[2], 16)) for one in found if one)
        self._begins, self._ends = [span[0] for span in spans], [span[1] for span in spans]

    def _holds(self, at: int, count: int) -> bool:
        place = bisect.bisect_right(self._begins, at) - 1
        return place >= 0 and at + count <= self._ends[place]

    def stored(self, at: int, count: int) -> bytes:
        """Return bytes as the process has them; 0 near what is mapped.

        Raises:
            KeyError: nothing is mapped near the address.
        """
        if not self._holds(at, count):
            self._look_up()
        if self._holds(at, count):
            return ctypes.string_at(at, count)
        if any(self._holds(at + step, count) for step in (-NEAR, NEAR)):
            return bytes(count)
        raise KeyError(f"no memory at {at:#x}")


def constants_of(parameters: bytes, block: int, blocks: int) -> bytes:
    """Return a kernel's constant memory.

    It holds the size of a block, the number of blocks, the window of local memory, the begin of the
    stack, and the parameters.
    """
    sizes = struct.pack("<6I8xQI", block, 1, 1, blocks, 1, 1, LOCAL_WINDOW, STACK)
    return sizes.ljust(PARAMETERS, b"\0") + parameters


def packed(params: Sequence[ctypes.Structure | ctypes._SimpleCData[Any]]) -> bytes:
    """Return the parameters of a kernel as its constant memory holds them."""
    data = b""
    for value in params:
        data = data.ljust(-(-len(data) // ctypes.alignment(value)) * ctypes.alignment(value), b"\0")
        data += bytes(value)
    return data
