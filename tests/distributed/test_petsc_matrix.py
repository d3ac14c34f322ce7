"""The operator and its multigrid as PETSc's objects."""

from pathlib import Path

import pytest

PROGRAM = Path(__file__).with_name("petsc_objects.py")


@pytest.mark.parametrize("ranks", [1, 2, 4])
def test_products_and_diagonals_are_those_of_the_definition(mpi, ranks):
    assert mpi(ranks, PROGRAM, "products").returncode == 0


@pytest.mark.parametrize("ranks", [1, 2])
@pytest.mark.parametrize("check", ["preconditioner", "linear_solves", "bounded_methods"])
def test_petscs_solvers_work_with_them(mpi, ranks, check):
    assert mpi(ranks, PROGRAM, check).returncode == 0


def test_a_cycle_is_that_of_pcmg(mpi):
    done = mpi(1, PROGRAM, "cycles_of_pcmg")  # which asserts that they agree to 1e-12
    assert done.returncode == 0
