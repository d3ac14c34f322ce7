"""Moving solids in liquid against known results.

Plugs of liquid in front of pistons, waves of linear theory.
"""

import math

import numpy as np
import pytest
import warp as wp

from default_run import covering
from small_liquids import GRAVITY, advance, box, create, scene
from warp_lcp.grid.motion import Pose
from warp_lcp.simulation import SimulationFailed

SPEED = 0.5  # of the piston [m/s]
FLAT = {"physics": {"gravity": [0.0, 0.0]}}
DEEP = {"physics": {"gravity": [0.0, 0.0, 0.0]}}


def distance(simulation, points):
    """Return the exact distance of points to the nearest solid at the current time."""
    nearest = np.full(len(points), np.inf)
    for solid in simulation.scene.solid:
        motion = solid.motion.to_motion(simulation.grid.dimension) if solid.motion else None
        geometry = solid.to_geometry(None, simulation.grid.dimension).moved(
            motion.pose(simulation.time) if motion else Pose.identity()
        )
        out = wp.empty(len(points), dtype=wp.float32, device="cpu")
        geometry.signed_distance(wp.array(points, dtype=wp.vec3, device="cpu"), out)
        nearest = np.minimum(nearest, out.numpy())
    return nearest


def piston(*, wall, speed, surface, dimension=2, floor=None):
    """Return a plug of liquid in a channel without gravity, a piston at its left end.

    It slides over a solid floor if that has a height.
    """
    deep = dimension == 3
    size = [1.0, 0.25, 0.25][:dimension]
    high = [0.6, 0.25, 0.25][:dimension]
    # The face of the piston lies within cells.
    body = box([-1.0, -0.5, -0.5][:dimension], [0.43, 0.5, 0.5][:dimension], wall=wall)
    body["motion"] = {"kind": "translation", "velocity": [speed, 0.0, 0.0][:dimension]}
    solids = (
        [body]
        if floor is None
        else [body, box([-1.0, -0.5, -0.5][:dimension], [2.0, floor, 0.5][:dimension])]
    )
    liquid = [box([0.43, 0.0, 0.0][:dimension], high)]
    tables = {
        "wall": "free-slip",
        "pressure": {"surface": surface},
        "solid": solids,
        **(DEEP if deep else FLAT),
    }
    return create(scene(size=size, resolution=32 if deep else 64, liquid=liquid, **tables))


@pytest.mark.default_cases(4)
@pytest.mark.parametrize(("dimension", "surface"), covering([2, 3], ["ghost-fluid", "voxel"]))
@pytest.mark.parametrize(
    ("wall", "speed", "expected"),
    [
        ("separating", SPEED, SPEED),  # the piston pushes the plug,
        ("free-slip", SPEED, SPEED),
        ("free-slip", -SPEED, -SPEED),  # pulls it,
        ("separating", -SPEED, 0.0),  # or leaves the plug behind
    ],
)
def test_a_piston_moves_a_plug_of_liquid(wall, speed, expected, surface, dimension):
    """Motion of a plug of liquid by a piston.

    Without the solid's velocity in the divergence the plug would stay; without it in the separation
    condition it would be pulled.
    """
    simulation = piston(wall=wall, speed=speed, surface=surface, dimension=dimension)
    start = simulation.particles.position.numpy()[:, 0].mean()
    rows = advance(simulation, 0.2)
    deviation = simulation.particles.velocity.numpy() - [expected, 0.0, 0.0]
    np.testing.assert_allclose(deviation.mean(axis=0), 0.0, atol=0.004 * SPEED)
    # By a few particles in the corners of piston and channel.
    assert np.sqrt((deviation**2).mean(axis=0)).max() < 0.04 * SPEED
    moved = simulation.particles.position.numpy()[:, 0].mean() - start
    assert moved == pytest.approx(expected * 0.2, abs=0.05 * simulation.grid.spacing)
    low = simulation.particles.position.numpy()[:, 0].min()
    assert low >= 0.43 + speed * 0.2 - 1e-3 * simulation.grid.spacing
    assert all(row["solve_status"] == "CONVERGED" for row in rows)


@pytest.mark.parametrize("height", [None, 0.037])
@pytest.mark.parametrize("speed", [SPEED, -SPEED])
def test_the_corner_between_a_piston_and_a_floor_turns_nothing_upwards(speed, height):
    """Corner between a piston and a floor: no upward velocity.

    With the normal of the nearest wall, or with the piston's speed on all of a face that both
    close, particles in the corner rose at a quarter and a half of its speed.
    """
    simulation = piston(wall="free-slip", speed=speed, surface="voxel", floor=height)
    most = 0.0
    while simulation.time < 0.2:
        simulation.step(min(simulation.stable_dt(), 0.01))
        most = max(most, float(np.abs(simulation.particles.velocity.numpy()[:, 1]).max()))
    assert most < 0.01 * SPEED
    np.testing.assert_allclose(
        simulation.particles.velocity.numpy()[:, 0], speed, atol=0.01 * SPEED
    )


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("surface", ["ghost-fluid", "voxel"])
def test_a_solid_crosses_the_domain_from_outside_to_outside(surface):
    ball = {
        "shape": "sphere",
        "center": [-0.5, 0.1],
        "radius": 0.09,
        "motion": {"kind": "translation", "velocity": [3.0, 0.5]},
    }
    liquid = [box([0.4, 0.0], [1.0, 0.2])]
    simulation = create(
        scene(
            size=[1.0, 0.5],
            resolution=16,
            liquid=liquid,
            solid=[ball],
            pressure={"surface": surface},
        )
    )
    rows = advance(simulation, 0.7)
    assert max(row["max_speed"] for row in rows) > 0.5
    assert (simulation.boundary.base.numpy()[1, 1:-1, 1:-1] == 0).all()


def test_a_disc_that_turns_in_place_leaves_the_liquid_alone():
    """Disc that turns in place, without effect on the liquid.

    Its wall moves along itself only: a velocity not relative along the normal would stir the
    liquid.
    """
    disc = {"shape": "sphere", "center": [0.5, 0.5], "radius": 0.23}
    disc["motion"] = {"kind": "rotation", "rate": 360.0, "center": [0.5, 0.5]}
    rim = 2.0 * math.pi * 0.23
    simulation = create(
        scene(
            size=[1.0, 1.0],
            resolution=48,
            liquid=[box([0.0, 0.0], [1.0, 0.9])],
            solid=[disc],
            **FLAT,
        )
    )
    advance(simulation, 0.25)
    velocity = np.linalg.norm(simulation.particles.velocity.numpy(), axis=1)
    assert velocity.max() < 0.05 * rim
    assert np.sqrt((velocity**2).mean()) < 0.005 * rim


@pytest.mark.parametrize("half", [0.03, 0.045])
def test_particles_stay_out_of_a_cross_that_turns(half):
    """Blades of 2.4 cells stop particles on their path; those of 3.6 cells push them out."""
    blades = [box([0.2, 0.4 - half], [0.8, 0.4 + half]), box([0.5 - half, 0.1], [0.5 + half, 0.7])]
    for blade in blades:
        blade["motion"] = {"kind": "rotation", "rate": 180.0, "center": [0.5, 0.4]}
    simulation = create(
        scene(size=[1.0, 1.0], resolution=40, liquid=[box([0.0, 0.0], [1.0, 0.7])], solid=blades)
    )
    rows = advance(simulation, 1.0)
    points = simulation.particles.position.numpy()
    inside = distance(simulation, points)
    # At corners, which distances at nodes round off.
    assert inside.min() > -0.25 * simulation.grid.spacing
    assert (inside < -0.05 * simulation.grid.spacing).mean() < 0.005
    assert (sum(row["pushed"] for row in rows) > 0) == (half == 0.045)
    moment = np.cross(points - [0.5, 0.4, 0.0], simulation.particles.velocity.numpy())[:, 2].mean()
    assert moment > 0.02  # the liquid turns with it, counterclockwise


@pytest.mark.slow
def test_waves_of_a_flap_are_as_long_and_high_as_linear_theory_says():
    """Waves of a flap against linear theory.

    For Dean & Dalrymple's flap, hinged at the bottom, H/S = 4 sinh(kh)/(kh) (kh sinh(kh) - cosh(kh)
    + 1) / (sinh(2kh) + 2kh).
    """
    depth, period, angle = 0.35, 1.2, 6.0
    omega = 2.0 * math.pi / period
    k = omega**2 / GRAVITY
    for _ in range(100):
        k = 0.5 * (k + omega**2 / (GRAVITY * math.tanh(k * depth)))
    kh = k * depth
    ratio = (
        4.0
        * math.sinh(kh)
        / kh
        * (kh * math.sinh(kh) - math.cosh(kh) + 1.0)
        / (math.sinh(2.0 * kh) + 2.0 * kh)
    )
    height = ratio * 2.0 * depth * math.sin(math.radians(angle))
    flap = box([-1.0, -0.5], [0.3, 1.5])
    flap["motion"] = {
        "kind": "sinusoid",
        "period": period,
        "angle": angle,
        "center": [0.3, 0.0],
        "phase": 90.0,
    }
    simulation = create(
        scene(size=[6.0, 0.6], resolution=200, liquid=[box([0.0, 0.0], [6.0, depth])], solid=[flap])
    )
    places, times, levels = np.array([1.5, 1.8]), [], []
    advance(simulation, 2.4)  # until waves have passed; their reflections return after 5 s
    while simulation.time < 4.0 * period - 0.01:
        advance(simulation, simulation.time + period / 16)
        points = simulation.particles.position.numpy()
        times.append(simulation.time)
        levels.append(
            [np.percentile(points[np.abs(points[:, 0] - x) < 0.04, 1], 98) for x in places]
        )
    harmonics = 2.0 * (np.array(levels) * np.exp(1j * omega * np.array(times))[:, None]).mean(
        axis=0
    )
    np.testing.assert_allclose(2.0 * np.abs(harmonics), height, rtol=0.1)
    assert np.angle(harmonics[1] / harmonics[0]) / (places[1] - places[0]) == pytest.approx(
        k, rel=0.1
    )


def test_the_step_is_shortened_before_a_solid_sets_off():
    """Shorter step before a solid starts to move.

    At rest gravity alone would allow 0.06 s, in which the piston crosses 19 cells.
    """
    ram = box([-2.0, -0.5], [0.6, 1.5])
    ram["motion"] = {"kind": "translation", "velocity": [6.0, 0.0], "start": 0.05}
    simulation = create(
        scene(size=[2.0, 1.0], resolution=100, liquid=[box([0.6, 0.0], [2.0, 0.4])], solid=[ram])
    )
    assert simulation.stable_dt() == pytest.approx(2.0 * 0.02 / math.sqrt(2.0 * GRAVITY * 0.02))
    advance(simulation, 0.05)
    assert simulation.stable_dt() == pytest.approx(
        2.0 * 0.02 / (6.0 + math.sqrt(2.0 * GRAVITY * 0.02)), rel=0.01
    )


@pytest.mark.parametrize(
    ("wall", "speed", "fails"),
    [("free-slip", 0.5, True), ("free-slip", -0.5, True), ("separating", -0.5, False)],
)
def test_a_piston_in_a_box_full_of_liquid(wall, speed, fails):
    """Piston in a box full of liquid.

    Incompressible liquid can only separate from a separating wall; a shorter step would not help.
    """
    piston = box([-1.0, -1.0], [0.3, 1.0], motion={"kind": "translation", "velocity": [speed, 0.0]})
    simulation = create(
        scene(
            size=[1.0, 0.5],
            resolution=16,
            wall=wall,
            liquid=[box([0.0, 0.0], [1.0, 0.5])],
            solid=[piston],
        )
    )
    if fails:
        with pytest.raises(SimulationFailed, match="fills a closed space"):
            simulation.step(0.01)
        return
    rows = advance(simulation, 0.1)
    assert sum(row["active"] for row in rows) > 0
    # Of the liquid before the step, not after the wall has moved.
    assert rows[0]["volume"] == pytest.approx(0.35, rel=0.01)
    assert sum(row["stuck"] for row in rows) == 0


def test_particles_between_solids_that_close_are_counted():
    jaws = [box([-1.0, -1.0], [0.3, 2.0]), box([0.7, -1.0], [2.0, 2.0])]
    for jaw, speed in zip(jaws, (1.0, -1.0), strict=True):
        jaw["motion"] = {"kind": "translation", "velocity": [speed, 0.0], "stop": 0.25}
    drop = {"shape": "sphere", "center": [0.5, 0.5], "radius": 0.03}
    simulation = create(scene(size=[1.0, 1.0], resolution=20, liquid=[drop], solid=jaws, **FLAT))
    rows = advance(simulation, 0.3)
    assert rows[0]["stuck"] == 0
    assert rows[-1]["stuck"] > 0
