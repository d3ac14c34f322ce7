"""Peers in an interpreter of their own: how it is found, and our side of the exchange."""

from __future__ import annotations

import glob
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]  # of the package `benchmarks`
PROBE_SECONDS = 120.0
DEBIAN_PETSC = "/usr/lib/petscdir/petsc*/*-real"  # where Debian keeps the builds that petsc4py chooses from by PETSC_DIR


class PeerFailed(RuntimeError):
    """A peer gave no answer; the message says why."""


@dataclass(frozen=True)
class Home:
    """Where a peer lives.

    Args:
        module: what its interpreter must be able to import.
        variable: environment variable that names the interpreter.
        worker: module under benchmarks.workers that serves it.
        hint: how to get it.
    """

    module: str
    variable: str
    worker: str
    hint: str

    def interpreter(self) -> str | None:
        """Return the first interpreter that imports the peer: the one the variable names, this one, the system's; None if none does."""
        named = os.environ.get(self.variable)
        candidates = [named] if named else [sys.executable, "/usr/bin/python3"]
        return next((python for python in candidates if self._imports(python)), None)

    def missing(self) -> str:
        """Return what to tell where there is none."""
        named = os.environ.get(self.variable)
        where = f"{named}, which {self.variable} names, does not import {self.module}" if named else f"no interpreter imports {self.module}"
        return f"missing: {where}; {self.hint}"

    def environment(self) -> dict[str, str]:
        """Return the environment of its interpreter: one thread, and Debian's PETSc where none is named."""
        found = sorted(glob.glob(DEBIAN_PETSC))
        return {**({"PETSC_DIR": found[-1]} if found else {}), **os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

    def _imports(self, python: str) -> bool:
        command = [python, "-c", f"import {self.module}"]
        try:
            done = subprocess.run(command, env=self.environment(), capture_output=True, check=False, timeout=PROBE_SECONDS)
        except (OSError, subprocess.TimeoutExpired):
            return False
        return done.returncode == 0


class Worker:
    """A running peer.

    Args:
        home: of the peer.
        python: its interpreter.

    Attributes:
        version: of the peer.

    Raises:
        PeerFailed: it does not start.
    """

    def __init__(self, home: Home, python: str) -> None:
        # the package comes last on the path: what lies beside it was installed for another interpreter
        program = f"import sys; sys.path.append({str(ROOT)!r}); from benchmarks.workers.{home.worker} import main; main()"
        self.name = home.module
        self.process = subprocess.Popen(
            [python, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=home.environment(), text=True, encoding="utf-8"
        )
        self.version = str(self._read()["version"])

    def ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Return the answer to a request.

        Raises:
            PeerFailed: it says that it failed, or it has ended.
        """
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(json.dumps(request) + "\n")
            self.process.stdin.flush()
        except BrokenPipeError:
            raise PeerFailed(f"{self.name} has ended with exit code {self.process.wait()}") from None
        reply = self._read()
        if "error" in reply:
            raise PeerFailed(f"{self.name}: {reply['error']}")
        return reply

    def close(self) -> None:
        """End it."""
        self.process.communicate()

    def _read(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise PeerFailed(f"{self.name} has ended with exit code {self.process.wait()}")
        reply: dict[str, Any] = json.loads(line)
        return reply
