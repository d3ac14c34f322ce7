"""Machine of a measurement: hardware, versions, peers, memory in use."""

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
from warp_lcp.benchmarks.harness.record import MACHINE, SOURCE, BenchmarkRecord
from warp_lcp.benchmarks.harness.timing import Figure, in_turns
from warp_lcp.run.devices import versions

PEERS = ("pyamg", "scipy", "numba", "matplotlib")
STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
COPIED = 1 << 26  # float32 elements of the arrays that are copied: 256 MiB, beyond any cache


def machine(device: str, *, elements: int = COPIED, repeat: int = 5) -> BenchmarkRecord:
    """Return the record of the machine, with its measured copy bandwidth.

    Bytes read and bytes written both count.
    """
    warp_device = wp.get_device(device)
    facts = {
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "hardware": {
            "cpu": cpu_model(),
            "cores": os.cpu_count(),
            "memory": f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.0f} GiB",
            "device": f"{warp_device.alias} {warp_device.name}"
            if warp_device.is_cuda
            else warp_device.alias,
            "load": f"{os.getloadavg()[0]:.1f}",
        },
        "versions": versions(),
        SOURCE: source_digest(),
        "peers": {name: _version(name) for name in PEERS},
    }
    return BenchmarkRecord(MACHINE, copy_bandwidth(device, elements, repeat), facts)


def copy_bandwidth(device: str, elements: int, repeat: int) -> dict[str, Figure]:
    """Return GB/s of `wp.copy` and of NumPy's copy."""
    a, b = (wp.full(elements, 1.0, dtype=wp.float32, device=device) for _ in range(2))
    # Pages of zeros that were never written all map to one page, which is read from the cache.
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
    """Return a digest of the measured code, to distinguish results of its versions."""
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
    """Return the bytes of all live Warp arrays; a slow search.

    Views and shared memory count once.
    """
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
    """Return the resident memory of the process, or its peak since `forget_peak`.

    The result is 0 if the system does not report it.
    """
    if not STATUS.exists():
        return 0
    found = re.search(
        rf"{'VmHWM' if peak else 'VmRSS'}:\s+(\d+) kB", STATUS.read_text(encoding="ascii")
    )
    return 1024 * int(found[1]) if found else 0


def forget_peak() -> None:
    """Return freed memory to the system and reset the peak, where possible."""
    gc.collect()
    if sys.platform == "linux":
        # glibc keeps freed memory for later allocations
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
    if CLEAR.exists():
        CLEAR.write_text("5", encoding="ascii")
