"""The active set with PETSc's linear solves: statuses, histories and solutions do not depend on the ranks; PETSc's options count."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

import warp_lcp as wl
from warp_lcp.distributed.petsc_active_set import PetscActiveSet

PROGRAM = Path(__file__).with_name("petsc_active_set_on_ranks.py")

WITH_OPTIONS = """
    import sys
    import numpy as np
    import warp_lcp as wl
    from warp_lcp.distributed.petsc_active_set import PetscActiveSet
    from warp_lcp.gallery.fluid import splash

    problem, stopping = splash(16).lcp("walls", device="cpu"), wl.StoppingCriteria(rtol=1e-9)
    plain = wl.solve(problem, PetscActiveSet(prefix="plain_"), stopping=stopping)
    method = PetscActiveSet()
    work = method.init(problem)
    other = wl.solve(problem, method, workspace=work, stopping=stopping)
    assert plain and other, (plain.status, other.status)
    assert work.ksp.getType() == "fcg" and work.ksp.getPC().getType() == "jacobi" and work.ksp.getTolerances()[3] == 70
    steps = np.diff([h.linear_iterations for h in other.history])
    assert steps.max() == 70, steps  # 0.1 was not reached: the limit of the options counts
    assert other.linear_iterations > 5 * plain.linear_iterations
    assert np.abs(plain.x.numpy() - other.x.numpy()).max() < 1e-7 * np.abs(plain.x.numpy()).max()
"""

IN_PLACE = """
    import numpy as np
    import warp as wp
    import warp_lcp as wl
    from warp_lcp.distributed.petsc_active_set import PetscActiveSet

    def cells(height):
        found = np.full((12, 20, 14), wl.AIR, dtype=np.int8)
        found[:, :height, : height + 2] = wl.FLUID
        found[3:5, 2:4, 5:9] = wl.SOLID
        return found

    def padded(seed):
        field = np.zeros((14, 22, 16))
        field[1:-1, 1:-1, 1:-1] = np.random.default_rng(seed).standard_normal((12, 20, 14))
        return field

    stopping, method = wl.StoppingCriteria(rtol=1e-9), PetscActiveSet(precision="double")
    A, b = wl.GridPoisson(cells(9), device="cpu"), wp.array(padded(19), dtype=wp.float64, device="cpu")
    problem = wl.LCP(A, b)
    work = method.init(problem)
    assert wl.solve(problem, method, workspace=work, stopping=stopping)
    for height, seed in ((5, 23), (12, 27)):
        A.update(wp.array(cells(height), dtype=wp.int8, device="cpu"))
        b.assign(padded(seed))
        again = wl.solve(problem, method, workspace=work, stopping=stopping)
        other = wl.LCP(wl.GridPoisson(cells(height), device="cpu"), padded(seed)[1:-1, 1:-1, 1:-1])
        fresh = wl.solve(other, method, stopping=stopping)
        assert again and fresh, (again.status, fresh.status)
        assert again.linear_iterations == fresh.linear_iterations
        x = fresh.x.numpy()
        assert np.abs(again.x.numpy()[1:-1, 1:-1, 1:-1] - x).max() <= 1e-12 * np.abs(x).max()
"""


@pytest.fixture(scope="module")
def told():
    """What the program tells on each number of ranks that has been asked for."""
    return {}


def run(mpi, told, ranks):
    if ranks not in told:
        lines = mpi(ranks, PROGRAM).stdout.splitlines()
        told[ranks] = json.loads(next(line for line in lines if line.startswith("{")))
    return told[ranks]


@pytest.mark.parametrize("ranks", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_results_do_not_depend_on_the_ranks(mpi, told, ranks):
    alone, shared = run(mpi, told, 1), run(mpi, told, ranks)
    assert alone.keys() == shared.keys()
    for name, one in alone.items():
        several = shared[name]
        assert several["status"] == one["status"], name
        assert abs(several["linear_iterations"] - one["linear_iterations"]) <= 1, name
        assert len(several["history"]) == len(one["history"]), name
        for step, other in zip(one["history"], several["history"], strict=True):
            assert step[0] == other[0], name
            assert step[2] == other[2], (name, step, other)  # unknowns held
            assert other[3] == pytest.approx(step[3], rel=0.02, abs=1e-6 * one["history"][0][3]), (name, step, other)
        x, y = np.array(one["x"]), np.array(several["x"])
        assert np.abs(x - y).max() <= (1e-4 if "single" in name else 1e-7) * np.abs(x).max(), name


def test_statuses_and_limits(mpi, told):
    found = run(mpi, told, 1)
    expected = dict.fromkeys(found, "CONVERGED") | {"cube, stopped": "MAX_ITERATIONS", "closed, filled": "INFEASIBLE"}
    assert {name: one["status"] for name, one in found.items()} == expected
    assert len(found["cube, stopped"]["history"]) == 4
    assert [step[0] for step in found["cube"]["history"][:4]] == ["start", "monotone cycle", "monotone cycle", "newton"]
    assert "monotone cycle" not in {step[0] for step in found["cube, cold"]["history"]}
    assert max(np.diff([step[1] for step in found["cube, few"]["history"]])) == 1
    for name in ("cube", "brick", "plane"):
        assert found[name]["linear_iterations"] <= 16, name  # as many as one linear solve to that accuracy


def test_problems_that_change_in_place_keep_their_workspace(mpi):
    assert mpi(1, IN_PLACE).returncode == 0


def test_options_of_petsc_count_and_its_monitors_speak(mpi):
    options = "-plain_ksp_monitor -plain_ksp_converged_reason -ksp_type fcg -pc_type jacobi -ksp_max_it 70 -ksp_rtol 1e-12"
    said = mpi(1, WITH_OPTIONS, environment={"PETSC_OPTIONS": options}).stdout
    assert "0 KSP Residual norm" in said
    assert "Linear plain_ solve converged due to CONVERGED_RTOL" in said


def test_wrong_settings_and_problems_are_refused():
    with pytest.raises(ValueError, match=r"eta = 2"):
        PetscActiveSet(eta=2)
    with pytest.raises(
        ValueError, match=r"PetscActiveSet needs an operator with a stencil .*; DenseOperator has none: use MinimumMapNewton"
    ):
        wl.solve(wl.LCP(wl.DenseOperator(np.eye(2), device="cpu"), -np.ones(2)), PetscActiveSet())


def test_without_petsc_the_message_tells_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "petsc4py", None)
    problem = wl.LCP(wl.GridPoisson(np.array([[wl.AIR, wl.FLUID]]), device="cpu"), -np.ones((1, 2)))
    with pytest.raises(ImportError, match="pip install"):
        wl.solve(problem, PetscActiveSet())
