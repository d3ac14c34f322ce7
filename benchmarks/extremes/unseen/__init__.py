"""Random problems by kind and seed, on which no method was tuned.

`problem(kind, seed)` always returns the same problem. Seeds 0 to 9,999 are for tests and
development. Seeds 10,000 to 19,999 are kept unseen for acceptance. A run draws seeds from 20,000
on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from warp_lcp.benchmarks.extremes.problem import GridProblem, Problem, solvable
from warp_lcp.benchmarks.extremes.unseen import grids, matrices
from warp_lcp.benchmarks.extremes.unseen.draw import SeededGenerator, SeededProblem, changed

RESERVED = range(10_000, 20_000)  # seeds reserved for acceptance
FRESH = range(20_000, 1 << 31)  # seeds that a run draws from

ProblemFamily = Callable[[SeededGenerator], Problem]


def _named(kinds: Iterable[ProblemFamily]) -> dict[str, ProblemFamily]:
    return {make.__name__.replace("_", "-"): make for make in kinds}


GRIDS, SURE_MATRICES, HARD_MATRICES = (
    _named(grids.KINDS),
    _named(matrices.SURE),
    _named(matrices.HARD),
)
KINDS = {**GRIDS, **SURE_MATRICES, **HARD_MATRICES}
ALLOWANCE = {"lognormal": 1.5}
WARM_EVERY = 3  # every third seed is solved again with b changed by 1 %


def problem(kind: str, seed: int, *, small: bool = False) -> SeededProblem:
    """Return the problem of a kind and a seed.

    Args:
        kind: a name of `KINDS`.
        seed: a number >= 0.
        small: return a problem small enough for every method; it differs from the large one.

    Raises:
        ValueError: there is no such kind.
    """
    if kind not in KINDS:
        raise ValueError(f"kind = {kind}: must be one of {', '.join(KINDS)}")
    problem = KINDS[kind](SeededGenerator(kind, seed, small=small))
    if not isinstance(problem, GridProblem):
        return SeededProblem(problem)
    problem = solvable(problem)
    return SeededProblem(
        problem,
        changed(problem, seed) if seed % WARM_EVERY == 0 and not small else None,
        ALLOWANCE.get(kind, 1.0),
    )
