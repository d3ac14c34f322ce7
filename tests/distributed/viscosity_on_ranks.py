"""Viscous equations on ranks; `test_viscosity_on_ranks` starts this program.

A cycle and a product of all ranks are compared with those of one process.
"""

import math
from pathlib import Path

import numpy as np
import warp as wp

from small_liquids import create as create_alone
from viscous_scenes import viscous_scene
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.fluids import viscosity_multigrid
from warp_lcp.fluids.simulator import FluidsSimulator, LiquidSimulation

# 3-D and 2-D, cut along rows and across, with two to four distributed levels. Cores lie in one box
# or in both.
SEEDS = (10, 21, 27)
ROUNDING = 1e-6  # where a cut lies in a row, cells of the row are grouped differently
STIFF = {"value": 300.0, "splitting_tolerance": math.inf}


def applied(simulation: LiquidSimulation, whole: np.ndarray) -> list[np.ndarray]:
    """Return z = M r, A z, and z of a light cycle on the cells, shape (d, nz, ny, nx).

    r is that of the whole grid.
    """
    multigrid, grid = simulation.viscosity.multigrid, simulation.grid
    own = grid.part.owned
    inside = tuple(slice(low, high) for low, high in zip(own.low, own.high, strict=True))
    place = tuple(
        slice(s.start - 1 + o, s.stop - 1 + o)
        for s, o in zip(inside, grid.origin[::-1], strict=True)
    )
    r, q = np.zeros((grid.dimension, *grid.shape), dtype=np.float32), wp.zeros_like(multigrid.r)
    for field, diagonal, values in zip(r, multigrid.levels[0].diagonal, whole, strict=True):
        field[inside] = np.where(diagonal.numpy()[inside] > 0.0, values[place], 0.0)
    multigrid.r.assign(r.ravel())
    multigrid.apply()
    multigrid.product(multigrid.z, q)
    z = wp.clone(multigrid.z)
    multigrid.light_program().run()
    return [
        np.array([field.numpy()[inside] for field in multigrid.components(each)])
        for each in (z, q, multigrid.z)
    ]


def main() -> None:
    """Distribute all levels that boxes allow, and compare."""
    ranks = Ranks.world()
    viscosity_multigrid.GATHERED = 8
    for seed in SEEDS:
        scene = viscous_scene(seed)
        scene = scene.model_copy(update={"viscosity": scene.viscosity.model_copy(update=STIFF)})
        shared, alone = (
            FluidsSimulator().create(scene, device="cpu", folder=Path(), ranks=ranks),
            create_alone(scene),
        )
        for simulation in (shared, alone):
            simulation.step(0.01)
        assert len(shared.viscosity.multigrid.levels) > 1
        whole = (
            np.random.default_rng(7 * seed)
            .standard_normal((scene.dimension, *scene.cell_counts[::-1]))
            .astype(np.float32)
        )
        box = (slice(None), *shared.grid.part.box.slices)
        for found, expected in zip(applied(shared, whole), applied(alone, whole), strict=True):
            error, largest = (
                float(ranks.max(np.abs(found - expected[box]).max())),
                float(np.abs(expected).max()),
            )
            assert error <= ROUNDING * largest * bool(
                shared.grid.part.decomposition.processes[0] > 1
            ), f"seed {seed}: {error} of {largest}"


if __name__ == "__main__":
    main()
