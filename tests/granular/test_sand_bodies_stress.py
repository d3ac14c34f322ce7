"""Stresses of sand on rigid bodies.

Third law, signs, and the coupled solve from light to heavy bodies.
"""

from dataclasses import dataclass

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.granular.bodies import SandBodies
from warp_lcp.granular.packing import Packing
from warp_lcp.granular.stress import Stress, YieldSet
from warp_lcp.granular.stress_methods import HeavyBallProjectedGradient
from warp_lcp.granular.wall_friction import SandWalls
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.operators.grid_poisson import SOLID

DT, DX, DENSITY, FRICTION, GRAVITY = 0.005, 0.01, 1500.0, 0.5, np.array([0.0, -9.81, 0.0])
SCALE = 9.81 * DT


@dataclass
class BlocksInSand:
    """Blocks in sand, some of them bodies."""

    stress: Stress
    packing: Packing
    bodies: SandBodies | None
    centers: np.ndarray
    masses: np.ndarray

    @property
    def dimension(self) -> int:
        return self.packing.grid.dimension

    def begin(self, velocity: np.ndarray, inverse_mass: np.ndarray) -> None:
        """Start a step of the bodies in falling sand."""
        assert self.bodies is not None
        fields = [
            wp.full(self.packing.grid.shape, float(g * DT), dtype=wp.float32)
            for g in GRAVITY[: self.dimension]
        ]
        weights = [wp.full(self.packing.grid.shape, 1.0, dtype=wp.float32) for _ in fields]
        self.bodies.begin(
            self.packing,
            fields,
            weights,
            velocity=velocity,
            inverse_mass=inverse_mass,
            density=DENSITY,
            dt=DT,
        )

    def solve(self, tolerance: float = 1e-3):
        stopping = wl.StoppingCriteria(rtol=0.0, atol=tolerance * SCALE, max_iterations=2000)
        return wl.solve(self.stress, HeavyBallProjectedGradient(), stopping=stopping)


def make(
    dimension: int,
    counts: tuple[int, ...],
    blocks: list[tuple],
    *,
    ratio: float | None,
    depth: int,
    sand: tuple[int, int] | None = None,
    friction: float = FRICTION,
) -> BlocksInSand:
    """Return sand of a depth [cells] around blocks of a density ratio.

    The blocks are fixed if the ratio is None.

    Args:
        dimension: 2 or 3.
        counts: cells along x, y (and z).
        blocks: first and one past the last cell (x, y, z) of each, counted from 0.
        ratio: ratio of the blocks' density to sand's.
        depth: rows of sand.
        sand: first and one past the last column with sand; None for all.
        friction: friction of all walls.
    """
    grid = StaggeredGrid((*counts, 1)[:3], DX, dimension)
    index = np.zeros(grid.shape, dtype=np.int32)
    index[1:-1, 1:-1, 1:-1] = -1
    centers, masses, inertias = [], [], []
    for number, (low, high) in enumerate(blocks, start=1):
        index[tuple(slice(a + 1, b + 1) for a, b in zip(low[::-1], high[::-1], strict=True))] = (
            number
        )
        size = (np.array(high) - low)[:dimension] * DX
        centers.append((np.add(low, high) / 2 * DX) * (np.arange(3) < dimension))
        masses.append((ratio or 1.0) * DENSITY * float(np.prod(size)))
        squares = size**2
        inertias.append(
            masses[-1]
            / 12.0
            * (np.array([squares.sum()]) if dimension == 2 else squares.sum() - squares)
        )
    density = np.zeros(grid.shape, dtype=np.float32)
    columns = slice(1, -1) if sand is None else slice(1 + sand[0], 1 + sand[1])
    density[1:-1, 1 : 1 + depth, columns] = 1.0
    density[index >= 0] = 0.0
    base = wp.array(np.where(index >= 0, SOLID, 0).astype(np.int8), dtype=wp.int8)
    packing = Packing(grid, base, wp.full(grid.shape, 1.0, dtype=wp.float32))
    u = [wp.full(grid.shape, float(g * DT), dtype=wp.float32) for g in GRAVITY[:dimension]]
    packing.update(wp.array(density, dtype=wp.float32), u, DT, grid.faces())
    walls = SandWalls(grid, index, [friction] * (1 + len(blocks)))
    bodies = None if ratio is None else SandBodies(grid, range(1, 1 + len(blocks)))
    if bodies is not None:
        bodies.place(index, np.array(centers), walls)
        k = bodies.freedoms
        start = np.tile(
            np.concatenate([GRAVITY[:dimension] * DT, np.zeros(k - dimension)]), (len(blocks), 1)
        )
        inverse = np.array(
            [
                np.diag(1.0 / np.concatenate([[m] * dimension, i]))
                for m, i in zip(masses, inertias, strict=True)
            ]
        )
    case = BlocksInSand(
        Stress(packing, walls, bodies=bodies), packing, bodies, np.array(centers), np.array(masses)
    )
    if bodies is not None:
        case.begin(start, inverse)
    case.stress.begin(YieldSet(0.5), GRAVITY, DT, DT)
    return case


def face_centers(grid: StaggeredGrid, axis: int) -> np.ndarray:
    """Return the centers of the lower faces of an axis [m], shape (*grid.shape, 3)."""
    k, j, i = np.indices(grid.shape)
    place = np.stack([i, j, k], axis=-1) - 0.5
    place[..., axis] -= 0.5
    if grid.dimension == 2:
        place[..., 2] = 0.0
    return place * grid.spacing


def beside_bodies(case: BlocksInSand, axis: int) -> np.ndarray:
    """Return which faces of an axis belong to bodies, shape of the grid's fields."""
    assert case.bodies is not None and case.bodies.faces is not None
    found, faces = np.zeros(case.packing.grid.size, dtype=bool), case.bodies.faces
    found[faces.face.at[faces.face.axis == axis]] = True
    return found.reshape(case.packing.grid.shape)


@pytest.mark.parametrize("dimension", [2, 3])
def test_momentum_of_sand_goes_to_bodies(dimension: int) -> None:
    """Momentum that a body gets and sand loses.

    Momentum and angular momentum of sand and two bodies stay constant under any stresses that reach
    no wall.
    """
    third = (10,) * (dimension - 2)
    low, high = ((3, 3, 4), (5, 6, 6)), ((5, 5, 3), (8, 7, 6))
    flat = [
        tuple((*corner[:2], (0, 1)[end]) for end, corner in enumerate(block))
        for block in (low, high)
    ]
    case = make(
        dimension, (11, 10, *third), [low, high] if dimension == 3 else flat, ratio=0.3, depth=10
    )
    grid, random, now = case.packing.grid, np.random.default_rng(811), case.stress.now.numpy()
    inner = tuple(slice(3, -3) if n > 3 else slice(None) for n in grid.shape)
    values = np.zeros_like(now)
    values[(slice(None), *inner)] = random.normal(scale=0.3, size=now[(slice(None), *inner)].shape)
    values[:, case.packing.base.numpy() == SOLID] = 0.0
    case.stress.now.assign(values)
    case.stress.residual()
    assert case.bodies is not None
    # As momenta of the grid, in units of a full face's mass.
    impulses = case.bodies.impulses() / (DENSITY * grid.cell_volume)
    assert (np.abs(impulses) > 1e-4).all()  # [m/s, m^2/s]: both bodies are pushed and turned
    push, turn = np.zeros(3), np.zeros(3)
    for axis, u in enumerate(case.stress.checked.u):
        free, mass = case.packing.inverse[axis].numpy() > 0.0, case.packing.mass[axis].numpy()
        # Half a cell before a body moves with it.
        gained = (u.numpy() - GRAVITY[axis] * DT) * np.where(free, mass, 0.5 * mass)
        gained[~(free | beside_bodies(case, axis))] = 0.0
        push[axis] = gained.sum()
        turn += (np.cross(face_centers(grid, axis), np.eye(3)[axis]) * gained[..., None]).sum(
            axis=(0, 1, 2)
        )
    for number, center in enumerate(case.centers):
        force, torque = np.zeros(3), np.zeros(3)
        force[:dimension] = impulses[number, :dimension]
        torque[(3 - (1 if dimension == 2 else 3)) :] = impulses[number, dimension:]
        push, turn = push + force, turn + torque + np.cross(center, force)
    # Sums of float32 masses.
    assert np.abs(push).max() < 2e-7 * np.abs(impulses).max() * grid.size**0.5
    assert np.abs(turn).max() < 2e-7 * np.abs(impulses).max() * grid.size**0.5


@pytest.mark.parametrize("dimension", [2, 3])
def test_pressure_pushes_away_and_off_center_pressure_turns(dimension: int) -> None:
    """Direction of the pressure's force and torque.

    A pressure below a block pushes it up; one to the right of its center turns it to the left.
    """
    third = (9,) * (dimension - 2)
    case = make(
        dimension,
        (11, 9, *third),
        [((3, 4, 3 * (dimension - 2)), (8, 6, 1 if dimension == 2 else 6))],
        ratio=1.0,
        depth=9,
    )
    now = np.zeros_like(case.stress.now.numpy())
    # The cell below the block's right end, one plane of three.
    now[0, 1 if dimension == 2 else 5, 4, 8] = 0.2
    case.stress.now.assign(now)
    case.stress.residual()
    assert case.bodies is not None
    # Half a cell of sand before each face of the block moves with it.
    size = np.array([5.0, 2.0, 3.0])[:dimension]
    mass = np.prod(size) + np.prod(size) / size[1]
    velocity = case.bodies.velocity.numpy()[0]
    assert velocity[1] == pytest.approx(-SCALE + 0.2 / mass, rel=1e-6)
    assert velocity[0] == pytest.approx(0.0, abs=1e-12) and velocity[-1] > 0.0
    np.testing.assert_allclose(velocity[2:-1], 0.0, atol=1e-12)
    gained = case.bodies.impulses()[0, 1] / case.masses[0]
    assert gained == pytest.approx(0.2 / mass, rel=1e-5)


def test_sand_that_slides_over_a_plate_takes_it_along() -> None:
    """Friction on a plate below sliding sand.

    A smooth floor holds the plate up. It accelerates in the direction of the sand, within Coulomb's
    bound.
    """
    case = make(2, (32, 8), [((3, 0, 0), (29, 2, 1))], ratio=1.0, depth=5, sand=(6, 26))
    speed, start = 3.0 * SCALE, case.packing.start[0].numpy().copy()
    start[case.packing.inverse[0].numpy() > 0.0] = speed
    case.packing.start[0].assign(start)
    assert case.bodies is not None
    held = np.diag([1.0 / case.masses[0], 0.0, 0.0])[None]
    case.begin(np.zeros((1, 3)), held)
    case.solve(1e-4)
    vx, vy, spin = case.bodies.velocity.numpy()[0]
    push, load, turn = case.bodies.impulses()[0] / (DENSITY * DX**2)
    assert vx > 0.05 * SCALE and vy == spin == 0.0
    # Weight of the sand on the plate, in units of a cell's.
    assert -load == pytest.approx(20 * 3 * SCALE, rel=0.1)
    assert FRICTION * -load * 0.95 < push < FRICTION * -load * 21 / 20  # 20 faces have 21 edges
    assert turn < 0.0


@pytest.mark.parametrize("ratio", [1e-3, 0.05, 1.0])
def test_number_of_iterations_does_not_depend_on_lightness(ratio: int) -> None:
    """Iterations for light bodies: nearly those of a fixed block.

    The block is half in the sand and comes to rest.
    """
    blocks = [((11, 6, 0), (17, 12, 1))]
    still = make(2, (28, 20), blocks, ratio=None, depth=9).solve()
    case = make(2, (28, 20), blocks, ratio=ratio, depth=9)
    solved = case.solve()
    assert bool(solved.residual <= 1e-3 * SCALE)
    assert solved.iterations <= 1.5 * still.iterations
    assert case.bodies is not None
    velocity = case.bodies.velocity.numpy()[0]
    assert np.abs(velocity[:2]).max() < 0.08 * SCALE and abs(velocity[2]) * 3 * DX < 0.02 * SCALE
    weight = case.masses[0] * SCALE
    assert case.bodies.impulses()[0, 1] == pytest.approx(weight, rel=0.08)


def test_velocity_is_what_the_impulse_leaves_and_sand_sees_it() -> None:
    """Velocity after a solve: V = V* + M^-1 impulse.

    The faces beside the body have it.
    """
    case = make(2, (28, 20), [((11, 6, 0), (17, 12, 1))], ratio=40.0, depth=9)
    case.solve()
    assert case.bodies is not None
    velocity = case.bodies.velocity.numpy()[0]
    impulse = case.bodies.impulses()[0]
    assert velocity[1] == pytest.approx(-SCALE + impulse[1] / case.masses[0], rel=1e-12)
    assert -SCALE < velocity[1] < -0.2 * SCALE  # it sinks, but slower than in free fall
    below = case.stress.checked.u[1].numpy()[1, 7, 12:18]
    np.testing.assert_allclose(
        below, velocity[1] + velocity[2] * (np.arange(-2.5, 3.0) * DX), rtol=1e-6
    )


def test_two_light_bodies_in_touch_through_sand() -> None:
    """Two light bodies that interact through sand.

    Light blocks one cell of sand apart, and under a heavier one: trial steps that ignored either
    would diverge.
    """
    case = make(
        2,
        (30, 22),
        [((9, 4, 0), (14, 9, 1)), ((15, 4, 0), (20, 9, 1)), ((10, 10, 0), (19, 14, 1))],
        ratio=5e-3,
        depth=12,
    )
    solved = case.solve()
    assert solved.residual <= 1e-3 * SCALE
    assert case.bodies is not None
    assert np.abs(case.bodies.velocity.numpy()[:, :2]).max() < 0.3 * SCALE


def test_bodies_far_from_sand_and_outside_change_nothing() -> None:
    """Bodies far from sand, and outside of the grid.

    A body in the air falls; one outside of the grid has no effect.
    """
    case = make(2, (28, 24), [((11, 17, 0), (17, 21, 1))], ratio=0.1, depth=9)
    case.solve()
    assert case.bodies is not None
    np.testing.assert_allclose(case.bodies.velocity.numpy()[0], [0.0, -SCALE, 0.0], atol=1e-12)
    index = np.where(case.packing.base.numpy() == SOLID, 0, -1)
    case.bodies = case.stress.bodies = gone = SandBodies(case.packing.grid, [1])
    gone.place(index, np.zeros((1, 3)), case.stress.walls)
    assert gone.faces is not None and len(gone.faces.face.at) == 0
    case.begin(np.array([[0.1, 0.2, 0.3]]), np.eye(3)[None])
    case.stress.set_walls(case.stress.walls)
    case.solve()
    assert gone.velocity.numpy()[0].tolist() == [0.1, 0.2, 0.3]
    assert not gone.impulses().any()


def test_without_friction_it_is_the_linear_complementarity_problem_with_the_bodies_matrix() -> None:
    """Linear complementarity problem without friction, with the bodies' matrix.

    Pressure and velocity are those of y = b + (A + R W R') x, built here face by face and solved by
    Lemke's method.
    """
    case = make(2, (7, 6), [((2, 1, 0), (5, 3, 1))], ratio=2.5, depth=4, friction=0.0)
    packing, bodies = case.packing, case.bodies
    assert bodies is not None
    flags, base = packing.flags.numpy(), packing.base.numpy()
    cells = [tuple(c) for c in np.argwhere(flags > 0)]
    assert (packing.drive.numpy()[flags > 0] == 0.0).all()  # full cells: volumes count
    number = {c: n for n, c in enumerate(cells)}
    mass, inverse, start = (
        [f.numpy().astype(float) for f in fields]
        for fields in (packing.mass, packing.inverse, packing.start)
    )
    n, center = len(cells), case.centers[0]
    size = np.array([3.0, 2.0]) * DX
    body = np.diag([case.masses[0], case.masses[0], case.masses[0] / 12.0 * (size**2).sum()]) / (
        DENSITY * DX**2
    )
    momentum = body @ [0.0, -SCALE, 0.0]
    # Of the pressure's velocity, of the initial one, of the body's.
    div, b, rows = np.zeros((n, n)), np.zeros(n), np.zeros((n, 3))
    for c in cells:
        for axis in range(2):
            for side in range(2):
                face = np.array(c)
                face[2 - axis] += side
                other = np.array(c)
                other[2 - axis] += 2 * side - 1
                face, other, out = tuple(face), tuple(other), 2 * side - 1
                if base[other] == SOLID:
                    place = face_centers(packing.grid, axis)[face] - center
                    unit = (
                        np.array([1.0, 0.0, -place[1]])
                        if axis == 0
                        else np.array([0.0, 1.0, place[0]])
                    )
                    if 1 <= other[2] <= 7 and 1 <= other[1] <= 6:  # not the domain's wall
                        rows[number[c]] += out * unit
                        body += 0.5 * mass[axis][face] * np.outer(unit, unit)
                        momentum += 0.5 * mass[axis][face] * unit * (GRAVITY[axis] * DT)
                    continue
                b[number[c]] += out * start[axis][face]
                div[number[c], number[c]] += inverse[axis][face]
                if other in number:
                    div[number[c], number[other]] -= inverse[axis][face]
    inverse_body = np.linalg.inv(body)
    matrix = div + rows @ inverse_body @ rows.T
    b += rows @ inverse_body @ momentum
    lcp = wl.LCP(wl.DenseOperator(matrix, device="cpu", dtype=wp.float64), b)
    x = wl.solve(lcp, wl.Lemke(), stopping=wl.StoppingCriteria(rtol=1e-10)).x.numpy()
    case.stress.begin(YieldSet(0.0), GRAVITY, DT, DT)
    assert case.solve(1e-6).residual <= 1e-6 * SCALE
    np.testing.assert_allclose(
        case.stress.now.numpy()[0][tuple(np.array(cells).T)], x, atol=2e-4 * SCALE
    )
    np.testing.assert_allclose(
        bodies.velocity.numpy()[0], inverse_body @ (momentum + rows.T @ x), atol=2e-4 * SCALE
    )
    assert x.max() > 3.0 * SCALE


def test_a_step_is_implicit_in_the_bodies_velocity(monkeypatch: pytest.MonkeyPatch) -> None:
    """Implicit velocity of the bodies in a step.

    With enough trial steps, the stresses of a step give the bodies the velocity that the step
    assumed.
    """
    left = []
    for rounds in (1, 60):
        monkeypatch.setattr("warp_lcp.granular.bodies.ROUNDS", rounds)
        case = make(2, (28, 20), [((11, 6, 0), (17, 12, 1))], ratio=0.02, depth=9)
        assert case.bodies is not None
        case.stress.residual()
        case.stress.restart(
            pressure_step=1 / 1.2, shear_step=1 / 2.5, lookahead=0.15, momentum=0.85
        )
        case.stress.advance(8)
        taken = case.bodies.velocity.numpy().copy()
        case.bodies.respond(case.packing, case.stress.now, wp.launch, implicit=False)
        left.append(float(np.abs(case.bodies.velocity.numpy() - taken)[0, :2].max()))
    assert left[1] < 1e-5 * SCALE < left[0]
