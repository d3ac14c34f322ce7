"""Scenes by seed that together have every table, every shape and every motion.

They have thin and thick solids, and sides from 1 mm to 1 km.
"""

from __future__ import annotations

import math
import random
from typing import Any

Tables = dict[str, Any]

SIDES = (1e-3, 0.02, 1.0, 30.0, 1e3)  # of the domain [m]
SHAPES = ("box", "sphere", "capsule", "plane", "mesh")
MOTIONS = ("translation", "rotation", "sinusoid", "keyframes")
GRAVITY = 9.81


class SceneDraw:
    """Draw one scene.

    Lengths are in units of the domain's longest side, times in those of a fall through it.

    Args:
        seed: seed of the scene; consecutive seeds cycle through sides, dimensions, materials
            and shapes.
    """

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self.side = SIDES[seed % len(SIDES)]
        self.liquid = seed % 2 == 0
        self.dimension = 3 if seed % 4 in (1, 2) else 2
        self.thin = seed % 3 == 0
        self.turn = seed
        self.fall = math.sqrt(self.side / GRAVITY)  # [s]
        self.speed = math.sqrt(self.side * GRAVITY)  # [m/s]

    def point(self, *coordinates: float) -> list[float]:
        """Return a point or a shift [m] with the coordinates of the scene.

        By default z is in the middle.
        """
        return [self.side * c for c in (*coordinates, 0.3)[: self.dimension]]

    def velocity(self, *parts: float) -> list[float]:
        """Return a velocity [m/s]."""
        return [self.speed * c for c in (*parts, 0.0)[: self.dimension]]

    def shape(self, kind: str, x: float, y: float, size: float, *, thin: bool = False) -> Tables:
        """Return a shape about a point.

        A thin one is a fifth of a cell thick, if its kind has a thickness.
        """
        thick = 0.01 if thin else size
        if kind == "box":
            low, high = (
                self.point(x - thick, y - size, 0.3 - size),
                self.point(x + thick, y + size, 0.3 + size),
            )
            return {"shape": "box", "min": low, "max": high}
        if kind == "sphere":
            return {"shape": "sphere", "center": self.point(x, y), "radius": self.side * size}
        if kind == "capsule":
            ends = self.point(x - 0.5 * size, y), self.point(x + 0.5 * size, y)
            return {"shape": "capsule", "from": ends[0], "to": ends[1], "radius": self.side * thick}
        if kind == "plane":
            return {
                "shape": "plane",
                "point": self.point(x, y),
                "normal": self.point(0.1, 1.0, 0.0),
            }
        z = [0.3] if self.dimension == 3 else []
        return {
            "shape": "mesh",
            "file": "builtin:torus",
            "scale": 2.0 * self.side * size,
            "translate": self.point(x, y, *z),
        }

    def motion(self, kind: str) -> Tables:
        """Return a motion about (0.5, 0.3)."""
        axis = {"axis": [0.0, 0.0, 1.0]} if self.dimension == 3 else {}
        zero, moved = [0.0] * self.dimension, self.point(0.02, 0.01, 0.0)
        motions: dict[str, Tables] = {
            "translation": {
                "velocity": self.velocity(0.2, 0.1),
                "start": 0.1 * self.fall,
                "stop": 0.3 * self.fall,
            },
            "rotation": {"rate": 90.0 / self.fall, "center": self.point(0.5, 0.3), **axis},
            "sinusoid": {
                "period": self.fall,
                "amplitude": moved,
                "angle": 10.0,
                "center": self.point(0.5, 0.3),
                "phase": -90.0,
                **axis,
            },
            "keyframes": {
                "times": [0.0, 0.2 * self.fall, self.fall],
                "translate": [zero, moved, zero],
                "interpolation": "smooth",
            },
        }
        return {"kind": kind, **motions[kind]}


def scene_of_every_table(seed: int) -> Tables:
    """Return the tables of a valid scene file."""
    draw = SceneDraw(seed)
    rng, side, fall = draw.rng, draw.side, draw.fall
    data: Tables = {
        "scene": {
            "simulator": "fluids" if draw.liquid else "granular",
            "name": f"drawn-{seed}",
            "description": "drawn",
        },
        "time": {
            "duration": 0.3 * fall,
            "frames_per_second": 10.0 / fall,
            "dt_max": 0.05 * fall,
            "dt_min": 1e-6 * fall,
        },
        "domain": {
            "size": [side * share for share in (1.0, 0.8, 0.6)[: draw.dimension]],
            "resolution": 10 if draw.dimension == 3 else 20,
            "open": rng.choice([[], ["top"], ["right", "top"]]),
            "follow": rng.random() < 0.5,
        },
        "physics": {"gravity": [0.0, -GRAVITY, 0.0][: draw.dimension]},
        "output": {
            "surface": rng.random() < 0.6,
            "surface_ply": rng.random() < 0.3,
            "grid_format": rng.choice(["vtu", "vti"]),
            "volume": draw.dimension == 3,
            "volume_format": rng.choice(["nvdb", "vdb"]) if draw.dimension == 3 else "nvdb",
            "ids": True,
            "checkpoint_every": 2,
            "checkpoint_minutes": 5.0,
        },
        "particles": {
            "transfer": rng.choice(["apic", "flip", "pic"]),
            "per_axis": rng.choice([2, 3]),
            "reseed": {"every": 2},
        },
        "density_correction": {"every": 1},
        "source": [_source(draw)],
        "drain": [draw.shape(_turn(draw, SHAPES[:3], 2), 0.92, 0.1, 0.07) | {"start": 0.05 * fall}],
        "solid": _solids(draw),
    }
    if draw.dimension == 3:
        data["camera"] = {
            "position": draw.point(3.0, 1.0, 3.0),
            "look_at": draw.point(0.5, 0.3, 0.3),
            "field_of_view": 30.0,
        }
    else:
        data["camera"] = {"min": draw.point(0.0, 0.0), "max": draw.point(1.0, 0.6)}
    kind = _turn(draw, SHAPES, 3)
    splash = draw.shape(kind, 0.45, 0.36 if kind == "plane" else 0.6, 0.1) | {
        "velocity": draw.velocity(0.3, -0.3)
    }
    material = [
        {"shape": "box", "min": [0.0] * draw.dimension, "max": draw.point(1.0, 0.3, 0.6)},
        splash,
    ]
    (_liquid if draw.liquid else _sand)(draw, data, material)
    return data


def _turn(draw: SceneDraw, values: tuple[str, ...], step: int) -> str:
    """Return one of some values, by the seed.

    Combinations change from one round of seeds to the next.
    """
    return values[(draw.turn // 2 + draw.turn // 10 * step) % len(values)]


def _source(draw: SceneDraw) -> Tables:
    schedule = {"start": 0.02 * draw.fall, "stop": 0.2 * draw.fall}
    return (
        draw.shape(_turn(draw, SHAPES[:3], 1), 0.14, 0.66, 0.1)
        | {"velocity": draw.velocity(0.5, -0.2)}
        | schedule
    )


def _solids(draw: SceneDraw) -> list[Tables]:
    """Return a fixed solid, a moving one and a rigid body, separate."""
    rng = draw.rng
    kind = _turn(draw, SHAPES, 1)
    standing = draw.shape(kind, 0.2, 0.02 if kind == "plane" else 0.2, 0.08, thin=draw.thin)
    if kind != "plane" and rng.random() < 0.5:
        # A mesh is rotated before it is moved.
        about = {} if kind == "mesh" else {"about": draw.point(0.2, 0.2)}
        standing |= {"rotate": 20.0 if draw.dimension == 2 else [0.0, 0.0, 20.0], **about}
    moving = draw.shape(_turn(draw, SHAPES[:3], 1), 0.5, 0.3, 0.08, thin=draw.thin) | {
        "motion": draw.motion(_turn(draw, MOTIONS, 1))
    }
    spin = 90.0 / draw.fall
    weight = (
        {"density": rng.choice([300.0, 3000.0])}
        if rng.random() < 0.7
        else {"mass": 300.0 * (0.1 * draw.side) ** draw.dimension}
    )
    body = (
        draw.shape(_turn(draw, SHAPES[:3], 3), 0.8, 0.5, 0.07, thin=draw.thin)
        | weight
        | {
            "velocity": draw.velocity(-0.1, -0.2),
            "angular_velocity": spin if draw.dimension == 2 else [0.0, 0.0, spin],
            "restitution": 0.3,
            "friction": 0.4,
        }
    )
    return [standing, moving, body]


def _liquid(draw: SceneDraw, data: Tables, material: list[Tables]) -> None:
    """Add the tables of a liquid.

    Its band, its unilateral pressure and its tension exclude each other.
    """
    rng, weight = draw.rng, data["physics"].setdefault("density", 1000.0) * GRAVITY * draw.side
    data["liquid"] = material
    choice = draw.turn // 2 % 3
    data["pressure"] = (
        {"model": "unilateral"}
        if choice == 0
        else {"surface": "ghost-fluid", "smoothing": rng.choice([0, 1])}
    )
    if choice == 1:
        data["surface_tension"] = {
            "coefficient": 1e-3 * weight * draw.side,
            "contact_angle": rng.choice([60.0, 120.0]),
        }
        data["liquid"][1]["viscosity"] = data["source"][0]["viscosity"] = 1e-3 * weight * draw.fall
    if choice == 2:
        data["particles"]["narrow_band"] = {"width": 3.0}
    data["viscosity"] = {
        "value": 1e-4 * weight * draw.fall,
        "slip_length": rng.choice([0.0, 0.1 * draw.side]),
    }
    data["domain"]["wall"] = rng.choice(["separating", "free-slip", "sticky"])
    data["solid"][0] |= {"wall": "sticky", "slip_length": 0.01 * draw.side, "drag": 0.01}
    data["wall_drag"] = {"coefficient": 0.005, "domain": 0.003}
    data["whitewater"] = {
        "length": 0.1 * draw.side,
        "speed": [0.0, 0.3 * draw.side / draw.fall],
        "trapped_air": [0.0, 0.1 * draw.side / draw.fall],
        "max_particles": 500,
    }
    data["solver"] = {
        "method": rng.choice(["projected-multigrid", "minimum-map-newton"]),
        "tolerance": rng.choice([1e-4, "auto"]),
    }
    data["output"]["forces"] = True
    names = ["pressure", "velocity", "level"]
    data["probe"] = [
        {"name": f"at_{name}", "position": draw.point(0.6, 0.15), "quantity": name}
        for name in names
    ]
    if draw.turn // 2 % 4 == 2:
        data["solid"].pop()  # problems with bodies are not recorded
    if draw.turn // 2 % 5 == 4:  # nothing falls, and no probe has a level
        data["physics"]["gravity"] = [0.0] * draw.dimension
        data["probe"].pop()


def _sand(draw: SceneDraw, data: Tables, material: list[Tables]) -> None:
    """Add the tables of sand.

    Every fourth is a periodic layer, which excludes many models.
    """
    rng = draw.rng
    data["sand"] = material
    weight = 1600.0 * GRAVITY * draw.side
    data["material"] = {
        "name": rng.choice(["dry-sand", "gravel", "sugar"]),
        "cohesion": rng.choice([0.0, 0.02 * weight]),
    }
    data["friction"] = (
        {"dynamic_angle": 43.0, "grain_size": 1e-3 * draw.side}
        if draw.turn // 2 % 2
        else {"model": "box"}
    )
    data["domain"]["friction"] = rng.choice([0.0, 0.4, "stick"])
    data["gauge"] = {"height": 0.2 * draw.side}
    data["solver"] = {"max_iterations": 200, "method": "accelerated-projection"}
    if draw.turn // 2 % 4 == 3:
        for key in ("source", "drain"):
            del data[key]
        del data["particles"]["reseed"]
        data["domain"] |= {"open": [], "periodic": [True, False, False][: draw.dimension]}
        data["solid"].pop()
        for plane in (
            shape for shape in (*data["solid"], *data["sand"]) if shape["shape"] == "plane"
        ):
            plane["normal"] = draw.point(0.0, 1.0, 0.0)
