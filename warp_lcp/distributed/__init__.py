"""Grids distributed over MPI ranks.

PETSc partitions the grid and exchanges halos; the solvers are those of one process.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from warp_lcp.distributed.decomposition import Decomposition
from warp_lcp.distributed.halo import Halo
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.grid.cell_box import CellBox

if TYPE_CHECKING:
    from warp_lcp.extras.petsc_matrix import PetscGrid


def __getattr__(name: str) -> Any:
    """Import `PetscGrid`, PETSc's objects for a grid, on first access: it is an extra."""
    if name == "PetscGrid":
        return import_module("warp_lcp.extras.petsc_matrix").PetscGrid
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = ["CellBox", "Decomposition", "Halo", "PetscGrid", "Ranks"]
