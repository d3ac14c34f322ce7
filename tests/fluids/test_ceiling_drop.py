"""Separation from the ceiling, validation.md 3: the last particle counts.

The mean falls even if the last particle hangs.
"""

from typing import Any

import numpy as np
import pytest
import warp as wp

from small_liquids import GRAVITY, box, create, scene
from stepping import STEPS
from warp_lcp.fluids import LiquidSimulation
from warp_lcp.material import boundary


def block(dimension: int, **tables: Any) -> LiquidSimulation:
    """Return a block that spans the ceiling from wall to wall."""
    size = [0.4, 0.8, 0.2][:dimension]
    low = [0.0, 0.6, 0.0][:dimension]
    return create(
        scene(size=size, resolution={2: 32, 3: 16}[dimension], liquid=[box(low, size)], **tables)
    )


def drop(
    simulation: LiquidSimulation, until: float
) -> tuple[np.ndarray, float, list[dict[str, Any]]]:
    """Let the block fall; return ways, expected ways [cells] and the log.

    Particles are matched by their order from the floor up. A rigid fall keeps it, and a straggler
    can only lose places in it.
    """
    start = np.sort(simulation.particles.position.numpy()[:, 1])
    rows = []
    while simulation.time < until - 1e-9:
        assert len(rows) < STEPS
        dt = min(simulation.stable_dt(), 0.02, until - simulation.time)
        rows.append(simulation.step(dt))
    end = np.sort(simulation.particles.position.numpy()[:, 1])
    return (
        (start - end) / simulation.grid.spacing,
        0.5 * GRAVITY * simulation.time**2 / simulation.grid.spacing,
        rows,
    )


@pytest.mark.parametrize("transfer", ["apic", "flip", "pic"])
@pytest.mark.parametrize("dimension", [2, 3])
def test_every_particle_falls_freely(dimension: int, transfer: str) -> None:
    simulation = block(dimension, particles={"transfer": transfer})
    fallen, expected, rows = drop(simulation, 0.25)
    assert expected > {2: 8, 3: 4}[dimension]
    assert np.abs(fallen - expected).max() < 0.01  # validation.md requires half a cell
    assert (simulation.projection.pressure.numpy() == 0.0).all()
    assert rows[0]["active"] > 0
    assert rows[-1]["active"] == 0
    assert {row["solve_status"] for row in rows} == {"CONVERGED"}


@pytest.mark.parametrize("dimension", [2, 3])
def test_free_slip_walls_hold_it_by_suction(dimension: int) -> None:
    """Suction of free-slip walls: the negative control of the walls.

    Liquid that may not separate hangs, with a negative pressure.
    """
    simulation = block(dimension, wall="free-slip")
    fallen, expected, rows = drop(simulation, 0.25)
    assert expected > {2: 8, 3: 4}[dimension]
    assert abs(fallen.mean()) < 0.1
    assert np.abs(fallen).max() < 1.0  # a few drops separate from the free surface
    assert simulation.projection.pressures(1000.0).min() == pytest.approx(
        -1000.0 * GRAVITY * 0.2, rel=0.15
    )
    assert all(row["active"] == 0 for row in rows)


def test_a_wall_that_keeps_its_velocity_fails_the_last_particle_only(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Wall velocity kept at released cells: the negative control of the release.

    The mean looks right, but the last particle lags.
    """
    extend = boundary.extend_velocity

    def hold(
        window: Any,
        velocity: Any,
        weights: Any,
        known: Any,
        kind: wp.array,
        contact: wp.array,
        *rest: Any,
        **more: Any,
    ) -> None:
        extend(window, velocity, weights, known, kind, wp.zeros_like(contact), *rest, **more)

    monkeypatch.setattr(boundary, "extend_velocity", hold)
    fallen, expected, _ = drop(block(2), 0.25)
    assert abs(fallen.mean() - expected) < 0.7
    assert expected - fallen.min() > 1.0


@pytest.mark.parametrize(("wall", "falls"), [("separating", True), ("free-slip", False)])
def test_a_solid_ceiling_has_its_own_separation_setting(wall: str, falls: bool) -> None:
    solid, liquid = [box([0.0, 0.7], [0.4, 0.8], wall=wall)], [box([0.0, 0.5], [0.4, 0.7])]
    fallen, expected, _ = drop(
        create(scene(size=[0.4, 0.8], resolution=32, liquid=liquid, solid=solid, wall="free-slip")),
        0.15,
    )
    assert expected > 3
    assert np.abs(fallen - expected if falls else fallen).max() < (0.01 if falls else 0.5)
