"""Bodies and liquid in one pressure problem.

The tests cover its columns, exchange of momentum and energy, and the direction of motion of bodies.
"""

import numpy as np
import pytest
import warp as wp
from pydantic import ValidationError

from small_liquids import advance, box, create, scene
from warp_lcp.simulation import StepFailed

FLAT = {"physics": {"gravity": [0.0, 0.0]}}
VOXEL = {"pressure": {"surface": "voxel"}}


def disc(center, radius, **more):
    return {"shape": "sphere", "center": center, "radius": radius, **more}


def crowded(dimension, model="incompressible"):
    """Return two bodies that share cells, in a tank almost full of liquid.

    One is beside a standing solid and the wall.
    """
    if dimension == 2:
        bodies = [
            disc([0.3, 0.41], 0.13, density=700.0),
            box([0.437, 0.33], [0.7, 0.52], density=2000.0),
        ]
        standing = [box([0.72, 0.0], [1.0, 0.47])]
    else:
        bodies = [
            disc([0.3, 0.41, 0.5], 0.13, density=700.0),
            box([0.437, 0.33, 0.3], [0.7, 0.52, 0.71], density=2000.0),
        ]
        standing = [box([0.74, 0.0, 0.0], [1.0, 0.47, 1.0])]
    liquid = [box([0.0] * dimension, [1.0, 0.8, 1.0][:dimension])]
    return create(
        scene(
            size=[1.0] * dimension,
            resolution=24,
            liquid=liquid,
            solid=[*standing, *bodies],
            pressure={"model": model},
        )
    )


def dense_columns(simulation):
    """Return U as a dense matrix on stored cells."""
    columns = simulation.projection.coupling.columns
    rows, blocks, values = columns.entries()
    U = np.zeros((columns.size, columns.rank))
    for row, block, value in zip(rows, blocks, values, strict=True):
        U[row, block * columns.width : (block + 1) * columns.width] = value
    return U


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("model", ["incompressible", "unilateral"])
@pytest.mark.parametrize("dimension", [2, 3])
def test_the_columns_are_what_velocities_add_to_the_right_hand_side(dimension, model):
    """Columns against the change of the right-hand side by velocities.

    Otherwise the pressure would give bodies another momentum than it takes from the liquid.
    """
    simulation = crowded(dimension, model)
    simulation.step(1e-4)
    projection, rng = simulation.projection, np.random.default_rng(67)
    zero_velocity = [wp.zeros_like(field) for field in simulation.velocity]

    def right_side(velocities):
        for body, v in zip(simulation.bodies.bodies, velocities, strict=True):
            six = np.array([v[0], v[1], 0.0, 0.0, 0.0, v[2]]) if dimension == 2 else v
            body.momentum, body.angular_momentum = (
                body.properties.mass * six[:3],
                body.inertia @ six[3:],
            )
        simulation.boundary.begin_step(simulation.time, 1e-4)
        projection.prepare(zero_velocity, 1e-4, 1e-4)
        return projection._b.numpy().ravel().copy()

    width = 3 if dimension == 2 else 6
    at_rest = right_side(np.zeros((2, width)))
    for _ in range(3):
        V = rng.standard_normal((2, width))
        change, U = right_side(V) - at_rest, dense_columns(simulation)
        np.testing.assert_allclose(U @ V.ravel(), change, atol=4e-7 * np.abs(V).max())
        assert np.abs(change).max() > 0.1
    shared = np.bincount(simulation.projection.coupling.columns.entries()[0]).max()
    assert shared == 2  # cells between the bodies belong to both


def projected(simulation, dt):
    """Project once; return velocities before and after.

    The velocities of the bodies (6 each) are returned too.
    """
    before, recorded = simulation.begin_step(dt), {}
    window = simulation.window(before)
    simulation.particles_to_grid(window)
    prepare = simulation.projection.prepare

    def watched(velocity, *steps):
        recorded["u"] = [field.numpy().astype(np.float64) for field in velocity]
        recorded["V"] = np.array(
            [np.r_[body.velocity, body.angular_velocity] for body in simulation.bodies.bodies]
        )
        return prepare(velocity, *steps)

    simulation.projection.prepare = watched
    simulation._project(window, dt, simulation.top_speed(before))
    after = [field.numpy().astype(np.float64) for field in simulation.velocity]
    return (
        recorded["u"],
        after,
        recorded["V"],
        np.array(
            [np.r_[body.velocity, body.angular_velocity] for body in simulation.bodies.bodies]
        ),
    )


def drop_that_meets_a_body(dimension, ratio, wall):
    """Return liquid that flies against a body, far from all walls.

    It surrounds most of the body.
    """
    weightless = {"physics": {"gravity": [0.0] * dimension}}
    body = box(
        [0.46, 0.4, 0.4][:dimension],
        [0.61, 0.57, 0.57][:dimension],
        density=1000.0 * ratio,
        wall=wall,
    )
    liquid = [
        box(
            [0.25, 0.3, 0.3][:dimension],
            [0.55, 0.6, 0.6][:dimension],
            velocity=[1.0, 0.2, -0.3][:dimension],
        )
    ]
    return create(
        scene(
            size=[1.0] * dimension,
            resolution=20,
            liquid=liquid,
            solid=[body],
            solver={"tolerance": 1e-6},
            **weightless,
            **VOXEL,
        )
    )


@pytest.mark.default_cases(6)
@pytest.mark.parametrize("wall", ["separating", "free-slip"])
@pytest.mark.parametrize("ratio", [0.01, 1.0, 100.0])
@pytest.mark.parametrize("dimension", [2, 3])
def test_momentum_is_exchanged_without_loss_and_energy_without_gain(dimension, ratio, wall):
    """Momentum exchange without loss, and energy without gain.

    Where no wall is near and the surface lies on faces, the pressure's impulses sum to 0, whatever
    the residual of the solve.
    """
    simulation = drop_that_meets_a_body(dimension, ratio, wall)
    before, after, V, W = projected(simulation, 0.01)
    mass, scale = simulation.bodies.bodies[0].properties.mass, 1000.0 * simulation.grid.cell_volume
    touched = simulation.projection.fluid_cells()
    wet = np.zeros(simulation.grid.shape, dtype=bool)
    wet[tuple(touched.T)] = True
    total, energy = np.zeros((2, 3)), np.zeros(2)
    inertia = simulation.bodies.bodies[0].inertia
    for axis, open_ in enumerate(simulation.boundary.open):
        share = open_.numpy() * (wet | np.roll(wet, 1, axis=2 - axis))
        for n, u in enumerate((before[axis], after[axis])):
            total[n, axis] += scale * (share * u).sum()
            energy[n] += 0.5 * scale * (share * u**2).sum()
    for n, v in enumerate((V[0], W[0])):
        total[n] += mass * v[:3]
        energy[n] += 0.5 * mass * v[:3] @ v[:3] + 0.5 * v[3:] @ inertia @ v[3:]
    np.testing.assert_allclose(total[1], total[0], atol=2e-6 * np.abs(total[0]).max())
    # Some momentum was exchanged.
    assert np.abs(mass * (W[0] - V[0])[0]) > 1e-3 * np.abs(total[0]).max()
    assert W[0][0] > 0.0
    assert energy[1] < energy[0]


@pytest.mark.parametrize("above", [True, False])
def test_a_jet_turns_what_it_hits_off_center(above):
    """Torque of a jet that hits off center.

    A force along x above the center turns clockwise: the torque about z is -r_y F_x.
    """
    low = 0.5 if above else 0.3
    liquid = [box([0.1, low], [0.4, low + 0.2], velocity=[2.0, 0.0])]
    body = box([0.42, 0.3], [0.5, 0.7], density=500.0)
    simulation = create(scene(size=[1.0, 1.0], resolution=32, liquid=liquid, solid=[body], **FLAT))
    rows = advance(simulation, 0.05)
    spin = rows[-1]["body0_spin"]
    assert rows[-1]["body0_vx"] > 0.1
    assert (spin < -20.0) if above else (spin > 20.0)
    assert all(row["solve_status"] == "CONVERGED" for row in rows)


@pytest.mark.parametrize("tilt", [15.0, -15.0])
def test_a_tilted_raft_rights_itself(tilt):
    turn = np.radians(tilt)
    center = np.array([0.5, 0.5])
    back = center - np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ center
    raft = box([0.3, 0.45], [0.7, 0.55], density=500.0, rotate=[tilt], translate=back.tolist())
    simulation = create(
        scene(size=[1.0, 1.0], resolution=32, liquid=[box([0.0, 0.0], [1.0, 0.5])], solid=[raft])
    )
    rows = advance(simulation, 0.15)
    turned = rows[-1]["body0_angle"]
    assert np.sign(turned) == -np.sign(tilt)
    assert 2.0 < abs(turned) < 2.0 * abs(tilt)


@pytest.mark.parametrize(("density", "sign"), [(100.0, 1.0), (3000.0, -1.0)])
@pytest.mark.parametrize("model", ["incompressible", "unilateral"])
def test_light_bodies_rise_and_heavy_ones_sink(density, sign, model):
    liquid = [box([0.0, 0.0], [1.0, 0.8])]
    ball = disc([0.5, 0.4], 0.12, density=density)
    simulation = create(
        scene(
            size=[1.0, 1.0], resolution=32, liquid=liquid, solid=[ball], pressure={"model": model}
        )
    )
    rows = advance(simulation, 0.1)
    assert sign * rows[-1]["body0_vy"] > 0.15
    assert abs(rows[-1]["body0_vx"]) < 0.05
    assert sum(row["stuck"] for row in rows) == 0


def test_liquid_separates_from_a_body_that_leaves_it():
    """Separation of liquid from a body that leaves it.

    A separating body that is thrown up out of the water is not held back; a free-slip one pulls the
    water up behind it.
    """
    speeds = {}
    for wall in ("separating", "free-slip"):
        body = box([0.4, 0.3], [0.6, 0.5], density=300.0, velocity=[0.0, 3.0], wall=wall)
        simulation = create(
            scene(
                size=[1.0, 1.0],
                resolution=32,
                liquid=[box([0.0, 0.0], [1.0, 0.31])],
                solid=[body],
                **FLAT,
            )
        )
        rows = advance(simulation, 0.02)
        speeds[wall] = rows[-1]["body0_vy"]
    assert speeds["separating"] == pytest.approx(3.0, rel=1e-3)
    assert speeds["free-slip"] < 2.5


def test_bodies_of_all_weights_in_one_tank():
    """Bodies of all weights in one tank.

    The columns of one problem reach from 1e-3 to 1e3 times the liquid's density.
    """
    densities = (1.0, 30.0, 1000.0, 3e4, 1e6)
    bodies = [
        disc([0.2 + 0.3 * n, 0.3], 0.1, density=density) for n, density in enumerate(densities)
    ]
    simulation = create(
        scene(size=[1.6, 0.8], resolution=64, liquid=[box([0.0, 0.0], [1.6, 0.5])], solid=bodies)
    )
    rows = advance(simulation, 0.06)
    assert all(row["solve_status"] == "CONVERGED" for row in rows)
    assert max(row["solve_iterations"] for row in rows) <= 30
    speeds = [rows[-1][f"body{n}_vy"] for n in range(len(densities))]
    assert min(speeds[:2]) > 0.2
    assert speeds[2] < 0.1
    assert speeds[3] > speeds[4] > -9.81 * 0.06 - 0.01


@pytest.mark.parametrize("body", [box([-0.1] * 3, [0.1] * 3), disc([0.0] * 3, 0.1)])
def test_bodies_of_equal_moments_may_be_turned(body):
    turned = body | {
        "density": 300.0,
        "rotate": [12.0, 34.0, 56.0],
        "translate": [0.4, 0.6, 0.4],
        "angular_velocity": [3.0, -2.0, 1.0],
    }
    model = scene(
        size=[0.8] * 3,
        resolution=8,
        liquid=[box([0.0, 0.0, 0.0], [0.8, 0.65, 0.8])],
        solid=[turned],
    )
    simulation = create(model)
    rows = advance(simulation, 0.03)
    assert {row["solve_status"] for row in rows} == {"CONVERGED"}


def test_a_failed_step_leaves_the_bodies_as_they_were():
    simulation = crowded(2)
    simulation.step(0.001)
    states = simulation.bodies.state()["bodies"].copy()
    simulation.projection.max_iterations, simulation.projection.tolerance = 1, 1e-12
    with pytest.raises(StepFailed):
        simulation.step(0.01)
    np.testing.assert_array_equal(simulation.bodies.state()["bodies"], states)
    simulation.projection.max_iterations, simulation.projection.tolerance = 100, 1e-4
    simulation.step(0.01)


def light_raft():
    """Return a light body, for which the preconditioner is corrected."""
    raft = box([0.3, 0.42], [0.7, 0.55], density=20.0)
    return create(
        scene(size=[1.0, 1.0], resolution=32, liquid=[box([0.0, 0.0], [1.0, 0.5])], solid=[raft])
    )


def test_a_run_goes_on_bit_for_bit_from_a_state():
    rows = []
    first, second = (light_raft() for _ in range(2))
    advance(first, 0.04)
    state = first.state()
    second.restore(state)
    for simulation in (first, second):
        rows.append(advance(simulation, 0.08))
    assert [row["solve_iterations"] for row in rows[0]] == [
        row["solve_iterations"] for row in rows[1]
    ]
    np.testing.assert_array_equal(
        first.particles.position.numpy(), second.particles.position.numpy()
    )
    np.testing.assert_array_equal(first.bodies.state()["bodies"], second.bodies.state()["bodies"])


def test_methods_that_sweep_are_refused_with_bodies():
    body = box([0.3, 0.3], [0.5, 0.5], density=500.0)
    with pytest.raises(
        ValidationError, match=r"cannot be combined with rigid bodies.*use projected-multigrid"
    ):
        scene(
            size=[1.0, 1.0],
            resolution=16,
            liquid=[box([0.0, 0.0], [1.0, 0.4])],
            solid=[body],
            solver={"method": "psor"},
        )


@pytest.mark.parametrize(
    "method", ["projected-multigrid", "minimum-map-newton", "primal-dual-active-set"]
)
def test_methods_agree_on_where_bodies_go(method):
    liquid = [box([0.0, 0.0], [1.0, 0.45])]
    body = box([0.35, 0.4], [0.65, 0.6], density=200.0)
    simulation = create(
        scene(
            size=[1.0, 1.0],
            resolution=24,
            liquid=liquid,
            solid=[body],
            solver={"method": method, "tolerance": 1e-7},
        )
    )
    rows = advance(simulation, 0.2)
    assert rows[-1]["body0_y"] == pytest.approx(0.519893, abs=2e-6)
    assert all(row["solve_status"] == "CONVERGED" for row in rows)


def test_liquid_under_a_body_does_not_accelerate_without_limit():
    """Particles buried by a body.

    Particles between a body and the floor to which it has sunk have no open face near; gravity
    alone would act on them.
    """
    body = box([0.3, 0.05], [0.7, 0.2], density=4000.0)
    simulation = create(
        scene(size=[1.0, 0.75], resolution=32, liquid=[box([0.0, 0.0], [1.0, 0.4])], solid=[body])
    )
    rows = advance(simulation, 1.2)
    assert rows[-1]["body0_y"] == pytest.approx(0.075, abs=0.005)
    assert rows[-1]["max_speed"] < 1.5
