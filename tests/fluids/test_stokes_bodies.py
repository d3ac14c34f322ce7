"""Coupled solve of velocity and pressure with rigid bodies: impulses, supports, drawn scenes."""

from __future__ import annotations

import numpy as np
import pytest

import small_liquids
from default_run import chosen
from small_liquids import GRAVITY, box, create
from viscous_scenes import coupled_scene
from warp_lcp.fluids import LiquidSimulation
from warp_lcp.simulation import StepFailed

ALWAYS = 1e-12  # splitting tolerance at which every step is coupled
STEP = 0.005  # [s]


def on_a_body(dimension: int) -> LiquidSimulation:
    """Return thick liquid that falls on a body, which stands on the floor between two blocks.

    The liquid touches nothing else. The body cannot move.
    """
    low, high = [0.2, 0.0, 0.2][:dimension], [0.8, 0.25, 0.8][:dimension]
    side = [0.2, 0.25, 1.0][:dimension]
    blocks = [box([0.0] * dimension, side), box([0.8, 0.0, 0.0][:dimension], [1.0, *side[1:]])]
    liquid = box(
        [0.4, 0.25, 0.4][:dimension],
        [0.6, 0.5, 0.6][:dimension],
        velocity=[0.5, -1.0, 0.25][:dimension],
    )
    return create(
        small_liquids.scene(
            size=[1.0] * dimension,
            resolution=16 if dimension == 2 else 12,
            liquid=[liquid],
            wall="separating",
            solid=[{**box(low, high), "density": 5000.0, "wall": "sticky"}, *blocks],
            pressure={"surface": "voxel"},
            viscosity={"value": 1e3, "splitting_tolerance": ALWAYS},
        )
    )


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_body_receives_the_momentum_that_the_liquid_loses(dimension: int) -> None:
    # Supports absorb all of it, but contacts between bodies have to know it.
    simulation = on_a_body(dimension)
    bodies, stokes = simulation.bodies, simulation.stokes
    assert bodies is not None and stokes is not None
    received, lost = [], []
    solve_contacts = simulation.solve_contacts

    def watched() -> None:
        operator = stokes.operator
        mass = 1000.0 * simulation.grid.cell_volume
        received.append(bodies.bodies.received_impulse[0, :dimension].copy())
        lost.append(
            [
                mass * float((volume.numpy() * (before.numpy() - u.numpy())).sum())
                for volume, before, u in zip(
                    operator.level.volume, operator.start, simulation.velocity, strict=True
                )
            ]
        )
        solve_contacts()

    simulation.solve_contacts = watched  # type: ignore[method-assign]
    for _ in range(4):
        row = simulation.step(STEP)
        assert row["stokes_iterations"] > 0
    weight = 1000.0 * 0.2 ** (dimension - 1) * 0.25 * GRAVITY * STEP
    for impulse, momentum in zip(received, lost, strict=True):
        assert np.abs(impulse - momentum).max() <= 1e-4 * np.abs(momentum).max()
        assert -impulse[1] > 0.5 * weight
    assert np.abs(bodies.bodies.velocities()).max() < 1e-6


def test_sources_do_not_push_bodies() -> None:
    # Faces of a source have its velocity, not that of the body that reaches into it. Otherwise the
    # matrix has links that the residual has not, and 52 iterations reduce nothing.
    body = {
        "shape": "sphere",
        "center": [0.5, 0.85],
        "radius": 0.09,
        "density": 400.0,
        "wall": "sticky",
    }
    source = box([0.3, 0.9], [0.7, 1.0], velocity=[0.0, -1.5])
    simulation = create(
        small_liquids.scene(
            size=[1.0, 1.0],
            resolution=24,
            liquid=[box([0.2, 0.5], [0.8, 0.9])],
            wall="sticky",
            solid=[body],
            source=[source],
            viscosity={"value": 1e3, "splitting_tolerance": ALWAYS},
        )
    )
    for _ in range(4):
        row = simulation.step(STEP)
        assert row["stokes_error"] <= simulation.stokes.tolerance
        assert 0 < row["stokes_iterations"] <= 20


@pytest.mark.parametrize("share", [ALWAYS, np.inf])
def test_a_floor_does_not_throw_bodies_that_fall_through_thick_liquid(share: float) -> None:
    # The liquid between body and floor stops the body.
    bodies = [
        {"center": [0.35, 0.3], "radius": 0.09, "density": 400.0, "wall": "sticky"},
        {"center": [0.65, 0.27], "radius": 0.08, "density": 50.0, "wall": "separating"},
    ]
    simulation = create(
        small_liquids.scene(
            size=[1.0, 1.0],
            resolution=32,
            liquid=[box([0.2, 0.19], [0.8, 0.6])],
            wall="sticky",
            solid=[{"shape": "sphere", **body} for body in bodies],
            viscosity={"value": 4e3, "splitting_tolerance": share},
        )
    )
    fastest = 0.0
    for _ in range(18):
        simulation.step(min(simulation.stable_dt(), 0.02))
        fastest = max(fastest, np.abs(simulation.bodies.bodies.velocities()[:, :3]).max())
    assert 1.0 < fastest < np.sqrt(2.0 * GRAVITY * 0.25)


@pytest.mark.parametrize("seed", chosen([889003, 889017, *range(889023, 889040)], [889003]))
def test_drawn_scenes_of_bodies_take_their_steps(seed: int) -> None:
    # 889003: body 2 touches walls in nearly all directions, and has left the liquid.
    simulation = create(coupled_scene(seed))
    for _ in range(18):
        dt = min(simulation.stable_dt(), 0.02)
        for _ in range(3):
            try:
                row = simulation.step(dt)
                break
            except StepFailed:
                dt *= 0.5
        else:
            pytest.fail("no step of a quarter of the stable time step was taken")
        if row.get("stokes_iterations"):
            assert row["stokes_error"] <= 3.0 * simulation.stokes.tolerance
        assert float(np.abs(simulation.particles.velocity.numpy()).max()) < 20.0
        if simulation.bodies is not None:
            # Faster than 20 m/s at its rim is no body.
            assert np.abs(simulation.bodies.bodies.velocities()[:, :3]).max() < 20.0


def test_resumed_steps_with_bodies_have_the_same_bits() -> None:
    first, second = (
        create(
            small_liquids.scene(
                size=[1.0, 1.0],
                resolution=16,
                liquid=[box([0.0, 0.0], [1.0, 0.3])],
                solid=[{**box([0.4, 0.31], [0.6, 0.5]), "density": 500.0}],
                viscosity={"value": 84.0, "splitting_tolerance": ALWAYS},
            )
        )
        for _ in range(2)
    )
    for _ in range(3):
        first.step(STEP)
    second.restore(first.state())
    rows = [[simulation.step(STEP) for _ in range(2)] for simulation in (first, second)]
    assert rows[0][0]["viscous_iterations"] == 0  # begins with the result of the last step
    assert rows[0] == rows[1]
