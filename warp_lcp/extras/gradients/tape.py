"""Solves on a Warp tape; `Tape.backward` differentiates them by `wl.vjp`."""

from __future__ import annotations

from typing import Unpack

import numpy as np
import warp as wp

from warp_lcp.gradients.names import Coefficients, MakesOperator, SolveOptions, flat, operator_of
from warp_lcp.gradients.vjp import vjp
from warp_lcp.kernels.fields import Array
from warp_lcp.kernels.vectors import ADD, convert, rows_of
from warp_lcp.method_selection import solve as solve_problem
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.operator_protocol import Operator
from warp_lcp.problem.result import SolveResult
from warp_lcp.problem.stopping import StoppingCriteria


def solve(
    tape: wp.Tape,
    A: Operator | MakesOperator,
    b: Array,
    lower: Array | float = 0.0,
    upper: Array | float = np.inf,
    *,
    coefficients: Coefficients | None = None,
    adjoint: StoppingCriteria | None = None,
    **options: Unpack[SolveOptions],
) -> SolveResult:
    """Solve y = A x + b with bounds and record the solve on a Warp tape.

    `tape.backward` then adds to the gradients of all arrays that have one.

    Call it outside of the tape's `with` block, which would record, and keep, each launch of the
    solve.

    Args:
        tape: the operations after the solve continue it.
        A: an operator, or a function of `coefficients` that returns one, such as
            `functools.partial(wl.GridPoisson, cells)`.
        b: as of `wl.LCP`; like bounds and coefficients an array with `requires_grad=True` if its
            gradient is needed.
        lower: likewise.
        upper: likewise.
        coefficients: arguments of A by name.
        adjoint: criteria of the linear solve of the gradients.
        options: of `wl.solve`.

    Returns:
        The result, whose x has a gradient.

    Raises:
        ValueError: as of `wl.LCP` and `wl.solve`, and in the backward pass as of `wl.vjp`.
    """
    arguments = flat({"b": b, "lower": lower, "upper": upper, **(coefficients or {})})
    operator = operator_of(A, coefficients or {})
    result = solve_problem(LCP(operator, b, lower, upper), **options)
    result.x.requires_grad = True
    differentiable = {
        name: v for name, v in arguments.items() if isinstance(v, wp.array) and v.requires_grad
    }

    def backward() -> None:
        found = vjp(result, result.x.grad, stopping=adjoint).by_name
        for name, array in differentiable.items():
            part = wp.empty_like(array.grad.flatten())
            gradient = found[name]
            assert isinstance(gradient, wp.array)
            convert(gradient.flatten(), part)
            ADD.bind(rows_of(part), z=part, x=array.grad.flatten()).launch()

    tape.record_func(backward, [result.x, *differentiable.values()])
    return result
