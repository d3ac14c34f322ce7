"""Monitors of a solve: printed progress and plots of convergence."""

import re

import numpy as np
import pytest

import warp_lcp as wl

A = np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 2.0]])
PROBLEM = wl.LCP(wl.DenseOperator(A, device="cpu"), np.array([1.0, -3.0, 0.5]))


def test_progress_has_a_line_for_each_record(capsys):
    result = wl.solve(PROBLEM, "psor", callback=wl.print_progress)
    lines = capsys.readouterr().out.splitlines()
    assert result and len(lines) == len(result.history)
    for line, record in zip(lines, result.history, strict=True):
        residual = re.escape(f"{record.residual:.6e}")
        assert re.fullmatch(
            rf" *{record.iteration}  residual {residual} +[0-9.]+ s  {record.step}", line
        )


def test_a_name_is_the_method_with_its_default_settings():
    by_name, by_method = wl.solve(PROBLEM, "psor"), wl.solve(PROBLEM, wl.ProjectedSOR())
    assert by_name.iterations == by_method.iterations
    np.testing.assert_array_equal(by_name.x.numpy(), by_method.x.numpy())


def test_plots_have_the_relative_residuals_of_each_solve():
    pyplot = pytest.importorskip("matplotlib.pyplot")
    results = {name: wl.solve(PROBLEM, name) for name in ("psor", "minimum-map-newton")}
    axes = wl.plot_convergence(results)
    assert [text.get_text() for text in axes.get_legend().get_texts()] == list(results)
    for line, result in zip(axes.get_lines(), results.values(), strict=True):
        first = np.linalg.norm(np.minimum(0.0, PROBLEM.b.numpy()))  # natural residual at x = 0
        expected = np.array([record.residual for record in result.history]) / first
        drawn = np.asarray(line.get_ydata(), dtype=float)
        np.testing.assert_allclose(drawn[expected > 0.0], expected[expected > 0.0], rtol=1e-6)
        assert np.isnan(drawn[expected == 0.0]).all()
    assert axes.get_yscale() == "log"
    given = wl.plot_convergence(
        list(results.values()), x="seconds", relative=False, axes=pyplot.figure().add_subplot()
    )
    assert (given.get_xlabel(), given.get_ylabel(), len(given.get_lines())) == (
        "wall time [s]",
        "residual",
        2,
    )
    pyplot.close("all")


@pytest.mark.parametrize("results", [[], {}, [1.0], "psor"])
def test_arguments_that_are_no_result_are_refused(results):
    with pytest.raises(ValueError, match=r"expected a result of wl\.solve"):
        wl.plot_convergence(results)
    with pytest.raises(
        ValueError, match="x = 'steps': must be one of iterations, seconds, linear_iterations"
    ):
        wl.plot_convergence(results, x="steps")
