"""Grids distributed over MPI ranks.

PETSc partitions the grid and exchanges halos; the solvers are those of one process.
"""

from warp_lcp.distributed.decomposition import Decomposition
from warp_lcp.distributed.halo import Halo
from warp_lcp.distributed.petsc_matrix import PetscGrid
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.grid.cell_box import CellBox

__all__ = ["CellBox", "Decomposition", "Halo", "PetscGrid", "Ranks"]
