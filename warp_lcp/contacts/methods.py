"""The methods that solve for the impulses of contacts, and the model of friction that each of them takes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.sparse import csr_array, vstack

import warp_lcp as wl
from warp_lcp.gallery.contact_models import (
    BoxedModel,
    ContactModel,
    ContactSystem,
    StewartTrinkleModel,
)
from warp_lcp.rigid.contact_problem import ContactImpulses, ContactProblem
from warp_lcp.rigid.contacts import jacobian
from warp_lcp.solvers.registry import METHODS

# of `warp_lcp.rigid.contact_problem`: what bodies in liquids and in sand are solved by
DEFAULT = "sweeps-and-newton"
# in its place where there are joints, which are equations: sweeps are slow at them, pivots exact
JOINTED = "lemke"
# of the normal and the friction problem of a staggered iteration, solved by pivoting
PIVOTING = 1e-8

# |r_t| <= mu r_n along each tangent: bounds that are affine in x
BOXED: dict[str, Callable[[ContactSystem], Any]] = {
    "nncg": lambda s: wl.NNCG(),
    "psor": lambda s: wl.ProjectedSOR(omega=1.0),
    "projected-jacobi": lambda s: wl.ProjectedJacobi(),
    "blocked-gauss-seidel": lambda s: wl.BlockedGaussSeidel(blocks=s.blocks()),
    "subspace-minimization": lambda s: wl.SubspaceMinimization(precision="double"),
    "staggering": lambda s: wl.Staggering(
        blocks=s.staggered(), solvers=wl.IncrementalPivoting(), eta=PIVOTING
    ),
}
# a cone of several sides and the slip as one more unknown: an unsymmetric linear complementarity
# problem
STEWART_TRINKLE: dict[str, Callable[[ContactSystem], Any]] = {
    "lemke": lambda s: wl.Lemke(),
    "fischer-newton": lambda s: wl.FischerNewton(),
    "minimum-map-newton": lambda s: wl.MinimumMapNewton(),
    "interior-point": lambda s: wl.InteriorPoint(precision="double"),
    "primal-dual-active-set": lambda s: wl.PrimalDualActiveSet(),
}
# the circular cone itself, bodies instead of a matrix
CONE: dict[str, Callable[[], Any]] = {"proximal-gauss-seidel": wl.ProximalGaussSeidel}
# of inverse kinematics, whose problems have small dense matrices and no blocks
KINEMATIC = (
    "lemke",
    "fischer-newton",
    "minimum-map-newton",
    "interior-point",
    "primal-dual-active-set",
    "nncg",
    "psor",
)
assert {*BOXED, *STEWART_TRINKLE, *CONE} <= METHODS.keys()


class MethodOfChoice:
    """Solve the problem of a step's contacts by a method of `wl.METHODS`; an `ImpulseSolver`.

    Args:
        name: of the method; DEFAULT for none of them.
        directions: sides of the friction cone of Stewart and Trinkle, for the methods of that
            model.
        tolerance: residual to reach, relative to that of no impulses.
        most: iterations.
        device: Warp device's name.

    Attributes:
        status: of the last solve.
    """

    def __init__(
        self, name: str, *, directions: int, tolerance: float, most: int, device: str
    ) -> None:
        self._method, self._cone = BOXED.get(name) or STEWART_TRINKLE.get(name), CONE.get(name)
        self._model: ContactModel = (
            StewartTrinkleModel(directions) if name in STEWART_TRINKLE else BoxedModel()
        )
        self._stopping = wl.StoppingCriteria(rtol=tolerance, max_iterations=most, patience=most)
        self._device, self.status = device, wl.SolveStatus.CONVERGED

    def __call__(self, problem: ContactProblem, start: np.ndarray) -> ContactImpulses:
        """Return the impulses; those of the least residual where the method does not converge, as `status` says."""
        self.status = wl.SolveStatus.CONVERGED
        if self._method is None and self._cone is None:
            found = problem.solve(self._stopping, start, self._stopping.rtol)
            if found.residual > self._stopping.rtol:
                self.status = wl.SolveStatus.MAX_ITERATIONS
            return found
        # nothing approaches: impulses are 0
        if problem.joints is None and not (problem.b[:, 0] < 0.0).any():
            return ContactImpulses(np.zeros_like(start), 0.0, 0)
        if self._method is None:
            return self._in_cones(problem, start)
        system = contact_system(problem)
        lcp = self._model.problem(system).lcp(device=self._device)
        x0 = self._model.guess(system, start.ravel())
        result = wl.solve(
            lcp, wl.default_chain(self._method(system), lcp), stopping=self._stopping, x0=x0
        )
        self.status = result.status
        impulses = self._model.impulses(system, result.x.numpy()).reshape(start.shape)
        return ContactImpulses(impulses, float(result.relative_residual), result.iterations)

    def _in_cones(self, problem: ContactProblem, start: np.ndarray) -> ContactImpulses:
        """Return the impulses in the circular cones; tolerances are relative to no impulses, as those of the other models.

        Contacts do not yield here. Where they are redundant (J'z = 0), as in jammed packings, e > 0
        makes the impulses unique, but a sweep changes their part along z by e / B only: the
        residual |e r| would take 1 / YIELDS sweeps. Sweeps without e need no unique impulses.
        """
        p = problem
        cones = wl.FrictionalContact(
            p.first, p.second, p.one, p.other, p.b, p.friction, p.bodies, device=self._device
        )
        assert self._cone is not None
        stopping = replace(self._stopping, rtol=0.0, atol=self._stopping.rtol * cones.reference)
        result = wl.solve(cones, self._cone(), stopping=stopping, x0=start)
        self.status = result.status
        return ContactImpulses(
            result.x.numpy().copy(), result.residual / cones.reference, result.iterations
        )


def contact_system(problem: ContactProblem) -> ContactSystem:
    """Return u = B r + b with B = J J' + diag(yields) as a matrix, shape (rows of all contacts, then of joints, the same)."""
    dim, joints, n = problem.one.shape[1], problem.joints, problem.bodies
    parts = (
        [jacobian(problem.first, problem.second, problem.one, problem.other, n)]
        if len(problem.friction)
        else []
    )
    parts += [joints.rows.jacobian(n)] if joints is not None else []
    J = csr_array(vstack(parts))
    B = csr_array(J @ J.T)
    _, yields = problem.yields()
    B.setdiag(B.diagonal() + np.concatenate([yields, np.zeros(J.shape[0] - len(yields))]))
    B = csr_array(0.5 * (B + B.T))  # rounding must not make it unsymmetric
    if joints is None:
        return ContactSystem("contacts", B, problem.b.ravel(), problem.friction, dim=dim)
    b = np.concatenate([problem.b.ravel(), joints.b])
    return ContactSystem(
        "contacts and joints", B, b, problem.friction, joints.rows.lower, joints.rows.upper, dim=dim
    )
