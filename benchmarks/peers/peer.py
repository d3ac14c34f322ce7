"""Problem, answer and interface of a peer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from warp_lcp.benchmarks.extremes.exact import ExactEquations
from warp_lcp.benchmarks.problems import BOUNDS, Splash
from warp_lcp.operators.grid_poisson import FLUID

INEQUALITIES = BOUNDS[1:]


class PeerFailed(RuntimeError):
    """Error of a peer that gives no answer; the message says why."""


@dataclass(frozen=True)
class PeerProblem:
    """Assembled problem y = A x + b, x >= lower, on the FLUID cells of a scene."""

    scene: Splash  # the scene
    bounds: str  # `linear`, `walls`, `everywhere`

    @cached_property
    def matrix(self) -> sp.csr_array:
        """Matrix A, float64, with 32-bit indices.

        Peers convert other formats at their own expense.
        """
        A = self.scene.matrix()
        A.indptr, A.indices = A.indptr.astype(np.int32), A.indices.astype(np.int32)
        return A

    @cached_property
    def where(self) -> np.ndarray:
        """Index of each unknown among the cells, shape (unknowns,)."""
        return np.flatnonzero(self.scene.cells == FLUID)

    @cached_property
    def b(self) -> np.ndarray:
        """Vector b, shape (unknowns,)."""
        return self.scene.b.ravel()[self.where]

    @cached_property
    def lower(self) -> np.ndarray:
        """Lower bounds, shape (unknowns,); -inf if there is no bound."""
        return np.broadcast_to(self.scene.lower(self.bounds), self.scene.b.shape).ravel()[
            self.where
        ]

    @cached_property
    def exact(self) -> ExactEquations:
        """Equations of the natural residual."""
        return ExactEquations(self.matrix, self.b, self.lower, np.full_like(self.b, np.inf))

    def residual(self, x: np.ndarray) -> float:
        """Return the relative natural residual of x, in float64.

        It is the residual that results of this project report, computed by other code.
        """
        return self.exact.residual(x) / self.exact.residual(self.exact.start)


@dataclass(frozen=True)
class PeerAnswer:
    """Answer of a peer."""

    x: np.ndarray  # shape (unknowns,)
    setup: float  # time of the part that can be reused for another b [s]
    solve: float  # remaining time [s]
    iterations: int  # iterations of the method
    linear_iterations: int | None = None  # iterations of linear solves within them

    @property
    def total(self) -> float:
        """Time of set-up and solve [s]."""
        return self.setup + self.solve


@dataclass(frozen=True)
class Peer:
    """Another solver of the same problem.

    Args:
        name: name in tables.
        library: name of its distribution.
        solve: solves to the peer's own tolerance; the harness tightens it until
            `PeerProblem.residual` is small enough.
        bounds: kinds of bounds that it solves.
        most: most cells along a side that are measured.
        settings: non-default settings.
        precision: precision of its vectors.
    """

    name: str
    library: str
    solve: Callable[[PeerProblem, float], PeerAnswer]
    bounds: tuple[str, ...] = ("linear",)
    most: int = 1 << 20
    settings: str = "defaults"
    precision: str = "float64"
