"""Surface tension against theory.

Curvature, pressure jump, walls, frequencies of drops and waves.
"""

import math
from typing import Any

import numpy as np
import pytest
import warp as wp
from scipy.optimize import curve_fit

import warp_lcp as wl
from default_run import covering, slow
from small_liquids import advance, box, create, scene
from warp_lcp.fluids import LiquidSimulation
from warp_lcp.fluids import surface_tension_kernels as kernels
from warp_lcp.fluids.surface_tension import MOST_PASSES, SurfaceTension, wall_cells

SIGMA, RHO, RADIUS = 0.072, 1000.0, 0.01  # of water [N/m, kg/m^3], and of drops [m]
# Units of a drop.
SPEED, TIME = math.sqrt(SIGMA / (RHO * RADIUS)), math.sqrt(RHO * RADIUS**3 / SIGMA)
WATER: dict[str, Any] = {"coefficient": SIGMA}


def tank(dimension: int, cells: int, *, angle: float = 90.0, **tables: Any) -> LiquidSimulation:
    """Return a simulation of unit cells, whose own liquid does not matter."""
    side = float(cells)
    liquid = [box([0.0] * dimension, [side / 2] * dimension)]
    tension = {"coefficient": 1.0, "contact_angle": angle}
    physics = {"density": 1.0, "gravity": [0.0] * dimension}
    return create(
        scene(
            size=[side] * dimension,
            resolution=cells,
            liquid=liquid,
            surface_tension=tension,
            physics=physics,
            **tables,
        )
    )


def centers(simulation: LiquidSimulation) -> np.ndarray:
    """Return the centers (x, y, z) of the stored cells in unit cells."""
    k, j, i = np.indices(simulation.grid.shape)
    z = np.zeros_like(k, dtype=float) if simulation.grid.dimension == 2 else k - 0.5
    return np.stack([i - 0.5, j - 0.5, z], axis=-1)


def take(simulation: LiquidSimulation, distance: np.ndarray) -> tuple[SurfaceTension, np.ndarray]:
    """Apply the surface tension to a given distance to the surface.

    Return it and the kinds of the cells.
    """
    assert simulation.tension is not None and simulation.surface.phi is not None
    kind = simulation.boundary.base.numpy().copy()
    kind[(kind == wl.AIR) & (distance < 0.0)] = wl.FLUID
    simulation.surface.phi.assign(np.clip(distance, -1.5, 1.5).astype(np.float32))
    simulation.projection.kind.assign(kind)
    simulation.tension.act(
        simulation.velocity, simulation.grid.everywhere, simulation.projection.kind, 1e-3
    )
    return simulation.tension, kind


def curvatures(simulation: LiquidSimulation, distance: np.ndarray) -> np.ndarray:
    """Return the curvature [1/cells] in cells beside the surface."""
    tension, _ = take(simulation, distance)
    jump = tension.jump.numpy() / 1e-3
    return np.asarray(jump[jump != 0.0])


def measured(
    simulation: LiquidSimulation, liquid: np.ndarray, open_: np.ndarray, points: int
) -> np.ndarray:
    """Return the level set of evenly spread particles.

    Args:
        simulation: simulation of unit cells.
        liquid: whether liquid is at each sample; `points` samples per axis and cell, up to two
            cells beyond the domain, in the order of the stored cells.
        open_: whether a sample is outside of solids.
        points: number of samples along each axis of a cell.
    """
    filled, room = (liquid & open_).astype(np.float64), open_.astype(np.float64)
    for axis, count in enumerate(simulation.grid.counts[::-1]):
        if filled.shape[axis] > 1:
            t = np.abs(
                (np.arange((count + 4) * points) + 0.5) / points
                - 2.0
                - np.arange(count)[:, None]
                - 0.5
            )
            kernel = (
                np.where(t < 0.5, 0.75 - t * t, np.where(t < 1.5, 0.5 * (1.5 - t) ** 2, 0.0))
                / points
            )
            filled, room = (
                np.moveaxis(np.tensordot(kernel, of, axes=(1, axis)), 0, axis)
                for of in (filled, room)
            )
    places = np.linspace(-1.5, 1.5, 3001)
    shares = np.where(
        np.abs(places) < 0.5,
        0.5 - 0.75 * np.abs(places) + np.abs(places) ** 3 / 3.0,
        (1.5 - np.abs(places)) ** 3 / 6.0,
    )
    shares = np.where(places > 0.0, 1.0 - shares, shares)
    distance = np.full(simulation.grid.shape, 1.5)
    distance[1:-1, 1:-1, 1:-1] = -np.interp(filled / np.maximum(room, 1e-9), shares, places)
    return distance


def samples(simulation: LiquidSimulation, points: int) -> np.ndarray:
    """Return the points (x, y, z) of `measured`, in cells."""
    axes = [
        (np.arange((n + 4) * points) + 0.5) / points - 2.0 if n > 1 else np.zeros(1)
        for n in simulation.grid.counts[::-1]
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij")[::-1], axis=-1)


@pytest.mark.parametrize(("dimension", "radius"), [(2, 6.0), (2, 12.0), (3, 7.0)])
@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["drop", "bubble"])
def test_the_curvature_of_a_sphere(dimension: int, radius: float, sign: float) -> None:
    rng = np.random.default_rng(71)
    simulation = tank(dimension, math.ceil(2 * radius + 12))
    for _ in range(2):
        middle = simulation.grid.counts[0] / 2 + rng.uniform(-0.5, 0.5, 3)
        middle[dimension:] = 0.0
        distance = sign * (np.linalg.norm(centers(simulation) - middle, axis=-1) - radius)
        found = curvatures(simulation, distance) * radius / (dimension - 1)
        assert found.mean() == pytest.approx(sign, abs=0.05 if radius < 10 else 0.015)
        assert found.std() < 0.03


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("at", [1, 5])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_surface_is_looked_for_nearby_and_inside_the_grid(
    dimension: int, at: int, sign: float
) -> None:
    """Search for the surface nearby and inside the grid.

    Where the distance is nearly constant, its slope implies 15 cells; the search goes at most 1.5
    slopes. Ghost cells do not count.
    """
    simulation = create(
        scene(
            size=[1.0] * dimension,
            resolution=10,
            liquid=[box([0.0] * dimension, [0.5] * dimension)],
        )
    )
    grid, field = simulation.grid, simulation.grid.field
    once, twice, bend, jump = (field() for _ in range(4))
    i = np.broadcast_to(np.arange(once.shape[2], dtype=np.float32), once.shape)
    once.assign(0.5 - sign * (0.3 + 0.02 * (i - at)))
    twice.assign(once.numpy())
    bent = i.copy()
    bent[..., 0] = 1000.0
    bend.assign(bent)
    kind = grid.field(wp.int8)
    kind.assign(np.where(i <= at, wl.FLUID, wl.AIR).astype(np.int8))
    numbers = {"planes": grid.planes, "linear": 1.0, "cubic": 0.0, "scale": 2.0}
    grid.everywhere.run(
        kernels.JUMP, once=once, twice=twice, bend=bend, jump=jump, kind=kind, **numbers
    )
    found = jump.numpy()[1:-1, 1:-1, 1:-1] if dimension == 3 else jump.numpy()[1, 1:-1, 1:-1]
    expected = 2.0 * np.maximum(np.array([at, at + 1]) - 1.5 * 0.02, 1.0)
    np.testing.assert_allclose(
        found[..., at - 1 : at + 1], np.broadcast_to(expected, (*found.shape[:-1], 2)), rtol=1e-4
    )


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_push_is_a_jump_of_the_pressure(dimension: int) -> None:
    simulation = tank(dimension, 16)
    middle = np.array([8.2, 7.9, 8.1 if dimension == 3 else 0.0])
    tension, kind = take(simulation, np.linalg.norm(centers(simulation) - middle, axis=-1) - 5.0)
    for field in simulation.velocity:
        field.zero_()
    tension.jump.fill_(0.25)
    window, projection = simulation.grid.everywhere, simulation.projection
    for axis, field in enumerate(simulation.velocity):
        window.run(
            tension._passes.push,
            kind=projection.kind,
            phi=simulation.surface.phi,
            planes=simulation.grid.planes,
            jump=tension.jump,
            field=field,
            axis=axis,
            **{f"{what}_{a}": None for what in ("open", "solid") for a in "xyz"},
        )
    assert max(np.abs(field.numpy()).max() for field in simulation.velocity) > 0.25
    projection.tolerance = 1e-8
    assert projection.prepare(simulation.velocity, 1e-3, 1e-3)
    result, criteria = projection.solve(1.0)
    assert result
    projection.project(simulation.velocity, window, result, criteria)
    np.testing.assert_allclose(projection.pressure.numpy()[kind == wl.FLUID], 0.25, rtol=1e-5)
    # The push is up to 0.25 / theta.
    assert max(np.abs(field.numpy()).max() for field in simulation.velocity) < 1e-4


@pytest.mark.default_cases(4)
@pytest.mark.parametrize(
    ("dimension", "degrees", "angle"),
    [
        (2, 0.0, 50.0),
        (2, 10.0, 130.0),
        (2, 25.0, 50.0),
        (2, 25.0, 90.0),
        (3, 0.0, 130.0),
        (3, 25.0, 50.0),
        *map(
            slow,
            [
                (2, 0.0, 90.0),
                (2, 0.0, 130.0),
                (2, 10.0, 50.0),
                (2, 10.0, 90.0),
                (2, 25.0, 130.0),
                (3, 0.0, 50.0),
                (3, 0.0, 90.0),
                (3, 25.0, 90.0),
                (3, 25.0, 130.0),
            ],
        ),
    ],
)
def test_a_plane_at_the_contact_angle_is_straight(
    angle: float, dimension: int, degrees: float
) -> None:
    cells, slope = 32 if dimension == 2 else 24, math.radians(degrees)
    normal = [math.sin(slope), math.cos(slope), 0.0]
    wall = (
        {
            "solid": [
                {
                    "shape": "plane",
                    "point": [cells / 2, 8.0, 0.0][:dimension],
                    "normal": normal[:dimension],
                }
            ]
        }
        if slope
        else {}
    )
    foot = np.array([cells / 2 + 0.3, 8.0 - 0.3 * math.tan(slope) if slope else 0.0, 0.0])
    tilt = math.radians(angle) - slope  # of the surface, whose liquid lies to its right
    found = {}
    for prescribed_angle in (angle, angle - 30.0):
        simulation = tank(dimension, cells, angle=prescribed_angle, **wall)
        at = samples(simulation, 10 if dimension == 2 else 4)
        open_ = ((at > 0.0) & (at < cells))[..., :dimension].all(axis=-1)
        if slope:
            open_ &= (at - [cells / 2, 8.0, 0.0]) @ normal > 0.0
        liquid = (at - foot) @ (-math.sin(tilt), math.cos(tilt), 0.0) < 0.0
        tension, _ = take(
            simulation, measured(simulation, liquid, open_, 10 if dimension == 2 else 4)
        )
        away = (centers(simulation) - foot) * (1.0, 1.0, 0.0)
        near = np.linalg.norm(away, axis=-1) < 6.0
        if dimension == 3:
            # The sides have the angle, too.
            near &= np.abs(centers(simulation)[..., 2] - cells / 2) < 2.0
        found[prescribed_angle] = np.abs(tension.jump.numpy()[near]).max() / 1e-3
    assert found[angle] < 0.03
    assert found[angle - 30.0] > 0.06


def meniscus(
    width: int, angle: float, offset: float, rng: np.random.Generator
) -> tuple[LiquidSimulation, np.ndarray, float, float]:
    """Return an arc between plates: distance, radius, and its begin.

    The left end is at `offset` of a cell, or at the domain's side.
    """
    radius, low, depth = (
        0.5 * width / math.cos(math.radians(angle)),
        3.0 + offset if offset else 0.0,
        9.0,
    )
    high = low + width
    size = [float(math.ceil(high + low)), width + 18.0]
    plates: dict[str, Any] = (
        {"solid": [box([-9.0, -9.0], [low, 99.0]), box([high, -9.0], [size[0] + 9.0, 99.0])]}
        if offset
        else {}
    )
    physics, tension = (
        {"density": 1.0, "gravity": [0.0, 0.0]},
        {"coefficient": 1.0, "contact_angle": angle},
    )
    plates |= {
        "liquid": [box([low, 0.0], [high, depth])],
        "physics": physics,
        "surface_tension": tension,
    }
    simulation = create(scene(size=size, resolution=int(max(size)), **plates))
    middle = np.array([0.5 * (low + high), depth + rng.uniform(-0.5, 0.5) + radius, 0.0])
    at = samples(simulation, 12)
    inside = np.linalg.norm(at - middle, axis=-1) < abs(radius)
    below = (
        (at[..., 1] < middle[1]) & ~inside if radius > 0.0 else inside | (at[..., 1] < middle[1])
    )
    return (
        simulation,
        measured(
            simulation, below, (at[..., 0] > low) & (at[..., 0] < high) & (at[..., 1] > 0.0), 12
        ),
        radius,
        low,
    )


@pytest.mark.default_cases(3)
@pytest.mark.parametrize(
    ("place", "angle"),
    covering(
        [(12, 0.0), (24, 0.0), (12, 0.25), (12, 1 / 3), (12, 0.5)], [30.0, 60.0, 120.0], count=6
    ),
)
def test_a_meniscus_has_the_curvature_of_its_arc(place: tuple[int, float], angle: float) -> None:
    """Curvature of a meniscus between walls: 2 cos(angle) / width.

    The mean, which determines the rise of liquid, was 8 % off where walls cut cells.
    """
    width, offset = place
    rng, found = np.random.default_rng(17), []
    for _ in range(3):
        simulation, distance, radius, low = meniscus(width, angle, offset, rng)
        tension, _ = take(simulation, distance)
        first = 1 + math.ceil(low - 0.5)  # of the columns whose center is open
        jump = tension.jump.numpy()[1, :, first : first + width] / 1e-3
        found.append(-radius * jump.sum(axis=0) / np.maximum((jump != 0.0).sum(axis=0), 1))
    columns = np.mean(found, axis=0)
    assert columns.mean() == pytest.approx(1.0, abs=0.05 if offset else 0.03)
    assert offset or (columns.min() > 0.75 and columns.max() < 1.1)


@pytest.mark.parametrize("angle", [30.0, 150.0])
def test_the_widest_filter_bends_no_flat_surface_beside_a_wall(angle: float) -> None:
    """Flat surface beside a wall with the widest filter.

    A kernel may be empty, or full, where that of the wall cell behind it is not: the surface seemed
    to turn by 0.028 there.
    """
    turns, rng = [], np.random.default_rng(11)
    cosine, sine = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    simulation = tank(2, 32, angle=angle)
    tension, at = simulation.tension, samples(simulation, 10)
    assert tension is not None
    kick = tension.longest_step()
    assert tension._passes_for(kick) == MOST_PASSES
    for _ in range(8):
        foot = 16.0 + 6.0 * cosine + rng.uniform(-0.5, 0.5)
        liquid, open_ = (
            at[..., 0] * cosine + (at[..., 1] - foot) * sine < 0.0,
            ((at > 0.0) & (at < 32.0))[..., :2].all(axis=-1),
        )
        distance = measured(simulation, liquid, open_, 10)
        _, kind = take(simulation, distance)
        tension.act(
            simulation.velocity, simulation.grid.everywhere, simulation.projection.kind, kick
        )
        turn = 0.0
        for i in range(1, 5):
            j = np.flatnonzero((kind[1, :-1, i] == wl.FLUID) & (kind[1, 1:, i] == wl.AIR))[-1]
            below, above = distance[1, j : j + 2, i]
            turn += np.interp(0.0, [below, above], tension.jump.numpy()[1, j : j + 2, i]) / kick
        turns.append(turn)
    assert abs(np.mean(turns)) < 0.015


def test_cells_of_walls_mirror_what_is_before_them() -> None:
    simulation = tank(2, 8, solid=[box([4.0, 0.0], [8.0, 2.0])])
    base = simulation.boundary.base.numpy()
    blocked, cells, points, way, raised = wall_cells(simulation.grid, base, None)
    assert (raised == 0.0).all()
    assert ((blocked != 0)[1, 1:-1, 1:-1] == (base == wl.SOLID)[1, 1:-1, 1:-1]).all()
    found = {
        tuple(np.array(np.unravel_index(c, base.shape))[::-1]): (p, w)
        for c, p, w in zip(cells, points, way, strict=True)
    }
    for cell, (point, length) in {
        (0, 3, 1): ((1, 3, 1), 1.0),  # the domain's left wall
        (0, 0, 1): ((1, 1, 1), 2.0),  # its corner
        (6, 2, 1): ((6, 3, 1), 1.0),  # the top of the box
        (5, 2, 1): ((4, 3, 1), 2.0),  # its upper corner
    }.items():
        np.testing.assert_array_equal(found[cell][0], point)
        assert found[cell][1] == length


def drop(across: int, dimension: int = 2, *, seed: int = 2015, **tables: Any) -> LiquidSimulation:
    """Return a drop in free space of so many cells in diameter."""
    side = (4 if dimension == 2 else 3) * RADIUS
    liquid = [{"shape": "sphere", "center": [side / 2] * dimension, "radius": RADIUS}]
    settings = {"particles": {"seed": seed}, "surface_tension": WATER} | tables
    return create(
        scene(
            size=[side] * dimension,
            resolution=across * (4 if dimension == 2 else 3) // 2,
            liquid=liquid,
            physics={"gravity": [0.0] * dimension},
            **settings,
        )
    )


def capillary_step(simulation: LiquidSimulation) -> float:
    """Return the step [s] beyond which unfiltered surface tension is unstable."""
    return math.sqrt(RHO * simulation.grid.spacing**3 / (math.pi * SIGMA))


def laplace(simulation: LiquidSimulation, dimension: int) -> float:
    """Return the pressure deep inside over sigma kappa."""
    assert simulation.surface.phi is not None
    deep = (simulation.projection.cells.numpy() == wl.FLUID) & (
        simulation.surface.phi.numpy() < -1.4
    )
    return (
        float(simulation.projection.pressures(RHO)[deep].mean())
        * RADIUS
        / ((dimension - 1) * SIGMA)
    )


@pytest.mark.parametrize(
    ("across", "dimension", "error"),
    [(16, 2, 0.03), slow((32, 2, 0.02)), (16, 3, 0.05), slow((32, 3, 0.02))],
)
def test_the_pressure_in_a_drop(across: int, dimension: int, error: float) -> None:
    simulation = drop(across, dimension)
    rows = advance(simulation, 0.2 * TIME, capillary_step(simulation))
    assert laplace(simulation, dimension) == pytest.approx(1.0, abs=error)
    area = 2.0 * math.pi * RADIUS * (1.0 if dimension == 2 else 2.0 * RADIUS)
    assert rows[-1]["surface_energy"] == pytest.approx(
        SIGMA * area, rel=0.08 if across == 16 else 0.03
    )


@pytest.mark.parametrize(("times", "bound"), [slow((1.0, 1e-2)), (10.0, 1e-2)])
def test_a_drop_at_rest_stays_so(times: float, bound: float) -> None:
    simulation = drop(16)
    rows = advance(simulation, 12.0 * TIME, times * capillary_step(simulation))
    speeds = [row["max_speed"] / SPEED for row in rows]
    assert max(speeds) < 0.1
    assert max(speeds[-len(rows) // 6 :]) < 0.03
    velocity = simulation.particles.velocity.numpy()
    assert math.sqrt((velocity**2).sum(axis=1).mean()) / SPEED < bound
    assert rows[-1]["volume"] == pytest.approx(rows[0]["volume"], rel=5e-3)


def moved(simulation: LiquidSimulation, position: np.ndarray) -> None:
    """Set the particles' positions."""
    arrays = {name: array.numpy() for name, array in simulation.particles.arrays().items()}
    simulation.particles.assign(arrays | {"position": position.astype(np.float32)})
    simulation.particles.sort()


def frequency(times: list[float], values: list[float], guess: float) -> tuple[float, float]:
    """Return the frequency and the damping of an oscillation, relative to a guess."""

    def decaying(t: np.ndarray, a: float, b: float, w: float, c: float, d: float) -> np.ndarray:
        return np.exp(-c * t) * (a * np.cos(w * t) + b * np.sin(w * t)) + d

    found, _ = curve_fit(
        decaying, np.array(times), np.array(values), p0=[values[0], 0.0, guess, 0.01 * guess, 0.0]
    )
    return float(found[2]) / guess, float(found[3]) / guess


def oscillation(
    across: int, dimension: int, times: float, periods: float = 1.6
) -> tuple[float, float]:
    """Return the frequency of an ellipsoid over Lamb's, and its damping."""
    guess = math.sqrt((6.0 if dimension == 2 else 8.0) / TIME**2)
    simulation, stretch = drop(across, dimension), 0.05
    middle = simulation.grid.extent[0] / 2
    position = simulation.particles.position.numpy()
    position[:, 0] = middle + (position[:, 0] - middle) * math.exp(stretch)
    position[:, 1:dimension] = middle + (position[:, 1:dimension] - middle) * math.exp(
        -stretch / (dimension - 1)
    )
    moved(simulation, position)
    at, shape = [], []
    while simulation.time < periods * 2.0 * math.pi / guess:
        simulation.step(min(simulation.stable_dt(), times * capillary_step(simulation)))
        spread = simulation.particles.position.numpy().var(axis=0)
        at.append(simulation.time)
        shape.append(math.log(spread[0] / spread[1:dimension].mean()))
    return frequency(at, shape, guess)


@pytest.mark.parametrize("times", [2.0, 6.0])
def test_a_drop_oscillates(times: float) -> None:
    found, damping = oscillation(16, 2, times)
    assert found == pytest.approx(1.0, abs=0.03)
    assert 0.0 < damping < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_drop_oscillates_at_lambs_frequency(dimension: int) -> None:
    errors = [abs(oscillation(across, dimension, 3.0)[0] - 1.0) for across in (8, 16, 32)]
    assert errors[2] < 0.01
    assert errors[0] > 2.0 * errors[1] or errors[1] > 1.5 * errors[2]  # first order at least
    assert errors[0] > 4.0 * errors[2]


def wave(cells: int, times: float = 1.0) -> float:
    """Return the frequency of a standing capillary wave over the exact one.

    The exact one is sqrt(sigma k^3 tanh(k h) / rho).
    """
    length = 2.0 * RADIUS
    k, depth, height = 2.0 * math.pi / length, length / 2, 0.02 * length
    liquid = [box([0.0, 0.0], [length, depth])]
    simulation = create(
        scene(
            size=[length, length],
            resolution=cells,
            liquid=liquid,
            wall="free-slip",
            physics={"gravity": [0.0, 0.0]},
            surface_tension=WATER,
        )
    )
    position = simulation.particles.position.numpy()
    x, y = position[:, 0].copy(), position[:, 1].copy()
    position[:, 0] -= height * np.sin(k * x) * np.cosh(k * y) / math.sinh(k * depth)
    position[:, 1] += height * np.cos(k * x) * np.sinh(k * y) / math.sinh(k * depth)
    moved(simulation, position)
    guess = math.sqrt(SIGMA * k**3 / RHO * math.tanh(k * depth))
    at, shape = [], []
    while simulation.time < 2.0 * 2.0 * math.pi / guess:
        simulation.step(min(simulation.stable_dt(), times * capillary_step(simulation)))
        at.append(simulation.time)
        shape.append(float(np.cos(k * simulation.particles.position.numpy()[:, 0]).mean()))
    return frequency(at, shape, guess)[0]


def test_a_capillary_wave() -> None:
    assert wave(32) == pytest.approx(1.0, abs=0.03)


@pytest.mark.slow
def test_capillary_waves_converge() -> None:
    assert wave(64, 3.0) == pytest.approx(1.0, abs=0.012)
    # The widest filter reduces so short a wave.
    assert wave(32, 10.0) == pytest.approx(1.0, abs=0.05)


def cap(angle: float, prescribed_angle: float) -> tuple[LiquidSimulation, float, float]:
    """Return a drop on the floor with a contact angle.

    The height of its center of mass and the radius of its surface [m] are returned too.
    """
    a = math.radians(angle)
    radius = RADIUS * math.sqrt(0.5 * math.pi / (a - math.sin(a) * math.cos(a)))
    side = 6.0 * RADIUS
    liquid = [{"shape": "sphere", "center": [side / 2, -radius * math.cos(a)], "radius": radius}]
    tension = WATER | {"contact_angle": prescribed_angle}
    tables = {"wall": "free-slip", "physics": {"gravity": [0.0, 0.0]}, "surface_tension": tension}
    simulation = create(scene(size=[side, side / 2], resolution=96, liquid=liquid, **tables))
    height = radius * (2.0 * math.sin(a) ** 3 / 3.0 / (a - math.sin(a) * math.cos(a)) - math.cos(a))
    return simulation, height, radius


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("angle", [60.0, 90.0, 120.0])
def test_a_drop_keeps_its_contact_angle(angle: float) -> None:
    heights = {}
    for given in (angle, 180.0 - angle if angle != 90.0 else 60.0):
        simulation, height, _ = cap(angle, given)
        advance(simulation, 1.0 * TIME, 2.0 * capillary_step(simulation))
        heights[given] = float(simulation.particles.position.numpy()[:, 1].mean()) / height
    kept, other = heights.values()
    assert kept == pytest.approx(1.0, abs=0.05)
    assert abs(other - 1.0) > 0.15


def test_velocity_gradients_are_damped_near_the_surface_alone() -> None:
    simulation = drop(16)
    tension, particles, phi = simulation.tension, simulation.particles, simulation.surface.phi
    assert tension is not None and phi is not None
    simulation.step(1e-4)
    particles.number()
    depth = phi.numpy().ravel()[particles.key.numpy()[: particles.count]]
    deep, near = depth == -1.5, depth > -1.4
    for gradient in particles.affine:
        gradient.fill_(1.0)
    dt = 1.0 / math.sqrt(SIGMA / (RHO * simulation.grid.spacing**3))
    tension.damp_velocity_gradients(particles, dt)
    assert deep.any() and near.any()
    for gradient in particles.affine:
        np.testing.assert_array_equal(gradient.numpy()[deep], 1.0)
        np.testing.assert_allclose(gradient.numpy()[near], math.exp(-0.2), rtol=1e-6)


def test_a_step_is_no_longer_than_the_filter_allows() -> None:
    simulation = drop(16)
    assert simulation.tension is not None
    longest = simulation.tension.longest_step()
    assert longest == simulation.tension._step_of(MOST_PASSES)
    assert simulation.stable_dt() == longest > 6.0 * capillary_step(simulation)
    assert any("surface tension: steps of at most" in note for note in simulation.notes())


def test_without_the_table_there_is_no_surface_tension() -> None:
    simulation = drop(8, surface_tension=None)
    assert simulation.tension is None and simulation.projection.jump is None
    assert "surface_energy" not in simulation.columns()
    assert "surface_energy" in drop(8).columns()


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"surface_tension": {"coefficient": 0.0}}, "greater than 0"),
        (
            {"surface_tension": {"coefficient": 0.1, "contact_angle": 181.0}},
            "less than or equal to 180",
        ),
        ({"surface_tension": WATER, "pressure": {"surface": "voxel"}}, "ghost-fluid"),
        ({"surface_tension": WATER, "pressure": {"model": "unilateral"}}, "incompressible"),
    ],
)
def test_invalid_settings_are_refused(tables: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        scene(size=[1.0, 1.0], resolution=8, liquid=[box([0.0, 0.0], [0.5, 0.5])], **tables)


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(("angle", "dimension"), covering([20.0, 60.0, 100.0, 150.0], [2, 3]))
def test_separating_walls_do_not_accelerate_a_splash(dimension: int, angle: float) -> None:
    """Speed of a splash at separating walls.

    Beside a separating wall the liquid bears the pull of the surface, however near to its center
    the surface lies.
    """
    low, high = [0.1, 0.2, 0.3][:dimension], [0.5, 0.4, 0.5][:dimension]
    drop = [
        box(
            [0.6, 0.3, 0.1][:dimension],
            [0.8, 0.45, 0.3][:dimension],
            velocity=[-1.0, 0.5, 0.7][:dimension],
        )
    ]
    ball = [{"shape": "sphere", "center": [0.5, 0.15, 0.25][:dimension], "radius": 0.12}]
    tables = {
        "surface_tension": {"coefficient": 5.0, "contact_angle": angle},
        "solid": ball,
        "liquid": [box(low, high), *drop],
    }
    fastest = {}
    for wall in ("separating", "free-slip"):
        simulation = create(
            scene(
                size=[1.0, 0.5, 0.5][:dimension],
                resolution={2: 40, 3: 24}[dimension],
                wall=wall,
                **tables,
            )
        )
        fastest[wall] = max(row["max_speed"] for row in advance(simulation, 0.15, 0.01))
    assert fastest["separating"] < 1.2 * fastest["free-slip"]


@pytest.mark.parametrize(("angle", "hangs"), [(50.0, True), (130.0, False)])
def test_a_wetting_drop_hangs_from_a_separating_ceiling(angle: float, hangs: bool) -> None:
    """Drop at a separating ceiling, with and without wetting.

    Over 7.8 mm of free fall: the air holds up what wets the ceiling, and nothing holds up what does
    not.
    """
    drop = {"shape": "sphere", "center": [0.01, 0.01], "radius": 0.004}
    tension = {"coefficient": 0.072, "contact_angle": angle}
    simulation = create(
        scene(
            size=[0.02, 0.01],
            resolution=40,
            liquid=[drop],
            surface_tension=tension,
            wall="separating",
        )
    )
    before = simulation.particles.position.numpy()[:, 1].mean()
    advance(simulation, 0.04, 1e-3)
    fallen = before - simulation.particles.position.numpy()[:, 1].mean()
    assert fallen < 0.001 if hangs else fallen > 0.005


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("width", "angle"), [(0.004, 30.0), (0.004, 70.0), (0.008, 20.0), (0.008, 60.0)]
)
def test_a_meniscus_rises_along_separating_walls(width: float, angle: float) -> None:
    """Rise of a meniscus along separating walls.

    Its pressure is below that of the air, also some cells below the surface, and no air gets there.
    """
    tension, liquid = (
        {"coefficient": 0.072, "contact_angle": angle},
        [box([0.0, 0.0], [width, 0.006])],
    )
    fastest = {}
    for wall in ("separating", "free-slip"):
        simulation = create(
            scene(
                size=[width, 0.012],
                resolution=36,
                liquid=liquid,
                surface_tension=tension,
                wall=wall,
            )
        )
        fastest[wall] = max(row["max_speed"] for row in advance(simulation, 0.04, 1e-3))
    assert fastest["separating"] < 1.1 * fastest["free-slip"]


@pytest.mark.slow
@pytest.mark.parametrize("angle", [60.0, 30.0])
def test_liquid_rises_between_plates(angle: float) -> None:
    """Rise of liquid between plates.

    The rise is 2 sigma cos(angle) / (rho g width) over its pressure's level, for widths of 12 and
    30 cells, as the mean over the width.
    """
    plate, bath = box([0.004, 0.002], [0.006, 0.02]), [box([0.0, 0.0], [0.016, 0.006])]
    tables = {
        "solid": [plate],
        "viscosity": {"value": 0.05, "slip_length": math.inf},
        "particles": {"transfer": "pic"},
    }
    tension = {"coefficient": SIGMA, "contact_angle": angle}
    simulation = create(
        scene(size=[0.016, 0.014], resolution=48, liquid=bath, surface_tension=tension, **tables)
    )
    rises = []
    while simulation.time < 0.5:
        simulation.step(min(simulation.stable_dt(), 0.02))
        x, y = simulation.particles.position.numpy()[:, :2].T
        area = simulation.particle_mass / RHO
        levels = [
            float(((x > low) & (x < high) & (y > 0.002)).sum()) * area / (high - low)
            for low, high in ((0.0, 0.004), (0.006, 0.016))
        ]
        rises += [levels[0] - levels[1]] if simulation.time > 0.3 else []
    expected = (
        2.0 * SIGMA * math.cos(math.radians(angle)) / (RHO * 9.81) * (1.0 / 0.004 - 1.0 / 0.01)
    )
    assert np.mean(rises) == pytest.approx(expected, rel=0.03)


def test_a_full_box_has_no_surface() -> None:
    simulation = create(
        scene(
            size=[1.0, 1.0],
            resolution=8,
            liquid=[box([0.0, 0.0], [1.0, 1.0])],
            surface_tension=WATER,
        )
    )
    assert simulation.tension is None
    assert simulation.step(1e-3)["max_speed"] < 1e-5


def test_surface_tension_works_with_a_moving_solid_and_short_steps() -> None:
    motion = {"kind": "translation", "velocity": [0.1, 0.0]}
    solid = [{"shape": "sphere", "center": [0.02, 0.01], "radius": 0.004, "motion": motion}]
    liquid = [box([0.0, 0.0], [0.04, 0.01])]
    simulation = create(
        scene(
            size=[0.04, 0.02],
            resolution=32,
            liquid=liquid,
            solid=solid,
            surface_tension=WATER,
            cfl=0.4,
        )
    )
    rows = advance(simulation, 0.01)
    assert simulation.projection.jump is not None and isinstance(
        simulation.projection.jump, wp.array
    )
    assert max(row["max_speed"] for row in rows) < 0.4
