"""Runs of rigid bodies alone: stability, energy, resuming, reported residuals."""

import csv
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest

import warp_lcp as wl
from command_line import succeed
from default_run import chosen, few
from every_step import differences_by_step
from warp_lcp.contacts.methods import BOXED, CONE, DEFAULT, STEWART_TRINKLE
from warp_lcp.contacts.scene import ContactScene
from warp_lcp.contacts.simulator import ContactSimulation, ContactSimulator
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.table import SceneError

SIDE = 0.5  # [m]
SCENES = ("box-stack", "heavy-on-light", "incline", "leaning-wall", "sphere-stack", "wall")


def box(x: float, y: float, **more: Any) -> dict[str, Any]:
    """Return a cube with its low corner at (x, y) in the middle of the room."""
    return {
        "shape": "box",
        "min": [x, y, 1.0],
        "max": [x + SIDE, y + SIDE, 1.0 + SIDE],
        "density": 1000.0,
        **more,
    }


def tables(*solids: dict[str, Any], **more: Any) -> dict[str, Any]:
    time = {"duration": 1.0, "frames_per_second": 10, "dt_max": 0.01}
    return {
        "scene": {"simulator": "contacts"},
        "time": time,
        "domain": {"size": [3.0, 3.0, 3.0]},
        "solid": list(solids),
        **more,
    }


def made(scene: ContactScene) -> ContactSimulation:
    return ContactSimulator().create(scene, device="cpu", folder=Path())


def loaded(*solids: dict[str, Any], **more: Any) -> ContactScene:
    scene = load_scene(tables(*solids, **more))
    assert isinstance(scene, ContactScene)
    return scene


def built_in(name: str, *overrides: str) -> ContactScene:
    scene = load_scene(name, overrides)
    assert isinstance(scene, ContactScene)
    return scene


def places(simulation: ContactSimulation) -> np.ndarray:
    return np.array([body.position for body in simulation.bodies.bodies])


@pytest.mark.default_cases(3)
@pytest.mark.parametrize(
    "name", ["box-stack", "heavy-on-light", "leaning-wall", "sphere-stack", "wall"]
)
def test_stable_stacks_of_the_book_stay_at_rest(name: str) -> None:
    """Stability of the book's stacks.

    After half a second no body has moved by a hundredth of a side, and the residual meets the
    tolerance of the scene.
    """
    simulation = made(built_in(name))
    before, residuals = places(simulation), []
    for _ in range(50):
        residuals.append(simulation.step(0.01)["solve_residual"])
    assert simulation.time == pytest.approx(0.5)
    assert np.abs(places(simulation) - before).max() < 0.01 * 0.25
    assert max(residuals) <= simulation.scene.solver.tolerance
    assert simulation.bodies.top_speed(0.0) < 1e-4


def test_bodies_slide_down_a_slope_as_friction_lets_them() -> None:
    """Sliding of bodies down a slope with friction.

    Below tan(0.3) they slide by g (sin - mu cos) t^2 / 2 along the slope, above it not at all.
    """
    simulation = made(built_in("incline"))
    before, steps, dt = places(simulation), 60, 0.01
    for _ in range(steps):
        simulation.step(dt)
    gone = np.linalg.norm(places(simulation) - before, axis=1)
    friction = np.array([0.1, 0.25, 0.4, 0.8])
    expected = (
        0.5 * 9.81 * np.maximum(np.sin(0.3) - friction * np.cos(0.3), 0.0) * (steps * dt) ** 2
    )
    assert gone == pytest.approx(expected, rel=0.01, abs=1e-3)


def test_a_body_falls_as_a_stone_does_and_hits_the_floor() -> None:
    simulation = made(loaded(box(1.0, 1.0)))
    row = simulation.step(0.01)
    assert (row["solver"], row["solve_status"], row["solve_residual"], row["contacts"]) == (
        None,
        None,
        None,
        0,
    )
    for _ in range(29):
        row = simulation.step(0.01)
    assert row["body0_y"] == pytest.approx(1.25 - 0.5 * 9.81 * 0.3**2, rel=1e-6)
    for _ in range(70):
        row = simulation.step(0.01)
    assert row["body0_y"] == pytest.approx(0.25, abs=1e-3)
    assert row["max_speed"] < 1e-6
    assert tuple(row) == simulation.columns()


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("method", few([DEFAULT, "proximal-gauss-seidel", "psor", "lemke"], 2))
def test_energy_does_not_grow_without_restitution(method: str) -> None:
    """Energy of bodies that fall on each other, tilted and turning.

    The sum of kinetic and potential energy never grows.
    """
    turned = {
        "rotate": [20.0, 10.0, 30.0],
        "about": [1.4, 1.95, 1.25],
        "angular_velocity": [90.0, 0.0, -200.0],
    }
    solids = [box(1.0, 0.0), box(1.15, 1.7, velocity=[0.5, -1.0, 0.0], **turned)]
    simulation = made(loaded(*solids, solver={"method": method, "tolerance": 1e-6}))
    energies = []
    for _ in range(120):
        row = simulation.step(0.01)
        energies.append(float(row["kinetic_energy"]) + float(row["potential_energy"]))
    assert np.diff(energies).max() < 1e-3 * (energies[0] - energies[-1])
    assert energies[-1] < 0.8 * energies[0]


def test_a_ball_bounces_as_its_restitution_says() -> None:
    """Bounce of a ball after a fall by h: it rises by e^2 h."""
    ball = {
        "shape": "sphere",
        "center": [1.5, 1.25, 1.5],
        "radius": 0.25,
        "density": 1000.0,
        "restitution": 0.5,
    }
    simulation, heights = made(loaded(ball)), []
    for _ in range(75):
        heights.append(float(simulation.step(0.01)["body0_y"] or 0.0))  # type: ignore[arg-type]
    hit = int(np.argmin(heights))
    assert max(heights[hit:]) == pytest.approx(0.25 + 0.5**2 * 1.0, rel=0.01)


@pytest.mark.parametrize(
    "method",
    chosen(
        [DEFAULT, *BOXED, *STEWART_TRINKLE, *CONE], [DEFAULT, "nncg", "staggering", "lemke", *CONE]
    ),
)
def test_every_method_reports_its_final_residual(method: str) -> None:
    """Reported status of every method on three boxes at rest.

    The log has its name, status, iterations and residual.
    """
    scene = loaded(
        *(box(1.0 + 0.01 * n, SIDE * n) for n in range(3)),
        solver={"method": method, "tolerance": 1e-3},
    )
    simulation = made(scene)
    before = places(simulation)
    for _ in range(10):
        row = simulation.step(0.01)
        assert row["solver"] == method
        assert row["solve_status"] == "CONVERGED"
        assert 0.0 <= float(row["solve_residual"] or 0.0) <= 1e-3  # type: ignore[arg-type]
        assert isinstance(row["solve_iterations"], int)
    assert np.abs(places(simulation) - before).max() < 1e-3 * SIDE


def test_the_log_reports_unconverged_contact_solves() -> None:
    simulation = made(
        loaded(
            *(box(1.0, SIDE * n) for n in range(3)),
            solver={"method": "projected-jacobi", "max_iterations": 3},
        )
    )
    row = simulation.step(0.01)
    assert (row["solve_status"], row["solve_iterations"]) == ("MAX_ITERATIONS", 3)
    assert float(row["solve_residual"] or 0.0) > 1e-5  # type: ignore[arg-type]


def test_a_body_that_slides_along_a_diagonal_is_braked_by_mu_g() -> None:
    """Friction of a body that slides along a diagonal: mu g.

    The circular cone brakes so in every direction; pyramids of four sides, or boxes, need not.
    """
    speed, mu, steps, dt = 1.0, 0.4, 15, 0.01
    way = np.array([np.cos(0.6), 0.0, np.sin(0.6)])
    scene = loaded(
        box(1.0, 0.0, velocity=(speed * way).tolist(), friction=mu),
        solver={"method": "proximal-gauss-seidel", "tolerance": 1e-8},
    )
    simulation = made(scene)
    for _ in range(steps):
        simulation.step(dt)
    velocity = simulation.bodies.bodies[0].velocity
    braked = mu * 9.81 * (steps - 0.5) * dt  # gravity of the first step acts for half of it
    np.testing.assert_allclose(velocity, (speed - braked) * way, atol=1e-5)


def test_in_a_plane() -> None:
    solids = [
        {"shape": "box", "min": [1.0, 0.5 * n], "max": [1.5, 0.5 * n + 0.5], "density": 500.0}
        for n in range(3)
    ]
    for method in (DEFAULT, "nncg", "minimum-map-newton", "proximal-gauss-seidel"):
        simulation = made(
            loaded(
                *solids, domain={"size": [3.0, 3.0]}, solver={"method": method, "tolerance": 1e-6}
            )
        )
        for _ in range(4):
            row = simulation.step(0.01)
        assert row["body2_y"] == pytest.approx(1.25, abs=1e-5)
        assert row["max_speed"] < 1e-4  # type: ignore[operator]


@pytest.mark.parametrize(
    "method", few([DEFAULT, "proximal-gauss-seidel", "subspace-minimization", "fischer-newton"], 2)
)
def test_a_run_goes_on_bit_for_bit_after_every_step(method: str) -> None:
    solids = [
        box(1.0, 0.0),
        box(1.1, SIDE),
        box(1.3, 1.2, velocity=[1.0, -2.0, 0.0], restitution=0.3),
    ]
    scene = loaded(*solids, solver={"method": method, "tolerance": 1e-5})
    assert differences_by_step(scene, 15, 2) == {}


def test_the_commands(tmp_path: Path) -> None:
    """Commands on a run of contacts.

    A resumed run has the same log and frames as an uninterrupted one. Other programs read the
    frames, and images are drawn.
    """
    uninterrupted, parts = tmp_path / "whole", tmp_path / "parts"
    assert "box-stack" in succeed("check", "box-stack", "--device", "cpu")
    succeed("run", "box-stack", "--device", "cpu", "--out", uninterrupted, "--frames", 4)
    succeed("run", "box-stack", "--device", "cpu", "--out", parts, "--frames", 2)
    succeed("run", "--resume", "--device", "cpu", "--out", parts, "--frames", 4)
    for file in sorted((uninterrupted / "frames").iterdir()):
        assert file.read_bytes() == (parts / "frames" / file.name).read_bytes(), file.name
    with (
        open(uninterrupted / "log.csv", newline="") as one,
        open(parts / "log.csv", newline="") as other,
    ):
        rows, continued = list(csv.DictReader(one)), list(csv.DictReader(other))
    assert [row | {"seconds": ""} for row in rows] == [row | {"seconds": ""} for row in continued]
    assert all(float(row["solve_residual"]) <= 1e-5 for row in rows)
    frame = uninterrupted / "frames" / "bodies_000004.vtu"
    mesh, read = meshio.read(frame), wl.read_frame(frame)
    assert len(mesh.points) == len(read.points)
    assert set(np.unique(mesh.point_data["body"])) == set(range(10))
    assert "frame_000004.png" in succeed("render", uninterrupted, "--frame", 4, "--size", "320x240")
    assert (uninterrupted / "images" / "frame_000004.png").stat().st_size > 1000
    assert "simulator contacts" in succeed("info")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"solid": []}, "has no rigid body: give one a density or a mass"),
        ({"solver": {"method": "nncgg"}}, "solver.method"),
        ({"solver": {"directions": 6}}, "solver.directions = 6: is only for the methods lemke"),
        ({"solver": {"method": "lemke", "directions": 5}}, "solver.directions = 5"),
        ({"solver": {"precision": "mixed"}}, "solver.precision"),
        ({"solver": {"preset": "final"}}, "solver.preset"),
        (
            {"output": {"particles": True}},
            "output.particles = true: must be false: there is no material",
        ),
        ({"physics": {"density": 900.0}}, "physics.density = 900.0: there is no material"),
        ({"liquid": [box(0.0, 0.0)]}, "fluids"),
        ({"domain": {"size": [3.0, 3.0, 3.0], "solids": "voxel"}}, "domain.solids"),
        ({"solid": [box(1.0, 0.0), box(5.0, 0.0)]}, "solid[1]: lies outside the domain"),
    ],
)
def test_invalid_contact_scenes_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneError) as error:
        load_scene(tables(box(1.0, 0.0)) | change)
    assert message in str(error.value)


def test_bodies_that_overlap_are_refused() -> None:
    with pytest.raises(
        ValueError, match=r"solid\[1\] \(box\) overlaps solid\[0\] \(box\) by 0\.1 m at the start"
    ):
        made(loaded(box(1.0, 0.0), box(1.0, 0.4)))


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_built_in_scenes_run_to_their_ends(name: str) -> None:
    scene = built_in(name)
    simulation, energies = made(scene), []
    while simulation.time < scene.time.duration - 1e-9:
        row = simulation.step(min(simulation.stable_dt(), scene.time.dt_max))
        energies.append(float(row["kinetic_energy"]) + float(row["potential_energy"]))  # type: ignore[arg-type]
    assert np.diff(energies).max() < 1e-4 * energies[0]
