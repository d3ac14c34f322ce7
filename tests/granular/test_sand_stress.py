"""Velocity, strain rates, projection and residual of sand's stresses.

They are compared with NumPy and SciPy, cell by cell from the equations.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import scipy.optimize
import warp as wp

from warp_lcp.granular.packing import Packing
from warp_lcp.granular.stress import Stress, YieldSet
from warp_lcp.granular.wall_friction import SandWalls
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.operators.grid_poisson import SOLID

DT, GRAVITY = 0.01, np.array([0.0, -9.81, 0.0])
AXES = {2: ((0, 1),), 3: ((0, 1), (0, 2), (1, 2))}  # pairs of axes of the shears xy, xz, yz
# Bits of a copy's place: q & 1 along the first axis, q >> 1 along the second.
OPENING = np.array([0, 1, 3])
FRICTIONS = [0.3, 1e6]  # of the domain and of the solid, which is rougher than sand
# Radius of a yield set as a function of the multiplier of the projection onto it.
Growth = Callable[[float], float]


def step_along(axis: int) -> np.ndarray:
    """Return the unit step (k, j, i) along an axis."""
    return np.eye(3, dtype=int)[2 - axis]


@dataclass
class RandomSand:
    """Random sand in a small domain with a solid: an admissible stress, and its parts."""

    stress: Stress
    packing: Packing
    bound: YieldSet
    index: np.ndarray

    @property
    def dimension(self) -> int:
        return self.packing.grid.dimension

    @property
    def now(self) -> np.ndarray:
        return self.stress.now.numpy().astype(float)

    def field(self, name: str) -> list[np.ndarray]:
        return [f.numpy().astype(float) for f in getattr(self.packing, name)]


def make(
    dimension: int,
    seed: int,
    *,
    cohesion: float = 0.0,
    tension: float = 0.0,
    box: bool = False,
    gain: float = 0.0,
    halfway: float = 0.0,
) -> RandomSand:
    """Return a case with empty, loose and dense cells.

    Some touch walls and a solid of two cells.
    """
    random = np.random.default_rng(seed)
    grid = StaggeredGrid((6, 5, 4 if dimension == 3 else 1), 0.1, dimension)
    index = np.zeros(grid.shape, dtype=np.int32)
    index[1:-1, 1:-1, 1:-1] = -1
    index[1:3, 2, 3] = index[1:3, 1, 3] = 1
    if dimension == 2:
        index[2] = 0
    base = wp.array(
        np.where(index >= 0, SOLID, 0).astype(np.int8), dtype=wp.int8, device=grid.device
    )
    one = wp.full(grid.shape, 1.0, dtype=wp.float32, device=grid.device)
    packing = Packing(grid, base, one)
    density = np.where(
        random.random(grid.shape) < 0.75,
        random.uniform(0.55, 1.1, grid.shape),
        random.uniform(0.0, 0.3, grid.shape),
    )
    u = [
        wp.array(
            random.normal(size=grid.shape).astype(np.float32), dtype=wp.float32, device=grid.device
        )
        for _ in range(dimension)
    ]
    packing.update(
        wp.array(density.astype(np.float32), dtype=wp.float32, device=grid.device), u, DT
    )
    stress = Stress(packing, SandWalls(grid, index, FRICTIONS), box=box, rate=gain > 0.0)
    start = random.normal(scale=0.4, size=stress.now.shape)
    start[0] = np.maximum(random.normal(0.4, 0.5, size=grid.shape), 0.0)
    start[:, index == 0] = 0.0  # the domain's ring is never written
    stress.now.assign(start.astype(np.float32))
    stress.kick_dt = DT
    bound = YieldSet(0.5, cohesion, tension, gain, halfway)
    stress.begin(bound, GRAVITY, DT, DT)
    return RandomSand(stress, packing, bound, index)


def at(cell: tuple[int, ...], *steps: np.ndarray) -> tuple[int, ...]:
    return tuple(np.add(cell, np.sum(steps, axis=0, dtype=int)) if steps else cell)


def interior(case: RandomSand) -> list[tuple[int, ...]]:
    nx, ny, nz = case.packing.grid.counts
    return list(itertools.product(range(1, nz + 1), range(1, ny + 1), range(1, nx + 1)))


def first_copy(dimension: int, shear: int) -> int:
    return (4 if dimension == 3 else 2) + 4 * shear


def edge_of(cell: tuple[int, ...], shear: int, copy: int) -> tuple[int, ...]:
    """Return the edge of copy 0 to 3 of a cell's shear.

    It is stored at the cell whose low side it is.
    """
    alpha, beta = AXES[3][shear]
    return at(cell, (copy & 1) * step_along(alpha), (copy >> 1) * step_along(beta))


def edge_stress(case: RandomSand, shear: int) -> np.ndarray:
    """Return the weighted sum of the copies on each edge."""
    out, now, share = np.zeros(case.index.shape), case.now, np.abs(case.field("share")[shear])
    for cell in interior(case):
        for copy in range(4):
            edge = edge_of(cell, shear, copy)
            out[edge] += share[edge] * now[(first_copy(case.dimension, shear) + copy, *cell)]
    return out


def total_stress(case: RandomSand, axis: int) -> np.ndarray:
    """Return sigma_aa = -x + s_aa of the cells."""
    now = case.now
    if case.dimension == 3:
        return np.asarray(now[1 + axis] - now[0])
    return np.asarray((now[1] if axis == 0 else -now[1]) - now[0])


def velocity(case: RandomSand) -> list[np.ndarray]:
    """Return u = u* + div(sigma) / m by face.

    sigma_aa acts across the face, and the shears on the edges around it.
    """
    out = []
    shears = [edge_stress(case, d) for d in range(len(AXES[case.dimension]))]
    for axis in range(case.dimension):
        start, inverse, normal = (
            case.field("start")[axis],
            case.field("inverse")[axis],
            total_stress(case, axis),
        )
        u = start.copy()
        for face in zip(*np.nonzero(inverse), strict=True):
            force = normal[face] - normal[at(face, -step_along(axis))]
            for number, (alpha, beta) in enumerate(AXES[case.dimension]):
                if axis in (alpha, beta):
                    other = beta if axis == alpha else alpha
                    force += shears[number][at(face, step_along(other))] - shears[number][face]
            u[face] += inverse[face] * force
        out.append(u)
    return out


def shear_rate(u: list[np.ndarray], shear: int, edge: tuple[int, ...]) -> float:
    """Return (du_a/dx_b + du_b/dx_a) dx on an edge."""
    alpha, beta = AXES[3][shear]
    return float(
        u[alpha][edge]
        - u[alpha][at(edge, -step_along(beta))]
        + u[beta][edge]
        - u[beta][at(edge, -step_along(alpha))]
    )


def nearest(
    point: np.ndarray,
    groups: list[np.ndarray],
    free: np.ndarray,
    metric: np.ndarray,
    radius: float,
    grown: Growth | None = None,
) -> np.ndarray:
    """Return the nearest point of the yield set in a metric.

    The set is { sum of free n^2 + sum over groups of max |z|^2 <= radius^2 }. With a multiplier mu
    of the set's bound, each group is cut to the size m that minimizes sum metric (|z| - m)_+^2 + mu
    m^2, and free entries shrink. SciPy's root finder gives each m, and mu.

    Args:
        point: the point to project.
        groups: groups of entries of which the largest magnitude counts.
        free: weights of the squares of the free entries; 0 for those in groups.
        metric: weights of the squared distance; equal to `free` on the free entries.
        radius: radius of the set.
        grown: radius as a function of the multiplier, in place of `radius`.
    """
    if radius < 1e-12:
        return np.zeros_like(point)

    def cut(group: np.ndarray, mu: float) -> float:
        sizes, weights = np.abs(point[group]), metric[group]
        if not sizes.any():
            return 0.0
        return float(
            scipy.optimize.brentq(
                lambda m: mu * m - weights @ np.maximum(sizes - m, 0.0),
                0.0,
                sizes.max(),
                xtol=1e-14,
            )
        )

    def shrunk(mu: float) -> np.ndarray:
        out = point / (1.0 + mu)
        for group in groups:
            most = cut(group, mu)
            out[group] = np.clip(point[group], -most, most)
        return out

    def excess(mu: float) -> float:
        new, bound = shrunk(mu), grown(mu) if grown else radius
        return float(
            free @ new**2
            + sum(np.abs(new[group]).max(initial=0.0) ** 2 for group in groups)
            - bound**2
        )

    if excess(0.0) <= 0.0:
        return point
    high = 1.0
    while excess(high) > 0.0:
        high *= 4.0
    return shrunk(float(scipy.optimize.brentq(excess, 0.0, high, xtol=1e-14)))


def growth(radius: float, gain: float, half: float, soft: float) -> Growth:
    """Return the rate-dependent radius r = radius + gain e / (e + half).

    By the multiplier mu: a step `soft` that subtracts mu r leaves the rate e = mu r / soft.
    """

    def grown(mu: float) -> float:
        if mu == 0.0 or gain == 0.0:
            return radius
        return float(
            scipy.optimize.brentq(
                lambda r: r - radius - gain / (1.0 + half * soft / (mu * r)),
                radius,
                radius + gain,
                xtol=1e-14,
            )
        )

    return grown


def cell_move(
    case: RandomSand, u: list[np.ndarray], cell: tuple[int, ...], *, box: bool = False
) -> tuple[float, float]:
    """Return the squared natural residual of pressure and friction of a cell."""
    dimension, now, p = case.dimension, case.now, case.packing
    flags, w, diagonal = int(p.flags.numpy()[cell]), float(p.drive.numpy()[cell]), 0.0
    if flags == 0:
        return 0.0, 0.0
    mass, inverse, share = case.field("mass"), case.field("inverse"), case.field("share")
    stretch = []
    # A full cell counts volume, a loose one mass.
    full = float(np.clip(1.0 - w * DT / p.grid.spacing / 0.05, 0.0, 1.0))
    for axis in range(dimension):
        low, high = cell, at(cell, step_along(axis))
        beyond, here = (mass[axis][face] + full * (1.0 - mass[axis][face]) for face in (high, low))
        w += beyond * u[axis][high] - here * u[axis][low]
        diagonal += beyond * inverse[axis][high] + here * inverse[axis][low]
        stretch.append(u[axis][high] - u[axis][low])
    dense, firm, stiff = bool(flags & 2), bool(flags & 4), float(p.stiff.numpy()[cell])
    x = (
        max(now[(0, *cell)] - w / diagonal, -case.bound.tension if firm else 0.0)
        if diagonal > 0.0
        else 0.0
    )
    radius = (
        max(case.bound.k * x + (case.bound.cohesion if dense else 0.0), 0.0)
        if dense and stiff > 0.0
        else 0.0
    )
    # The deviator and the copies, moved against the gradient over `stiff` in the metric |n|^2 / 2 +
    # sum b^2 / 4 (2-D: n = (a, -a)).
    normals = [now[(1, *cell)]] if dimension == 2 else [now[(1 + axis, *cell)] for axis in range(3)]
    soft = 1.0 / stiff if stiff > 0.0 else 0.0
    if dimension == 2:
        moved = [normals[0] + soft * (stretch[0] - stretch[1])]
    else:
        moved = [
            n + 2.0 * soft * (e - np.mean(stretch)) for n, e in zip(normals, stretch, strict=True)
        ]
    old, groups = list(normals), []
    for shear in range(len(AXES[dimension])):
        group = []
        for copy in range(4):
            edge = edge_of(cell, shear, copy)
            if share[shear][edge] > 0.0:
                group.append(len(moved))
                old.append(now[(first_copy(dimension, shear) + copy, *cell)])
                moved.append(old[-1] + 4.0 * soft * share[shear][edge] * shear_rate(u, shear, edge))
        groups.append(np.array(group, dtype=int))
    point, count = np.array(moved), len(normals)
    free, metric = np.zeros(len(point)), np.full(len(point), 0.25)
    free[:count] = metric[:count] = 1.0 if dimension == 2 else 0.5
    if box:
        new = np.clip(point, -radius, radius)
        size = np.sqrt(free @ point**2)
        new[:count] = point[:count] * min(1.0, radius / size) if size > 0.0 else 0.0
    else:
        grown = (
            growth(
                radius,
                case.bound.gain * max(x, 0.0),
                case.bound.halfway * np.sqrt(max(x, 0.0)),
                soft,
            )
            if case.bound.gain
            else None
        )
        new = nearest(point, groups, free, metric, radius, grown)
    return (x - now[(0, *cell)]) ** 2, float(metric @ (new - np.array(old)) ** 2)


def wall_move(
    case: RandomSand,
    u: list[np.ndarray],
    cell: tuple[int, ...],
    axis: int,
    side: int,
    friction: float,
) -> float:
    """Return the squared natural residual of friction on a face of a solid.

    The friction is Coulomb's, or limited by the sand's own strength.
    """
    dimension, now, p = case.dimension, case.now, case.packing
    if p.flags.numpy()[cell] == 0:
        return 0.0
    x = now[(0, *cell)]
    toward = (1.0 if side else -1.0) * DT * GRAVITY[axis]
    half = 0.5 * toward * float(p.fraction.numpy()[cell])
    load = -total_stress(case, axis)[cell] + half + max(half - max(x, 0.0), 0.0)
    inverse, share = case.field("inverse"), case.field("share")
    point, old, groups, pulls, stiffest = [], [], [], [], 0.0
    for shear, (alpha, beta) in enumerate(AXES[dimension]):
        if axis not in (alpha, beta):
            continue
        group = []
        for copy in range(4):
            if (copy & 1 if axis == alpha else copy >> 1) != side:
                continue
            edge = edge_of(cell, shear, copy)
            weight = -share[shear][edge]
            if weight <= 0.0:
                continue
            around = [inverse[alpha][edge], inverse[alpha][at(edge, -step_along(beta))]]
            around += [inverse[beta][edge], inverse[beta][at(edge, -step_along(alpha))]]
            stiffest = max(stiffest, 2.0 * weight * sum(around))
            group.append(len(old))
            old.append(now[(first_copy(dimension, shear) + copy, *cell)])
            pulls.append(weight * shear_rate(u, shear, edge))
        groups.append(np.array(group, dtype=int))
    if stiffest == 0.0:
        return 0.0
    point = np.array(old) + 2.0 / stiffest * np.array(pulls)
    metric = np.full(len(point), 0.5)
    most, bound = max(load, 0.0), case.bound
    new = nearest(
        point,
        groups,
        np.zeros(len(point)),
        metric,
        min(friction * most, (bound.k + bound.gain) * most + bound.cohesion),
    )
    return float(metric @ (new - np.array(old)) ** 2)


CASES = [(2, 41), (2, 42), (3, 43)]


@pytest.mark.parametrize(("dimension", "seed"), CASES)
def test_the_velocity_is_the_divergence_of_the_stress(dimension: int, seed: int) -> None:
    """Velocity as the divergence of the stress.

    A wrong sign of a pressure, of a deviator or of one of the shears moves most faces.
    """
    case = make(dimension, seed)
    case.stress.residual()
    for axis, expected in enumerate(velocity(case)):
        moved = case.field("inverse")[axis] > 0.0
        assert moved.sum() > 8
        np.testing.assert_allclose(
            case.stress.checked.u[axis].numpy()[moved], expected[moved], rtol=1e-5, atol=1e-5
        )


@pytest.mark.parametrize(("dimension", "seed"), CASES)
def test_shear_rates_are_differences_around_edges(dimension: int, seed: int) -> None:
    case = make(dimension, seed)
    case.stress.residual()
    u = velocity(case)
    for shear, share in enumerate(case.field("share")):
        edges = list(zip(*np.nonzero(share), strict=True))
        assert len(edges) > 5
        expected = [shear_rate(u, shear, edge) for edge in edges]
        np.testing.assert_allclose(
            [case.stress.checked.edge[shear].numpy()[edge] for edge in edges],
            expected,
            rtol=1e-4,
            atol=1e-4,
        )


@pytest.mark.parametrize(("dimension", "seed"), CASES)
def test_stress_and_strain_are_adjoint(dimension: int, seed: int) -> None:
    """Adjointness of stress and strain.

    The effect of a stress on the faces' momentum is minus its power per rate of strain: the power
    of friction has one value.
    """
    case = make(dimension, seed)
    now = case.now
    case.stress.residual()
    u = [
        np.where(inverse > 0.0, field.numpy(), 0.0)
        for field, inverse in zip(case.stress.checked.u, case.field("inverse"), strict=True)
    ]
    gained = 0.0  # power of div(sigma) on the faces
    for axis, after in enumerate(velocity(case)):
        inverse = case.field("inverse")[axis]
        force = np.divide(
            after - case.field("start")[axis],
            inverse,
            out=np.zeros_like(after),
            where=inverse > 0.0,
        )
        gained += float((force * u[axis]).sum())
    work = 0.0
    for cell in interior(case):
        for axis in range(dimension):
            work += total_stress(case, axis)[cell] * (
                u[axis][at(cell, step_along(axis))] - u[axis][cell]
            )
        for shear, share in enumerate(case.field("share")):
            for copy in range(4):
                edge = edge_of(cell, shear, copy)
                work += (
                    abs(share[edge])
                    * now[(first_copy(dimension, shear) + copy, *cell)]
                    * shear_rate(u, shear, edge)
                )
    assert gained == pytest.approx(-work, rel=1e-4)


@pytest.mark.parametrize(
    ("dimension", "seed", "options"),
    [
        (2, 41, {}),
        (2, 42, {"cohesion": 0.1, "tension": 0.05}),
        (2, 44, {"box": True}),
        (3, 43, {}),
        (3, 45, {"box": True}),
        (2, 42, {"gain": 0.8, "halfway": 1.0}),
        (3, 47, {"gain": 0.8, "halfway": 4.0, "cohesion": 0.1}),
    ],
)
def test_the_residual_is_how_far_the_projection_moves_the_stress(
    dimension: int, seed: int, options: dict[str, float]
) -> None:
    """Residual as the distance by which the projection moves the stress.

    Projections by SciPy: another yield set, another metric, or copies of other cells would change
    the sum.
    """
    case = make(dimension, seed, **options)
    pressure, friction = case.stress.residual()
    u = velocity(case)
    cells = [cell for cell in interior(case) if case.packing.flags.numpy()[cell]]
    moves = np.array([cell_move(case, u, cell, box=bool(options.get("box"))) for cell in cells])
    walls = case.stress.walls
    rubs = 0.0
    for flat, where, wall in zip(
        walls.cells.numpy(), walls.sides.numpy(), walls.walls.numpy(), strict=True
    ):
        cell = tuple(int(n) for n in np.unravel_index(int(flat), case.index.shape))
        rubs += wall_move(case, u, cell, int(where) >> 1, int(where) & 1, FRICTIONS[wall])
    assert pressure == pytest.approx(np.sqrt(moves[:, 0].sum() / len(cells)), rel=1e-4)
    assert rubs > 0.0
    assert friction == pytest.approx(np.sqrt((moves[:, 1].sum() + rubs) / len(cells)), rel=1e-3)


@pytest.mark.parametrize(("dimension", "seed"), CASES)
def test_the_load_of_walls_is_continuous_in_the_pressure(dimension: int, seed: int) -> None:
    """Load of a wall as the pressure of its cell goes to 0.

    Half of the weight of all cells without pressure appeared there before.
    """
    case = make(dimension, seed)
    frictions = []
    for pressure in (0.0, 1e-7):
        stress = np.zeros(case.stress.now.shape, dtype=np.float32)
        stress[0] = pressure * (case.packing.flags.numpy() > 0)
        case.stress.now.assign(stress)
        frictions.append(case.stress.residual()[1])
    assert frictions[0] > 0.0
    assert frictions[1] == pytest.approx(frictions[0], abs=1e-5)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_stress_free_fall_has_no_residual(dimension: int) -> None:
    """Free fall without stress and without residual: loose sand bears nothing."""
    grid = StaggeredGrid((6, 6, 6 if dimension == 3 else 1), 0.1, dimension)
    base, one = grid.field(wp.int8), wp.full(grid.shape, 1.0, dtype=wp.float32, device=grid.device)
    packing = Packing(grid, base, one)
    u = [wp.full(grid.shape, -0.3, dtype=wp.float32, device=grid.device) for _ in range(dimension)]
    packing.update(wp.full(grid.shape, 0.2, dtype=wp.float32, device=grid.device), u, DT)
    stress = Stress(packing, SandWalls(grid, np.full(grid.shape, -1, dtype=np.int32), [0.0]))
    stress.begin(YieldSet(0.5), GRAVITY, DT, DT)
    assert stress.residual() == (0.0, 0.0)


@pytest.mark.parametrize("dimension", [2, 3])
def test_cells_without_sand_bear_no_pressure_whatever_flows_into_them(dimension: int) -> None:
    """Pressure and residual of a full block that is thrown up by 40 cells in a time step: 0.

    The block moves as a whole, so its cells are not compressed. 16 cells flow through half a face
    into each empty cell above it, which has room for one.
    """
    grid = StaggeredGrid((6, 6, 6 if dimension == 3 else 1), 0.1, dimension)
    base, one = grid.field(wp.int8), wp.full(grid.shape, 1.0, dtype=wp.float32, device=grid.device)
    packing = Packing(grid, base, one)
    fraction = np.where(np.arange(grid.shape[1]) < 4, 0.8, 0.0)[None, :, None]
    speed = 40.0 * grid.spacing / DT
    u = [wp.full(grid.shape, speed * (a == 1), dtype=wp.float32) for a in range(dimension)]
    sand = np.broadcast_to(fraction, grid.shape).astype(np.float32)
    packing.update(wp.array(sand, dtype=wp.float32, device=grid.device), u, DT)
    stress = Stress(packing, SandWalls(grid, np.full(grid.shape, -1, dtype=np.int32), [0.0]))
    stress.begin(YieldSet(0.5), np.zeros(3), DT, DT)
    stress.restart(pressure_step=0.5, shear_step=0.2, lookahead=0.0, momentum=0.0)
    stress.advance(1)
    assert stress.residual() == (0.0, 0.0)
    assert not stress.now.numpy()[0].any()
