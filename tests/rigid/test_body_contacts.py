"""Contacts of bodies with walls, solids and each other, against mechanics.

The tests cover rest, slope, stack and impact.
"""

import numpy as np
import pytest
from bodies_at_hand import GRAVITY, SIDES, bodies_of, run

from warp_lcp.grid.grid_part import SerialCommunicator
from warp_lcp.grid.motion import Pose, Rotation, Translation
from warp_lcp.grid.signed_distance import Box, Capsule, Placement, Plane, Sphere, TriangleMesh
from warp_lcp.grid.triangle_mesh import builtin_mesh
from warp_lcp.grid.voxelize import PlacedSolid
from warp_lcp.rigid.contact_detection import between, on_plane
from warp_lcp.rigid.contact_shape import ContactShape
from warp_lcp.rigid.obstacles import Obstacle

G = 9.81


def box(low, high, dimension, rotate=0.0):
    """Return a box turned by an angle about z; in 3-D from 0.4 to 0.6 along z."""
    if dimension == 3:
        low, high = [*low, 0.4], [*high, 0.6]
    angles = [rotate] if dimension == 2 else [0.0, 0.0, rotate]
    return Box(
        lower=low,
        upper=high,
        placement=Placement.from_degrees(1.0, angles, [0.0] * dimension, dimension),
    )


def solid(geometry, motion=None):
    return PlacedSolid(geometry=geometry, separating=True, name="solid[0]", motion=motion)


def drift(bodies, duration, **settings):
    """Run, and return the largest displacement and rotation of any body."""
    before = [(body.position.copy(), body.rotation.copy()) for body in bodies.bodies]
    run(bodies, duration, **settings)
    moves = [
        np.linalg.norm(body.position - position)
        for body, (position, _) in zip(bodies.bodies, before, strict=True)
    ]
    turns = [
        np.abs(body.rotation - rotation).max()
        for body, (_, rotation) in zip(bodies.bodies, before, strict=True)
    ]
    return max(moves), max(turns)


@pytest.mark.parametrize("dimension", [2, 3])
def test_impulses_that_lift_a_supported_body_release_it(dimension):
    bodies = bodies_of([box([0.4, 0.0], [0.6, 0.25], dimension)], dimension)
    run(bodies, 0.1)
    body, kick = bodies.bodies[0], 0.01 * G
    weight = body.properties.mass * kick
    up = np.zeros(3 if dimension == 2 else 6)
    up[1] = weight
    for load, released in ((-5.0, False), (1.5, False), (2.5, True)):
        bodies.begin_step(bodies.time, 0.01, GRAVITY, 0.01)
        assert body.hold is not None
        body.apply_impulse(load * up)
        before = body.state(), body.received_impulse.copy()
        assert bodies.release_lifted(kick) == released
        if released:
            # It falls, as without contacts, and has received nothing.
            assert body.hold is None and not body.received_impulse.any()
            assert body.momentum[1] == pytest.approx(-weight)
            body.apply_impulse(load * up)
        else:
            assert body.hold is not None
            assert (body.state() == before[0]).all()
            assert (body.received_impulse == before[1]).all()
        bodies.solve_contacts()
        assert body.velocity[1] == pytest.approx(max(load - 1.0, 0.0) * kick, abs=1e-6)
        bodies.restore_step()


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_dropped_box_rests_on_the_floor_without_drift(dimension):
    bodies = bodies_of([box([0.4, 0.1], [0.6, 0.25], dimension)], dimension)
    run(bodies, 1.0)
    assert bodies.bodies[0].position[1] == pytest.approx(0.075, abs=1e-7)
    moved, turned = drift(bodies, 2.0)
    assert moved < 1e-6  # 5e-6 of its size
    assert turned < 1e-5


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_stack_of_two_stands(dimension):
    """Stack of two at rest.

    The upper one overhangs; they start slightly apart.
    """
    bodies = bodies_of(
        [box([0.4, 0.01], [0.6, 0.15], dimension), box([0.47, 0.17], [0.62, 0.3], dimension)],
        dimension,
    )
    run(bodies, 1.0)
    heights = [body.position[1] for body in bodies.bodies]
    np.testing.assert_allclose(heights, [0.07, 0.14 + 0.065], atol=1e-6)
    moved, turned = drift(bodies, 2.0)
    assert moved < 1e-5
    assert turned < 1e-5


def test_a_box_on_one_of_the_same_size_stands():
    """Rest of a box on one of the same size, where corners meet corners.

    There a distance has no direction.
    """
    bodies = bodies_of([box([0.4, 0.0], [0.6, 0.1], 2), box([0.4, 0.1], [0.6, 0.2], 2)], 2)
    moved, _ = drift(bodies, 2.0)
    assert moved < 1e-5


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize(("slope", "slides"), [(0.38, False), (0.42, True)])
def test_a_box_on_a_slope_slides_beyond_the_angle_of_friction(dimension, slope, slides):
    """Sliding of a box beyond the angle of friction.

    In 3-D along a diagonal, where friction boxes would hold more than the cone.
    """
    bodies = bodies_of([box([0.1, 0.0], [0.3, 0.1], dimension)], dimension, friction=0.4)
    angle = np.arctan(slope)
    along = (
        np.array([1.0, 0.0, 0.0]) if dimension == 2 else np.array([1.0, 0.0, 1.0]) / np.sqrt(2.0)
    )
    gravity = G * (np.sin(angle) * along - np.cos(angle) * np.array([0.0, 1.0, 0.0]))
    start, time = bodies.bodies[0].position.copy(), 0.5
    run(bodies, time, gravity=gravity)
    way = (bodies.bodies[0].position - start) @ along
    if not slides:
        assert abs(way) < 2e-7
        return
    pull = G * (np.sin(angle) - 0.4 * np.cos(angle))
    assert bodies.bodies[0].velocity @ along == pytest.approx(pull * time, rel=1e-6)
    # Symplectic Euler in steps of 0.01.
    assert way == pytest.approx(0.5 * pull * time * (time + 0.01), rel=1e-6)


@pytest.mark.every_case
@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("shapes", ["balls", "boxes", "capsule and box"])
def test_an_impact_keeps_the_momentum_and_returns_the_speed(restitution, shapes):
    problem = {
        "balls": [Sphere(center=[0.3, 0.5], radius=0.1), Sphere(center=[0.7, 0.5], radius=0.15)],
        "boxes": [box([0.2, 0.4], [0.4, 0.6], 2), box([0.6, 0.45], [0.7, 0.55], 2)],
        "capsule and box": [
            Capsule(start=[0.3, 0.4], end=[0.3, 0.6], radius=0.05),
            box([0.6, 0.4], [0.7, 0.6], 2),
        ],
    }[shapes]
    bodies = bodies_of(
        problem,
        2,
        open_sides=SIDES,
        restitution=restitution,
        settings=[{"velocity": np.array([2.0, 0.0, 0.0])}, {}],
    )
    one, other = bodies.bodies
    momentum, energy = one.momentum + other.momentum, bodies.kinetic_energy()
    run(bodies, 0.35, dt=0.007, gravity=np.zeros(3))
    np.testing.assert_allclose(one.momentum + other.momentum, momentum, atol=1e-9)
    assert other.velocity[0] - one.velocity[0] == pytest.approx(2.0 * restitution, abs=1e-6)
    m, n = one.properties.mass, other.properties.mass
    lost = 0.5 * m * n / (m + n) * 4.0 * (1.0 - restitution**2)
    assert energy - bodies.kinetic_energy() == pytest.approx(lost, rel=1e-6, abs=1e-6 * energy)


@pytest.mark.parametrize("fast", [0, 1])
def test_a_ball_does_not_fly_through_another_in_a_step(fast):
    """Fast ball against another: no tunnelling within a step.

    It would move by seven of its diameters; the order of the two makes no difference.
    """
    centers, settings = [[0.6, 0.5], [0.6, 0.5]], [{}, {}]
    centers[fast], settings[fast] = [0.2, 0.5], {"velocity": np.array([70.0, 0.0, 0.0])}
    bodies = bodies_of(
        [Sphere(center=center, radius=0.05) for center in centers],
        2,
        open_sides=SIDES,
        settings=settings,
    )
    run(bodies, 0.02, gravity=np.zeros(3))
    behind, ahead = bodies.bodies[fast], bodies.bodies[1 - fast]
    assert ahead.position[0] - behind.position[0] == pytest.approx(0.1, abs=1e-3)
    assert behind.velocity[0] == pytest.approx(35.0) == ahead.velocity[0]


def test_an_oblique_impact_keeps_momentum_and_angular_momentum():
    """Momentum and angular momentum of an oblique impact, with spin and friction."""
    made = [Sphere(center=[0.3, 0.45, 0.5], radius=0.1), box([0.5, 0.4], [0.7, 0.6], 3, 0.0)]
    start = [
        {"velocity": np.array([3.0, 0.3, 0.2]), "angular_velocity": np.array([0.0, 5.0, -10.0])},
        {},
    ]
    bodies = bodies_of(made, 3, restitution=0.7, settings=start, open_sides=SIDES)

    def total():
        return (
            sum(b.momentum for b in bodies.bodies),
            sum(b.angular_momentum + np.cross(b.position, b.momentum) for b in bodies.bodies),
        )

    linear, angular = total()
    energies = run(bodies, 0.3, dt=0.005, gravity=np.zeros(3))
    now = total()
    np.testing.assert_allclose(now[0], linear, atol=1e-9)
    np.testing.assert_allclose(now[1], angular, atol=1e-9)
    assert energies[-1] < energies[0]
    assert np.linalg.norm(bodies.bodies[1].velocity) > 0.1


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_ball_bounces_to_the_square_of_its_restitution(dimension):
    bodies = bodies_of(
        [Sphere(center=[0.5, 0.6, 0.5][:dimension], radius=0.1)], dimension, restitution=0.8
    )
    heights = []
    for _ in range(600):
        run(bodies, 0.001, dt=0.001)
        heights.append(bodies.bodies[0].position[1] - 0.1)
    bottom = int(np.argmin(heights))
    assert max(heights[bottom:]) == pytest.approx(0.64 * 0.5, rel=2e-2)


def test_a_bouncing_ball_comes_to_rest():
    bodies = bodies_of([Sphere(center=[0.5, 0.3], radius=0.1)], 2, restitution=0.5)
    run(bodies, 3.0)
    moved, _ = drift(bodies, 1.0)
    assert moved < 1e-7
    assert bodies.bodies[0].position[1] == pytest.approx(0.1, abs=1e-6)


def test_a_ball_rolls_down_a_slope():
    """Rolling of a ball down a slope.

    Without slip a disc accelerates by 2/3 of the slope's pull.
    """
    bodies = bodies_of([Sphere(center=[0.1, 0.1], radius=0.1)], 2, friction=1.0)
    angle = 0.3
    run(bodies, 0.5, gravity=G * np.array([np.sin(angle), -np.cos(angle), 0.0]))
    disc = bodies.bodies[0]
    assert disc.velocity[0] == pytest.approx(G * np.sin(angle) / 1.5 * 0.5, rel=1e-6)
    assert disc.angular_velocity[2] == pytest.approx(-disc.velocity[0] / 0.1, rel=1e-6)


@pytest.mark.parametrize("dimension", [2, 3])
def test_an_overlap_is_removed_without_speed(dimension):
    bodies = bodies_of([box([0.4, 0.0], [0.6, 0.1], dimension)], dimension)
    bodies.bodies.position[0, 1] -= 2e-3
    energies = run(bodies, 0.5)
    assert energies.max() < 1e-12
    assert bodies.bodies[0].position[1] == pytest.approx(0.05, abs=5e-6)


def test_a_tumbling_box_never_gains_energy():
    bodies = bodies_of(
        [
            Box(
                lower=[0.4, 0.4, 0.4],
                upper=[0.6, 0.5, 0.55],
                placement=Placement.from_degrees(1.0, [20.0, 10.0, 15.0], [0.0] * 3, 3),
            )
        ],
        3,
    )
    total = []
    for _ in range(300):
        run(bodies, 0.005, dt=0.005)
        total.append(bodies.kinetic_energy() + bodies.potential_energy(GRAVITY))
    weight = bodies.bodies[0].properties.mass * G
    assert np.diff(total).max() < weight * 1e-3 * 0.1  # a thousandth of its size in height
    assert bodies.kinetic_energy() < 1e-6 * weight


@pytest.mark.parametrize(
    ("shape", "rest"),
    [
        (
            TriangleMesh(
                surface=builtin_mesh("torus"),
                placement=Placement.from_degrees(0.3, [90.0, 0.0, 0.0], [0.5, 0.1, 0.5], 3),
            ),
            0.045,
        ),
        (Capsule(start=[0.4, 0.2, 0.5], end=[0.6, 0.2, 0.5], radius=0.05), 0.05),
    ],
)
def test_round_bodies_rest_on_a_box(shape, rest):
    table = Box(lower=[0.2, -0.1, 0.2], upper=[0.8, 0.03, 0.8])
    bodies = bodies_of([shape], 3, solids=[solid(table)])
    run(bodies, 1.0)
    assert bodies.bodies[0].position[1] == pytest.approx(0.03 + rest, abs=2e-3 * rest)
    moved, turned = drift(bodies, 0.5)
    assert moved < 1e-5
    assert turned < 1e-4


def test_a_cut_of_a_mesh_rests_in_the_plane():
    """Rest of a mesh's cut in the plane: the torus becomes a ring."""
    ring = TriangleMesh(
        surface=builtin_mesh("torus"), placement=Placement.from_degrees(0.4, [0.0], [0.5, 0.3], 2)
    )
    bodies = bodies_of([ring], 2, solids=[solid(Box(lower=[0.0, 0.0], upper=[1.0, 0.05]))])
    run(bodies, 1.0)
    assert bodies.bodies[0].position[1] == pytest.approx(0.25, abs=1e-3)


def test_a_small_ball_rests_inside_a_ring():
    """Rest of a small ball inside a ring.

    The distance to the cut of a mesh is that in the plane, also inside its hole.
    """
    ring = TriangleMesh(
        surface=builtin_mesh("torus"), placement=Placement.from_degrees(0.8, [0.0], [0.5, 0.5], 2)
    )
    bodies = bodies_of([Sphere(center=[0.5, 0.5], radius=0.05)], 2, solids=[solid(ring)])
    run(bodies, 1.0)
    assert bodies.bodies[0].position[1] == pytest.approx(0.5 - 0.8 * 0.2 + 0.05, abs=1e-3)


def test_a_body_rides_on_a_plate():
    plate = Box(lower=[0.2, 0.1], upper=[0.8, 0.2])
    lift = Translation(velocity=[0.1, 0.2], start=0.0, stop=1.0)
    bodies = bodies_of(
        [box([0.4, 0.2], [0.5, 0.3], 2)], 2, solids=[solid(plate, lift)], friction=0.8
    )
    run(bodies, 0.5)
    np.testing.assert_allclose(bodies.bodies[0].velocity[:2], [0.1, 0.2], atol=1e-6)
    np.testing.assert_allclose(bodies.bodies[0].position[:2], [0.5, 0.35], atol=5e-3)


def test_a_turning_paddle_throws_a_ball():
    paddle = Box(lower=[0.2, 0.48], upper=[0.8, 0.52])
    spin = Rotation(rate=180.0, center=[0.5, 0.5])
    bodies = bodies_of([Sphere(center=[0.7, 0.58], radius=0.05)], 2, solids=[solid(paddle, spin)])
    run(bodies, 0.1, gravity=np.zeros(3))
    assert bodies.bodies[0].velocity[1] > 0.9 * np.pi * 0.2


def test_a_plane_and_an_inverted_box_are_walls():
    ramp = Plane(point=[0.5, 0.3], normal=[-1.0, 1.0])
    room = Box(lower=[0.2, 0.2], upper=[0.9, 0.9], invert=True)
    for other, least in ((solid(ramp), 0.0), (solid(room), 0.2)):
        bodies = bodies_of(
            [Sphere(center=[0.3, 0.6], radius=0.05)], 2, solids=[other], friction=0.0
        )
        run(bodies, 1.0)
        x, y = bodies.bodies[0].position[:2]
        assert y >= least + 0.05 - 1e-6
        assert x >= 0.05 - 1e-6
        if not least:
            assert (np.array([x, y]) - [0.5, 0.3]) @ [-1, 1] / np.sqrt(2) >= 0.05 - 1e-6


def test_open_sides_have_no_wall():
    # The bottom is open.
    bodies = bodies_of([Sphere(center=[0.5, 0.5], radius=0.1)], 2, open_sides=0b0100)
    run(bodies, 1.0)
    assert bodies.bodies[0].position[1] == pytest.approx(0.5 - 0.5 * G * 1.01, rel=1e-9)


@pytest.mark.parametrize(
    ("shapes", "says"),
    [
        ([Sphere(center=[0.05, 0.5], radius=0.1)], "wall"),
        ([Sphere(center=[0.5, 0.5], radius=0.1), Sphere(center=[0.6, 0.5], radius=0.1)], "body 0"),
    ],
)
def test_bodies_that_overlap_at_the_start_are_refused(shapes, says):
    with pytest.raises(ValueError, match=says):
        bodies_of(shapes, 2)
    with pytest.raises(ValueError, match=r"solid\[0\]"):
        bodies_of(
            [box([0.4, 0.4], [0.6, 0.6], 2)],
            2,
            solids=[solid(Sphere(center=[0.5, 0.65], radius=0.1))],
        )


def test_contacts_point_from_the_other_to_the_one():
    """Direction of contacts: from the other body to the one.

    For every kind of pair, on both sides, motion along the normal separates them.
    """
    rng = np.random.default_rng(5150)
    shapes = [
        Box(lower=[-0.1, -0.1, -0.1], upper=[0.1, 0.1, 0.1]),
        Sphere(center=[0.0, 0.0, 0.0], radius=0.1),
        Capsule(start=[-0.05, 0.0, 0.0], end=[0.05, 0.0, 0.0], radius=0.08),
        TriangleMesh(
            surface=builtin_mesh("torus"),
            placement=Placement.from_degrees(0.3, [0.0] * 3, [0.0] * 3, 3),
        ),
    ]
    made = [ContactShape.of(shape, 3) for shape in shapes]
    for one in made:
        for other in made:
            way = rng.normal(size=3)
            way /= np.linalg.norm(way)
            at = Pose(np.eye(3), 0.17 * way)
            touch = between(one, at, other, Pose.identity(), 1.0, 3)
            assert len(touch) > 0
            deepest = int(touch.gap.argmin())
            np.testing.assert_allclose(np.linalg.norm(touch.normal, axis=1), 1.0, atol=1e-6)
            apart = Pose(np.eye(3), 0.17 * way + 0.01 * touch.normal[deepest])
            after = between(one, apart, other, Pose.identity(), 1.0, 3)
            assert after.gap.min() > touch.gap.min() + 0.002
            assert after.gap.min() < touch.gap.min() + 0.0105


@pytest.mark.parametrize("gap", [0.06, -0.02])
def test_a_contact_lies_halfway_between_the_surfaces(gap):
    shape, pose = (
        ContactShape.of(Sphere(center=[0.0, 0.0, 0.0], radius=0.1), 3),
        Pose(np.eye(3), np.array([0.5, 0.1 + gap, 0.5])),
    )
    touch = on_plane(shape, pose, np.zeros(3), np.array([0.0, 1.0, 0.0]), 0.1)
    np.testing.assert_allclose(touch.point, [[0.5, 0.5 * gap, 0.5]], atol=1e-12)
    np.testing.assert_allclose(touch.gap, gap)


def test_obstacles_need_no_name_to_be_found():
    assert Obstacle(name="wall").pose(1.0).translation.tolist() == [0.0, 0.0, 0.0]


def begun(dimension=2, **settings):
    """Return a box at rest on the floor and the impulse of its weight.

    A step has begun.
    """
    bodies = bodies_of([box([0.4, 0.0], [0.6, 0.1], dimension)], dimension, **settings)
    bodies.begin_step(0.0, 0.01, GRAVITY, 0.01)
    return bodies, bodies.bodies[0], bodies.bodies[0].properties.mass * G * 0.01


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_body_on_the_floor_answers_to_the_material_as_the_floor_does(dimension):
    _, body, weight = begun(dimension)
    inverse = body.inverse_mass(dimension)
    assert np.abs(inverse).max() < 1e-9 * np.abs(body.free_inverse_mass(dimension)).max()
    push = np.zeros(3 * dimension - 3)
    push[1] = 0.5 * weight
    body.apply_impulse(push)
    np.testing.assert_allclose(body.velocity, 0.0, atol=1e-7)  # gravity gives 0.1 in the step


def test_without_friction_it_slides_but_does_not_sink():
    _, body, _ = begun(friction=0.0)
    inverse, free = body.inverse_mass(2), body.free_inverse_mass(2)
    assert inverse[0, 0] == pytest.approx(free[0, 0])
    assert abs(inverse[1, 1]) < 1e-9 * free[1, 1]
    np.testing.assert_allclose(inverse, inverse.T)


@pytest.mark.parametrize(("share", "speed"), [(0.5, 0.0), (1.5, 0.5)])
def test_a_material_lifts_a_body_off_the_floor_if_it_bears_its_weight(share, speed):
    bodies, body, weight = begun()
    body.apply_impulse(np.array([0.0, share * weight, 0.0]))
    bodies.end_step(0.01)
    np.testing.assert_allclose(body.velocity, [0.0, speed * G * 0.01, 0.0], atol=1e-8)
    assert body.hold is None


def test_in_the_air_impulses_act_in_full():
    bodies = bodies_of([box([0.4, 0.5], [0.6, 0.6], 2)], 2)
    body = bodies.bodies[0]
    bodies.begin_step(0.0, 0.01, GRAVITY, 0.01)
    impulse, before, inverse = np.array([1.0, 2.0, 0.3]), body.velocities(2), body.inverse_mass(2)
    body.apply_impulse(impulse)
    after = body.velocities(2)
    np.testing.assert_allclose(after, before + inverse @ impulse)
    bodies.end_step(0.01)
    np.testing.assert_allclose(body.velocities(2), after)
    np.testing.assert_allclose(body.position, [0.5 + 0.01 * after[0], 0.55 + 0.01 * after[1], 0.0])


def test_a_step_undone_leaves_nothing():
    bodies, body, weight = begun()
    start = bodies_of([box([0.4, 0.0], [0.6, 0.1], 2)], 2).state()["bodies"]
    body.apply_impulse(np.array([weight, weight, weight]))
    bodies.restore_step()
    np.testing.assert_array_equal(bodies.state()["bodies"], start)
    assert body.hold is None
    with pytest.raises(RuntimeError, match="begin_step"):
        bodies.end_step(0.01)


def test_a_restarted_step_is_independent_of_the_first_attempt():
    (bodies, body, weight), (once, _, _) = begun(), begun()
    body.apply_impulse(np.array([weight, weight, weight]))
    bodies.begin_step(0.0, 0.01, GRAVITY, 0.01)
    for each in (bodies, once):
        each.end_step(0.01)
    np.testing.assert_array_equal(bodies.state()["bodies"], once.state()["bodies"])


def test_a_smooth_body_slides_away_under_a_rough_one():
    """Smooth body that slides from under a rough one.

    The coefficient is the geometric mean of both surfaces.
    """
    made = [box([0.3, 0.0], [0.6, 0.1], 2), box([0.35, 0.1], [0.55, 0.25], 2)]
    bodies = bodies_of(made, 2, settings=[{"friction": 0.0}, {"friction": 1.0}])
    bodies.begin_step(0.0, 0.01, GRAVITY, 0.01)
    bodies.bodies[0].apply_impulse(np.array([1.0, 0.0, 0.0]))
    bodies.end_step(0.01)
    assert bodies.bodies[0].velocity[0] == pytest.approx(1.0 / 15.0)
    assert bodies.bodies[1].velocity[0] == pytest.approx(0.0, abs=1e-9)


def test_a_side_of_an_axis_without_an_end_stops_the_run():
    bodies = bodies_of(
        [Sphere(center=[0.85, 0.5], radius=0.1)],
        2,
        open_sides=SIDES,
        velocity=np.array([1.0, 0.0, 0.0]),
    )
    assert bodies.stop_reason([1.0, 1.0], (0,)) is None
    run(bodies, 0.06)
    assert bodies.stop_reason([1.0, 1.0], ()) is None
    assert "periodic x axis" in bodies.stop_reason([1.0, 1.0], (0,))
    bodies.bodies.momentum[0, 0] = np.inf
    assert "not finite" in bodies.stop_reason([1.0, 1.0], ())


class SecondRank(SerialCommunicator):
    """Second of two ranks; it receives what the first one has shared."""

    size, rank, is_root = 2, 1, False

    def __init__(self, messages):
        self.messages = messages

    def share(self, value):
        return self.messages.pop(0)


class FirstRank(SerialCommunicator):
    """First of two ranks; it stores what it shares."""

    size = 2

    def __init__(self):
        self.messages = []

    def share(self, value):
        self.messages.append(value)
        return value


def test_each_part_of_a_step_ends_with_the_bodies_of_the_first_rank():
    first = FirstRank()
    ball = Sphere(center=[0.5, 0.11], radius=0.1)
    bodies = [bodies_of([ball], 2, ranks=ranks) for ranks in (first, SecondRank(first.messages))]
    bodies[1].bodies[0].momentum = np.array([1e-9, 0.0, 0.0])  # the processors have differed
    for _ in range(3):
        for part in (
            lambda b: b.begin_step(b.time, 0.01, GRAVITY, 0.01),
            lambda b: b.end_step(0.01),
        ):
            for of_rank in bodies:
                part(of_rank)
            states = [of_rank.state() for of_rank in bodies]
            np.testing.assert_array_equal(states[0]["bodies"], states[1]["bodies"])
            assert not first.messages
            bodies[1].bodies[0].momentum = bodies[1].bodies[0].momentum + 1e-9
