"""Methods, one a file."""

from warp_lcp.solvers.accelerated_projected_gradient import AcceleratedProjectedGradient
from warp_lcp.solvers.blocked_gauss_seidel import BlockedGaussSeidel
from warp_lcp.solvers.coupled_problem import CoupledBlock, CoupledResult, StaggeredRound, solve_coupled
from warp_lcp.solvers.default import default_method, solve
from warp_lcp.solvers.direct_enumeration import BatchResult, DirectEnumeration, enumerate_batch
from warp_lcp.solvers.fischer_newton import FischerNewton
from warp_lcp.solvers.gradient_descent import GradientDescent
from warp_lcp.solvers.grid_lines import GridLines
from warp_lcp.solvers.incremental_pivoting import IncrementalPivoting
from warp_lcp.solvers.interior_point import InteriorPoint
from warp_lcp.solvers.lemke import Lemke
from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton
from warp_lcp.solvers.mprgp import MPRGP
from warp_lcp.solvers.nncg import NNCG
from warp_lcp.solvers.primal_dual_active_set import PrimalDualActiveSet
from warp_lcp.solvers.projected_jacobi import ProjectedJacobi
from warp_lcp.solvers.projected_multigrid import ProjectedMultigrid
from warp_lcp.solvers.psor import ProjectedSOR, advised_omega
from warp_lcp.solvers.quadratic_program import QuadraticProgram
from warp_lcp.solvers.registry import METHODS
from warp_lcp.solvers.staggering import Staggering
from warp_lcp.solvers.subspace_minimization import SubspaceMinimization

__all__ = [
    "METHODS",
    "MPRGP",
    "NNCG",
    "AcceleratedProjectedGradient",
    "BatchResult",
    "BlockedGaussSeidel",
    "CoupledBlock",
    "CoupledResult",
    "DirectEnumeration",
    "FischerNewton",
    "GradientDescent",
    "GridLines",
    "IncrementalPivoting",
    "InteriorPoint",
    "Lemke",
    "MinimumMapNewton",
    "PrimalDualActiveSet",
    "ProjectedJacobi",
    "ProjectedMultigrid",
    "ProjectedSOR",
    "QuadraticProgram",
    "StaggeredRound",
    "Staggering",
    "SubspaceMinimization",
    "advised_omega",
    "default_method",
    "enumerate_batch",
    "solve",
    "solve_coupled",
]
