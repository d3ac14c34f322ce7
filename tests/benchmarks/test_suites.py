"""The suites through the command line, at sizes that take seconds."""

import json
import re
from pathlib import Path

import pytest

from command_line import forked_suites, invoke
from warp_lcp.cli.suites import benchmarks

pytestmark = pytest.mark.usefixtures("only_new_objects")


def measured(tmp_path, suite, *options):
    words = ("bench", suite, "--device", "cpu", "--out", tmp_path, "--repeat", 1, *options)
    with forked_suites():
        result = invoke(*words)
    assert result.exit_code == 0, result.stderr
    assert f"{tmp_path / suite}.json" in result.stdout
    assert (tmp_path / f"{suite}.md").read_text().startswith("# ")
    assert list(tmp_path.glob(f"{suite}-*.png"))
    records = {r["name"]: r for r in json.loads((tmp_path / f"{suite}.json").read_text())}
    machine = records.pop("machine")
    assert machine["hardware"]["cpu"]
    assert machine["versions"]["warp-lang"]
    assert machine["peers"]["pyamg"]
    assert machine["date"]
    assert machine["figures"]["copy"]["value"] > 0
    assert all(figure["value"] >= 0 for r in records.values() for figure in r["figures"].values())
    return records


def test_suites_are_installed():
    assert {"kernels", "run", "sand", "solvers", "validation"} <= benchmarks().keys()
    assert all(
        suite.name == name and suite.summary and "minutes" in suite.takes
        for name, suite in benchmarks().items()
    )


def test_the_page_lists_the_cost_of_each_suite():
    page = (Path(__file__).parents[2] / "docs" / "benchmarks.md").read_text()
    assert all(
        re.search(rf"^\| `{name}` \| .* \| {suite.takes} \|$", page, flags=re.M)
        for name, suite in benchmarks().items()
    )


def test_kernels(tmp_path):
    records = measured(tmp_path, "kernels", "--size", 8)
    hot = [r for r in records.values() if r["role"] == "hot"]
    assert len(hot) > 15
    product = records["8^3 unit: stencil.product, float32"]
    assert (product["reads"], product["writes"]) == (["d", "x"], ["y"])
    assert product["figures"]["bytes_per_cell"]["value"] == 9
    faces = records["8^3 faces: stencil.product, float32"]
    assert faces["figures"]["bytes_per_cell"]["value"] == 24
    assert {"rate", "bandwidth", "of_copy", "over Warp, one thread a cell"} <= product[
        "figures"
    ].keys()


@pytest.mark.slow
def test_solvers(tmp_path):
    records = measured(tmp_path, "solvers", "--size", 16)
    case = records["16^3 unit walls ProjectedMultigrid"]["figures"]
    expected = {
        "setup",
        "solve",
        "total",
        "reuse",
        "warm",
        "iterations",
        "to_1e-04",
        "to_1e-06",
        "to_1e-08",
        "bytes_per_cell",
    }
    assert expected <= case.keys()
    assert case["converged"]["value"] == 1
    assert case["residual"]["value"] <= 1e-6
    assert records["16^3 unit linear PyAMG SA-CG"]["figures"]["residual"]["value"] <= 2e-6
    assert "16^3 arrays 1:100 walls ProjectedMultigrid" in records
    assert (
        records["definite 100: minimum-map-newton"]["status"]
        == records["fluid 12^3: psor"]["status"]
        == "CONVERGED"
    )
    # The method needs symmetric matrices.
    assert "contacts of 12 bodies: incremental-pivoting" not in records
    again = invoke(
        "bench", "solvers", "--compare", tmp_path / "solvers.json", tmp_path / "solvers.json"
    )
    assert again.exit_code == 0
    assert "[1.000, 1.000]    within noise" in again.stdout


@pytest.mark.slow
def test_devices(tmp_path):
    records = measured(tmp_path, "devices", "--size", 16)
    assert records["16^3: ProjectedMultigrid"]["status"] == "CONVERGED"
    names = {
        "16^3: a sweep of PGS",
        "16^3: product",
        "a step of dam-break, 16 cells",
        "a step of column-collapse, 16 cells",
    }
    assert names <= records.keys()
    assert all(records[name]["figures"]["seconds"]["value"] > 0 for name in names)


def test_kept_machines_can_be_compared():
    results = Path(__file__).parents[2] / "benchmarks" / "results"
    cpu, gpu = (results / name / "devices.json" for name in ("amd-epyc", "nvidia-h200"))
    compared = invoke("bench", "devices", "--compare", cpu, gpu)
    assert compared.exit_code == 0, compared.stderr
    assert "128^3: ProjectedMultigrid" in compared.stdout


@pytest.mark.slow
def test_run(tmp_path):
    records = measured(tmp_path, "run", "--size", 16)
    scene = records["dam-break"]["figures"]
    assert scene["steps"]["value"] > 3
    assert sum(
        figure["value"] for name, figure in scene.items() if name.startswith("share")
    ) == pytest.approx(1)
    assert records["particles, 3-D"]["figures"]["round_trip"]["value"] > 0
    assert records["dam-break, 3-D: walls"]["figures"]["solve_over_linear"]["value"] > 0


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["kernals"], "did you mean 'kernels'?"),
        (["kernels", "--device", "cuda:77"], "--device cuda:77: there is no such device"),
        (["kernels", "--size", "4"], "size = 4: must be >= 8"),
        (["validation", "--size", "16"], "size = 16: cannot be given for the suite validation"),
        (["kernels", "--repeat", "0"], "--repeat"),
        (["kernels", "--compare", "a.json"], "--compare"),
        (["kernels", "--compare", "a.json", "b.json"], "a.json: no results of a benchmark"),
        ([], "SUITE"),
    ],
)
def test_wrong_input_exits_with_2(arguments, expected):
    result = invoke("bench", *arguments)
    assert result.exit_code == 2
    assert expected in result.stderr


def test_a_suite_that_fails_exits_with_1(tmp_path):
    result = invoke("bench", "scaling", "--size", 1_000_000, "--out", tmp_path)
    assert result.exit_code == 1
    assert "the suite scaling ended with exit code 1" in result.stderr
