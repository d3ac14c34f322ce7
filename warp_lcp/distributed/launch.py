"""Start a Python program on ranks of this machine, and say why that cannot be done here."""

from __future__ import annotations

import glob
import importlib.util
import os
import shutil
import sys
from collections.abc import Mapping

DEBIAN_PETSC = "/usr/lib/petscdir/petsc*/*-real"  # where Debian keeps the builds that petsc4py chooses from by PETSC_DIR
INSTALL = "install MPI, petsc4py and mpi4py (the extra `distributed`, or Debian's python3-petsc4py, openmpi-bin and python3-mpi4py)"
# Open MPI: more ranks than cores, none bound to a core, root; MPICH allows all of that and ignores these names
OPEN_MPI = {
    "OMPI_ALLOW_RUN_AS_ROOT": "1",
    "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
    "OMPI_MCA_rmaps_base_oversubscribe": "1",
    "OMPI_MCA_hwloc_base_binding_policy": "none",
    "OMPI_MCA_mpi_yield_when_idle": "1",  # a rank that waits gives its core to others
    "PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe",  # the same of Open MPI 5
    "PRTE_MCA_hwloc_default_binding_policy": "none",
}
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # each rank has a core, not a machine
OF_A_RANK = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "PMIX_RANK", "PMI_RANK")  # what mpiexec tells the processes that it starts


def on_ranks() -> bool:
    """Return whether mpiexec started this process."""
    return any(name in os.environ for name in OF_A_RANK)


def missing() -> str:
    """Return why this interpreter starts no programs on ranks, "" if it does."""
    if shutil.which("mpiexec") is None:
        return f"no mpiexec: {INSTALL}"
    lacking = [name for name in ("petsc4py", "mpi4py") if importlib.util.find_spec(name) is None]
    return f"no {' and no '.join(lacking)}: {INSTALL}" if lacking else ""


def command(ranks: int, *arguments: str) -> list[str]:
    """Return the command that runs this interpreter with `arguments` on as many ranks."""
    return ["mpiexec", "-n", str(ranks), sys.executable, *arguments]


def environment(given: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return an environment for that command: `given` (this process's unless given), and where it is silent one thread a rank,
    any number of ranks and Debian's PETSc."""
    found = sorted(glob.glob(DEBIAN_PETSC))
    debian = {"PETSC_DIR": found[-1]} if found else {}
    return {**debian, **ONE_THREAD, **OPEN_MPI, **(os.environ if given is None else given)}
