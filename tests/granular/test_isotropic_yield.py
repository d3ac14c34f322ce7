"""Isotropy of the yield set with respect to the grid."""

import math

import numpy as np
import pytest
import warp as wp

from warp_lcp.granular.packing import Packing
from warp_lcp.granular.stress import Stress, YieldSet
from warp_lcp.granular.wall_friction import SandWalls
from warp_lcp.grid.staggered import StaggeredGrid

# Cells along an edge; p and k of the yield set [m/s]; shear of the flow times dx [m/s].
CELLS, PRESSURE, SLOPE, RATE = 6, 1.0, 0.5, 300.0


def linear_flow(grid: StaggeredGrid, gradient: np.ndarray) -> list[wp.array]:
    """Return the faces' values of u_i = gradient_ij x_j, times dx."""
    k, j, i = np.meshgrid(*(np.arange(n, dtype=float) for n in grid.shape), indexing="ij")
    center = np.stack([i, j, k]) - 0.5 * CELLS
    fields = []
    for axis in range(grid.dimension):
        at = center + 0.5
        at[axis] -= 0.5
        fields.append(
            wp.array(
                np.einsum("j,jkmn->kmn", gradient[axis], at).astype(np.float32),
                dtype=wp.float32,
                device=grid.device,
            )
        )
    return fields


def borne(degrees: float, plane: tuple[int, int], dimension: int, *, box: bool) -> float:
    """Return the shear stress over k p in a cell of packed sand under fast shear.

    The shear is along a direction in a plane of two axes. The stress is the dissipation over the
    rate of shear: the largest power that friction can take from the flow.
    """
    grid = StaggeredGrid((CELLS, CELLS, CELLS if dimension == 3 else 1), 1.0, dimension)
    base, one = grid.field(wp.int8), wp.full(grid.shape, 1.0, dtype=wp.float32, device=grid.device)
    packing = Packing(grid, base, one)
    angle = math.radians(degrees)
    along, across = np.zeros(3), np.zeros(3)
    along[list(plane)], across[list(plane)] = (
        (math.cos(angle), math.sin(angle)),
        (-math.sin(angle), math.cos(angle)),
    )
    gradient = RATE * np.outer(along, across)
    packing.update(one, linear_flow(grid, gradient), 1.0)
    stress = Stress(
        packing, SandWalls(grid, np.full(grid.shape, -1, dtype=np.int32), [0.0]), box=box
    )
    start = np.zeros(stress.now.shape, dtype=np.float32)
    start[0] = PRESSURE
    stress.now.assign(start)
    stress.kick_dt = 1.0
    stress.begin(YieldSet(SLOPE), np.zeros(3), 1.0, 1.0)
    # The pressure stays constant.
    stress.restart(pressure_step=1e-6, shear_step=0.2, lookahead=0.0, momentum=0.0)
    # So fast a flow moves the stress to the point of the yield set with the largest dissipation.
    stress.advance(1)
    k = CELLS // 2 if dimension == 3 else 1
    cell = stress.now.numpy()[:, k, CELLS // 2, CELLS // 2].astype(float)
    assert cell[0] == pytest.approx(PRESSURE, rel=1e-3)
    normals = cell[1:4] if dimension == 3 else np.array([cell[1], -cell[1], 0.0])
    strain = 0.5 * (gradient + gradient.T)
    taken = float(normals @ np.diag(strain))
    for shear, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))[: 3 if dimension == 3 else 1]):
        first = len(cell) - 4 * (3 if dimension == 3 else 1) + 4 * shear
        taken += 2.0 * float(cell[first : first + 4].mean()) * strain[a, b]
    return taken / (RATE * SLOPE * PRESSURE)


CASES = [(2, (0, 1)), (3, (0, 1)), (3, (0, 2)), (3, (1, 2))]


@pytest.mark.parametrize(("dimension", "plane"), CASES)
def test_the_cone_bears_the_same_shear_in_all_directions(
    dimension: int, plane: tuple[int, int]
) -> None:
    found = [
        borne(degrees, plane, dimension, box=False) for degrees in (0.0, 10.0, 22.5, 45.0, 100.0)
    ]
    assert found == pytest.approx([1.0] * len(found), abs=0.03)


@pytest.mark.parametrize(("dimension", "plane"), CASES)
def test_the_box_bears_more_between_its_axes(dimension: int, plane: tuple[int, int]) -> None:
    """Box between its axes: the negative control.

    Normal and shear stress each have their own bound; both are reached at 22.5 degrees.
    """
    assert borne(0.0, plane, dimension, box=True) == pytest.approx(1.0, abs=0.03)
    assert borne(45.0, plane, dimension, box=True) == pytest.approx(1.0, abs=0.03)
    assert borne(22.5, plane, dimension, box=True) == pytest.approx(math.sqrt(2.0), abs=0.03)
