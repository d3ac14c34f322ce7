"""Where and when something was measured: hardware, versions, peers; and the bytes that arrays and the process hold."""

from __future__ import annotations

import ctypes
import datetime
import gc
import hashlib
import os
import platform
import re
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import warp as wp

import warp_lcp
from warp_lcp import fluids, granular
from warp_lcp.benchmarks.harness.record import MACHINE, SOURCE, Record
from warp_lcp.benchmarks.harness.timing import Figure, in_turns
from warp_lcp.run.devices import versions

PEERS = ("pyamg", "scipy", "numba", "matplotlib")
STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
COPIED = 1 << 26  # float32 elements of the arrays that are copied: 256 MiB, beyond any cache


def machine(device: str, *, elements: int = COPIED, repeat: int = 5) -> Record:
    """Return the record of the machine, with its measured copy bandwidth (bytes read and bytes written)."""
    chosen = wp.get_device(device)
    facts = {
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "hardware": {
            "cpu": cpu_model(),
            "cores": os.cpu_count(),
            "memory": f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.0f} GiB",
            "device": f"{chosen.alias} {chosen.name}" if chosen.is_cuda else chosen.alias,
            "load": f"{os.getloadavg()[0]:.1f}",
        },
        "versions": versions(),
        SOURCE: source_digest(),
        "peers": {name: _version(name) for name in PEERS},
    }
    return Record(MACHINE, copy_bandwidth(device, elements, repeat), facts)


def copy_bandwidth(device: str, elements: int, repeat: int) -> dict[str, Figure]:
    """Return GB/s of `wp.copy` and of NumPy's copy."""
    a, b = (wp.full(elements, 1.0, dtype=wp.float32, device=device) for _ in range(2))
    # zeros nobody wrote are one page, read from the cache
    x, y = (np.ones(elements, np.float32) for _ in range(2))

    def warp_copy() -> None:
        wp.copy(b, a)
        wp.synchronize_device(device)

    times = in_turns({"copy": warp_copy, "numpy_copy": lambda: np.copyto(y, x)}, repeat)
    return {
        name: Figure.of([8e-9 * elements / t for t in taken], "GB/s")
        for name, taken in times.items()
    }


def source_digest() -> str:
    """Return a digest of the measured code, so that results of different states are told apart."""
    digest = hashlib.sha256()
    for package in (warp_lcp, fluids, granular):
        root = Path(package.__path__[0])
        for path in sorted([*root.rglob("*.py"), *root.rglob("*.h")]):
            digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def cpu_model() -> str:
    """Return the processor's name."""
    path = Path("/proc/cpuinfo")
    names = (
        re.findall(r"model name\s*:\s*(.+)", path.read_text(encoding="utf-8"))
        if path.exists()
        else []
    )
    return names[0] if names else platform.processor() or platform.machine()


def present(name: str) -> bool:
    """Return whether a peer is installed."""
    return _version(name) != "missing"


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "missing"


def array_bytes() -> int:
    """Return the bytes of all Warp arrays alive, views and shared memory counted once; a slow search."""
    spans = sorted(
        (a.ptr, a.ptr + a.capacity)
        for a in gc.get_objects()
        if type(a) is wp.array and a.ptr and a.capacity
    )
    total, end = 0, 0
    for first, last in spans:
        total += max(0, last - max(first, end))
        end = max(end, last)
    return total


def resident_bytes(*, peak: bool = False) -> int:
    """Return the process's resident memory now, or the most since `forget_peak`; 0 where the system does not tell."""
    if not STATUS.exists():
        return 0
    found = re.search(
        rf"{'VmHWM' if peak else 'VmRSS'}:\s+(\d+) kB", STATUS.read_text(encoding="ascii")
    )
    return 1024 * int(found[1]) if found else 0


def forget_peak() -> None:
    """Give freed memory back and let the peak begin again, where the system can."""
    gc.collect()
    if sys.platform == "linux":
        # glibc keeps freed fields for the next ones
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
    if CLEAR.exists():
        CLEAR.write_text("5", encoding="ascii")
