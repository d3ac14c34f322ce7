"""What carries a computation: this process, or the ranks that `mpiexec` has started."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer


class EngineError(ValueError):
    """An engine cannot be used here. The message says why and what to do."""


class Engine(StrEnum):
    """What carries a computation."""

    SINGLE = "single"  # one process with one device
    PETSC = "petsc"  # the ranks of MPI, whose grids PETSc cuts and exchanges


EngineOption = Annotated[
    Engine, typer.Option(help="single: this process; petsc: the ranks that `mpiexec -n N warp-lcp ...` starts (needs petsc4py and mpi4py).")
]
