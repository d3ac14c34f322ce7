"""Bytes that device arrays and the process hold."""

from __future__ import annotations

import ctypes
import gc
import re
import sys
from pathlib import Path

import warp as wp

STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def array_bytes() -> int:
    """Return the bytes of all Warp arrays alive, views and shared memory counted once; a slow search."""
    spans = sorted((a.ptr, a.ptr + a.capacity) for a in gc.get_objects() if type(a) is wp.array and a.ptr and a.capacity)
    total, end = 0, 0
    for first, last in spans:
        total += max(0, last - max(first, end))
        end = max(end, last)
    return total


def resident_bytes(*, peak: bool = False) -> int:
    """Return the process's resident memory now, or the most since `forget_peak`; 0 where the system does not tell."""
    if not STATUS.exists():
        return 0
    found = re.search(rf"{'VmHWM' if peak else 'VmRSS'}:\s+(\d+) kB", STATUS.read_text(encoding="ascii"))
    return 1024 * int(found[1]) if found else 0


def forget_peak() -> None:
    """Give freed memory back and let the peak begin again, where the system can."""
    gc.collect()
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc keeps freed fields for the next ones
        if trim is not None:
            trim(0)
    if CLEAR.exists():
        CLEAR.write_text("5", encoding="ascii")
