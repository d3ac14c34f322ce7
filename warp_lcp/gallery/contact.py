"""Frictional contact of random rigid bodies as an LCP, with a polyhedral friction cone (Stewart and Trinkle; [Book] 1.3.5)."""

from __future__ import annotations

import numpy as np

from warp_lcp.gallery.problem import Problem


def contact_jacobian(bodies: int, contacts: int, directions: int, rng: np.random.Generator) -> np.ndarray:
    """Return J with the relative velocity along each contact's normal and tangents, shape (contacts (1 + directions), 6 bodies).

    Body i is a sphere of radius 1; each contact joins it to another one or to the ground at a random point of its surface. The tangents
    come in opposite pairs, evenly around the normal.
    """
    J = np.zeros((contacts, 1 + directions, 6 * bodies))
    for k in range(contacts):
        i = k % bodies  # every body has a contact
        j = int(rng.integers(-1, bodies))
        normal = rng.standard_normal(3)
        normal /= np.linalg.norm(normal)
        first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
        first /= np.linalg.norm(first)
        second = np.cross(normal, first)
        angles = rng.uniform(0, 2 * np.pi) + 2 * np.pi * np.arange(directions) / directions
        axes = np.vstack([normal, np.outer(np.cos(angles), first) + np.outer(np.sin(angles), second)])
        arm = -normal + 0.1 * rng.standard_normal(3)
        J[k, :, 6 * i : 6 * i + 6] = np.hstack([axes, np.cross(arm, axes)])
        if j not in (-1, i):
            J[k, :, 6 * j : 6 * j + 6] -= np.hstack([axes, np.cross(-arm, axes)])
    return J.reshape(-1, 6 * bodies)


def contact(contacts: int, *, directions: int = 4, bodies: int | None = None, friction: float = 0.5, seed: int = 2015) -> Problem:
    """Return the impulse problem of random bodies with velocities v that touch: a block of 2 + directions rows a contact.

    A block's unknowns are the normal impulse, `directions` tangential ones and the slip speed beta:
    y_n = J_n v', y_t = J_t v' + beta, y_beta = friction x_n - sum of x_t, with v' = v + M^-1 J'(x_n, x_t) and b = (J v, 0). A is
    copositive and not symmetric, its beta rows have a zero diagonal. Whatever v is there is a solution (Anitescu, Potra), which Lemke's
    method finds; impulses need not be unique.

    Args:
        contacts: how many; a problem has (2 + directions) contacts unknowns.
        directions: tangents of a contact, an even number >= 2.
        bodies: how many; half as many as contacts if None.
        friction: coefficient mu >= 0.
        seed: of all choices.

    Raises:
        ValueError: an argument is out of range.
    """
    if directions < 2 or directions % 2:
        raise ValueError(f"directions = {directions}: must be an even number >= 2")
    if contacts < 1 or not friction >= 0:
        raise ValueError(f"contacts = {contacts}, friction = {friction}: at least one contact, friction >= 0")
    bodies = bodies or max(1, contacts // 2)
    rng = np.random.default_rng(seed)
    J = contact_jacobian(bodies, contacts, directions, rng)
    mass = rng.uniform(0.5, 2.0, bodies)
    inverse_mass = np.repeat(1 / mass, 6) * np.tile([1.0, 1.0, 1.0, 2.5, 2.5, 2.5], bodies)  # a solid sphere's inertia is 2/5 m r^2
    v = rng.standard_normal(6 * bodies)
    m, K = 2 + directions, directions
    A, b = np.zeros((m * contacts, m * contacts)), np.zeros(m * contacts)
    impulses = (m * np.arange(contacts)[:, None] + np.arange(1 + K)).ravel()
    A[np.ix_(impulses, impulses)] = (J * inverse_mass) @ J.T
    b[impulses] = J @ v
    for k in range(contacts):
        normal, tangents, beta = m * k, m * k + 1 + np.arange(K), m * k + 1 + K
        A[beta, normal] = friction
        A[beta, tangents], A[tangents, beta] = -1.0, 1.0
    n = len(b)
    facts = frozenset({"copositive", "solvable"})
    return Problem(f"contact {contacts} x {K} directions", A, b, np.zeros(n), np.full(n, np.inf), None, facts)
