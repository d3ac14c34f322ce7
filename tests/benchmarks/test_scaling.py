"""The suite `scaling`: what fits, what grows how, and two devices beside each other."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from warp_lcp.benchmarks import scaling, side_by_side
from warp_lcp.benchmarks.compare import comparison
from warp_lcp.benchmarks.record import Record, write_json
from warp_lcp.benchmarks.side_by_side import side_by_side as beside
from warp_lcp.benchmarks.timing import Figure
from warp_lcp.cli import commands as cli


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
    assert scaling.fitting([32, 64, 128], "cuda:0")[0] == [32, 64]  # the scene is made in the host's memory
    assert scaling.fitting([32, 64], "cpu")[0] == [32]  # which holds both, on the CPU
    monkeypatch.setattr(scaling, "free_memory", lambda device: None)
    assert scaling.fitting([1024], "cpu") == ([1024], {})


def test_estimate_of_memory_bounds_what_a_solve_takes(tmp_path):
    records = measured(tmp_path, "--size", 48)
    most = max(r["figures"]["bytes_per_cell"]["value"] for r in records.values() if "^3" in r["name"])
    assert 30 < most < scaling.SOLVE_BYTES


def measured(tmp_path, *options):
    arguments = ["bench", "scaling", "--device", "cpu", "--out", tmp_path, "--repeat", 2, *options]
    result = CliRunner().invoke(cli.app, [str(a) for a in arguments])
    assert result.exit_code == 0, result.stderr
    assert f"{tmp_path / 'scaling.json'}" in result.stdout
    return {r["name"]: r for r in json.loads((tmp_path / "scaling.json").read_text()) if r["name"] != "machine"}


def test_scaling(tmp_path):
    records = measured(tmp_path, "--size", 16, "--size", 24)
    for name in ("16^3 linear", "24^3 walls", "24^3 everywhere"):
        figures = {k: f["value"] for k, f in records[name]["figures"].items()}
        assert figures["setup"] < figures["to_1e-04"] <= figures["to_1e-06"] <= figures["to_1e-08"]
        assert figures["iterations_to_1e-04"] < figures["iterations_to_1e-06"] < figures["iterations_to_1e-08"] <= 12
        assert figures["converged"] == 1
        assert figures["residual"] <= 1e-8
        assert {"bytes_per_cell", "per_cell", "in_copies"} <= figures.keys()
    growth = records["growth linear"]
    assert (growth["from"], growth["to"]) == (16, 24)
    assert growth["figures"]["exponent_to_1e-06"]["samples"] == 2
    text = (tmp_path / "scaling.md").read_text()
    assert "| exponent of the seconds to 1e-6, linear, 16^3 to 24^3 | <= 1.05 | not measured here |  |" in text  # too small to be judged
    assert (tmp_path / "scaling-seconds.png").is_file()


def result(copy, seconds, device="cpu"):
    machine = Record("machine", {"copy": Figure(copy, "GB/s")}, {"hardware": {"cpu": "Z80", "device": device}})
    return {"machine": machine, "64^3 linear": Record("64^3 linear", {"to_1e-06": Figure.of(seconds, "s")})}


def test_side_by_side_is_limited_by_copying():
    table = beside(result(10.0, [1.0, 1.0, 1.0]), result(100.0, [0.1, 0.2, 0.4], "cuda:0 a card"))
    assert table.rows == [["64^3 linear", "to_1e-06", "1000.00", "200.00", "5.00 (2.50 to 10.00)", "50 %"]]
    assert "A: cpu Z80, copying 10 GB/s" in table.remark
    assert "B copies memory 10.00 times as fast" in table.remark


def test_side_by_side_refuses_what_it_cannot_compare():
    other = result(10.0, [1.0])
    other["machine"] = Record("machine")
    with pytest.raises(ValueError, match="no copy bandwidth"):
        beside(other, result(10.0, [1.0]))
    with pytest.raises(ValueError, match="no time in common"):
        beside({"machine": result(1.0, [1.0])["machine"]}, result(10.0, [1.0]))


def test_side_by_side_of_files(tmp_path):
    a, b = tmp_path / "a.json", tmp_path / "b.json"
    write_json(a, list(result(10.0, [1.0]).values()))
    write_json(b, list(result(20.0, [0.5], "cuda:0 a card").values()))
    side_by_side.main([str(a), str(b), "--out", str(tmp_path)])
    assert "| 64^3 linear | to_1e-06 | 1000.00 | 500.00 | 2.00 (2.00 to 2.00) | 100 % |" in (tmp_path / "side-by-side.md").read_text()
    assert "of what copying gains" in comparison(a, b)  # of different devices
    assert "of what copying gains" not in comparison(a, a)
    b.write_text("{")
    with pytest.raises(SystemExit, match="no results of a benchmark"):
        side_by_side.main([str(a), str(b), "--out", str(tmp_path)])
