"""Solutions on ranks against PETSc's own methods.

PETSc's matrix is assembled from the definition.
"""

import json
from pathlib import Path

import pytest

PROGRAM = Path(__file__).with_name("petsc_oracles.py")
SCENES = ("cube", "brick", "plane")
OURS = ("newton", "multigrid")


@pytest.mark.parametrize("ranks", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_petscs_own_methods_find_the_same_solution_and_active_set(mpi, ranks):
    lines = mpi(ranks, PROGRAM, *SCENES).stdout.splitlines()
    found = json.loads(next(line for line in lines if line.startswith("{")))
    assert len(found) == 3 * len(SCENES)
    for bounds, methods in found.items():
        assert set(methods) > set(OURS), methods
        assert len(methods) == len(OURS) + 5
        below, above = methods["newton"]["held"]
        assert below > 30
        assert (above > 30) == bounds.endswith("boxed")
        for method, figures in methods.items():
            assert figures["converged"], (bounds, method, figures)
            assert figures["error"] < 1e-8, (bounds, method, figures)
            assert figures["held_otherwise"] == 0, (bounds, method, figures)
        for method in OURS:  # the reported residual is that of its x
            figures = methods[method]
            assert figures["residual_by_scipy"] == pytest.approx(figures["residual"], rel=1e-3), (
                bounds,
                method,
                figures,
            )
