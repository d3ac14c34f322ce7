"""Solve a problem from Matrix Market files: `warp-lcp solve`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.io
import scipy.sparse
from rich.table import Table

from warp_lcp.cli.matrix_market import MarketError, Matrix, ShapeTest, read_market, read_shape
from warp_lcp.files.atomic import replacing
from warp_lcp.method_selection import solve
from warp_lcp.operators import DenseOperator, SparseOperator
from warp_lcp.problem.bounds import huge_as_infinite
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import Solver
from warp_lcp.problem.operator_protocol import families
from warp_lcp.problem.result import SolveResult
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.run.problem_folder import ProblemError
from warp_lcp.settings import SettingError
from warp_lcp.solvers.registry import METHODS

MOST_ROWS = 40  # rows of the table of iterations: a longer history shows its first and last ones
SQUARE: tuple[ShapeTest, str] = (lambda rows, columns: rows == columns > 0, "A must be square")
FORMAT = "a Matrix Market file (https://math.nist.gov/MatrixMarket/formats.html)"


@dataclass(frozen=True)
class FileOutcome:
    """Result of a solve and the problem solved.

    Attributes:
        problem: the problem.
        solver: the method; None if `wl.solve` has chosen it.
        name: name in `METHODS` of the method that found x.
        result: the result.
    """

    problem: LCP
    solver: Solver | None
    name: str
    result: SolveResult

    def heading(self) -> str:
        """Return a line about the problem."""
        A = self.problem.A
        kind = f"{A.nnz} entries, " if isinstance(A, SparseOperator) else "dense, "
        symmetry = "symmetric" if A.symmetric else "unsymmetric"
        return (
            f"{self.problem.layout.size} unknowns, {kind}{symmetry}, by {self.methods} on "
            f"{self.problem.device}"
        )

    @property
    def methods(self) -> str:
        """Names of the methods that were used, in order."""
        return ", then ".join(
            dict.fromkeys(record.method or self.name for record in self.result.history)
        )

    def table(self) -> Table:
        """Return the history as a table."""
        table = Table(
            "iteration",
            "residual",
            "linear",
            "active",
            "step",
            "seconds",
            box=None,
            header_style="bold",
        )
        for column in table.columns[:4]:
            column.justify = "right"
        history = self.result.history
        shown = (
            [*history[: MOST_ROWS // 2], None, *history[-(MOST_ROWS // 2) :]]
            if len(history) > MOST_ROWS
            else history
        )
        for record in shown:
            if record is None:
                table.add_row("...")
                continue
            active = "" if record.active is None else str(record.active)
            row = [
                str(record.iteration),
                f"{record.residual:.3e}",
                str(record.linear_iterations),
                active,
                record.step,
            ]
            table.add_row(*row, f"{record.seconds:.3f}")
        return table

    def ending(self) -> str:
        """Return a line about the result."""
        r = self.result
        size = f"residual {r.residual:.3e}, relative {r.relative_residual:.3e}"
        return f"{r.status.name}: {r.status.value}; {r.iterations} iterations, {size}"

    def write(self, path: Path) -> None:
        """Write x as a Matrix Market array, n x 1.

        Raises:
            ProblemError: the file cannot be written.
        """
        write_vector(path, self.result.x.numpy())


def solve_files(
    matrix: Path,
    right_side: Path,
    *,
    lower: str,
    upper: str,
    method: str | None,
    tolerance: float,
    max_iterations: int,
    max_seconds: float,
    device: str,
) -> FileOutcome:
    """Solve y = A x + b, lower <= x <= upper, from files.

    Args:
        matrix: A, sparse (coordinate) or dense (array).
        right_side: b, a vector of either form.
        lower: a number, or the file of a vector; magnitudes of 1e20 and more are infinite.
        upper: likewise.
        method: a name in `METHODS`; `wl.solve` chooses if None.
        tolerance: residual, relative to the one at clip(0, lower, upper).
        max_iterations: limit of steps.
        max_seconds: limit of the wall time.
        device: a Warp device.

    Raises:
        ProblemError: a file or an option is invalid.
    """
    stopping = criteria(tolerance, max_iterations, max_seconds)
    n = _checked(matrix, *SQUARE)[0]  # sizes first: a file may have a huge number of rows
    for path in (
        right_side,
        *(Path(side) for side in (lower, upper) if _number(side) is None and Path(side).exists()),
    ):
        _checked(path, *_vector_of(n))
    A = read_matrix(matrix)
    b = read_vector(right_side, n)
    sides = [_bound(value, n, f"--{name}") for name, value in (("lower", lower), ("upper", upper))]
    try:
        operator = (
            SparseOperator(A, device=device)
            if scipy.sparse.issparse(A)
            else DenseOperator(A, device=device)
        )
        problem = LCP(operator, b, *sides)
        family = "sparse" if isinstance(operator, SparseOperator) else "dense"
        solver = None if method is None else method_named(method, family)
        result = solve(problem, solver, stopping=stopping)
    except ValueError as error:
        raise ProblemError(str(error)) from error
    return FileOutcome(problem, solver, method or str(result.method), result)


def criteria(tolerance: float, max_iterations: int, max_seconds: float) -> StoppingCriteria:
    """Return the stopping criteria from options.

    Raises:
        ProblemError: an option is outside its range; the message names it.
    """
    try:
        return StoppingCriteria(
            rtol=tolerance, max_iterations=max_iterations, max_seconds=max_seconds
        )
    except SettingError as error:
        option = "tolerance" if error.name == "rtol" else error.name.replace("_", "-")
        raise ProblemError(f"--{option} {error.value}: must be {error.rule}") from error


def read_matrix(path: Path) -> Matrix:
    """Return a square matrix, scipy.sparse or numpy, as stored in the file.

    Raises:
        ProblemError: the file cannot be read, or is no finite real square matrix.
    """
    return _read(path, *SQUARE)


def read_vector(path: Path, n: int, *, infinite: bool = False) -> np.ndarray:
    """Return a vector of n finite numbers from a file of shape n x 1 or 1 x n.

    Or also infinite ones, if `infinite` is set.

    Raises:
        ProblemError: the file cannot be read, or is no such vector.
    """
    matrix = _read(path, *_vector_of(n), infinite=infinite)
    return (matrix if isinstance(matrix, np.ndarray) else matrix.toarray()).ravel()


def write_vector(path: Path, x: np.ndarray) -> None:
    """Write a vector as a Matrix Market array, n x 1.

    Raises:
        ProblemError: the file cannot be written.
    """
    try:
        with replacing(path) as stream:
            scipy.io.mmwrite(stream, x.reshape(-1, 1), precision=17)
    except OSError as error:
        raise ProblemError(f"--out {path}: {error.strerror}") from error


def _vector_of(n: int) -> tuple[ShapeTest, str]:
    """Return the test for shapes of a vector, and their description."""
    return (
        lambda rows, columns: (rows, columns) in ((n, 1), (1, n)),
        f"expected {n} x 1, a number for each row of A",
    )


def _checked(path: Path, fits: ShapeTest, expected: str) -> tuple[int, int]:
    """Return the shape in a file's header after a check."""
    with _file_named_in_errors(path):
        return read_shape(path, fits, expected)


@contextmanager
def _file_named_in_errors(path: Path) -> Iterator[None]:
    """Add the file's name to errors of reading."""
    try:
        yield
    except FileNotFoundError as error:
        raise ProblemError(f"{path}: no such file") from error
    except OSError as error:
        raise ProblemError(f"{path}: {error.strerror or error}") from error
    except MarketError as error:
        raise ProblemError(f"{path}: is not {FORMAT}: {error}") from error
    except ValueError as error:
        raise ProblemError(f"{path}: {error}") from error


def _read(path: Path, fits: ShapeTest, expected: str, *, infinite: bool = False) -> Matrix:
    """Return the matrix in a file of an allowed shape, with finite real numbers.

    Or also infinite ones, if `infinite` is set.
    """
    with _file_named_in_errors(path):
        matrix = read_market(path, fits, expected)
    values = matrix if isinstance(matrix, np.ndarray) else matrix.data
    wrong = np.isnan(values) if infinite else ~np.isfinite(values)
    if wrong.any():
        raise ProblemError(
            f"{path}: holds {np.count_nonzero(wrong)} values that are "
            f"{'NaN' if infinite else 'not finite'}"
        )
    return matrix


def _number(value: str) -> float | None:
    """Return a number; None if the text is no number."""
    try:
        return float(value)
    except ValueError:
        return None


def _bound(value: str, n: int, option: str) -> float | np.ndarray:
    """Return a bound: a number, or the vector in a file; 1e20 and more is infinite."""
    number = _number(value)
    if number is None and not Path(value).exists():
        raise ProblemError(f"{option} {value}: neither a number nor a file")
    side = huge_as_infinite(
        read_vector(Path(value), n, infinite=True) if number is None else np.asarray(number)
    )
    wrong = np.inf if option == "--lower" else -np.inf
    if (side == wrong).any():
        raise ProblemError(
            f"{option} {value}: is {wrong} (1e20 and more count as infinite): no x could meet it"
        )
    return side if side.ndim else float(side)


def method_named(name: str, family: str, *, shared: bool = False) -> Solver:
    """Return a method by its name, for a family of operators.

    With `shared`, for several ranks.
    """
    if name not in METHODS:
        raise ProblemError(f"--method {name}: no such method; {METHODS.nearest(name)}")
    fits = [
        known
        for known, kind in METHODS.items()
        if family in families(kind) and (not shared or getattr(kind, "distributed", False))
    ]
    if name not in fits:
        what = (
            "work on several ranks"
            if shared
            else "solve grid problems"
            if family == "grid"
            else f"accept {family} matrices"
        )
        raise ProblemError(f"--method {name}: does not {what}; choose from {', '.join(fits)}")
    try:
        return METHODS[name]()
    except (ImportError, TypeError) as error:
        raise ProblemError(f"--method {name}: {error}") from error
