"""Moving solids in sand that enter and leave the domain."""

import math
from typing import Any

import numpy as np
import pytest
import warp as wp

from small_sands import GRAVITY, advance, box, create, scene
from warp_lcp.granular.simulator import SandSimulation
from warp_lcp.simulation import StepFailed

SPEED = 0.5  # of a paddle [m/s]
FEW = {"max_iterations": 60}  # of a solve: enough where its accuracy does not matter


def push(velocity: list[float], **more: Any) -> dict[str, Any]:
    """Return a motion at a constant velocity."""
    return {"kind": "translation", "velocity": velocity, **more}


def depth_in_solids(simulation: SandSimulation) -> float:
    """Return the largest depth of a particle in a solid, in cells."""
    dimension, points = simulation.grid.dimension, simulation.particles.position.numpy()
    deepest = -math.inf
    for solid in simulation.scene.solid:
        geometry = solid.to_geometry(None, dimension)  # type: ignore[arg-type]
        if solid.motion is not None:
            geometry = geometry.moved(solid.motion.to_motion(dimension).pose(simulation.time))
        out = wp.empty(len(points), dtype=wp.float32, device="cpu")
        geometry.signed_distance(wp.array(points, dtype=wp.vec3, device="cpu"), out)
        deepest = max(deepest, float(-out.numpy().min()))
    return deepest / simulation.grid.spacing


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_paddle_pushes_sand_and_none_gets_behind_it(dimension: int) -> None:
    """Sand pushed by a paddle; none gets behind it.

    Without the solid's velocity in the pressure problem the sand before it would stay at rest or
    pile up in it.
    """
    blade = {
        **box([-0.5, -1.0, -1.0][:dimension], [0.2, 2.0, 2.0][:dimension]),
        "motion": push([SPEED, 0.0, 0.0][:dimension]),
    }
    size, high = [1.0, 0.4, 0.2][:dimension], [0.5, 0.2, 0.2][:dimension]
    sand = [box([0.2, 0.0, 0.0][:dimension], high)]
    simulation = create(
        scene(
            size=size,
            resolution=40 if dimension == 2 else 20,
            sand=sand,
            solid=[blade],
            friction=0.0,
            solver=FEW,
        )
    )
    rows = advance(simulation, 0.4)
    position, velocity = (
        simulation.particles.position.numpy(),
        simulation.particles.velocity.numpy(),
    )
    face = 0.2 + SPEED * simulation.time
    assert position[:, 0].min() > face - 0.05 * simulation.grid.spacing
    assert depth_in_solids(simulation) < 0.05
    near = position[:, 0] < face + 0.05
    assert velocity[near, 0].mean() == pytest.approx(SPEED, rel=0.15)
    assert velocity[:, 0].mean() > 0.5 * SPEED
    assert rows[-1]["mass"] == rows[0]["mass"]
    assert sum(row["stuck"] for row in rows) == 0


def test_a_plate_that_is_pulled_from_under_sand_lets_it_fall() -> None:
    """Fall of sand after a plate below it is pulled away.

    The layer falls by the plate's height onto the floor and keeps its mass.
    """
    plate = {**box([-0.1, -0.1], [1.1, 0.2]), "motion": push([0.0, -4.0])}
    simulation = create(
        scene(
            size=[1.0, 0.75],
            resolution=32,
            sand=[box([0.0, 0.2], [1.0, 0.4])],
            solid=[plate],
            friction=0.0,
            solver=FEW,
        )
    )
    before = simulation.particles.position.numpy()[:, 1].mean()
    advance(simulation, 0.1)
    fallen = before - simulation.particles.position.numpy()[:, 1].mean()
    # The plate leaves faster than sand falls: it does not pull.
    assert fallen == pytest.approx(0.5 * GRAVITY * 0.1**2, rel=0.1)
    advance(simulation, 0.45)
    assert before - simulation.particles.position.numpy()[:, 1].mean() == pytest.approx(
        0.2, abs=0.02
    )


def test_a_plate_that_rises_carries_its_load() -> None:
    lift = {**box([-0.1, -0.3], [1.1, 0.1]), "motion": push([0.0, 0.4])}
    simulation = create(
        scene(
            size=[1.0, 0.75],
            resolution=32,
            sand=[box([0.0, 0.1], [1.0, 0.3])],
            solid=[lift],
            friction=0.0,
            solver=FEW,
        )
    )
    before = simulation.particles.position.numpy()[:, 1].mean()
    advance(simulation, 0.3)
    assert simulation.particles.position.numpy()[:, 1].mean() - before == pytest.approx(
        0.12, abs=0.02
    )
    assert depth_in_solids(simulation) < 0.05


def test_a_belt_drags_sand_along_with_friction_and_not_without() -> None:
    """Sand on a belt, with and without friction.

    A floor slides along itself: mu g is the acceleration until the sand has its speed.
    """
    found = []
    for friction in (0.0, 0.3):
        belt = {**box([-3.0, -1.0], [4.0, 0.1]), "motion": push([0.6, 0.0]), "friction": friction}
        sand = [box([0.3, 0.1], [0.9, 0.2])]
        simulation = create(
            scene(
                size=[2.0, 0.5],
                resolution=80,
                sand=sand,
                solid=[belt],
                friction=0.0,
                material={"friction_angle": 40.0},
            )
        )
        advance(simulation, 0.1)
        position, velocity = (
            simulation.particles.position.numpy(),
            simulation.particles.velocity.numpy(),
        )
        found.append(float(velocity[np.abs(position[:, 0] - 0.6) < 0.15, 0].mean()))
    assert found[0] == pytest.approx(0.0, abs=0.03)
    assert found[1] == pytest.approx(0.3 * GRAVITY * 0.1, rel=0.25)


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_solid_comes_in_from_outside_and_leaves(dimension: int) -> None:
    ball = {
        "shape": "sphere",
        "center": [-0.5, 0.12, 0.15][:dimension],
        "radius": 0.09,
        "motion": push([3.0, 0.5, 0.0][:dimension]),
    }
    size = [1.0, 0.5, 0.3][:dimension]
    sand = [box([0.4, 0.0, 0.0][:dimension], [1.0, 0.2, 0.3][:dimension])]
    resolution = 20 if dimension == 2 else 10
    simulation = create(
        scene(
            size=size, resolution=resolution, sand=sand, solid=[ball], solver={"max_iterations": 40}
        )
    )
    rows = advance(simulation, 0.7)
    assert max(row["max_speed"] for row in rows) > 0.5
    assert (simulation.solids.base.numpy()[1, 1:-1, 1:-1] == 0).all()
    assert rows[-1]["particles"] == rows[0]["particles"]


def test_solids_that_close_the_domain_end_no_run() -> None:
    press = {**box([-0.1, 0.3], [0.6, 2.0]), "motion": push([0.0, -1.0])}
    simulation = create(
        scene(
            size=[0.5, 0.5],
            resolution=16,
            sand=[box([0.0, 0.0], [0.5, 0.1])],
            solid=[press],
            solver=FEW,
        )
    )
    rows = advance(simulation, 0.4)  # the press passes the floor at 0.3 s
    assert rows[-1]["stuck"] > 0
    assert math.isfinite(rows[-1]["kinetic_energy"])


def test_sand_deflected_by_a_wall_is_not_counted_as_accelerated() -> None:
    """Sand stopped by a wall at a high speed.

    A wall removes the component -1e6 m/s. float32 ends the solve far above g dt, and the energy
    falls to 0.6 of itself.
    """
    sand = [box([0.0, 0.0], [0.375, 0.375], velocity=[-1e6, 1e6])]
    simulation = create(scene(size=[1.0, 0.5], resolution=16, sand=sand))
    simulation.step(simulation.stable_dt())
    fastest = max(float(np.abs(u.numpy()).max()) for u in simulation.velocity)
    assert 1.1e6 < fastest < math.sqrt(2) * 1e6


def test_sand_without_solids_that_finds_no_stresses_says_so() -> None:
    """Failed stresses without solids are reported.

    At 1e6 m/s with steps of a second 20 iterations are too few; there is no velocity of solids to
    compare with.
    """
    sand = [box([0.0, 0.0], [0.375, 0.375], velocity=[1e6, 0.0])]
    few = {"max_iterations": 20}
    simulation = create(scene(size=[1.0, 0.5], resolution=16, sand=sand, solver=few))
    with pytest.raises(StepFailed, match="would add energy to the sand"):
        for _ in range(3):
            simulation.step(1.0)
