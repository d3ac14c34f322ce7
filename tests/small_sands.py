"""Scenes of a small amount of sand, and functions to run them."""

from pathlib import Path
from typing import Any

import stepping
from scene_tables import box
from warp_lcp.granular import SIMULATOR
from warp_lcp.granular.scene import SandScene
from warp_lcp.granular.simulator import SandSimulation

GRAVITY = 9.81


def scene(
    *, size: list[float], resolution: int, sand: list[dict[str, Any]], **tables: Any
) -> SandScene:
    """Return a scene.

    `friction` (not a table), `solids`, `open`, `periodic` are of the domain, `cfl` is time.cfl, the
    rest are tables.
    """
    of_domain = ("friction", "solids", "open", "periodic")
    domain = {
        key: tables.pop(key)
        for key in of_domain
        if key in tables and not isinstance(tables[key], dict)
    }
    data: dict[str, Any] = {
        "scene": {"simulator": "granular"},
        "time": {"duration": 10.0, "cfl": tables.pop("cfl", 0.8)},
        "domain": {"size": size, "resolution": resolution, **domain},
        "sand": sand,
    }
    return SandScene.model_validate(data | tables)


def create(model: SandScene, device: str = "cpu") -> SandSimulation:
    """Return a simulation."""
    return SIMULATOR.create(model, device=device, folder=Path())


def column(dimension: int = 2, device: str = "cpu", **tables: Any) -> SandSimulation:
    """Return a small column that collapses."""
    size, high = [1.0, 0.5, 0.25], [0.375, 0.375, 0.25]
    sand = [box([0.0] * dimension, high[:dimension])]
    return create(scene(size=size[:dimension], resolution=16, sand=sand, **tables), device=device)


def advance(simulation: SandSimulation, until: float, dt_max: float = 5e-3) -> list[dict[str, Any]]:
    """Step to a time and return the rows of the log."""
    return stepping.advance(simulation, until, dt_max)
