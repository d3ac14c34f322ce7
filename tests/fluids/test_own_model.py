"""The documentation's user-defined model of a liquid, against its equation."""

from pathlib import Path

import numpy as np
import pytest

from code_blocks import sponge
from small_liquids import box, scene
from warp_lcp.fluids import SIMULATOR

PAGE = Path(__file__).parents[2] / "docs/own-model.md"


def test_a_sponge_damps_liquid_at_its_rate_and_logs_the_energy():
    """Velocity and energy in a sponge.

    A block in flight without gravity, all of it in the sponge: u is divided by 1 + k dt in each
    step, and so is its momentum.
    """
    block = box([0.3, 0.2], [0.5, 0.4], velocity=[0.4, 0.1])
    model = scene(
        size=[1.0, 0.5],
        resolution=32,
        liquid=[block],
        physics={"gravity": [0.0, 0.0]},
        solver={"precision": "double"},
    )
    liquid, rate = (
        SIMULATOR.create(model, device="cpu", folder=Path(), models=[sponge()(5.0, 0.5)]),
        5.0,
    )
    velocity, energy, last = np.array([0.4, 0.1, 0.0]), None, 0.0
    assert "sponge_work" in liquid.columns()
    for dt in (0.01, 0.02, 0.005):
        row = liquid.step(dt)
        # Forces act for half of the last step and half of this one.
        velocity /= 1.0 + rate * 0.5 * (last + dt)
        last = dt
        np.testing.assert_allclose(
            liquid.particles.velocity.numpy().mean(axis=0), velocity, rtol=2e-5, atol=1e-7
        )
        if energy is not None:  # of particles that all have one velocity, as their faces have
            assert row["sponge_work"] == pytest.approx(energy - row["kinetic_energy"], rel=1e-3)
        energy = row["kinetic_energy"]


def test_a_sponge_above_nothing_changes_nothing():
    block = box([0.0, 0.2], [0.3, 0.4])
    model = scene(size=[1.0, 0.5], resolution=16, liquid=[block])
    rows = []
    for models in ([], [sponge()(100.0, 0.0)]):
        liquid = SIMULATOR.create(model, device="cpu", folder=Path(), models=models)
        rows.append([liquid.step(0.005) for _ in range(3)])
    plain, with_model = rows
    assert [row | {"sponge_work": 0.0} for row in plain] == with_model
