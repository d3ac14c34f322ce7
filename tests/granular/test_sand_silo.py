"""Small silos of sand at rest.

Other widths, 3-D, lids and negative controls are in the suite `validation`.
"""

import math

import numpy as np
import pytest

from warp_lcp.benchmarks.validation import sand_silo
from warp_lcp.benchmarks.validation.scenes import create_sand

SHORT = 0.125  # [s] at rest after the first steps


def test_janssens_law_is_the_weight_above_without_friction_and_saturates_with_it() -> None:
    assert sand_silo.janssen(3.0, 0.0, 0.5) == 3.0
    assert sand_silo.janssen(1e-3, 0.5, 0.5) == pytest.approx(1e-3, rel=1e-3)
    assert sand_silo.janssen(50.0, 0.5, 0.5) == pytest.approx(2.0)
    assert sand_silo.janssen(50.0, 0.5, 0.5, walls=4) == pytest.approx(1.0)


def test_a_narrow_silo_bears_as_janssen_says_with_and_without_short_steps_and_under_a_lid(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sand_silo, "RESTS", SHORT)
    trial = sand_silo.trial(12, frictions=(0.5,), deep=3.25)
    assert trial.failures() == []


def test_a_square_silo_bears_less_than_two_walls() -> None:
    more = {"deep": 2.25, "square": True}
    silo = sand_silo.rest(sand_silo.fill(8, 0.5, **more), 0.05)
    for depth in (1, 2):
        least, most = (
            sand_silo.janssen(depth, 0.5, ratio, walls=4) for ratio in reversed(sand_silo.RATIOS)
        )
        assert 0.9 * least < silo.at(depth) < 1.1 * most
    assert silo.fell < 2e-4


@pytest.mark.parametrize("each", [sand_silo._pack_as_before, sand_silo._close_all_gaps])
def test_sand_that_is_packed_through_its_stresses_misses_the_law(each: sand_silo.Step) -> None:
    silo = sand_silo.rest(sand_silo.fill(12, 0.5, deep=3.25), SHORT, each=each)
    assert silo.fell > 2e-4


@pytest.mark.parametrize(("per_axis", "jitter"), [(1, 0.25), (2, 0.0), (2, 0.5)])
@pytest.mark.parametrize("tilt", [0.0, 12.0])
def test_sand_put_down_stays_where_it_is_however_its_particles_lie(
    per_axis: int, jitter: float, tilt: float
) -> None:
    """Rest of deposited sand, however its particles lie.

    The surface lies between the cells' faces. With one particle per cell, fractions scatter by 6 %,
    and gaps used to close by falling.
    """
    angle, height = math.radians(tilt), 0.1347
    gravity = {"gravity": [9.81 * math.sin(angle), -9.81 * math.cos(angle)]}
    particles = {"per_axis": per_axis, "jitter": jitter, "seed": 23}
    box = {"shape": "box", "min": [0.0, 0.0], "max": [0.16, height]}
    simulation = create_sand(
        [0.16, 0.2], 20, [box], walls=0.5, physics=gravity, particles=particles
    )
    start, weight = (
        simulation.particles.position.numpy().mean(axis=0),
        1600.0 * 9.81 * 0.16 * height**2,
    )
    energy = [simulation.step(5e-3)["kinetic_energy"] for _ in range(12)]
    assert np.abs(simulation.particles.position.numpy().mean(axis=0) - start).max() < 2e-4 * height
    assert max(energy) < 1e-4 * weight
