"""The start of particles on ranks: who has which box, and what of a scene lies in it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from warp_lcp.distributed.decomposition import Decomposition, balanced_processes, pool
from warp_lcp.distributed.particles import SharedParticles
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.distributed.subdomain import Subdomain, ghost_layers
from warp_lcp.grid.surface_mesh import surface_layers
from warp_lcp.material.particle_assembly import Parts, kept_by, seed_materials, start_band, start_velocities
from warp_lcp.material.particle_scene import ParticleScene

NOT_ON_RANKS = "is not there on several processes (--engine petsc) yet: leave it out, or run on one process"


def check_shared(scene: ParticleScene, ranks: Ranks, refused: Sequence[str], methods: Sequence[str]) -> None:
    """Refuse a scene that is not the same on all ranks, or asks for what runs on ranks have not; collective.

    Args:
        scene: the scene.
        ranks: who share it.
        refused: keys of it.
        methods: that solve problems of several ranks.

    Raises:
        ValueError: the message names the key and what is allowed; on all ranks.
    """
    ranks.agree("the scene", scene.model_dump(mode="json"))
    told = [f"{key} {NOT_ON_RANKS}" for key in refused]
    if scene.solver.method not in methods:
        told.append(f"solver.method = {scene.solver.method} works on one process only (without --engine petsc): {' or '.join(methods)}")
    if told:
        raise ValueError("; ".join(told))


def part_of(scene: ParticleScene, ranks: Ranks, device: str, *, smoothing: int = 0) -> Subdomain:
    """Return where this rank works: all have about as much material, at the start and when it has come to rest.

    Args:
        scene: the scene.
        ranks: who share it.
        device: a Warp device's name.
        smoothing: binomial passes over the level set.
    """
    counts, layers = scene.cell_counts, ghost_layers(scene.time.cfl, smoothing)
    if scene.output.surface:
        layers = max(layers, surface_layers(scene.output.surface_resolution or scene.particles.per_axis))
    size = np.array([*scene.domain.size, scene.spacing][:3])
    start = []
    for shape in scene.materials()[1]:
        bounds = shape.bounds(scene.dimension)
        low, high = (np.zeros(3), size) if bounds is None else (np.clip(corner, 0.0, size) for corner in bounds)
        if scene.dimension == 2:
            low[2], high[2] = 0.0, scene.spacing
        start.append((low / scene.spacing, high / scene.spacing))
    volume = sum(float(np.prod(high - low)) for low, high in start)
    rest = pool(counts, scene.dimension, volume, np.array(scene.physics.gravity))
    processes = balanced_processes(counts, ranks.size, layers=layers, states=[start, [rest]])
    decomposition = Decomposition(counts, ranks, processes=processes, periodic=scene.endless)
    return Subdomain(decomposition, spacing=scene.spacing, dimension=scene.dimension, device=device, layers=layers)


def particles_of_part(scene: ParticleScene, part: Subdomain, parts: Parts, folder: Path) -> tuple[SharedParticles, list[str]]:
    """Return this rank's particles at the start, and warnings; the host's arrays are gone before the fields are made. Collective.

    The narrow band of `parts` gets what particles need not carry.

    Raises:
        ValueError: a material has no particle on any rank; on all ranks.
    """
    elsewhere = np.ones(part.grid.counts[::-1], dtype=bool)
    elsewhere[tuple(slice(low - 1, high - 1) for low, high in zip(part.owned.low, part.owned.high, strict=True))] = False
    without = start_band(scene, part.grid, parts.boundary, folder, parts.band)
    if without is not None:
        elsewhere |= without
    position, owner, notes = seed_materials(scene, part.grid, parts.boundary, folder, elsewhere)
    _check_seeded(scene, part.ranks.sum(np.bincount(owner, minlength=len(scene.materials()[1]))))
    velocity = start_velocities(scene).astype(np.float32)[owner]
    return SharedParticles(part, position, velocity, affine=scene.particles.transfer == "apic", kept=kept_by(scene, owner)), notes


def _check_seeded(scene: ParticleScene, counts: np.ndarray) -> None:
    """Refuse material without a particle on any rank."""
    key, materials = scene.materials()
    for number, (material, count) in enumerate(zip(materials, counts, strict=True)):
        if count == 0:
            raise ValueError(
                f"{key}[{number}] ({material.shape}) holds no particle: it is too small for cells of {scene.spacing:.4g} m, or lies in "
                f"solids, outside the domain or in an earlier {key}"
            )
