"""Viscous equations on ranks against one process, with their preconditioner."""

from pathlib import Path

import pytest

PROGRAM = Path(__file__).with_name("viscosity_on_ranks.py")
TESTS = Path(__file__).parents[1]


@pytest.mark.parametrize("ranks", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_a_cycle_is_that_of_one_process(mpi, ranks):
    assert (
        mpi(ranks, PROGRAM, environment={"PYTHONPATH": f"{TESTS}:{TESTS.parent}"}).returncode == 0
    )
