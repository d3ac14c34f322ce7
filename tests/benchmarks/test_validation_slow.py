"""Every check of the suite `validation`, as `warp-lcp bench validation` runs it."""

import pytest

from benchmarks.validation import CHECKS

# single particles that leave a free surface under tilted gravity run down above it; all but 1 % stay below 4 % of sqrt(g dx)
UNMET = {"rest": pytest.mark.xfail(strict=True, reason="the tilted free surface exceeds 10 % of sqrt(g dx)")}


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(name, marks=UNMET.get(name, ())) for name in CHECKS])
def test_a_check_holds_and_its_controls_fail(name: str) -> None:
    trials, charts = CHECKS[name].check("cpu")
    assert len(trials) >= 2
    assert [line for trial in trials for line in trial.failures()] == []
    assert any(finding.control for trial in trials for finding in trial.findings)
    assert all(chart.curves for chart in charts)
