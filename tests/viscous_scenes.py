"""Scenes of thick liquid drawn at random: it meets solids of any shape, whose walls hold it, let it go or let it slip."""

from __future__ import annotations

from typing import Any

import numpy as np

from small_liquids import box, scene
from warp_lcp.fluids import LiquidScene


def viscous_scene(seed: int) -> LiquidScene:
    """Return the scene of a seed: a unit square or cube with a block or two, maybe a source, and up to three solids in its middle."""
    rng = np.random.default_rng(seed)
    dimension = int(rng.choice([2, 3, 3]))
    resolution = int(rng.integers(24, 65) if dimension == 2 else rng.integers(14, 29))
    walls = ["sticky", "free-slip", "separating"]

    def corner(low: float, high: float) -> np.ndarray:
        return rng.uniform(low, high, dimension)

    def some(share: float) -> bool:
        return bool(rng.random() < share)

    def solid() -> dict[str, Any]:
        middle, size = corner(0.3, 0.7), rng.uniform(0.1, 0.25)
        kinds = ["sphere", "box", "capsule"] + ["mesh"] * 3 * (dimension == 3)
        kind = str(rng.choice(kinds))
        found: dict[str, Any] = {"shape": kind, "wall": str(rng.choice(walls))}
        if kind == "sphere":
            found |= {"center": middle.tolist(), "radius": size}
        elif kind == "box":
            found |= {"min": (middle - corner(0.05, 0.25)).tolist(), "max": (middle + corner(0.05, 0.25)).tolist()}
        elif kind == "capsule":
            found |= {"from": middle.tolist(), "to": (middle + corner(-0.2, 0.2)).tolist(), "radius": 0.4 * size}
        else:
            angles = rng.uniform(-180.0, 180.0, 3).tolist()
            name = "builtin:" + str(rng.choice(["torus", "knot"]))
            found |= {"file": name, "scale": 3.0 * size, "rotate": angles, "translate": middle.tolist()}
        if found["wall"] == "sticky" and some(0.4):
            found["slip_length"] = float(10.0 ** rng.uniform(-3.0, 0.0))
        return found

    blocks = []
    for _ in range(int(rng.integers(1, 3))):
        low = corner(0.0, 0.5)
        blocks.append(box(low.tolist(), np.minimum(low + corner(0.2, 0.6), 1.0).tolist()))
    tables: dict[str, Any] = {"viscosity": {"value": float(10.0 ** rng.uniform(-3.0, 5.0))}, "wall": str(rng.choice(walls))}
    if some(0.4):
        tables["viscosity"]["slip_length"] = float(10.0 ** rng.uniform(-3.0, 0.0))
    if some(0.5):
        low = corner(0.1, 0.6)
        low[1] = 0.9
        high = low + corner(0.1, 0.3)
        high[1] = 1.0
        velocity = [0.0, -float(rng.uniform(0.3, 2.0)), 0.0][:dimension]
        tables["source"] = [box(low.tolist(), high.tolist(), velocity=velocity)]
    tables["solid"] = [solid() for _ in range(int(rng.integers(0, 4)))]
    return scene(size=[1.0] * dimension, resolution=resolution, liquid=blocks, cfl=float(rng.uniform(0.5, 4.0)), **tables)
