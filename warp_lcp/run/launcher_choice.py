"""Choice of the launcher of a command by its engine."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from warp_lcp.run.devices import Engine
from warp_lcp.run.launcher import Launcher


@contextmanager
def launcher_of(engine: Engine, *, rank_timeout: float) -> Iterator[Launcher]:
    """Yield the launcher of a command.

    Args:
        engine: engine that runs the command.
        rank_timeout: longest time that ranks wait for one of them [s]; 0: no limit.

    Raises:
        EngineError: the engine cannot be used here.
    """
    if engine is Engine.SINGLE:
        yield Launcher()
        return
    from warp_lcp.run.rank_launcher import ranks_together  # needs MPI and PETSc

    with ranks_together(rank_timeout) as launcher:
        yield launcher
