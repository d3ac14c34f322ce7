"""Solutions as JAX functions of the host, with gradients by `wl.vjp`; they can be traced. Needs JAX, the extra `jax`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from warp_lcp.gradients.vjp import vjp
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.result import SolveResult
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.solvers.default import solve as solve_problem


def solve(
    A: Any, b: Any, lower: Any = 0.0, upper: Any = np.inf, *, coefficients: Mapping[str, Any] | None = None,
    adjoint: StoppingCriteria | None = None, **options: Any,
) -> Any:  # fmt: skip
    """Return x of y = A x + b with bounds as an array of b's type, with gradients to all that is given.

    Callbacks are pure: going back begins with a solve from x, which takes no step where x has not been rounded to float32.

    Args:
        A: an operator, or what makes one of `coefficients`, say `functools.partial(wl.GridPoisson, cells)`; on any device.
        b: as of `wl.LCP`.
        lower: an array or a number.
        upper: likewise.
        coefficients: arguments of A by name, arrays or numbers.
        adjoint: criteria of the linear solve of the gradients.
        options: of `wl.solve`.

    Raises:
        Exception: JAX's own, with the message of an ArithmeticError where a solve does not converge, or of a ValueError.
    """
    import jax

    given = {name: jax.numpy.asarray(v) for name, v in {"b": b, "lower": lower, "upper": upper, **(coefficients or {})}.items()}

    def solved(data: Mapping[str, Any], x0: Any = None) -> SolveResult:
        host = {name: np.asarray(v) for name, v in data.items()}
        sides = [host.pop(name) for name in ("b", "lower", "upper")]
        result = solve_problem(LCP(A(**host) if host else A, *sides), **{**options, **({} if x0 is None else {"x0": np.asarray(x0)})})
        if not result:
            raise ArithmeticError(f"the solve ended with {result.status.name}: {result.status.value}")
        return result

    def derived(data: Mapping[str, Any], x: Any, cotangent: Any) -> dict[str, Any]:
        found = vjp(solved(data, x), np.asarray(cotangent), stopping=adjoint).by_name
        return {name: np.asarray(getattr(found[name], "numpy", lambda n=name: found[n])(), dtype=v.dtype) for name, v in data.items()}

    @jax.custom_vjp
    def solution(data: Mapping[str, Any]) -> Any:
        like = jax.ShapeDtypeStruct(data["b"].shape, data["b"].dtype)
        return jax.pure_callback(lambda d: solved(d).x.numpy().astype(like.dtype), like, data)

    def forward(data: Mapping[str, Any]) -> Any:
        x = solution(data)
        return x, (data, x)

    def backward(kept: Any, cotangent: Any) -> Any:
        like = {name: jax.ShapeDtypeStruct(v.shape, v.dtype) for name, v in kept[0].items()}
        return (jax.pure_callback(derived, like, *kept, cotangent),)

    solution.defvjp(forward, backward)
    return solution(given)
