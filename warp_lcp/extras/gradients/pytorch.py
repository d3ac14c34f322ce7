"""Solutions as PyTorch functions, with gradients by `wl.vjp` (extra `torch`).

Tensors share memory with Warp arrays.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Unpack

import numpy as np
import warp as wp

from warp_lcp.gradients.names import (
    Coefficients,
    MakesOperator,
    Name,
    SolveOptions,
    flat,
    nested,
    operator_of,
)
from warp_lcp.gradients.vjp import vjp
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.method_selection import solve as solve_problem
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.operator_protocol import Operator
from warp_lcp.problem.stopping import StoppingCriteria

if TYPE_CHECKING:
    import torch
    from torch.autograd.function import FunctionCtx


def solve(
    A: Operator | MakesOperator,
    b: torch.Tensor,
    lower: torch.Tensor | float = 0.0,
    upper: torch.Tensor | float = np.inf,
    *,
    coefficients: Coefficients | None = None,
    adjoint: StoppingCriteria | None = None,
    **options: Unpack[SolveOptions],
) -> torch.Tensor:
    """Return the solution x as a PyTorch tensor with gradients to all given tensors.

    x solves y = A x + b with bounds; it has the type of b.

    Args:
        A: an operator, or a function of `coefficients` that returns one, such as
            `functools.partial(wl.GridPoisson, cells)`; same device.
        b: as of `wl.LCP`, a tensor.
        lower: a tensor or a number.
        upper: likewise.
        coefficients: arguments of A by name, tensors or numbers.
        adjoint: criteria of the linear solve of the gradients.
        options: of `wl.solve`.

    Raises:
        ArithmeticError: a solve does not converge; the message gives its status.
        ValueError: as of `wl.LCP`, `wl.solve` and `wl.vjp`.
    """
    given = flat({"b": b, "lower": lower, "upper": upper, **(coefficients or {})})
    return _solution().apply((A, options, adjoint, tuple(given)), *given.values())


# Operator, options of the solve, criteria of the gradients, names of the other arguments.
SolveArguments = tuple[
    Operator | MakesOperator, SolveOptions, StoppingCriteria | None, tuple[Name, ...]
]


@cache
def _solution() -> type[torch.autograd.Function]:
    """Return the autograd function, created at the first call."""
    import torch

    class SolveFunction(torch.autograd.Function):
        @staticmethod
        def forward(
            ctx: FunctionCtx, how: SolveArguments, b: torch.Tensor, *others: torch.Tensor | float
        ) -> torch.Tensor:
            """Solve, and keep the result for the backward pass."""
            A, options, ctx.adjoint, ctx.names = how
            values = (b, *others)
            ctx.kinds = [
                (v.dtype, v.device) if isinstance(v, torch.Tensor) else None for v in values
            ]
            shared = [_shared(v) if kind else v for v, kind in zip(values, ctx.kinds, strict=True)]
            right, lower, upper = shared[:3]
            parts = nested(ctx.names[3:], shared[3:])
            problem = LCP(operator_of(A, parts), right, lower, upper)
            ctx.result = solve_problem(problem, **options)
            if not ctx.result:
                raise ArithmeticError(
                    f"the solve ended with {ctx.result.status.name}: {ctx.result.status.value}"
                )
            return wp.to_torch(ctx.result.x).to(b.dtype)

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(ctx: FunctionCtx, cotangent: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
            """Return the gradients of all tensors by `wl.vjp`."""
            found = vjp(ctx.result, _shared(cotangent), stopping=ctx.adjoint).by_name
            values = [
                found[name] if kind else None
                for name, kind in zip(ctx.names, ctx.kinds, strict=True)
            ]
            tensors = [
                wp.to_torch(v)
                if isinstance(v, wp.array)
                else None
                if v is None
                else torch.tensor(v)
                for v in values
            ]
            return None, *(
                t if t is None else t.to(*kind[::-1])
                for t, kind in zip(tensors, ctx.kinds, strict=True)
            )

    return SolveFunction


def _shared(tensor: torch.Tensor) -> DeviceArray | float:
    """Return a tensor's memory as a Warp array, a number if it has no axes."""
    return wp.from_torch(tensor.detach().contiguous()) if tensor.ndim else float(tensor)
