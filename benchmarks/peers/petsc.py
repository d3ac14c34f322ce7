"""PETSc as a peer: its interpreter, and our side of the exchange."""

from __future__ import annotations

import glob
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np

from warp_lcp.benchmarks.peers.peer import INEQUALITIES, Peer, PeerAnswer, PeerFailed, PeerProblem
from warp_lcp.benchmarks.problems import BOUNDS
from warp_lcp.files import Tables, TableView

VARIABLE = "WARP_LCP_PETSC_PYTHON"  # environment variable that names the interpreter
PROBE_SECONDS = 120.0
# Debian keeps here the builds from which petsc4py chooses by PETSC_DIR.
DEBIAN_PETSC = "/usr/lib/petscdir/petsc*/*-real"
CYCLE = "V-cycle, Galerkin, SSOR"
ICC, HYPRE = {"pc_type": "icc"}, {"pc_type": "hypre", "pc_hypre_type": "boomeramg"}
# Options, problems, and cells along a side beyond which the method is not measured.
METHODS: dict[str, tuple[dict[str, str], tuple[str, ...], int, str]] = {
    "PETSc CG+MG": ({}, BOUNDS[:1], 256, f"geometric 2x2x2 aggregates, {CYCLE}"),
    "PETSc CG+GAMG": ({"pc_type": "gamg"}, BOUNDS[:1], 256, "-pc_type gamg"),
    "PETSc CG+BoomerAMG": (HYPRE, BOUNDS[:1], 256, "-pc_type hypre"),
    "PETSc CG+ICC": (ICC, BOUNDS[:1], 128, "-pc_type icc"),
    "PETSc SNESVI+MG": (
        {},
        INEQUALITIES,
        128,
        f"vinewtonrsls, -ksp_rtol 1e-2, aggregates of the free set, {CYCLE}",
    ),
    "PETSc SNESVI+ICC": (ICC, INEQUALITIES, 128, "vinewtonrsls, -ksp_rtol 1e-2 -pc_type icc"),
    "PETSc SNESVI+BoomerAMG": (
        HYPRE,
        INEQUALITIES,
        64,
        "vinewtonrsls, -ksp_rtol 1e-2 -pc_type hypre",
    ),
}


def interpreter(module: str = "petsc4py", variable: str = VARIABLE) -> str | None:
    """Return the first interpreter that can import a module; None if none can.

    It tries the one that the variable names, this one, and that of the system.
    """
    named = os.environ.get(variable)
    for python in [named] if named else [sys.executable, "/usr/bin/python3"]:
        command = [python, "-c", f"import {module}"]
        try:
            done = subprocess.run(
                command, env=environment(), capture_output=True, check=False, timeout=PROBE_SECONDS
            )
        except (OSError, subprocess.TimeoutExpired):
            continue
        if done.returncode == 0:
            return python
    return None


def missing() -> str:
    """Return the message for a missing PETSc."""
    named = os.environ.get(VARIABLE)
    where = (
        f"{named}, which {VARIABLE} names, does not import petsc4py"
        if named
        else "no interpreter imports petsc4py"
    )
    return f"missing: {where}; apt-get install python3-petsc4py, or name an interpreter that has it"


def environment() -> dict[str, str]:
    """Return the environment of PETSc's interpreter.

    It sets one thread, and Debian's PETSc if PETSC_DIR names none.
    """
    found = sorted(glob.glob(DEBIAN_PETSC))
    return {
        **({"PETSC_DIR": found[-1]} if found else {}),
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }


@contextmanager
def peers(folder: Path) -> Iterator[tuple[list[Peer], str]]:
    """Start PETSc if it is installed; yield its peers and its version.

    Args:
        folder: folder for the exchanged files.
    """
    python = interpreter()
    if python is None:
        yield [], missing()
        return
    worker = PeerWorker("petsc4py", [python, str(Path(__file__).with_name("petsc_worker.py"))])
    ask = partial(asked, worker=worker, folder=folder)
    try:
        found = METHODS.items()
        yield (
            [
                Peer(name, "petsc", partial(ask, options=o), bounds, most, text)
                for name, (o, bounds, most, text) in found
            ],
            worker.version,
        )
    finally:
        worker.close()


class PeerWorker:
    """Running process of a peer.

    Args:
        name: name of the peer.
        command: interpreter and script of the peer, see `petsc_worker`.

    Attributes:
        version: version of the peer.

    Raises:
        PeerFailed: the peer does not start.
    """

    def __init__(self, name: str, command: Sequence[str]) -> None:
        self.name = name
        pipes: Tables = {
            "stdin": subprocess.PIPE,
            "stdout": subprocess.PIPE,
            "text": True,
            "encoding": "utf-8",
        }
        self.process = subprocess.Popen(command, env=environment(), **pipes)
        self.version = str(self._read()["version"])

    def ask(self, request: TableView) -> Tables:
        """Return the answer to a request.

        Raises:
            PeerFailed: the peer reports a failure, or has ended.
        """
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(json.dumps(request) + "\n")
            self.process.stdin.flush()
        except BrokenPipeError:
            raise PeerFailed(
                f"{self.name} has ended with exit code {self.process.wait()}"
            ) from None
        reply = self._read()
        if "error" in reply:
            raise PeerFailed(f"{self.name}: {reply['error']}")
        return reply

    def close(self) -> None:
        """End the process."""
        self.process.communicate()

    def _read(self) -> Tables:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise PeerFailed(f"{self.name} has ended with exit code {self.process.wait()}")
        reply: Tables = json.loads(line)
        return reply


def asked(
    question: PeerProblem,
    tolerance: float,
    *,
    worker: PeerWorker,
    folder: Path,
    options: Mapping[str, str],
) -> PeerAnswer:
    """Solve a question by a worker, through files.

    The problem's file of a scene is written at its first question.

    Raises:
        PeerFailed: the peer gives no answer.
    """
    path, answer, A = folder / f"{question.scene.n}.npz", folder / "x.npy", question.matrix
    if not path.exists():
        for old in folder.glob("*.npz"):
            old.unlink()
        fields: Tables = {
            f"lower_{name}": PeerProblem(question.scene, name).lower for name in INEQUALITIES
        }
        fields |= {
            "data": A.data,
            "indices": A.indices,
            "indptr": A.indptr,
            "shape": np.array(question.scene.cells.shape),
        }
        np.savez(path, b=question.b, where=question.where, **fields)
    method = "inequality" if question.bounds in INEQUALITIES else "linear"
    request = {
        "method": method,
        "options": dict(options),
        "tolerance": tolerance,
        "bounds": question.bounds,
    }
    reply = worker.ask(request | {"problem": str(path), "answer": str(answer)})
    if reply["reason"] <= 0:
        raise PeerFailed(
            f"PETSc did not converge: reason {reply['reason']} after {reply['iterations']} "
            "iterations"
        )
    return PeerAnswer(
        np.load(answer),
        reply["setup"],
        reply["solve"],
        reply["iterations"],
        reply["linear_iterations"],
    )
