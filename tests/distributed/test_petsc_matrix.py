"""Operator and multigrid as PETSc objects."""

from pathlib import Path

import pytest

PROGRAM = Path(__file__).with_name("petsc_objects.py")


# Products and diagonals against the definition, and PETSc's solvers with them. A start takes longer
# than most checks.
CHECKS = ("products", "preconditioner", "linear_solves", "bounded_methods")


# a cycle beside PCMG's, to 1e-12
@pytest.mark.parametrize(
    ("ranks", "checks"), [(1, ("cycles_of_pcmg", *CHECKS)), (2, CHECKS), (4, CHECKS[:1])]
)
def test_they_are_what_the_definition_says_and_petscs_solvers_work_with_them(mpi, ranks, checks):
    assert sorted(mpi(ranks, PROGRAM, *checks).stdout.split()) == sorted(checks * ranks)
