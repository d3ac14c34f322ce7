"""Numbers that kernels leave on a device for the host, which waits for the device whenever it reads: those of a device come together."""

from __future__ import annotations

import functools
import weakref
from typing import Any

import numpy as np
import warp as wp

BYTES = 1 << 15  # of a board: as long under way as eight
LINE = 64  # bytes that no two readings share


class Reading:
    """An array of a few numbers, written by kernels and read by the host.

    Whoever has launched what writes to `array` says so by `changed`; `numpy` then waits for the device, once for all readings of it.

    Args:
        device: where it is.
        count: numbers.
        dtype: of them.
    """

    _board: Board | None

    def __init__(self, device: wp.Device, count: int = 1, dtype: Any = wp.float64) -> None:
        self.array: wp.array[Any]
        self._board, self._change = None, 0
        self._view: np.ndarray | None = None  # of an array that the host reads as it is
        board, size = board_of(device.alias) if device.is_cuda else None, count * wp.types.type_size_in_bytes(dtype)
        place = None if board is None else board.take(size)
        if board is None or place is None:
            self.array = wp.zeros(count, dtype=dtype, device=device)
            return
        self.array = wp.array(ptr=board.memory.ptr + place, dtype=dtype, shape=count, device=device)
        self.array.zero_()
        self._board, self._slice, self._kind = board, slice(place, place + size), wp.dtype_to_numpy(dtype)
        weakref.finalize(self, board.give_back, place, size)

    def changed(self) -> None:
        """Say that launches have written to it."""
        if self._board is not None:
            self._change = self._board.note()

    def numpy(self) -> np.ndarray:
        """Return the numbers as they are after all that has been launched, not to be written to."""
        if self._board is None:
            found = self.array.numpy() if self._view is None else self._view
            if self.array.device.is_cpu:  # the memory itself; of a GPU whose board is full it is a copy
                self._view = found
            return found
        return self._board.fetched(self._change)[self._slice].view(self._kind)


class Board:
    """Memory of a device for its readings.

    Args:
        device: where it is.
    """

    def __init__(self, device: wp.Device) -> None:
        self.memory = wp.zeros(BYTES, dtype=wp.uint8, device=device)
        self._host, self._end, self._changes, self._known = np.zeros(0, dtype=np.uint8), 0, 0, 0
        self._free: dict[int, list[int]] = {}  # places by their size

    def take(self, size: int) -> int | None:
        """Return a place of so many bytes, None if there is none."""
        size = -(-size // LINE) * LINE
        if free := self._free.get(size):
            return free.pop()
        if self._end + size > BYTES:
            return None
        self._end += size
        self._known = -1  # what has been fetched is too short
        return self._end - size

    def give_back(self, place: int, size: int) -> None:
        """Take a place back."""
        self._free.setdefault(-(-size // LINE) * LINE, []).append(place)

    def note(self) -> int:
        """Count a change; return its number."""
        self._changes += 1
        return self._changes

    def fetched(self, change: int) -> np.ndarray:
        """Return all bytes as they are after a change, or later."""
        if self._known < change:
            self._known, self._host = self._changes, self.memory[: self._end].numpy()
        return self._host


@functools.cache
def board_of(device: str) -> Board:
    """Return a device's board."""
    return Board(wp.get_device(device))
