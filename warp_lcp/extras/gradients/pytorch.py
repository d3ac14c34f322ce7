"""Solutions as PyTorch functions, with gradients by `wl.vjp` (extra `torch`).

Tensors share memory with Warp arrays.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.default import solve as solve_problem
from warp_lcp.gradients.names import flat, nested
from warp_lcp.gradients.vjp import vjp
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.stopping import StoppingCriteria


def solve(
    A: Any,
    b: Any,
    lower: Any = 0.0,
    upper: Any = np.inf,
    *,
    coefficients: Mapping[str, Any] | None = None,
    adjoint: StoppingCriteria | None = None,
    **options: Any,
) -> Any:
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


@cache
def _solution() -> Any:
    """Return the autograd function, created at the first call."""
    import torch

    class Solution(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, how: Any, *values: Any) -> Any:
            """Solve, and keep the result for the backward pass."""
            A, options, ctx.adjoint, ctx.names = how
            ctx.kinds = [
                (v.dtype, v.device) if isinstance(v, torch.Tensor) else None for v in values
            ]
            shared = [_shared(v) if kind else v for v, kind in zip(values, ctx.kinds, strict=True)]
            b, lower, upper = shared[:3]
            parts = nested(ctx.names[3:], shared[3:])
            ctx.result = solve_problem(LCP(A(**parts) if parts else A, b, lower, upper), **options)
            if not ctx.result:
                raise ArithmeticError(
                    f"the solve ended with {ctx.result.status.name}: {ctx.result.status.value}"
                )
            return wp.to_torch(ctx.result.x).to(values[0].dtype)

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(ctx: Any, cotangent: Any) -> Any:
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

    return Solution


def _shared(tensor: Any) -> Any:
    """Return a tensor's memory as a Warp array, a number if it has no axes."""
    return wp.from_torch(tensor.detach().contiguous()) if tensor.ndim else float(tensor)
