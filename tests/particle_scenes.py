"""Built-in scenes of particle materials, without those of rigid bodies alone."""

import functools

from warp_lcp.material.particle_scene import ParticleScene
from warp_lcp.scene.scene_file import built_in_scenes, load_scene


@functools.cache
def particle_scenes() -> list[str]:
    """Return the names of the scenes."""
    return [name for name in built_in_scenes() if isinstance(load_scene(name), ParticleScene)]
