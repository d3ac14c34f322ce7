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
from warp_lcp.rigid.body import BodyStates


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
        self._part = grid.part
        self._scale = density * grid.cell_volume
        self.free_parts = grid.faces()
        self._flow = BodyCoupling(grid, boundary, bodies, density, open_parts=self.free_parts)
        self._flow.columns.comm = drag.columns.comm
        self.rank = drag.columns.rank
        self._factors = wp.zeros(self.rank, dtype=wp.float64, device=grid.device)
        self.start = np.zeros(self.rank)

    @property
    def velocities(self) -> np.ndarray:
        """V of all bodies [m/s, 1/s], shape (rank,)."""
        return np.ravel([body.velocities(self._dimension) for body in self.states])

    @property
    def states(self) -> BodyStates:
        """States of the bodies."""
        return self.bodies.bodies

    def keep_start(self) -> None:
        """Store V*, and the momenta."""
        self.start = self.velocities
        self._start_momenta = self.states.momenta()

    def update(
        self, level: ViscosityLevel, walls: ViscousWalls, velocity: Sequence[wp.array]
    ) -> None:
        """Compute the coupling of a step."""
        self._drag.update(level, walls, velocity)
        self._flow.update(walls.kind)
        self._flow.grow_entries()
        self.take_masses()
        self._D = self._drag.drags()
        self._response = np.linalg.inv(np.eye(self.rank) + self._m @ self._D)

    def take_masses(self) -> None:
        """Compute the masses of the bodies in their present poses and on their supports."""
        self._m = self._drag.inverse_masses()
        # Masses without supports: m itself is singular along supported directions, and a
        # pseudo-inverse of it amplifies rounding. For z and r in the range of m,
        # z'm^+ r = z'm0^-1 r with m0 = rho dx^d times the inverse of these masses.
        inverses = [body.free_inverse_mass(self._dimension) for body in self.states]
        self._masses = scipy.linalg.block_diag(*(np.linalg.inv(m) for m in inverses))
        self._energy = self._masses / self._scale

    @property
    def weights(self) -> np.ndarray:
        """Weights of the rows in the norm of residuals, shape (rank,)."""
        size = np.diag(self._m) * (1.0 + np.diag(self._m) * np.diag(self._D))
        return np.where(size > 0.0, 1.0 / np.where(size > 0.0, size, 1.0), 1.0)

    def pull(self, u: wp.array, x: wp.array | None) -> np.ndarray:
        """Return m (C'u + U'x)."""
        return np.asarray(self._m @ self._pulled(u, x))

    def _pulled(self, u: wp.array, x: wp.array | None) -> np.ndarray:
        """Return C'u + U'x."""
        total = self._drag.columns.gather(u).numpy().copy()
        if x is not None:
            total += self._flow.columns.gather(self._in_box(x)).numpy()
        return np.asarray(total)

    def _in_box(self, field: wp.array) -> wp.array:
        """Return a field of cells in the flat layout of the outflows U V."""
        box = self._part.box_like(field)
        self._part.copy_to_box(field, box)
        return box.flatten()

    def rows(self, V: np.ndarray, u: wp.array, x: wp.array) -> np.ndarray:
        """Return V - m (C'u - D V + U'x)."""
        return np.asarray(V + self._m @ (self._D @ V) - self.pull(u, x))

    def add_forces(self, V: np.ndarray, out: wp.array) -> None:
        """Subtract C V from the rows of velocities."""
        self._factors.assign(V)
        self._drag.columns.scatter(self._factors, out, out, sign=-1.0)

    def add_outflow(self, V: np.ndarray, out: wp.array, free: wp.array, *, sign: float) -> None:
        """Add sign U V to outflows of free cells, fields of the grid."""
        self._factors.assign(V)
        box, mask = self._in_box(out), self._in_box(free)
        self._flow.columns.scatter(self._factors, box, box, mask=mask, sign=sign)
        self._part.copy_from_box(box, out)

    def corrected(self, r: np.ndarray, z: wp.array) -> np.ndarray:
        """Return (1 + m D)^-1 (r + m C'z), the preconditioner's velocities."""
        return np.asarray(self._response @ (r + self.pull(z, None)))

    def square(self, z: np.ndarray, r: np.ndarray) -> float:
        """Return the energy z'm^-1 r of a correction."""
        return float(z @ self._energy @ r)

    def move(self, change: np.ndarray) -> None:
        """Change the velocities of the bodies, but not along supported directions.

        The impulse is M0 P dV: M0 are the masses without supports, and P = M^-1 M0 projects on the
        velocities that supports allow.
        """
        allowed = self._m @ (self._energy @ change)
        self._push(self._masses @ allowed)

    def apply_impulses(self, u: wp.array, x: wp.array) -> None:
        """Apply the impulse of the liquid, rho dx^d (C'u - D V + U'x), since `keep_start`.

        It has the parts, too, that supports absorb: they press the bodies on each other. Velocities
        change by the residual of the bodies' rows.
        """
        impulse = self._pulled(u, x) - self._D @ self.velocities
        self.states.restore_momenta(self._start_momenta)
        self._push(self._scale * impulse)

    def _push(self, impulses: np.ndarray) -> None:
        """Apply impulses, shape (rank,)."""
        self.states.apply_impulses(impulses.reshape(len(self.states), -1))

    def settle(self) -> None:
        """End the step: the bodies have its velocities."""
        self._drag.settle()
