"""Small collapses, hourglasses and piles at rest.

All resolutions and negative controls are in the suite `validation`.
"""

import numpy as np
import pytest

from default_run import slow
from warp_lcp.benchmarks.validation import sand_collapse, sand_hourglass, scenes


def test_the_envelope_is_that_of_the_experiments() -> None:
    """Envelope of the experiments, by numbers of the papers' laws.

    With the other paper's power a = 8 would be off by a third.
    """
    for aspect, low, high in (
        (0.5, 0.6, 0.9),
        (1.0, 1.2, 1.8),
        (2.0, 3.02, 3.6),
        (4.0, 4.79, 5.8),
        (8.0, 7.6, 9.2),
    ):
        assert sand_collapse.lube(aspect) == pytest.approx(low, abs=0.01)
        assert sand_collapse.lajeunesse(aspect) == pytest.approx(high, abs=0.01)
        assert sand_collapse.envelope(aspect) == pytest.approx((0.8 * low, 1.2 * high), abs=0.02)


def test_the_height_is_that_of_the_experiments() -> None:
    """Heights of the experiments.

    Low columns keep theirs. With the power of round ones, 1/6, a = 4 would be off by a quarter.
    """
    for aspect, height in ((0.5, 0.5), (1.1, 1.1), (2.0, 1.32), (4.0, 1.741), (8.0, 2.297)):
        assert sand_collapse.lube_height(aspect) == pytest.approx(height, abs=1e-3)


def test_a_column_runs_as_far_as_in_experiments_and_stops() -> None:
    trial = sand_collapse.runouts(12, aspects=(1.0,), controls=False)
    assert trial.failures() == []


@pytest.mark.slow
def test_half_the_friction_runs_too_far() -> None:
    angle = float(np.degrees(np.arctan(0.5 * scenes.WALL_FRICTION)))
    c = sand_collapse.collapse(2.0, 10, length=12.0, angle=angle, floor=0.5 * scenes.WALL_FRICTION)
    assert c.runout > sand_collapse.envelope(2.0)[1]


@pytest.mark.parametrize("cells", [6, slow(8)])
def test_sand_runs_out_evenly(cells: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Even discharge of sand.

    That of a liquid would fall by 15 % with the fill.
    """
    monkeypatch.setattr(sand_hourglass, "SPACING", 0.01)
    d = sand_hourglass.sand(cells, 1)
    assert d.spread < 8.0
    assert d.rate.mean() == pytest.approx((9.81 * (0.01 * cells) ** 3) ** 0.5, rel=0.3)


@pytest.mark.parametrize("mu", [0.1, 0.3, 0.5])
def test_the_rate_of_a_silo_depends_on_the_friction_as_in_another_code(mu: float) -> None:
    """Rates of Basilisk.

    Half of the friction would be 46 % off, the box model 19 %.
    """
    expected = sand_hourglass.REFERENCE[mu]
    assert sand_hourglass.silo_rate(8, mu) == pytest.approx(expected, rel=0.08)


def test_rates_are_areas_over_times() -> None:
    time = np.linspace(0.0, 10.0, 200)
    width = sand_hourglass.WIDTH
    fill, rate = sand_hourglass._rates(time, 2.0 * width**2 - 0.01 * time, 1.5, 1.2, 3)
    assert fill == pytest.approx([1.45, 1.35, 1.25])
    assert rate == pytest.approx(np.full(3, 0.01))
    _, root = sand_hourglass._rates(time, width**2 * (1.5 - 0.06 * time) ** 2, 1.5, 0.9, 4)
    assert (np.diff(root) < 0.0).all()


def test_a_collapse_keeps_its_invariants() -> None:
    trial = sand_collapse.invariants(12, duration=0.6)
    assert [line for line in trial.failures() if "densest" not in line] == []
    assert trial.findings[-1].control
    assert trial.findings[-1].passed


@pytest.mark.parametrize(("cells", "watches"), [(8, 1), slow((10, 2))])
def test_a_pile_at_rest_hardly_moves_inside(cells: int, watches: int) -> None:
    whole, deep = np.array(sand_collapse.rest(cells, watches)).T
    assert deep.max() < sand_collapse.DEEP
    # Few cells have a large share of the surface, where a grain still slides at first.
    assert whole[-1] < sand_collapse.ALL


def test_drift_is_the_way_of_each_particle_whatever_their_order(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Drift of particles, independent of their order.

    Particles move by a rigid shift and are shuffled at every step. Tracked by number, they would
    seem to go far.
    """
    simulation = scenes.create_sand(
        [0.2, 0.1], 20, [{"shape": "box", "min": [0.0, 0.0], "max": [0.1, 0.08]}]
    )
    random = np.random.default_rng(1)

    def shift(s: scenes.SandSimulation, until: float):
        for _ in range(5):
            moved = s.particles.position.numpy() + np.array([1e-4, 0.0, 0.0], dtype=np.float32)
            s.particles.position.assign(moved[random.permutation(len(moved))])
            s.time += 0.1
            yield {}

    monkeypatch.setattr(scenes, "steps", shift)
    whole, deep = scenes.drift(simulation, 0.5, 0.1)
    assert whole == pytest.approx(5e-4 / 0.5 / 0.1, rel=1e-3)
    assert deep == pytest.approx(whole, rel=1e-3)
