"""Density correction beside periodic sides: its problem, its displacements, layers that keep."""

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.granular.scene import SandScene
from warp_lcp.granular.simulator import GranularSimulator, SandSimulation
from warp_lcp.grid.particles import Particles
from warp_lcp.material.density_correction import DensityCorrection

DX, COUNTS, MOST = 0.02, (10, 8), 1.05  # [m]; cells; largest density
FLOOR = {"shape": "box", "min": [-1.0, -1.0], "max": [1.0, 1.37 * DX]}  # cuts cells


def simulation_of(
    counts: tuple[int, ...] = COUNTS, solid: list[dict[str, Any]] | None = None, **tables: Any
) -> SandSimulation:
    """Return a layer of sand, half as deep as the domain, that is periodic along x and z."""
    size = [n * DX for n in counts]
    layer = {"shape": "box", "min": [0.0] * len(size), "max": [size[0], 0.5 * size[1], *size[2:]]}
    scene = {
        "scene": {"simulator": "granular"},
        "time": {"duration": 1.0},
        "domain": {
            "size": size,
            "resolution": max(counts),
            "periodic": [True, False, True][: len(size)],
        },
        "sand": [layer],
        "solid": solid or [],
    }
    return GranularSimulator().create(
        SandScene.model_validate(scene | tables), device="cpu", folder=Path()
    )


def correction_of(simulation: SandSimulation) -> DensityCorrection:
    """Return a correction that is solved nearly exactly."""
    return DensityCorrection(
        simulation.grid,
        simulation.boundary,
        wl.ProjectedMultigrid(precision="double"),
        particles_a_cell=2**simulation.grid.dimension,
        max_density=MOST,
        tolerance=1e-9,
        max_iterations=80,
    )


def squeezed(shift: int, dimension: int = 2) -> np.ndarray:
    """Return points of sand that is too dense across a side [m], shape (n, 3).

    They are shifted along x by a number of cells.
    """
    random = np.random.default_rng(12)
    span = [10.0, 4.0, 6.0][:dimension]
    points = random.uniform(0.0, 1.0, (round(4.2 * math.prod(span)), dimension)) * span
    dense = random.uniform(0.0, 1.0, (60 if dimension == 2 else 400, dimension)) * 2.0
    dense[:, 0] += 9.0
    points = np.pad(np.concatenate([points, dense]), ((0, 0), (0, 3 - dimension)))
    points[:, 1] += 1.4
    points[:, 0] = (points[:, 0] + shift) % 10.0
    if dimension == 3:
        points[:, 2] %= 6.0
    return points.astype(np.float32) * np.float32(DX)


def moved(
    simulation: SandSimulation, points: np.ndarray
) -> tuple[DensityCorrection, wl.SolveResult, np.ndarray]:
    """Correct points once; return the correction, its solve and the positions after it."""
    corrected = correction_of(simulation)
    particles = Particles(simulation.grid, points, np.zeros_like(points), affine=True)
    done = corrected.apply(particles, simulation.grid.everywhere)
    assert done.result is not None
    return corrected, done.result, particles.position.numpy().astype(float)


def density_of(counts: tuple[int, ...], points: np.ndarray) -> np.ndarray:
    """Return the density at cell centers by a sum over all pairs, shape (ny, nx)."""
    result = np.zeros(counts[::-1])
    for cell in itertools.product(*(range(n) for n in counts)):
        away = points[:, :2].astype(float) / DX - (np.array(cell) + 0.5)
        away[:, 0] -= counts[0] * np.round(away[:, 0] / counts[0])
        d = np.abs(away)
        weight = np.where(d < 0.5, 0.75 - d * d, np.where(d < 1.5, 0.5 * (1.5 - d) ** 2, 0.0))
        result[cell[::-1]] = weight.prod(axis=1).sum() / 4.0
    return result


def dense_solution(
    density: np.ndarray, base: np.ndarray, capacity: np.ndarray, open_y: np.ndarray | None
) -> np.ndarray:
    """Return x >= 0 complementary to sum a_f (x_i - x_nb) + MOST capacity - density by sweeps.

    All fields have the shape (ny, nx). `open_y` has the open fractions of lower faces.
    """
    ny, nx = density.shape
    wet = (base != wl.SOLID) & (density > 0.0)
    A = np.zeros((ny * nx, ny * nx))
    for j, i in itertools.product(range(ny), range(nx)):
        for m, l, low in ((j, (i - 1) % nx, False), (j - 1, i, True)):
            if m < 0 or base[j, i] == wl.SOLID or base[m, l] == wl.SOLID:
                continue
            fraction = 1.0 if open_y is None else open_y[0 if low else 1][j, i]
            for one, other in (((j, i), (m, l)), ((m, l), (j, i))):
                if wet[one]:
                    A[one[0] * nx + one[1], one[0] * nx + one[1]] += fraction
                    A[one[0] * nx + one[1], other[0] * nx + other[1]] -= fraction * wet[other]
    b, x = (MOST * capacity - density).ravel(), np.zeros(ny * nx)
    unknowns = np.flatnonzero(wet.ravel() & (A.diagonal() > 0.0))
    for _ in range(20000):
        before = x.copy()
        for n in unknowns:
            x[n] = max(0.0, x[n] - (A[n] @ x + b[n]) / A[n, n])
        if np.abs(x - before).max() < 1e-12:
            break
    return x.reshape(ny, nx)


@pytest.mark.parametrize("solid", [[], [FLOOR]])
def test_the_problem_continues_at_the_opposite_side(solid: list[dict[str, Any]]) -> None:
    """Solution against that of a dense problem whose first and last columns are neighbors."""
    simulation = simulation_of(solid=solid)
    points = squeezed(0)
    corrected, result, _ = moved(simulation, points)
    assert result
    boundary, inner = simulation.boundary, (1, slice(1, -1), slice(1, -1))
    base = boundary.base.numpy()[inner]
    opened = [boundary.open[axis].numpy()[inner] for axis in (1, 0)] if boundary.open else None
    expected = dense_solution(
        density_of(COUNTS, points),
        base,
        boundary.capacity.numpy()[inner].astype(float),
        None if opened is None else np.stack(opened),
    )
    assert expected[:, [0, -1]].max() > 0.2  # on both sides of the side
    np.testing.assert_allclose(corrected.x.numpy()[inner], expected, atol=0.01 if solid else 2e-4)


@pytest.mark.parametrize(("dimension", "solid"), [(2, []), (3, []), (2, [FLOOR])])
def test_a_shifted_start_gives_shifted_displacements(
    dimension: int, solid: list[dict[str, Any]]
) -> None:
    simulation = simulation_of((10, 8, 6)[:dimension], solid)
    size, ways = 10 * DX, []
    for shift in (0, 3, 5):
        points = squeezed(shift, dimension)
        _, result, after = moved(simulation, points)
        assert result
        assert (after[:, 0] >= 0.0).all()
        assert (after[:, 0] < size).all()
        way = after - points
        way[:, 0] -= size * np.round(way[:, 0] / size)
        if dimension == 3:
            way[:, 2] -= 6 * DX * np.round(way[:, 2] / (6 * DX))
        ways.append(way)
    assert np.abs(ways[0]).max() > 0.2 * DX
    for way in ways[1:]:
        # Particles beside a side may be moved by a little to keep off its end.
        assert np.abs(way - ways[0]).max() < 2e-3 * DX


def test_a_full_room_between_floor_and_ceiling_is_left_alone() -> None:
    """Room without a surface: constants are in the null space, and the excess has no way out."""
    simulation = simulation_of()
    random = np.random.default_rng(3)
    points = random.uniform(0.001, 0.999, (600, 3)) * [10 * DX, 8 * DX, 0.0]
    points = points.astype(np.float32)
    _, result, after = moved(simulation, points)
    assert result.status is wl.SolveStatus.INFEASIBLE
    assert np.array_equal(after, points.astype(float))


def test_the_monitor_counts_what_reaches_beyond_a_side() -> None:
    """Automatic correction: it acts for an excess beside a side as for one inside."""
    rows = []
    for shift in (0, 5):
        simulation = simulation_of()
        points = squeezed(shift)
        particles = simulation.particles
        particles.assign(
            {
                name: points if name == "position" else np.zeros((len(points), 3), np.float32)
                for name in particles.arrays()
            }
        )
        particles.sort()
        rows.append(simulation.step(1e-3))
    for row in rows:
        assert row["density_status"] == "CONVERGED"
    assert rows[0]["max_density"] == pytest.approx(rows[1]["max_density"], abs=1e-5)
    assert rows[0]["max_density"] > 2.0


def bagnold(y: np.ndarray, depth: float, fall: float) -> np.ndarray:
    """Return a speed profile 2/3 fall (depth^1.5 - (depth - y)^1.5) [m/s] at heights [m]."""
    rest = np.maximum(depth - y, 0.0)
    return np.asarray(2.0 / 3.0 * fall * (depth**1.5 - rest**1.5))


@pytest.mark.parametrize("tables", [{"density_correction": {}}, {}])
def test_a_layer_that_runs_for_long_keeps_its_height(tables: dict[str, Any]) -> None:
    """Height of glass beads that run down 26 degrees by mu(I), after 0.25 s.

    Where an axis is periodic, the table is the default. Without a correction the layer packs to
    0.86 of its mean height. The profile is Bagnold's, see
    `warp_lcp.benchmarks.validation.inclined`.
    """
    depth, slope, static, dynamic, grain = 0.04, 26.0, 20.9, 32.76, 5.3e-4
    tangents = [math.tan(math.radians(angle)) for angle in (static, slope, dynamic)]
    inertial = 0.279 * (tangents[1] - tangents[0]) / (tangents[2] - tangents[1])
    gravity = [9.81 * math.sin(math.radians(slope)), -9.81 * math.cos(math.radians(slope))]
    scene = {
        "scene": {"simulator": "granular"},
        "time": {"duration": 3.0},
        "domain": {
            "size": [8 * depth / 12, 1.5 * depth],
            "resolution": 18,
            "periodic": [True, False],
            "friction": "stick",
        },
        "physics": {"gravity": gravity},
        "material": {"friction_angle": static},
        "friction": {"dynamic_angle": dynamic, "grain_size": grain},
        "sand": [{"shape": "box", "min": [0.0, 0.0], "max": [8 * depth / 12, depth]}],
    }
    simulation = GranularSimulator().create(
        SandScene.model_validate(scene | tables), device="cpu", folder=Path()
    )
    fall = inertial / grain * math.sqrt(0.6 * -gravity[1])
    velocity, y = simulation.particles.velocity.numpy(), simulation.particles.position.numpy()[:, 1]
    before = y.mean()
    velocity[:, 0] = bagnold(y, depth, fall)
    simulation.particles.velocity.assign(velocity)
    while simulation.time < 0.25:
        simulation.step(min(simulation.stable_dt(), 5e-3))
    y, u = simulation.particles.position.numpy()[:, 1], simulation.particles.velocity.numpy()[:, 0]
    assert y.mean() == pytest.approx(before, rel=0.03)
    assert u.mean() == pytest.approx(bagnold(y, depth, fall).mean(), rel=0.03)
    assert simulation.particles.count == 384


def test_a_table_makes_no_difference_to_a_layer_that_slides_as_a_block() -> None:
    """Loose sand: nothing is corrected, and no bit changes."""
    ends = []
    for tables in ({}, {"density_correction": {"every": 0}}):
        simulation = simulation_of(particles={"jitter": 0.0}, **tables)
        for _ in range(10):
            simulation.step(2e-3)
        ends.append(wp.clone(simulation.particles.position).numpy())
    assert np.array_equal(*ends)
