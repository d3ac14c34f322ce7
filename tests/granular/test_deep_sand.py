"""Coupled pressure and friction in deep sand: iterations and residuals."""

from typing import Any

import numpy as np
import pytest

from default_run import slow
from small_sands import GRAVITY, box, create, scene
from warp_lcp.granular.simulator import SandSimulation
from warp_lcp.granular.stress_methods import HeavyBallProjectedGradient


def silo(cells: int, depth: int, slot: int, **tables: Any) -> SandSimulation:
    """Return a silo of some cells' width and depth, with a slot in its floor."""
    dx, left = 0.0125, (cells - slot) // 2
    low, floor, high = 4 * dx, 6 * dx, (6 + depth) * dx
    solid = [
        box([-1.0, low], [left * dx, floor], friction="stick"),
        box([(left + slot) * dx, low], [1.0, floor], friction="stick"),
    ]
    sand, drain = [box([0.0, floor], [cells * dx, high])], [box([-1.0, -1.0], [1.0, 2 * dx])]
    size = [cells * dx, (depth + 10) * dx]
    return create(
        scene(
            size=size,
            resolution=depth + 10,
            sand=sand,
            friction=0.5,
            solid=solid,
            drain=drain,
            **tables,
        )
    )


@pytest.mark.parametrize(
    ("cells", "friction"),
    [(32, 0.0), (64, 0.5), *map(slow, [(32, 0.5), (64, 0.0), (96, 0.0), (96, 0.5)])],
)
def test_a_cold_start_takes_iterations_as_the_sand_is_deep(cells: int, friction: float) -> None:
    """Iterations of a cold start in deep sand.

    Waves as long as the depth keep their momentum. A solve that limits it before they have decayed
    takes twice as long. This counts to the tolerance; by default the first step's solve continues
    from there.
    """
    dx = 0.02
    sand = [box([0.0, 0.0], [8 * dx, cells * dx])]
    simulation = create(
        scene(size=[8 * dx, (cells + 4) * dx], resolution=cells + 4, sand=sand, friction=friction)
    )
    simulation.method = HeavyBallProjectedGradient(cold=HeavyBallProjectedGradient().least)
    row = simulation.step(0.5 * float(np.sqrt(dx / GRAVITY)))
    assert row["solve_status"] == "CONVERGED"
    assert row["solve_iterations"] <= (3.0 if friction else 5.0) * cells + 40


@pytest.mark.parametrize(
    ("cells", "depth", "slot", "steps"), [(12, 24, 4, 20), slow((24, 48, 6, 30))]
)
def test_a_limit_of_the_momentum_leaves_less_of_the_residual_where_deep_sand_yields(
    cells: int, depth: int, slot: int, steps: int
) -> None:
    """Limit of the momentum: smaller residual where deep sand yields.

    Sand of 45 degrees, k = 0.85, runs out of a silo: pressure and the friction's bound amplify each
    other. Only the residual ends a solve: at the velocities' tolerance both would end early.
    """
    medians = []
    for limits in ((), HeavyBallProjectedGradient().calm):
        simulation = silo(
            cells,
            depth,
            slot,
            material={"friction_angle": 45.0},
            density_correction={},
            solver={"velocity_tolerance": 0.0},
        )
        simulation.method = HeavyBallProjectedGradient(calm=limits)
        rows = [simulation.step(min(simulation.stable_dt(), 0.01)) for _ in range(steps)]
        residuals = [row["coupled_residual"] for row in rows[steps // 3 :]]
        medians.append(float(np.median(residuals)))
    assert medians[1] < 0.75 * medians[0]
