"""Who is asked: every peer with its version, or why it is missing."""

from __future__ import annotations

import importlib.util
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from warp_lcp.benchmarks.peers import linear, quadratic
from warp_lcp.benchmarks.peers.foreign import Home, PeerFailed, Worker
from warp_lcp.benchmarks.peers.peer import Answer, Peer, Question
from warp_lcp.benchmarks.problems import BOUNDS

PETSC = Home("petsc4py", "WARP_LCP_PETSC_PYTHON", "petsc", "apt-get install python3-petsc4py, or name an interpreter that has it")
INEQUALITIES = BOUNDS[1:]
FACTORS = 32  # cells a side up to which matrices are factorized: fill grows with the fourth power, work with the sixth
HINTS = {
    "pyamgcl": "pip install pyamgcl (needs a C++ compiler and Boost's headers)",
    "cupy": "pip install cupy-cuda12x, on a machine with a CUDA device",
    "siconos": "build it from source; no package of it is asked",
    "numba": "pip install 'warp-lcp[peers]'",
    "osqp": "pip install 'warp-lcp[peers]'",
    "piqp": "pip install 'warp-lcp[peers]'",
    "clarabel": "pip install 'warp-lcp[peers]'",
}


@dataclass(frozen=True)
class Roster:
    """Who is there.

    Args:
        peers: who can be asked.
        versions: of all libraries that were looked for; of missing ones, how to get them.
    """

    peers: tuple[Peer, ...]
    versions: dict[str, str]


@contextmanager
def roster(device: str) -> Iterator[Roster]:
    """Find the peers; those in interpreters of their own run until the end of the block."""
    cuda = device.startswith("cuda")
    with tempfile.TemporaryDirectory(prefix="peers-") as folder, _petsc(Path(folder)) as (petsc, petsc_version):
        peers = [*_linear(device), *_quadratic(), *petsc]
        libraries = ["scipy", "pyamg", "pyamgcl", "osqp", "piqp", "clarabel", "numba", "cupy", "siconos"]
        versions = {name: _version(name) for name in libraries} | {"petsc": petsc_version, "warp.optim.linear": version("warp-lang")}
        if not cuda:
            versions["cupy"] = f"not asked: {device} is no CUDA device"
        yield Roster(tuple(p for p in peers if p.library == "petsc" or _present(versions[p.library])), versions)


def _present(text: str) -> bool:
    return text[:1].isdigit()


def _version(name: str) -> str:
    if importlib.util.find_spec(name) is None:
        return f"missing: {HINTS.get(name, f'pip install {name}')}"
    if name == "cupy":  # its distributions are named after CUDA's versions
        return str(importlib.import_module(name).__version__)
    try:
        return version(name)
    except PackageNotFoundError:
        return "0 (no distribution tells)"


def _linear(device: str) -> list[Peer]:
    """Return the peers of the linear solve in this process."""
    most = 256 if device.startswith("cuda") else 32  # Warp's CG takes 15 ms an iteration at 24^3 on the CPU
    return [
        Peer("PyAMG SA-CG", "pyamg", linear.pyamg_aggregation, most=256),
        Peer("PyAMG RS-CG", "pyamg", linear.pyamg_classical, most=256),
        Peer("AMGCL SA-CG", "pyamgcl", linear.amgcl, most=256, settings="smoothed aggregation, ILU(0), one thread"),
        Peer("SciPy CG", "scipy", linear.scipy_cg, most=128, settings="no preconditioner"),
        Peer("Warp CG", "warp.optim.linear", partial(linear.warp_cg, device=device), most=most, settings="diagonal, BSR, one thread a row"),
        Peer("CuPy CG", "cupy", linear.cupy_cg, settings="no preconditioner"),
    ]


def _quadratic() -> list[Peer]:
    """Return the solvers of quadratic programs."""
    return [
        Peer("OSQP", "osqp", quadratic.osqp, INEQUALITIES, FACTORS, "defaults, no polishing"),
        Peer("PIQP", "piqp", quadratic.piqp, INEQUALITIES, FACTORS, "sparse"),
        Peer("Clarabel", "clarabel", quadratic.clarabel, INEQUALITIES, FACTORS, "one thread"),
    ]


@contextmanager
def _petsc(folder: Path) -> Iterator[tuple[list[Peer], str]]:
    """Start PETSc where it is found; yield its peers and its version."""
    python = PETSC.interpreter()
    if python is None:
        yield [], PETSC.missing()
        return
    worker = Worker(PETSC, python)
    desk = Desk(worker, folder)
    cycle = "V-cycle, Galerkin, SSOR"
    names = {
        "PETSc CG+MG": ("cg-mg", BOUNDS[:1], 256, f"geometric 2x2x2 aggregates, {cycle}"),
        "PETSc CG+GAMG": ("cg-gamg", BOUNDS[:1], 256, "-pc_type gamg"),
        "PETSc CG+BoomerAMG": ("cg-boomeramg", BOUNDS[:1], 256, "-pc_type hypre"),
        "PETSc CG+ICC": ("cg-icc", BOUNDS[:1], 128, "-pc_type icc"),
        "PETSc SNESVI+MG": ("snesvi-mg", INEQUALITIES, 128, f"vinewtonrsls, -ksp_rtol 1e-2, aggregates of the free set, {cycle}"),
        "PETSc SNESVI+ICC": ("snesvi-icc", INEQUALITIES, 128, "vinewtonrsls, -ksp_rtol 1e-2 -pc_type icc"),
        "PETSc SNESVI+BoomerAMG": ("snesvi-boomeramg", INEQUALITIES, 64, "vinewtonrsls, -ksp_rtol 1e-2 -pc_type hypre"),
    }
    peers = [Peer(name, "petsc", partial(desk.solve, m), bounds, most, text) for name, (m, bounds, most, text) in names.items()]
    try:
        yield peers, worker.version
    finally:
        worker.close()


class Desk:
    """Hands problems to a worker through files: one for each scene, written when it is first asked about.

    Args:
        worker: who is asked.
        folder: of the files.
    """

    def __init__(self, worker: Worker, folder: Path) -> None:
        self.worker, self.folder = worker, folder
        self._written = 0

    def solve(self, method: str, question: Question, tolerance: float) -> Answer:
        """Ask the worker.

        Raises:
            PeerFailed: it gave no answer.
        """
        n, answer = question.scene.n, self.folder / "x.npy"
        path = self.folder / f"{n}.npz"
        if n != self._written:
            for old in self.folder.glob("*.npz"):
                old.unlink()
            self._write(path, question)
            self._written = n
        request = {"method": method, "problem": str(path), "answer": str(answer), "tolerance": tolerance, "bounds": question.bounds}
        reply = self.worker.ask(request)
        if reply["reason"] <= 0:
            raise PeerFailed(f"{method} did not converge: reason {reply['reason']} after {reply['iterations']} iterations")
        return Answer(np.load(answer), reply["setup"], reply["solve"], reply["iterations"], reply["linear_iterations"])

    def _write(self, path: Path, question: Question) -> None:
        A = question.matrix
        fields: dict[str, Any] = {f"lower_{name}": Question(question.scene, name).lower for name in INEQUALITIES}
        fields |= {"data": A.data, "indices": A.indices, "indptr": A.indptr, "shape": np.array(question.scene.cells.shape)}
        np.savez(path, b=question.b, where=question.where, **fields)
