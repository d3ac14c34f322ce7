"""Unilateral pressure: it pushes where a cell would over-fill, and never pulls."""

from typing import Any

import numpy as np
import pytest

from default_run import slow
from small_liquids import GRAVITY, advance, box, create, scene
from warp_lcp.fluids import LiquidSimulation

UNILATERAL = {"pressure": {"model": "unilateral"}}


def liquid(
    size: list[float], blocks: list[dict[str, Any]], resolution: int = 32, **tables: Any
) -> LiquidSimulation:
    """Return a liquid with that pressure."""
    return create(
        scene(size=size, resolution=resolution, liquid=blocks, **{**UNILATERAL, **tables})
    )


def splines(distance: np.ndarray) -> np.ndarray:
    """Return the quadratic B-spline."""
    d = np.abs(distance)
    return np.where(d < 0.5, 0.75 - d**2, np.where(d < 1.5, 0.5 * (1.5 - d) ** 2, 0.0))


def test_the_solution_satisfies_the_law_written_face_by_face() -> None:
    # NumPy, cell by cell, from mass balance alone: y is the capacity of cells after a step. A wrong
    # sign or row would show.
    rng = np.random.default_rng(77)
    blocks = [
        box([0.0, 0.0], [0.5, 0.5], velocity=[3.0, -1.0]),
        box([0.5, 0.0], [1.0, 0.25], velocity=[-3.0, 2.0]),
    ]
    simulation = liquid(
        [1.0, 1.0], blocks, 16, solver={"tolerance": 1e-8, "precision": "double"}, solids="voxel"
    )
    x = simulation.particles.position.numpy()
    simulation.particles.position.assign(
        np.clip(x + 0.02 * rng.standard_normal(x.shape), 0.01, 0.99) * [1, 1, 0]
    )
    dt, dx = 0.01, 1 / 16
    simulation.particles.sort()
    window = simulation.grid.everywhere
    simulation.kick_dt = dt
    simulation.particles_to_grid(window)
    projection = simulation.projection
    simulation.surface.mark(simulation.particles, window, projection.kind)
    u, v = (field.numpy()[1].astype(np.float64) for field in simulation.velocity)
    projection.prepare(simulation.velocity, dt, dt)
    assert projection.counted() == 256
    result, _ = projection.solve(3.0)
    assert result
    p = result.x.numpy().reshape(simulation.grid.shape)[1, 1:-1, 1:-1]

    points = simulation.particles.position.numpy()[:, :2] / dx
    cells = np.arange(16) + 0.5
    wx, wy = splines(points[:, :1] - cells), splines(points[:, 1:] - cells)
    rho = wy.T @ wx / 4
    share = np.array([5 / 6] + [1.0] * 14 + [5 / 6])
    capacity = np.outer(share, share)
    full = np.minimum(rho / (0.8 * np.maximum(capacity, 0.25)), 1.0)
    u, v = u[1:-1, 1:18].copy(), v[1:18, 1:-1].copy()
    u[:, [0, -1]] = 0.0
    v[[0, -1]] = 0.0
    flow_x, flow_y = np.zeros_like(u), np.zeros_like(v)
    flow_x[:, 1:-1] = np.where(u[:, 1:-1] > 0, full[:, :-1], full[:, 1:]) * u[:, 1:-1]
    flow_y[1:-1] = np.where(v[1:-1] > 0, full[:-1], full[1:]) * v[1:-1]
    inward = (
        np.maximum(flow_x[:, :-1], 0)
        - np.minimum(flow_x[:, 1:], 0)
        + np.maximum(flow_y[:-1], 0)
        - np.minimum(flow_y[1:], 0)
    )
    flow_x[:, 1:-1] -= p[:, 1:] - p[:, :-1]
    flow_y[1:-1] -= p[1:] - p[:-1]
    out = flow_x[:, 1:] - flow_x[:, :-1] + flow_y[1:] - flow_y[:-1]
    room = np.maximum(dx / dt, inward) * np.maximum(capacity - rho / 0.8, 0.0)
    settling = np.sqrt(GRAVITY * dx) * np.clip(capacity - rho, -0.2, 0.2)
    y = room + settling + out
    assert (p >= 0).all()
    assert 20 < (p > 0).sum() < 200
    assert y.min() > -1e-3
    assert np.abs(y[p > 0]).max() < 1e-3
    assert np.abs(out.sum()) < 1e-9


@pytest.mark.parametrize("dimension", [2, 3])
def test_overfull_cells_keep_their_velocity_in_flight_and_settle_slowly(dimension: int) -> None:
    """Speed of too dense liquid.

    Without gravity excess density is no velocity. With it a cell twice as full expands by at most a
    fifth of sqrt(g dx), whatever dt is.
    """
    low, high = [0.375] * dimension, [0.625] * dimension
    for g, dt in ((0.0, 0.01), (GRAVITY, 1e-5)):
        simulation = liquid(
            [1.0] * dimension, [box(low, high)], 8, physics={"gravity": [0.0, -g, 0.0][:dimension]}
        )
        simulation.particles.append(
            np.tile(simulation.particles.position.numpy(), (2, 1)),
            np.zeros((2 * simulation.particles.count, 3)),
        )
        simulation.particles.sort()
        center = simulation.particles.position.numpy().mean(axis=0)
        simulation.step(dt)
        outward, velocity = (
            simulation.particles.position.numpy() - center,
            simulation.particles.velocity.numpy(),
        )
        fastest = np.abs(velocity).max()
        if g == 0.0:
            assert fastest == 0.0
        else:
            assert 0.1 < fastest / (0.2 * np.sqrt(g / 8)) < 2.0  # two cells, one on each side
            assert ((outward * velocity).sum(axis=1) > 0.0).mean() > 0.99
            np.testing.assert_allclose(velocity.mean(axis=0), 0.0, atol=0.02 * fastest)


def test_cells_with_room_have_no_pressure_and_spray_is_ballistic() -> None:
    simulation = liquid(
        [1.0, 1.0], [box([0.25, 0.25], [0.75, 0.75])], particles={"per_axis": 2, "jitter": 1.0}
    )
    thin = simulation.particles.marks
    # A quarter remains.
    thin.assign((np.arange(simulation.particles.count) % 4 != 0).astype(np.int32))
    simulation.particles.remove(thin)
    velocity = np.random.default_rng(5).uniform(-0.2, 0.2, (simulation.particles.count, 3)).astype(
        np.float32
    ) * [1, 1, 0]
    simulation.particles.velocity.assign(velocity.astype(np.float32))
    mean = velocity.mean(axis=0)
    advance(simulation, 0.1, 0.005)
    assert not simulation.projection.pressure.numpy().any()
    middle = simulation.time - 0.5 * simulation.last_dt
    np.testing.assert_allclose(
        simulation.particles.velocity.numpy().mean(axis=0),
        mean - [0.0, middle * GRAVITY, 0.0],
        atol=1e-4,
    )


@pytest.mark.parametrize("cfl", [0.7, 2.0])
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_falling_block_is_ballistic(dimension: int, cfl: float) -> None:
    # With fluxes of the mean density its front seems to over-fill the cells ahead and is blown off
    # at some m/s.
    low, high = [0.375, 0.6, 0.0][:dimension], [0.625, 0.9, 0.25][:dimension]
    block = box(low, high, velocity=[0.5, 0.0, 0.0][:dimension])
    simulation = liquid([1.0, 1.0, 0.25][:dimension], [block], cfl=cfl)
    advance(simulation, 0.2)
    velocity = simulation.particles.velocity.numpy().astype(np.float64)
    expected = [0.5, -(0.2 - 0.5 * simulation.last_dt) * GRAVITY, 0.0]
    np.testing.assert_allclose(velocity.mean(axis=0), expected, atol=2e-3)
    # 3 % of the speed: the densest cells of the jitter settle.
    assert np.abs(velocity - expected).max() < 0.06
    assert np.abs(velocity - expected).std() < 0.01


@pytest.mark.default_cases(1)
@pytest.mark.parametrize(
    ("dimension", "cut"), [(2, False), slow((3, False)), slow((2, True)), (3, True)]
)
def test_a_pool_holds_itself(dimension: int, cut: bool) -> None:
    ball = {"shape": "sphere", "center": [0.3, 0.1, 0.1][:dimension], "radius": 0.08}
    tables = {"solid": [ball]} if cut else {}
    simulation = liquid(
        [0.5, 1.0, 0.25][:dimension],
        [box([0.0] * dimension, [0.5, 0.5, 0.25][:dimension])],
        **tables,
    )
    height = simulation.particles.totals().center[1]
    rows = advance(simulation, 1.0, 0.01)
    assert rows[-1]["volume"] == pytest.approx(rows[0]["volume"], rel=0.02)
    assert rows[-1]["center_of_mass_y"] == pytest.approx(height, rel=0.01)
    assert rows[-1]["kinetic_energy"] < 1e-3 * rows[-1]["potential_energy"]
    p = simulation.grid.interior(simulation.projection.pressures(1000.0))[..., 0].mean(axis=0)
    depth = 0.5 - (np.arange(32) + 0.5) / 32
    # The surface is known to half a cell.
    np.testing.assert_allclose(p[:14] / (1000.0 * GRAVITY), depth[:14], atol=0.45 / 32)
    assert not p[17:].any()


def test_blocks_that_part_are_not_held_together() -> None:
    halves = [
        box([0.25, 0.25], [0.5, 0.75], velocity=[-1.0, 0.0]),
        box([0.5, 0.25], [0.75, 0.75], velocity=[1.0, 0.0]),
    ]
    speeds = {}
    for model in ("unilateral", "incompressible"):
        simulation = liquid(
            [1.0, 1.0], halves, physics={"gravity": [0.0, 0.0]}, pressure={"model": model}
        )
        advance(simulation, 0.1, 0.005)
        speeds[model] = np.abs(simulation.particles.velocity.numpy()[:, 0]).mean()
    # Particles within a cell of the seam share faces and stay behind as spray.
    assert speeds["unilateral"] > 0.93
    assert speeds["incompressible"] < 0.8


def test_liquid_falls_off_the_ceiling() -> None:
    simulation = liquid([0.5, 1.0], [box([0.125, 0.75], [0.375, 1.0])])
    start = simulation.particles.totals().center[1]
    rows = advance(simulation, 0.2, 0.01)
    assert rows[-1]["center_of_mass_y"] - start == pytest.approx(-0.5 * GRAVITY * 0.2**2, rel=0.1)
    assert simulation.particles.totals().high[1] < 0.98


def test_a_collision_conserves_volume_and_momentum() -> None:
    drops = [
        {"shape": "sphere", "center": [0.3, 0.5], "radius": 0.12, "velocity": [2.0, 0.0]},
        {"shape": "sphere", "center": [0.7, 0.5], "radius": 0.12, "velocity": [-2.0, 0.0]},
    ]
    simulation = liquid(
        [1.0, 1.0], drops, 48, physics={"gravity": [0.0, 0.0]}, cfl=1.0, density_correction={}
    )
    rows = advance(simulation, 0.12)
    velocity = simulation.particles.velocity.numpy()
    assert np.abs(velocity[:, 0]).mean() < 1.2  # they have met
    assert np.abs(velocity[:, 1]).mean() > 0.5
    np.testing.assert_allclose(velocity.mean(axis=0), 0.0, atol=0.02)
    assert rows[-1]["volume"] == pytest.approx(rows[0]["volume"], rel=0.06)
    energies = [row["kinetic_energy"] for row in rows]
    assert max(energies) < 1.02 * energies[0]  # there is no gain of energy
