"""Liquids at rest stay at rest, validation.md 1 with the surface of whole cells: the LCP may not invent motion."""

import math
from typing import Any

import numpy as np
import pytest
from small_liquids import GRAVITY, advance, box, create, scene

from fluids import LiquidSimulation

SLOPE = math.radians(30)
V = [{"shape": "plane", "point": [0.4, 0.0], "normal": [side * math.sin(SLOPE), math.cos(SLOPE)]} for side in (-1, 1)]
TILT = math.radians(20)
TILTED = {"gravity": [GRAVITY * math.sin(TILT), -GRAVITY * math.cos(TILT)]}

CASES: dict[str, dict[str, Any]] = {
    "pool": {"liquid": [box([0.0, 0.0], [0.8, 0.4])]},
    "pool in a V": {"liquid": [box([0.0, 0.0], [0.8, 0.4])], "solid": V},
    "full box": {"liquid": [box([0.0, 0.0], [0.8, 0.8])]},
    "full tilted box": {"liquid": [box([0.0, 0.0], [0.8, 0.8])], "physics": TILTED},
    "free-slip pool": {"liquid": [box([0.0, 0.0], [0.8, 0.4])], "wall": "free-slip"},
    "full free-slip box": {"liquid": [box([0.0, 0.0], [0.8, 0.8])], "wall": "free-slip"},
}


def tank(case: str) -> LiquidSimulation:
    return create(scene(size=[0.8, 0.8], resolution=20, **CASES[case]))


def largest_speed(simulation: LiquidSimulation, until: float) -> float:
    """Return the largest speed in units of sqrt(g dx)."""
    return max(row["max_speed"] for row in advance(simulation, until)) / math.sqrt(GRAVITY * simulation.grid.spacing)


@pytest.mark.parametrize("case", CASES)
def test_a_liquid_at_rest_stays_at_rest(case: str) -> None:
    assert largest_speed(tank(case), 10.0) < 1e-3


def test_a_pool_at_rest_in_space() -> None:
    simulation = create(scene(size=[0.8, 0.8, 0.4], resolution=12, liquid=[box([0.0, 0.0, 0.0], [0.8, 0.4, 0.4])]))
    assert largest_speed(simulation, 0.5) < 1e-3


def test_the_pressure_of_a_pool_is_that_of_its_depth() -> None:
    simulation = tank("pool")
    advance(simulation, 0.2)
    pressure = simulation.projection.pressures(1000.0)[1, 1:-1, 1:-1]
    rows = np.arange(20)
    # the surface of whole cells lies at p = 0 in the AIR cell above: half a cell too high
    depth = np.maximum(0.4 - rows * 0.04, 0.0)
    assert pressure == pytest.approx(np.tile(1000.0 * GRAVITY * depth[:, None], (1, 20)), rel=1e-3, abs=1.0)


def test_a_full_tilted_box_has_its_lowest_pressure_in_the_corner_that_is_up() -> None:
    simulation = tank("full tilted box")
    advance(simulation, 0.2)
    pressure = simulation.projection.pressures(1000.0)[1, 1:-1, 1:-1]
    assert pressure.min() == pytest.approx(0.0, abs=1.0)
    assert pressure[-1, 0] == pytest.approx(0.0, abs=1.0)
    gx, gy = TILTED["gravity"]
    assert pressure[0, -1] == pytest.approx(1000.0 * 19 * 0.04 * (gx - gy), rel=1e-3)


def test_restarts_need_few_iterations() -> None:
    rows = advance(tank("pool"), 0.5)
    assert np.mean([row["solve_iterations"] for row in rows[1:]]) <= 1.0
