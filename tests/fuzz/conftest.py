"""Commands that are fuzzed have compiled their kernels before memory is limited."""

import pytest

from warp_lcp.driver.check import start
from warp_lcp.driver.scene_file import load_scene


@pytest.fixture(autouse=True, scope="session")
def kernels():
    for scene in ("dam-break-2d", "column-collapse-2d", "floating-bodies-2d", "tap-and-drain", "mesh-obstacle"):
        start(load_scene(scene, ["domain.resolution=20"]), "cpu")
