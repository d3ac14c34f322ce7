"""Methods, one a file."""

from warp_lcp.solvers.default import default_method, solve
from warp_lcp.solvers.direct_enumeration import BatchResult, DirectEnumeration, enumerate_batch
from warp_lcp.solvers.incremental_pivoting import IncrementalPivoting
from warp_lcp.solvers.lemke import Lemke
from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton
from warp_lcp.solvers.projected_multigrid import ProjectedMultigrid
from warp_lcp.solvers.psor import ProjectedSOR
from warp_lcp.solvers.quadratic_program import QuadraticProgram
from warp_lcp.solvers.registry import METHODS

__all__ = [
    "METHODS",
    "BatchResult",
    "DirectEnumeration",
    "IncrementalPivoting",
    "Lemke",
    "MinimumMapNewton",
    "ProjectedMultigrid",
    "ProjectedSOR",
    "QuadraticProgram",
    "default_method",
    "enumerate_batch",
    "solve",
]
