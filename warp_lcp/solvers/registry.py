"""The methods by name: the one table that scenes, the command line, the tests and the documentation read.

A new method is one file and one line here. Each class says in `supports` on which families of operators it works ("dense", "sparse",
"grid") and in `needs` what else it asks of A ("symmetric", ...). A class that takes small problems only has `most_unknowns`; one that takes
no upper bounds and no equations has `boxed = False`.
"""

from __future__ import annotations

from typing import Any

from warp_lcp.solvers.accelerated_projected_gradient import AcceleratedProjectedGradient
from warp_lcp.solvers.blocked_gauss_seidel import BlockedGaussSeidel
from warp_lcp.solvers.direct_enumeration import DirectEnumeration
from warp_lcp.solvers.incremental_pivoting import IncrementalPivoting
from warp_lcp.solvers.lemke import Lemke
from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton
from warp_lcp.solvers.mprgp import MPRGP
from warp_lcp.solvers.nncg import NNCG
from warp_lcp.solvers.projected_jacobi import ProjectedJacobi
from warp_lcp.solvers.projected_multigrid import ProjectedMultigrid
from warp_lcp.solvers.psor import ProjectedSOR
from warp_lcp.solvers.quadratic_program import QuadraticProgram
from warp_lcp.solvers.staggering import Staggering
from warp_lcp.solvers.subspace_minimization import SubspaceMinimization

METHODS: dict[str, type[Any]] = {
    "accelerated-projected-gradient": AcceleratedProjectedGradient,
    "blocked-gauss-seidel": BlockedGaussSeidel,
    "direct-enumeration": DirectEnumeration,
    "incremental-pivoting": IncrementalPivoting,
    "lemke": Lemke,
    "minimum-map-newton": MinimumMapNewton,
    "mprgp": MPRGP,
    "nncg": NNCG,
    "projected-jacobi": ProjectedJacobi,
    "projected-multigrid": ProjectedMultigrid,
    "psor": ProjectedSOR,
    "quadratic-program": QuadraticProgram,
    "staggering": Staggering,
    "subspace-minimization": SubspaceMinimization,
}
