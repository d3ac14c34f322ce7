"""Small built-in scenes: equal bits on any number of threads.

However small the pieces are.
"""

import hashlib
from pathlib import Path

import pytest

import warp_lcp as wl
from default_run import chosen
from particle_scenes import particle_scenes, stepped_by_default
from warp_lcp.kernels import thread_pool as team
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.simulator import simulators

CELLS = {  # scenes that need other sizes
    "jet": 128,
    "mesh-obstacle": 15,
    "retracting-wall": 25,
    "river": 256,
    "stirred-tank": 24,
    "water-labyrinth": 24,
    "waterfall": 32,
    "wave-maker": 30,
}


def digests(name: str, count: int, steps: int) -> list[str]:
    """Return digests of the state after each step."""
    wl.set_threads(count)
    scene = load_scene(name, [f"domain.resolution={CELLS.get(name, 16)}"])
    simulation = simulators()[scene.scene.simulator].create(scene, device="cpu", folder=Path.cwd())
    found = []
    for _ in range(steps):
        simulation.step(min(simulation.stable_dt(), 0.01))
        state = simulation.state()
        found.append(
            hashlib.sha256(
                b"".join(name.encode() + state[name].tobytes() for name in sorted(state))
            ).hexdigest()
        )
    simulation.frame()
    return found


# Scenes that run with each number of threads: a liquid, sand. The others run with 3.
EVERY_COUNT = ("splash-in-circle", "column-collapse-2d")


@pytest.mark.parametrize("name", chosen(particle_scenes(), stepped_by_default()))
def test_a_scene_has_the_same_bits_on_any_number_of_threads(name, monkeypatch):
    for module in ("thread_pool", "launch_graph", "fused_kernel"):
        monkeypatch.setattr(f"warp_lcp.kernels.{module}.CELLS", 100)
    before = wl.get_threads()
    try:
        expected = digests(name, 1, 3)
        for count in (2, 3, 7) if name in EVERY_COUNT else (3,):
            assert digests(name, count, 3) == expected, f"{count} threads"
            assert team.shared_seconds() > 0
    finally:
        wl.set_threads(before)
