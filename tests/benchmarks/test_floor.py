"""The floors of the precisions, and the residual that judges them."""

import json

import numpy as np
import pytest
import scipy.sparse.linalg
from typer.testing import CliRunner

import warp_lcp as wl
from warp_lcp.benchmarks import floor
from warp_lcp.benchmarks.problems import splash
from warp_lcp.cli import commands as cli


@pytest.mark.parametrize("bounds", floor.BOUNDS)
def test_the_residual_is_that_of_the_matrix(bounds):
    scene = splash(12)
    fluid = scene.cells == wl.FLUID
    x = np.random.default_rng(271).standard_normal(scene.cells.shape)
    lower = np.broadcast_to(scene.lower(bounds), x.shape)
    y = scene.matrix() @ x[fluid] + scene.b[fluid]
    expected = np.linalg.norm(np.minimum(x[fluid] - lower[fluid], y))
    assert floor.residual(scene, bounds, x) == pytest.approx(expected, rel=1e-12)
    solved = np.zeros(x.shape)
    solved[fluid] = scipy.sparse.linalg.spsolve(scene.matrix().tocsc(), -scene.b[fluid])
    assert floor.residual(scene, "linear", solved) < 1e-12 * floor.residual(scene, "linear", 0.0 * x)
    assert floor.residual(scene, "linear", -solved) > floor.residual(scene, "linear", 0.0 * x)  # a wrong sign is seen


def test_floors_grow_with_the_grid_and_shrink_with_the_precision(tmp_path):
    arguments = ["bench", "scaling", "--group", "floor", "--device", "cpu", "--out", str(tmp_path), "--repeat", "1"]
    result = CliRunner().invoke(cli.app, [*arguments, "--size", "16", "--size", "48"])
    assert result.exit_code == 0, result.stderr
    records = {r["name"]: r for r in json.loads((tmp_path / "floor.json").read_text()) if r["name"] != "machine"}
    assert len(records) == 12
    found = {name: r["figures"]["floor"]["value"] for name, r in records.items()}
    for bounds in floor.BOUNDS:
        for n in (16, 48):
            single, mixed, double = (found[f"{n}^3 {bounds} {precision}"] for precision in floor.PRECISIONS)
            assert single > 10 * floor.ASKED
            assert mixed < 1e-3 * floor.ASKED
            assert mixed == pytest.approx(double, rel=1.0)
        assert found[f"48^3 {bounds} single"] > 2.0 * found[f"16^3 {bounds} single"]
    assert {r["status"] for r in records.values()} <= {"FLOOR", "STAGNATED"}
    text = (tmp_path / "floor.md").read_text()
    assert "| mixed precision, walls: largest floor of any grid | <= 1e-08 |" in text
    assert (tmp_path / "floor-sizes.png").is_file()
    assert (tmp_path / "floor-history.png").is_file()


def test_a_solve_that_tells_another_residual_is_a_failure():
    ended = floor.Floor(16, "walls", "mixed", 1e-7, 1e-15, wl.SolveStatus.FLOOR, 20, 0.1)
    assert floor._failures([ended]) == [
        "16^3, walls: mixed precision ends at 1.00e-07",
        "16^3, walls, mixed: the solve tells 1.00e-15, x has 1.00e-07",
    ]


@pytest.mark.slow
def test_mixed_precision_reaches_what_single_does_not_on_large_grids():
    scene = splash(192)
    single, mixed = (floor.reach(scene, "walls", precision, "cpu") for precision in ("single", "mixed"))
    assert mixed.relative < 1e-12
    assert single.relative > 1e-6
