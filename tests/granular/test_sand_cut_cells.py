"""Solids that cut cells, for the stresses of sand.

Forces, friction of their surfaces, and sand that slides and rests on them.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.validation import inclined
from warp_lcp.granular.cut_walls import CutWalls
from warp_lcp.granular.packing import SHEARS, Packing
from warp_lcp.granular.scene import SandScene
from warp_lcp.granular.simulator import GranularSimulator, SandSimulation
from warp_lcp.granular.stress import Stress, YieldSet
from warp_lcp.granular.stress_methods import HeavyBallProjectedGradient
from warp_lcp.granular.wall_friction import SandSolids, SandWalls
from warp_lcp.grid.cut_cells import CutCells
from warp_lcp.grid.signed_distance import Plane
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.voxelize import PlacedSolid
from warp_lcp.material.particle_assembly import GridComponents
from warp_lcp.operators.grid_poisson import SOLID

DT, DX, G = 0.01, 0.1, 9.81
TILTS = {
    2: [(-0.37, 1.0, 0.0), (1.0, 1.0, 0.0), (0.8, -0.55, 0.0)],
    3: [(-0.37, 1.0, 0.21), (0.6, 0.7, -0.9)],
}
CASES = [(dimension, number) for dimension, tilts in TILTS.items() for number in range(len(tilts))]


class SandBesidePlane:
    """Grid full of sand on one side of a plane, gravity toward the plane."""

    def __init__(
        self,
        dimension: int,
        tilt: tuple[float, ...],
        *,
        mu: float = 0.4,
        k: float = 0.5,
        cells: int = 7,
        seed: int = 1,
    ) -> None:
        self.dimension, self.random = dimension, np.random.default_rng(seed)
        counts = (cells, cells - 1, cells - 2 if dimension == 3 else 1)
        self.grid = grid = StaggeredGrid(counts, DX, dimension)
        self.normal = np.array(tilt) / np.linalg.norm(tilt)
        point = DX * np.array(
            [0.52 * counts[0], 0.43 * counts[1], 0.47 * counts[2] if dimension == 3 else 0.0]
        )
        half = Plane(point=point[:dimension].tolist(), normal=self.normal[:dimension].tolist())
        cut = CutCells(
            grid, [PlacedSolid(geometry=half, separating=True, name="plane")], wall_separating=True
        )
        self.walls = CutWalls(grid, cut, [0.0, mu])
        self.point, self.k, self.mu = point, k, mu
        self.packing = Packing(
            grid,
            cut.base,
            wp.full(grid.shape, 1.0, dtype=wp.float32, device=grid.device),
            cut=self.walls,
        )
        ring = np.zeros(grid.shape, dtype=np.int32)
        ring[1:-1, 1:-1, 1:-1] = -1
        self.stress = Stress(self.packing, SandWalls(grid, ring, [0.0, mu], rubbing_only=True))
        self.openings = self.walls.openings.numpy().astype(float)

    def begin(
        self,
        velocity: list[np.ndarray],
        gravity: np.ndarray,
        *,
        cohesion: float = 0.0,
        filled: np.ndarray | None = None,
    ) -> None:
        density = np.ones(self.grid.shape) if filled is None else filled
        one = wp.array(density.astype(np.float32), dtype=wp.float32, device=self.grid.device)
        fields = [
            wp.array(np.broadcast_to(u, self.grid.shape).astype(np.float32), dtype=wp.float32)
            for u in velocity
        ]
        self.packing.update(one, fields, DT)
        self.stress.begin(YieldSet(self.k, cohesion), gravity, DT, DT)
        self.stress.kick_dt = DT

    def solve(self, tolerance: float = 1e-4) -> None:
        stopping = wl.StoppingCriteria(rtol=0.0, atol=tolerance * G * DT, max_iterations=4000)
        wl.solve(self.stress, HeavyBallProjectedGradient(), stopping=stopping)


def along(values: np.ndarray, axis: int, by: int) -> np.ndarray:
    """Return the values of the cell `by` cells further along an axis."""
    return np.roll(values, -by, axis=2 - axis)


def test_openings_are_those_of_the_plane() -> None:
    """Open fractions of a plane.

    Volumes and walls against a count of points of the true half space.
    """
    case = SandBesidePlane(2, TILTS[2][0])
    volume, points = case.walls.volume.numpy()[1], (np.arange(200) + 0.5) / 200
    for j in range(1, case.grid.counts[1] + 1):
        for i in range(1, case.grid.counts[0] + 1):
            x, y = np.meshgrid(DX * (i - 1 + points), DX * (j - 1 + points))
            inside = (x - case.point[0]) * case.normal[0] + (y - case.point[1]) * case.normal[
                1
            ] > 0.0
            assert volume[j, i] == pytest.approx(inside.mean(), abs=5e-3)
    assert case.walls.normal == pytest.approx(
        np.tile(-case.normal, (case.walls.count, 1)), abs=2e-3
    )
    columns = case.walls.area * case.normal[1]  # horizontal area of the walls
    assert columns.sum() == pytest.approx(case.grid.counts[0], abs=0.01)


@pytest.mark.parametrize(("dimension", "number"), CASES)
def test_forces_are_the_adjoint_of_what_they_work_on(dimension: int, number: int) -> None:
    """Forces as the adjoint of the rate of strain.

    For any stresses and any velocity v: sum of mass v (u - u*) is minus the power of the stresses
    in v, written out independently.
    """
    case = SandBesidePlane(dimension, TILTS[dimension][number])
    shape, random = case.grid.shape, case.random
    case.begin([random.normal(size=shape) for _ in range(dimension)], np.zeros(3))
    stress, p = case.stress, case.packing
    now = random.normal(size=stress.now.shape)
    now[:, p.flags.numpy() == 0] = 0.0
    stress.now.assign(now.astype(np.float32))
    now = stress.now.numpy().astype(float)
    stress.checked.find(stress.now)
    faces = [p.inverse[axis].numpy() > 0.0 for axis in range(dimension)]
    v = [np.where(face, random.normal(size=shape), 0.0) for face in faces]
    work = 0.0
    for axis in range(dimension):
        change = stress.checked.u[axis].numpy() - p.start[axis].numpy()
        work += float(
            (
                v[axis][faces[axis]] * change[faces[axis]] / p.inverse[axis].numpy()[faces[axis]]
            ).sum()
        )
    power, normals = 0.0, 3 if dimension == 3 else 1
    for axis in range(dimension):
        low, high = case.openings[axis], along(case.openings[axis], axis, 1)
        ahead = along(v[axis], axis, 1)
        # Pressure: the outflow of the open part.
        power += float((now[0] * (high * ahead - low * v[axis])).sum())
        part = (now[1] if axis == 0 else -now[1]) if dimension == 2 else now[1 + axis]
        power -= float((part * case.openings[dimension + axis] * (ahead - v[axis])).sum())
        # Traction: the slip along the wall.
        power += float((now[len(now) - dimension + axis] * (low * v[axis] + high * ahead)).sum())
    for d, (alpha, beta) in enumerate(SHEARS[dimension]):
        rate = v[alpha] - along(v[alpha], beta, -1) + v[beta] - along(v[beta], alpha, -1)
        weight = np.abs(p.share[d].numpy())
        for q in range(4):
            copy = now[1 + normals + 4 * d + q]
            power -= float((copy * along(along(weight * rate, alpha, q & 1), beta, q >> 1)).sum())
    assert work == pytest.approx(power, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize(("dimension", "number"), CASES)
def test_sliding_along_the_wall_strains_nothing(dimension: int, number: int) -> None:
    """No strain of sliding along the wall.

    Pressure and friction vanish, except the wall's: a smooth wall lets sand pass.
    """
    case = SandBesidePlane(dimension, TILTS[dimension][number], mu=0.0)
    along_wall = np.cross(case.normal, [0.3, 0.4, 1.0] if dimension == 3 else [0.0, 0.0, 1.0])
    case.begin([np.full(case.grid.shape, u) for u in along_wall[:dimension]], np.zeros(3))
    case.stress.residual()
    ring = np.zeros(case.grid.shape, dtype=bool)
    ring[1:-1, 1:-1, 1:-1] = True
    for axis in range(dimension):  # away from the domain's own walls
        ring &= along(ring, axis, 1) & along(ring, axis, -1)
    u = [f.numpy() for f in case.stress.checked.u]
    out = sum(
        case.openings[a] * -u[a] + along(case.openings[a] * u[a], a, 1) for a in range(dimension)
    )
    assert np.abs(out[ring]).max() < 3e-3  # faces open by less than 1e-3 count as closed
    for axis in range(dimension):
        assert (
            np.abs(
                (case.openings[dimension + axis] * (along(u[axis], axis, 1) - u[axis]))[ring]
            ).max()
            < 1e-6
        )
    for share, rate in zip(case.packing.share, case.stress.checked.edge, strict=True):
        assert np.abs((share.numpy() * rate.numpy())[ring & (share.numpy() > 0.0)]).max() < 1e-6


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_wall_bears_what_the_sand_loses(dimension: int) -> None:
    """Momentum that sand loses and the wall gets.

    A stiff block, away from the domain's walls, slides on a plane. Its momentum goes into the wall,
    by Coulomb's law in every cell.
    """
    case = SandBesidePlane(dimension, TILTS[dimension][0], mu=0.2, cells=9)
    gravity = np.array([0.0, -G, 0.0])
    filled = np.zeros(case.grid.shape)
    filled[(slice(1, -1) if dimension == 2 else slice(3, -3)), 1:-2, 3:-3] = 1.0
    case.begin(
        [np.full(case.grid.shape, g * DT) for g in gravity[:dimension]],
        gravity,
        cohesion=10.0,
        filled=filled,
    )
    case.solve(1e-5)
    now, p, cells = case.stress.now.numpy().astype(float), case.packing, case.walls.cells.numpy()
    traction, slip, lost_momentum = (
        np.zeros((case.walls.count, 3)),
        np.zeros((case.walls.count, 3)),
        np.zeros(3),
    )
    pressure, area, missing = now[0].ravel()[cells], case.walls.area, np.zeros(case.walls.count)
    for axis in range(dimension):
        low, high = case.openings[axis], along(case.openings[axis], axis, 1)
        total, u = (low + high).ravel()[cells], case.stress.checked.u[axis].numpy()
        traction[:, axis] = now[len(now) - dimension + axis].ravel()[cells] * total / area
        slip[:, axis] = np.divide(
            (low * u + high * along(u, axis, 1)).ravel()[cells],
            total,
            out=np.zeros(len(total)),
            where=total > 0.0,
        )
        volume = (case.walls.volume.numpy() - 0.5 * (low + high)).ravel()[cells]
        missing += case.walls.normal[:, axis] * gravity[axis] * DT * volume / area
        inverse = p.inverse[axis].numpy()
        lost_momentum[axis] = (
            (u - p.start[axis].numpy())[inverse > 0.0] / inverse[inverse > 0.0]
        ).sum()
    given = (area[:, None] * (traction - pressure[:, None] * case.walls.normal)).sum(axis=0)
    assert lost_momentum == pytest.approx(given, rel=1e-4, abs=1e-4 * np.abs(given).max())
    slip -= (slip * case.walls.normal).sum(axis=1)[:, None] * case.walls.normal
    sliding = (pressure > 0.2 * G * DT) & (np.linalg.norm(slip, axis=1) > 0.02 * G * DT)
    assert sliding.sum() >= 3 ** (dimension - 1)
    size, speed = np.linalg.norm(traction[sliding], axis=1), np.linalg.norm(slip[sliding], axis=1)
    assert -(traction[sliding] * slip[sliding]).sum(axis=1) == pytest.approx(size * speed, rel=0.02)
    assert size == pytest.approx(
        0.2 * np.maximum(pressure + missing, 0.0)[sliding], rel=0.02, abs=1e-6
    )


def test_a_liquid_at_rest_presses_by_its_depth() -> None:
    """Hydrostatic pressure of a liquid at rest.

    Without friction the pressure is that of the depth in every cell that a plane cuts, however
    small its open part is.
    """
    case = SandBesidePlane(2, TILTS[2][0], mu=0.0, k=0.0, cells=9)
    gravity = np.array([0.0, -G, 0.0])
    case.begin([np.full(case.grid.shape, g * DT) for g in gravity[:2]], gravity)
    case.solve(1e-6)
    pressure, flags = case.stress.now.numpy()[0, 1] / (G * DT), case.packing.flags.numpy()[1]
    volume = case.walls.volume.numpy()[1]
    found = np.argwhere((flags > 0) & (volume > 0.0))
    depth = pressure[tuple(found.T)] + found[:, 0]
    big = volume[tuple(found.T)] > 0.05
    assert depth[big] == pytest.approx(np.full(big.sum(), depth[big].mean()), abs=0.02)


def on_plane(
    theta: float, mu: Any, *, cells: int, cuts: bool = True, shift: float = 0.0
) -> tuple[SandSimulation, np.ndarray]:
    """Return a block of stiff sand on a plane, and the downhill direction.

    The plane falls by theta degrees.
    """
    depth, t = 0.1, math.radians(theta)
    dx = depth / cells
    down, up = np.array([math.cos(t), -math.sin(t)]), np.array([math.sin(t), math.cos(t)])
    point = [depth + shift * dx, 0.37 * dx + depth + 4 * depth * math.tan(t)]
    high = math.ceil((point[1] + 1.5 * depth) / depth)
    scene = SandScene.model_validate(
        {
            "scene": {"simulator": "granular"},
            "time": {"duration": 1.0},
            "domain": {
                "size": [6 * depth, high * depth],
                "resolution": max(6, high) * cells,
                "friction": 0.0,
            },
            "material": {"friction_angle": 40.0, "cohesion": 5e3},
            "solid": [{"shape": "plane", "point": point, "normal": up.tolist(), "friction": mu}],
            "sand": [
                {
                    "shape": "box",
                    "min": [0.0, 0.0],
                    "max": [3 * depth, depth],
                    "rotate": -theta,
                    "translate": point,
                }
            ],
        }
    )
    simulation = GranularSimulator().create(scene, device="cpu", folder=Path())
    if not cuts:
        simulation = whole(simulation)
    return simulation, down


def whole(simulation: SandSimulation) -> SandSimulation:
    """Return the simulation with solids of whole cells for the stresses, the control."""
    scene = simulation.scene
    solids = SandSolids(
        simulation.grid, simulation.boundary.cut.solids, simulation.boundary, scene.wall_frictions()
    )
    return SandSimulation(
        scene,
        simulation.grid,
        GridComponents(simulation.boundary, solids=solids),
        simulation.particles,
    )


def acceleration(simulation: SandSimulation, down: np.ndarray) -> float:
    """Return the block's mean acceleration from 0.02 s to 0.06 s [m/s^2]."""
    speeds = []
    for _ in range(30):
        simulation.step(2e-3)
        speeds.append(float(simulation.particles.velocity.numpy()[:, :2].mean(axis=0) @ down))
    return (speeds[-1] - speeds[9]) / (20 * 2e-3)


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("theta", "mu", "shift"), [(20.0, 0.2, 0.0), (30.0, 0.0, 0.3), (35.0, 0.4, 0.7)]
)
def test_a_block_slides_on_an_oblique_plane_as_coulomb_says(
    theta: float, mu: float, shift: float
) -> None:
    t = math.radians(theta)
    assert acceleration(*on_plane(theta, mu, cells=6, shift=shift)) == pytest.approx(
        G * (math.sin(t) - mu * math.cos(t)), abs=0.02 * G * math.sin(t)
    )


def test_slits_bear_nothing() -> None:
    """Slits without a load.

    A cell here is open by 2e-3 of one of its faces. A pressure of 8,000 cells' depth held the block
    back there, with an unsolved problem.
    """
    t, mu = math.radians(10.3), 0.09
    assert inclined.acceleration(10.3, mu, 11, shift=0.47) == pytest.approx(
        G * (math.sin(t) - mu * math.cos(t)), abs=0.02 * G * math.sin(t)
    )


def test_whole_cells_hold_the_block() -> None:
    """Block held by the stairs of whole cells, the control."""
    assert acceleration(*on_plane(20.0, 0.2, cells=6, cuts=False)) < 0.1


@pytest.mark.parametrize("mu", [0.7, "stick"])
def test_a_block_rests_where_friction_holds_it(mu: Any) -> None:
    assert abs(acceleration(*on_plane(25.0, mu, cells=6))) < 0.002 * G


def test_solids_of_whole_cells_stay_so() -> None:
    """Solids of whole cells remain whole.

    Boxes on the grid's lines need no cut. A diagonal through cell corners opens or closes every
    face, but is no box.
    """
    grid = StaggeredGrid((8, 8, 1), 0.125, 2)

    def cut(normal: list[float], point: list[float]) -> CutCells:
        half = Plane(point=point, normal=normal)
        return CutCells(
            grid, [PlacedSolid(geometry=half, separating=True, name="plane")], wall_separating=True
        )

    assert cut([0.0, 1.0], [0.0, 0.25]).whole_cells
    assert not cut([math.sqrt(0.5), math.sqrt(0.5)], [0.5, 0.5]).whole_cells
    assert (cut([1.0, 1.0], [0.5, 0.5]).base.numpy() == SOLID).any()
