"""Sand on slopes, whose angles of rest and accelerations are known; all angles and resolutions are in the suite `validation`."""

import pytest

from benchmarks.validation import inclined


def test_a_layer_rests_and_runs_as_its_friction_angle_says_and_the_box_does_not() -> None:
    trial = inclined.layer(16, angles=(27.5, 35.0))
    assert trial.failures() == []
    assert trial.findings[-1].control


def test_a_stiff_slab_rests_and_slides_as_the_walls_friction_says() -> None:
    trial = inclined.slab(16, angles=(26.8,))
    assert trial.failures() == []


def test_the_uppermost_row_presses_on_what_it_lies_on() -> None:
    """Were half of the sand above the last full row weightless, the slab would gain speed 1.5 times too fast."""
    smooth = {"material": {"friction_angle": inclined.STIFF}, "floor": inclined.SMOOTH}
    assert inclined.runs(16, 26.8, speed=0.0, **smooth) == pytest.approx(inclined.accelerates(26.8), rel=0.02)


def test_a_layer_that_runs_comes_to_rest_where_it_should() -> None:
    """Below the angle it loses speed as fast as friction exceeds gravity; the lowest row, which the floor holds, takes no part."""
    slower = inclined.runs(16, 22.0)
    assert slower == pytest.approx(inclined.accelerates(22.0), rel=0.06 + 1 / 16)
    assert slower < -0.8
