"""Random contacts of rigid bodies, drawn by a seed.

They are spheres in a box, stacks of boxes, and bodies of any inertia with any contacts.
"""

import numpy as np

from warp_lcp.problem.frictional_contact import FrictionalContact

DT, GRAVITY, DENSITY = 0.01, 9.81, 1000.0
FAMILIES = ("spheres", "stack", "any")


def drawn(family, seed, *, friction=None, ratio=None, side=3, **more):
    """Return a problem of a family.

    By default friction is drawn from 0 to 2 and the ratio of masses from 1 to 1e4.
    """
    rng = np.random.default_rng([FAMILIES.index(family), seed])
    mu = rng.uniform(0.0, 2.0) if friction is None else friction
    ratio = 10.0 ** rng.uniform(0.0, 4.0) if ratio is None else ratio
    make = {
        "spheres": lambda: spheres(rng, ratio, side),
        "stack": lambda: stack(rng, ratio),
        "any": lambda: anything(rng, ratio),
    }[family]
    touch, roots, speeds = make()
    return assembled(*touch, roots, speeds, mu, **more)


def assembled(first, second, normals, arms, other_arms, roots, speeds, mu, **more):
    """Return the problem of contacts with these normals and arms.

    Arms are from the centers of both bodies, G G' = M^-1, and `speeds` are the velocities before.
    """
    tangents = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    frames = np.stack([normals, tangents, np.cross(normals, tangents)], axis=1)
    one, other = (
        np.concatenate([frames, np.cross(a[:, None], frames)], axis=2) for a in (arms, other_arms)
    )
    other = np.where((second < len(speeds))[:, None, None], -other, 0.0)
    roots, speeds = (
        np.concatenate([roots, np.zeros((1, 6, 6))]),
        np.concatenate([speeds, np.zeros((1, 6))]),
    )
    b = (one @ speeds[first][:, :, None] + other @ speeds[second][:, :, None])[:, :, 0]
    friction = np.full(len(first), mu)
    return FrictionalContact(
        first,
        second,
        one @ roots[first],
        other @ roots[second],
        b,
        friction,
        len(speeds) - 1,
        **more,
    )


def falling(rng, n, speed):
    """Return velocities after a step of gravity, with random ones added."""
    speeds = speed * rng.standard_normal((n, 6))
    speeds[:, 1] -= GRAVITY * DT
    return speeds


def spheres(rng, ratio, side, layers=3):
    """Return spheres of radius 1 on a square lattice between five walls.

    Each layer lies in the hollows of the layer below.
    """
    places = []
    for layer in range(layers):
        at = 1.0 + layer % 2 + 2.0 * np.arange(side - layer % 2)
        x, z = np.meshgrid(at, at, indexing="ij")
        places.append(
            np.column_stack([x.ravel(), np.full(x.size, 1.0 + np.sqrt(2.0) * layer), z.ravel()])
        )
    at = np.concatenate(places) + rng.uniform(-1e-3, 1e-3, (sum(map(len, places)), 3))
    n, masses = len(at), ratio ** rng.uniform(0.0, 1.0, len(at))
    i, j = (np.linalg.norm(at[:, None] - at, axis=2) < 2.01).nonzero()
    i, j = i[i > j], j[i > j]
    normals = (at[i] - at[j]) / np.linalg.norm(at[i] - at[j], axis=1)[:, None]
    first, second, ways = [i], [j], [normals]
    for axis, place, sign in (
        (0, 0.0, 1),
        (0, 2.0 * side, -1),
        (1, 0.0, 1),
        (2, 0.0, 1),
        (2, 2.0 * side, -1),
    ):
        near = np.flatnonzero(np.abs(at[:, axis] - place) < 1.01)
        first, second, ways = (
            [*first, near],
            [*second, np.full(len(near), n)],
            [*ways, np.tile(sign * np.eye(3)[axis], (len(near), 1))],
        )
    normals = np.concatenate(ways)
    roots = np.zeros((n, 6, 6))
    roots[:, range(6), range(6)] = (
        np.column_stack(
            [np.repeat(1 / masses[:, None], 3, 1), np.repeat(2.5 / masses[:, None], 3, 1)]
        )
        ** 0.5
    )
    return (
        (np.concatenate(first), np.concatenate(second), normals, -normals, normals),
        roots,
        falling(rng, n, 0.05),
    )


def stack(rng, ratio, height=4):
    """Return a tower of boxes, each with contacts at its four corners.

    The masses grow or fall by the ratio.
    """
    corners = np.array([[x, z] for x in (-0.5, 0.5) for z in (-0.5, 0.5)])
    n, masses = height, ratio ** (rng.permutation(height) / (height - 1))
    first = np.repeat(np.arange(n), 4)
    second = np.where(first > 0, first - 1, n)
    arms = np.column_stack(
        [np.tile(corners[:, 0], n), np.full(4 * n, -0.25), np.tile(corners[:, 1], n)]
    )
    shift = rng.uniform(-0.1, 0.1, (n, 3)) * [1, 0, 1]
    other_arms = arms + [0.0, 0.5, 0.0] + shift[first]
    inertia = np.array([0.25 + 1.0, 2.0, 1.0 + 0.25]) / 12
    roots = np.zeros((n, 6, 6))
    roots[:, range(6), range(6)] = (
        np.column_stack([np.repeat(1 / masses[:, None], 3, 1), 1 / (masses[:, None] * inertia)])
        ** 0.5
    )
    return (
        (first, second, np.tile([0.0, 1.0, 0.0], (4 * n, 1)), arms, other_arms),
        roots,
        falling(rng, n, 0.1),
    )


def anything(rng, ratio, n=8, k=20):
    """Return bodies of any inertia with contacts of any normal and arms.

    Each contact is between two bodies or a body and a wall; normals and tangents couple.
    """
    first = rng.integers(0, n, k)
    second = (first + rng.integers(1, n + 1, k)) % (n + 1)
    normals, arms, others = (rng.standard_normal((k, 3)) for _ in range(3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    roots = rng.standard_normal((n, 6, 6)) + np.eye(6)
    roots[:, :3, 3:] = roots[:, 3:, :3] = 0.0
    roots *= (ratio ** rng.uniform(-0.5, 0.0, n))[:, None, None]
    return (first, second, normals, arms, others), roots, rng.standard_normal((n, 6))
