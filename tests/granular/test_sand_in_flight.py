"""Airborne sand: parabolas, whatever the steps.

Sand in contact is left to its stresses.
"""

from typing import Any

import numpy as np
import pytest

from small_sands import GRAVITY, advance, box, create, scene
from warp_lcp.granular.simulator import SandSimulation

FLIGHT = 0.3  # [s]
BODY = {"density": 800.0}


def thrown(
    dimension: int, cells: int, cfl: float, *, spin: float = 0.0, **tables: Any
) -> SandSimulation:
    """Return a block of sand in flight that turns about z at `spin` [1/s]."""
    low, high, velocity = [0.6, 1.0, 0.9], [1.0, 1.3, 1.2], [1.0, 1.5, -0.5]
    sand = [box(low[:dimension], high[:dimension], velocity=velocity[:dimension])]
    simulation = create(
        scene(size=[2.0] * dimension, resolution=cells, sand=sand, cfl=cfl, **tables)
    )
    particles = simulation.particles
    arm = particles.position.numpy().astype(np.float64)
    arm -= arm.mean(axis=0)
    particles.velocity.assign(
        particles.velocity.numpy()
        + spin * np.stack([-arm[:, 1], arm[:, 0], 0.0 * arm[:, 0]], axis=1)
    )
    for gradient, row in zip(particles.affine, ([0.0, -spin, 0.0], [spin, 0.0, 0.0]), strict=False):
        gradient.assign(np.tile(np.array(row, dtype=np.float32), (len(arm), 1)))
    return simulation


@pytest.mark.parametrize(("dimension", "cells", "cfl"), [(2, 40, 2.0), (2, 40, 8.0), (3, 20, 8.0)])
@pytest.mark.parametrize("spin", [0.0, 6.0])
def test_thrown_sand_goes_along_its_parabola(
    dimension: int, cells: int, cfl: float, spin: float
) -> None:
    """Parabola of thrown sand.

    Its center is exact to 1e-4 of its way (it was up to 8e-2 off), its rotation likewise, and no
    grain is pushed by others in flight with it.
    """
    simulation = thrown(dimension, cells, cfl, spin=spin)

    def measured() -> tuple[np.ndarray, np.ndarray, float]:
        x, v = (
            field.numpy().astype(np.float64)
            for field in (simulation.particles.position, simulation.particles.velocity)
        )
        arm, own = x - x.mean(axis=0), v - v.mean(axis=0)
        return (
            x.mean(axis=0),
            np.cross(arm, own).mean(axis=0),
            float(np.square(own).sum(axis=1).mean()),
        )

    start, turning, within = measured()
    advance(simulation, FLIGHT, dt_max=1.0)
    end, turning_then, within_then = measured()
    way = np.array([1.0, 1.5 - 0.5 * GRAVITY * FLIGHT, -0.5 if dimension == 3 else 0.0]) * FLIGHT
    np.testing.assert_allclose(end - start, way, atol=1e-4 * float(np.linalg.norm(way)))
    np.testing.assert_allclose(turning_then, turning, atol=1e-3 * 6.0 / 48.0)
    assert within_then <= within + 1e-6  # [m^2/s^2]


def test_sand_that_touches_a_wall_or_a_body_is_not_in_flight() -> None:
    """Sand in contact with a wall or a body is not airborne.

    Sand on a floor, on a body in free fall, and sand that lands in the step: the same bits as
    without conservation.
    """
    crate = box([0.2, 0.5], [0.6, 0.7]) | BODY
    cases = [
        {"sand": [box([0.0, 0.0], [0.5, 0.3])]},
        {"sand": [box([0.3, 0.7], [0.5, 0.85])], "solid": [crate]},
        {"sand": [box([0.3, 0.1], [0.5, 0.3], velocity=[0.0, -2.0])], "cfl": 4.0},
    ]
    for case in cases:
        left, kept = (create(scene(size=[1.0, 1.0], resolution=32, **case)) for _ in range(2))
        left.flights = None
        assert kept.flights is not None
        dt = 0.05 if "cfl" in case else 4e-3
        assert kept.step(dt) == left.step(dt)
        np.testing.assert_array_equal(
            kept.particles.position.numpy(), left.particles.position.numpy()
        )
        np.testing.assert_array_equal(
            kept.particles.velocity.numpy(), left.particles.velocity.numpy()
        )


def test_momentum_correction_acts_on_airborne_sand_only() -> None:
    """Conservation for airborne sand alone.

    A block over a heap: the heap keeps the result of the stresses, the block falls rigidly.
    """
    sand = [box([0.0, 0.0], [1.0, 0.25]), box([0.4, 0.6], [0.6, 0.75], velocity=[0.5, 0.0])]
    kept, left = (create(scene(size=[1.0, 1.0], resolution=32, sand=sand)) for _ in range(2))
    left.flights = None
    for _ in range(3):
        kept.step(0.01)
        left.step(0.01)
    x, velocity = kept.particles.position.numpy(), kept.particles.velocity.numpy()
    low = x[:, 1] < 0.4
    np.testing.assert_array_equal(x[low], left.particles.position.numpy()[low])
    np.testing.assert_allclose(velocity[~low].mean(axis=0), [0.5, -0.025 * GRAVITY, 0.0], atol=1e-6)
    # The root of the rounding error of energies.
    assert np.abs(velocity[~low] - velocity[~low].mean(axis=0)).max() < 1e-3


def test_connected_sand_on_a_periodic_axis_is_no_fragment() -> None:
    assert (
        create(
            scene(
                size=[1.0, 1.0],
                resolution=16,
                sand=[box([0.0, 0.5], [1.0, 0.8])],
                periodic=[True, False],
            )
        ).flights
        is None
    )


def test_falling_sand_needs_no_iterations() -> None:
    """Sand that falls without contact has nothing to solve, at any speed and phase on the grid.

    Its front fills cells from behind; the mass flux through their faces once compressed it there,
    with pressures of up to 10 rho g dx and 80 iterations a step.
    """
    simulation = create(
        scene(size=[1.0, 2.0], resolution=40, sand=[box([0.3, 1.2], [0.7, 1.8])], cfl=0.8)
    )
    counts = []
    while simulation.particles.position.numpy()[:, 1].min() > 3.0 * simulation.grid.spacing:
        row = simulation.step(min(simulation.stable_dt(), 5e-3))
        counts.append(row["solve_iterations"])
        assert row["coupled_residual"] <= 1e-4
        assert not simulation.stress.now.numpy().any()
    assert len(counts) > 80
    assert max(counts) == 0
