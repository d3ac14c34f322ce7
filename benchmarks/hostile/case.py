"""Cases of the hostile benchmark: input, solve, and known facts of the answer."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import scipy.io
import scipy.sparse
from scipy.sparse.linalg import LinearOperator

import warp_lcp as wl
from warp_lcp.files import TableValue
from warp_lcp.host_problem import Matrix
from warp_lcp.problem.affine_bounds import AffineBounds
from warp_lcp.problem.operator_protocol import families

if TYPE_CHECKING:
    import qpsolvers

Bounds = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
CONVERGED, INFEASIBLE, REFUSED, EXCEPTION = "CONVERGED", "INFEASIBLE", "REFUSED", "EXCEPTION"
# Methods that take any matrix or refuse it with a ValueError, which is no fault.
NAMED = tuple(
    sorted(
        name
        for name, cls in wl.METHODS.items()
        if "dense" in families(cls) and name != "direct-enumeration"
    )
)
GRID_METHODS = ("projected-multigrid", "minimum-map-newton", "mprgp", "psor", "interior-point")


@dataclass(frozen=True)
class HostileAnswer:
    """Result of a solve, on the host.

    Args:
        status: name of a `wl.SolveStatus`, or REFUSED (a ValueError) or EXCEPTION (any other).
        x: the solution, shape (n,).
        note: message of an exception, or further facts.
        values: other arrays by name, for example gradients.
    """

    status: str
    x: np.ndarray | None = None
    note: str = ""
    values: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class HostileBox:
    """Problem y = A x + b, l <= x <= u as plain arrays, with its known facts.

    Args:
        A: matrix (n, n), dense or scipy.sparse, float64.
        b: shape (n,).
        lower: l, shape (n,).
        upper: u, shape (n,).
        rtol: relative tolerance of the solve.
        solution: a solution known by construction.
        unique: whether that solution is the only one.
        solvable: whether a solution exists, by construction; None if an oracle decides.
        definite: whether A is symmetric positive semi-definite, by construction.
        monotone: whether x'Ax >= 0 for all x, by construction; implied by `definite`.
        grid: whether the problem was posed on a grid, where d_i = A_ii.
        storage: relative rounding of coefficients that the operator documents (float32 storage).
        affine: function of x that returns the bounds, if they are affine in x.
        largest: a bound on |x| beyond which an answer is suspicious.
    """

    A: Matrix
    b: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    rtol: float = 1e-6
    solution: np.ndarray | None = None
    unique: bool = False
    solvable: bool | None = None
    definite: bool = False
    monotone: bool = False
    grid: bool = False
    storage: float = 0.0
    affine: Bounds | None = None
    largest: float = np.inf

    def bounds(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return l and u at x."""
        return (self.lower, self.upper) if self.affine is None else self.affine(x)


@dataclass(frozen=True, kw_only=True)
class HostileProgram:
    """Quadratic program for qpsolvers, and a well-scaled form with the same x.

    Args:
        scaled: qpsolvers.Problem as given to the solver.
        plain: qpsolvers.Problem in units near 1, with inf where there is no bound.
        expected: "solvable", "infeasible" or "unbounded", by construction.
        unique: whether x is the only solution.
    """

    scaled: qpsolvers.Problem
    plain: qpsolvers.Problem
    expected: str
    unique: bool


@dataclass(frozen=True)
class ExpectedArrays:
    """Expected arrays, to a tolerance relative to the largest entry of each."""

    expected: dict[str, np.ndarray]
    tolerance: float


@dataclass(frozen=True)
class MalformedInput:
    """Malformed input, which must be refused.

    Expected is a ValueError, or a solve that ends in a status other than CONVERGED.
    """

    why: str


@dataclass(frozen=True)
class HostileCase:
    """One solve, with the truth about its answer.

    Args:
        name: description of the drawn case, in one line.
        solve: function that solves; its exceptions are recorded.
        truth: known facts of the answer.
        method: name of the method; None for the default.
    """

    name: str
    solve: Callable[[], HostileAnswer]
    truth: HostileBox | HostileProgram | ExpectedArrays | MalformedInput
    method: str | None = None


Made = wl.Operator | wl.SparseOperator | Matrix | LinearOperator  # what the library accepts as A
Side = float | np.ndarray | AffineBounds  # bounds in the form for the library


def box_case(
    rng: np.random.Generator,
    name: str,
    box: HostileBox,
    *,
    operator: Callable[[], Made] | None = None,
    shape: tuple[int, ...] | None = None,
    unknowns: np.ndarray | None = None,
    named: tuple[str, ...] = NAMED,
    share: float = 0.4,
    bounds: tuple[Side, Side] | None = None,
    entries: bool = True,
    x0: np.ndarray | None = None,
) -> HostileCase:
    """Return a case that solves a box problem.

    The case solves it by the default method, a named method or another entry point.

    Args:
        rng: random numbers.
        name: description of the drawn case.
        box: the problem.
        operator: makes A in the form for the library; None for `box.A` itself.
        shape: shape of the fields of a grid; None for matrices.
        unknowns: flat indices of the FLUID cells of a grid.
        named: methods to draw from.
        share: probability that a method is named.
        bounds: bounds in the form for the library; None for those of the box.
        entries: whether other entry points may be drawn.
        x0: start, shape (n,).
    """
    method = str(rng.choice(named)) if rng.random() < share else None
    entry = "solve"
    if entries and operator is None and x0 is None and box.affine is None:
        entry = str(
            rng.choice(["solve", "linear_complementarity", "command line"], p=[0.86, 0.125, 0.015])
        )

    def field_of(values: Side) -> Side:
        if isinstance(values, AffineBounds) or shape is None or unknowns is None:
            return values
        if np.ndim(values) == 0:
            return values
        full = np.zeros(int(np.prod(shape)))
        full[unknowns] = values
        return full.reshape(shape)

    def solve() -> HostileAnswer:
        A = box.A if operator is None else operator()
        low, high = (box.lower, box.upper) if bounds is None else bounds
        if entry == "linear_complementarity":
            found = wl.linear_complementarity(
                A, box.b, bounds=(low, high), tol=box.rtol, method=method
            )
            return HostileAnswer(
                found.result.status.name, np.asarray(found.x).ravel(), found.message
            )
        if entry == "command line":
            return command_line(A, box.b, low, high, box.rtol, method)
        problem = wl.LCP(A, field_of(box.b), field_of(low), field_of(high))
        stopping = wl.StoppingCriteria(rtol=box.rtol, max_iterations=1000 if method else 100)
        solver = wl.METHODS[method]() if method else None
        result = wl.solve(
            problem, solver, stopping=stopping, x0=None if x0 is None else field_of(x0)
        )
        x = result.x.numpy().astype(np.float64).ravel()
        note = f"{result.iterations} steps, relative residual {result.relative_residual:.1e}"
        return HostileAnswer(result.status.name, x if unknowns is None else x[unknowns], note)

    via = "" if entry == "solve" else f", by {entry}"
    return HostileCase(
        f"{name}, n={len(box.b)}, rtol {box.rtol:g}, {method or 'default'}{via}", solve, box, method
    )


def command_line(
    A: TableValue,
    b: np.ndarray,
    lower: TableValue,
    upper: TableValue,
    rtol: float,
    method: str | None,
) -> HostileAnswer:
    """Solve by `warp-lcp solve` from Matrix Market files."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for label, array in (("A", A), ("b", b), ("l", lower), ("u", upper)):
            column = np.broadcast_to(array, np.shape(b)).reshape(-1, 1) if label != "A" else array
            text = (
                scipy.sparse.coo_array(column)
                if scipy.sparse.issparse(column)
                else np.asarray(column)
            )
            scipy.io.mmwrite(folder / f"{label}.mtx", text, precision=17)
        command = [
            sys.executable,
            "-m",
            "warp_lcp.cli.commands",
            "solve",
            "A.mtx",
            "b.mtx",
            "--lower",
            "l.mtx",
            "--upper",
            "u.mtx",
        ]
        command += ["--tolerance", f"{rtol:g}", "--out", "x.mtx", "--device", "cpu"] + (
            ["--method", method] if method else []
        )
        code = (
            f"import sys; sys.argv = {['warp-lcp', *command[3:]]!r}; from warp_lcp.cli.commands "
            "import main; main()"
        )
        run = subprocess.run(
            [sys.executable, "-c", code],
            cwd=folder,
            env=_environment(),
            capture_output=True,
            text=True,
            check=False,
        )
        output = f"{run.stdout}\n{run.stderr}".strip()
        if run.returncode == 0 and (folder / "x.mtx").exists():
            return HostileAnswer(
                CONVERGED, np.asarray(scipy.io.mmread(folder / "x.mtx")).ravel(), output[-200:]
            )
        if run.returncode == 2:
            return HostileAnswer(REFUSED, None, output[-200:])
        if run.returncode != 1 or "Traceback" in output:
            return HostileAnswer(EXCEPTION, None, f"exit code {run.returncode}: {output[-200:]}")
        status = next(
            (s.name for s in wl.SolveStatus if s.name in output and s.name != CONVERGED), "FAILED"
        )
        return HostileAnswer(status, None, output[-200:])


def _environment() -> dict[str, str]:
    """Return the environment of a child process that can import this package.

    It works in any folder.
    """
    import os

    root = str(Path(wl.__file__).parents[1])
    return {**os.environ, "PYTHONPATH": os.pathsep.join([root, os.environ.get("PYTHONPATH", "")])}
