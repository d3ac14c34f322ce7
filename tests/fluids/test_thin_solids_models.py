"""What else acts on liquid keeps to one side of solids thinner than cells."""

from typing import Any

import numpy as np
import pytest

from default_run import chosen
from small_liquids import GRAVITY, box, create, scene
from warp_lcp.fluids import LiquidSimulation

CELLS = 24
CELL = 1.0 / CELLS
THIN, THICK = 0.1, 3.0  # cells
LEFT, RIGHT = 0.5, 5.0 / 24  # levels of two pools [m]
SPEED = float(np.sqrt(GRAVITY * LEFT))
MODELS: dict[str, dict[str, Any]] = {
    "plain": {},
    "viscosity": {"viscosity": {"value": 5.0}},
    "surface tension": {"surface_tension": {"coefficient": 2.0}},
    "contact angle": {"surface_tension": {"coefficient": 2.0, "contact_angle": 60.0}},
    "wall drag": {"wall_drag": {"coefficient": 0.1}},
    "density correction": {"density_correction": {"every": 1}},
    "smoothing": {"pressure": {"smoothing": 2}},
    "unilateral": {"pressure": {"model": "unilateral"}},
    "whole cells": {"pressure": {"surface": "voxel"}},
    "narrow band": {"particles": {"narrow_band": {"width": 3.0}, "jitter": 0.0}},
    "reseeding": {"particles": {"reseed": {}, "jitter": 0.0}},
    "flip": {"particles": {"transfer": "flip", "jitter": 0.0}},
}
PRESSURES = [
    {"name": "left", "position": [0.25, 0.05], "quantity": "pressure"},
    {"name": "right", "position": [0.8, 0.05], "quantity": "pressure"},
]


def pools(width: float, tables: dict[str, Any]) -> LiquidSimulation:
    """Return a simulation of two pools on the sides of an upright plate some cells wide."""
    low = 0.5 - 0.5 * width * CELL if width < 1.0 else 0.5
    high = low + width * CELL
    liquid = [box([0.0, 0.0], [low, LEFT]), box([high, 0.0], [1.0, RIGHT])]
    given = {"particles": {"jitter": 0.0}, "probe": PRESSURES} | tables
    plate = box([low, -0.1], [high, 1.1])
    return create(scene(size=[1.0, 1.0], resolution=CELLS, liquid=liquid, solid=[plate], **given))


def speeds(simulation: LiquidSimulation, until: float) -> list[float]:
    """Step to a time, and return the largest speed of each step [m/s]."""
    found = []
    while simulation.time < until - 1e-9:
        dt = min(simulation.stable_dt(), 0.01, until - simulation.time)
        found.append(float(simulation.step(dt)["max_speed"]))
    return found


@pytest.mark.parametrize(
    "name", chosen(MODELS, ["plain", "contact angle", "unilateral", "whole cells", "flip"])
)
def test_pools_on_two_sides_of_a_sheet_rest_as_beside_a_thick_wall(name: str) -> None:
    thin, thick = (pools(width, MODELS[name]) for width in (THIN, THICK))
    found, expected = speeds(thin, 0.3), speeds(thick, 0.3)
    # Particles in lanes along the plate are not in the rows of the others, so that pressures differ
    # a little from those of a lattice: .0012 to .003 of SPEED here.
    assert max(found) < 1.1 * max(expected) + 3.2e-3 * SPEED
    x, y, _ = thin.particles.position.numpy().T
    assert not (np.abs(x - 0.5) < 0.5 * THIN * CELL).any()
    assert np.percentile(y[x < 0.5], 99) == pytest.approx(
        LEFT, abs=0.05 if name == "unilateral" else 0.02
    )
    assert np.percentile(y[x > 0.5], 99) == pytest.approx(
        RIGHT, abs=0.05 if name == "unilateral" else 0.02
    )
    pressures, others = thin.measured["probes"], thick.measured["probes"]
    for side, level in (("left", LEFT), ("right", RIGHT)):
        pressure = pressures[f"{side}_pressure"]
        assert pressure == pytest.approx(others[f"{side}_pressure"], rel=0.01)
        assert pressure == pytest.approx(
            1000.0 * GRAVITY * (level - 0.05), abs=0.6 * 1000.0 * GRAVITY * CELL
        )


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("name", ["plain", "viscosity", "surface tension"])
def test_pools_come_to_rest(name: str) -> None:
    assert speeds(pools(THIN, MODELS[name]), 1.0)[-1] < 1e-3 * SPEED


def flow(width: float, tables: dict[str, Any]) -> tuple[np.ndarray, float]:
    """Return the mean speed of each layer of cells over a plate, and the force along it [N/m]."""
    top = 6.0 * CELL
    layer, plate = (
        box([0.0, top], [1.0, top + 8.0 * CELL]),
        box([-0.1, top - width * CELL], [1.1, top]),
    )
    defaults = {
        "physics": {"gravity": [2.0, -9.8]},
        "particles": {"jitter": 0.0},
        "output": {"forces": True},
    }
    simulation = create(
        scene(size=[1.0, 1.0], resolution=CELLS, liquid=[layer], solid=[plate], **defaults | tables)
    )
    speeds(simulation, 0.1)
    x, y, _ = simulation.particles.position.numpy().T
    u, height = simulation.particles.velocity.numpy()[:, 0], (y - top) / CELL
    middle = np.abs(x - 0.5) < 0.1
    layers = [u[middle & (height > n) & (height <= n + 1)].mean() for n in range(8)]
    return np.array(layers), simulation.measured["forces"]["solid0_fx"]


@pytest.mark.default_cases(1)
@pytest.mark.parametrize(
    "tables",
    [
        {"viscosity": {"value": 20.0}},
        {"viscosity": {"value": 20.0, "slip_length": 0.05}},
        {"viscosity": {"value": 20.0}, "wall": "free-slip"},
        {"wall_drag": {"coefficient": 0.3}},
    ],
)
def test_liquid_flows_along_a_sheet_as_along_a_thick_wall(tables: dict[str, Any]) -> None:
    (thin, pull), (thick, expected) = flow(0.2, tables), flow(3.0, tables)
    np.testing.assert_allclose(thin, thick, rtol=0.01)
    assert pull == pytest.approx(expected, rel=0.02, abs=0.05)


def test_unsupported_settings_of_sheets_are_refused() -> None:
    angle = MODELS["contact angle"]
    assert any(
        "contact_angle is 90 on solid[0] (box)" in note for note in pools(THIN, angle).notes()
    )
    assert not any("thinner than a cell" in note for note in pools(THICK, angle).notes())
