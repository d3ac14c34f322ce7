"""Random small scenes of liquid or sand, with about half of all models each."""

from __future__ import annotations

import random
from typing import Any

from warp_lcp.scene.scene import Scene
from warp_lcp.scene.simulator import simulators
from warp_lcp.scene.table import SceneError, validate

LIQUID_METHODS = ["projected-multigrid"] * 6 + [
    "minimum-map-newton",
    "primal-dual-active-set",
    "mprgp",
    "nncg",
    "psor",
    "projected-jacobi",
]
Tables = dict[str, Any]


def drawn(seed: int) -> Scene:
    """Return the scene of a seed.

    It is drawn again until the rules of scenes allow it.
    """
    rng = random.Random(seed)
    while True:
        tables = _tables(rng)
        try:
            return validate(
                simulators()[tables["scene"]["simulator"]].scene_model, tables, f"drawn({seed})"
            )
        except SceneError:
            continue


def _tables(rng: random.Random) -> Tables:
    liquid, dimension = rng.random() < 0.6, 3 if rng.random() < 0.25 else 2
    size = [1.0, 0.8, 0.6][:dimension]
    data: Tables = {
        "scene": {"simulator": "fluids" if liquid else "granular", "name": "drawn"},
        "time": {"duration": 5.0, "frames_per_second": rng.choice([20, 60])},
        "domain": {"size": size, "resolution": 10 if dimension == 3 else rng.choice([20, 25])},
        "output": {
            "surface": _half(rng),
            "volume": dimension == 3 and _half(rng),
            "diagnostics": _half(rng),
        },
        "particles": {"transfer": rng.choice(["apic", "apic", "flip", "pic"])},
    }
    domain = data["domain"]
    domain["wall"] = rng.choice(["separating", "free-slip"]) if liquid else "separating"
    if _half(rng, 0.3):
        domain["open"] = rng.sample(["left", "right", "top", "bottom"], rng.choice([1, 2]))
    if _half(rng):
        data["density_correction"] = {"every": rng.choice([1, 2, 3])}
    if _half(rng, 0.3):
        data["particles"]["reseed"] = {"every": rng.choice([1, 2, 3])}
    if _half(rng, 0.3):
        data["source"] = [_source(rng, dimension)]
    if _half(rng, 0.3):
        low = [rng.uniform(0.0, 0.7), *[0.0] * (dimension - 1)]
        data["drain"] = [
            _box(low, [low[0] + 0.2, 0.1, 0.6][:dimension])
            | {"start": rng.choice([0.0, 0.05, 0.12])}
        ]
    data["solid"] = _solids(rng, dimension, bodies=_half(rng), sand=not liquid)
    if not any("motion" in solid or "density" in solid for solid in data["solid"]):
        domain["solids"] = rng.choice(["cut-cell", "voxel"])
    material = [
        _box([0.0] * dimension, [rng.uniform(0.3, 1.0), rng.uniform(0.3, 0.6), 0.6][:dimension])
    ]
    if _half(rng, 0.4):
        velocity = [rng.uniform(-2.0, 2.0) for _ in range(dimension)]
        material.append(
            _box([0.3, 0.55, 0.1][:dimension], [0.6, 0.75, 0.5][:dimension])
            | {"velocity": velocity}
        )
    (_liquid if liquid else _sand)(rng, data, material, dimension)
    if liquid:
        _forces(rng, data, dimension)
    return data


def _liquid(rng: random.Random, data: Tables, material: list[Tables], dimension: int) -> None:
    data["liquid"] = material
    data["pressure"] = {
        "surface": rng.choice(["ghost-fluid", "ghost-fluid", "voxel"]),
        "smoothing": rng.choice([0, 0, 1, 3]),
    }
    if _half(rng, 0.25):
        data["pressure"] = {"model": "unilateral"}
    elif _half(rng, 0.6):
        data["particles"]["narrow_band"] = {"width": rng.choice([3.0, 4.0, 4.5])}
        data["pressure"]["surface"] = "ghost-fluid"
        material[0]["max"][:2] = [rng.uniform(0.7, 1.0), rng.uniform(0.5, 0.65)]
        if dimension == 2:
            data["domain"]["resolution"] = rng.choice([35, 40])
    data["solver"] = {
        "method": rng.choice(LIQUID_METHODS),
        "max_iterations": 20000,
        "precision": rng.choice(["mixed", "single", "double"]),
    }
    if _half(rng, 0.2):
        data["solver"]["tolerance"] = "auto"
    data["time"]["cfl"] = rng.choice([0.4, 1.0, 2.0, 3.0])


def _forces(rng: random.Random, data: Tables, dimension: int) -> None:
    """Add forces on the liquid, and measurements."""
    if _half(rng, 0.4):
        data["viscosity"] = {
            "value": 10.0 ** rng.uniform(-3.0, 4.0),
            "slip_length": rng.choice([0.0, 0.05]),
        }
        if _half(rng, 0.4):
            data["liquid"][-1]["viscosity"] = 10.0 ** rng.uniform(-3.0, 4.0)
        if _half(rng):
            data["domain"]["wall"] = "sticky"
    if _half(rng, 0.3):
        data["surface_tension"] = {
            "coefficient": rng.choice([0.07, 2.0]),
            "contact_angle": rng.choice([60.0, 90.0, 120.0]),
        }
    if _half(rng, 0.3):
        data["wall_drag"] = {"coefficient": rng.choice([0.005, 0.5])}
    if _half(rng, 0.3):
        data["output"]["forces"] = True
        data["probe"] = [
            {"name": what, "position": [0.4, 0.2, 0.3][:dimension], "quantity": what}
            for what in ("pressure", "level")
        ]


def _sand(rng: random.Random, data: Tables, material: list[Tables], dimension: int) -> None:
    data["sand"] = material
    data["solver"] = {
        "max_iterations": 60,
        "method": rng.choice(["accelerated-projection"] * 3 + ["interleaved-sweeps"]),
    }
    data["material"] = {"cohesion": rng.choice([0.0, 0.0, 50.0])}
    if _half(rng, 0.4):
        data["friction"] = {"dynamic_angle": 40.0, "grain_size": 1e-3}
    elif _half(rng, 0.2):
        data["friction"] = {"model": "box"}
    data["domain"]["friction"] = rng.choice([0.0, 0.4, "stick"])
    if _half(rng, 0.2) and "open" not in data["domain"]:
        data["domain"]["periodic"] = [True, False, False][:dimension]
    if _half(rng, 0.3):
        data["gauge"] = {"height": 0.2}


def _solids(rng: random.Random, dimension: int, *, bodies: bool, sand: bool) -> list[Tables]:
    """Return up to one fixed solid, one moving solid and two bodies, separate."""
    solids: list[Tables] = []
    if _half(rng):
        solids.append(_ball([0.15, 0.2], 0.1, dimension))
    if _half(rng, 0.6):
        velocity, center = (
            [rng.uniform(-0.5, 0.5), rng.uniform(0.0, 0.3), 0.0][:dimension],
            [0.5, 0.3, 0.3][:dimension],
        )
        motions: list[Tables] = [
            {
                "kind": "translation",
                "velocity": velocity,
                "start": rng.choice([0.0, 0.06]),
                "stop": rng.choice([0.1, 9.0]),
            },
            {
                "kind": "rotation",
                "rate": rng.uniform(-300.0, 300.0),
                "center": center,
                **({"axis": [0, 0, 1]} if dimension == 3 else {}),
            },
            {"kind": "sinusoid", "period": 0.4, "amplitude": [0.06, 0.03, 0.02][:dimension]},
            {
                "kind": "keyframes",
                "times": [0.0, 0.05, 0.2],
                "translate": [[0.0] * dimension, [0.04] * dimension, [0.0] * dimension],
            },
        ]
        low, high = [c - 0.1 for c in center], [c + 0.1 for c in center]
        shape = rng.choice([_ball([0.5, 0.3], 0.12, dimension), _box(low, high)])
        solids.append(shape | {"motion": rng.choice(motions)})
    if bodies:
        for x in rng.sample([0.2, 0.85], rng.choice([1, 2])):
            y = rng.choice([0.12, 0.45, 0.68]) if x == 0.85 else 0.68
            shape = rng.choice(
                [
                    _ball([x, y], 0.09, dimension),
                    _box(
                        [x - 0.07, y - 0.08, 0.2][:dimension], [x + 0.07, y + 0.08, 0.4][:dimension]
                    ),
                ]
            )
            velocity = [rng.uniform(-1.0, 1.0), 0.0, 0.0][:dimension]
            solids.append(
                shape
                | {
                    "density": rng.choice([200.0, 900.0, 3000.0]),
                    "restitution": rng.choice([0.0, 0.5]),
                    "velocity": velocity,
                }
            )
    for solid in solids:
        if sand and _half(rng, 0.3):
            solid["friction"] = rng.choice([0.2, "stick"])
        elif not sand and _half(rng, 0.3):
            solid["wall"] = rng.choice(["separating", "free-slip"])
    return solids


def _source(rng: random.Random, dimension: int) -> Tables:
    stop = {"stop": rng.choice([0.06, 0.13])} if _half(rng) else {}
    velocity = [rng.uniform(0.5, 2.0), 0.0, 0.0][:dimension]
    return (
        _box([0.0, 0.6, 0.2][:dimension], [0.1, 0.7, 0.4][:dimension])
        | {"velocity": velocity, "start": rng.choice([0.0, 0.04])}
        | stop
    )


def _half(rng: random.Random, share: float = 0.5) -> bool:
    return rng.random() < share


def _box(low: list[float], high: list[float]) -> Tables:
    return {"shape": "box", "min": low, "max": high}


def _ball(center: list[float], radius: float, dimension: int) -> Tables:
    return {"shape": "sphere", "center": [*center, 0.3][:dimension], "radius": radius}
