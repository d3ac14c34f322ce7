"""Peers: the same residual for all, the exchange with other interpreters, and what is said where one is missing."""

import json
import shutil
import sys
from functools import partial

import numpy as np
import pytest
from typer.testing import CliRunner
from warp_lcp.benchmarks.implicit_mpm import NEWTON

import warp_lcp as wl
from warp_lcp.benchmarks import chart
from warp_lcp.benchmarks.harness.record import Record, read_json, write_json
from warp_lcp.benchmarks.harness.timing import Figure
from warp_lcp.benchmarks.peers import foreign, linear, quadratic, suite
from warp_lcp.benchmarks.peers.foreign import Home, PeerFailed, Worker
from warp_lcp.benchmarks.peers.peer import Answer, Peer, Question
from warp_lcp.benchmarks.peers.roster import PETSC, roster
from warp_lcp.benchmarks.problems import splash
from warp_lcp.benchmarks.suite import Suite
from warp_lcp.benchmarks.workers import exchange
from warp_lcp.cli import commands as cli

STUB = """
import os
from warp_lcp.benchmarks.workers.exchange import serve

def double(request):
    print("a library prints")
    os.system("echo and so does its C code")
    return {"x": 2 * request["x"]}

def fail(request):
    raise ValueError("first line\\nsingular matrix")

def end(request):
    os._exit(7)

def main():
    serve("1.2", {"double": double, "fail": fail, "end": end}, (ValueError,))
"""


@pytest.fixture(scope="module")
def question():
    return Question(splash(12), "walls")


def dense_solution(question, rounds=200):
    """Return the LCP's solution by primal-dual active sets and dense solves."""
    A, b, lower = question.matrix.toarray(), question.b, question.lower
    held = np.zeros(len(b), dtype=bool)
    for _ in range(rounds):
        x, free = np.where(held, lower, 0.0), ~held
        x[free] = np.linalg.solve(A[np.ix_(free, free)], -b[free] - A[np.ix_(free, held)] @ x[held])
        y = A @ x + b
        new = np.isfinite(lower) & np.where(held, y > 0, x < lower)
        if (new == held).all():
            return x
        held = new
    raise AssertionError("the active set did not settle")


def test_question_is_the_problem(question):
    problem = question.scene.problem("walls", "cpu")
    result = wl.solve(problem, stopping=wl.StoppingCriteria(rtol=1e-5))
    x = result.x.numpy().ravel()[question.where]
    assert question.residual(x) == pytest.approx(result.relative_residual, rel=1e-6)
    assert question.residual(np.zeros_like(x)) == pytest.approx(1.0)
    assert question.residual(-x) > 1.0
    assert question.matrix.indices.dtype == np.int32


def test_peers_of_the_linear_solve_find_its_solution():
    question = Question(splash(12), "linear")
    x = np.linalg.solve(question.matrix.toarray(), -question.b)
    for solve in (linear.pyamg_aggregation, linear.pyamg_classical, linear.scipy_cg, partial(linear.warp_cg, device="cpu")):
        answer = solve(question, 1e-9)
        assert np.allclose(answer.x, x, atol=1e-7 * np.abs(x).max())
        assert answer.iterations > 0
        assert answer.total == answer.setup + answer.solve


@pytest.mark.parametrize("name", ["osqp", "piqp", "clarabel"])
def test_quadratic_programs_find_the_solution(name, question):
    pytest.importorskip(name)
    answer = getattr(quadratic, name)(question, 1e-9)
    x = dense_solution(question)
    assert question.residual(x) < 1e-12
    assert np.allclose(answer.x, x, atol=1e-4 * np.abs(x).max())


def test_amgcl_finds_the_solution():
    pytest.importorskip("pyamgcl")
    question = Question(splash(12), "linear")
    assert question.residual(linear.amgcl(question, 1e-8).x) < 1e-7


@pytest.mark.skipif(PETSC.interpreter() is None, reason="no interpreter imports petsc4py")
def test_petsc_finds_the_solutions(question):
    with roster("cpu") as there:
        peers = [p for p in there.peers if p.library == "petsc"]
        assert there.versions["petsc"][:1].isdigit()
        assert len(peers) == 7
        for peer in peers:
            for bounds in peer.bounds:
                asked = Question(question.scene, bounds)
                answer = peer.solve(asked, 1e-8)
                assert asked.residual(answer.x) < 1e-6, peer.name
                assert answer.linear_iterations >= answer.iterations > 0
                if bounds == "walls":
                    assert np.allclose(answer.x, dense_solution(question), atol=1e-5 * np.abs(answer.x).max())


@pytest.fixture
def stub(tmp_path, monkeypatch):
    folder = tmp_path / "benchmarks" / "workers"
    folder.mkdir(parents=True)
    (tmp_path / "benchmarks" / "__init__.py").touch()
    (folder / "__init__.py").touch()
    shutil.copy(exchange.__file__, folder)
    (folder / "stub.py").write_text(STUB)
    monkeypatch.setattr(foreign, "ROOT", tmp_path)
    monkeypatch.chdir(tmp_path)  # `benchmarks` is then the one here, not the installed one
    worker = Worker(Home("json", "WARP_LCP_NO_SUCH_VARIABLE", "stub", ""), sys.executable)
    yield worker
    worker.close()


def test_exchange(stub):
    assert stub.version == "1.2"
    assert stub.ask({"method": "double", "x": 21}) == {"x": 42}
    with pytest.raises(PeerFailed, match="json: singular matrix"):
        stub.ask({"method": "fail"})
    assert stub.ask({"method": "double", "x": 1}) == {"x": 2}  # it goes on after a failure
    with pytest.raises(PeerFailed, match="ended with exit code 7"):
        stub.ask({"method": "end"})
    with pytest.raises(PeerFailed, match="ended with exit code 7"):
        stub.ask({"method": "double", "x": 1})


def test_a_missing_peer_tells_how_to_get_it(monkeypatch):
    home = Home("no_such_module", "WARP_LCP_TEST_PYTHON", "stub", "pip install it")
    assert home.interpreter() is None
    assert home.missing() == "missing: no interpreter imports no_such_module; pip install it"
    monkeypatch.setenv("WARP_LCP_TEST_PYTHON", "/no/such/python")
    assert home.interpreter() is None
    assert "/no/such/python, which WARP_LCP_TEST_PYTHON names, does not import no_such_module" in home.missing()
    assert Home("json", "WARP_LCP_TEST_OTHER", "stub", "").interpreter() == sys.executable


def contest(question, errors):
    """Return a contest of a peer whose answer is off by a share of the tolerance that it is asked for."""
    x = dense_solution(question)

    def solve(asked, tolerance):
        if errors is None:
            raise PeerFailed("it is made of cheese")
        return Answer(x * (1 + errors * tolerance), 0.1, 0.2, 3)

    return suite.Contest(Peer("stub", "none", solve), question)


def test_tolerances_are_tightened_until_the_residual_is_as_asked(question):
    x = dense_solution(question)
    size = question.residual(2 * x)  # the residual that an error as large as x has
    exact, loose, hopeless, broken = (contest(question, e) for e in (0.5 / size, 20 / size, 1e9 / size, None))
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
    arguments = ["bench", "peers", "--out", str(tmp_path), "--repeat", "1", "--size", "12"]
    result = CliRunner().invoke(cli.app, arguments)
    assert result.exit_code == 0, result.stderr
    records = {r["name"]: r for r in json.loads((tmp_path / "peers.json").read_text())}
    peers = records["machine"]["peers"]
    assert peers["petsc"].startswith("missing: /no/such/python, which WARP_LCP_PETSC_PYTHON names")
    assert peers["siconos"].startswith("missing")
    assert peers["pyamg"][:1].isdigit()
    pyamg, ours = records["12^3 linear PyAMG SA-CG"], records["12^3 linear ProjectedMultigrid"]
    for r in (pyamg, ours):
        assert r["figures"]["residual"]["value"] <= 1.01e-6
    ratio = pyamg["figures"]["total"]["value"] / ours["figures"]["total"]["value"]
    assert pyamg["figures"]["over_engine"]["value"] == pytest.approx(ratio)
    text = (tmp_path / "peers.md").read_text()
    assert "| linear: PETSc's CG+MG | >= 3 x | not measured here |  |" in text


def test_sand_without_newton(tmp_path, monkeypatch):
    monkeypatch.setenv("WARP_LCP_NEWTON_PYTHON", "/no/such/python")
    arguments = ["bench", "sand", "--group", "implicit_mpm", "--out", str(tmp_path), "--repeat", "1", "--size", "16"]
    result = CliRunner().invoke(cli.app, arguments)
    assert result.exit_code == 0, result.stderr
    records = read_json(tmp_path / "implicit_mpm.json")
    ours, theirs = records["16 cells: warp_lcp"], records["16 cells: newton, defaults"]
    assert theirs.facts["remark"].startswith("missing: /no/such/python, which WARP_LCP_NEWTON_PYTHON names, does not import newton")
    assert ours.value("runout") > 0.05  # the column has spread
    assert ours.value("height") < 0.25
    assert "| newton's step (dense grid) over ours | >= 1 x | not measured here |  |" in (tmp_path / "implicit_mpm.md").read_text()


@pytest.mark.slow
@pytest.mark.skipif(NEWTON.interpreter() is None, reason="no interpreter imports newton")
def test_newton_computes_the_same_collapse(tmp_path):
    Suite("sand", "", groups={"implicit_mpm": ""}).run(device="cpu", out=tmp_path, sizes=(32,), repeat=1, group="implicit_mpm")
    records = read_json(tmp_path / "implicit_mpm.json")
    ours = records["32 cells: warp_lcp"]
    for name in ("32 cells: newton, defaults", "32 cells: newton, dense grid"):
        assert records[name].value("runout") == pytest.approx(ours.value("runout"), rel=0.1)
        assert records[name].value("height") == pytest.approx(ours.value("height"), rel=0.1)


def test_chart_takes_the_largest_size_with_peers(tmp_path):
    taken = [(32, "PETSc", 0.1), (64, "PETSc", 0.8), (64, "ProjectedMultigrid", 0.02), (128, "ProjectedMultigrid", 0.1)]
    records = [
        Record(f"{n}^3 {bounds} {method}", {"total": Figure(seconds, "s")}, {"n": n, "bounds": bounds, "method": method})
        for n, method, seconds in taken
        for bounds in chart.TITLES
    ]
    assert chart.bars(records, "walls") == (64, {"ProjectedMultigrid": 0.02, "PETSc": 0.8})
    write_json(tmp_path / "peers.json", records)
    chart.main([str(tmp_path / "peers.json"), str(tmp_path / "chart.png")])
    assert (tmp_path / "chart.png").read_bytes().startswith(b"\x89PNG")
    write_json(tmp_path / "peers.json", [r for r in records if r.facts["method"] != "PETSc"])
    with pytest.raises(SystemExit, match="no peer was measured on the problem linear"):
        chart.main([str(tmp_path / "peers.json"), str(tmp_path / "chart.png")])
