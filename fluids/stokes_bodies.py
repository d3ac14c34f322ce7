"""Rigid bodies as unknowns of the coupled solve of velocity and pressure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg
import warp as wp

from warp_lcp.fluids.coupling import BodyCoupling
from warp_lcp.fluids.viscosity_bodies import BodyDrag, ViscousWalls
from warp_lcp.fluids.viscosity_level import ViscosityLevel
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.material.boundary import CutBoundary
from warp_lcp.rigid.bodies import RigidBodies


class StokesBodies:
    """Velocities V of rigid bodies as unknowns of the coupled solve.

    With m = rho dx^d M^-1, the viscous coupling C and D of `fluids.viscosity_bodies` and the
    outflow U V of the cells due to the bodies, their rows are

        V - m (C'u - D V + U'x) = V*.

    Rows of velocities have -C V, those of outflows U V. A face in a body that is partly open moves
    with it by its share, see `fluids.stokes_operator`: U has it by this share, too.

    Args:
        grid: the grid.
        boundary: its solids.
        bodies: the bodies.
        drag: their viscous coupling, set up by `take`.
        density: density of the liquid [kg/m^3].

    Attributes:
        free_parts: open fractions of faces times one minus the share of the wall, of each
            component; written by the caller before `take`.
        start: V* [m/s, 1/s], shape (rank,).
        rank: number of unknowns.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        boundary: CutBoundary,
        bodies: RigidBodies,
        drag: BodyDrag,
        density: float,
    ) -> None:
        self.bodies, self._dimension, self._drag = bodies, grid.dimension, drag
        self.free_parts = grid.faces()
        self._flow = BodyCoupling(grid, boundary, bodies, density, open_parts=self.free_parts)
        self._flow.columns.comm = drag.columns.comm
        self.rank = drag.columns.rank
        self._factors = wp.zeros(self.rank, dtype=wp.float64, device=grid.device)
        self.start = np.zeros(self.rank)

    @property
    def velocities(self) -> np.ndarray:
        """V of all bodies [m/s, 1/s], shape (rank,)."""
        return np.ravel([body.velocities(self._dimension) for body in self.bodies.bodies])

    def keep_start(self) -> None:
        """Store V*."""
        self.start = self.velocities

    def update(
        self, level: ViscosityLevel, walls: ViscousWalls, velocity: Sequence[wp.array]
    ) -> None:
        """Compute the coupling of a step."""
        self._drag.update(level, walls, velocity)
        self._flow.update(walls.kind)
        self._flow.grow_entries()
        self._m, self._D = self._drag.factors()
        inverses = [body.inverse_mass(self._dimension) for body in self.bodies.bodies]
        self._masses = scipy.linalg.block_diag(*(np.linalg.pinv(m) for m in inverses))
        self._response = np.linalg.inv(np.eye(self.rank) + self._m @ self._D)
        self._energy = np.linalg.pinv(self._m)

    @property
    def weights(self) -> np.ndarray:
        """Weights of the rows in the norm of residuals, shape (rank,)."""
        size = np.diag(self._m) * (1.0 + np.diag(self._m) * np.diag(self._D))
        return np.where(size > 0.0, 1.0 / np.where(size > 0.0, size, 1.0), 1.0)

    def pull(self, u: wp.array, x: wp.array | None) -> np.ndarray:
        """Return m (C'u + U'x)."""
        total = self._drag.columns.gather(u).numpy().copy()
        if x is not None:
            total += self._flow.columns.gather(x).numpy()
        return np.asarray(self._m @ total)

    def rows(self, V: np.ndarray, u: wp.array, x: wp.array) -> np.ndarray:
        """Return V - m (C'u - D V + U'x)."""
        return np.asarray(V + self._m @ (self._D @ V) - self.pull(u, x))

    def add_forces(self, V: np.ndarray, out: wp.array) -> None:
        """Subtract C V from the rows of velocities."""
        self._factors.assign(V)
        self._drag.columns.scatter(self._factors, out, out, sign=-1.0)

    def add_outflow(self, V: np.ndarray, out: wp.array, free: wp.array, *, sign: float) -> None:
        """Add sign U V to outflows of free cells."""
        self._factors.assign(V)
        self._flow.columns.scatter(self._factors, out, out, mask=free, sign=sign)

    def corrected(self, r: np.ndarray, z: wp.array) -> np.ndarray:
        """Return (1 + m D)^-1 (r + m C'z), the preconditioner's velocities."""
        return np.asarray(self._response @ (r + self.pull(z, None)))

    def square(self, z: np.ndarray, r: np.ndarray) -> float:
        """Return the energy z'm^-1 r of a correction."""
        return float(z @ self._energy @ r)

    def move(self, change: np.ndarray) -> None:
        """Change the velocities of the bodies."""
        count = len(self.bodies.bodies)
        self.bodies.bodies.apply_impulses((self._masses @ change).reshape(count, -1))

    def settle(self) -> None:
        """End the step: the bodies have its velocities."""
        self._drag.settle()
