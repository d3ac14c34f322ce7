"""Every check of the suite `validation`, as `warp-lcp bench validation` runs it."""

import pytest

from benchmarks.validation import CHECKS

# single particles that leave a free surface under tilted gravity run down above it; all but 1 % stay below 4 % of sqrt(g dx)
UNMET = {
    "rest": pytest.mark.xfail(strict=True, reason="the tilted free surface exceeds 10 % of sqrt(g dx)"),
    "sand collapse": pytest.mark.xfail(reason="3-D runs out 2 % too little; 11 % of the steps miss 1e-3 at a = 4, 40 cells"),
    "sand hourglass": pytest.mark.xfail(strict=True, reason="stresses in deep sand that yields everywhere are 2e-3 rho g dx, not 1e-3"),
    "sand invariants": pytest.mark.xfail(reason="single steps at 40 cells leave a cell at 1.11 of the densest"),
    "sand rest": pytest.mark.xfail(reason="the surface slides a little for a second or two after the stop"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(name, marks=UNMET.get(name, ())) for name in CHECKS])
def test_a_check_holds_and_its_controls_fail(name: str) -> None:
    trials, charts = CHECKS[name].check("cpu")
    assert len(trials) >= 2
    assert [line for trial in trials for line in trial.failures()] == []
    assert any(finding.control for trial in trials for finding in trial.findings)
    assert all(chart.curves for chart in charts)
