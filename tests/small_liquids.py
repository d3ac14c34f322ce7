"""Scenes of a small liquid, and functions to run them."""

from pathlib import Path
from typing import Any

import numpy as np

import stepping
from scene_tables import box
from warp_lcp.fluids import SIMULATOR, LiquidScene, LiquidSimulation

GRAVITY = 9.81


def scene(
    *, size: list[float], resolution: int, liquid: list[dict[str, Any]], **tables: Any
) -> LiquidScene:
    """Return a scene.

    `wall`, `solids` and `cfl` are short for domain.wall, domain.solids and time.cfl; the rest are
    tables.
    """
    data: dict[str, Any] = {
        "scene": {"simulator": "fluids"},
        "time": {"duration": 10.0, "cfl": tables.pop("cfl", 2.0)},
        "domain": {
            "size": size,
            "resolution": resolution,
            "wall": tables.pop("wall", "separating"),
            "solids": tables.pop("solids", "cut-cell"),
        },
        "liquid": liquid,
    }
    return LiquidScene.model_validate(data | tables)


def create(
    model: LiquidScene, wall_velocity: np.ndarray | None = None, device: str = "cpu"
) -> LiquidSimulation:
    """Return a simulation."""
    return SIMULATOR.create(model, device=device, folder=Path(), wall_velocity=wall_velocity)


def dam(dimension: int = 2, device: str = "cpu", **tables: Any) -> LiquidSimulation:
    """Return a small dam break."""
    size, low, high = [1.0, 0.5, 0.25], [0.0, 0.0, 0.0], [0.375, 0.375, 0.25]
    liquid = [box(low[:dimension], high[:dimension])]
    return create(
        scene(size=size[:dimension], resolution=16, liquid=liquid, **tables), device=device
    )


def random_tank(seed: int) -> dict[str, Any]:
    """Return the tables of a pool with a few solids in 2-D or 3-D.

    They are whole or cut, separate or overlapping.
    """
    rng = np.random.default_rng(seed)
    dimension = int(rng.integers(2, 4))
    solids: list[dict[str, Any]] = []
    for _ in range(rng.integers(1, 4)):
        center, size = rng.uniform(0.1, 0.7, dimension), rng.uniform(0.06, 0.2)
        solids.append({"shape": "sphere", "center": center.tolist(), "radius": size})
        if rng.random() < 0.5:
            turn = rng.uniform(0.0, 180.0, 1 if dimension == 2 else 3).tolist()
            solids[-1] = box(
                (center - size).tolist(),
                (center + size).tolist(),
                rotate=turn,
                about=center.tolist(),
            )
    top = [0.8, float(rng.uniform(0.35, 0.65)), 0.8][:dimension]
    tables = {
        "solids": str(rng.choice(["voxel", "cut-cell"])),
        "particles": {"seed": seed},
        "solid": solids,
    }
    return {
        "size": [0.8] * dimension,
        "resolution": 20,
        "liquid": [box([0.0] * dimension, top)],
        **tables,
    }


def advance(
    simulation: LiquidSimulation, until: float, dt_max: float = 0.02
) -> list[dict[str, Any]]:
    """Step to a time and return the rows of the log."""
    return stepping.advance(simulation, until, dt_max)
