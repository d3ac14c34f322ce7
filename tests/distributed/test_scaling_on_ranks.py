"""`warp-lcp bench scaling --engine petsc`: figures of ranks, and their tables."""

import json
import re

import pytest
from typer.testing import CliRunner

from warp_lcp.benchmarks import ranks
from warp_lcp.benchmarks.harness.record import BenchmarkRecord
from warp_lcp.benchmarks.harness.timing import Figure, Options
from warp_lcp.cli import commands as cli

MAIN = "import sys; from warp_lcp.cli.commands import main; main()"


def records(file):
    return {
        r["name"]: {**r, **{k: f["value"] for k, f in r["figures"].items()}}
        for r in json.loads(file.read_text())
    }


def test_ranks_measure_what_one_process_does(mpi, tmp_path):
    done = mpi(
        2,
        "-c",
        MAIN,
        "bench",
        "scaling",
        "--engine",
        "petsc",
        "--size",
        16,
        "--repeat",
        1,
        "--out",
        tmp_path,
    )
    assert done.stdout.split() == [str(tmp_path / "ranks.json"), str(tmp_path / "ranks.md")]
    found = records(tmp_path / "ranks.json")
    for bounds in ("linear", "walls", "everywhere"):
        record = found[f"16^3 {bounds}, ranks: 2"]
        assert record["converged"] == 1
        assert record["residual"] <= 1e-8  # computed independently of the solve
        assert record["residual"] == pytest.approx(record["told"], rel=1e-3)
        assert abs(record["iterations_to_1e-06"] - record["single_iterations"]) <= 1
        assert record["setup"] < record["to_1e-04"] <= record["to_1e-06"] <= record["to_1e-08"]
        assert record["boxes"] in ("1 x 1 x 2", "1 x 2 x 1", "2 x 1 x 1")
        assert 0.0 <= record["resident_more"] < record["resident"]
    assert "ranks: 2" not in done.stdout
    assert "| 16^3 | walls | 2 |" in (tmp_path / "ranks.md").read_text()


def test_a_wrong_solution_is_seen(mpi):
    text = """
    import warp as wp
    wp.config.log_level = wp.LOG_ERROR
    from warp_lcp.benchmarks import ranks
    from warp_lcp.distributed.ranks import Ranks
    walls = ranks.shared_cases(16, Ranks.world(), "cpu")[1]
    problem, solver, work = walls.build()
    import warp_lcp as wl
    x = wl.solve(problem, solver, stopping=wl.StoppingCriteria(rtol=1e-9), workspace=work).x.numpy()
    right = walls.residual(x)
    x[0, 3, 3] += 0.1 * walls.ranks.rank  # beside the cut, on one rank only
    wrong = walls.residual(x)
    if walls.ranks.is_root:
        print(right < 1e-8, wrong > 1e-3)
    """
    assert mpi(2, text).stdout.split() == ["True", "True"]


def test_the_suite_starts_its_ranks(mpi, tmp_path, monkeypatch):
    monkeypatch.setattr(ranks, "RANKS", (1, 2))
    results = ranks.measure(Options("cpu", (16,), 1, lambda text: None), tmp_path)
    assert not results.failures
    kept = {r.name: r for r in results.records if "boxes" in r.facts}
    assert {r.facts["ranks"] for r in kept.values()} == {1, 2}
    counts = [kept[f"16^3 walls, ranks: {count}"].value("iterations_to_1e-06") for count in (1, 2)]
    assert max(counts) - min(counts) <= 1
    assert [t.title for t in results.tables] == ["Figures to reach", "Ranks and sizes"]
    assert [row[:3] for row in results.tables[1].rows if row[1] == "walls"] == [
        ["16^3", "walls", "1"],
        ["16^3", "walls", "2"],
    ]


@pytest.mark.parametrize("arguments", [["kernels"], ["solvers"]])
def test_other_suites_have_one_process(arguments, tmp_path):
    result = CliRunner().invoke(
        cli.app, ["bench", *arguments, "--engine", "petsc", "--out", str(tmp_path)]
    )
    assert result.exit_code == 2
    assert "measures one process; use scaling" in result.stderr


def measured(n, ranks, seconds, count, memory, over):
    figures = {
        "to_1e-06": seconds,
        "iterations_to_1e-06": count,
        "resident_more": memory,
        "to_1e-06_over_single": over,
    }
    facts = {"n": n, "bounds": "walls", "ranks": ranks, "boxes": "1 x 1 x 1"}
    return BenchmarkRecord("", {name: Figure(value) for name, value in figures.items()}, facts)


def found(records):
    return {(r.facts["n"], r.facts["bounds"], r.facts["ranks"]): r for r in records}


def test_figures_to_reach(monkeypatch):
    monkeypatch.setattr(ranks.os, "cpu_count", lambda: 2)
    records = [
        measured(128, 1, 0.2, 8, 100.0, 1.2),
        measured(128, 2, 0.1, 9, 55.0, 0.7),
        measured(128, 4, 0.3, 10, 30.0, 2.0),
    ]
    table = ranks.targets(found(records), [64, 128])
    assert [row[2:] for row in table.rows] == [
        ["2", "no"],
        ["2", "yes"],
        ["1.2", "yes"],
        ["not measured here", ""],
        ["0.55", "yes"],
    ]
    monkeypatch.setattr(ranks.os, "cpu_count", lambda: 1)
    assert ranks.targets(found(records), [128]).rows[1][2:] == ["not measured here", ""]


def test_memory_and_messages_of_a_liquid_on_a_rank_are_counted(mpi):
    """Count the exchanges of a liquid on ranks.

    Ghost cells of at least 28 bytes of fields, in 5 layers at the one cut, are filled several times
    a step. Solves begin, and multigrid is rebuilt, without Python between exchanges, so that no
    halo of an operator is filled from Python.
    """
    said = mpi(
        2, "-m", "warp_lcp.benchmarks.rank_costs", "dam-break-2d", "domain.resolution=32"
    ).stdout
    found = {
        name: float(value.replace(",", ""))
        for value, name in re.findall(r"^ *([\d,.]+)  (.*)$", said, flags=re.M)
    }
    assert found["cells at cuts"] == 16
    assert found["cells of the box"] < found["cells stored"] < 32 * 16 * 3
    assert found["Subdomain.fill: bytes a step"] > 28 * 5 * found["cells at cuts"]
    assert 8 < found["Ranks.gather: times a step"] <= 12
    # Particles that migrate, and ghosts of a density correction.
    assert found["MpiMailbox.swap: times a step"] <= 2
    assert not {name for name in found if re.match(r"(Halo|GridGather)\.", name)}
