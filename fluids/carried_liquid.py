"""Liquid that moves with thin rigid bodies, up to the nearest cell centers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from warp_lcp.grid.barriers import Barriers
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.operators.grid_poisson import FLUID
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.rigid.body import PLANAR


class CarriedLiquid:
    """Added mass of the liquid beside thin rigid bodies.

    The pressure acts on such a body at cells' centers, a cell apart. The liquid between these
    centers and the body moves with the body: its mass m at each face f has, along the normal n, the
    body's velocity n . V_f there. With the unit motions c_f of the body's point at the face, the
    matrix G = sum of m c c' and the sum g of m c u* of the liquid's velocities u*,

        V = V* + H (I + g - G V)

    after impulses I, where H is the inverse of the body's mass matrix. The body then has the
    inverse mass W = (1 + H G)^-1 H, and of impulses I its own share is I - G W I.

    Args:
        grid: the grid.
        barriers: thin solids, with bodies among them.
        bodies: the bodies.
        density: of the liquid [kg/m^3].

    Attributes:
        mass: G of each body, shape (n, k, k), k = 3 in 2-D (vx, vy, wz), 6 in 3-D.
        momentum: g, shape (n, k).
    """

    def __init__(
        self, grid: StaggeredGrid, barriers: Barriers, bodies: RigidBodies, density: float
    ) -> None:
        self.grid, self.barriers, self.bodies = grid, barriers, bodies
        self._each = density * grid.cell_volume
        width, count = (3 if grid.dimension == 2 else 6), len(bodies.bodies)
        self.mass, self.momentum = np.zeros((count, width, width)), np.zeros((count, width))
        self._body = np.full(1 + max(bodies.numbers), -1)
        self._body[bodies.numbers] = np.arange(count)

    def update(self, velocity: Sequence[wp.array], kind: wp.array) -> None:
        """Compute G and g, and share the liquid's momentum with the bodies; collective.

        Args:
            velocity: u* of each component [m/s].
            kind: int8 of AIR, FLUID, SOLID.
        """
        self._find(velocity, kind)
        inverse = self.bodies.bodies.inverse_masses(self.grid.dimension)
        before = np.array([body.velocities(self.grid.dimension) for body in self.bodies.bodies])
        free = before + np.einsum("nij,nj->ni", inverse, self.momentum)
        after = np.linalg.solve(self._joined(inverse), free[..., None])[..., 0]
        lost = np.einsum("nij,nj->ni", self.mass, after)
        self.bodies.bodies.apply_impulses(self.momentum - lost)

    def inverse_masses(self, inverse: np.ndarray) -> np.ndarray:
        """Return W, given H, of shape (n, k, k)."""
        joined = np.linalg.solve(self._joined(inverse), inverse)
        return np.asarray(0.5 * (joined + joined.swapaxes(-1, -2)))

    def share(self, impulses: np.ndarray) -> np.ndarray:
        """Return the bodies' own share of impulses, shape (n, k)."""
        inverse = self.bodies.bodies.inverse_masses(self.grid.dimension)
        changed = np.einsum("nij,nj->ni", self.inverse_masses(inverse), impulses)
        return np.asarray(impulses - np.einsum("nij,nj->ni", self.mass, changed))

    def _joined(self, inverse: np.ndarray) -> np.ndarray:
        return np.asarray(np.eye(inverse.shape[-1]) + inverse @ self.mass)

    def _find(self, velocity: Sequence[wp.array], kind: wp.array) -> None:
        """Sum up G and g over the faces of this process, and then over all processes.

        The liquid up to the cell centers at distances a below and b above the solid [cells], 0
        where that cell is not FLUID, has at face f the mass m = rho dx^d (a + b) [kg; kg/m in 2-D]
        and the momentum m u* = rho dx^d (a u_below + b u_above) along the axis n of the face. With
        c = (n, r x n), r from the body's center of mass to the face's center [m], G = sum of m c c'
        and g = sum of m u* c. The velocities are those of the faces beside f, since particles may
        not reach f itself.
        """
        grid, part, barriers = self.grid, self.grid.part, self.barriers
        near = barriers.reach.common(grid.domain)
        window = None if near is None else near.common(part.faces(near))
        mass, momentum = np.zeros((len(self.mass), 6, 6)), np.zeros((len(self.mass), 6))
        low, high = ((), ()) if window is None else (window.low, window.high)
        cells = tuple(map(slice, low, high))
        for axis in range(grid.dimension) if window is not None else ():
            number = barriers.number[axis].numpy()[cells]
            known = np.minimum(number, len(self._body) - 1)
            body = np.where(number < len(self._body), self._body[known], -1)
            at = np.argwhere(body >= 0)
            step = np.eye(3, dtype=int)[2 - axis]
            under, face, over = (tuple((at + low + n * step).T) for n in (-1, 0, 1))
            u, wet = velocity[axis].numpy(), kind.numpy() == FLUID
            below = np.where(wet[under], barriers.below[axis].numpy()[face], 0.0)
            above = np.where(wet[face], barriers.above[axis].numpy()[face], 0.0)
            # Velocities of the neighboring faces, since particles may not see this one.
            moved = below * u[under] + above * u[over]
            place = (np.array(face).T[:, ::-1] + np.array(grid.origin) - 0.5) * grid.spacing
            place[:, axis] -= 0.5 * grid.spacing
            if grid.dimension == 2:
                place[:, 2] = 0.0
            owner = body[tuple(at.T)]
            normal = np.eye(3)[axis]
            lever = place - np.array([b.position for b in self.bodies.bodies])[owner]
            unit = np.hstack([np.broadcast_to(normal, lever.shape), np.cross(lever, normal)])
            m = self._each * (below + above)
            np.add.at(mass, owner, m[:, None, None] * unit[:, :, None] * unit[:, None, :])
            np.add.at(momentum, owner, (self._each * moved)[:, None] * unit)
        mass, momentum = part.ranks.sum(mass), part.ranks.sum(momentum)
        planar = slice(None) if grid.dimension == 3 else PLANAR
        self.mass, self.momentum = mass[:, planar][:, :, planar], momentum[:, planar]
