"""Motion of rigid bodies in NumPy, array by array.

It is the same as the loop in `warp_lcp/rigid/headers/motion.h`.
"""

import numpy as np

# v @ CROSS is the matrix of v x.
CROSS = np.cross(np.eye(3)[:, None], np.eye(3)[None]).transpose(0, 2, 1).reshape(3, 9)


def cross_matrix(vector):
    return (vector @ CROSS).reshape(*vector.shape, 3)


def spins(rotation, inverse_inertia, momentum):
    """Return angular velocities R I^-1 R' L."""
    return (rotation @ (inverse_inertia @ (rotation.swapaxes(-1, -2) @ momentum[..., None])))[
        ..., 0
    ]


def sinc(x):
    y = np.pi * x
    y = np.where(y, y, np.finfo(np.float64).eps)
    return np.sin(y) / y


def rotation_by(vector):
    """Return rotations by |v| about v."""
    angle = np.sqrt(np.square(vector).sum(axis=-1))[..., None, None] / np.pi
    K = cross_matrix(vector)
    return np.eye(3) + sinc(angle) * K + (0.5 * sinc(0.5 * angle) ** 2 * K) @ K


def orthonormal(rotation):
    """Return the rotations nearest to almost orthonormal matrices R.

    R (3 - R'R) / 2 is Newton's step to the polar factor.
    """
    return 0.5 * rotation @ (3.0 * np.eye(3) - rotation.swapaxes(-1, -2) @ rotation)


def advanced(values, mass, inverse_inertia, dt):
    """Return values of bodies, shape (n, 26), after times dt, shape (n,)."""
    values, time = values.copy(), dt[:, None]
    R, L = values[:, 3:12].reshape(-1, 3, 3), values[:, 15:18]
    half, left = 0.5 * time * spins(R, inverse_inertia, L), np.arange(len(R))
    for _ in range(60):
        before = half[left]
        half[left] = (
            0.5 * time[left] * spins(rotation_by(before) @ R[left], inverse_inertia[left], L[left])
        )
        left = left[~(np.abs(half[left] - before).max(axis=1) <= 1e-15)]
        if not len(left):
            break
    turned = orthonormal(rotation_by(2.0 * half) @ R)
    values[:, :3] += time * (values[:, 12:15] / mass[:, None])
    values[:, 3:12] = turned.reshape(-1, 9)
    values[:, 18] += dt * spins(turned, inverse_inertia, L)[:, 2]
    values[:, 19] += dt
    return values


def velocity_fields(values, mass, inverse_inertia):
    """Return turns and shifts: a point x of a body moves at turn x + shift."""
    turn = cross_matrix(spins(values[:, 3:12].reshape(-1, 3, 3), inverse_inertia, values[:, 15:18]))
    return turn, values[:, 12:15] / mass[:, None] - (turn @ values[:, :3, None])[..., 0]


def corners(low, high):
    ends = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(-1, 3)
    return np.stack([low, high], axis=-2)[..., ends, np.arange(3)]


def top_speed(R, t, boxes, size, span):
    """Return the largest speed of corners of boxes between m poses.

    The boxes are clipped to the domain. R has shape (m, n, 3, 3), t has shape (m, n, 3).
    """

    def applied(R, t, points):
        return points @ R.swapaxes(-1, -2) + t[..., None, :]

    def inverse(R, t):
        back = R.swapaxes(-1, -2)
        return back, (-back @ t[..., None])[..., 0]

    parts, limited = len(R) - 1, np.isfinite(boxes[:, 0, :1])
    placed = applied(
        R, t, corners(*np.moveaxis(np.where(limited[:, None] & (size > 0.0), boxes, 0.0), 1, 0))
    )
    low = np.where(limited, np.maximum(0.0, placed.min(axis=-2)), 0.0)
    high = np.where(limited, np.minimum(size, placed.max(axis=-2)), size)
    points, inside = corners(low, high), np.all(low <= high, axis=-1)
    back = inverse(R[:-1], t[:-1])
    way = R[1:] @ back[0], (R[1:] @ back[1][..., None])[..., 0] + t[1:]
    fastest = 0.0
    for step, ends in ((way, slice(None, -1)), (inverse(*way), slice(1, None))):
        ways = applied(*step, points[ends]) - points[ends]
        speeds = np.sqrt(np.square(ways).sum(axis=-1)).max(axis=-1) * parts / span
        fastest = max(fastest, float(speeds.max(initial=0.0, where=inside[ends])))
    return fastest
