"""Hostile inputs of ordinary users, drawn by seed and judged independently.

`python -m warp_lcp.benchmarks.hostile --seed 1 --count 78` solves 78 cases of each kind.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from warp_lcp.benchmarks.hostile import grids, matrices, programs
from warp_lcp.benchmarks.hostile.case import HostileAnswer, HostileCase
from warp_lcp.benchmarks.hostile.judge import Verdicts, judge

KINDS: dict[str, Callable[[np.random.Generator], HostileCase]] = {
    "rows": matrices.rows,
    "infinity": programs.infinity,
    "program": programs.programs,
    "solid": grids.solid,
    "gradients": grids.gradients,
    "singular": matrices.singular,
    "narrow": matrices.narrow,
    "sign": matrices.sign,
    "low-rank": programs.low_rank,
    "friction": matrices.friction,
    "malformed": matrices.malformed,
    "periodic": grids.periodic,
    "odd": matrices.odd,
}


def draw_case(kind: str, seed: int, index: int) -> HostileCase:
    """Return a case of a kind; equal arguments give equal cases."""
    return KINDS[kind](np.random.default_rng([seed, list(KINDS).index(kind), index]))


def attempt(case: HostileCase) -> HostileAnswer:
    """Solve a case and turn exceptions into answers.

    A ValueError is a refusal. LinAlgError, which derives from it, is not.
    """
    try:
        return case.solve()
    except Exception as error:
        trace = error.__traceback__
        while trace is not None and trace.tb_next is not None:
            trace = trace.tb_next
        file = trace.tb_frame.f_code.co_filename if trace is not None else ""
        where = (
            f" (raised in {file.rsplit('/', 1)[-1]}:{trace.tb_lineno})"
            if trace is not None and "warp_lcp" not in file
            else ""
        )
        refused = isinstance(error, ValueError) and not isinstance(error, np.linalg.LinAlgError)
        return HostileAnswer(
            "REFUSED" if refused else "EXCEPTION",
            None,
            f"{type(error).__name__}: {str(error)[:150]}{where}",
        )


def examine(case: HostileCase) -> tuple[HostileAnswer, Verdicts]:
    """Solve a case and judge its answer."""
    answer = attempt(case)
    return answer, judge(case, answer)
