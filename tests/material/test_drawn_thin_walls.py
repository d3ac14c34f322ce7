"""Thin solids drawn at random: no particle passes one, and those at rest bear their liquid."""

import pytest

from drawn_thin_walls import KINDS, drawn, run

SEEDS = range(6)
LOAD = {2: 0.02, 3: 0.03}  # in 3-D a bottle is 7 cells wide


def check(seed: int, kind: str, simulator: str, dimension: int) -> None:
    draw = drawn(seed, kind, simulator, dimension)
    outcome = run(draw)
    assert outcome.passed == 0, draw.label
    if outcome.load is not None:
        assert outcome.load == pytest.approx(1.0, abs=LOAD[dimension]), draw.label


@pytest.mark.parametrize(("seed", "kind"), [(100, "plate"), (101, "bottle"), (100, "shaken")])
def test_liquid_stays_where_it_is_and_loads_what_is_below(seed: int, kind: str) -> None:
    check(seed, kind, "fluids", 2)


def test_draws_are_the_same_again() -> None:
    one, other = (drawn(3, "bottle", "fluids", 2) for _ in range(2))
    assert one.tables == other.tables
    assert all(drawn(1, kind, "fluids", 3).tables["solid"] for kind in KINDS)


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("simulator", ["fluids", "granular"])
@pytest.mark.parametrize("kind", KINDS)
def test_no_particle_passes_a_thin_wall(
    kind: str, simulator: str, dimension: int, seed: int
) -> None:
    if kind == "mesh" and dimension == 2:
        pytest.skip("meshes are 3-D")
    check(seed, kind, simulator, dimension)
