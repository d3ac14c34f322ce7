"""Add material between two steps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import warp_lcp as wl
from warp_lcp.material.partial_sites import seed_regions
from warp_lcp.material.particle_assembly import region_of
from warp_lcp.material.particle_simulation import ParticleSimulation
from warp_lcp.scene.shapes import MaterialProperties


def pour(simulation: ParticleSimulation, shape: MaterialProperties, name: str) -> int:
    """Fill the empty part of a shape with particles, and return their number.

    Cells of solids and of material stay as they are.

    Args:
        simulation: between two steps (updated).
        shape: an entry of a scene's `[[liquid]]` or `[[sand]]`, with the velocity of the new
            material.
        name: name of the shape, for messages.

    Raises:
        ValueError: the shape holds no empty cell, or the grid covers but a part of the domain.
    """
    grid, settings, boundary = simulation.grid, simulation.scene.particles, simulation.boundary
    if grid.whole is not None:
        raise ValueError(
            f"{name}: the grid follows the material and may not cover this place; set "
            "domain.follow = false"
        )
    cells = grid.interior(simulation.own_state()["cells"])
    free = (cells == wl.AIR) & (grid.interior(boundary.base.numpy()) != wl.SOLID)
    i, j, k = simulation.particles.cells_of(simulation.particles.position.numpy()).T
    free[k, j, i] = False  # cells that material has entered since the last solve
    geometry = shape.to_geometry(Path.cwd(), grid.dimension)
    points, _ = seed_regions(
        grid,
        boundary,
        [geometry],
        [region_of(geometry, boundary, grid.device)],
        free,
        per_axis=settings.per_axis,
        jitter=settings.jitter,
        random_seed=settings.seed,
    )
    if not len(points):
        raise ValueError(
            f"{name} holds no empty cell: it lies in solids, in material or outside the domain, or "
            "is too small"
        )
    velocity = np.zeros((len(points), 3), dtype=np.float32)
    velocity[:, : grid.dimension] = shape.velocity or 0.0
    simulation.add(points, velocity)
    return len(points)
