"""Watch a solve: print its progress, plot its residuals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from warp_lcp.problem.result import SolveResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from warp_lcp.problem.result import Record

X_AXES = {  # of plot_convergence: the attribute of Record and the axis label
    "iterations": ("iteration", "iterations"),
    "seconds": ("seconds", "wall time [s]"),
    "linear_iterations": ("linear_iterations", "linear iterations"),
}


def print_progress(record: Record) -> None:
    """Print a line for each iteration of a solve.

    Use it as `wl.solve(problem, callback=wl.print_progress)`.

    A line has the iteration, the norm of the natural residual in the units of y, the wall time in
    seconds and the kind of the last step. It is like the output of PETSc's `-snes_monitor`.

    Args:
        record: argument that `wl.solve` passes to its callback.
    """
    print(
        f"{record.iteration:5d}  residual {record.residual:.6e}  {record.seconds:9.3f} s  "
        f"{record.step}",
        flush=True,
    )


def plot_convergence(
    results: SolveResult | Sequence[SolveResult] | Mapping[str, SolveResult],
    *,
    x: str = "iterations",
    relative: bool = True,
    axes: Axes | None = None,
) -> Axes:
    """Plot residuals over iterations or seconds, on a logarithmic axis.

    There is one line for each solve.

    Args:
        results: one result of `wl.solve`, a sequence of results, or a mapping from labels to
            results.
        x: the horizontal axis: "iterations", "seconds" or "linear_iterations".
        relative: divide each residual by the one at clip(0, l, u), as `StoppingCriteria(rtol=...)`
            does. Without it residuals have the units of y.
        axes: Matplotlib axes to draw into; new ones if None.

    Returns:
        The Matplotlib axes; `axes.figure.savefig("convergence.png")` writes the picture.

    Raises:
        ValueError: results is of another kind or empty, or `x` names no axis.
        ImportError: Matplotlib is missing.
    """
    if x not in X_AXES:
        raise ValueError(f"x = {x!r}: must be one of {', '.join(X_AXES)}")
    lines = _labeled(results)
    if axes is None:
        try:
            from matplotlib import pyplot  # an optional dependency, half a second to import
        except ImportError as error:
            raise ImportError(
                "plot_convergence needs Matplotlib: pip install matplotlib"
            ) from error
        axes = pyplot.figure().add_subplot()
    attribute, axis_label = X_AXES[x]
    for label, result in lines:
        position = [getattr(record, attribute) for record in result.history]
        residual = np.array([record.residual for record in result.history])
        if relative:
            residual = residual / _reference(result)
        # log(0) has no place
        axes.semilogy(position, np.where(residual > 0.0, residual, np.nan), marker=".", label=label)
    axes.set_xlabel(axis_label)
    axes.set_ylabel("relative residual" if relative else "residual")
    axes.legend()
    return axes


def _labeled(
    results: SolveResult | Sequence[SolveResult] | Mapping[str, SolveResult],
) -> list[tuple[str, SolveResult]]:
    """Return pairs of a label and a result."""
    if isinstance(results, SolveResult):
        results = [results]
    if isinstance(results, Mapping):
        lines = [(str(label), result) for label, result in results.items()]
    elif isinstance(results, Sequence):
        lines = [
            (getattr(result, "method", None) or f"solve {number}", result)
            for number, result in enumerate(results, 1)
        ]
    else:
        lines = []
    if not lines or not all(isinstance(result, SolveResult) for _, result in lines):
        raise ValueError(
            "results: expected a result of wl.solve, a sequence of them, or a mapping from labels "
            "to results; at least one"
        )
    return lines


def _reference(result: SolveResult) -> float:
    """Return the norm of the natural residual at clip(0, l, u).

    Relative residuals are divided by it.
    """
    return (
        result.residual / result.relative_residual
        if result.relative_residual > 0.0
        else max(result.history[0].residual, 1e-300)
    )
