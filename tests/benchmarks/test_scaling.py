"""Suite `scaling`: sizes that fit, growth, and the accuracy of each precision."""

import json

import numpy as np
import pytest
import scipy.sparse.linalg

import warp_lcp as wl
from command_line import forked_suites, invoke
from warp_lcp.benchmarks import scaling
from warp_lcp.benchmarks.harness.record import BenchmarkRecord
from warp_lcp.benchmarks.harness.timing import Figure
from warp_lcp.benchmarks.problems import BOUNDS, natural, splash

pytestmark = pytest.mark.usefixtures("only_new_objects")


def test_exponent_is_that_of_a_power_law():
    unknowns = np.array([64.0, 128.0, 256.0]) ** 3
    assert scaling.exponent(unknowns, 3e-8 * unknowns**1.37) == pytest.approx(1.37)


def test_sizes_stop_where_memory_ends(monkeypatch):
    free = {"cuda:0": 100 * 64**3, "cpu": 1 << 40}
    monkeypatch.setattr(scaling, "free_memory", free.get)
    sizes, left_out = scaling.fitting([32, 64, 128], "cuda:0")
    assert sizes == [32, 64]
    assert left_out == {128: "128^3 needs about 0.1 GiB on cuda:0, where 0.0 GiB are free"}
    free |= {"cuda:0": 1 << 50, "cpu": 100 * 64**3}
    # The scene is made in host memory.
    assert scaling.fitting([32, 64, 128], "cuda:0")[0] == [32, 64]
    # On the CPU its memory holds scene and solve.
    assert scaling.fitting([32, 64], "cpu")[0] == [32]
    monkeypatch.setattr(scaling, "free_memory", lambda device: None)
    assert scaling.fitting([1024], "cpu") == ([1024], {})


@pytest.fixture(scope="module")
def two_sizes(tmp_path_factory):
    """Folder and records of the suite on grids of 16^3 and 32^3 cells."""
    folder = tmp_path_factory.mktemp("scaling")
    return folder, measured(folder, "--size", 16, "--size", 32)


def test_estimate_of_memory_bounds_what_a_solve_takes(two_sizes):
    _, records = two_sizes
    most = max(
        r["figures"]["bytes_per_cell"]["value"]
        for r in records.values()
        if "bytes_per_cell" in r["figures"] and r["name"].startswith("32^3")
    )
    assert 30 < most < scaling.SOLVE_BYTES


def measured(tmp_path, *options):
    arguments = ["bench", "scaling", "--device", "cpu", "--out", tmp_path, "--repeat", 2, *options]
    with forked_suites():
        result = invoke(*arguments)
    assert result.exit_code == 0, result.stderr
    assert f"{tmp_path / 'scaling.json'}" in result.stdout
    return {
        r["name"]: r
        for r in json.loads((tmp_path / "scaling.json").read_text())
        if r["name"] != "machine"
    }


def test_scaling(two_sizes):
    folder, records = two_sizes
    for name in ("16^3 linear", "32^3 walls", "32^3 everywhere"):
        figures = {k: f["value"] for k, f in records[name]["figures"].items()}
        assert figures["setup"] < figures["to_1e-04"] <= figures["to_1e-06"] <= figures["to_1e-08"]
        assert (
            figures["iterations_to_1e-04"]
            < figures["iterations_to_1e-06"]
            < figures["iterations_to_1e-08"]
            <= 12
        )
        assert figures["converged"] == 1
        assert figures["residual"] <= 1e-8
        assert {"bytes_per_cell", "per_cell", "in_copies"} <= figures.keys()
    growth = records["growth linear"]
    assert (growth["from"], growth["to"]) == (16, 32)
    assert growth["figures"]["exponent_to_1e-06"]["samples"] == 2
    text = (folder / "scaling.md").read_text()
    # Too small to be judged.
    assert (
        "| exponent of the seconds to 1e-6, linear, 16^3 to 32^3 | <= 1.05 | not measured here |  |"
        in text
    )
    assert "| mixed precision: largest floor of any grid | <= 1e-08 |" in text
    assert {path.name for path in folder.glob("*.png")} == {
        "scaling-seconds.png",
        "scaling-floors.png",
    }


def floors(n):
    return {
        r.facts["precision"]: r
        for r in (scaling.floor(splash(n), "walls", p, "cpu") for p in scaling.PRECISIONS)
    }


def test_floors_grow_with_the_grid_and_shrink_with_the_precision():
    small, large = floors(16), floors(48)
    for found in (small, large):
        single, mixed, double = (r.value("floor") for r in found.values())
        assert single > 10 * scaling.REACHED
        assert mixed < 1e-3 * scaling.REACHED
        assert mixed == pytest.approx(double, rel=1.0)
        assert {r.facts["status"] for r in found.values()} <= {"FLOOR", "STAGNATED"}
    assert large["single"].value("floor") > 2.0 * small["single"].value("floor")
    assert not scaling._failures([*small.values(), *large.values()])


def test_a_wrongly_reported_residual_is_a_failure():
    ended = BenchmarkRecord(
        "floor 16^3 walls mixed",
        {"floor": Figure(1e-7), "told": Figure(1e-15)},
        {"precision": "mixed"},
    )
    lines = [
        "floor 16^3 walls mixed: ends at 1.00e-07",
        "floor 16^3 walls mixed: the solve tells 1.00e-15, x has 1.00e-07",
    ]
    assert scaling._failures([ended]) == lines


@pytest.mark.parametrize("bounds", BOUNDS)
def test_the_residual_is_that_of_the_matrix(bounds):
    scene = splash(12)
    fluid = scene.cells == wl.FLUID

    def norm(x, bounds=bounds):
        return np.linalg.norm(natural(scene.cells, scene.b, scene.lower(bounds), x))

    x = np.random.default_rng(271).standard_normal(scene.cells.shape)
    lower = np.broadcast_to(scene.lower(bounds), x.shape)
    y = scene.matrix() @ x[fluid] + scene.b[fluid]
    assert norm(x) == pytest.approx(
        np.linalg.norm(np.minimum(x[fluid] - lower[fluid], y)), rel=1e-12
    )
    solved = np.zeros(x.shape)
    solved[fluid] = scipy.sparse.linalg.spsolve(scene.matrix().tocsc(), -scene.b[fluid])
    # A wrong sign is detected.
    assert norm(solved, "linear") < 1e-12 * norm(0.0 * x, "linear") < norm(-solved, "linear")
