"""Launch Python programs on MPI ranks of this machine; report missing packages."""

from __future__ import annotations

import glob
import importlib.util
import os
import shutil
import sys
from collections.abc import Mapping
from types import ModuleType

# Directory of Debian's builds, from which petsc4py chooses by PETSC_DIR.
DEBIAN_PETSC = "/usr/lib/petscdir/petsc*/*-real"
INSTALL = (
    "install MPI, petsc4py and mpi4py (the extra `distributed`, or Debian's "
    "python3-petsc4py, openmpi-bin and python3-mpi4py)"
)
HOW_TO_INSTALL = (
    "the PETSc engine needs petsc4py and mpi4py: pip install 'warp-lcp[distributed]', or on Debian "
    "and Ubuntu apt-get install "
    "python3-petsc4py python3-mpi4py openmpi-bin, a virtual environment of the system's Python "
    "with --system-site-packages and numpy < 2, "
    "and PETSC_DIR set to a folder like /usr/lib/petscdir/petsc3.18/x86_64-linux-gnu-real"
)
# Open MPI: allow more ranks than cores, do not bind ranks to cores, allow root. MPICH allows all of
# that and ignores these names.
OPEN_MPI = {
    "OMPI_ALLOW_RUN_AS_ROOT": "1",
    "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
    "OMPI_MCA_rmaps_base_oversubscribe": "1",
    "OMPI_MCA_hwloc_base_binding_policy": "none",
    "OMPI_MCA_mpi_yield_when_idle": "1",  # a waiting rank yields its core to others
    # The option for oversubscription in Open MPI 5.
    "PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe",
    "PRTE_MCA_hwloc_default_binding_policy": "none",
}
# A rank has one core, not all of the machine.
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
# Environment variables that mpiexec and srun set for their processes.
RANK = ("OMPI_COMM_WORLD_RANK", "PMIX_RANK", "PMI_RANK")

# Environment variables of mpiexec or srun with the number of processes.
SIZES = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "SLURM_STEP_NUM_TASKS")


def processes_started() -> int:
    """Return the number of processes of mpiexec or srun, without MPI."""
    return int(next((os.environ[name] for name in SIZES if name in os.environ), "1"))


def rank_here() -> int | None:
    """Return this process's MPI rank, or None if mpiexec started none.

    MPI is not initialized.
    """
    return next((int(os.environ[name]) for name in RANK if name in os.environ), None)


def find_petsc() -> None:
    """Add Debian's petsc4py to the import path of this interpreter.

    It is located next to the PETSc build that PETSC_DIR names when Python starts. Does nothing if
    petsc4py is found already, if PETSC_DIR is set, and in an interpreter without Debian's mpi4py.
    """
    if (
        "PETSC_DIR" in os.environ
        or importlib.util.find_spec("petsc4py")
        or not importlib.util.find_spec("mpi4py")
    ):
        return
    for directory in debian_petsc():
        os.environ["PETSC_DIR"] = directory
        sys.path.append(os.path.join(directory, "lib", "python3", "dist-packages"))


def petsc() -> ModuleType:
    """Return the PETSc module, with MPI initialized.

    Raises:
        ImportError: petsc4py or mpi4py cannot be imported; the message says how to install them.
    """
    find_petsc()
    try:
        import mpi4py  # noqa: F401
        from petsc4py import PETSc
    except ImportError as error:
        raise ImportError(f"{HOW_TO_INSTALL} ({error})") from error
    return PETSc


def debian_petsc() -> list[str]:
    """Return the newest PETSc build of Debian, as a list of at most one folder."""
    return sorted(glob.glob(DEBIAN_PETSC))[-1:]


def missing() -> str:
    """Return the packages missing for programs on ranks; "" if none is."""
    if shutil.which("mpiexec") is None:
        return f"no mpiexec: {INSTALL}"
    find_petsc()
    lacking = [name for name in ("petsc4py", "mpi4py") if importlib.util.find_spec(name) is None]
    return f"no {' and no '.join(lacking)}: {INSTALL}" if lacking else ""


def command(ranks: int, *arguments: str) -> list[str]:
    """Return the command that runs this interpreter with `arguments` on ranks."""
    return ["mpiexec", "-n", str(ranks), sys.executable, *arguments]


def environment(base: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return the environment for `command`.

    One thread per rank, any number of ranks, and Debian's PETSc, unless `base` sets them.

    Args:
        base: variables that stay as they are; this process's own if None.
    """
    found = {**ONE_THREAD, **OPEN_MPI}
    if debian_petsc():
        found["PETSC_DIR"] = debian_petsc()[0]
    return found | dict(os.environ if base is None else base)
