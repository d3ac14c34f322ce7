"""Single particles that fly off the grid, and come back."""

from typing import Any

import numpy as np
import pytest

from small_liquids import box, create, scene
from warp_lcp.fluids import LiquidSimulation
from warp_lcp.material import domain_window as coverage
from warp_lcp.material import spray

GRAVITY = np.array([0.0, -9.81, 0.0])


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use grid windows even in small domains."""
    monkeypatch.setattr(coverage, "LEAST_CELLS", 0)


def with_drops(points: list[list[float]], velocity: list[float], **tables: Any) -> LiquidSimulation:
    """Return a block of liquid on the floor, and single particles."""
    simulation = create(
        scene(size=[6.0, 3.0], resolution=120, liquid=[box([0.0, 0.0], [1.0, 0.5])], **tables)
    )
    simulation.particles.append(np.array(points), np.tile(velocity, (len(points), 1)))
    simulation.particles.sort()
    return simulation


def test_spray_follows_its_parabola_and_keeps_its_mass() -> None:
    simulation = with_drops([[2.5, 1.5, 0.0], [4.0, 1.0, 0.0]], [1.0, 3.0, 0.0])
    count, start = (
        simulation.particles.count,
        simulation.particles.position.numpy()[-2:].astype(float),
    )
    rows = [simulation.step(0.01) for _ in range(20)]
    assert [row["spray"] for row in rows] == [2] * 20
    assert {row["particles"] for row in rows} == {count}
    assert simulation.grid.counts[0] < 64  # the grid does not reach to them
    found = simulation.points()
    assert len(found.points) == count
    middle = np.array([1.0, 3.0, 0.0]) + GRAVITY * (simulation.time - 0.005)
    assert found.fields["velocity"][-2:] == pytest.approx(np.tile(middle, (2, 1)), abs=1e-5)
    exact = start + np.array([1.0, 3.0, 0.0]) * simulation.time + 0.5 * GRAVITY * simulation.time**2
    assert np.sort(found.points[-2:], axis=0) == pytest.approx(np.sort(exact, axis=0), abs=2e-5)


def test_energy_equals_that_of_a_run_without_spray(monkeypatch: pytest.MonkeyPatch) -> None:
    drops = [[2.5 + 0.4 * n, 1.0 + 0.2 * n, 0.0] for n in range(6)]
    off_grid = with_drops(drops, [0.5, 2.0, 0.0])
    monkeypatch.setattr(spray, "FEW", 0)
    on_grid = with_drops(drops, [0.5, 2.0, 0.0])
    for n in range(20):
        monkeypatch.setattr(spray, "FEW", 8)
        row = off_grid.step(0.01)
        monkeypatch.setattr(spray, "FEW", 0)
        expected = on_grid.step(0.01)
        assert (row["spray"], expected["spray"]) == (6, 0), n
        for name in ("mass", "kinetic_energy", "potential_energy", "center_of_mass_y"):
            assert row[name] == pytest.approx(expected[name], rel=1e-5), (n, name)


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("start", "velocity", "solids"),
    [
        ([2.5, 0.4], [-6.0, 0.5, 0.0], []),  # the liquid
        ([3.0, 0.6], [0.0, -3.0, 0.0], []),  # the floor
        ([4.0, 1.5], [5.0, 2.0, 0.0], []),  # a wall
        ([3.0, 1.5], [4.0, 0.0, 0.0], [{"shape": "sphere", "center": [4.5, 1.5], "radius": 0.4}]),
    ],
    ids=["liquid", "floor", "wall", "solid"],
)
def test_spray_returns_to_the_grid_before_a_collision(start, velocity, solids):
    simulation = with_drops([[*start, 0.0]], velocity, solid=solids)
    count = simulation.particles.count
    flying = []
    for _ in range(60):
        row = simulation.step(0.01)
        flying.append(row["spray"])
        assert row["particles"] == count
        positions = simulation.points().points
        for solid in solids:
            assert (
                np.linalg.norm(positions[:, :2] - np.array(solid["center"]), axis=1)
                > solid["radius"]
            ).all()
    assert flying[0] == 1
    assert flying[-1] == 0


def test_spray_resumes_from_a_state_and_leaves_through_open_sides() -> None:
    tables: dict[str, Any] = {}
    through, later = (
        with_drops([[2.5, 1.5, 0.0], [5.0, 1.5, 0.0]], [2.0, 3.0, 0.0], **tables) for _ in range(2)
    )
    for _ in range(5):
        through.step(0.01)
    state = through.state()
    assert int(state["spray"]) == 2
    later.restore(state)
    assert later.spray.particles.count == 2
    for _ in range(12):
        assert through.step(0.01) == later.step(0.01)
    found = later.state()
    assert all(np.array_equal(value, found[name]) for name, value in through.state().items())


def test_drains_remove_spray() -> None:
    drain = {"drain": [box([2.0, 1.0], [3.0, 3.0])]}
    simulation = with_drops([[2.5, 1.5, 0.0], [4.5, 1.5, 0.0]], [0.0, 1.0, 0.0], **drain)
    row = simulation.step(0.01)
    assert (row["drained"], row["spray"]) == (1, 1)
