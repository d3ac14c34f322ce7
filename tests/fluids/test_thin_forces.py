"""Forces of liquid at rest on thin solids: weight, lever arm, and loads of upright sides."""

import math
from typing import Any

import numpy as np
import pytest

from default_run import covering
from drawn_thin_walls import drawn, filled, run, walls_around
from small_liquids import GRAVITY, advance, box, create, scene
from warp_lcp.fluids import LiquidSimulation

CELLS = 32
CELL = 1.0 / CELLS
SHARE = 0.6
WATER = 1000.0 * GRAVITY


def bottle_at_rest(angle: float, offset: np.ndarray) -> tuple[LiquidSimulation, np.ndarray]:
    """Return a closed box, filled to a share and at rest, and its lower corner before its turn."""
    low = np.array([9.0, 9.0]) * CELL + offset * CELL
    high = low + 14.3 * CELL
    place: dict[str, Any] = {"rotate": angle, "about": (0.5 * (low + high)).tolist()}
    solids = [wall | place for wall in walls_around(low, high, 0.3 * CELL)]
    liquid = filled(low, high, angle, SHARE, CELL, place)
    if not angle:
        liquid = [box(low, [high[0], low[1] + SHARE * (high[1] - low[1])])]
    model = scene(
        size=[1.0, 1.0], resolution=CELLS, liquid=liquid, solid=solids, output={"forces": True}
    )
    simulation = create(model)
    advance(simulation, 0.4)
    return simulation, low


def totals(simulation: LiquidSimulation, about: np.ndarray) -> np.ndarray:
    """Return the force on all solids, and its torque about a point, shape (3,)."""
    assert simulation.forces is not None
    row, result = simulation.measured["forces"], np.zeros(3)
    for number in range(len(simulation.scene.solid)):
        force = np.array([row[f"solid{number}_fx"], row[f"solid{number}_fy"]], dtype=float)
        way = simulation.forces.references[1 + number][:2] - about
        result[:2] += force
        result[2] += float(row[f"solid{number}_torque"] or 0.0)
        result[2] += way[0] * force[1] - way[1] * force[0]
    return result


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(("angle", "offset"), covering([45.0, 30.0], [0.1, 0.4, 0.6, 0.9], count=4))
def test_a_tilted_bottle_carries_its_content(angle: float, offset: float) -> None:
    """Force and line of action are those of the weight.

    At 45 degrees all edges between cells' centers are crossed at the same two places: a pressure
    that is taken there, and not at the wall's centroid, puts the load off by up to 8 %.
    """
    simulation, _low = bottle_at_rest(angle, np.array([offset, 0.3]))
    x = simulation.particles.position.numpy().astype(np.float64)
    weight = len(x) * WATER * (0.5 * CELL) ** 2
    assert weight == pytest.approx(SHARE * (14.3 * CELL) ** 2 * WATER, rel=0.02)
    force_x, force_y, torque = totals(simulation, x[:, :2].mean(axis=0))
    assert -force_y == pytest.approx(weight, rel=0.015)
    assert abs(force_x) < 0.01 * weight
    assert abs(torque) < 0.15 * CELL * weight


def test_a_tilted_bottle_in_3d_carries_its_content() -> None:
    """Walls of 0.75 cells at 15 degrees, at rest: the forces' sum is the weight."""
    outcome = run(drawn(999106, "bottle", "fluids", 3))
    assert outcome.load == pytest.approx(1.0, abs=0.02)
    assert not outcome.passed


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("offset", [0.1, 0.4, 0.7])
def test_both_sides_of_an_upright_bottle_bear_the_hydrostatic_load(offset: float) -> None:
    simulation, _low = bottle_at_rest(0.0, np.array([offset, 1.0 - offset]))
    row = simulation.measured["forces"]
    depth = SHARE * 14.3 * CELL
    expected = 0.5 * WATER * depth**2
    assert -float(row["solid0_fx"] or math.nan) == pytest.approx(expected, rel=0.02)
    assert float(row["solid1_fx"] or math.nan) == pytest.approx(expected, rel=0.02)
    floor = WATER * depth * 14.3 * CELL
    assert -float(row["solid2_fy"] or math.nan) == pytest.approx(floor, rel=0.01)
