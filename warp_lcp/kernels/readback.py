"""Small results on a device that the host reads in one copy.

The host waits for the device whenever it reads, so the numbers of a device are copied together.
"""

from __future__ import annotations

import gc
import weakref

import numpy as np
import warp as wp

from warp_lcp.kernels.fields import zeros
from warp_lcp.kernels.types import DataType, DeviceArray

BYTES = 1 << 15  # of a buffer: its transfer takes as long as that of eight bytes
LINE = 64  # bytes of a cache line, which no two readings share


class DeviceScalar:
    """An array of a few numbers, written by kernels and read by the host.

    Call `changed` after every launch that writes to `array`. `numpy` then waits for the device; one
    copy serves all readings of it.

    Args:
        device: of the array.
        count: of numbers.
        dtype: of them.
    """

    _board: ReadbackBuffer | None
    _view: np.ndarray  # view of an array in host memory

    def __init__(self, device: wp.Device, count: int = 1, dtype: DataType = wp.float64) -> None:
        self.array: DeviceArray
        self._board, self._change = None, 0
        if not device.is_cuda:
            self.array = zeros(count, dtype, device)
            self._view = self.array.numpy()
            return
        size = count * wp.types.type_size_in_bytes(dtype)
        self._board, place = place_of(device, size)
        self.array = wp.array(
            ptr=self._board.memory.ptr + place, dtype=dtype, shape=count, device=device
        )
        self.array.zero_()
        self._slice, self._kind = slice(place, place + size), wp.dtype_to_numpy(dtype)
        weakref.finalize(self, self._board.give_back, place, size)

    def changed(self) -> None:
        """Mark the numbers as changed by launches."""
        if self._board is not None:
            self._change = self._board.note()

    def numpy(self) -> np.ndarray:
        """Return the numbers after all launches so far; they are read-only."""
        if self._board is None:
            return self._view
        return self._board.fetch(self._change)[self._slice].view(self._kind)


class ReadbackBuffer:
    """Device buffer of all small results, copied to the host as a whole.

    Args:
        device: of the buffer.
        size: of it, in bytes.
    """

    def __init__(self, device: wp.Device, size: int = BYTES) -> None:
        self.memory = wp.zeros(-(-size // LINE) * LINE, dtype=wp.uint8, device=device)
        self._host, self._end, self._changes, self._fetched = np.zeros(0, dtype=np.uint8), 0, 0, 0
        self._free: dict[int, list[int]] = {}  # free places by their size

    def allocate(self, size: int) -> int | None:
        """Allocate so many bytes and return their place; None if there is no room."""
        size = -(-size // LINE) * LINE
        if free := self._free.get(size):
            return free.pop()
        if self._end + size > self.memory.size:
            return None
        self._end += size
        self._fetched = -1  # the fetched copy is too short
        return self._end - size

    def give_back(self, place: int, size: int) -> None:
        """Free a place."""
        self._free.setdefault(-(-size // LINE) * LINE, []).append(place)

    def note(self) -> int:
        """Count a change; return its number."""
        self._changes += 1
        return self._changes

    def fetch(self, change: int) -> np.ndarray:
        """Return all bytes as they are after a change, or later."""
        if self._fetched < change:
            self._fetched, self._host = self._changes, self.memory[: self._end].numpy()
        return self._host


_boards: dict[str, ReadbackBuffer] = {}  # the newest buffer of each device


def place_of(device: wp.Device, size: int) -> tuple[ReadbackBuffer, int]:
    """Return a buffer of a device with so many bytes free, and their place in it."""
    board = _boards.get(device.alias) or _boards.setdefault(device.alias, ReadbackBuffer(device))
    place = board.allocate(size)
    if place is None:
        gc.collect()  # frees readings that only reference cycles hold
        place = board.allocate(size)
    if place is None:  # the old buffer lives as long as its readings
        board = _boards[device.alias] = ReadbackBuffer(device, max(size, BYTES))
        place = board.allocate(size)
        assert place is not None
    return board, place
