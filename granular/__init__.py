"""Sand that flows and comes to rest. This version holds only its name: scenes of sand are refused."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

from warp_lcp.driver.scene import Scene


class GranularSimulator:
    """The plug-in for sand, not available yet."""

    name = "granular"
    summary = "sand that flows and comes to rest (not available yet)"
    scene_model = Scene

    def create(self, scene: Scene, *, device: str, folder: Path) -> NoReturn:
        """Refuse.

        Raises:
            ValueError: always.
        """
        raise ValueError("granular is not available yet in this version")


SIMULATOR = GranularSimulator()
