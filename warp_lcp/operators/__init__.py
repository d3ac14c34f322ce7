"""Operators: A of y = A x + b, never assembled."""

from warp_lcp.operators.dense import DenseOperator
from warp_lcp.operators.grid_poisson import AIR, FLUID, SOLID, GridPoisson
from warp_lcp.operators.linear_operator import LinearOperator
from warp_lcp.operators.low_rank import LowRankOperator
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.operators.stencil import Stencil
from warp_lcp.operators.sum import SumOperator
from warp_lcp.problem.operator_protocol import Operator

__all__ = [
    "AIR",
    "FLUID",
    "SOLID",
    "DenseOperator",
    "GridPoisson",
    "LinearOperator",
    "LowRankOperator",
    "Operator",
    "SparseOperator",
    "Stencil",
    "SumOperator",
]
