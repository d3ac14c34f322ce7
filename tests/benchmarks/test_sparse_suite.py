"""Suite of sparse matrices: properties of its problems, solutions, PyAMG."""

import numpy as np
import pytest

from warp_lcp.benchmarks import sparse
from warp_lcp.benchmarks.harness.timing import Options
from warp_lcp.benchmarks.sparse_family import FAMILY, numbered_at_random


@pytest.mark.parametrize("kind", FAMILY)
def test_problems_of_a_kind(kind):
    problem = numbered_at_random(kind, 900, 30203)
    A, d = problem.A, problem.A.diagonal()
    assert (d > 0).all()
    assert (abs(A - A.T).max() < 1e-12 * d.max()) == problem.symmetric
    assert np.abs(np.subtract(*A.nonzero())).mean() > 0.2 * A.shape[0]
    if problem.near_null_space is not None:
        products = np.abs(A @ problem.near_null_space).max(axis=1) / d
        assert np.median(products) < 1e-13  # nodes beside the held side differ
    seconds, result = sparse.ours(problem, "cpu")
    assert seconds > 0
    assert result
    x, y = result.x.numpy(), A @ result.x.numpy() + problem.b
    start = np.maximum(problem.lower, 0)
    first = np.linalg.norm(
        d * (start - np.maximum(start - (A @ start + problem.b) / d, problem.lower))
    )
    assert np.linalg.norm(d * (x - np.maximum(x - y / d, problem.lower))) <= 1.01e-6 * first


@pytest.mark.slow
def test_the_suite_compares_with_the_best_of_pyamg(monkeypatch, tmp_path):
    monkeypatch.setattr(sparse, "FAMILY", dict.fromkeys(("triangles", "elastic")))
    results = sparse.measure(Options("cpu", (22,), 1, lambda text: None), tmp_path)
    records = {r.facts["kind"]: r for r in results.records if "kind" in r.facts}
    assert set(records) == {"triangles", "elastic"}
    for record in records.values():
        assert record.facts["status"] == "CONVERGED"
        assert record.value("ratio") == pytest.approx(record.value("ours") / record.value("pyamg"))
    assert records["elastic"].facts["pyamg"].startswith(("smoothed", "rootnode"))
    assert [row[0] for row in results.tables[0].rows] == ["triangles", "elastic"]
