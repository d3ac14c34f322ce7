"""Workspace that is kept between solves.

Cold solves of problems of one form allocate memory and record their launches only once.
"""

from __future__ import annotations

import threading
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Protocol

from warp_lcp.kernels.thread_pool import get_threads, team
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import Solver, Workspace
from warp_lcp.problem.result import SolveResult, SolveStatus

# Largest workspace that is kept, in cells with ghost cells: 45 bytes each, 140 in float64 with
# fields of faces and bounds.
MOST_CELLS = 3 << 17


class CacheableWorkspace(Workspace, Protocol):
    """A workspace that later solves may use.

    Attributes:
        problem: its own problem, into which others are copied.
    """

    problem: LCP

    def forget_solve(self) -> None:
        """Discard what belongs to the last solve."""


@dataclass(frozen=True)
class CachedWorkspace:
    """A workspace with its own problem, into which other problems are copied.

    Args:
        form: of problems and settings that it serves.
        work: the workspace.
    """

    form: Hashable
    work: CacheableWorkspace

    def give_back(self, result: SolveResult) -> None:
        """Keep the workspace for the next solve.

        Not if the solve has failed, or the result's x lies in the workspace's memory.
        """
        x = self.work.x
        within = x.ptr <= result.x.ptr < x.ptr + x.capacity
        if result.status is SolveStatus.CONVERGED and not within:
            self.work.forget_solve()
            CACHE.workspace = self


class WorkspaceCache:
    """Storage of the one kept workspace, and of the form of the last cold solve."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.workspace: CachedWorkspace | None = None
        self.last: Hashable = None

    def pop(self, form: Hashable) -> tuple[CachedWorkspace | None, bool]:
        """Remove and return the workspace of a form, None if another is kept.

        Also returns whether the last solve had the same form.
        """
        with self.lock:
            workspace, again = self.workspace, self.last == form
            self.last = form
            if workspace is None or (workspace.form != form and not again):
                return None, again
            self.workspace = None
            return (workspace if workspace.form == form else None), again


CACHE = WorkspaceCache()


def cached_or_new_workspace(problem: LCP, solver: Solver) -> CachedWorkspace | None:
    """Return a kept or new workspace with a problem's data, or None.

    The kept one, or at the second consecutive solve of a form a new one. Results have the same bits
    as with a new workspace. None: a problem of this form has no copies (GPUs, ranks, fields that
    are used in place, large grids), or it is the first solve of its form.

    Args:
        problem: whose data are copied.
        solver: the method, with its settings.
    """
    form = problem.form if problem.layout.size <= MOST_CELLS else None
    if form is None or team() is None:
        return None
    form = form, type(solver), solver, get_threads()
    found, again = CACHE.pop(form)
    if found is not None:
        found.work.problem.copy_from(problem)
        return found
    return CachedWorkspace(form, solver.init(problem.replica())) if again else None


def release_workspace() -> None:
    """Free the workspace that `wl.solve` keeps.

    `wl.solve` with `ProjectedMultigrid` and without a `workspace` keeps its workspace from the
    second consecutive solve of a form on. A form is the shape, types, settings, threads and kinds
    of bounds and coefficients. The next solve of this form copies its data there, which at 16^3
    takes half the time of a new workspace, and returns the same bits. One workspace is kept, of at
    most 393,216 cells on the CPU: 16 MiB, at most 52 MiB.

    Example:
        >>> import warp_lcp as wl
        >>> wl.release_workspace()
    """
    CACHE.workspace = None
