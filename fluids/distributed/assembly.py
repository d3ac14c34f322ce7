"""The start of liquid on ranks."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from warp_lcp.distributed.particle_assembly import check_shared, part_of, particles_of_part
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.distributed.solids import boundary_of_part
from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.fluids.distributed.simulation import DistributedLiquid
from warp_lcp.fluids.scene import LiquidScene
from warp_lcp.material.particle_assembly import Parts, make_bodies, make_narrow_band, make_outlets, make_sources, placed_solids
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.scene.scene import Scene

METHODS = ("projected-multigrid", "minimum-map-newton")  # that solve problems of several ranks


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
    check_shared(scene, ranks, [], METHODS)
    part = part_of(scene, ranks, device, smoothing=scene.pressure.smoothing)
    solids = placed_solids(scene, folder)
    bodies, warnings = make_bodies(scene, solids, partial(RigidBodies, ranks=ranks)), list[str]()

    def make_parts(part: Subdomain) -> Parts:
        boundary, warnings[:] = boundary_of_part(scene, part, solids)
        sources = make_sources(scene, part.grid, boundary, folder)
        return Parts(boundary, sources, make_narrow_band(scene, part.grid, boundary, folder))

    parts = make_parts(part)
    particles, notes = particles_of_part(scene, part, parts, folder)
    return DistributedLiquid(
        scene, part.grid, parts, particles, make_parts=make_parts, solids=solids, bodies=bodies,
        outlets=make_outlets(scene, part.grid, folder), notes=[*warnings, *notes],
    )  # fmt: skip
