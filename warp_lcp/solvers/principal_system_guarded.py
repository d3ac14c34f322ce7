"""Principal systems whose preconditioner may fail: another system, of better factors, takes over."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import warp as wp

from warp_lcp.krylov.system import KrylovSystem
from warp_lcp.rows.fields import zeros_like

REDUCED = 1e-2  # of a right-hand side: what any preconditioner worth its name comes to, whatever rounding leaves
ENOUGH = 60  # iterations by which it should


class Substitute(Protocol):
    """A system that takes over: the same matrix, fields of its own."""

    def restrict(self, free: wp.array[Any], shift: wp.array[Any] | None) -> None:
        """Take another free set and shift."""

    def solve_for(self, r: wp.array[Any], e: wp.array[Any], tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Solve for e; return iterations and the norm reached."""


class GuardedSystem(KrylovSystem):
    """A Krylov method with a preconditioner, and where that fails by another system.

    A preconditioner fails if its solve stalls, or is cut off after `ENOUGH` iterations, before the residual is at the tolerance or
    `REDUCED`. What takes over stays until the operator changes.
    """

    _substitute: Substitute | None = None
    _make_substitute: Callable[[], Substitute] | None = None  # None: nothing takes over
    _restriction: tuple[wp.array[Any], wp.array[Any] | None] | None = None  # the free set and the shift there are

    def _guard(self, substitute: Callable[[], Substitute]) -> None:
        """Take over where needed, from now on, by a system that is made then."""
        self._saved, self._make_substitute = zeros_like(self.r), substitute

    def _note(self, free: wp.array[Any], shift: wp.array[Any] | None) -> None:
        """Remember the free set and the shift."""
        self._restriction = free, shift
        if self._substitute is not None:
            self._substitute.restrict(free, shift)

    def solve(self, tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Iterate from e = 0 until the norm is at most the tolerance; return iterations and the norm reached."""
        if self._make_substitute is None or self._restriction is None:
            return super().solve(tolerance, max_iterations)
        done, start = 0, self.norm()
        if self._substitute is None:
            wp.copy(self._saved, self.r)
            done, norm = super().solve(tolerance, max_iterations)
            if norm <= max(tolerance, REDUCED * start) or ENOUGH > done >= max_iterations:
                return done, norm
            wp.copy(self.r, self._saved)
            self._substitute = self._make_substitute()
            self._substitute.restrict(*self._restriction)
        iterations, norm = self._substitute.solve_for(self.r, self.e, tolerance, max_iterations)
        return done + iterations, norm
