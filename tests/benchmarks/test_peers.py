"""Peers: equal residuals, exchange with other interpreters, missing libraries."""

import json
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import warp_lcp as wl
from command_line import forked_suites, invoke
from warp_lcp.benchmarks import peers as suite
from warp_lcp.benchmarks.peers import libraries, petsc
from warp_lcp.benchmarks.peers.peer import Peer, PeerAnswer, PeerFailed, PeerProblem
from warp_lcp.benchmarks.peers.peer_list import roster
from warp_lcp.benchmarks.peers.petsc import PeerWorker
from warp_lcp.benchmarks.problems import splash

STUB = """
import os
import sys
import types

sys.modules["petsc4py"] = types.SimpleNamespace(PETSc=None)  # which the program \
imports, and `serve` does not use
sys.path.append(sys.argv[1])
from petsc_worker import serve


def double(request):
    print("a library prints")
    os.system("echo and so does its C code")
    return {"x": 2 * request["x"]}


def fail(request):
    raise ValueError("first line\\nsingular matrix")


serve("1.2", {"double": double, "fail": fail, "end": lambda request: os._exit(7)}, (ValueError,))
"""


@pytest.fixture(scope="module")
def question():
    return PeerProblem(splash(12), "walls")


def dense_solution(question, rounds=200):
    """Return the LCP's solution by primal-dual active sets and dense solves."""
    A, b, lower = question.matrix.toarray(), question.b, question.lower
    at_bound = np.zeros(len(b), dtype=bool)
    for _ in range(rounds):
        x, free = np.where(at_bound, lower, 0.0), ~at_bound
        x[free] = np.linalg.solve(
            A[np.ix_(free, free)], -b[free] - A[np.ix_(free, at_bound)] @ x[at_bound]
        )
        y = A @ x + b
        new = np.isfinite(lower) & np.where(at_bound, y > 0, x < lower)
        if (new == at_bound).all():
            return x
        at_bound = new
    raise AssertionError("the active set did not settle")


def test_residuals_of_the_peer_problem_agree(question):
    problem = question.scene.lcp("walls", device="cpu")
    result = wl.solve(problem, stopping=wl.StoppingCriteria(rtol=1e-5))
    x = result.x.numpy().ravel()[question.where]
    assert question.residual(x) == pytest.approx(result.relative_residual, rel=1e-6)
    assert question.residual(np.zeros_like(x)) == pytest.approx(1.0)
    assert question.residual(-x) > 1.0
    assert question.matrix.indices.dtype == np.int32


def test_peers_of_the_linear_solve_find_its_solution():
    question = PeerProblem(splash(12), "linear")
    x = np.linalg.solve(question.matrix.toarray(), -question.b)
    classical = partial(libraries.pyamg, build="ruge_stuben_solver")
    for solve in (
        libraries.pyamg,
        classical,
        libraries.scipy_cg,
        partial(libraries.warp_cg, device="cpu"),
    ):
        answer = solve(question, 1e-9)
        assert np.allclose(answer.x, x, atol=1e-7 * np.abs(x).max())
        assert answer.iterations > 0
        assert answer.total == answer.setup + answer.solve


@pytest.mark.parametrize("name", ["osqp", "piqp", "clarabel"])
def test_quadratic_programs_find_the_solution(name, question):
    pytest.importorskip(name)
    answer = getattr(libraries, name)(question, 1e-9)
    x = dense_solution(question)
    assert question.residual(x) < 1e-12
    assert np.allclose(answer.x, x, atol=1e-4 * np.abs(x).max())


def test_amgcl_finds_the_solution():
    pytest.importorskip("pyamgcl")
    question = PeerProblem(splash(12), "linear")
    assert question.residual(libraries.amgcl(question, 1e-8).x) < 1e-7


@pytest.mark.skipif(petsc.interpreter() is None, reason="no interpreter imports petsc4py")
def test_petsc_finds_the_solutions(question):
    with roster("cpu") as there:
        peers = [p for p in there.peers if p.library == "petsc"]
        assert there.versions["petsc"][:1].isdigit()
        assert len(peers) == 7
        for peer in peers:
            for bounds in peer.bounds:
                asked = PeerProblem(question.scene, bounds)
                answer = peer.solve(asked, 1e-8)
                assert asked.residual(answer.x) < 1e-6, peer.name
                assert answer.linear_iterations >= answer.iterations > 0
                if bounds == "walls":
                    assert np.allclose(
                        answer.x, dense_solution(question), atol=1e-5 * np.abs(answer.x).max()
                    )


@pytest.fixture
def stub(tmp_path):
    (tmp_path / "stub.py").write_text(STUB)
    worker = PeerWorker(
        "json", [sys.executable, str(tmp_path / "stub.py"), str(Path(petsc.__file__).parent)]
    )
    yield worker
    worker.close()


def test_exchange(stub):
    assert stub.version == "1.2"
    assert stub.ask({"method": "double", "x": 21}) == {"x": 42}
    with pytest.raises(PeerFailed, match="json: singular matrix"):
        stub.ask({"method": "fail"})
    assert stub.ask({"method": "double", "x": 1}) == {"x": 2}  # it continues after a failure
    with pytest.raises(PeerFailed, match="ended with exit code 7"):
        stub.ask({"method": "end"})
    with pytest.raises(PeerFailed, match="ended with exit code 7"):
        stub.ask({"method": "double", "x": 1})


def test_a_missing_peer_reports_how_to_install_it(monkeypatch):
    monkeypatch.delenv(petsc.VARIABLE, raising=False)
    assert petsc.interpreter("no_such_module") is None
    assert petsc.missing().startswith("missing: no interpreter imports petsc4py; apt-get install")
    monkeypatch.setenv(petsc.VARIABLE, "/no/such/python")
    assert petsc.interpreter("json") is None
    assert (
        "/no/such/python, which WARP_LCP_PETSC_PYTHON names, does not import petsc4py"
        in petsc.missing()
    )
    assert petsc.interpreter("json", "WARP_LCP_TEST_OTHER") == sys.executable


def contest(question, errors):
    """Return a contest of a peer whose error is a share of its tolerance."""
    x = dense_solution(question)

    def solve(asked, tolerance):
        if errors is None:
            raise PeerFailed("it is made of cheese")
        return PeerAnswer(x * (1 + errors * tolerance), 0.1, 0.2, 3)

    return suite.PeerComparison(Peer("stub", "none", solve), question)


def test_tolerances_are_tightened_until_the_residual_is_as_asked(question):
    x = dense_solution(question)
    size = question.residual(2 * x)  # residual of an error as large as x
    exact, loose, hopeless, broken = (
        contest(question, e) for e in (0.5 / size, 20 / size, 1e9 / size, None)
    )
    for one in (exact, loose, hopeless, broken):
        one.calibrate()
        one.again()
    assert exact.tolerance == 1e-6
    assert loose.tolerance == pytest.approx(3e-8)
    assert loose.residual <= 1.01e-6
    assert [len(one.answers) for one in (exact, loose, hopeless, broken)] == [1, 1, 0, 0]
    assert hopeless.remark.startswith("residual")
    assert broken.remark == "it is made of cheese"


def test_suite_without_foreign_peers(tmp_path, monkeypatch):
    monkeypatch.setenv("WARP_LCP_PETSC_PYTHON", "/no/such/python")
    arguments = ["bench", "peers", "--out", str(tmp_path), "--repeat", "1", "--size", "8"]
    with forked_suites():
        result = invoke(*arguments)
    assert result.exit_code == 0, result.stderr
    records = {r["name"]: r for r in json.loads((tmp_path / "peers.json").read_text())}
    peers = records["machine"]["peers"]
    assert peers["petsc"].startswith("missing: /no/such/python, which WARP_LCP_PETSC_PYTHON names")
    assert peers["siconos"].startswith("missing")
    assert peers["pyamg"][:1].isdigit()
    pyamg, ours = records["8^3 linear PyAMG SA-CG"], records["8^3 linear ProjectedMultigrid"]
    for r in (pyamg, ours):
        assert r["figures"]["residual"]["value"] <= 1.01e-6
    ratio = pyamg["figures"]["total"]["value"] / ours["figures"]["total"]["value"]
    assert pyamg["figures"]["over_engine"]["value"] == pytest.approx(ratio)
    text = (tmp_path / "peers.md").read_text()
    assert "| linear: PETSc's CG+MG | >= 3 x | not measured here |  |" in text
