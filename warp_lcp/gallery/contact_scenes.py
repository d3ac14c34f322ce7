"""Contact scenes of the book's figures 2.9 and 2.11.

Stacks, walls, heavy on light bodies, chains of hinges, inclines, gears, motors. Each function
returns a `World`, deterministic by its seed, in meters and kilograms; `contact_scene` returns the
problem of a scene by name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from warp_lcp.gallery.contact_stepper import ContactStepper
from warp_lcp.gallery.rigid_world import FIXED, GRAVITY, Parts, World
from warp_lcp.grid.signed_distance import Box, Placement, Sphere
from warp_lcp.host_problem import Problem
from warp_lcp.rigid.contact_models import (
    BoxedModel,
    ContactModel,
    ContactSystem,
    StewartTrinkleModel,
)
from warp_lcp.rigid.contacts import contact_frames, jacobian
from warp_lcp.rigid.joints import WORLD, Joint
from warp_lcp.rigid.obstacles import Obstacle
from warp_lcp.solvers.nncg import NNCG

DENSITY = 1000.0  # [kg/m^3]
Y_AXIS = np.array([0.0, 1.0, 0.0])
BARS = 3  # bars of a gear, which has twice as many teeth
LINK = (0.2, 0.12, 0.08)  # half sides of a snake's links [m]
Vector = Sequence[float] | np.ndarray


def box(center: Vector, half: Vector, turn: Rotation | None = None) -> Box:
    """Return a box by its center and half sides [m], rotated about the center."""
    place = Placement(
        rotation=(turn or Rotation.identity()).as_matrix(), translation=np.array(center)
    )
    return Box(lower=tuple(-h for h in half), upper=tuple(half), placement=place)


def gear(center: Vector, half: Vector, phase: float) -> list[Box]:
    """Return a gear of crossed bars in the xz plane.

    It has BARS bars of given half sides [m], the first at an angle [rad].
    """
    return [
        box(
            center,
            half,
            about((1.0, 0.0, 0.0), np.pi / 2) * about((0.0, 0.0, 1.0), phase + np.pi * k / BARS),
        )
        for k in range(BARS)
    ]


def about(axis: Vector, angle: float) -> Rotation:
    """Return the rotation about a unit vector by an angle [rad]."""
    return Rotation.from_rotvec(angle * np.array(axis))


def box_mass(half: Vector) -> float:
    """Return the mass of a box of water [kg]."""
    return DENSITY * 8 * float(np.prod(half))


def _check(name: str, value: float, least: float) -> None:
    if not least <= value < np.inf:
        raise ValueError(f"{name} = {value}: must be >= {least} and finite")


def sphere_stack(count: int = 6, *, seed: int = 2015) -> World:
    """Return a stack of spheres of radius 0.25 m with masses within a tenth.

    Raises:
        ValueError: there is no sphere.
    """
    _check("count", count, 1)
    radius = 0.25
    mass = (
        DENSITY * 4 / 3 * np.pi * radius**3 * np.random.default_rng(seed).uniform(0.9, 1.1, count)
    )
    balls = [Sphere(center=[0.0, 0.0, radius * (2 * i + 1)], radius=radius) for i in range(count)]
    return World(f"stack of {count} spheres", balls, mass)


def box_stack(count: int = 10, *, seed: int = 2015) -> World:
    """Return a stack of boxes, each slightly displaced (fig. 2.9c, 2.11c, f).

    Raises:
        ValueError: there is no box.
    """
    _check("count", count, 1)
    half, rng = (0.25, 0.25, 0.25), np.random.default_rng(seed)
    position = [[*rng.uniform(-0.02, 0.02, 2), 0.25 + 0.5 * i] for i in range(count)]
    boxes = [
        box(x, half, about((0.0, 0.0, 1.0), a))
        for x, a in zip(position, rng.uniform(-0.1, 0.1, count), strict=True)
    ]
    return World(f"stack of {count} boxes", boxes, [box_mass(half)] * count)


def wall(rows: int = 4, *, columns: int = 4, seed: int = 2015) -> World:
    """Return a wall of bricks in running bond.

    Bricks are 1:0.5:0.5, every second row has half bricks at its ends, densities vary by a tenth.

    Raises:
        ValueError: rows or columns are missing.
    """
    _check("rows", rows, 1)
    _check("columns", columns, 1)
    whole, half = (0.25, 0.125, 0.125), (0.12375, 0.125, 0.125)
    bricks = []
    for i in range(rows):
        bricks += [
            (x, i, half) for x in ([-0.12625, 0.505 * (columns - 1) + 0.12625] if i % 2 else [])
        ]
        bricks += [(0.505 * (j + 0.5 * (i % 2)), i, whole) for j in range(columns - i % 2)]
    density = np.random.default_rng(seed).uniform(0.9, 1.1, len(bricks))
    mass = [d * box_mass(sides) for d, (_, _, sides) in zip(density, bricks, strict=True)]
    return World(
        f"wall of {rows} x {columns} bricks",
        [box((x, 0.0, 0.125 + 0.25 * i), sides) for x, i, sides in bricks],
        mass,
    )


def heavy_on_light(layers: int = 2, *, ratio: float = 1000.0, seed: int = 2015) -> World:
    """Return a heavy box on layers of 2 x 2 lighter ones (fig. 2.9d, 2.11h).

    Each layer's boxes are `ratio` times lighter.

    Raises:
        ValueError: layers are missing, or the ratio is not positive.
    """
    _check("layers", layers, 1)
    _check("ratio", ratio, 1e-12)
    small, large, rng = (0.125, 0.125, 0.125), (0.3, 0.3, 0.3), np.random.default_rng(seed)
    position = [
        [0.3 * i - 0.15, 0.3 * j - 0.15, 0.125 + 0.25 * k]
        for k in range(layers)
        for i in (0, 1)
        for j in (0, 1)
    ]
    position = [
        [x + a, y + b, z]
        for (x, y, z), (a, b) in zip(
            position, rng.uniform(-0.01, 0.01, (len(position), 2)), strict=True
        )
    ]
    boxes, light = (
        [*(box(x, small) for x in position), box([0.0, 0.0, 0.25 * layers + 0.3], large)],
        box_mass(small),
    )
    return World(
        f"heavy box on {layers} layers, mass ratio {ratio:g}",
        boxes,
        [*([light] * len(position)), ratio * light],
    )


def _arch(links: int) -> tuple[list[Box], list[np.ndarray], np.ndarray]:
    """Return half a regular polygon of links standing on z = 0.

    Also the points between the links, and the center of the top link.
    """
    step = np.pi / links
    radius = LINK[0] / np.tan(step / 2)
    # The first link is tilted by step / 2: its lowest corner is that far below its end.
    up = np.array([0.0, 0.0, LINK[2] * np.sin(step / 2)])

    def at(distance: float, angle: float) -> np.ndarray:
        return distance * np.array([np.cos(angle), 0.0, np.sin(angle)]) + up

    angles = np.pi - step * (np.arange(links) + 0.5)
    boxes = [box(at(radius, a), LINK, about(-Y_AXIS, a - np.pi / 2)) for a in angles]
    points = [at(radius / np.cos(step / 2), a) for a in np.pi - step * np.arange(1, links)]
    return boxes, points, at(radius, angles[links // 2])


def _chain(points: Sequence[Vector], limits: np.ndarray) -> tuple[Joint, ...]:
    """Return hinges between consecutive bodies, with limits of +- some angle [rad]."""
    pairs = enumerate(zip(points, limits.tolist(), strict=True))
    return tuple(Joint(i + 1, i, np.array(at), Y_AXIS, (-limit, limit)) for i, (at, limit) in pairs)


def _next_but_one(links: int) -> frozenset[tuple[int, int]]:
    """Return the pairs of a chain's links with one link between them.

    Their hinges keep them apart.
    """
    return frozenset((i, i + 2) for i in range(links - 2))


def arched_snake(links: int = 9, *, heavy: float = 0.0, seed: int = 2015) -> World:
    """Return an arch of boxes joined by hinges with limits (fig. 2.9a, b; 2.11g).

    A box lies on top if `heavy` > 0. Hinges rotate by up to 0.02 to 0.04 rad either way.

    Args:
        links: number of boxes, odd, at least 3.
        heavy: mass of the box on top over that of a link; 0 for none.
        seed: seed of the limits.

    Raises:
        ValueError: links or heavy is out of range.
    """
    _check("links", links, 3)
    _check("heavy", heavy, 0.0)
    if links % 2 == 0:
        raise ValueError(f"links = {links}: must be odd, so that one is on top")
    (boxes, points, top), mass, name = (
        _arch(links),
        [box_mass(LINK)] * links,
        f"arched snake of {links} links",
    )
    if heavy > 0:
        boxes, mass = (
            [*boxes, box(top + np.array([0.0, 0.0, 0.08 + 0.25]), (0.25, 0.25, 0.25))],
            [*mass, heavy * mass[0]],
        )
        name += f" under a box of {heavy:g} links"
    hinges = _chain(points, np.random.default_rng(seed).uniform(0.02, 0.04, links - 1))
    return World(name, boxes, mass, hinges=hinges, friction=0.8, ignored=_next_but_one(links))


def hanging_snake(links: int = 8, *, seed: int = 2015) -> World:
    """Return a hanging chain of hinged boxes, the first one fixed (fig. 2.11i).

    The limits of the hinges support it.

    Raises:
        ValueError: there are fewer than two links.
    """
    _check("links", links, 2)
    boxes, mass = (
        [box([0.42 * i, 0.0, 2.0], LINK) for i in range(links)],
        [FIXED, *([box_mass(LINK)] * (links - 1))],
    )
    points = [(0.42 * i + 0.21, 0.0, 2.0) for i in range(links - 1)]
    hinges = _chain(points, np.random.default_rng(seed).uniform(0.02, 0.05, links - 1))
    return World(
        f"hanging snake of {links} links", boxes, mass, hinges=hinges, ignored=_next_but_one(links)
    )


def incline(
    count: int = 1, *, angle: float = 0.3, friction: float = 0.5, seed: int = 2015
) -> World:
    """Return boxes in a row on a slope (fig. 2.9e, 2.11a).

    Each box rests below atan(mu) and slides with g (sin - mu cos) above. The plane goes through the
    origin and rises toward -x; boxes are 1:1:0.5, so that they do not topple, with masses that vary
    by a tenth.

    Args:
        count: number of boxes.
        angle: angle of the slope [rad], in [0, pi / 2).
        friction: mu.
        seed: seed of the masses.

    Raises:
        ValueError: count or angle is out of range.
    """
    _check("count", count, 1)
    if not 0 <= angle < np.pi / 2:
        raise ValueError(f"angle = {angle}: must be in [0, pi / 2), in rad")
    half, turn = (0.25, 0.25, 0.125), about(Y_AXIS, angle)
    boxes = [box(turn.apply([0.8 * i, 0.0, half[2]]), half, turn) for i in range(count)]
    mass = box_mass(half) * np.random.default_rng(seed).uniform(0.9, 1.1, count)
    slope = Obstacle(name="slope", points=np.zeros((1, 3)), normals=turn.apply([[0.0, 0.0, 1.0]]))
    return World(
        f"{count} boxes on a slope of {angle:g} rad", boxes, mass, (slope,), friction=friction
    )


def leaning_wall(
    rows: int = 4, *, columns: int = 3, angle: float = 0.25, seed: int = 2015
) -> World:
    """Return a wall on a slope of `angle` [rad] (fig. 2.9h, 2.11b).

    Friction holds every brick.

    Raises:
        ValueError: an argument is out of range.
    """
    flat = wall(rows, columns=columns, seed=seed)
    if not 0 <= angle < np.pi / 2:
        raise ValueError(f"angle = {angle}: must be in [0, pi / 2), in rad")
    x, y, z = about(-Y_AXIS, angle).apply(GRAVITY).tolist()
    return World(
        f"wall of {rows} x {columns} bricks leaning by {angle:g} rad",
        flat.solids,
        flat.mass,
        gravity=(x, y, z),
    )


def gear_pyramid(rows: int = 3, *, seed: int = 2015) -> World:
    """Return a pyramid of six-toothed gears (fig. 2.9f, g; 2.11d, e).

    The gears lean on each other, the lowest row between posts. Gears of a row are a tooth's width
    apart; those above start at a small height and need some steps to settle.

    Raises:
        ValueError: there is no row.
    """
    _check("rows", rows, 1)
    half, pitch, rng = (0.3, 0.05, 0.1), 0.62, np.random.default_rng(seed)
    solids: list[Parts] = []
    for row in range(rows):
        for i in range(rows - row):
            phase = float(rng.uniform(-0.02, 0.02)) + np.pi / 6 * (row % 2)
            solids.append(gear([pitch * (i + 0.5 * row), 0.0, 0.31 + 0.62 * row], half, phase))
    gears = len(solids)
    solids += [box([x, 0.0, 0.3], (0.05, 0.3, 0.3)) for x in (-0.37, pitch * (rows - 1) + 0.37)]
    points, normals = (
        [[0.0, 0.0, 0.0], [0.0, -0.101, 0.0], [0.0, 0.101, 0.0]],
        [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]],
    )
    frame = Obstacle(name="ground and panes", points=np.array(points), normals=np.array(normals))
    mass = [*([BARS * box_mass(half)] * gears), FIXED, FIXED]
    return World(f"pyramid of {gears} gears", solids, mass, (frame,), friction=0.4)


def motor_arm(links: int = 4, *, torque: float = 400.0, seed: int = 2015) -> World:
    """Return an arm of boxes on a fixed base with motors in its hinges.

    Speeds up to 0.5 rad/s, torques limited [N m]. Motors near the base carry more: their limits
    grow with the square of the number of links that they carry, times `torque` / links^2.

    Raises:
        ValueError: links or torque is out of range.
    """
    _check("links", links, 1)
    _check("torque", torque, 0.0)
    half, rng = (0.2, 0.08, 0.08), np.random.default_rng(seed)
    boxes, hinges = [box([0.42 * i, 0.0, 1.0], half) for i in range(links + 1)], []
    for i in range(links):
        anchor, most = np.array([0.42 * i + 0.21, 0.0, 1.0]), torque * ((links - i) / links) ** 2
        hinges.append(
            Joint(
                i + 1,
                i,
                anchor,
                Y_AXIS,
                (-1.0, 1.0),
                motor_speed=float(rng.uniform(-0.5, 0.5)),
                motor_torque=most,
            )
        )
    return World(
        f"arm of {links} motors", boxes, [FIXED, *([box_mass(half)] * links)], hinges=tuple(hinges)
    )


def driven_gears(count: int = 3, *, seed: int = 2015) -> World:
    """Return a row of meshing gears on fixed axles; a motor turns the first.

    Raises:
        ValueError: there is no gear.
    """
    _check("count", count, 1)
    half, phase = (0.3, 0.04, 0.1), float(np.random.default_rng(seed).uniform(-0.05, 0.05))
    gears = [
        gear([0.5 * i, 0.0, 1.0], half, np.pi / 6 * (i % 2) + phase * (-1) ** i)
        for i in range(count)
    ]
    torques = [50.0] + [0.0] * (count - 1)
    axles = [
        Joint(i, WORLD, np.array([0.5 * i, 0.0, 1.0]), Y_AXIS, motor_speed=1.0, motor_torque=t)
        for i, t in enumerate(torques)
    ]
    return World(
        f"{count} driven gears",
        gears,
        [BARS * box_mass(half)] * count,
        hinges=tuple(axles),
        friction=0.2,
    )


def contact(
    contacts: int,
    *,
    directions: int = 4,
    bodies: int | None = None,
    friction: float = 0.5,
    seed: int = 2015,
) -> Problem:
    """Return the impulse problem of random bodies in contact.

    It uses the model of Stewart and Trinkle ([Book] 1.3.5). Bodies are balls of radius 1 with
    velocities v; each contact connects one to another or to the ground at a random point of its
    surface, with randomly rotated tangents. For any v there is a solution (Anitescu, Potra), which
    Lemke's method finds; impulses need not be unique.

    Args:
        contacts: number of contacts; a problem has (2 + directions) contacts unknowns.
        directions: tangents of a contact, an even number >= 2.
        bodies: number of bodies; half as many as contacts if None.
        friction: coefficient mu >= 0.
        seed: seed of all random numbers.

    Raises:
        ValueError: an argument is out of range.
    """
    model = StewartTrinkleModel(directions)
    if contacts < 1 or not friction >= 0:
        raise ValueError(
            f"contacts = {contacts}, friction = {friction}: at least one contact, friction >= 0"
        )
    bodies = bodies or max(1, contacts // 2)
    # Every body has a contact.
    rng, first = np.random.default_rng(seed), np.arange(contacts) % bodies
    second, one, other = (
        np.full(contacts, bodies),
        np.zeros((contacts, 3, 6)),
        np.zeros((contacts, 3, 6)),
    )
    for k in range(contacts):
        j, normal = int(rng.integers(-1, bodies)), rng.standard_normal(3)
        normal /= np.linalg.norm(normal)
        frame = about(normal, rng.uniform(0, 2 * np.pi)).apply(contact_frames(normal[None], 3)[0])
        arm = -frame[0] + 0.1 * rng.standard_normal(3)
        one[k] = np.hstack([frame, np.cross(arm, frame)])
        if j not in (-1, first[k]):
            second[k], other[k] = j, -np.hstack([frame, np.cross(-arm, frame)])
    J = jacobian(first, second, one, other, bodies)
    mass = rng.uniform(0.5, 2.0, bodies)
    # The inertia of a solid sphere is 2/5 m r^2.
    inverse_mass = np.repeat(1 / mass, 6) * np.tile([1.0, 1.0, 1.0, 2.5, 2.5, 2.5], bodies)
    B = csr_array(J @ (inverse_mass[:, None] * J.toarray().T))
    system = ContactSystem("", B, J @ rng.standard_normal(6 * bodies), np.full(contacts, friction))
    facts = frozenset({"copositive", "solvable"})
    return replace(
        model.problem(system).dense(),
        name=f"contact {contacts} x {directions} directions",
        facts=facts,
    )


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

# Steps after which these scenes have contacts or reached limits.
SETTLING = {"gear-pyramid": 60, "hanging-snake": 60, "driven-gears": 40}


def contact_scene(
    name: str,
    size: int | None = None,
    *,
    model: ContactModel | None = None,
    dt: float = 0.01,
    steps: int = 0,
    seed: int = 2015,
) -> Problem:
    """Return the contact problem of a scene's next time step.

    Args:
        name: one of SCENES.
        size: number of bodies, rows or links; default of the scene if None.
        model: friction model; BoxedModel() if None.
        dt: time step [s].
        steps: steps before the problem, each with at most 500 iterations of NNCG; for scenes that
            have to settle, see SETTLING.
        seed: seed of the scene.

    Raises:
        ValueError: there is no such scene, an argument is out of range, or there are no contacts.

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
        raise ValueError(f"{world.name}: there are no contacts, hence no problem")
    return (model or BoxedModel()).problem(system)
