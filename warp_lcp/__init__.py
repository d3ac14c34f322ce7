"""Solvers for large linear complementarity problems on CPU and CUDA.

Matrix-free methods as NVIDIA Warp kernels.
"""

import warnings
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

from warp_lcp.default_chain import default_chain
from warp_lcp.gradients.vjp import Gradients, vjp
from warp_lcp.import_aliases import install_aliases
from warp_lcp.kernels.log_filter import install_log_filter
from warp_lcp.kernels.thread_pool import get_threads, set_threads
from warp_lcp.linear_complementarity import linear_complementarity
from warp_lcp.method_selection import default_method, solve
from warp_lcp.monitor import plot_convergence, print_progress
from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.operators import (
    AIR,
    FLUID,
    SOLID,
    DenseOperator,
    GridPoisson,
    LinearOperator,
    LowRankOperator,
    Operator,
    SparseOperator,
    Stencil,
    SumOperator,
)
from warp_lcp.problem.affine_bounds import AffineBounds
from warp_lcp.problem.frictional_contact import FrictionalContact
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import Precision, Step
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.problem.result import Record, SolveResult, SolveStatus
from warp_lcp.problem.solve_loop import VariationalInequality
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.problem.workspace_cache import release_workspace
from warp_lcp.recommend import Budget, Recommendation, recommend
from warp_lcp.solvers.accelerated_projected_gradient import AcceleratedProjectedGradient
from warp_lcp.solvers.blocked_gauss_seidel import BlockedGaussSeidel, GridLines
from warp_lcp.solvers.direct_enumeration import BatchResult, DirectEnumeration, enumerate_batch
from warp_lcp.solvers.fallback import (
    Fallback,
    FallbackEntry,
    crawls,
    fails,
    slow_linear_solves,
    stalls,
)
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
from warp_lcp.solvers.psor import ProjectedSOR, advised_omega
from warp_lcp.solvers.quadratic_program import QuadraticProgram
from warp_lcp.solvers.registry import METHODS
from warp_lcp.solvers.staggering import Staggering
from warp_lcp.solvers.subspace_minimization import SubspaceMinimization

if TYPE_CHECKING:
    from warp_lcp.frames.read_frame import read_frame
    from warp_lcp.run.api import Run

install_log_filter()
install_aliases()

try:
    __version__ = version("warp-lcp")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"


def __getattr__(name: str) -> object:
    """Import the modules of simulations on first access.

    Programs that only solve problems do not load them.
    """
    if name == "read_frame":
        return import_module("warp_lcp.frames.read_frame").read_frame
    if name == "Run":
        return import_module("warp_lcp.run.api").Run
    if name == "ConvexSetProblem":
        warnings.warn(
            "wl.ConvexSetProblem is now wl.VariationalInequality", DeprecationWarning, stacklevel=2
        )
        return VariationalInequality
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = [
    "AIR",
    "FLUID",
    "LCP",
    "METHODS",
    "MPRGP",
    "NNCG",
    "SOLID",
    "AcceleratedProjectedGradient",
    "AffineBounds",
    "BatchResult",
    "BlockedGaussSeidel",
    "Budget",
    "CycleSettings",
    "DenseOperator",
    "DirectEnumeration",
    "Fallback",
    "FallbackEntry",
    "FischerNewton",
    "FrictionalContact",
    "GradientDescent",
    "Gradients",
    "GridLines",
    "GridPoisson",
    "IncrementalPivoting",
    "InteriorPoint",
    "Lemke",
    "LinearOperator",
    "LowRankOperator",
    "MinimumMapNewton",
    "NaturalResidual",
    "Operator",
    "Penalty",
    "Precision",
    "PrimalDualActiveSet",
    "ProjectedJacobi",
    "ProjectedMultigrid",
    "ProjectedSOR",
    "ProximalGaussSeidel",
    "ProximalPoint",
    "QuadraticProgram",
    "Recommendation",
    "Record",
    "Run",
    "SolveResult",
    "SolveStatus",
    "SparseOperator",
    "Staggering",
    "Stencil",
    "Step",
    "StoppingCriteria",
    "SubspaceMinimization",
    "SumOperator",
    "VariationalInequality",
    "advised_omega",
    "crawls",
    "default_chain",
    "default_method",
    "enumerate_batch",
    "fails",
    "get_threads",
    "linear_complementarity",
    "plot_convergence",
    "print_progress",
    "read_frame",
    "recommend",
    "release_workspace",
    "set_threads",
    "slow_linear_solves",
    "solve",
    "stalls",
    "vjp",
]
