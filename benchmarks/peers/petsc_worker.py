"""PETSc's multigrid CG and its active-set solver, for PETSc's own interpreter.

The matrix is converted and the transfers of the geometric hierarchy are built before the clock
starts, since neither is PETSc's work. A request is a line of JSON, and so is an answer; arrays are
exchanged in .npz files. The program imports nothing of this project.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import numpy as np
from petsc4py import PETSc

Request = dict[str, Any]  # JSON
Reply = dict[str, Any]  # JSON
COARSEST = 500  # largest number of unknowns for a direct solver
NEWTON_STEPS = 200
LINEAR_ITERATIONS = 10_000
# Two sweeps of symmetric SOR per level, or PETSc's own choices. These took the least time of all
# variants tried on the splash.
MULTIGRID = {
    "pc_mg_galerkin": "both",
    "mg_levels_ksp_type": "richardson",
    "mg_levels_ksp_max_it": 1,
    "mg_levels_pc_type": "sor",
}
# Tolerance of a Newton step; tighter ones take fewer steps and more time.
LOOSE = {"ksp_rtol": 1e-2}


class PetscProblem:
    """Problem A x + b on the unknowns of a grid, as PETSc objects.

    Attributes:
        A: the matrix.
        b: numpy, shape (unknowns,).
        where: index of each unknown among the cells of the grid.
        shape: cells along each axis.
    """

    def __init__(self, path: str) -> None:
        with np.load(path) as archive:
            self.b, self.where, self.shape = (
                archive["b"],
                archive["where"],
                tuple(int(s) for s in archive["shape"]),
            )
            rows, columns, values = (
                archive["indptr"].astype(np.int32),
                archive["indices"].astype(np.int32),
                archive["data"],
            )
            self.lower = {
                name[6:]: archive[name] for name in archive.files if name.startswith("lower_")
            }
        self.A = PETSc.Mat().createAIJWithArrays((len(self.b),) * 2, (rows, columns, values))
        self.A.setOption(PETSc.Mat.Option.SPD, True)


problem_of = lru_cache(maxsize=1)(PetscProblem)  # keeps the last problem


@contextmanager
def options(values: dict[str, object]) -> Iterator[None]:
    """Set PETSc options for the time in which a solver reads them."""
    for name, value in values.items():
        PETSc.Options()[name] = value
    try:
        yield
    finally:
        for name in values:
            PETSc.Options().delValue(name)


def aggregates(where: np.ndarray, shape: tuple[int, ...]) -> list[PETSc.Mat]:
    """Return prolongations by 2 x 2 x 2 aggregates of cells, finest first.

    They are constant on each aggregate. Trilinear ones need fewer iterations and three times the
    time, since their Galerkin products have 27 points.
    """
    prolongations = []
    while len(where) > COARSEST and min(shape) > 2:
        coarse = tuple((s + 1) // 2 for s in shape)
        parents = np.ravel_multi_index(
            tuple(i // 2 for i in np.unravel_index(where, shape)), coarse
        )
        kept = np.zeros(int(np.prod(coarse)), dtype=bool)
        kept[parents] = True
        columns = (np.cumsum(kept) - 1)[parents].astype(np.int32)
        rows = np.arange(len(where) + 1, dtype=np.int32)
        where, shape = np.flatnonzero(kept), coarse
        prolongations.append(
            PETSc.Mat().createAIJWithArrays(
                (len(rows) - 1, len(where)), (rows, columns, np.ones(len(columns)))
            )
        )
    return prolongations


def give(pc: PETSc.PC, prolongations: list[PETSc.Mat]) -> None:
    """Make a preconditioner PETSc's multigrid, with these prolongations.

    Coarse matrices are Galerkin products.
    """
    pc.setType("mg")
    pc.setMGLevels(len(prolongations) + 1)
    for number, P in enumerate(reversed(prolongations), start=1):
        pc.setMGInterpolation(number, P)


def linear(request: Request) -> Reply:
    """Solve A x = -b by CG; with geometric multigrid if no options are given."""
    problem, own = problem_of(request["problem"]), request["options"]
    right = PETSc.Vec().createWithArray(-problem.b)
    x = right.duplicate()
    transfers = [] if own else aggregates(problem.where, problem.shape)
    with options(own or MULTIGRID):
        start_time = time.perf_counter()
        ksp = PETSc.KSP().create()
        ksp.setOperators(problem.A)
        ksp.setType("cg")
        ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
        ksp.setTolerances(rtol=request["tolerance"], atol=0.0, max_it=LINEAR_ITERATIONS)
        if transfers:
            give(ksp.getPC(), transfers)
        ksp.setFromOptions()
        ksp.setUp()
        middle = time.perf_counter()
        ksp.solve(right, x)
        end = time.perf_counter()
    return _answer(
        request,
        x,
        middle - start_time,
        end - middle,
        ksp.getIterationNumber(),
        ksp.getConvergedReason(),
        ksp,
    )


class ReducedMultigrid:
    """Multigrid of the principal submatrices of an active-set method.

    It aggregates the free unknowns and is rebuilt when they change.
    """

    def __init__(self, problem: PetscProblem, snes: PETSc.SNES) -> None:
        self.problem, self.snes, self.building = problem, snes, 0.0
        self.ksp: PETSc.KSP | None = None

    def setUp(self, pc: PETSc.PC) -> None:
        """Build the hierarchy of the current free set.

        Its transfers are computed in NumPy; this time is not PETSc's.
        """
        free = self.snes.getVIInactiveSet().getIndices()
        begun = time.perf_counter()
        transfers = aggregates(self.problem.where[free], self.problem.shape)
        self.building += time.perf_counter() - begun
        A, _ = pc.getOperators()
        if self.ksp is not None:
            self.ksp.destroy()
        self.ksp = PETSc.KSP().create()
        self.ksp.setOperators(A)
        self.ksp.setType("preonly")
        give(self.ksp.getPC(), transfers)
        with options(MULTIGRID):
            self.ksp.setFromOptions()
            self.ksp.setUp()

    def apply(self, pc: PETSc.PC, r: PETSc.Vec, z: PETSc.Vec) -> None:
        """Set z to the result of a V-cycle applied to r."""
        assert self.ksp is not None, "set up"
        self.ksp.solve(r, z)


def inequality(request: Request) -> Reply:
    """Solve the LCP by SNESVI's reduced-space active-set Newton method with CG.

    It uses geometric multigrid if no options are given.
    """
    problem = problem_of(request["problem"])
    lower = problem.lower[request["bounds"]]
    b = PETSc.Vec().createWithArray(problem.b)
    low = PETSc.Vec().createWithArray(np.where(np.isinf(lower), PETSc.NINFINITY, lower))
    x, residual, high = b.duplicate(), b.duplicate(), b.duplicate()
    high.set(PETSc.INFINITY)

    def function(snes: PETSc.SNES, x: PETSc.Vec, y: PETSc.Vec) -> None:
        problem.A.mult(x, y)
        y.axpy(1.0, b)

    with options(LOOSE | request["options"]):
        start_time = time.perf_counter()
        snes = PETSc.SNES().create()
        snes.setType("vinewtonrsls")
        snes.setFunction(function, residual)
        snes.setJacobian(lambda snes, x, J, P: None, problem.A, problem.A)  # A is constant
        snes.setVariableBounds(low, high)
        snes.setTolerances(rtol=request["tolerance"], atol=0.0, stol=0.0, max_it=NEWTON_STEPS)
        snes.ksp.setType("cg")
        multigrid = None
        if not request["options"]:
            multigrid = ReducedMultigrid(problem, snes)
            snes.ksp.getPC().setType("python")
            snes.ksp.getPC().setPythonContext(multigrid)
        snes.setFromOptions()
        middle = time.perf_counter()
        snes.solve(None, x)
        end = time.perf_counter()
    seconds = end - middle - (0.0 if multigrid is None else multigrid.building)
    return _answer(
        request,
        x,
        middle - start_time,
        seconds,
        snes.getIterationNumber(),
        snes.getConvergedReason(),
        snes,
    )


def _answer(
    request: Request,
    x: PETSc.Vec,
    setup: float,
    solve: float,
    iterations: int,
    reason: int,
    solver: PETSc.SNES | PETSc.KSP,
) -> Reply:
    """Write x and return the other results."""
    np.save(request["answer"], x.array_r)
    linear_iterations = (
        solver.getLinearSolveIterations() if isinstance(solver, PETSc.SNES) else iterations
    )
    solver.destroy()
    return {
        "setup": setup,
        "solve": solve,
        "iterations": iterations,
        "linear_iterations": linear_iterations,
        "reason": int(reason),
    }


def serve(
    version: str,
    methods: Mapping[str, Callable[[Request], Reply]],
    failures: tuple[type[Exception], ...] = (),
) -> None:
    """Answer requests until the input ends.

    The first line that is sent is the peer's version.

    Args:
        version: version of the peer.
        methods: functions by the `method` of a request.
        failures: exceptions of failed methods; the answer is then {"error": text}. Other
            exceptions end the program.
    """
    replies = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    # Output of the peer must not mix with the answers.
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())

    def send(reply: Reply) -> None:
        replies.write(json.dumps(reply) + "\n")
        replies.flush()

    send({"version": version, "methods": sorted(methods)})
    for line in sys.stdin:
        request = json.loads(line)
        try:
            send(methods[request["method"]](request))
        except failures as error:
            send({"error": (str(error).splitlines() or [type(error).__name__])[-1]})


if __name__ == "__main__":
    serve(
        ".".join(map(str, PETSc.Sys.getVersion())),
        {"linear": linear, "inequality": inequality},
        (PETSc.Error,),
    )
