"""The start of sand on ranks."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from warp_lcp.distributed.particle_assembly import check_shared, part_of, particles_of_part
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.distributed.solids import boundary_of_part
from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.granular.distributed.simulation import DistributedSand
from warp_lcp.granular.scene import SandScene
from warp_lcp.granular.solids import SandSolids
from warp_lcp.material.particle_assembly import Parts, make_bodies, make_outlets, make_sources, placed_solids
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.scene.scene import Scene

METHODS = ("accelerated-projection",)  # that solve problems of several ranks


def create(scene: Scene, ranks: Ranks, *, device: str, folder: Path) -> DistributedSand:
    """Build this rank's part of a simulation of `scene`; collective.

    Args:
        scene: a SandScene, the same on all ranks.
        ranks: who share it.
        device: a Warp device's name.
        folder: where the files are that the scene names.

    Raises:
        ValueError: the scene cannot be simulated, or not on ranks; the message names the key and what is allowed. On all ranks.
    """
    if not isinstance(scene, SandScene):
        raise ValueError("scene.simulator: granular needs a scene of sand")
    check_shared(scene, ranks, refusals(scene), METHODS)
    part = part_of(scene, ranks, device)
    placed = placed_solids(scene, folder)
    bodies, warnings = make_bodies(scene, placed, partial(RigidBodies, ranks=ranks)), list[str]()

    def make_parts(part: Subdomain) -> Parts:
        boundary, notes = boundary_of_part(scene, part, placed)
        solids = SandSolids(part.grid, placed, boundary, scene.wall_frictions(), prescribed=bool(scene.source), cuts=True)
        warnings[:] = [*notes, *solids.notes]
        return Parts(boundary, make_sources(scene, part.grid, boundary, folder), solids=solids)

    parts = make_parts(part)
    particles, notes = particles_of_part(scene, part, parts, folder)
    outlets = make_outlets(scene, part.grid, folder)
    return DistributedSand(
        scene, part.grid, parts, particles, make_parts=make_parts, bodies=bodies, outlets=outlets, notes=[*warnings, *notes]
    )  # fmt: skip


def refusals(scene: SandScene) -> list[str]:
    """Return the keys of a scene that ask for what runs on ranks have not."""
    shown = [key for key in ("surface", "volume") if scene.endless and getattr(scene.output, key)]
    return [f"output.{key} where an axis is periodic" for key in shown]  # they end at sides that ranks do not have
