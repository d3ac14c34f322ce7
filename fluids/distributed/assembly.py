"""The start of liquid on ranks: who has which box, and what of a scene lies in it."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from warp_lcp.distributed.decomposition import Decomposition, balanced_processes, pool
from warp_lcp.distributed.particles import SharedParticles
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.distributed.solids import boundary_of_part
from warp_lcp.distributed.sources import SharedSources
from warp_lcp.distributed.subdomain import Subdomain, ghost_layers
from warp_lcp.fluids.distributed.simulation import DistributedLiquid
from warp_lcp.fluids.scene import LiquidScene
from warp_lcp.grid.sides import side_bits
from warp_lcp.material.boundary import Boundary
from warp_lcp.material.particle_assembly import Parts, make_outlets, make_sources, placed_solids, seed_materials, start_velocities
from warp_lcp.scene.scene import Scene

METHODS = ("projected-multigrid", "minimum-map-newton")  # that solve problems of several ranks
NOT_ON_RANKS = "is not there on several processes (--engine petsc) yet: leave it out, or run on one process"


def create(scene: Scene, ranks: Ranks, *, device: str, folder: Path) -> DistributedLiquid:
    """Build this rank's part of a simulation of `scene`; collective.

    Args:
        scene: a LiquidScene, the same on all ranks.
        ranks: who share it.
        device: a Warp device's name.
        folder: where the files are that the scene names.

    Raises:
        ValueError: the scene cannot be simulated, or not on ranks; the message names the key and what is allowed. On all ranks.
    """
    if not isinstance(scene, LiquidScene):
        raise ValueError("scene.simulator: fluids needs a scene of liquid")
    ranks.agree("the scene", scene.model_dump(mode="json"))
    refused = [f"{key} {NOT_ON_RANKS}" for key in refusals(scene)]
    if scene.solver.method not in METHODS:
        refused.append(f"solver.method = {scene.solver.method} works on one process only (without --engine petsc): {' or '.join(METHODS)}")
    if refused:
        raise ValueError("; ".join(refused))
    part = _part(scene, ranks, device)
    solids, domain = placed_solids(scene, folder), scene.domain
    boundary, warnings = boundary_of_part(
        part, solids, cut_cells=domain.solids == "cut-cell", wall_separating=domain.wall == "separating",
        open_sides=side_bits(domain.open), sources=bool(scene.source),
    )  # fmt: skip
    particles, notes = _particles(scene, part, boundary, folder)
    sources = make_sources(scene, part.grid, boundary, folder, partial(SharedSources, part))
    outlets = make_outlets(scene, part.grid, folder)
    parts, notes = Parts(boundary, sources), [*warnings, *notes]
    return DistributedLiquid(scene, part, parts, particles, solids=solids, outlets=outlets, notes=notes)


def _particles(scene: LiquidScene, part: Subdomain, boundary: Boundary, folder: Path) -> tuple[SharedParticles, list[str]]:
    """Return this rank's particles at the start, and warnings; the host's arrays are gone before the fields are made."""
    elsewhere = np.ones(part.grid.counts[::-1], dtype=bool)
    elsewhere[tuple(slice(low - 1, high - 1) for low, high in zip(part.owned.low, part.owned.high, strict=True))] = False
    position, owner, notes = seed_materials(scene, part.grid, boundary, folder, elsewhere)
    _check_seeded(scene, part.ranks.sum(np.bincount(owner, minlength=len(scene.materials()[1]))))
    velocity = start_velocities(scene).astype(np.float32)[owner]
    return SharedParticles(part, position, velocity, affine=scene.particles.transfer == "apic"), notes


def _part(scene: LiquidScene, ranks: Ranks, device: str) -> Subdomain:
    """Return where this rank works: all have about as much liquid, at the start and when it has come to rest."""
    counts, layers = scene.cell_counts, ghost_layers(scene.time.cfl, scene.pressure.smoothing)
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
    decomposition = Decomposition(counts, ranks, processes=processes)
    return Subdomain(decomposition, spacing=scene.spacing, dimension=scene.dimension, device=device, layers=layers)


def refusals(scene: LiquidScene) -> list[str]:
    """Return the keys of a scene that ask for what runs on ranks have not."""
    output, particles = scene.output, scene.particles
    asked = {
        **{f"solid[{n}].mass": solid.is_body for n, solid in enumerate(scene.solid)},
        "viscosity": scene.viscosity,
        "particles.narrow_band": particles.narrow_band,
        "particles.reseed": particles.reseed,
        'pressure.model = "unilateral"': scene.pressure.model == "unilateral",
        "output.surface": output.surface,
        "output.volume": output.volume,
    }
    return [key for key, wanted in asked.items() if wanted]


def _check_seeded(scene: LiquidScene, counts: np.ndarray) -> None:
    """Refuse liquid without a particle on any rank."""
    key, materials = scene.materials()
    for number, (material, count) in enumerate(zip(materials, counts, strict=True)):
        if count == 0:
            raise ValueError(
                f"{key}[{number}] ({material.shape}) holds no particle: it is too small for cells of {scene.spacing:.4g} m, or lies in "
                f"solids, outside the domain or in an earlier {key}"
            )
