"""Liquid in worlds of newton: bodies float, sink, and exchange momentum."""

from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
import warp as wp

newton = pytest.importorskip("newton", reason="newton is missing: the extra newton")

from newton.solvers import SolverXPBD  # noqa: E402

from warp_lcp.extras.newton.solver import SolverLiquid  # noqa: E402

GRAVITY, WATER = 9.81, 1000.0
pytestmark = pytest.mark.filterwarnings("default")  # newton's own warnings


def world(*bodies, ground=True, gravity=-GRAVITY):
    """Return a model of bodies.

    A body is (position, density, shape, its sizes, ...); each one after the first is added to one
    body.
    """
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, gravity))
    for position, density, *shapes in bodies:
        body = builder.add_body(xform=wp.transform(wp.vec3(*position), wp.quat_identity()))
        for kind, sizes in zip(shapes[::2], shapes[1::2], strict=True):
            cfg = newton.ModelBuilder.ShapeConfig(density=density)
            getattr(builder, f"add_shape_{kind}")(body, cfg=cfg, **sizes)
    if ground:
        builder.add_ground_plane()
    return builder.finalize(device="cpu")


def pool(cells=16, depth=0.5, **more):
    """Return the tables of a liquid in a unit cube centered at the world's origin."""
    liquid = [{"shape": "box", "min": [0.0] * 3, "max": [1.0, 1.0, depth]}]
    return {"domain": {"size": [1.0] * 3, "resolution": cells}, "liquid": liquid, **more}


MIDDLE = (-0.5, -0.5, 0.0)


def together(model, scene, **more):
    return SolverLiquid.coupled(
        model, lambda view: SolverXPBD(view, iterations=10), scene, origin=MIDDLE, **more
    )


def steps(solver, count, dt):
    """Take steps, and yield the state after each."""
    model = solver.model
    now, later, pipeline = model.state(), model.state(), newton.CollisionPipeline(model)
    contacts = pipeline.contacts()
    for _ in range(count):
        now.clear_forces()
        pipeline.collide(now, contacts)
        solver.step(now, later, None, contacts, dt)
        now, later = later, now
        yield now


def heights(state):
    return state.body_q.numpy()[:, 2]


def under(z, half, liquid):
    """Return the share of a box's volume below the level of a liquid.

    The liquid has a volume in the unit cube.
    """
    area = 4.0 * half**2
    level = (liquid - area * (z - half)) / (1.0 - area)
    return (level - (z - half)) / (2.0 * half)


@pytest.mark.parametrize("alone", [True, False])
def test_a_box_of_half_the_density_floats_half_under(alone):
    half, start = 0.15, 0.53
    model, scene = (
        world(((0.0, 0.0, start), 0.5 * WATER, "box", {"hx": half, "hy": half, "hz": half})),
        pool(),
    )
    solver = SolverLiquid(model, scene, origin=MIDDLE) if alone else together(model, scene)
    liquid = solver if alone else solver.solver("liquid")
    volume = liquid.simulation.particles.count * liquid.simulation.particle_mass / WATER
    shares = [under(heights(state)[0], half, volume) for state in steps(solver, 100, 0.02)]
    assert shares[0] == pytest.approx(0.4, abs=0.01)  # so it bobs
    assert max(shares) > 0.55
    assert np.mean(shares[50:]) == pytest.approx(0.5, abs=0.015)
    assert not liquid.row["stuck"]


def test_dense_bodies_sink_onto_the_world_s_floor_and_light_ones_rise():
    boxes = [
        ((x, 0.0, 0.3), density * WATER, "box", {"hx": 0.12, "hy": 0.12, "hz": 0.12})
        for x, density in ((-0.25, 2.5), (0.25, 0.2))
    ]
    *_, state = steps(together(world(*boxes), pool()), 60, 0.02)
    assert heights(state)[0] == pytest.approx(0.12, abs=2e-3)
    assert abs(state.body_qd.numpy()[0]).max() < 0.05
    assert heights(state)[1] > 0.45


@pytest.mark.parametrize("ratio", [0.1, 2.0])
@pytest.mark.parametrize("alone", [True, False])
def test_a_sphere_sets_off_with_its_added_mass(ratio, alone):
    """Added mass of a sphere.

    It is half of its displacement, (1 + 2 q^3) / (1 - q^3) times as much in a round tank of 1/q
    diameters.
    """
    q, dt = 0.25, 1e-3
    added = 0.5 * (1.0 + 2.0 * q**3) / (1.0 - q**3)
    model = world(((0.0, 0.0, 0.5), ratio * WATER, "sphere", {"radius": 0.5 * q}), ground=False)
    scene = pool(32, 1.0, solver={"tolerance": 1e-6})
    solver = SolverLiquid(model, scene, origin=MIDDLE) if alone else together(model, scene)
    *_, state = steps(solver, 3, dt)
    acceleration = state.body_qd.numpy()[0, 2] / (3.0 * dt)
    assert acceleration == pytest.approx((1.0 - ratio) * GRAVITY / (ratio + added), rel=0.1)


def test_a_repeated_step_does_not_run_the_liquid_again_if_bodies_move_as_before():
    """Steps of the liquid under a coupler of three iterations, which is asked three times a step.

    A ball in the air gets no impulse, so each iteration asks for the same motion of it.
    """
    calls = {
        name: mock.patch.object(
            SolverLiquid, name, autospec=True, side_effect=getattr(SolverLiquid, name)
        )
        for name in ("step", "_advance")
    }
    model = world(((0.0, 0.0, 0.85), 0.2 * WATER, "sphere", {"radius": 0.1}))
    solver = together(model, pool(), iterations=3)
    with calls["step"] as asked, calls["_advance"] as run:
        list(steps(solver, 2, 2e-3))
    assert (asked.call_count, run.call_count) == (6, 2)


@pytest.mark.parametrize("iterations", [1, 2])
def test_momentum_is_exchanged_with_newton(iterations):
    """Exchange of momentum.

    A dumbbell of light balls flies into a drop: it gets the momentum of the liquid, with one
    iteration the last impulse a step later.
    """
    balls = [
        "sphere",
        {"radius": 0.08, "xform": wp.transform(wp.vec3(0.0, 0.0, 0.1), wp.quat_identity())},
        "sphere",
        {"radius": 0.1},
    ]
    model = world(((0.0, 0.02, 0.78), 0.5 * WATER, *balls), ground=False, gravity=0.0)
    model.body_qd.assign(np.array([[0.0, 0.0, -2.0, 1.0, 0.0, 0.0]]))
    drop = {"liquid": [{"shape": "sphere", "center": [0.5, 0.5, 0.45], "radius": 0.2}]}
    solver = together(model, pool(20) | drop, iterations=iterations)
    liquid, mass = solver.solver("liquid"), model.body_mass.numpy()[0]
    assert len(liquid.bodies.bodies) == 1
    impulses, received = [np.zeros(3)], []
    for state in steps(solver, 15, 5e-3):
        impulses.append(impulses[-1] + liquid.bodies.impulses[0, :3])
        received.append(mass * (state.body_qd.numpy()[0, :3] - [0.0, 0.0, -2.0]))
    assert impulses[-1][2] > 0.1 * mass * 2.0
    late = impulses[:-1] if iterations == 1 else impulses[1:]
    assert (
        np.abs(np.array(received) - late).max()
        < (1e-5 if iterations == 1 else 5e-3) * impulses[-1][2]
    )
    flowing = (
        liquid.simulation.particles.velocity.numpy().astype(float).sum(axis=0)
        * liquid.simulation.particle_mass
    )
    # Particles near a body have velocities of faces inside it.
    assert flowing[2] == pytest.approx(-impulses[-1][2], rel=0.15)


@pytest.mark.parametrize("name", ["XPBD", "Featherstone"])
def test_a_float_on_a_hinge_swings_up(name):
    builder = newton.ModelBuilder()
    link = builder.add_link(xform=wp.transform(wp.vec3(0.25, 0.0, 0.3), wp.quat_identity()))
    builder.add_shape_sphere(
        link, radius=0.1, cfg=newton.ModelBuilder.ShapeConfig(density=0.2 * WATER)
    )
    at, arm = (
        wp.transform(wp.vec3(*place), wp.quat_identity())
        for place in ((0.0, 0.0, 0.3), (-0.25, 0.0, 0.0))
    )
    builder.add_articulation(
        [
            builder.add_joint_revolute(
                -1, link, parent_xform=at, child_xform=arm, axis=(0.0, 1.0, 0.0)
            )
        ]
    )
    model = builder.finalize(device="cpu")
    solver = SolverLiquid.coupled(
        model, getattr(newton.solvers, f"Solver{name}"), pool(20, 0.8), origin=MIDDLE
    )
    places = np.array([state.body_q.numpy()[0, :3] for state in steps(solver, 80, 5e-3)])
    assert np.abs(np.linalg.norm(places - [0.0, 0.0, 0.3], axis=1) - 0.25).max() < 2e-3
    assert places[:, 2].max() > 0.54
    assert places[-1, 0] < 0.0  # it swings past the top


@pytest.mark.parametrize("alone", [True, False])
def test_kinematic_bodies_push_liquid_and_take_nothing(alone):
    builder = newton.ModelBuilder()
    body = builder.add_body(
        xform=wp.transform(wp.vec3(-0.4, 0.0, 0.25), wp.quat_identity()), is_kinematic=True
    )
    builder.add_shape_box(body, hx=0.06, hy=0.5, hz=0.5)
    model = builder.finalize(device="cpu")
    solver = SolverLiquid(model, pool(), origin=MIDDLE) if alone else together(model, pool())
    liquid = solver if alone else solver.solver("liquid")
    now, later = model.state(), model.state()
    for step in range(10):
        now.body_qd.assign(np.array([[1.0, 0.0, 0.0, 0.0, 0.0, 0.0]]))
        now.body_q.assign(np.array([[-0.4 + 0.01 * step, 0.0, 0.25, 0.0, 0.0, 0.0, 1.0]]))
        solver.step(now, later, None, None, 0.01)
        assert (later.body_q.numpy() == now.body_q.numpy()).all()
        assert liquid.bodies.prescribed.all()
    assert liquid.bodies.impulses[0, 0] < 0.0
    assert liquid.simulation.particles.velocity.numpy()[:, 0].mean() > 0.05
    x = liquid.particles().numpy()[:, 0]
    assert not ((x > -0.35) & (x < -0.25)).any()  # place of the plate


def test_reset_puts_the_liquid_back_and_other_masses_are_taken():
    model = world(((0.0, 0.0, 0.5), 0.5 * WATER, "box", {"hx": 0.15, "hy": 0.15, "hz": 0.15}))
    liquid = SolverLiquid(model, pool(), origin=MIDDLE)
    ends = []
    for density in (0.5, 0.5, 0.9):
        model.body_mass.assign(density / 0.5 * np.array([13.5]))
        liquid.notify_model_changed(newton.ModelFlags.BODY_INERTIAL_PROPERTIES)
        *_, state = steps(liquid, 5, 0.02)
        ends.append(heights(state)[0])
        liquid.reset(state)
    assert ends[0] == ends[1]
    assert ends[2] < ends[0] - 0.01


def test_a_frame_shows_liquid_and_bodies():
    balls = [
        "sphere",
        {"radius": 0.08, "xform": wp.transform(wp.vec3(0.0, 0.0, 0.1), wp.quat_identity())},
        "sphere",
        {"radius": 0.1},
    ]
    liquid = SolverLiquid(world(((0.0, 0.0, 0.4), 500.0, *balls)), pool(), origin=MIDDLE)
    parts = {part.name: part for part in liquid.simulation.frame()}
    top = parts["bodies"].points[:, 2].max()
    assert top == pytest.approx(0.4 + 0.1 + 0.08, abs=1e-3)


def test_graph_capture_is_refused():
    model = world(((0.0, 0.0, 0.5), 500.0, "sphere", {"radius": 0.1}))
    liquid, state = SolverLiquid(model, pool(), origin=MIDDLE), model.state()
    with (
        wp.ScopedDevice("cpu"),
        pytest.raises(RuntimeError, match="inside a captured graph"),
        wp.ScopedCapture(),
    ):
        liquid.step(state, state, None, None, 0.01)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"solid": [{"shape": "sphere", "center": [0.5] * 3, "radius": 0.1, "mass": 1.0}]},
            "rigid bodies come from the model",
        ),
        ({"solver": {"method": "psor"}}, "solver.method"),
        (
            {
                "domain": {"size": [1.0, 1.0], "resolution": 16},
                "liquid": [{"shape": "box", "min": [0, 0], "max": [1, 0.5]}],
            },
            "must have 2 entries",
        ),
    ],
)
def test_unsupported_features_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        SolverLiquid(
            world(((0.0, 0.0, 0.5), 500.0, "sphere", {"radius": 0.1})),
            pool() | change,
            origin=MIDDLE,
        )


def test_unsupported_worlds_are_refused():
    ball = world(((0.0, 0.0, 0.5), 500.0, "sphere", {"radius": 0.1}))
    with pytest.raises(ValueError, match="have no shapes"):
        SolverLiquid(ball, pool(), bodies=[1])
    with pytest.raises(ValueError, match="dt = 0"):
        SolverLiquid(ball, pool(), origin=MIDDLE).step(ball.state(), ball.state(), None, None, 0.0)
    many, one = newton.ModelBuilder(), newton.ModelBuilder()
    one.add_shape_sphere(one.add_body(), radius=0.1)
    many.replicate(one, 2)
    with pytest.raises(ValueError, match="2 worlds"):
        SolverLiquid(many.finalize(device="cpu"), pool())
    walls = newton.ModelBuilder()
    walls.add_shape_plane(width=1.0, length=1.0)
    with pytest.raises(ValueError, match="PLANE encloses no volume"):
        SolverLiquid(walls.finalize(device="cpu"), pool())


def test_newton_s_basic_shapes_fall_into_liquid():
    """newton's basic shapes falling into liquid.

    Its example's world: ellipsoid, cylinder, ball, capsule, box, a mesh and a cone, as dense as
    water, fall from 2 m.
    """
    pytest.importorskip("pxr", reason="OpenUSD, with which the example reads its mesh, is missing")
    from newton.examples.basic.example_basic_shapes import Example
    from newton.viewer import ViewerNull

    size, states = [2.0, 14.0, 3.0], {}
    scene = {
        "domain": {"size": size, "resolution": 70},
        "liquid": [{"shape": "box", "min": [0.0] * 3, "max": [2.0, 14.0, 1.4]}],
    }
    with wp.ScopedDevice("cpu"):
        for wet in (False, True):
            example = Example(ViewerNull(), SimpleNamespace(solver="xpbd"))
            if wet:
                example.solver = SolverLiquid.coupled(
                    example.model,
                    lambda view: SolverXPBD(view, iterations=5),
                    scene,
                    origin=(-1, -7, 0),
                )
            example.sim_substeps, example.sim_dt = 1, 0.02
            for _ in range(40):
                example.simulate()
            states[wet] = example.state_0
    row = example.solver.solver("liquid").row
    wet, dry = (heights(states[name]) for name in (True, False))
    assert len(wet) == 7
    assert np.isfinite(states[True].body_q.numpy()).all()
    assert (wet > dry - 0.01).all()
    assert (wet - dry).max() > 0.3
    assert row["mass"] == pytest.approx(WATER * 2.0 * 14.0 * 1.4, rel=0.05)
    assert row["stuck"] < 1e-3 * row["particles"]
