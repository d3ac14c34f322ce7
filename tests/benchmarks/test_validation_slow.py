"""Every check of the suite `validation`, as `warp-lcp bench validation` runs it."""

import pytest

from benchmarks.validation import CHECKS


@pytest.mark.slow
@pytest.mark.parametrize("name", CHECKS)
def test_a_check_holds_and_its_controls_fail(name: str) -> None:
    trials, charts = CHECKS[name].check("cpu")
    assert len(trials) >= 2
    assert [line for trial in trials for line in trial.failures()] == []
    assert any(finding.control for trial in trials for finding in trial.findings)
    assert all(chart.curves for chart in charts)
