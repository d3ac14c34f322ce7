"""Recorded steps against steps with immediate launches."""

from typing import Any

import numpy as np
import pytest

from small_liquids import box, create, scene
from warp_lcp.fluids import LiquidSimulation
from warp_lcp.kernels.launch_graph import LaunchGraph

# Different lengths reveal a number that is recorded only once.
STEPS = (4e-3, 3e-3, 5e-3, 2e-3, 4e-3, 3e-3)
JET = [box([0.0, 0.7], [0.1, 0.8], velocity=[1.5, 0.0], start=0.005, stop=0.015)]
MODELS: dict[str, dict[str, Any]] = {
    "narrow band": {
        "particles": {"narrow_band": {"width": 3.0}},
        "density_correction": {"every": 2},
    },
    "FLIP": {"particles": {"transfer": "flip"}, "wall_drag": {"coefficient": 0.1}},
    "viscosity": {"viscosity": {"value": 20.0}},
    "surface tension": {"surface_tension": {"coefficient": 5.0, "contact_angle": 60.0}},
    "unilateral": {"pressure": {"model": "unilateral"}},
    "source": {"source": JET},
}


def steps(tables: dict[str, Any]) -> tuple[LiquidSimulation, list[dict[str, Any]]]:
    """Return a tank after some steps of a collapsing column, and its log."""
    simulation = create(
        scene(size=[1.0, 1.0], resolution=16, liquid=[box([0.1, 0.0], [0.7, 0.6])], **tables)
    )
    return simulation, [dict(simulation.step(dt)) for dt in STEPS]


@pytest.mark.default_cases(4)
@pytest.mark.parametrize("model", MODELS)
def test_recorded_launches_give_the_same_bits(monkeypatch, model):
    """Equal bits of recorded and immediate launches: positions, velocities, log."""
    recorded, rows = steps(MODELS[model])
    monkeypatch.setattr(
        LaunchGraph, "run", lambda graph, *given, variant=None: graph._record(*given)
    )
    direct, expected = steps(MODELS[model])
    assert rows == expected
    for name, array in recorded.particles.arrays().items():
        assert np.array_equal(array.numpy(), direct.particles.arrays()[name].numpy()), name
