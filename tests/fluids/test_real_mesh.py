"""Dam break over a real triangle mesh, if one is installed."""

from pathlib import Path

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from small_liquids import advance, box, create, scene

SPOT = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "spot.obj"
pytestmark = pytest.mark.skipif(not SPOT.is_file(), reason="shared/data/spot.obj is not here")


@pytest.mark.parametrize("wall", ["separating", "free-slip"])
@pytest.mark.parametrize("solids", ["cut-cell", "voxel"])
def test_a_dam_breaks_over_spot(solids: str, wall: str) -> None:
    cow = {
        "shape": "mesh",
        "file": str(SPOT),
        "scale": 0.35,
        "rotate": [0, -90, 0],
        "translate": [0.9, 0.25, 0.5],
    }
    liquid = [box([0.0, 0.0, 0.0], [0.5, 0.9, 1.0])]
    simulation = create(
        scene(
            size=[1.5, 1.25, 1.0],
            resolution=24,
            liquid=liquid,
            solid=[cow],
            wall=wall,
            solids=solids,
        )
    )
    volume = (
        float((1.0 - simulation.boundary.capacity.numpy())[2:-2, 2:-2, 2:-2].sum())
        * simulation.grid.cell_volume
    )
    assert volume == pytest.approx(0.718 * 0.35**3, rel=0.15 if solids == "cut-cell" else 0.2)
    rows = advance(simulation, 0.6)
    assert {row["solve_status"] for row in rows} == {"CONVERGED"}
    assert np.mean([row["linear_iterations"] for row in rows]) <= 8
    assert rows[0]["mass"] == rows[-1]["mass"]
    energy = [row["kinetic_energy"] + row["potential_energy"] for row in rows]
    assert energy[-1] < 1.02 * energy[0]
    base = simulation.boundary.base.numpy()
    position = simulation.particles.position.numpy()
    x, y, z = (np.floor(position / simulation.grid.spacing).astype(int) + 1).T
    # No particle is inside the mesh or the walls.
    if solids == "cut-cell":
        # Beside the thin legs a cell without open faces may have room for a particle.
        near = simulation.boundary.barriers.near.numpy()
        assert (base[near == 0] == wl.SOLID).any()
        assert ((base[z, y, x] != wl.SOLID) | (near[z, y, x] > 0)).all()
        assert simulation.boundary.admits(position + 0.0).mean() > 0.999
        solid = simulation.boundary.cut.solids[0].geometry
        distance = wp.empty(len(position), dtype=wp.float32)
        solid.signed_distance(wp.array(position, dtype=wp.vec3), distance)
        assert (distance.numpy() > 0.0).all()
    else:
        assert (base[z, y, x] != wl.SOLID).all()
    assert position[:, 0].max() > 1.3  # the wave has passed it
