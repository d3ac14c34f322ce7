"""Scenes with joints and targets.

The tests cover snakes, motors, gears and reaching arms, refusals, resuming, frames and images.
"""

import csv
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
import scipy.optimize

from command_line import succeed
from default_run import few, slow
from every_step import differences_by_step
from warp_lcp.contacts.kinematics import KinematicSimulation
from warp_lcp.contacts.methods import JOINTED, KINEMATIC
from warp_lcp.contacts.scene import ContactScene
from warp_lcp.contacts.simulator import ContactSimulation, ContactSimulator
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.table import SceneError
from warp_lcp.simulation import Surface

Z = [0.0, 0.0, 1.0]


def bar(x: float, y: float = 1.5, **more: Any) -> dict[str, Any]:
    """Return a bar of 0.4 m along x that begins at x."""
    return {
        "shape": "box",
        "min": [x, y - 0.05, 0.95],
        "max": [x + 0.4, y + 0.05, 1.05],
        "density": 1000.0,
        **more,
    }


def hinge(*solids: int, at: float, **more: Any) -> dict[str, Any]:
    return {"kind": "hinge", "solids": list(solids), "anchor": [at, 1.5, 1.0], "axis": Z, **more}


def tables(joints: list[dict[str, Any]], **more: Any) -> dict[str, Any]:
    """Return a scene of two bars and a fixed post."""
    post = {"shape": "box", "min": [0.2, 0.0, 0.8], "max": [0.5, 2.0, 1.2]}
    time = {"duration": 1.0, "frames_per_second": 10, "dt_max": 0.01}
    own = {
        "solid": [post, bar(0.6), bar(1.05)],
        "joint": joints,
        "domain": {"size": [3.0, 3.0, 2.0]},
        "time": time,
    }
    return {"scene": {"simulator": "contacts"}, **own, **more}


JOINTS = [hinge(1, 0, at=0.55), hinge(2, 1, at=1.02, limits=[-20.0, 20.0])]
REACH = {
    "solid": 2,
    "point": [1.45, 1.5, 1.0],
    "times": [0.0, 1.0],
    "places": [[1.45, 1.5, 1.0], [0.9, 2.1, 1.0]],
}


def loaded(source: Any, *overrides: str) -> ContactScene:
    scene = load_scene(source, overrides)
    assert isinstance(scene, ContactScene)
    return scene


def made(scene: ContactScene) -> Any:
    return ContactSimulator().create(scene, device="cpu", folder=Path())


def test_a_chain_falls_and_stays_together() -> None:
    """Fall of a chain.

    Its limit holds. Energy does not grow, except for oscillations of second order in the step: 3e-4
    of the kinetic energy.
    """
    scene = loaded(tables(JOINTS, solver={"tolerance": 1e-6}))
    assert scene.solver.method == JOINTED
    simulation, energies = made(scene), []
    assert isinstance(simulation, ContactSimulation)
    for _ in range(40):
        row = simulation.step(0.01)
        energies.append(row["kinetic_energy"] + row["potential_energy"])
        assert row["joint_error"] < 1e-6
        assert abs(row["joint1_angle"]) < 20.01
        assert (row["solver"], row["solve_status"]) == (JOINTED, "CONVERGED")
        assert row["solve_residual"] <= 1e-6
    assert tuple(row) == simulation.columns()
    assert np.diff(energies).max() < 3e-4 * row["kinetic_energy"]
    assert energies[-1] < energies[0]


def test_a_scene_in_the_plane() -> None:
    """Planar scene of two bars on hinges.

    They fall as if fixed to each other where the limits of the second are 0.
    """
    solids = [
        {
            "shape": "box",
            "min": [0.6 + 0.45 * n, 1.45],
            "max": [1.0 + 0.45 * n, 1.55],
            "density": 1000.0,
        }
        for n in (0, 1)
    ]
    first = {"kind": "hinge", "solids": [0], "anchor": [0.55, 1.5]}
    seconds = [
        {"kind": "fixed", "solids": [1, 0], "anchor": [1.02, 1.5]},
        {"kind": "hinge", "solids": [1, 0], "anchor": [1.02, 1.5], "limits": [0, 0]},
    ]
    ends = []
    for second in seconds:
        flat = tables([first, {**second}], solid=solids, domain={"size": [3.0, 3.0]})
        if "limits" in second:
            flat["joint"][1]["limits"] = [0.0, 0.0]
        simulation = made(loaded(flat, "solver.tolerance=1e-8"))
        for _ in range(30):
            row = simulation.step(0.01)
        ends.append([row["body0_angle"], row["body1_angle"], row["body1_x"], row["body1_y"]])
    assert ends[0] == pytest.approx(ends[1], abs=1e-4)
    assert ends[0][0] == pytest.approx(ends[0][1], abs=1e-4)
    assert ends[0][0] < -30.0


@pytest.mark.parametrize(
    "more", [{}, {"target": [REACH]}, {"solver": {"method": "nncg", "tolerance": 1e-3}}]
)
def test_a_run_goes_on_bit_for_bit_after_every_step(more: dict[str, Any]) -> None:
    assert differences_by_step(loaded(tables(JOINTS, **more)), 6, 2) == {}


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("method", few(KINEMATIC))
def test_an_arm_reaches_as_far_as_its_limits_let_it(method: str) -> None:
    """Reach of an arm within its joint limits.

    It reaches the point that SciPy's bounded least squares finds; anchors stay together.
    """
    simulation = made(
        loaded(tables(JOINTS, target=[REACH], solver={"method": method, "tolerance": 1e-6}))
    )
    assert isinstance(simulation, KinematicSimulation)
    for _ in range(10):
        row = simulation.step(0.1)
        assert row["solve_status"] == "CONVERGED"
        assert row["solve_residual"] <= 1e-6
        assert row["joint_error"] < 1e-12
        assert abs(row["joint1_angle"]) <= 20.0 + 1e-6
    goal = np.array(REACH["places"][1])

    def off(angles: np.ndarray) -> np.ndarray:
        a, b = angles[0], angles[0] + angles[1]
        at = (
            np.array([0.55, 1.5, 1.0])
            + 0.47 * np.array([np.cos(a), np.sin(a), 0.0])
            + 0.43 * np.array([np.cos(b), np.sin(b), 0.0])
        )
        return at - goal

    limit = np.radians(20.0)
    start = [1.0, 0.1 * np.sign(row["joint1_angle"])]  # the elbow may bend either way
    best = scipy.optimize.least_squares(
        off, start, bounds=([-np.inf, -limit], [np.inf, limit]), xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    assert [row["joint0_angle"], row["joint1_angle"]] == pytest.approx(
        np.degrees(best.x).tolist(), abs=1e-3
    )
    assert row["target_error"] == pytest.approx(float(np.linalg.norm(best.fun)), abs=1e-5)
    tip = simulation.bodies.motions[1].pose(simulation.time).apply(np.array([REACH["point"]]))[0]
    assert tip - goal == pytest.approx(best.fun, abs=1e-5)
    # The target's marker is around it, and small beside the arm of 0.9 m.
    (part,) = simulation.frame()
    assert isinstance(part, Surface)
    ways = part.points[part.fields["body"] == len(simulation.bodies.bodies)] - goal
    assert ways.mean(axis=0) == pytest.approx(np.zeros(3), abs=1e-6)
    assert np.abs(ways).max() == pytest.approx(0.03 * 0.9, rel=0.05)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"joint": [hinge(1, 7, at=0.5)]},
            "joint[0].solids = [1, 7]: must be numbers of [[solid]]s, from 0 to 2",
        ),
        ({"joint": [hinge(0, 1, at=0.5)]}, "the first must be a rigid body"),
        ({"joint": [hinge(1, 1, at=0.5)]}, "must differ"),
        (
            {"joint": [{"kind": "hinge", "solids": [1], "anchor": [0.5, 1.5, 1.0]}]},
            "joint[0].axis: must be given for a hinge in 3-D",
        ),
        (
            {"joint": [hinge(1, at=0.5, motor_speed=1.0)]},
            "joint[0].motor_torque: must be given together with motor_speed",
        ),
        (
            {"joint": [hinge(1, at=0.5, limits=[10.0, -10.0])]},
            "joint[0].limits = [10.0, -10.0]: must be in order",
        ),
        (
            {
                "joint": [
                    {
                        "kind": "ball",
                        "solids": [1],
                        "anchor": [0.5, 1.5, 1.0],
                        "limits": [-1.0, 1.0],
                    }
                ]
            },
            "is only for hinges: this joint is ball",
        ),
        ({"joint": [{"kind": "rope", "solids": [1], "anchor": [0.5, 1.5, 1.0]}]}, "joint[0].kind"),
        (
            {"solver": {"method": "sweeps-and-newton"}},
            "cannot solve joints, which are equations; choose from nncg",
        ),
        (
            {"solid": [bar(0.6, restitution=0.5), bar(1.05)], "joint": [hinge(1, 0, at=1.02)]},
            "must be 0 where there are joints",
        ),
        ({"domain": {"size": [3.0, 3.0, 2.0], "open": ["left"]}}, "domain.open"),
        (
            {"target": [{**REACH, "solid": 0}]},
            "target[0].solid = 0: must be the number of a rigid body",
        ),
        ({"target": [{**REACH, "times": [0.0]}]}, "target[0].places"),
        (
            {"target": [REACH], "joint": JOINTS[:1]},
            "target: every body must be the first body of exactly one hinge",
        ),
        (
            {"target": [REACH], "joint": [hinge(1, 2, at=1.02), hinge(2, 1, at=1.02)]},
            "some form a loop",
        ),
        (
            {"target": [REACH], "solver": {"method": "staggering"}},
            "cannot be used for inverse kinematics",
        ),
    ],
)
def test_invalid_joint_scenes_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneError) as error:
        load_scene(tables(JOINTS) | change)
    assert message in str(error.value)


def test_ball_joints_are_for_three_dimensions() -> None:
    ball = {"kind": "ball", "solids": [1], "anchor": [0.55, 1.5, 1.0]}
    assert loaded(tables([ball])).joint[0].kind == "ball"
    bar = {"shape": "box", "min": [0.6, 1.4], "max": [1.0, 1.5], "density": 1000.0}
    flat = {"solid": [bar], "domain": {"size": [3.0, 3.0]}}
    with pytest.raises(SceneError) as error:
        load_scene(tables([ball | {"solids": [0], "anchor": [0.6, 1.45]}], **flat))
    assert "must be hinge in 2-D" in str(error.value)


@pytest.mark.parametrize("name", few(["reach", "gears", "gear-pyramid", "motor-arm", "snake"], 1))
def test_frames_of_built_in_scenes(tmp_path: Path, name: str) -> None:
    """Frames of built-in scenes.

    meshio opens them, the log has residual and iterations, an image is drawn, and `scenes` lists
    them.
    """
    assert "joints" in succeed("check", name, "--device", "cpu")
    assert name in succeed("scenes")
    succeed("run", name, "--device", "cpu", "--out", tmp_path / "run", "--frames", 1)
    with open(tmp_path / "run" / "log.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert all(
        float(row["solve_residual"]) <= 1e-5 and int(row["solve_iterations"]) >= 0 for row in rows
    )
    mesh = meshio.read(tmp_path / "run" / "frames" / "bodies_000001.vtu")
    scene = loaded(name)
    shown = sum(solid.is_body for solid in scene.solid) + len(scene.target)
    assert set(np.unique(mesh.point_data["body"])) == set(range(shown))
    succeed("render", tmp_path / "run", "--frame", 1, "--size", "320x240")
    assert (tmp_path / "run" / "images" / "frame_000001.png").stat().st_size > 1000


@pytest.mark.parametrize("limit", [2.0, slow(60.0)])
def test_an_arch_is_held_up_by_the_limits_of_its_hinges(limit: float) -> None:
    """Arch held up by the limits of its hinges.

    It sags until six of them reach their limits, then stands. Loose hinges let it fall.
    """
    scene = loaded("arched-snake")
    simulation = made(
        scene.model_copy(
            update={
                "joint": [j.model_copy(update={"limits": [-limit, limit]}) for j in scene.joint]
            }
        )
    )
    for _ in range(15):
        row = simulation.step(0.01)
    angles = np.array([value for key, value in row.items() if key.endswith("_angle")])
    top = simulation.bodies.bodies.position[4, 1]
    assert len(angles) == 8 and np.abs(angles).max() < limit + 1e-4
    assert (row["max_speed"] < 1e-5) == (limit == 2.0)
    assert ((np.abs(np.abs(angles) - 2.0) < 1e-3).sum() == 6) == (limit == 2.0)
    assert (top > 1.10) == (limit == 2.0)


@pytest.mark.slow
def test_a_pyramid_of_gears_settles_between_its_posts() -> None:
    """Pyramid of gears between its posts.

    It comes to rest, row on row, as symmetric as at the start. Gears of a row push outward; those
    of the middle stay there.
    """
    simulation = made(loaded("gear-pyramid"))
    for _ in range(60):
        row = simulation.step(0.01)
    x, y = simulation.bodies.bodies.position[::3, :2].T  # of the first bar of each gear
    assert row["max_speed"] < 1e-5
    np.testing.assert_allclose(x + x[[2, 1, 0, 4, 3, 5]], 2.08, atol=0.02)
    assert (np.diff([y[:3].mean(), y[3:5].mean(), y[5]]) > 0.4).all()


@pytest.mark.parametrize("until", [0.3, slow(4.0)])
def test_a_gear_turns_one_with_twice_its_teeth_half_as_fast(until: float) -> None:
    """Gear with half the teeth of the other, at twice its speed.

    No tooth is skipped: the difference stays within the play between teeth, a third of their
    distance of 30 degrees.
    """
    simulation, turned = made(loaded("gears")), np.zeros(2)
    before = np.zeros(2)
    while simulation.time < until - 1e-9:
        row = simulation.step(min(simulation.stable_dt(), 0.01))
        now = np.array([row["joint0_angle"], row["joint3_angle"]])
        turned += (now - before + 180.0) % 360.0 - 180.0
        before = now
        assert abs(turned[1] + 0.5 * turned[0]) < 10.0
        assert row["joint_error"] < 1e-7
    assert turned[0] == pytest.approx(90.0 * until, abs=0.02 * 360.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "apart"),
    [("arched-snake", 1e-6), ("gear-pyramid", 1e-6), ("motor-arm", 1e-6), ("snake", 1e-5)],
)
def test_built_in_scenes_run_to_their_ends(name: str, apart: float) -> None:
    scene = loaded(name)
    simulation = made(scene)
    while simulation.time < scene.time.duration - 1e-9:
        row = simulation.step(min(simulation.stable_dt(), scene.time.dt_max))
        assert row["joint_error"] < apart
        assert row["solve_status"] == "CONVERGED"
    for number, table in enumerate(scene.joint):
        if table.limits is not None:
            assert table.limits[0] - 0.1 < row[f"joint{number}_angle"] < table.limits[1] + 0.1
        if table.motor_torque is not None:
            assert abs(row[f"joint{number}_torque"]) <= table.motor_torque * (1 + 1e-9)
