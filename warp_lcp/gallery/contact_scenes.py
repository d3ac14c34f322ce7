"""The scenes of figures 2.9 and 2.11 of the book: stacks, walls, heavy on light, snakes of hinges, inclines, gears, motors.

Each makes a `World`, deterministic by its seed, in meters and kilograms; `contact_scene` makes a problem of one by its name.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from warp_lcp.gallery.contact_detection import Plane
from warp_lcp.gallery.contact_models import BoxedModel, ContactModel
from warp_lcp.gallery.contact_stepper import ContactStepper
from warp_lcp.gallery.hinges import Hinge
from warp_lcp.gallery.problem import Problem
from warp_lcp.gallery.rigid_bodies import FIXED, Box, Gear, RigidBodies, Shape, Sphere, rotation
from warp_lcp.gallery.rigid_world import GRAVITY, World
from warp_lcp.solvers.nncg import NNCG

DENSITY = 1000.0  # [kg/m^3]
Y_AXIS = np.array([0.0, 1.0, 0.0])


def box_mass(half: tuple[float, float, float]) -> float:
    """Return the mass of a box of water [kg]."""
    return DENSITY * 8 * float(np.prod(half))


def _check(name: str, value: float, least: float) -> None:
    if not least <= value < np.inf:
        raise ValueError(f"{name} = {value}: must be >= {least} and finite")


def sphere_stack(count: int = 6, *, seed: int = 2015) -> World:
    """Return spheres of one radius, 0.25 m, and masses that differ by up to a tenth, on top of each other.

    Raises:
        ValueError: there is no sphere.
    """
    _check("count", count, 1)
    radius = 0.25
    mass = DENSITY * 4 / 3 * np.pi * radius**3 * np.random.default_rng(seed).uniform(0.9, 1.1, count)
    position = [[0.0, 0.0, radius * (2 * i + 1)] for i in range(count)]
    return World(f"stack of {count} spheres", RigidBodies([Sphere(radius)] * count, mass, position))


def box_stack(count: int = 10, *, seed: int = 2015) -> World:
    """Return boxes of equal mass on top of each other, each moved and turned a little (fig. 2.9c, 2.11c, f).

    Raises:
        ValueError: there is no box.
    """
    _check("count", count, 1)
    half, rng = (0.25, 0.25, 0.25), np.random.default_rng(seed)
    position = [[*rng.uniform(-0.02, 0.02, 2), 0.25 + 0.5 * i] for i in range(count)]
    turned = [rotation(np.array([0.0, 0.0, a])) for a in rng.uniform(-0.1, 0.1, count)]
    return World(f"stack of {count} boxes", RigidBodies([Box(half)] * count, [box_mass(half)] * count, position, turned))


def wall(rows: int = 4, *, columns: int = 4, seed: int = 2015) -> World:
    """Return a running bond of bricks 1:0.5:0.5, every second row with half bricks at its ends, densities within a tenth.

    Raises:
        ValueError: rows or columns are missing.
    """
    _check("rows", rows, 1)
    _check("columns", columns, 1)
    whole, half = Box((0.25, 0.125, 0.125)), Box((0.12375, 0.125, 0.125))
    shapes: list[Shape] = []
    position = []
    for i in range(rows):
        ends = [-0.12625, 0.505 * (columns - 1) + 0.12625] if i % 2 else []
        centers = [*ends, *(0.505 * (j + 0.5 * (i % 2)) for j in range(columns - i % 2))]
        shapes += [*([half] * len(ends)), *([whole] * (len(centers) - len(ends)))]
        position += [[x, 0.0, 0.125 + 0.25 * i] for x in centers]
    density = np.random.default_rng(seed).uniform(0.9, 1.1, len(position))
    mass = [d * box_mass(s.half) for d, s in zip(density, shapes, strict=True) if isinstance(s, Box)]
    return World(f"wall of {rows} x {columns} bricks", RigidBodies(shapes, mass, position))


def heavy_on_light(layers: int = 2, *, ratio: float = 1000.0, seed: int = 2015) -> World:
    """Return a box on layers of 2 x 2 smaller ones, each `ratio` times lighter (fig. 2.9d, 2.11h).

    Raises:
        ValueError: layers are missing, or the ratio is not positive.
    """
    _check("layers", layers, 1)
    _check("ratio", ratio, 1e-12)
    small, large, rng = (0.125, 0.125, 0.125), (0.3, 0.3, 0.3), np.random.default_rng(seed)
    position = [[0.3 * i - 0.15, 0.3 * j - 0.15, 0.125 + 0.25 * k] for k in range(layers) for i in (0, 1) for j in (0, 1)]
    position = [[x + a, y + b, z] for (x, y, z), (a, b) in zip(position, rng.uniform(-0.01, 0.01, (len(position), 2)), strict=True)]
    shapes: list[Shape] = [*([Box(small)] * len(position)), Box(large)]
    light = box_mass(small)
    bodies = RigidBodies(shapes, [*([light] * len(position)), ratio * light], [*position, [0.0, 0.0, 0.25 * layers + 0.3]])
    return World(f"heavy box on {layers} layers, mass ratio {ratio:g}", bodies)


def _arch(links: int) -> tuple[list[Shape], list[float], list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """Return shapes, masses, centers, rotations and the points between links of half a regular polygon of links that stands on z = 0."""
    half = (0.2, 0.12, 0.08)
    step = np.pi / links
    radius = half[0] / np.tan(step / 2)
    angles = np.pi - step * (np.arange(links) + 0.5)
    lift = half[2] * np.sin(step / 2)  # the first link leans by step / 2 from the vertical: its lowest corner is that far below its end
    up = np.array([0.0, 0.0, lift])
    centers = [radius * np.array([np.cos(a), 0.0, np.sin(a)]) + up for a in angles]
    turned = [rotation(-Y_AXIS * (a - np.pi / 2)) for a in angles]
    outer = radius / np.cos(step / 2)
    points = [outer * np.array([np.cos(a), 0.0, np.sin(a)]) + up for a in np.pi - step * np.arange(1, links)]
    return [Box(half)] * links, [box_mass(half)] * links, centers, turned, points


def arched_snake(links: int = 9, *, heavy: float = 0.0, seed: int = 2015) -> World:
    """Return an arch of boxes joined by hinges whose limits hold it up (fig. 2.9a, b; 2.11g); a body on top if `heavy` > 0.

    Hinges turn by up to 0.02 to 0.04 rad either way.

    Args:
        links: boxes, an odd number >= 3.
        heavy: mass of the box on top over that of a link; 0 for none.
        seed: of the limits.

    Raises:
        ValueError: links or heavy is out of range.
    """
    _check("links", links, 3)
    _check("heavy", heavy, 0.0)
    if links % 2 == 0:
        raise ValueError(f"links = {links}: must be odd, so that one is on top")
    shapes, mass, centers, turned, points = _arch(links)
    if heavy > 0:
        top = centers[links // 2]
        shapes, mass = [*shapes, Box((0.25, 0.25, 0.25))], [*mass, heavy * mass[0]]
        centers, turned = [*centers, top + np.array([0.0, 0.0, 0.08 + 0.25])], [*turned, np.eye(3)]
    bodies = RigidBodies(shapes, mass, centers, turned)
    rng = np.random.default_rng(seed)
    hinges = []
    for i, point in enumerate(points):
        limit = float(rng.uniform(0.02, 0.04))
        hinges.append(Hinge.between(bodies, i + 1, i, point, Y_AXIS, limits=(-limit, limit)))
    name = f"arched snake of {links} links" + (f" under a box of {heavy:g} links" if heavy > 0 else "")
    return World(name, bodies, hinges=tuple(hinges), friction=0.8, ignored=frozenset((i, i + 2) for i in range(links - 2)))


def hanging_snake(links: int = 8, *, seed: int = 2015) -> World:
    """Return a chain of boxes in the air whose first link is fixed, held by the limits of its hinges (fig. 2.11i).

    Raises:
        ValueError: there are less than two links.
    """
    _check("links", links, 2)
    half = (0.2, 0.12, 0.08)
    position = [[0.42 * i, 0.0, 2.0] for i in range(links)]
    bodies = RigidBodies([Box(half)] * links, [FIXED, *([box_mass(half)] * (links - 1))], position)
    limits = np.random.default_rng(seed).uniform(0.02, 0.05, links - 1)
    hinges = [
        Hinge.between(bodies, i + 1, i, np.array([0.42 * i + 0.21, 0.0, 2.0]), Y_AXIS, limits=(-float(a), float(a)))
        for i, a in enumerate(limits)
    ]
    return World(f"hanging snake of {links} links", bodies, hinges=tuple(hinges), ignored=frozenset((i, i + 2) for i in range(links - 2)))


def incline(count: int = 1, *, angle: float = 0.3, friction: float = 0.5, seed: int = 2015) -> World:
    """Return boxes in a row along a slope (fig. 2.9e, 2.11a): each rests below atan(mu) and slides with g (sin - mu cos) above.

    The plane goes through the origin and rises toward -x; boxes are 1:1:0.5, so that they do not topple, with masses within a tenth.

    Args:
        count: boxes.
        angle: of the slope [rad], in [0, pi / 2).
        friction: mu.
        seed: of the masses.

    Raises:
        ValueError: count or angle is out of range.
    """
    _check("count", count, 1)
    if not 0 <= angle < np.pi / 2:
        raise ValueError(f"angle = {angle}: must be in [0, pi / 2), in rad")
    half = (0.25, 0.25, 0.125)
    R = rotation(Y_AXIS * angle)
    position = [R @ np.array([0.8 * i, 0.0, half[2]]) for i in range(count)]
    mass = box_mass(half) * np.random.default_rng(seed).uniform(0.9, 1.1, count)
    bodies = RigidBodies([Box(half)] * count, mass, position, [R] * count)
    normal = (float(R[0, 2]), 0.0, float(R[2, 2]))
    return World(f"{count} boxes on a slope of {angle:g} rad", bodies, planes=(Plane(normal),), friction=friction)


def leaning_wall(rows: int = 4, *, columns: int = 3, angle: float = 0.25, seed: int = 2015) -> World:
    """Return a wall on a slope of `angle` [rad] along it: friction holds every brick (fig. 2.9h, 2.11b).

    Raises:
        ValueError: an argument is out of range.
    """
    flat = wall(rows, columns=columns, seed=seed)
    if not 0 <= angle < np.pi / 2:
        raise ValueError(f"angle = {angle}: must be in [0, pi / 2), in rad")
    gravity = tuple(float(v) for v in rotation(-Y_AXIS * angle) @ np.array(GRAVITY))
    return World(f"wall of {rows} x {columns} bricks leaning by {angle:g} rad", flat.bodies, gravity=(gravity[0], gravity[1], gravity[2]))


def gear_pyramid(rows: int = 3, *, seed: int = 2015) -> World:
    """Return a pyramid of gears with six teeth that lean on each other, the lowest row between posts (fig. 2.9f, g; 2.11d, e).

    Gears of a row are a tooth's width apart, those above are let in from a little height: it needs some steps to settle.

    Raises:
        ValueError: there is no row.
    """
    _check("rows", rows, 1)
    gear, pitch = Gear(0.3, 0.05, 0.1, 3), 0.62
    upright = rotation(np.array([np.pi / 2, 0.0, 0.0]))  # the gears' plane is xz
    rng = np.random.default_rng(seed)
    position, turned = [], []
    for row in range(rows):
        for i in range(rows - row):
            position.append([pitch * (i + 0.5 * row), 0.0, 0.31 + 0.62 * row])
            turned.append(upright @ rotation(np.array([0.0, 0.0, float(rng.uniform(-0.02, 0.02)) + np.pi / 6 * (row % 2)])))
    mass = DENSITY * 8 * gear.radius * gear.tooth * gear.thickness * gear.bars
    post = Box((0.05, 0.3, 0.3))
    sides = [[-0.37, 0.0, 0.3], [pitch * (rows - 1) + 0.37, 0.0, 0.3]]
    shapes: list[Shape] = [*([gear] * len(position)), post, post]
    masses = [*([mass] * len(position)), FIXED, FIXED]
    bodies = RigidBodies(shapes, masses, [*position, *sides], [*turned, np.eye(3), np.eye(3)])
    planes = (Plane((0.0, 0.0, 1.0)), Plane((0.0, 1.0, 0.0), -0.101), Plane((0.0, -1.0, 0.0), -0.101))
    return World(f"pyramid of {len(position)} gears", bodies, planes=planes, friction=0.4)


def motor_arm(links: int = 4, *, torque: float = 400.0, seed: int = 2015) -> World:
    """Return an arm of boxes on a fixed base whose hinges have motors that turn it: speeds up to 0.5 rad/s, torques limited [N m].

    Motors near the base carry more; their limits grow with the square of the links they carry, times `torque` / links^2.

    Raises:
        ValueError: links or torque is out of range.
    """
    _check("links", links, 1)
    _check("torque", torque, 0.0)
    half, rng = (0.2, 0.08, 0.08), np.random.default_rng(seed)
    position = [[0.0, 0.0, 1.0], *([0.42 * i, 0.0, 1.0] for i in range(1, links + 1))]
    bodies = RigidBodies([Box(half)] * (links + 1), [FIXED, *([box_mass(half)] * links)], position)
    hinges = []
    for i in range(links):
        anchor = np.array([0.42 * i + 0.21, 0.0, 1.0])
        most, speed = torque * ((links - i) / links) ** 2, float(rng.uniform(-0.5, 0.5))
        hinges.append(Hinge.between(bodies, i + 1, i, anchor, Y_AXIS, limits=(-1.0, 1.0), motor_speed=speed, motor_torque=most))
    return World(f"arm of {links} motors", bodies, hinges=tuple(hinges))


def driven_gears(count: int = 3, *, seed: int = 2015) -> World:
    """Return gears on fixed axles in a row whose teeth mesh; a motor turns the first.

    Raises:
        ValueError: there is no gear.
    """
    _check("count", count, 1)
    gear, pitch = Gear(0.3, 0.04, 0.1, 3), 0.5
    upright = rotation(np.array([np.pi / 2, 0.0, 0.0]))
    phase = float(np.random.default_rng(seed).uniform(-0.05, 0.05))
    turned = [upright @ rotation(np.array([0.0, 0.0, (np.pi / 6) * (i % 2) + phase * (-1) ** i])) for i in range(count)]
    position = np.array([[pitch * i, 0.0, 1.0] for i in range(count)])
    mass = DENSITY * 8 * gear.radius * gear.tooth * gear.thickness * gear.bars
    bodies = RigidBodies([gear] * count, [mass] * count, position, turned)
    hinges = [Hinge.between(bodies, 0, -1, position[0], Y_AXIS, motor_speed=1.0, motor_torque=50.0)]
    hinges += [Hinge.between(bodies, i, -1, position[i], Y_AXIS) for i in range(1, count)]
    return World(f"{count} driven gears", bodies, hinges=tuple(hinges), friction=0.2)


SCENES: dict[str, Callable[..., World]] = {
    "sphere-stack": sphere_stack,
    "box-stack": box_stack,
    "wall": wall,
    "heavy-on-light": heavy_on_light,
    "arched-snake": arched_snake,
    "heavy-on-snake": lambda links=9, *, seed=2015: arched_snake(links, heavy=20.0, seed=seed),
    "hanging-snake": hanging_snake,
    "incline": lambda count=4, *, seed=2015: incline(count, seed=seed),
    "leaning-wall": leaning_wall,
    "gear-pyramid": gear_pyramid,
    "motor-arm": motor_arm,
    "driven-gears": driven_gears,
}

SETTLING = {"gear-pyramid": 60, "hanging-snake": 60, "driven-gears": 40}  # steps after which these scenes have their contacts or limits


def contact_scene(
    name: str, size: int | None = None, *, model: ContactModel | None = None, dt: float = 0.01, steps: int = 0, seed: int = 2015
) -> Problem:
    """Return the contact problem of a scene's next time step.

    Args:
        name: one of SCENES.
        size: bodies, rows or links, what the scene counts; its own if None.
        model: how friction becomes a problem; BoxedModel() if None.
        dt: time step [s].
        steps: made before the problem is taken, each by 500 iterations of NNCG at most; where a scene has to settle, see SETTLING.
        seed: of the scene.

    Raises:
        ValueError: there is no such scene, an argument is out of range, or nothing touches.

    Example:
        >>> problem = contact_scene("box-stack", 2)
        >>> print(problem.name, problem.A.shape)
        stack of 2 boxes: boxed (24, 24)
    """
    if name not in SCENES:
        raise ValueError(f"name = {name!r}: no such scene; choose from {', '.join(SCENES)}")
    world = SCENES[name](seed=seed) if size is None else SCENES[name](size, seed=seed)
    if steps > 0:
        stepper = ContactStepper(world, NNCG(), dt=dt)
        for _ in range(steps):
            stepper.step()
    system = world.assemble(dt).system
    if not len(system.q):
        raise ValueError(f"{world.name}: nothing touches, there is no problem")
    return (model or BoxedModel()).problem(system)
