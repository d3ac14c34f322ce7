"""Grids that are shared by the ranks of MPI: PETSc cuts and exchanges them, the solvers are those of one process."""
