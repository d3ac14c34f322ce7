"""Losses of ratios to peers between two results."""

import pytest

from warp_lcp.benchmarks.harness.compare import comparison, losses
from warp_lcp.benchmarks.harness.record import BenchmarkRecord, write_json
from warp_lcp.benchmarks.harness.timing import Figure


def result(*samples, figure="pyamg_over_this"):
    return {
        "64^3": BenchmarkRecord(
            "64^3", {figure: Figure.of(samples), "total": Figure(1.0 / samples[0], "s")}
        )
    }


@pytest.mark.parametrize(
    ("old", "new", "lost"),
    [
        ([30.0, 31.0, 32.0], [15.0, 16.0, 17.0], True),
        ([30.0, 31.0, 32.0], [24.0, 24.5, 25.0], False),  # a loss of at most 20 to 25 %
        ([30.0, 31.0, 32.0], [15.0, 16.0, 29.0], False),  # one sample is unchanged: noise
        ([30.0, 31.0, 32.0], [60.0, 61.0, 62.0], False),  # a gain
    ],
)
def test_a_loss_is_one_that_noise_does_not_explain(old, new, lost):
    for figure in ("pyamg_over_this", "over_engine", "over Numba product"):
        assert bool(losses(result(*old, figure=figure), result(*new, figure=figure))) == lost
    # Seconds are not judged.
    assert not losses(result(*old, figure="seconds"), result(*new, figure="seconds"))


def test_comparison_names_losses(tmp_path):
    a, b = tmp_path / "a.json", tmp_path / "b.json"
    write_json(a, list(result(30.0, 31.0).values()))
    write_json(b, list(result(15.0, 15.5).values()))
    lost = (
        "lost against a peer: 64^3: pyamg_over_this 30.5 (30 to 31) fell to 15.25 (15 to 15.5), "
        "to [0.48, 0.52] of it"
    )
    assert lost in comparison(a, b).splitlines()
    assert "no ratio to a peer fell by more than 25 % beyond noise" in comparison(b, a).splitlines()
