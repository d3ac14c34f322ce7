"""Energy balance of a step against known values, and steps of any length.

The steps start in the middle of small scenes.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from warp_lcp.benchmarks.validation import flight, scenes, time_steps
from warp_lcp.benchmarks.validation.energy import EnergyBalance
from warp_lcp.benchmarks.validation.scenes import DENSITY, SUB_CELL, VOXEL, box
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.simulator import simulators

LENGTHS = (0.02, 1e-6, 0.013, 1e-4, 1e-4, 0.02)  # [s]
STILL = {"gravity": [0.0, 0.0]}


def test_free_fall_makes_no_energy_whatever_the_steps() -> None:
    ledger = EnergyBalance(
        scenes.create_liquid(
            VOXEL, [1.0, 1.0], 16, [box([0.3, 0.6], [0.6, 0.9], velocity=[0.5, 1.0])]
        )
    )
    start = ledger.total()
    for dt in LENGTHS:
        assert abs(ledger.step(dt).gained) < 1e-6 * start
    speed = np.hypot(0.5, 1.0 - 9.81 * ledger.simulation.time)
    mass = ledger.simulation.particle_mass * ledger.simulation.particles.count
    assert ledger.total() == pytest.approx(start, rel=1e-6)
    assert ledger.total() - ledger.height() == pytest.approx(0.5 * mass * speed**2, rel=1e-5)


def test_energy_of_source_inflow_is_not_counted_as_gain() -> None:
    """Energy of emitted particles: that of particles at the inflow velocity.

    The first step emits them; nothing else happens.
    """
    source = box([0.0, 0.25], [0.125, 0.5], velocity=[2.0, 0.0])
    simulation = scenes.create_liquid(VOXEL, [1.0, 1.0], 16, [], source=[source], physics=STILL)
    ledger = EnergyBalance(simulation)
    before = simulation.particles.count
    done = ledger.step(0.0625)  # the particles move by two cells
    emitted = simulation.particles.count - before
    assert emitted > 0
    assert done.given == pytest.approx(0.5 * simulation.particle_mass * emitted * 2.0**2, rel=1e-6)
    assert abs(done.gained) < 1e-6 * done.after


def test_the_work_of_a_wall_that_sets_a_plug_in_motion_is_its_momentum_times_its_velocity() -> None:
    """Work of a wall that accelerates liquid from rest to u at once: m u^2.

    Half of it becomes kinetic energy, half is lost in the impact.
    """
    motion = {"kind": "translation", "velocity": [0.8, 0.0]}
    piston = box([-2.0, -1.0], [0.25, 2.0], motion=motion, wall="free-slip")
    simulation = scenes.create_liquid(
        SUB_CELL,
        [1.0, 0.25],
        32,
        [box([0.25, 0.0], [0.5, 0.25])],
        solid=[piston],
        physics=STILL,
        wall="free-slip",
        solver={"tolerance": 1e-8},
    )
    done = EnergyBalance(simulation).step(1e-4)
    assert done.given == pytest.approx(DENSITY * 0.25 * 0.25 * 0.8**2, rel=0.1)
    assert done.gained == pytest.approx(-0.5 * done.given, rel=0.1)


TAP = {"shape": "box", "min": [0.0, 0.5], "max": [0.125, 0.625], "velocity": [1.5, 0.0]}


# Cells along the longest side and times [s] of the tests. Surface tension is left out, since the
# balance has no term for its energy.
SCENES = {
    "balls-on-sand-2d": (48, 0.6),
    "carried-box-2d": (48, 0.7),
    "ceiling-drop": (32, 0.8),
    "column-collapse-2d": (48, 0.7),
    "column-collapse": (24, 0.5),
    "dam-break-2d": (48, 1.2),
    "dam-break": (32, 0.8),
    "floating-bodies-2d": (64, 1.2),
    "floating-bodies": (32, 0.8),
    "honey-coil": (32, 1.5),
    "hourglass-2d": (48, 0.6),
    "hourglass": (28, 0.4),
    "inclined-layer": (32, 0.8),
    "jet": (128, 0.8),
    "mesh-obstacle": (30, 0.6),
    "paint-pour": (24, 1.0),
    "pouring-pile": (24, 1.2),
    "retracting-wall": (60, 1.8),
    "river": (256, 1.6),
    "sand-on-mesh": (24, 0.4),
    "sliding-slab": (32, 0.8),
    "slumping-letter": (32, 1.5),
    "splash-in-circle": (40, 1.2),
    "splash-in-square": (40, 1.0),
    "splash-unilateral": (80, 0.8),
    "stirred-tank": (24, 0.8),
    "tap-and-drain": (32, 1.6),
    "water-labyrinth": (48, 1.6),
    "waterfall": (32, 1.2),
    "wave-maker": (120, 2.4),
}
SHORTER = (1e-6, 1e-5, 1e-4, 1e-3)  # [s], shorter than the normal step
MOST = 1e-3  # share of the total that a step may add


class EnergyGain(NamedTuple):
    """Energy gained by a step of a length [s], and its part from density correction.

    Both are divided by the total energy.
    """

    length: float
    gained: float
    displaced: float


def along(ledger: EnergyBalance, moments: list[float], dt_max: float) -> list[EnergyGain]:
    """Step from moment to moment and try steps of all lengths at each.

    Also rows of short and normal steps in turns.
    """
    simulation, rises = ledger.simulation, list[EnergyGain]()
    for moment in moments:
        while simulation.time < moment or simulation.step_count == 0:
            ledger.step(min(simulation.stable_dt(), dt_max))
        state, energy, total = simulation.state(), ledger.now, ledger.total()
        normal = min(simulation.stable_dt(), dt_max)
        rows: list[tuple[float, ...]] = [
            (length,) for length in (*(t for t in SHORTER if t < normal), normal)
        ]
        for row in [*rows, (0.0, 1e-6) * 2, (0.0, 1e-4) * 2]:
            for length in row:
                done = ledger.step(length or min(simulation.stable_dt(), dt_max))
                rises.append(EnergyGain(length, done.gained / total, done.displaced / total))
            ledger.set_back(state, energy)
    return rises


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_no_step_in_the_middle_of_a_scene_makes_energy(name: str) -> None:
    cells, time = SCENES[name]
    scene = load_scene(name, [f"domain.resolution={cells}"])
    simulation: Any = simulators()[scene.scene.simulator].create(
        scene, device="cpu", folder=Path.cwd()
    )
    rises = along(EnergyBalance(simulation), [0.05 * time, 0.5 * time, time], scene.time.dt_max)
    assert max(rise.gained for rise in rises) < MOST


@pytest.mark.parametrize("what", ["liquid and a tap", "unilateral", "thick liquid", "sand"])
def test_a_step_of_any_length_makes_no_energy(what: str) -> None:
    """No energy gain, except by the density correction.

    The correction changes positions alone and is the same for any step.
    """
    simulation: Any
    if what == "sand":
        simulation = scenes.create_sand([0.8, 0.4], 24, [box([0.0, 0.0], [0.2, 0.3])], walls=0.5)
    else:
        of: dict[str, dict[str, Any]] = {
            "liquid and a tap": {"source": [TAP]},
            "unilateral": {"pressure": {"model": "unilateral"}},
        }
        tables = of.get(what, {"viscosity": {"value": 3000.0}, "wall": "sticky"})
        simulation = scenes.create_liquid(
            VOXEL, [1.0, 0.75], 16, [box([0.0, 0.0], [0.375, 0.5])], **tables
        )
    found = along(EnergyBalance(simulation), [0.02, 0.2], simulation.scene.time.dt_max)
    assert len(found) > 20
    # Loss of creeping material.
    assert max(rise.gained - rise.displaced for rise in found) < (
        0.0 if what == "thick liquid" else MOST
    )


@pytest.mark.parametrize("what", ["liquid, unilateral", "sand"])
def test_an_energy_gain_of_the_old_relaxation_is_detected(what: str) -> None:
    """Detection of the former relaxation, which pushed dense material apart in a step.

    The shorter the step, the faster the material moved.
    """
    _, gained = time_steps.collapse(
        what, 24, 1e-3, change=time_steps.PUSHED_APART[what], moments=np.array([0.01])
    )
    assert gained > time_steps.MOST


@pytest.mark.parametrize("what", ["liquid, whole cells", "sand", "body over liquid"])
def test_thrown_material_follows_its_parabola(what: str) -> None:
    assert flight.off_its_parabola(what, 16, 8.0) < flight.MOST
    assert flight.off_its_parabola(what, 16, 8.0, whole_kicks=True) > 0.1
