"""Very short steps.

No exchange between liquid and spray may happen once per step, independent of its length.
"""

from pathlib import Path

import numpy as np
import pytest

from small_liquids import advance, box, create, scene
from warp_lcp.fluids import SIMULATOR
from warp_lcp.scene.scene_file import load_scene


@pytest.mark.parametrize("cfl", [0.4, 0.125])
def test_a_drop_that_flies_past_spray_keeps_its_momentum(cfl: float) -> None:
    """Momentum of a drop that flies past spray.

    Without gravity and far from walls there is no force from outside. Spray that took the drop's
    velocity would change the sum by 4 %.
    """
    simulation = create(
        scene(
            size=[2.0, 1.0],
            resolution=40,
            cfl=cfl,
            physics={"gravity": [0.0, 0.0]},
            liquid=[box([0.2, 0.4], [0.5, 0.6], velocity=[1.0, 0.0])],
        )
    )
    rng = np.random.default_rng(20261122)
    spray = np.zeros((400, 3))
    spray[:, 0] = rng.uniform(0.2, 1.8, 400)
    spray[:, 1] = np.where(
        rng.random(400) < 0.5, rng.uniform(0.62, 0.7, 400), rng.uniform(0.3, 0.38, 400)
    )
    simulation.particles.append(spray, np.zeros((400, 3)))
    simulation.particles.sort()

    def momentum() -> np.ndarray:
        return simulation.particle_mass * simulation.particles.velocity.numpy().astype(
            np.float64
        ).sum(axis=0)

    before = momentum()
    advance(simulation, 0.5)
    assert np.abs(momentum() - before).max() < 0.02 * before[0]


@pytest.mark.slow
@pytest.mark.parametrize("cfl", [0.125, 0.0625])  # the shorter the step, the more energy was gained
def test_liquid_poured_over_a_mesh_gains_no_energy_in_short_steps(cfl: float) -> None:
    """Energy of liquid poured over a mesh in short steps.

    Half of it is spray among drops; dragged along with them in every step it reached 60 m/s.
    """
    model = load_scene("mesh-obstacle", ["domain.resolution=20", f"time.cfl={cfl}"])
    simulation = SIMULATOR.create(model, device="cpu", folder=Path())
    energy = np.array(
        [
            row["kinetic_energy"] + row["potential_energy"]
            for row in advance(simulation, 0.46, dt_max=0.0025)
        ]
    )
    assert (energy - np.minimum.accumulate(energy)).max() < 0.05 * energy[0]
    assert energy[-1] < 0.4 * energy[0]


@pytest.mark.parametrize("until", [5e-3, 0.25])
def test_crowded_liquid_gains_no_energy_in_a_step_of_any_length(until: float) -> None:
    """Energy of dense liquid in steps of any length.

    A falling block compresses a jittered pool. Emptying over-full cells within the step made 1e4
    times the energy in 1e-6 s.
    """
    blocks = [box([0.0, 0.0], [1.0, 0.3]), box([0.3, 0.5], [0.6, 0.8], velocity=[0.0, -2.0])]
    tables = {"pressure": {"model": "unilateral"}, "particles": {"jitter": 1.0}}
    simulation = create(scene(size=[1.0, 1.0], resolution=24, cfl=1.0, liquid=blocks, **tables))
    rows = advance(simulation, until)[-1:]
    rows += [simulation.step(dt) for dt in (1e-6, 5e-3, 1e-5, 1e-6, 5e-3, 1e-4, 1e-3, 5e-3)]
    energy = np.array([row["kinetic_energy"] + row["potential_energy"] for row in rows])
    assert np.diff(energy).max() < 1e-3 * energy[0]


@pytest.mark.parametrize("cut", [False, True])
def test_one_drop_that_leaves_a_wall_throws_nothing_after_it(cut: bool) -> None:
    """Drop that leaves a wall without effect on others.

    Nine particles rest on the floor, or on a slab, and one leaves the cell at 4 m/s. No force acts,
    so that additional energy would come from nowhere.
    """
    floor = 0.3 if cut else 0.0
    simulation = create(
        scene(
            size=[1.0, 1.0],
            resolution=10,
            physics={"gravity": [0.0, 0.0]},
            liquid=[box([0.5, 0.7], [0.6, 0.8])],
            solid=[box([-1.0, -1.0], [2.0, floor])] if cut else [],
        )
    )
    position, velocity = np.zeros((2, 10, 3), dtype=np.float32)
    position[:, 0], position[:, 1] = (
        [*np.linspace(0.53, 0.57, 9), 0.55],
        floor + np.array([0.002] * 9 + [0.09]),
    )
    velocity[9, 1] = 4.0
    rows = {name: array.numpy()[:10] * 0 for name, array in simulation.particles.arrays().items()}
    simulation.particles.assign(rows | {"position": position, "velocity": velocity})
    simulation.particles.sort()
    row = simulation.step(1e-3)
    assert row["active"] > 0
    after = simulation.particles.velocity.numpy().astype(np.float64)
    assert (after**2).sum() < 16.0
