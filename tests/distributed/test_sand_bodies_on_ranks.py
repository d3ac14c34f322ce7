"""Forces of sand on bodies, on ranks and in one process."""

import numpy as np
import pytest
import warp as wp
from ranks_in_turn import RankInTurn, on_ranks

from warp_lcp.distributed.decomposition import Decomposition
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.granular.bodies import SandBodies
from warp_lcp.granular.packing import Packing
from warp_lcp.granular.wall_friction import SandWalls
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.operators.grid_poisson import SOLID

DX, DT, LAYERS = 0.1, 0.01, 3
COUNTS = {2: (16, 16, 1), 3: (16, 16, 8)}


def answers(
    bodies: SandBodies, packing: Packing, index: np.ndarray, centers: np.ndarray, fields: dict
) -> list[np.ndarray]:
    """Return the coupling of random bodies with random stresses.

    It consists of sums of all kinds, and the resulting velocities.
    """
    grid, count, k = packing.grid, len(centers), bodies.freedoms
    walls = SandWalls(grid, index, [0.5] * (1 + count), counted=packing.counted)
    bodies.place(index, centers, walls)
    speeds = [wp.array(fields["speed"][axis], dtype=wp.float32) for axis in range(grid.dimension)]
    packing.update(wp.array(fields["density"], dtype=wp.float32), speeds, DT, grid.faces())
    random = np.random.default_rng(907)
    velocity, inverse = (
        random.normal(size=(count, k)),
        np.tile(np.eye(k), (count, 1, 1)) * random.uniform(1.0, 2.0, (count, 1, 1)),
    )
    bodies.begin(
        packing,
        speeds,
        speeds,
        velocity=velocity,
        inverse_mass=inverse,
        density=1.0 / grid.cell_volume,
        dt=0.5 * grid.spacing,
    )
    bodies.prepare(pressure_step=0.8, shear_step=0.4)
    stress = wp.array(fields["stress"], dtype=wp.float32)
    found = [bodies.velocity.numpy().copy(), bodies._correction.array.numpy().copy()]
    for implicit in (True, False):
        bodies.respond(packing, stress, wp.launch, implicit=implicit)
        found += [bodies._force.numpy().copy(), bodies.velocity.numpy().copy()]
    return [*found, bodies.impulses()]


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("size", [2, 4])
def test_every_cell_and_edge_acts_on_a_body_once(dimension: int, size: int) -> None:
    random = np.random.default_rng(613)
    grid = StaggeredGrid(COUNTS[dimension], DX, dimension)
    index = np.zeros(grid.shape, dtype=np.int32)
    index[1:-1, 1:-1, 1:-1] = -1
    deep = slice(3, 7) if dimension == 3 else slice(1, -1)
    for number, (rows, columns) in enumerate(
        ((slice(5, 9), slice(3, 11)), (slice(9, 12), slice(7, 9)), (slice(12, 14), slice(13, 15))),
        1,
    ):
        # Across cuts, beside the body and the cuts, and in one rank's box.
        index[deep, rows, columns] = number
    open_ = index < 0
    fields = {
        "density": np.where(
            open_, random.choice([0.0, 0.6, 1.0], p=[0.1, 0.2, 0.7], size=grid.shape), 0.0
        ),
        "speed": random.uniform(0.1, 1.0, (3, *grid.shape)),
        "stress": random.normal(
            size=((2 if dimension == 2 else 4) + 4 * (1 if dimension == 2 else 3), *grid.shape)
        )
        * open_,
    }
    centers, numbers = random.uniform(0.3, 1.3, (3, 3)), (1, 2, 3)

    def packed(grid: StaggeredGrid, index: np.ndarray) -> Packing:
        base = wp.array(np.where(index >= 0, SOLID, 0), dtype=wp.int8)
        return Packing(grid, base, wp.full(grid.shape, 1.0, dtype=wp.float32))

    def work(seat: RankInTurn) -> list[np.ndarray]:
        boxes = Decomposition(grid.counts, Ranks(seat))
        part = Subdomain(boxes, spacing=DX, dimension=dimension, device="cpu", layers=LAYERS)
        here = tuple(
            slice(low, low + n)
            for low, n in zip(part.grid.origin[::-1], part.grid.shape, strict=True)
        )
        mine = {name: np.ascontiguousarray(values[(..., *here)]) for name, values in fields.items()}
        cells = np.ascontiguousarray(index[here])
        return answers(
            SandBodies(part.grid, numbers), packed(part.grid, cells), cells, centers, mine
        )

    expected = answers(SandBodies(grid, numbers), packed(grid, index), index, centers, fields)
    for found in on_ranks(size, work):
        for values, wanted in zip(found, expected, strict=True):
            np.testing.assert_allclose(
                values, wanted, rtol=1e-10, atol=1e-12 * np.abs(wanted).max()
            )
