"""Scenes of contacts: equal velocities by all methods, and known statics."""

import numpy as np
import pytest

import warp_lcp as wl
from default_run import slow
from warp_lcp.gallery.contact_scenes import (
    SCENES,
    arched_snake,
    box_stack,
    contact_scene,
    gear_pyramid,
    heavy_on_light,
    incline,
    motor_arm,
    sphere_stack,
    wall,
)
from warp_lcp.gallery.rigid_world import World
from warp_lcp.grid.signed_distance import Sphere
from warp_lcp.rigid.contact_models import BoxedModel, StewartTrinkleModel

DT = 0.01
SMALL = {
    "box-stack": 3,
    "wall": 2,
    "heavy-on-light": 1,
    "arched-snake": 5,
    "heavy-on-snake": 5,
    "leaning-wall": 2,
    "gear-pyramid": 2,
}
TIGHT = wl.StoppingCriteria(rtol=1e-10, max_iterations=20_000, patience=20_000)


@pytest.mark.parametrize("name", SCENES)
def test_scenes_are_problems_that_repeat(name):
    problem, again = contact_scene(name, SMALL.get(name)), contact_scene(name, SMALL.get(name))
    assert problem.name == again.name and np.array_equal(problem.b, again.b)
    A = problem.A.toarray()
    assert np.array_equal(A, A.T) and np.linalg.eigvalsh(A)[0] > -1e-12 * abs(A).max()
    assert problem.kind == "sparse"
    world = SCENES[name](SMALL.get(name, 2))
    assert world.deepest() < 0.01 * world.size  # nothing begins inside something else
    assert (
        not np.array_equal(
            problem.A.toarray(), contact_scene(name, SMALL.get(name), seed=7).A.toarray()
        )
        or not np.array_equal(problem.b, contact_scene(name, SMALL.get(name), seed=7).b)
        or name in ("arched-snake", "heavy-on-snake", "hanging-snake")
    )  # only its limits are drawn


def test_gears_of_a_row_are_less_than_a_tooth_apart():
    world = gear_pyramid(3)
    gears = [body for body, fixed in zip(world.bodies, world.fixed, strict=True) if not fixed]
    assert len(gears) == 3 + 2 + 1
    centers = np.array([body.position for body in gears])
    reach, tooth = np.hypot(0.3, 0.05), 0.1  # a bar is 0.6 m long and 0.1 m wide
    for row in (centers[:3], centers[3:5]):
        gaps = np.diff(row[:, 0]) - 2 * reach
        assert ((gaps > 0) & (gaps < tooth)).all()
    np.testing.assert_allclose(centers[3:5, 0], (centers[:2, 0] + centers[1:3, 0]) / 2, atol=1e-14)


@pytest.mark.parametrize("name", [n for n in SCENES if n not in ("driven-gears", "hanging-snake")])
def test_lemke_and_newton_find_the_same_velocities(name):
    """Velocities of these scenes by independent methods.

    Impulses are not unique, velocities are.
    """
    world = SCENES[name](SMALL.get(name, 2))
    assembly = world.assemble(DT)
    system, model, found = assembly.system, StewartTrinkleModel(4), []
    problem = model.problem(system).dense()
    for method in (wl.Lemke(), wl.FischerNewton()):
        result = wl.solve(
            problem.lcp(device="cpu"),
            method,
            # With two threads of BLAS pivots of heavy-on-light are exact to 1.05e-8 only.
            stopping=wl.StoppingCriteria(rtol=1e-7, max_iterations=500, patience=500),
        )
        assert result, (method, result.status)
        r = model.impulses(system, result.x.numpy())
        u = system.B @ r + system.q
        assert (r[system.normals] >= -1e-6).all() and (u[system.normals] >= -1e-6).all()
        slip, radius = np.abs(r[system.tangents]).sum(axis=1), system.friction * r[system.normals]
        assert (slip <= radius + 1e-6 * (1 + radius)).all()  # K = 4: the one-norm
        found.append(assembly.velocity(r))
    np.testing.assert_allclose(found[0], found[1], atol=2e-6)


@pytest.mark.parametrize(
    "world",
    [sphere_stack(4), heavy_on_light(1, ratio=100.0), slow(box_stack(3)), slow(wall(3, columns=2))],
    ids=lambda w: w.name,
)
def test_the_ground_carries_the_weight(world):
    assembly = world.assemble(DT)
    system = assembly.system
    method = wl.SubspaceMinimization(precision="double", backtracks=-1)
    result = wl.solve(BoxedModel().problem(system).lcp(device="cpu"), method, stopping=TIGHT)
    assert result, result.status
    r = result.x.numpy()
    on_ground = assembly.contacts.second == len(world.bodies)
    assert r[system.normals][on_ground].sum() == pytest.approx(
        sum(world.mass) * 9.81 * DT, rel=1e-7
    )
    np.testing.assert_allclose(assembly.velocity(r), 0, atol=1e-8)


def test_a_stack_by_its_name_is_of_boxes_of_water_about_to_fall_for_a_hundredth_of_a_second():
    world = box_stack(2)
    assert [body.properties.mass for body in world.bodies] == pytest.approx([1000.0 * 0.5**3] * 2)
    assert (world.assemble(DT).system.friction == 0.5).all()
    # All contacts are closed and at rest.
    assert contact_scene("box-stack", 2).b.min() == pytest.approx(-9.81 * 0.01)


@pytest.mark.parametrize("mu", [0.2, 0.5])
@pytest.mark.parametrize("steeper", [0.95, 1.05, 1.5])
def test_a_box_sticks_below_the_angle_of_friction_and_slides_above(mu, steeper):
    angle = float(np.arctan(mu)) * steeper
    world = incline(1, angle=angle, friction=mu)
    assembly = world.assemble(DT)
    for model, method in (
        (BoxedModel(), wl.ProjectedSOR(omega=1.0)),
        (StewartTrinkleModel(4), wl.Lemke()),
    ):
        result = wl.solve(
            model.problem(assembly.system).dense().lcp(device="cpu"), method, stopping=TIGHT
        )
        assert result, result.status
        v = assembly.velocity(model.impulses(assembly.system, result.x.numpy()))[0]
        speed = max(0.0, 9.81 * (np.sin(angle) - mu * np.cos(angle))) * DT
        np.testing.assert_allclose(
            v[:3], speed * np.array([np.cos(angle), 0, -np.sin(angle)]), atol=1e-8
        )
        np.testing.assert_allclose(v[3:], 0, atol=1e-7)


def test_an_arch_presses_on_its_feet_and_closes():
    world = arched_snake(7)
    feet = world.contacts()
    assert set(feet.first.tolist()) == {0, 6}
    assert (feet.second == 7).all()
    for hinge in world.hinges:
        a, b = (hinge.side(world.bodies, number)[1] for number in (hinge.first, hinge.second))
        np.testing.assert_allclose(a, b, atol=1e-12)
        assert hinge.angle(world.bodies) == pytest.approx(0.0, abs=1e-12)


def test_motors_turn_at_their_speed_as_far_as_their_torque_reaches():
    for torque, reached in ((4000.0, True), (1.0, False)):
        world = motor_arm(2, torque=torque)
        assembly = world.assemble(DT)
        result = wl.solve(
            BoxedModel().problem(assembly.system).lcp(device="cpu"),
            wl.ProjectedSOR(omega=1.0),
            stopping=TIGHT,
        )
        v = assembly.velocity(result.x.numpy())
        rates = [v[1, 4], v[2, 4] - v[1, 4]]  # about y
        wanted = [hinge.motor_speed for hinge in world.hinges]
        if reached:
            np.testing.assert_allclose(rates, wanted, atol=1e-6)
        else:
            assert abs(np.subtract(rates, wanted)).max() > 0.05
            limits = np.isfinite(assembly.system.upper)
            assert np.isclose(np.abs(result.x.numpy()[limits]), assembly.system.upper[limits]).any()


def test_wrong_scenes_are_named():
    with pytest.raises(ValueError, match="no such scene"):
        contact_scene("castle")
    for make in (
        lambda: box_stack(0),
        lambda: wall(1, columns=0),
        lambda: arched_snake(2),
        lambda: gear_pyramid(0),
        lambda: incline(angle=2.0),
    ):
        with pytest.raises(ValueError, match="must be"):
            make()
    with pytest.raises(ValueError, match="must be odd"):
        arched_snake(4)
    with pytest.raises(ValueError, match="friction = -1"):
        World("", [Sphere(center=[0, 0, 1], radius=1.0)], [1.0], friction=-1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "world", [box_stack(10), heavy_on_light(2, ratio=1000.0)], ids=lambda w: w.name
)
def test_nncg_beats_sweeps_on_stacks_and_mass_ratios(world):
    """NNCG against sweeps on stacks and mass ratios, [Book] fig. 2.12.

    If friction is projected by the bounds before the move along p, the advantage is lost: a factor
    of 2 on the heavy box.
    """
    problem = BoxedModel().problem(world.assemble(DT).system).lcp(device="cpu")
    stopping = wl.StoppingCriteria(rtol=1e-13, max_iterations=1000, patience=1000)
    sweeps, nncg = (
        wl.solve(problem, method, stopping=stopping).residual
        for method in (wl.ProjectedSOR(omega=1.0), wl.NNCG())
    )
    assert nncg < sweeps / 100


def test_subspace_minimization_with_affine_bounds_solves_stacks():
    """Subspace minimization with affine bounds on stacks.

    If active friction did not follow its moving normal impulse, the residual would end at that of
    sweeps, 1e-3.
    """
    problem = BoxedModel().problem(box_stack(10).assemble(DT).system).lcp(device="cpu")
    result = wl.solve(
        problem, wl.SubspaceMinimization(precision="double", backtracks=-1), stopping=TIGHT
    )
    assert result, result.status
    assert result.linear_iterations < 1000
