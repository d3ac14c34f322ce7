"""Losses against peers, and the program for machines with a CUDA device."""

import pytest

from warp_lcp.benchmarks import gpu, guard
from warp_lcp.benchmarks.compare import comparison, losses
from warp_lcp.benchmarks.record import Record, read_json, write_json
from warp_lcp.benchmarks.suite import ONE_THREAD, Suite
from warp_lcp.benchmarks.timing import Figure

WIDE = 2.0  # range of the samples of a ratio from which on they tell nothing
TRIES = 3


def result(*samples, figure="pyamg_over_this"):
    return {"64^3": Record("64^3", {figure: Figure.of(samples), "total": Figure(1.0 / samples[0], "s")})}


@pytest.mark.parametrize(
    ("old", "new", "lost"),
    [
        ([30.0, 31.0, 32.0], [15.0, 16.0, 17.0], True),
        ([30.0, 31.0, 32.0], [24.0, 24.5, 25.0], False),  # 20 to 25 % less at the most
        ([30.0, 31.0, 32.0], [15.0, 16.0, 29.0], False),  # one sample is as it was: noise
        ([30.0, 31.0, 32.0], [60.0, 61.0, 62.0], False),  # a gain
    ],
)
def test_a_loss_is_one_that_noise_does_not_explain(old, new, lost):
    for figure in ("pyamg_over_this", "over_engine", "over Numba product"):
        assert bool(losses(result(*old, figure=figure), result(*new, figure=figure))) == lost
    assert not losses(result(*old, figure="seconds"), result(*new, figure="seconds"))  # seconds are not judged


def test_comparison_names_losses(tmp_path):
    a, b = tmp_path / "a.json", tmp_path / "b.json"
    write_json(a, list(result(30.0, 31.0).values()))
    write_json(b, list(result(15.0, 15.5).values()))
    lost = "lost against a peer: 64^3: pyamg_over_this 30.5 (30 to 31) fell to 15.25 (15 to 15.5), to [0.48, 0.52] of it"
    assert lost in comparison(a, b).splitlines()
    assert "no ratio to a peer fell by more than 25 % beyond noise" in comparison(b, a).splitlines()


def test_without_a_cuda_device_nothing_is_measured(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(gpu.wp, "is_cuda_available", lambda: False)
    with pytest.raises(SystemExit) as ended:
        gpu.main(["--out", str(tmp_path / "gpu")])
    assert ended.value.code == 2
    assert "cuda:0: no such CUDA device; Warp sees cpu" in capsys.readouterr().err
    assert not (tmp_path / "gpu").exists()


def test_agreement_of_devices():
    parts = gpu.agreement("cpu", 12)
    assert len(parts) == 12
    assert all(not part.ended and "apart 0.0e+00" in part.found for part in parts)  # the CPU repeats itself bit for bit


def test_disagreement_of_devices_is_found(monkeypatch):
    real, count = gpu.wl.solve, []

    def solve(problem, *arguments, **options):
        result = real(problem, *arguments, **options)
        count.append(result)
        if len(count) % 2 == 0:
            result.x.fill_(0.0)
        return result

    monkeypatch.setattr(gpu.wl, "solve", solve)
    assert {part.ended for part in gpu.agreement("cpu", 8)} == {"the devices disagree"}


@pytest.mark.slow
def test_rehearsal_of_the_device_program(tmp_path):
    with pytest.raises(SystemExit) as ended:
        gpu.main(["--out", str(tmp_path), "--rehearse", "--size", "16", "--repeat", "1"])
    text = (tmp_path / "gpu.md").read_text()
    assert ended.value.code == 0, text
    for part in ("suite kernels on cpu", "suite solvers on cpu", "suite scaling on cpu", "suite run on cpu", "side by side"):
        assert part in text
    assert (tmp_path / "side-by-side.md").is_file()


@pytest.mark.slow
def test_nothing_is_lost_against_peers(tmp_path):
    assert ONE_THREAD["OPENBLAS_NUM_THREADS"] == "1"
    kept = guard.kept("solvers")
    if kept is None:
        pytest.skip("no results of this processor are kept")
    for turn in range(TRIES):
        Suite("guard", "").run(device="cpu", out=tmp_path / str(turn), repeat=7)
        new = read_json(tmp_path / str(turn) / "guard.json")
        ratios = [r.figures["pyamg_over_this"] for r in new.values() if "pyamg_over_this" in r.figures]
        assert len(ratios) == 3
        assert losses(kept, new) == []
        if all(f.high < WIDE * f.low for f in ratios):
            return
    pytest.skip("this machine is too noisy to tell")
