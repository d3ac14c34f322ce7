"""Matrix-free solvers for large linear complementarity problems, as NVIDIA Warp kernels on CPU and CUDA."""

from importlib.metadata import PackageNotFoundError, version

from warp_lcp.affine_bounds import AffineBounds
from warp_lcp.kernel_messages import hear_kernels
from warp_lcp.operators import (
    AIR,
    FLUID,
    SOLID,
    DenseOperator,
    GridPoisson,
    LowRankOperator,
    Operator,
    SparseOperator,
    SumOperator,
)
from warp_lcp.problem import LCP
from warp_lcp.recommend import Budget, Recommendation, recommend
from warp_lcp.residual import NaturalResidual
from warp_lcp.result import Record, SolveResult, SolveStatus
from warp_lcp.solve import Precision, Step
from warp_lcp.solvers import (
    METHODS,
    MPRGP,
    NNCG,
    AcceleratedProjectedGradient,
    BatchResult,
    BlockedGaussSeidel,
    CoupledBlock,
    CoupledResult,
    DirectEnumeration,
    FischerNewton,
    GradientDescent,
    GridLines,
    IncrementalPivoting,
    InteriorPoint,
    Lemke,
    MinimumMapNewton,
    PrimalDualActiveSet,
    ProjectedJacobi,
    ProjectedMultigrid,
    ProjectedSOR,
    QuadraticProgram,
    StaggeredRound,
    Staggering,
    SubspaceMinimization,
    advised_omega,
    default_method,
    enumerate_batch,
    solve,
    solve_coupled,
)
from warp_lcp.stopping import StoppingCriteria

hear_kernels()

try:
    __version__ = version("warp-lcp")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"

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
    "CoupledBlock",
    "CoupledResult",
    "DenseOperator",
    "DirectEnumeration",
    "FischerNewton",
    "GradientDescent",
    "GridLines",
    "GridPoisson",
    "IncrementalPivoting",
    "InteriorPoint",
    "Lemke",
    "LowRankOperator",
    "MinimumMapNewton",
    "NaturalResidual",
    "Operator",
    "Precision",
    "PrimalDualActiveSet",
    "ProjectedJacobi",
    "ProjectedMultigrid",
    "ProjectedSOR",
    "QuadraticProgram",
    "Recommendation",
    "Record",
    "SolveResult",
    "SolveStatus",
    "SparseOperator",
    "StaggeredRound",
    "Staggering",
    "Step",
    "StoppingCriteria",
    "SubspaceMinimization",
    "SumOperator",
    "advised_omega",
    "default_method",
    "enumerate_batch",
    "recommend",
    "solve",
    "solve_coupled",
]
