"""Methods for contact impulses, and the friction model of each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.sparse import csr_array, vstack

import warp_lcp as wl
from warp_lcp.problem.method_protocol import Solver
from warp_lcp.rigid.contact_models import (
    BoxedModel,
    ContactModel,
    ContactSystem,
    StewartTrinkleModel,
)
from warp_lcp.rigid.contact_problem import ContactImpulses, ContactProblem
from warp_lcp.rigid.contacts import jacobian
from warp_lcp.solvers.registry import METHODS

# The solver of `warp_lcp.rigid.contact_problem`, which bodies in liquids and in sand use.
DEFAULT = "sweeps-and-newton"
# Default with joints, which are equations: sweeps converge slowly, pivoting is exact.
JOINTED = "lemke"
# Tolerance of the normal and the friction problem of a staggered iteration, solved by pivoting.
PIVOTING = 1e-8

# |r_t| <= mu r_n along each tangent: bounds that are affine in x.
BOXED: dict[str, Callable[[ContactSystem], Solver]] = {
    "nncg": lambda s: wl.NNCG(),
    "psor": lambda s: wl.ProjectedSOR(omega=1.0),
    "projected-jacobi": lambda s: wl.ProjectedJacobi(),
    "blocked-gauss-seidel": lambda s: wl.BlockedGaussSeidel(blocks=s.blocks()),
    "subspace-minimization": lambda s: wl.SubspaceMinimization(precision="double"),
    "staggering": lambda s: wl.Staggering(
        blocks=s.staggered(), solvers=wl.IncrementalPivoting(), eta=PIVOTING
    ),
}
# A polygonal cone with the slip as an additional unknown: an unsymmetric linear complementarity
# problem.
STEWART_TRINKLE: dict[str, Callable[[ContactSystem], Solver]] = {
    "lemke": lambda s: wl.Lemke(),
    "fischer-newton": lambda s: wl.FischerNewton(),
    "minimum-map-newton": lambda s: wl.MinimumMapNewton(),
    "interior-point": lambda s: wl.InteriorPoint(precision="double"),
    "primal-dual-active-set": lambda s: wl.PrimalDualActiveSet(),
}
# The circular cone, without an assembled matrix.
CONE: dict[str, Callable[[], Solver]] = {"proximal-gauss-seidel": wl.ProximalGaussSeidel}
# Methods for inverse kinematics, whose problems have small dense matrices and no blocks.
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


class RegistryContactMethod:
    """Solve the contact problem of a step by a method of `wl.METHODS`.

    It implements `ImpulseSolver`.

    Args:
        name: name of the method; DEFAULT for the solver of `warp_lcp.rigid`.
        directions: sides of the friction cone of Stewart and Trinkle, for the methods of that
            model.
        tolerance: residual to reach, relative to that of no impulses.
        most: limit of iterations.
        device: Warp device's name.

    Attributes:
        status: status of the last solve.
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
        """Return the impulses.

        If the method does not converge, see `status`, they are those of the least residual.
        """
        self.status = wl.SolveStatus.CONVERGED
        if self._method is None and self._cone is None:
            found = problem.solve(self._stopping, start, self._stopping.rtol)
            if found.residual > self._stopping.rtol:
                self.status = wl.SolveStatus.MAX_ITERATIONS
            return found
        # No contact approaches: impulses are 0.
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
        """Return impulses within the circular cones.

        Tolerances are relative to no impulses, as for the other models. The contacts have no
        compliance e here. If they are redundant (J'z = 0), as in jammed packings, e > 0 makes the
        impulses unique, but a sweep changes their component along z only by e / B: the residual |e
        r| would take 1 / YIELDS sweeps. Sweeps without e do not need unique impulses.
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
    """Return u = B r + b with B = J J' + diag(yields) as a matrix.

    The rows are those of all contacts, then of joints.
    """
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
