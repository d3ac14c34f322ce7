"""Available peers with their versions, and why others are missing."""

from __future__ import annotations

import importlib.util
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from warp_lcp.benchmarks.peers import libraries, petsc
from warp_lcp.benchmarks.peers.peer import INEQUALITIES, Peer

# Cells along a side up to which matrices are factorized: fill grows with the fourth power, work
# with the sixth.
FACTORS = 32
EXTRA = "pip install 'warp-lcp[peers]'"
HINTS = {
    "pyamgcl": "pip install pyamgcl (needs a C++ compiler and Boost's headers)",
    "cupy": "pip install cupy-cuda12x, on a machine with a CUDA device",
    "siconos": "build it from source; no package of it is asked",
    **dict.fromkeys(("numba", "osqp", "piqp", "clarabel"), EXTRA),
}


@dataclass(frozen=True)
class PeerList:
    """Available peers and all versions."""

    peers: tuple[Peer, ...]  # installed peers
    # Versions of all libraries; for a missing one, how to install it.
    versions: dict[str, str]


def _linear(device: str) -> list[Peer]:
    """Return the peers of the linear solve in this process."""
    warp, classical = (
        partial(libraries.warp_cg, device=device),
        partial(libraries.pyamg, build="ruge_stuben_solver"),
    )
    # Warp's CG takes 15 ms per iteration at 24^3 on the CPU.
    most = 256 if device.startswith("cuda") else 32
    return [
        Peer("PyAMG SA-CG", "pyamg", libraries.pyamg, most=256),
        Peer("PyAMG RS-CG", "pyamg", classical, most=256),
        Peer(
            "AMGCL SA-CG",
            "pyamgcl",
            libraries.amgcl,
            most=256,
            settings="smoothed aggregation, ILU(0), one thread",
        ),
        Peer("SciPy CG", "scipy", libraries.scipy_cg, most=128, settings="no preconditioner"),
        Peer(
            "Warp CG",
            "warp.optim.linear",
            warp,
            most=most,
            settings="diagonal, BSR, one thread a row",
        ),
        Peer("CuPy CG", "cupy", libraries.cupy_cg, settings="no preconditioner"),
    ]


QUADRATIC = (
    Peer("OSQP", "osqp", libraries.osqp, INEQUALITIES, FACTORS, "defaults, no polishing"),
    Peer("PIQP", "piqp", libraries.piqp, INEQUALITIES, FACTORS, "sparse"),
    Peer("Clarabel", "clarabel", libraries.clarabel, INEQUALITIES, FACTORS, "one thread"),
)


@contextmanager
def roster(device: str) -> Iterator[PeerList]:
    """Find the peers.

    Those with an interpreter of their own run until the end of the block.
    """
    with (
        tempfile.TemporaryDirectory(prefix="peers-") as folder,
        petsc.peers(Path(folder)) as (petsc_peers, petsc_version),
    ):
        libraries = [
            "scipy",
            "pyamg",
            "pyamgcl",
            "osqp",
            "piqp",
            "clarabel",
            "numba",
            "cupy",
            "siconos",
        ]
        versions = {name: _version(name) for name in libraries} | {
            "petsc": petsc_version,
            "warp.optim.linear": version("warp-lang"),
        }
        if not device.startswith("cuda"):
            versions["cupy"] = f"not asked: {device} is no CUDA device"
        yield PeerList(
            tuple(
                p
                for p in (*_linear(device), *QUADRATIC, *petsc_peers)
                if versions[p.library][:1].isdigit()
            ),
            versions,
        )


def _version(name: str) -> str:
    if importlib.util.find_spec(name) is None:
        return f"missing: {HINTS.get(name, f'pip install {name}')}"
    if name == "cupy":  # its distributions are named after CUDA's versions
        return str(importlib.import_module(name).__version__)
    try:
        return version(name)
    except PackageNotFoundError:
        return "0 (no distribution tells)"
