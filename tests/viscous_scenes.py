"""Random scenes of viscous liquid at solids of any shape.

Their walls are no-slip, separating or free-slip.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from small_liquids import box, scene
from warp_lcp.fluids import LiquidScene


def viscous_scene(seed: int) -> LiquidScene:
    """Return the scene of a seed: a unit square or cube with a block or two.

    It may have a source, and up to three solids in its middle.
    """
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
            found |= {
                "min": (middle - corner(0.05, 0.25)).tolist(),
                "max": (middle + corner(0.05, 0.25)).tolist(),
            }
        elif kind == "capsule":
            found |= {
                "from": middle.tolist(),
                "to": (middle + corner(-0.2, 0.2)).tolist(),
                "radius": 0.4 * size,
            }
        else:
            angles = rng.uniform(-180.0, 180.0, 3).tolist()
            name = "builtin:" + str(rng.choice(["torus", "knot"]))
            found |= {
                "file": name,
                "scale": 3.0 * size,
                "rotate": angles,
                "translate": middle.tolist(),
            }
        if found["wall"] == "sticky" and some(0.4):
            found["slip_length"] = float(10.0 ** rng.uniform(-3.0, 0.0))
        return found

    blocks = []
    for _ in range(int(rng.integers(1, 3))):
        low = corner(0.0, 0.5)
        blocks.append(box(low.tolist(), np.minimum(low + corner(0.2, 0.6), 1.0).tolist()))
    tables: dict[str, Any] = {
        "viscosity": {"value": float(10.0 ** rng.uniform(-3.0, 5.0))},
        "wall": str(rng.choice(walls)),
    }
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
    return scene(
        size=[1.0] * dimension,
        resolution=resolution,
        liquid=blocks,
        cfl=float(rng.uniform(0.5, 4.0)),
        **tables,
    )


def stirred_scene(seed: int) -> LiquidScene:
    """Return the scene of a seed: a square or cube with several viscosities.

    With solids that turn or swing, bodies, and a source.
    """
    rng = np.random.default_rng(seed)
    dimension = int(rng.choice([2, 2, 3]))
    resolution = int(rng.integers(16, 41) if dimension == 2 else rng.integers(10, 17))

    def corner(low: float, high: float) -> np.ndarray:
        return rng.uniform(low, high, dimension)

    def some(share: float) -> bool:
        return bool(rng.random() < share)

    def slip() -> dict[str, Any]:
        return {"slip_length": float(10.0 ** rng.uniform(-3.0, 0.0))} if some(0.6) else {}

    def solid(number: int, count: int) -> dict[str, Any]:
        middle, size = corner(0.25, 0.75), float(rng.uniform(0.1, 0.4)) / (1 + count)
        middle[0] = (1 + number) / (1 + count)  # apart from each other, however they turn
        round_one = {"shape": "sphere", "center": middle.tolist(), "radius": size}
        half = size * corner(0.3, 0.6)
        found: dict[str, Any] = (
            round_one if some(0.4) else box((middle - half).tolist(), (middle + half).tolist())
        )
        kind = str(rng.choice(["rotation", "sinusoid", "body", "body"]))
        if kind == "rotation":
            axis = {"axis": rng.standard_normal(3).tolist()} if dimension == 3 else {}
            found["motion"] = {
                "kind": kind,
                "center": middle.tolist(),
                "rate": float(rng.uniform(-600.0, 600.0)),
                **axis,
            }
        elif kind == "sinusoid":
            found["motion"] = {
                "kind": kind,
                "period": float(rng.uniform(0.1, 0.5)),
                "amplitude": (0.05 * corner(-1.0, 1.0)).tolist(),
            }
        else:
            turning = float(rng.uniform(-600.0, 600.0))
            found |= {"density": float(10.0 ** rng.uniform(1.5, 4.0))}
            found["angular_velocity"] = turning if dimension == 2 else [turning, 0.0, 0.5 * turning]
        return found | {"wall": str(rng.choice(["sticky", "sticky", "separating"]))} | slip()

    blocks = []
    for _ in range(int(rng.integers(1, 4))):
        low = corner(0.0, 0.7)
        own = {"viscosity": float(10.0 ** rng.uniform(-2.0, 4.0))} if some(0.5) else {}
        blocks.append(box(low.tolist(), np.minimum(low + corner(0.1, 0.5), 1.0).tolist(), **own))
    tables: dict[str, Any] = {"wall": str(rng.choice(["sticky", "separating"]))}
    tables["viscosity"] = {"value": float(10.0 ** rng.uniform(-2.0, 4.0)), **slip()}
    if some(0.5):
        low, velocity = corner(0.1, 0.6), [0.0, -float(rng.uniform(0.3, 2.0)), 0.0][:dimension]
        low[1] = 0.9
        high = low + corner(0.1, 0.3)
        high[1] = 1.0
        tables["source"] = [box(low.tolist(), high.tolist(), velocity=velocity)]
    count = int(rng.integers(1, 4))
    tables["solid"] = [solid(number, count) for number in range(count)]
    return scene(
        size=[1.0] * dimension,
        resolution=resolution,
        liquid=blocks,
        cfl=float(rng.uniform(0.5, 4.0)),
        **tables,
    )


def hanging_thread(seed: int) -> LiquidScene:
    """Return the scene of a seed: a thick thread that hangs from a sticky ceiling.

    It is 2 to 5 cells wide, and in most scenes tilted. The splitting tolerance is 0.1 %, 5 % or
    100 %.
    """
    rng = np.random.default_rng(seed)
    dimension = int(rng.choice([2, 3]))
    resolution = 24 if dimension == 2 else 16
    width, length = rng.uniform(2.0, 5.0) / resolution, rng.uniform(0.3, 0.5)
    middle = 0.5 + rng.uniform(-0.5, 0.5, dimension) / resolution
    low, high = middle - 0.5 * width, middle + 0.5 * width
    low[1], high[1] = 1.0 - length, 1.3
    tilt = float(rng.uniform(-20.0, 20.0))
    value = float(10.0 ** rng.uniform(3.0, 5.0))
    turn: dict[str, Any] = {}
    if rng.random() < 0.7:
        angles = tilt if dimension == 2 else [float(rng.uniform(-20.0, 20.0)), 0.0, tilt]
        turn = {
            "rotate": angles,
            "about": np.where(np.arange(dimension) == 1, 1.0, middle).tolist(),
        }
    share = [1e-3, 0.05, 1.0][int(rng.integers(3))]
    return scene(
        size=[1.0] * dimension,
        resolution=resolution,
        wall="sticky",
        liquid=[box(low.tolist(), high.tolist(), **turn)],
        viscosity={"value": value, "splitting_tolerance": share},
    )


def coupled_scene(seed: int) -> LiquidScene:
    """Return a scene of `viscous_scene` or `stirred_scene` with coupled solves.

    Steps with splitting errors above 5 %, or 0.1 %, are solved at once.
    """
    drawn = stirred_scene(seed) if seed % 2 else viscous_scene(seed)
    assert drawn.viscosity is not None
    share = 0.05 if seed % 4 < 2 else 1e-3
    viscosity = drawn.viscosity.model_copy(update={"splitting_tolerance": share})
    return drawn.model_copy(update={"viscosity": viscosity})
