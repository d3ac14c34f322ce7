"""Sand in periodic domains, independent of where the grid begins."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp
from scipy.spatial import cKDTree

from warp_lcp.granular.scene import SandScene
from warp_lcp.granular.simulator import GranularSimulator, SandSimulation
from warp_lcp.grid.domain_sides import PeriodicSides
from warp_lcp.grid.extrapolate import complete
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.scene.scene import SceneError, validate

DX, DT = 0.02, 2e-3  # [m], [s]


def scene(cells: tuple[int, ...], sand: list[dict[str, Any]], **tables: Any) -> dict[str, Any]:
    """Return a scene of cells of DX, periodic along x and z."""
    domain = {
        "size": [n * DX for n in cells],
        "resolution": max(cells),
        "periodic": [True, False, True][: len(cells)],
        "friction": 0.5,
    }
    return {
        "scene": {"simulator": "granular"},
        "time": {"duration": 1.0, "dt_max": DT},
        "domain": domain | tables.pop("domain", {}),
        "physics": {"gravity": [0.0, -9.81, 0.0][: len(cells)]},
        "particles": {"jitter": 0.0},
        "sand": sand,
    } | tables


def create(*args: Any, **tables: Any) -> SandSimulation:
    """Return the simulation of a `scene`."""
    return GranularSimulator().create(
        SandScene.model_validate(scene(*args, **tables)), device="cpu", folder=Path()
    )


def block(
    low: list[float], high: list[float], count: int, shift: int, velocity: list[float]
) -> list[dict[str, Any]]:
    """Return a box [cells], shifted along x by whole cells in a periodic domain.

    The domain has `count` cells. A box across the side is in two parts.
    """
    x0 = (low[0] + shift) % count
    x1 = x0 + high[0] - low[0]
    parts = [(x0, min(x1, count))] + ([(0.0, x1 - count)] if x1 > count else [])
    return [
        {
            "shape": "box",
            "min": [a * DX, *(n * DX for n in low[1:])],
            "max": [b * DX, *(n * DX for n in high[1:])],
            "velocity": velocity,
        }
        for a, b in parts
    ]


def test_the_ring_repeats_the_other_side() -> None:
    grid = StaggeredGrid((5, 3, 4), 1.0, 3)
    random = np.random.default_rng(2718)
    values = random.random(grid.shape)
    for axes, dtype in (((0,), wp.float64), ((2,), wp.float32), ((0, 2), wp.float64)):
        field = wp.array(values, dtype=dtype)
        PeriodicSides(grid, axes).wrap(field)
        expected = values[1:-1] if 2 in axes else values
        expected = (
            np.pad(expected, ((1, 1), (0, 0), (0, 0)), mode="wrap") if 2 in axes else expected
        )
        expected = (
            np.pad(expected[:, :, 1:-1], ((0, 0), (0, 0), (1, 1)), mode="wrap")
            if 0 in axes
            else expected
        )
        assert np.array_equal(field.numpy(), expected.astype(field.numpy().dtype))


def folded(field: Any) -> np.ndarray:
    """Return a field in double, with the ring added to the cells that it repeats.

    That is done along z and x.
    """
    values = np.asarray(field, float).copy()
    for _ in range(2):
        values[1] += values[-1]
        values[-2] += values[0]
        values[[0, -1]] = 0.0
        values = values.swapaxes(0, 2)
    return values


@pytest.mark.parametrize("at", [1, 8])
def test_velocities_go_on_through_a_side(at: int) -> None:
    """Extrapolation of velocities through a periodic side.

    One face is known. Its effect on its neighbors does not depend on where the grid begins.
    """
    grid = StaggeredGrid((8, 4, 4), 1.0, 3)
    window, join = (
        Window.of((1, 1, 1), (5, 5, 9), wp.get_device("cpu")),
        PeriodicSides(grid, (0,)).wrap,
    )

    def around(i: int) -> np.ndarray:
        host = np.zeros(grid.shape, dtype=np.float32)
        host[2, 2, i] = 1.0
        weight, field = (wp.array(factor * host, dtype=wp.float32) for factor in (1.0, 3.0))
        complete(window, [field], [weight], [wp.zeros(grid.shape, dtype=wp.int8)], join)
        return np.roll(field.numpy()[1:-1, 1:-1, 1:-1], 4 - i, axis=2)

    expected = around(4)
    assert np.count_nonzero(expected) > 20
    assert np.array_equal(around(at), expected)


def test_sums_and_means_over_particles_come_back_from_the_ring() -> None:
    grid = StaggeredGrid((5, 3, 4), 1.0, 3)
    random = np.random.default_rng(3141)
    sides = PeriodicSides(grid, (0, 2))
    density, velocity, weight, saved = (
        wp.array(random.random(grid.shape), dtype=wp.float32) for _ in range(4)
    )
    expected = folded(density)
    sides.add(density)
    assert density.numpy()[1:-1, :, 1:-1] == pytest.approx(expected[1:-1, :, 1:-1], rel=1e-6)
    assert np.array_equal(density.numpy()[0], density.numpy()[-2])
    total = folded(weight)
    momenta = [folded(field.numpy().astype(float) * weight.numpy()) for field in (velocity, saved)]
    sides.average([velocity], [weight], [saved])
    assert weight.numpy() == pytest.approx(total, rel=1e-6)
    for field, momentum in zip((velocity, saved), momenta, strict=True):
        assert field.numpy() * total == pytest.approx(momentum, rel=1e-5)


def test_particles_come_in_again_and_keep_off_the_end() -> None:
    grid = StaggeredGrid((10, 5, 1), DX, 2)
    L = 10 * DX
    x = [
        [-0.3 * DX, 0.05, 0],
        [L + 0.25 * DX, 0.05, 0],
        [L - 1e-8, 0.05, 0],
        [-1e-9, 0.05, 0],
        [0.1, -1e-4, 0],
        [L + 0.01, -1e-4, 0],
    ]
    position = wp.array(np.array(x, dtype=np.float32), dtype=wp.vec3)
    PeriodicSides(grid, (0,)).carry(position)
    found = position.numpy()
    assert found[:, 0] == pytest.approx([L - 0.3 * DX, 0.25 * DX, 0.0, 0.0, 0.1, 0.01], abs=1e-7)
    assert (found[:, 0] < L - 5e-4 * DX).all()
    assert found[4, 1] == np.float32(-1e-4)  # what has not crossed the side is unchanged
    assert found[5, 1] == pytest.approx(1e-3 * DX)


@pytest.mark.parametrize(("transfer", "steps"), [("apic", 20), ("flip", 8)])
def test_sand_that_starts_elsewhere_ends_elsewhere(transfer: str, steps: int) -> None:
    """Shifted start: shifted result.

    A block slides and collapses, once inside the grid, once across its sides. Without a row of the
    ring the two differ within a step.
    """
    count = 12

    def run(shift: int) -> tuple[np.ndarray, np.ndarray]:
        sand = block([4, 0], [8, 8], count, shift, [0.5, 0.0])
        simulation = create((count, 12), sand, particles={"jitter": 0.0, "transfer": transfer})
        for _ in range(steps):
            simulation.step(DT)
        position = simulation.particles.position.numpy().astype(float)
        position[:, 0] = (position[:, 0] - shift * DX) % (count * DX)
        return position, simulation.particles.velocity.numpy()

    at, velocity = run(0)
    for shift in (3, 7):
        there, moving = run(shift)
        distance, partner = cKDTree(at[:, :2], boxsize=[count * DX, 1.0]).query(there[:, :2])
        assert len(set(partner)) == len(at)
        assert distance.max() < 1e-2 * DX
        assert np.abs(moving - velocity[partner]).max() < 1e-3
    assert at[:, 0].mean() > (6 + 0.15 * steps / 8) * DX  # the block has moved


def test_the_same_in_three_dimensions() -> None:
    count, steps = 6, 5

    def run(shift: int, *, turned: bool) -> np.ndarray:
        sand = block([1, 0, 1], [4, 4, 4], count, shift, [0.5, 0.0, 0.2])
        if turned:  # x and z change places
            for box in sand:
                for key in ("min", "max", "velocity"):
                    box[key] = box[key][::-1]
        simulation = create((count, 6, count), sand)
        for _ in range(steps):
            simulation.step(DT)
        position = simulation.particles.position.numpy().astype(float)
        position = position[:, ::-1] if turned else position
        position[:, 0] = (position[:, 0] - shift * DX) % (count * DX)
        return position

    at = run(0, turned=False)
    for shift, turned in ((4, False), (4, True)):
        distance, partner = cKDTree(at, boxsize=[count * DX, 1.0, count * DX]).query(
            run(shift, turned=turned)
        )
        assert len(set(partner)) == len(at)
        assert distance.max() < 2e-3 * DX


def test_mass_is_conserved_across_the_sides() -> None:
    """Conservation on the way around.

    A layer that slides on a smooth floor keeps its mass, momentum and height for two rounds.
    """
    count = 8
    simulation = create(
        (count, 8), block([0, 0], [count, 4], count, 0, [1.0, 0.0]), domain={"friction": 0.0}
    )
    particles, row = simulation.particles.count, {}
    while simulation.time < 2 * count * DX / 1.0:
        row = simulation.step(DT)
    assert simulation.particles.count == particles == row["particles"]
    velocity = simulation.particles.velocity.numpy().astype(float)
    assert velocity[:, 0].mean() == pytest.approx(1.0, abs=1e-5)
    assert np.abs(velocity[:, 0] - 1.0).max() < 1e-4
    assert simulation.particles.position.numpy()[:, 1].mean() == pytest.approx(2 * DX, rel=0.02)


def test_a_floor_goes_on_across_the_sides() -> None:
    """Floor across periodic sides.

    On a slanted floor the sides differ and the scene is refused. On a flat one the layer slides as
    on the domain's own floor.
    """
    sand = block([0, 0], [8, 6], 8, 0, [1.0, 0.0])
    flat = {"shape": "box", "min": [-1.0, -1.0], "max": [1.0, 2.5 * DX], "friction": 0.0}
    simulation = create((8, 10), sand, solid=[flat])
    particles = simulation.particles.count
    for _ in range(100):
        simulation.step(DT)
    assert simulation.particles.count == particles
    assert simulation.particles.velocity.numpy()[:, 0].mean() == pytest.approx(1.0, abs=1e-4)
    assert simulation.particles.position.numpy()[:, 1].min() > 2.5 * DX
    # Points on the side, or nearer to it than the margin of a wall.
    points = np.zeros((21, 3), dtype=np.float32)
    points[:, 0], points[:, 1] = (7.5 + np.linspace(-1e-3, 1e-3, 21)) * DX, 6.5 * DX
    position, wind = wp.array(points, dtype=wp.vec3), simulation.grid.faces()
    wind[0].fill_(1.0)
    simulation.boundary.advect(wind, 0.5 * DX, simulation.time, position)
    assert simulation.boundary.collision_counts() == (0, 0, 0)
    assert np.unwrap(position.numpy()[:, 0], period=8 * DX) - points[:, 0] == pytest.approx(
        0.5 * DX, abs=1e-7
    )
    with pytest.raises(ValueError, match="sides of the periodic x axis"):
        create(
            (8, 10), sand, solid=[{"shape": "plane", "point": [0.08, 0.03], "normal": [0.3, 1.0]}]
        )


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"domain": {"periodic": [True, True]}}, "along x and z only"),
        ({"domain": {"open": ["left"]}}, "side of a periodic axis"),
        ({"solver": {"method": "interleaved-sweeps"}}, "cannot be combined with periodic axes"),
        ({"particles": {"reseed": {}}}, "cannot be combined with reseed, source or drain"),
    ],
)
def test_contradicting_settings_are_refused(tables: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneError, match=message):
        validate(
            SandScene, scene((8, 8), block([0, 0], [8, 4], 8, 0, [0.0, 0.0]), **tables), "scene"
        )


def test_a_domain_with_walls_has_no_periodic_data() -> None:
    simulation = create(
        (8, 8), block([0, 0], [8, 4], 8, 0, [0.0, 0.0]), domain={"periodic": [False, False]}
    )
    assert simulation.sides is None
    assert simulation.packing.sides is None
    assert simulation.boundary.open_sides == 0
    assert math.isfinite(float(simulation.step(DT)["mass"]))
