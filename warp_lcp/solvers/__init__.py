"""Methods, one a file."""

from warp_lcp.solvers.default import default_method, solve
from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton
from warp_lcp.solvers.projected_multigrid import ProjectedMultigrid
from warp_lcp.solvers.psor import ProjectedSOR

__all__ = ["MinimumMapNewton", "ProjectedMultigrid", "ProjectedSOR", "default_method", "solve"]
