"""Dissipation of friction, and a pattern without dissipation.

They are compared with the forces on the faces.
"""

import numpy as np
import pytest
import warp as wp
from test_sand_stress import RandomSand, make, velocity

from small_sands import advance, box, create, scene
from warp_lcp.granular.packing import Packing
from warp_lcp.granular.report import SandReport
from warp_lcp.granular.stress import Stress, YieldSet
from warp_lcp.granular.stress_kernels import DAMPED
from warp_lcp.granular.wall_friction import SandWalls
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.operators.grid_poisson import SOLID


def without_trace(case: RandomSand) -> np.ndarray:
    """Return the stresses with a traceless deviator.

    In 2-D it is always traceless.
    """
    now = case.stress.now.numpy()
    if case.dimension == 3:
        now[1:4] -= now[1:4].mean(axis=0)
    return now


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("seed", [11, 12])
def test_dissipation_is_the_power_of_friction(dimension: int, seed: int) -> None:
    """Dissipation as the power of friction.

    Sum of s : grad u = - sum over faces of u . div s. A wrong sign, axis or weight in either shows.
    """
    case = make(dimension, seed)
    now = without_trace(case)
    case.stress.now.assign(now)
    case.stress.residual()
    report = SandReport(case.stress)
    report.measure()
    found = report.report(1.0)["dissipation"]
    u = velocity(case)
    friction = now.copy()
    friction[0] = 0.0
    case.stress.now.assign(friction)
    power = 0.0
    for axis, moved in enumerate(velocity(case)):
        inverse = case.field("inverse")[axis]
        on = inverse > 0.0
        force = (moved - case.field("start")[axis])[on] / inverse[on]
        power -= float(u[axis][on] @ force)
    assert abs(power) > 1e-2
    assert found == pytest.approx(power, rel=1e-4)


def checkered(dimension: int) -> tuple[Stress, np.ndarray, np.ndarray, tuple[slice, ...]]:
    """Return the stress of a full box, an impulse with a checkerboard, the latter, deep cells.

    The pressure is 5 with a checkerboard of height 1/2; there are no shears.
    """
    grid = StaggeredGrid((10, 10, 10 if dimension == 3 else 1), 0.1, dimension)
    index = np.zeros(grid.shape, dtype=np.int32)
    index[1:-1, 1:-1, 1:-1] = -1
    base = wp.array(
        np.where(index >= 0, SOLID, 0).astype(np.int8), dtype=wp.int8, device=grid.device
    )
    one = wp.full(grid.shape, 1.0, dtype=wp.float32, device=grid.device)
    packing = Packing(grid, base, one)
    packing.update(one, grid.faces(), 0.01)
    stress = Stress(packing, SandWalls(grid, index, [0.0]))
    k, j, i = np.indices(grid.shape)
    checkers = (-1.0) ** (i + j + (k if dimension == 3 else 0))
    start = np.zeros(stress.now.shape, dtype=np.float32)
    start[0] = (index < 0) * (5.0 + 0.5 * checkers)
    deep = (slice(5, 7) if dimension == 3 else slice(1, 2), slice(5, 7), slice(5, 7))
    stress.begin(YieldSet(0.5), np.zeros(3), 0.01, 0.01)
    return stress, start, checkers, deep


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_checkerboard_that_is_damped_moves_nothing(dimension: int) -> None:
    """Damped checkerboard without motion.

    Moving the pattern from the pressure to the shears leaves the velocity of inner faces unchanged;
    other signs would not.
    """
    stress, start, checkers, deep = checkered(dimension)
    packing = stress.packing
    stress.now.assign(start)
    stress.residual()
    before = [field.numpy().copy() for field in stress.checked.u]
    packing.grid.domain.run(
        stress.velocity.passes.damp, packing.fields, source=wp.clone(stress.now), now=stress.now
    )
    stress.residual()
    taken = start[0][deep] - stress.now.numpy()[0][deep]
    np.testing.assert_allclose(taken, DAMPED * 0.5 * checkers[deep], rtol=1e-4)
    for old, field in zip(before, stress.checked.u, strict=True):
        # The checkerboard pushes each face by twice its height.
        assert np.abs(old[deep]).max() > 0.9
        np.testing.assert_allclose(field.numpy()[deep], old[deep], atol=1e-5)


@pytest.mark.parametrize("dimension", [2, 3])
def test_each_step_begins_with_a_lower_checkerboard(dimension: int) -> None:
    """Height of the checkerboard at the beginning of a step: DAMPED less than at the last end."""
    stress, start, checkers, deep = checkered(dimension)
    stress.now.assign(start)
    stress.begin(YieldSet(0.5), np.zeros(3), 0.01, 0.01)  # of equal length: no other change
    height = stress.now.numpy()[0][deep] - 5.0
    np.testing.assert_allclose(height, (1.0 - DAMPED) * 0.5 * checkers[deep], rtol=1e-4)


@pytest.mark.parametrize("until", [5e-3, 0.2])
def test_crowded_sand_gains_no_energy_in_a_step_of_any_length(until: float) -> None:
    """Energy of dense sand in steps of any length.

    A falling block compresses a jittered bed. Emptying over-full cells within the step made 1e3
    times the energy in 1e-6 s.
    """
    blocks = [box([0.0, 0.0], [1.0, 0.3]), box([0.3, 0.5], [0.6, 0.8], velocity=[0.0, -2.0])]
    simulation = create(
        scene(size=[1.0, 1.0], resolution=24, sand=blocks, friction=0.5, particles={"jitter": 1.0})
    )
    rows = advance(simulation, until)[-1:]
    rows += [simulation.step(dt) for dt in (1e-6, 5e-3, 1e-5, 1e-6, 5e-3, 1e-4, 1e-3, 5e-3)]
    energy = np.array([row["kinetic_energy"] + row["potential_energy"] for row in rows])
    assert np.diff(energy).max() < 1e-3 * energy[0]


def test_walls_hold_sand_up() -> None:
    """Sand held up by walls.

    A silo's walls bear a part of the sand. Sand that expanded hung on them, and weighed more than
    its mass.
    """
    simulation = create(
        scene(
            size=[0.2, 1.0],
            resolution=60,
            sand=[box([0.0, 0.0], [0.2, 0.9])],
            friction=0.5,
            particles={"jitter": 1.0},
        )
    )
    advance(simulation, 0.15)
    depth = 0.9 - (np.arange(60) + 0.5) / 60
    vertical = simulation.stress.now.numpy()[:2, 1, 1:-1, 1:-1].sum(axis=0).mean(axis=1)  # x - s_yy
    load = vertical * simulation.grid.spacing / (simulation.stress.kick_dt * 9.81)
    # Janssen (1895), K = 1/3 .. 1: 0.73 .. 0.49 and 0.55 .. 0.25 of the weight.
    for below, most in ((0.4, 0.75), (0.8, 0.55)):
        row = int((0.9 - below) * 60)
        assert load[row - 2 : row + 3].mean() < most * depth[row]
