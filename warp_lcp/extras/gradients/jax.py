"""Solutions as JAX functions, with gradients by `wl.vjp` (extra `jax`).

The functions run on the host and can be traced.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Unpack

import numpy as np
import warp as wp

from warp_lcp.gradients.names import (
    Coefficients,
    MakesOperator,
    SolveOptions,
    flat,
    nested,
    operator_of,
)
from warp_lcp.gradients.vjp import vjp
from warp_lcp.method_selection import solve as solve_problem
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.operator_protocol import Operator
from warp_lcp.problem.result import SolveResult
from warp_lcp.problem.stopping import StoppingCriteria

if TYPE_CHECKING:
    import jax


def solve(
    A: Operator | MakesOperator,
    b: jax.Array | np.ndarray,
    lower: jax.Array | np.ndarray | float = 0.0,
    upper: jax.Array | np.ndarray | float = np.inf,
    *,
    coefficients: Coefficients | None = None,
    adjoint: StoppingCriteria | None = None,
    **options: Unpack[SolveOptions],
) -> jax.Array:
    """Return the solution x as a JAX array with gradients to all arguments.

    x solves y = A x + b with bounds; it has the type of b.

    Callbacks are pure: the backward pass begins with a solve from x, which takes no step where x
    has not been rounded to float32.

    Args:
        A: an operator, or a function of `coefficients` that returns one, such as
            `functools.partial(wl.GridPoisson, cells)`; any device.
        b: as of `wl.LCP`.
        lower: an array or a number.
        upper: likewise.
        coefficients: arguments of A by name, arrays or numbers.
        adjoint: criteria of the linear solve of the gradients.
        options: of `wl.solve`.

    Raises:
        Exception: JAX's own, with the message of an ArithmeticError where a solve does not
            converge, or of a ValueError.
    """
    import jax

    given = flat({"b": b, "lower": lower, "upper": upper, **(coefficients or {})})
    names, values = tuple(given), tuple(map(jax.numpy.asarray, given.values()))

    SavedData = tuple[Sequence[jax.Array], jax.Array]  # data and solution

    def solved(data: Sequence[jax.Array], x0: jax.Array | None = None) -> SolveResult:
        """Solve the problem of host arrays."""
        host = [np.asarray(v) for v in data]
        parts = nested(names[3:], host[3:])
        own = options.copy()
        if x0 is not None:
            own["x0"] = np.asarray(x0)
        result = solve_problem(LCP(operator_of(A, parts), *host[:3]), **own)
        if not result:
            raise ArithmeticError(
                f"the solve ended with {result.status.name}: {result.status.value}"
            )
        return result

    def derived(
        data: Sequence[jax.Array], x: jax.Array, cotangent: jax.Array
    ) -> tuple[np.ndarray, ...]:
        found = vjp(solved(data, x), np.asarray(cotangent), stopping=adjoint).by_name
        parts = (found[name] for name in names)
        return tuple(
            np.asarray(p.numpy() if isinstance(p, wp.array) else p, dtype=v.dtype)
            for p, v in zip(parts, data, strict=True)
        )

    @jax.custom_vjp
    def solution(data: Sequence[jax.Array]) -> jax.Array:
        like = jax.ShapeDtypeStruct(data[0].shape, data[0].dtype)
        return jax.pure_callback(lambda d: solved(d).x.numpy().astype(like.dtype), like, data)

    def forward(data: Sequence[jax.Array]) -> tuple[jax.Array, SavedData]:
        x = solution(data)
        return x, (data, x)

    def backward(kept: SavedData, cotangent: jax.Array) -> tuple[Sequence[jax.Array]]:
        like = tuple(jax.ShapeDtypeStruct(v.shape, v.dtype) for v in kept[0])
        return (jax.pure_callback(derived, like, *kept, cotangent),)

    solution.defvjp(forward, backward)
    return solution(values)
