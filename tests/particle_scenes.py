"""Built-in scenes of particle materials, without those of rigid bodies alone."""

import functools

from warp_lcp.material.particle_scene import ParticleScene
from warp_lcp.scene.scene_file import built_in_scenes, load_scene


@functools.cache
def particle_scenes() -> list[str]:
    """Return the names of the scenes."""
    return [name for name in built_in_scenes() if isinstance(load_scene(name), ParticleScene)]


# Scenes of more than three seconds, otherwise like shorter ones.
LONG = ("honey-coil", "hourglass", "column-collapse", "paint-pour")


def stepped_by_default() -> list[str]:
    """Return the scenes whose steps are compared on different numbers of threads by default.

    They are every second scene, without long ones.
    """
    return [name for name in particle_scenes()[::2] if name not in LONG]
