"""Moving solids that cut cells of sand: swept volume, slip and lists of walls."""

import math
from typing import Any

import numpy as np
import pytest
import warp as wp

from small_sands import advance, box, create, scene
from warp_lcp.granular.cut_walls import LEAST_LISTED, CutWalls
from warp_lcp.granular.packing import Packing
from warp_lcp.granular.simulator import SandSimulation
from warp_lcp.granular.stress import Stress, YieldSet
from warp_lcp.granular.stress_layout import NEARLY
from warp_lcp.granular.wall_friction import SandWalls
from warp_lcp.grid.cut_cells import CutCells
from warp_lcp.grid.motion import Motion, Rotation, Translation
from warp_lcp.grid.signed_distance import Box, Plane
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.voxelize import PlacedSolid

DT, DX = 0.01, 0.1
SPIN = 90.0  # of a drum [degrees/s]


def moving(grid: StaggeredGrid, geometry: Any, motion: Motion | None) -> CutCells:
    """Return the cells that a solid cuts."""
    solid = PlacedSolid(geometry=geometry, separating=True, name="wall", motion=motion)
    return CutCells(grid, [solid], wall_separating=True)


def residual(dimension: int, fraction: float, *, moves: bool) -> float:
    """Return the natural residual without stresses [m/s] of sand that moves with a plane.

    The plane is oblique, has friction, and the sand fills one side of it. It may also stand still.
    """
    velocity = [0.3, -0.2, 0.25][:dimension]
    counts = (8, 7, 6 if dimension == 3 else 1)
    grid = StaggeredGrid(counts, DX, dimension)
    normal = np.array([-0.37, 1.0, 0.21][:dimension])
    point = [0.52 * DX * n for n in counts[:dimension]]
    half = Plane(point=point, normal=(normal / np.linalg.norm(normal)).tolist())
    cut = moving(grid, half, Translation(velocity=velocity if moves else [0.0] * dimension))
    walls = CutWalls(grid, cut, [0.0, 0.4])
    cut.set_velocity(0.0, DT)
    walls.find_velocity()
    one = wp.full(grid.shape, 1.0, dtype=wp.float32, device=grid.device)
    density = wp.full(grid.shape, fraction, dtype=wp.float32, device=grid.device)
    packing = Packing(grid, cut.base, one, cut=walls)
    packing.update(density, [wp.full_like(one, u) for u in velocity], DT)
    index = np.zeros(grid.shape, dtype=np.int32)
    index[1:-1, 1:-1, 1:-1] = -1
    stress = Stress(packing, SandWalls(grid, index, [0.0, 0.4], rubbing_only=True))
    stress.begin(YieldSet(0.5), np.zeros(3), DT, DT)
    stress.residual()
    # The domain's own walls stand still: only cells away from them move with the plane alone.
    u = [field.numpy() for field in stress.checked.u]
    openings = walls.openings.numpy()
    # Full cells keep their volume, loose ones their mass.
    full = np.clip(1.0 - packing.drive.numpy() * DT / DX / NEARLY, 0.0, 1.0)
    flux = openings[2 * dimension].copy()
    for axis in range(dimension):
        mass, open_flux = packing.mass[axis].numpy(), openings[axis] * u[axis]
        for sign, by in ((-1.0, 0), (1.0, -1)):
            m, passed = (np.roll(field, by, axis=2 - axis) for field in (mass, open_flux))
            flux += sign * (m + full * (1.0 - m)) * passed
    inner = (slice(2, -2) if dimension == 3 else slice(1, 2), slice(2, -2), slice(2, -2))
    return float(np.abs(flux[inner] * (packing.flags.numpy()[inner] > 0)).max())


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("fraction", [1.0, 0.6])
def test_sand_that_moves_with_a_wall_is_not_compressed(dimension: int, fraction: float) -> None:
    """Flux through the faces and the swept volume cancel in dense and in loose sand."""
    # Faces that are open by less than 1e-3 count as closed.
    assert residual(dimension, fraction, moves=True) < 1e-3
    assert residual(dimension, fraction, moves=False) > 0.1


@pytest.mark.parametrize(
    ("dimension", "motion"),
    [
        (2, Rotation(rate=SPIN, center=[0.5, 0.4])),
        (2, Translation(velocity=[0.7, 0.4])),
        (3, Rotation(rate=SPIN, center=[0.5, 0.4, 0.3], axis=[1.0, 2.0, 3.0])),
    ],
)
def test_walls_that_have_moved_equal_new_ones(dimension: int, motion: Motion) -> None:
    """Only cells near the solid are computed again, also where it enters the domain or leaves."""
    counts = (12, 9, 7 if dimension == 3 else 1)
    grid = StaggeredGrid(counts, DX, dimension)
    lower, upper = [0.3, 0.2, 0.2][:dimension], [0.75, 0.47, 0.5][:dimension]
    cut = moving(grid, Box(lower=lower, upper=upper), motion)
    walls = CutWalls(grid, cut, [0.0, 0.4])
    for time in (0.13, 0.5, 0.9, 1.4):
        had = set(walls.cells.numpy().tolist())
        cut.place(time)
        left = walls.place()
        new = CutWalls(grid, cut, [0.0, 0.4])
        for mine, other in zip(
            (walls.openings, walls.volume, *walls.around, walls.cells),
            (new.openings, new.volume, *new.around, new.cells),
            strict=True,
        ):
            values, expected = mine.numpy(), other.numpy()
            if values.ndim > 1:  # the ring of the domain holds no sand
                values, expected = (v[..., 1:-1, 1:-1, 1:-1] for v in (values, expected))
            assert np.array_equal(values, expected)
        assert np.array_equal(walls.normal, new.normal) and np.array_equal(walls.area, new.area)
        assert set(left.tolist()) == had - set(new.cells.numpy().tolist())
        assert walls.count % LEAST_LISTED == 0


def test_solids_at_rest_have_no_fields_of_moving_ones() -> None:
    grid = StaggeredGrid((8, 8, 1), DX, 2)
    walls = CutWalls(
        grid, moving(grid, Plane(point=[0.4, 0.4], normal=[0.6, 0.8]), None), [0.0, 0.4]
    )
    assert walls.swept is None and not walls.moves
    assert walls.openings.shape[0] == 4 and walls.count == len(walls.area)


def drum(friction: float) -> SandSimulation:
    """Return sand in a drum that turns."""
    shell = {
        "shape": "sphere",
        "center": [0.5, 0.5],
        "radius": 0.42,
        "invert": True,
        "friction": friction,
        "motion": {"kind": "rotation", "center": [0.5, 0.5], "rate": SPIN},
    }
    sand = [box([0.0, 0.0], [1.0, 0.4])]
    return create(scene(size=[1.0, 1.0], resolution=24, sand=sand, solid=[shell]))


def test_a_smooth_drum_turns_around_its_sand_and_a_rough_one_lifts_it() -> None:
    """Whole cells would drag the sand by their steps, however smooth: to 30 degrees and more."""
    tilts = []
    for friction in (0.0, 0.5):
        simulation = drum(friction)
        advance(simulation, 0.4)
        x, y = simulation.particles.position.numpy()[:, :2].mean(axis=0) - 0.5
        tilts.append(math.degrees(math.atan2(x, -y)))
    assert abs(tilts[0]) < 3.0 and tilts[1] > 15.0
    assert simulation.solids.cut is not None and not simulation.solids.notes


@pytest.mark.parametrize("speed", [0.6])
def test_plowed_sand_keeps_its_density(speed: float) -> None:
    """A blade that pushes a layer: cells hold at most 1.10 times the densest packing.

    They held up to 1.2 while solids were whole cells and only overfull scenes were corrected.
    """
    blade = {
        **box([0.05, 0.0], [0.13, 0.6]),
        "friction": 0.3,
        "motion": {"kind": "translation", "velocity": [speed, 0.0]},
    }
    sand = [box([0.2, 0.0], [1.2, 0.1])]
    simulation = create(
        scene(size=[1.2, 0.4], resolution=48, sand=sand, solid=[blade], friction=0.577)
    )
    rows = advance(simulation, 0.25 / speed)
    assert max(row["max_fraction"] for row in rows) < 1.10
