"""Sand on slopes with known angles of rest and accelerations.

All angles and resolutions are in the suite `validation`.
"""

import pytest

from default_run import slow
from warp_lcp.benchmarks.validation import inclined


def test_the_cone_slides_at_the_friction_angle_and_the_box_does_not() -> None:
    trial = inclined.layer(16, angles=(27.5,))
    assert trial.failures() == []
    assert trial.findings[-1].control


@pytest.mark.parametrize("cells", [6, slow(12)])
def test_a_stiff_slab_rests_and_slides_as_the_walls_friction_says(cells: int) -> None:
    """Rest and sliding of a stiff slab by the wall friction.

    If half of the sand above the last full row were weightless, the acceleration would be more than
    1.5 times too large.
    """
    trial = inclined.slab(cells, angles=(26.8,))
    assert trial.failures() == []
    assert trial.findings[1].what == "26.8 degrees: acceleration over expected"
    assert trial.findings[1].value == pytest.approx(1.0, rel=0.02)


def test_a_layer_that_runs_comes_to_rest_where_it_should() -> None:
    """Rest of a running layer below the angle.

    Its deceleration is friction less gravity, equal in all rows.
    """
    slower = inclined.runs(16, 22.0)
    assert slower == pytest.approx(inclined.accelerates(22.0), rel=0.01)
    assert slower < -0.8


@pytest.mark.parametrize(("azimuth", "slope"), [(0.0, 22.0), (37.0, 30.0)])
def test_a_layer_in_3d_runs_as_the_sand_s_friction_says(azimuth: float, slope: float) -> None:
    """Acceleration of a running layer in 3-D, along an axis of the grid and obliquely to it."""
    assert inclined.runs_obliquely(8, slope, azimuth) == pytest.approx(
        inclined.accelerates(slope), abs=1e-3 * inclined.GRAVITY
    )
