"""Thin solids drawn at random around liquid or sand, and what passes them or loads them.

`PYTHONPATH=. python tests/drawn_thin_walls.py SEED COUNT [names]` runs draws and prints a line
each. Names select: kinds of `KINDS`, `fluids` or `granular`, `2` or `3` dimensions.
"""

from __future__ import annotations

import math
import os
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from scene_tables import box
from warp_lcp.scene.simulator import simulators
from warp_lcp.scene.table import validate

Tables = dict[str, Any]
THICKNESSES = [0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0, 1.28, 1.6, 2.0]  # cells
ANGLES = [0.0, 0.0, 7.0, 15.0, 30.0, 45.0, 60.0, 80.0]  # degrees
OFFSETS = 16  # of a cell
GRAVITY, DENSITY = 9.81, 1000.0
SLACK = 2e-3  # cells by which a particle may seem to be beyond a surface, for rounding
STRIPS = 2.0  # strips per cell that fill a tilted bottle
COUNTS = {2: 32, 3: 16}  # cells of the domain along an axis
Sides = Callable[[np.ndarray, Any], np.ndarray]


@dataclass
class ThinWallScene:
    """A scene, and on which side of its walls a point is.

    Attributes:
        label: what was drawn.
        tables: of the scene.
        side: of points [m], shape (n, 3), in the simulation, int of shape (n,); -1: in a wall.
        until: time to simulate [s].
        weight: of the liquid that the solids bear [N; 2-D: N/m]; None: they do not bear all.
        depth: of liquid at rest [m]; None: it is not at rest.
    """

    label: str
    tables: Tables
    side: Sides
    until: float
    weight: float | None = None
    depth: float | None = None


@dataclass
class ThinWallOutcome:
    """What a draw came to.

    Attributes:
        particles: how many there are.
        passed: how many are on another side than at the start, or in a wall.
        load: that of the solids in the last third, in weights of the liquid; None: not measured.
        density: the largest of the last step, in that at rest.
        failures: solves that did not converge, by status.
        speed: largest of a particle, in units of sqrt(g depth); None: it is not at rest.
    """

    particles: int
    passed: int
    load: float | None
    density: float
    failures: Counter[str] = field(default_factory=Counter)
    speed: float | None = None


def scene(
    simulator: str, dimension: int, material: list[Tables], solid: list[Tables], cfl: float = 2.0
) -> Tables:
    """Return the tables of a scene in a domain of 1 m."""
    tables: Tables = {
        "scene": {"simulator": simulator},
        "time": {"duration": 10.0, "cfl": cfl if simulator == "fluids" else min(cfl, 0.8)},
        "domain": {"size": [1.0] * dimension, "resolution": COUNTS[dimension]},
        "solid": solid,
        "liquid" if simulator == "fluids" else "sand": material,
    }
    if simulator == "fluids":
        tables["output"] = {"forces": True}
    return tables


def turned(points: np.ndarray, angle: float, about: np.ndarray) -> np.ndarray:
    """Return points turned about z by an angle [degrees]."""
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    result = np.array(points, dtype=np.float64)
    x, y = result[..., 0] - about[0], result[..., 1] - about[1]
    result[..., 0], result[..., 1] = about[0] + c * x - s * y, about[1] + s * x + c * y
    return result


def width_at(corners: np.ndarray, y: float) -> tuple[float, float]:
    """Return where a horizontal line enters and leaves a convex polygon."""
    found = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if (a[1] - y) * (b[1] - y) <= 0.0 and a[1] != b[1]:
            found.append(a[0] + (y - a[1]) / (b[1] - a[1]) * (b[0] - a[0]))
    return (min(found), max(found)) if found else (0.0, 0.0)


def filled(
    low: np.ndarray, high: np.ndarray, angle: float, share: float, dx: float, place: Tables
) -> list[Tables]:
    """Return strips that fill a share of a turned box, up to a level surface.

    The strips are boxes that are turned as the box itself is: they fill it up to its walls, and
    their ends are stairs along the surface. A point at (p, q) from the center, in the box's own
    frame, is p sin(angle) + q cos(angle) above the center.
    """
    slopes = np.array([math.sin(math.radians(angle)), math.cos(math.radians(angle))])
    along = int(np.argmax(slopes))
    across = 1 - along
    half = 0.5 * (high - low)[:2]
    ends = np.linspace(-half[across], half[across], round(2.0 * half[across] / dx * STRIPS) + 1)
    middles = 0.5 * (ends[1:] + ends[:-1])
    tops = np.linspace(-half.sum(), half.sum(), 100001)
    reach = np.clip(
        (tops[:, None] - slopes[across] * middles) / slopes[along], -half[along], half[along]
    )
    top = np.searchsorted((reach + half[along]).mean(axis=1), share * 2.0 * half[along])
    strips = []
    for a, b, end in zip(ends[:-1], ends[1:], reach[top], strict=True):
        first, last = low.copy(), high.copy()
        center = 0.5 * (low + high)
        first[across], last[across] = center[across] + a, center[across] + b
        last[along] = center[along] + end
        if end + half[along] > 1.5 * dx:
            strips.append(box(first, last, **place))
    return strips


def volume(boxes: list[Tables]) -> float:
    """Return the volume of boxes that do not overlap [m^3; m^2 in 2-D]."""
    return float(sum(np.prod(np.subtract(one["max"], one["min"])) for one in boxes))


def bottle(
    rng: np.random.Generator, simulator: str, dimension: int, motion: str | None, mesh: bool
) -> ThinWallScene:
    """Draw a closed box, of a solid a side or of a mesh, that rests, is shaken or turns."""
    dx, cfl = 1.0 / COUNTS[dimension], float(rng.choice([2.0, 8.0]))
    thick, angle = float(rng.choice(THICKNESSES)), float(rng.choice(ANGLES))
    offset = rng.integers(0, OFFSETS, dimension) / OFFSETS
    cells = 14.3 if dimension == 2 else 7.3
    low = 0.5 + (offset - 0.5 - cells / 2.0) * dx
    high, center = low + cells * dx, low + cells * dx / 2.0
    where: Tables = {}
    if angle:
        rotation = angle if dimension == 2 else [0.0, 0.0, angle]
        where = {"rotate": rotation, "about": center.tolist()}
    if motion == "shaken":
        amplitude = [0.12, float(rng.choice([0.0, 0.05])), 0.0][:dimension]
        period = float(rng.uniform(0.3, 0.6))
        where["motion"] = {"kind": "sinusoid", "period": period, "amplitude": amplitude}
    elif motion == "turned":
        where["motion"] = {"kind": "rotation", "center": center.tolist()}
        where["motion"] |= {"rate": float(rng.choice([90.0, 360.0]))}
        where["motion"] |= {"axis": [0, 0, 1]} if dimension == 3 else {}
    shell = hollow_box(low, high, thick * dx) if mesh else walls_around(low, high, thick * dx)
    solids = [one | where for one in shell]
    share = 0.6
    if angle and motion is None:
        material = filled(low, high, angle, share, dx, where)
    else:
        top = [high[0], low[1] + share * (high[1] - low[1]), *high[2:]]
        material = [box(low, top, **{k: v for k, v in where.items() if k != "motion"})]

    def side(x: np.ndarray, simulation: Any) -> np.ndarray:
        placed = simulation.boundary.cut.solids[0].motion
        own = x
        if placed is not None:
            pose = placed.pose(simulation.time)
            own = (x - pose.translation) @ pose.rotation
        own = turned(own, -angle, center)[:, :dimension]
        inside = (own > low - SLACK * dx) & (own < high + SLACK * dx)
        return np.asarray(np.where(inside.all(axis=1), 1, -1))

    weight = volume(material) * DENSITY * GRAVITY
    kind = f"{'mesh ' if mesh else ''}bottle {motion or 'at rest'}"
    label = f"{kind} {thick} cells, offset {offset.tolist()}, {angle} degrees, CFL {cfl}"
    tables = scene(simulator, dimension, material, solids, cfl)
    return ThinWallScene(label, tables, side, 0.4, weight if motion is None else None)


def walls_around(low: np.ndarray, high: np.ndarray, thick: float) -> list[Tables]:
    """Return a box for each side of a box."""
    solids = []
    for axis in range(len(low)):
        for upper in (False, True):
            a, b = low - thick, high + thick
            (a if upper else b)[axis] = (high if upper else low)[axis]
            solids.append(box(a, b))
    return solids


def hollow_box(low: np.ndarray, high: np.ndarray, thick: float) -> list[Tables]:
    """Return a box with a cavity as one mesh, in a temporary file."""
    signs = np.array([[i >> a & 1 for a in range(3)] for i in range(8)])
    squares = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    points = np.concatenate(
        [low - thick + signs * (high - low + 2.0 * thick), low + signs * (high - low)]
    )
    lines = ["v " + " ".join(f"{v:.9g}" for v in point) for point in points]
    for n, order in ((0, 1), (8, -1)):  # the cavity's faces look inwards
        for a, b, c, d in squares:
            for face in ((a, b, c), (a, c, d)):
                lines.append("f " + " ".join(str(1 + n + v) for v in face[::order]))
    with tempfile.NamedTemporaryFile("w", suffix=".obj", delete=False) as file:
        file.write("\n".join(lines) + "\n")
    return [{"shape": "mesh", "file": file.name}]


def plate(rng: np.random.Generator, simulator: str, dimension: int) -> ThinWallScene:
    """Draw a plate under a pool, from wall to wall, with another pool below it."""
    dx, thick = 1.0 / COUNTS[dimension], float(rng.choice(THICKNESSES))
    offset, depth = rng.integers(0, OFFSETS) / OFFSETS, 10.0 if dimension == 2 else 5.0
    top = 0.5 + offset * dx
    low, high = np.full(dimension, -0.1), np.full(dimension, 1.1)
    low[1], high[1] = top - thick * dx, top
    a, b, c = np.zeros(dimension), np.ones(dimension), np.ones(dimension)
    a[1], b[1], c[1] = top, top + depth * dx, 0.2
    tables = scene(simulator, dimension, [box(a, b), box(np.zeros(dimension), c)], [box(low, high)])

    def side(x: np.ndarray, simulation: Any) -> np.ndarray:
        above = np.where(x[:, 1] > top - SLACK * dx, 1, -1)
        return np.asarray(np.where(x[:, 1] < top - (thick - SLACK) * dx, 2, above))

    label = f"plate {thick} cells, offset {offset}"
    return ThinWallScene(label, tables, side, 0.4, depth * dx * DENSITY * GRAVITY)


def divider(rng: np.random.Generator, simulator: str, dimension: int) -> ThinWallScene:
    """Draw an upright plate between two pools of different height, straight or at a slant."""
    dx, thick = 1.0 / COUNTS[dimension], float(rng.choice(THICKNESSES))
    offset, angle = rng.integers(0, OFFSETS) / OFFSETS, float(rng.choice([0.0, 0.0, 10.0, 30.0]))
    at, half = 0.45 + offset * dx, 0.5 * thick * dx
    low, high = np.full(dimension, -1.0), np.full(dimension, 2.0)
    low[0], high[0] = at - half, at + half
    about = np.array([at, 0.0, 0.0])
    rotation = angle if dimension == 2 else [0.0, 0.0, angle]
    place = {"rotate": rotation, "about": about[:dimension].tolist()} if angle else {}
    lean = 0.5 * math.tan(math.radians(angle)) + 2.0 * half
    a, b, c = np.zeros(dimension), np.ones(dimension), np.ones(dimension)
    b[:2], c[1] = (at - lean, 0.5), 0.25
    d = np.zeros(dimension)
    d[0] = at + 2.0 * half
    tables = scene(simulator, dimension, [box(a, b), box(d, c)], [box(low, high, **place)])

    def side(x: np.ndarray, simulation: Any) -> np.ndarray:
        away = turned(x, -angle, about)[:, 0] - at
        right = np.where(away > half - SLACK * dx, 2, -1)
        return np.asarray(np.where(away < -half + SLACK * dx, 1, right))

    return ThinWallScene(
        f"divider {thick} cells, offset {offset}, {angle} degrees", tables, side, 0.4
    )


def pools(rng: np.random.Generator, simulator: str, dimension: int) -> ThinWallScene:
    """Draw an upright sheet between two pools at rest, of different height."""
    dx, thick = 1.0 / COUNTS[dimension], float(rng.choice(THICKNESSES))
    offset = rng.integers(0, OFFSETS) / OFFSETS
    first, last = 0.45 + offset * dx, 0.45 + (offset + thick) * dx
    low, high = np.full(dimension, -1.0), np.full(dimension, 2.0)
    low[0], high[0] = first, last
    a, b, c, d = (np.full(dimension, end) for end in (0.0, 1.0, 0.0, 1.0))
    b[:2], c[0], d[1] = (first, 0.5), last, 0.25
    tables = scene(simulator, dimension, [box(a, b), box(c, d)], [box(low, high)])

    def side(x: np.ndarray, simulation: Any) -> np.ndarray:
        right = np.where(x[:, 0] > last - SLACK * dx, 2, -1)
        return np.asarray(np.where(x[:, 0] < first + SLACK * dx, 1, right))

    label = f"pools {thick} cells, offset {offset}"
    return ThinWallScene(label, tables, side, 0.1, depth=0.5)


def funnel(rng: np.random.Generator, simulator: str, dimension: int) -> ThinWallScene:
    """Draw a closed vee, of capsules in 2-D and of boxes in 3-D."""
    dx, thick = 1.0 / COUNTS[dimension], float(rng.choice(THICKNESSES))
    offset, slope = rng.integers(0, OFFSETS) / OFFSETS, float(rng.choice([0.5, 1.0, 2.0]))
    middle, foot, half = 0.5 + offset * dx, 0.25, 0.5 * thick * dx
    reach = 0.45 / max(slope, 1.0)
    solids: list[Tables] = []
    for sign in (-1.0, 1.0):
        if dimension == 2:
            end = [middle + sign * reach, foot + slope * reach]
            solids.append({"shape": "capsule", "from": end, "to": [middle, foot], "radius": half})
        else:
            turn = {"rotate": [0.0, 0.0, sign * math.degrees(math.atan(slope))]}
            ends = sorted([middle, middle + sign * 0.62])
            low, high = [ends[0], foot - half, -0.1], [ends[1], foot + half, 1.1]
            solids.append(box(low, high, **turn, about=[middle, foot, 0.0]))
    low, high = np.zeros(dimension), np.ones(dimension)
    # above both sides, with the corner at the foot left open
    low[:2] = middle - 0.06, foot + 0.06 * slope + 2.0 * half * math.hypot(1.0, slope)
    high[:2] = middle + 0.06, low[1] + 0.22 * min(slope, 1.0)

    def side(x: np.ndarray, simulation: Any) -> np.ndarray:
        above = x[:, 1] - foot - slope * np.abs(x[:, 0] - middle)
        return np.asarray(np.where((above > 0.0) | (np.abs(x[:, 0] - middle) > 0.9 * reach), 1, -1))

    label = f"funnel {thick} cells, offset {offset}, slope {slope}"
    return ThinWallScene(label, scene(simulator, dimension, [box(low, high)], solids), side, 0.4)


def tube(rng: np.random.Generator, simulator: str, dimension: int) -> ThinWallScene:
    """Draw two long plates a few cells apart, closed below, in a pool that is lower."""
    dx, thick = 1.0 / COUNTS[dimension], float(rng.choice(THICKNESSES))
    offset, bore = rng.integers(0, OFFSETS) / OFFSETS, float(rng.choice([2.5, 4.2]))
    left, right, wall = 0.5 + offset * dx, 0.5 + (offset + bore) * dx, thick * dx
    solids = []
    for a, b in ((left - wall, left), (right, right + wall)):
        low, high = np.full(dimension, -0.1), np.full(dimension, 1.1)
        low[0], high[0] = a, b
        solids.append(box(low, high))
    pools = []
    for a, b, top in ((0.0, left - wall, 0.3), (left, right, 0.6), (right + wall, 1.0, 0.3)):
        low, high = np.zeros(dimension), np.ones(dimension)
        low[0], high[0], high[1] = a, b, top
        pools.append(box(low, high))

    def side(x: np.ndarray, simulation: Any) -> np.ndarray:
        result = np.full(len(x), -1)
        slack = SLACK * dx
        result[x[:, 0] < left - wall + slack] = 1
        result[(x[:, 0] > left - slack) & (x[:, 0] < right + slack)] = 2
        result[x[:, 0] > right + wall - slack] = 3
        return result

    label = f"tube of {bore} cells, {thick} cells, offset {offset}"
    return ThinWallScene(label, scene(simulator, dimension, pools, solids), side, 0.3)


def pushed(rng: np.random.Generator, simulator: str, dimension: int) -> ThinWallScene:
    """Draw a piston from wall to wall, or a plate that is as fast as 20 m/s for a short way."""
    dx, thick = 1.0 / COUNTS[dimension], float(rng.choice(THICKNESSES))
    offset, cfl = rng.integers(0, OFFSETS) / OFFSETS, float(rng.choice([2.0, 8.0]))
    at, speed = 0.1 + offset * dx, float(rng.choice([0.3, 1.0, 5.0, 20.0]))
    stop = 0.3 / speed
    low, high = np.full(dimension, -0.2), np.full(dimension, 1.2)
    low[0], high[0] = at, at + thick * dx
    velocity = [speed, 0.0, 0.0][:dimension]
    motion = {"kind": "translation", "velocity": velocity, "stop": stop}
    a, b = np.zeros(dimension), np.ones(dimension)
    a[0], b[1] = high[0], 0.3

    def side(x: np.ndarray, simulation: Any) -> np.ndarray:
        front = high[0] + speed * min(simulation.time, stop)
        return np.asarray(np.where(x[:, 0] > front - SLACK * dx, 1, -1))

    label = f"piston {thick} cells, offset {offset}, {speed} m/s, CFL {cfl}"
    tables = scene(simulator, dimension, [box(a, b)], [box(low, high, motion=motion)], cfl)
    return ThinWallScene(label, tables, side, min(stop + 0.1, 0.5))


def blade(rng: np.random.Generator, simulator: str, dimension: int) -> ThinWallScene:
    """Draw a plate across a closed pool that swings like a paddle: each half keeps its material."""
    dx, thick = 1.0 / COUNTS[dimension], float(rng.choice(THICKNESSES))
    offset, cfl = rng.integers(0, OFFSETS) / OFFSETS, float(rng.choice([2.0, 8.0]))
    at, half, period = 0.45 + offset * dx, 0.5 * thick * dx, float(rng.choice([0.15, 0.5]))
    low, high = np.full(dimension, -1.0), np.full(dimension, 2.0)
    low[0], high[0] = at - half, at + half
    swing = [0.1, 0.0, 0.0][:dimension]
    motion = {"kind": "sinusoid", "period": period, "amplitude": swing}
    a, b, c = np.zeros(dimension), np.ones(dimension), np.zeros(dimension)
    b[:2], c[0] = (at - half, 0.4), at + half
    d = np.ones(dimension)
    d[1] = 0.4
    tables = scene(
        simulator, dimension, [box(a, b), box(c, d)], [box(low, high, motion=motion)], cfl
    )

    def side(x: np.ndarray, simulation: Any) -> np.ndarray:
        shift = simulation.boundary.cut.solids[0].motion.pose(simulation.time).translation[0]
        away = x[:, 0] - at - shift
        right = np.where(away > half - SLACK * dx, 2, -1)
        return np.asarray(np.where(away < -half + SLACK * dx, 1, right))

    label = f"blade {thick} cells, offset {offset}, period {period} s, CFL {cfl}"
    return ThinWallScene(label, tables, side, 0.4)


KINDS: dict[str, Callable[[np.random.Generator, str, int], ThinWallScene]] = {
    "plate": plate,
    "divider": divider,
    "funnel": funnel,
    "tube": tube,
    "bottle": lambda rng, sim, dim: bottle(rng, sim, dim, None, False),
    "shaken": lambda rng, sim, dim: bottle(rng, sim, dim, "shaken", False),
    "turned": lambda rng, sim, dim: bottle(rng, sim, dim, "turned", False),
    "mesh": lambda rng, sim, dim: bottle(rng, sim, 3, None, True),
    "piston": pushed,
    "blade": blade,
    "pools": pools,
}


def drawn(seed: int, kind: str, simulator: str, dimension: int) -> ThinWallScene:
    """Return the draw of a seed."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind), dimension, len(simulator)])
    return KINDS[kind](rng, simulator, dimension)


def run(draw: ThinWallScene) -> ThinWallOutcome:
    """Simulate a draw."""
    simulation = made(draw.tables)
    key = np.asarray(simulation.particles.position.numpy(), dtype=np.float64)
    start = Counter(draw.side(key, simulation).tolist())
    loads: list[float] = []
    failures: Counter[str] = Counter()
    fastest = 0.0
    row: dict[str, Any] = {}
    while simulation.time < draw.until - 1e-9:
        row = simulation.step(min(simulation.stable_dt(), 0.02, draw.until - simulation.time))
        if row.get("solve_status") not in (None, "CONVERGED"):
            failures[str(row["solve_status"])] += 1
        if draw.depth is not None:
            speeds = np.linalg.norm(simulation.particles.velocity.numpy(), axis=1)
            fastest = max(fastest, float(speeds.max()))
        forces = getattr(simulation, "measured", {}).get("forces")
        if draw.weight and forces and simulation.time > draw.until * 2.0 / 3.0:
            own = [v for k, v in forces.items() if k.startswith("solid") and k.endswith("_fy")]
            loads.append(-sum(own) / draw.weight)
    x = np.asarray(simulation.particles.position.numpy(), dtype=np.float64)
    end = Counter(draw.side(x, simulation).tolist())
    passed = sum(abs(end[s] - start[s]) for s in {*start, *end}) // 2 + start[-1]
    density = row.get("max_density", row.get("max_fraction", 0.0))
    load = float(np.mean(loads)) if loads else None
    speed = fastest / math.sqrt(GRAVITY * draw.depth) if draw.depth is not None else None
    return ThinWallOutcome(len(x), passed, load, density, failures, speed)


def made(tables: Tables) -> Any:
    """Return a simulation without the slabs of material that are too small for a particle."""
    key = "liquid" if "liquid" in tables else "sand"
    kind = simulators()[tables["scene"]["simulator"]]
    while True:
        try:
            model = validate(kind.scene_model, tables, "drawn")
            return kind.create(model, device="cpu", folder=Path())
        except ValueError as error:
            if "holds no particle" not in str(error) or len(tables[key]) == 1:
                raise
            empty = int(str(error).split("[")[1].split("]")[0])
            tables[key] = [part for n, part in enumerate(tables[key]) if n != empty]


def main() -> None:
    """Run draws and print them."""
    seed, count, names = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3:]
    kinds = [name for name in KINDS if name in names] or list(KINDS)
    models = [name for name in ("fluids", "granular") if name in names] or ["fluids", "granular"]
    dimensions = [d for d in (2, 3) if str(d) in names] or [2, 3]
    total: Counter[str] = Counter()
    for kind in kinds:
        for model in models:
            for dimension in [3] if kind == "mesh" else dimensions:
                for n in range(count):
                    draw = drawn(seed + n, kind, model, dimension)
                    out = run(draw)
                    total["draws"] += 1
                    total["held"] += out.passed == 0
                    load = "" if out.load is None else f", load {out.load:.3f}"
                    if out.speed is not None:
                        load += f", speed {out.speed:.4f} sqrt(g h)"
                    print(
                        f"{model} {dimension}-D {draw.label}: {out.passed} of {out.particles} "
                        "passed"
                        f"{load}, density {out.density:.2f} {dict(out.failures) or ''}",
                        flush=True,
                    )
    print(dict(total))


if __name__ == "__main__":
    os.environ.setdefault("WARP_LCP_THREADS", "1")
    main()
