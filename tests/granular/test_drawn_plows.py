"""Blades drawn at random that plow sand: the run reaches its end, and no cell is crowded."""

import pytest

from default_run import slow
from drawn_plows import LIMIT, drawn, run


# 30 stopped in a jam; a cell held up to 1.41, 1.15, 1.34, 1.20, 1.17 and 1.15 in the others.
@pytest.mark.parametrize("seed", [30, 21, 56, slow(23), slow(5), slow(19), slow(67)])
def test_plowed_sand_does_not_jam_and_keeps_its_density(seed: int) -> None:
    out = run(drawn(seed))
    assert out.failed == float("inf")
    assert out.retried == 0
    assert out.densest.max() < LIMIT
