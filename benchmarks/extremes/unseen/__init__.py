"""Random problems of many kinds, by kind and seed: what no method was tuned on. `problem(kind, seed)` is the same for ever.

Seeds 0 to 9,999 are for tests and for development, 10,000 to 19,999 are kept unseen for acceptance, a run draws from 20,000 on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from warp_lcp.benchmarks.extremes.problem import GridProblem
from warp_lcp.benchmarks.extremes.unseen import grids, matrices
from warp_lcp.benchmarks.extremes.unseen.draw import Draw, Unseen, changed, solvable

RESERVED = range(10_000, 20_000)  # seeds for acceptance
FRESH = range(20_000, 1 << 31)  # seeds that a run draws from


def _named(kinds: Iterable[Callable[[Draw], Any]]) -> dict[str, Callable[[Draw], Any]]:
    return {make.__name__.replace("_", "-"): make for make in kinds}


GRIDS, SURE_MATRICES, HARD_MATRICES = _named(grids.KINDS), _named(matrices.SURE), _named(matrices.HARD)
KINDS = {**GRIDS, **SURE_MATRICES, **HARD_MATRICES}
ALLOWANCE = {"lognormal": 1.5}
WARM_EVERY = 3  # of how many seeds one is solved once more with b changed by 1 %


def problem(kind: str, seed: int, *, small: bool = False) -> Unseen:
    """Return the problem of a kind and a seed.

    Args:
        kind: of `KINDS`.
        seed: >= 0.
        small: of a size that every method can take; another problem than the large one.

    Raises:
        ValueError: there is no such kind.
    """
    if kind not in KINDS:
        raise ValueError(f"kind = {kind}: must be one of {', '.join(KINDS)}")
    made, then = KINDS[kind](Draw(kind, seed, small=small)), None
    if isinstance(made, tuple):
        made, then = made
    if isinstance(made, GridProblem):
        made, then = solvable(made), None if then is None else solvable(then)
        if then is None and seed % WARM_EVERY == 0 and not small:
            then = changed(made, seed)
    return Unseen(kind, seed, made, then, ALLOWANCE.get(kind, 1.0))
