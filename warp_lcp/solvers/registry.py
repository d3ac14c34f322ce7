"""Table of the methods by name.

Scenes, the command line, the tests and the documentation read it. A new method is one file and one
line here. Each class lists in `supports` the capabilities of an operator of which it needs at least
one (see `warp_lcp.problem.operator_protocol`; no attribute if every operator will do), and says in
`needs` what must hold of A ("symmetric", ...). A class for small problems only has `most_unknowns`.
A class whose problems are no `LCP` names their class as `problems`; it takes no operators, so that
its `families` are empty. A class that takes no upper bounds and no equations has `boxed = False`. A
class that ends with NEGATIVE_CURVATURE where A is surely no P- and no semi-definite matrix has
`definite = True`.
"""

from __future__ import annotations

from inspect import signature
from typing import Any

from warp_lcp.problem.method_protocol import Solver
from warp_lcp.problem.operator_protocol import declared, families
from warp_lcp.settings import nearest
from warp_lcp.solvers.accelerated_projected_gradient import AcceleratedProjectedGradient
from warp_lcp.solvers.blocked_gauss_seidel import BlockedGaussSeidel
from warp_lcp.solvers.direct_enumeration import DirectEnumeration
from warp_lcp.solvers.fischer_newton import FischerNewton
from warp_lcp.solvers.gradient_descent import GradientDescent
from warp_lcp.solvers.incremental_pivoting import IncrementalPivoting
from warp_lcp.solvers.interior_point import InteriorPoint
from warp_lcp.solvers.lemke import Lemke
from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton
from warp_lcp.solvers.mprgp import MPRGP
from warp_lcp.solvers.nncg import NNCG
from warp_lcp.solvers.penalty import Penalty
from warp_lcp.solvers.primal_dual_active_set import PrimalDualActiveSet
from warp_lcp.solvers.projected_jacobi import ProjectedJacobi
from warp_lcp.solvers.projected_multigrid import ProjectedMultigrid
from warp_lcp.solvers.proximal_gauss_seidel import ProximalGaussSeidel
from warp_lcp.solvers.proximal_point import ProximalPoint
from warp_lcp.solvers.psor import ProjectedSOR
from warp_lcp.solvers.quadratic_program import QuadraticProgram
from warp_lcp.solvers.staggering import Staggering
from warp_lcp.solvers.subspace_minimization import SubspaceMinimization

ALSO = {
    "ipm": "interior-point",
    "pgs": "psor",
    "sor": "psor",
    "gauss-seidel": "psor",
    "jacobi": "projected-jacobi",
    "simplex": "lemke",
    "piqp": "quadratic-program",
}


class MethodRegistry(dict[str, type[Any]]):
    """Methods by their names; the KeyError of an unknown name lists near ones."""

    def __missing__(self, name: str) -> type[Any]:
        """Raise a KeyError for a name that no method has."""
        raise KeyError(f"no such method: {name!r}; {self.nearest(name)}")

    def nearest(self, name: object) -> str:
        """Return `did you mean ...?` for initials, class names and synonyms.

        For other names the result is that of `settings.nearest`.
        """
        word = str(name).lower().replace("_", "-").replace(" ", "-")
        for name_of_method, kind in self.items():
            initials = "".join(part[0] for part in name_of_method.split("-"))
            if ALSO.get(word, name_of_method) == name_of_method and (
                word in ALSO or word in (initials, kind.__name__.lower())
            ):
                return f"did you mean {name_of_method!r}?"
        return nearest(word, self)


METHODS = MethodRegistry(
    {
        "accelerated-projected-gradient": AcceleratedProjectedGradient,
        "blocked-gauss-seidel": BlockedGaussSeidel,
        "direct-enumeration": DirectEnumeration,
        "fischer-newton": FischerNewton,
        "gradient-descent": GradientDescent,
        "incremental-pivoting": IncrementalPivoting,
        "interior-point": InteriorPoint,
        "lemke": Lemke,
        "minimum-map-newton": MinimumMapNewton,
        "mprgp": MPRGP,
        "nncg": NNCG,
        "penalty": Penalty,
        "primal-dual-active-set": PrimalDualActiveSet,
        "projected-jacobi": ProjectedJacobi,
        "projected-multigrid": ProjectedMultigrid,
        "proximal-gauss-seidel": ProximalGaussSeidel,  # of `FrictionalContact`
        "proximal-point": ProximalPoint,
        "psor": ProjectedSOR,
        "quadratic-program": QuadraticProgram,
        "staggering": Staggering,
        "subspace-minimization": SubspaceMinimization,
    }
)


def method_of(method: str | Solver, name: str = "method") -> Solver:
    """Return the method of a name in METHODS, with its default settings.

    A method instance is returned unchanged.

    Args:
        method: a name, or a method with its settings.
        name: of the argument, for messages.

    Raises:
        ValueError: no method has this name.
    """
    if not isinstance(method, str):
        return method
    if method not in METHODS:
        meant = f"; {METHODS.nearest(method)}" if "did you mean" in METHODS.nearest(method) else ""
        raise ValueError(
            f"{name} = {method!r}: must be one of {', '.join(METHODS)}, a method with its settings "
            f"or None{meant}"
        )
    made: Solver = METHODS[method]()
    return made


def grid_methods() -> tuple[str, ...]:
    """Return the names of the methods that a scene may name.

    They take a grid of any size and a precision.
    """
    grids = [
        (name, method)
        for name, method in METHODS.items()
        if "grid" in families(method) and declared(method).most_unknowns is None
    ]
    return tuple(name for name, method in grids if "precision" in signature(method).parameters)
