"""Newton's method on the minimum map with PETSc's KSP for its linear solves."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import warp as wp

from warp_lcp.distributed.launch import petsc
from warp_lcp.distributed.petsc_matrix import PetscGrid
from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.protocol import HasStencil, check_taken, has
from warp_lcp.problem.solve import PrecisionName, Step
from warp_lcp.settings import Count, CountOrZero, Settings, Share
from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton, NewtonWorkspace
from warp_lcp.solvers.principal_system import GridSystem, PrincipalSystem

LEAST = 0.5  # by which a linear solve reduces its residual at least


@dataclass(frozen=True, kw_only=True)
class PetscActiveSet(Settings):
    """Primal-dual active-set method with linear solves by PETSc's KSP.

    [Hintermueller, Ito, Kunisch 2003; [Book] 2.4.1.]

    Unknowns with x - y / A_ii outside their bounds are held there; PETSc solves on the others, matrix-free, by conjugate gradients
    preconditioned with one multigrid cycle, and the step is safeguarded as MinimumMapNewton's is. For grids, on one process or on ranks
    that share one. MinimumMapNewton and ProjectedMultigrid are faster; use this one for PETSc's methods, monitors and
    options. `init` reads them from PETSC_OPTIONS in the environment, or from what a program gave `petsc4py.init`:

    - `-ksp_type`: default cg; fcg, pipecg and groppcg (fewer waits for sums over the ranks), minres, gmres, fgmres, bcgs, richardson,
      preonly (the cycle alone) and most others. A is symmetric.
    - `-pc_type`: default python, our cycle; jacobi, bjacobi, none. Methods that need matrix entries (sor, ilu, gamg) fail.
    - `-ksp_norm_type`: unpreconditioned where the method has that norm, else its own; `eta` counts in it.
    - `-ksp_rtol`, `-ksp_atol`, `-ksp_max_it`: instead of what `eta`, the whole solve's tolerance and `max_linear_iterations` ask for.
    - `-ksp_monitor`, `-ksp_converged_reason`, `-ksp_view`, `-log_view`, `-options_left`: PETSc prints reports to standard output.

    With `prefix="wall_"` those of KSP and PC read `-wall_ksp_type` and so on.

    Args:
        precision: "mixed": iterate float64, cycles float32; "double"; or "single": the iterate rounded to float32 as well. PETSc's vectors
            are float64.
        monotone_cycles: projected multigrid cycles of a cold start, not by PETSc.
        eta: each linear solve reduces its residual by this factor, by its square once the active set has settled, or to what the whole
            solve still needs.
        max_linear_iterations: maximum number of iterations of KSP in one step.
        backtracks: maximum number of halvings of a step.
        memory: number of last residuals; a step may not exceed their maximum (nonmonotone search).
        prefix: of PETSc's options.
        cycle: settings of multigrid cycles.

    Raises:
        ValueError: an argument is outside its range.
    """

    supports: ClassVar = (HasStencil,)
    needs: ClassVar[str] = "positive definite"
    distributed: ClassVar[bool] = True

    precision: PrecisionName = "mixed"
    monotone_cycles: CountOrZero = 2
    eta: Share = 0.1
    max_linear_iterations: Count = 200
    backtracks: CountOrZero = 6
    memory: Count = 4
    prefix: str = ""
    cycle: CycleSettings = field(default_factory=CycleSettings)

    def as_newton(self) -> MinimumMapNewton:
        """Return the same method with the project's own linear solver."""
        return MinimumMapNewton(**{f.name: getattr(self, f.name) for f in fields(self) if f.name != "prefix"})

    def init(self, problem: LCP) -> KSPWorkspace:
        """Return a workspace.

        Raises:
            ImportError: PETSc cannot be imported; the message says how to install it.
            ValueError: A has no stencil.
        """
        check_taken(self, problem.A)
        return KSPWorkspace(problem, self)

    def step(self, problem: LCP, work: KSPWorkspace, x: wp.array[Any]) -> Step:
        """Take a monotone cycle during a cold start, else a safeguarded Newton step."""
        return work.step(x)


class KSPWorkspace(NewtonWorkspace):
    """Memory of the method for one problem.

    Attributes:
        ksp: PETSc's solver, as its options have made it.
    """

    def __init__(self, problem: LCP, settings: PetscActiveSet) -> None:
        self._prefix = settings.prefix
        super().__init__(problem, settings.as_newton())

    @property
    def ksp(self) -> Any:
        """PETSc's solver of the free set's system."""
        assert isinstance(self.system, KSPSystem)
        return self.system.iteration.ksp

    def _principal_system(self) -> PrincipalSystem:
        A = self.problem.A
        assert has(A, HasStencil)
        return KSPSystem(A, self.precision.correction, bounded=self.bounded, settings=self.settings.cycle, prefix=self._prefix)


class KSPSystem(GridSystem):
    """The system on a grid's free set, solved by PETSc's KSP."""

    def __init__(self, A: HasStencil, real: Any, *, bounded: bool, settings: CycleSettings | None = None, prefix: str = "") -> None:
        self._prefix = prefix
        super().__init__(A, real, bounded=bounded, settings=settings)

    def _krylov_method(self) -> KSPIteration:
        self.iteration = KSPIteration(PetscGrid(self._A, self.hierarchy), self._prefix)
        return self.iteration

    def restrict(self, free: wp.array[Any], shift: wp.array[Any] | None = None) -> None:
        """Mask the finest diagonal and coarsen; PETSc is told that the matrix is another one."""
        super().restrict(free, shift)
        self.iteration.grid.matrix.stateIncrease()


class KSPIteration:
    """Iterates as PETSc's options say, on the finest level's right-hand side.

    Args:
        grid: the matrix and the cycle.
        prefix: of the options.

    Attributes:
        x: stored field, the solution.
        ksp: what iterates.
    """

    def __init__(self, grid: PetscGrid, prefix: str) -> None:
        self.grid, self.ksp = grid, grid.solver(prefix)
        self.x = wp.zeros_like(grid.hierarchy.finest.b)
        self._right_side, self._solution = grid.vector(), grid.vector()
        given = petsc().Options(prefix)
        self._given = frozenset(name for name in ("rtol", "atol", "max_it") if given.hasName(f"ksp_{name}"))

    def solve(self, tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Iterate from x = 0 until the residual has fallen as `tolerance` asks, in the norm that KSP takes, or as PETSc's options say.

        Returns:
            Iterations and the norm reached, as KSP has them.
        """
        copies = self.grid.copies
        copies.leave(self.grid.hierarchy.finest.b, None, self._right_side)
        size = self._right_side.norm()
        asked = {"rtol": min(tolerance / size, LEAST), "atol": 0.0, "max_it": max_iterations} if size > 0 else {}
        self.ksp.setTolerances(**{name: value for name, value in asked.items() if name not in self._given})
        self.ksp.solve(self._right_side, self._solution)
        copies.enter(self._solution, self.x)
        return self.ksp.getIterationNumber(), self.ksp.getResidualNorm()
