"""Rigid bodies in simulations of liquid and sand.

The tests cover steps, log, frames and checkpoints.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from warp_lcp.fluids import SIMULATOR as FLUIDS
from warp_lcp.fluids import LiquidScene
from warp_lcp.frames.frame_folder import write_vtu
from warp_lcp.granular import SIMULATOR as GRANULAR
from warp_lcp.granular.scene import SandScene
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.simulation import StepFailed, Surface

GRAVITY = 9.81
BLOCK = {"shape": "box", "min": [0.4, 0.6], "max": [0.6, 0.7], "density": 500.0}
LOW = [0.0, 0.0]


def make(
    *solids: dict[str, Any], simulator: str = "fluids", resolution: int = 16, **tables: Any
) -> Any:
    data = {
        "scene": {"simulator": simulator},
        "time": {"duration": 1.0},
        "domain": {"size": [1.0, 1.0], "resolution": resolution},
        "physics": {},
        ("liquid" if simulator == "fluids" else "sand"): [
            {"shape": "box", "min": LOW, "max": [0.25, 0.25]}
        ],
        "solid": list(solids),
    }
    model, plugin = (LiquidScene, FLUIDS) if simulator == "fluids" else (SandScene, GRANULAR)
    return plugin.create(model.model_validate(data | tables), device="cpu", folder=Path())


@pytest.mark.parametrize("simulator", ["fluids", "granular"])
def test_a_body_falls_and_turns_in_air_as_mechanics_says(simulator: str) -> None:
    simulation = make(
        {**BLOCK, "velocity": [0.5, 0.0], "angular_velocity": 90.0}, simulator=simulator
    )
    for dt in (0.004, 0.01, 1e-6, 0.006, 0.02):
        row = simulation.step(dt)
    time = simulation.time
    assert row["body0_x"] == pytest.approx(0.5 + 0.5 * time)
    assert row["body0_y"] == pytest.approx(0.65 - 0.5 * GRAVITY * time**2)
    # In the middle of the step.
    assert row["body0_vy"] == pytest.approx(-GRAVITY * (time - 0.5 * dt))
    assert row["body0_angle"] == pytest.approx(90.0 * time)
    assert row["body0_spin"] == pytest.approx(90.0)
    assert tuple(row) == simulation.columns()
    # Its solid is at its position.
    distance = simulation.boundary.distance.numpy()[1] * simulation.grid.spacing
    j, i = np.unravel_index(distance[1:-1, 1:-1].argmin(), (16, 16))
    assert np.hypot(i / 16 - row["body0_x"], j / 16 - row["body0_y"]) < 0.08


def test_without_bodies_a_scene_has_no_body_data() -> None:
    simulation = make()
    row = simulation.step(0.004)
    assert simulation.bodies is None
    assert not [name for name in row if name.startswith(("body", "contacts"))]
    assert "bodies" not in simulation.state()
    assert [part.name for part in simulation.frame()] == ["particles", "grid"]


@pytest.mark.parametrize("simulator", ["fluids", "granular"])
def test_a_run_goes_on_from_a_state_bit_for_bit(simulator: str) -> None:
    """Resumed run, equal bit for bit, from the middle of an impact on the floor."""
    solids = [
        {**BLOCK, "translate": [0.2, -0.55], "rotate": 3.0, "velocity": [0.0, -3.0]},
        {**BLOCK, "translate": [0.0, 0.1]},
    ]
    through, later = (make(*solids, simulator=simulator) for _ in range(2))
    for _ in range(6):
        through.step(0.004)
    state = {name: array.copy() for name, array in through.state().items()}
    later.restore(state)
    for _ in range(4):
        one, other = through.step(0.004), later.step(0.004)
        assert one == other
    assert one["contacts"] > 0
    for name, array in through.state().items():
        np.testing.assert_array_equal(array, later.state()[name], err_msg=name)


def test_a_state_of_other_bodies_is_refused() -> None:
    simulation, other = make(BLOCK), make(BLOCK, {**BLOCK, "translate": [0.0, 0.15]})
    with pytest.raises(ValueError, match="bodies"):
        simulation.restore(other.state())
    with pytest.raises(ValueError, match="lacks bodies"):
        simulation.restore(make().state())


def test_bodies_go_on_on_another_grid() -> None:
    coarse, fine = make(BLOCK), make(BLOCK, resolution=24)
    for _ in range(5):
        coarse.step(0.01)
    fine.resample(coarse.state())
    np.testing.assert_array_equal(fine.state()["bodies"], coarse.state()["bodies"])
    row = fine.step(0.01)
    assert row["body0_vy"] == pytest.approx(-GRAVITY * 0.055)
    with pytest.raises(ValueError, match="no bodies"):
        fine.resample({name: array for name, array in coarse.state().items() if name != "bodies"})


def test_a_step_that_fails_leaves_the_bodies_as_they_were(monkeypatch: pytest.MonkeyPatch) -> None:
    simulation = make(
        {**BLOCK, "translate": [0.0, -0.6], "angular_velocity": 10.0},
        solver={"max_iterations": 1, "tolerance": 1e-12},
    )
    before = {
        name: array
        for name, array in simulation.state().items()
        if name not in ("position", "velocity", "affine")
    }
    with pytest.raises(StepFailed):
        simulation.step(0.01)
    for name, array in simulation.state().items():
        if name in before:
            np.testing.assert_array_equal(array, before[name], err_msg=name)


@pytest.mark.parametrize("simulator", ["fluids", "granular"])
@pytest.mark.parametrize("when", ["begin_step", "solve_contacts"])
def test_contacts_that_are_not_solved_fail_the_step(
    simulator: str, when: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unsolved contacts: the step fails.

    Before or after the material's solve: the message has the residual, a shorter step may follow,
    and the state is unchanged.
    """
    simulation, twin = (
        make({**BLOCK, "translate": [0.0, -0.6]}, simulator=simulator) for _ in range(2)
    )
    simulation.step(0.004)
    twin.step(0.004)
    kept = getattr(RigidBodies, when)

    def missing(self: RigidBodies, *arguments: Any) -> None:
        kept(self, *arguments)
        self.contact_residual = 0.83

    with monkeypatch.context() as patch:
        patch.setattr(RigidBodies, when, missing)
        with pytest.raises(StepFailed, match=r"contacts.* relative residual of 8.30e-01"):
            simulation.step(0.01)
    row, expected = simulation.step(0.005), twin.step(0.005)
    for name in expected:  # the pressure starts from the one of the failed step
        if name.startswith(("body", "contacts", "center")):
            assert row[name] == pytest.approx(expected[name], rel=1e-4, abs=1e-9), name


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("simulator", ["fluids", "granular"])
def test_the_log_says_how_well_contacts_are_solved(simulator: str) -> None:
    simulation = make(
        {**BLOCK, "translate": [0.2, -0.6]},
        {**BLOCK, "translate": [0.2, -0.5], "density": 4e4},
        simulator=simulator,
    )
    assert "contact_residual" in simulation.columns()
    rows = [simulation.step(0.004) for _ in range(3)]
    assert all(0.0 < row["contact_residual"] <= 1e-5 for row in rows)


@pytest.mark.parametrize("simulator", ["fluids", "granular"])
def test_a_body_leaves_by_an_open_side(simulator: str, tmp_path: Path) -> None:
    """Body that leaves by an open side.

    It slides out over the floor, whose plane continues outside; the other stays, and a run resumes
    from any state bit for bit.
    """
    solids = [
        {**BLOCK, "translate": [0.2, -0.6], "velocity": [3.0, 0.0], "friction": 0.0},
        {**BLOCK, "translate": [0.0, 0.1]},
    ]
    domain = {"size": [1.0, 1.0], "resolution": 16, "open": ["right"]}
    through, later = (make(*solids, simulator=simulator, domain=domain) for _ in range(2))
    rows = [through.step(0.01) for _ in range(8)]
    assert {row["bodies_gone"] for row in rows[:6]} == {0}
    rows += [through.step(0.01) for _ in range(6)]
    assert rows[-1]["bodies_gone"] == 1
    assert tuple(rows[-1]) == through.columns()
    gone = through.bodies.bodies[0]
    assert gone.position[0] > 1.2
    assert not gone.velocity.any()
    assert rows[-1]["body1_vy"] == pytest.approx(-GRAVITY * (through.time - 0.005))
    bodies = next(part for part in through.frame() if part.name == "bodies")
    assert set(bodies.fields["body"]) == {1}
    assert bodies.corners.shape == (4, 2)
    assert bodies.corners.max() < len(bodies.points)
    later.restore({name: array.copy() for name, array in through.state().items()})
    for _ in range(3):
        assert through.step(0.01) == later.step(0.01)


def test_frames_without_a_body_left_are_written(tmp_path: Path) -> None:
    domain = {"size": [1.0, 1.0], "resolution": 16, "open": ["top"]}
    simulation = make({**BLOCK, "velocity": [0.0, 20.0]}, domain=domain)
    while simulation.time < 0.04:
        row = simulation.step(0.005)
    assert row["bodies_gone"] == 1
    part = next(part for part in simulation.frame() if part.name == "bodies")
    assert isinstance(part, Surface)
    assert len(part.points) == 0
    write_vtu(tmp_path / "bodies.vtu", part)
    simulation.step(simulation.stable_dt())


def test_frames_show_the_outlines(tmp_path: Path) -> None:
    simulation = make(
        BLOCK,
        {
            "shape": "sphere",
            "center": [0.2, 0.6],
            "radius": 0.1,
            "mass": 1.0,
            "velocity": [0.3, 0.0],
        },
    )
    simulation.step(0.01)
    part = simulation.frame()[-1]
    assert isinstance(part, Surface)
    assert part.name == "bodies"
    assert part.corners.shape == (4 + 48, 2)
    assert np.bincount(part.fields["body"]).tolist() == [4, 48]
    row = simulation.bodies.row()
    ball = part.points[4:]
    np.testing.assert_allclose(ball.mean(axis=0)[:2], [row["body1_x"], row["body1_y"]], atol=1e-6)
    np.testing.assert_allclose(
        part.fields["velocity"][4:], np.tile([0.3, -0.5 * 0.0981, 0.0], (48, 1)), rtol=1e-5
    )
    write_vtu(tmp_path / "bodies.vtu", part)
    assert (tmp_path / "bodies.vtu").stat().st_size > 1000


def test_time_steps_count_the_bodies_speed() -> None:
    slow, fast = make(BLOCK), make({**BLOCK, "velocity": [20.0, 0.0]})
    assert fast.stable_dt() < 0.3 * slow.stable_dt()


@pytest.mark.parametrize("simulator", ["fluids", "granular"])
def test_a_body_comes_to_rest_on_the_floor(simulator: str) -> None:
    """Rest of a body on a dry floor, separated from the material by a sill."""
    sill = {"shape": "box", "min": [0.25, 0.0], "max": [0.45, 0.5]}
    simulation = make({**BLOCK, "translate": [0.2, -0.55]}, sill, simulator=simulator)
    while simulation.time < 0.3:
        row = simulation.step(0.01)
    assert row["body0_y"] == pytest.approx(0.05, abs=1e-6)
    assert abs(row["body0_vy"]) < 1e-8
    assert row["contacts"] == 2
