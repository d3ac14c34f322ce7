"""Operator and multigrid as PETSc objects."""

import re
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
def test_petsc_objects_match_their_definition_and_work_in_petsc_solvers(mpi, ranks, checks):
    assert sorted(mpi(ranks, PROGRAM, *checks).stdout.split()) == sorted(checks * ranks)


def test_operators_that_all_ranks_have_released_are_destroyed(mpi):
    """Objects that wait for their end, after each of three operators: that operator's matrix."""
    text = mpi(2, PROGRAM, "released").stdout
    assert re.findall(r"Total entries: *(\d+)", text) == ["1"] * 6
