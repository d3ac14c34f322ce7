"""Computations of the suite `validation` on known signals and particles.

And the cheapest checks.
"""

import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import trapezoid

import warp_lcp.benchmarks.__main__ as process
from warp_lcp.benchmarks import validation
from warp_lcp.benchmarks.harness.record import RecordLines
from warp_lcp.benchmarks.suite import VALIDATION
from warp_lcp.benchmarks.validation import dam_break, floating, rest, signals, transfers, walls
from warp_lcp.benchmarks.validation.finding import (
    Finding,
    Findings,
    ValidationCheck,
    ValidationTrial,
    attempt,
    control,
    table,
)
from warp_lcp.benchmarks.validation.scenes import (
    SUB_CELL,
    VOXEL,
    NumericalSettings,
    create_liquid,
    fill,
)
from warp_lcp.benchmarks.validation.signals import cumulative, enclosed_cells, filled_fraction
from warp_lcp.grid.triangle_mesh import load_surface
from warp_lcp.simulation import StepFailed


def test_a_finding_keeps_its_bound_and_a_control_breaks_it() -> None:
    assert Finding("x", 0.9, high=1.0).passed
    assert not Finding("x", 1.1, high=1.0).passed
    assert Finding("x", 1.5, low=1.0, high=2.0).passed
    assert not Finding("x", 0.5, low=1.0, high=2.0).passed
    assert not control(Finding("x", 0.9, high=1.0)).passed
    assert control(Finding("x", 1.1, high=1.0)).passed
    for finding in (Finding("x", math.nan, high=1.0), control(Finding("x", math.nan, high=1.0))):
        assert not finding.passed
    assert Finding("x", 1.0, high=2.0, unit="m").row() == ["x", "1 m", "<= 2 m", "yes"]
    assert control(Finding("x", 1.0, low=2.0)).row() == [
        "control: x",
        "1",
        "must break >= 2",
        "yes",
    ]
    assert Finding("x", 9.0, low=1.0, high=2.0).row() == ["x", "9", "1 to 2", "NO"]


def found(value: float, broken: float) -> ValidationTrial:
    def run(findings: Findings) -> None:
        findings.add("error", value, high=1.0, unit="%")
        findings.must_break("whole cells: error", broken, high=1.0, unit="%")

    return attempt("waves", "8 cells", run)


def test_records_list_passed_bounds_and_failed_controls() -> None:
    good, bad, blind = found(0.5, 2.0), found(1.5, 2.0), found(0.5, 0.5)
    assert [t.passed for t in (good, bad, blind)] == [True, False, False]
    record = good.record()
    assert record.name == "waves, 8 cells"
    assert record.figures["error"].value == 0.5
    assert record.figures["control: whole cells: error"].unit == "%"
    assert record.figures["seconds"].value >= 0
    assert (record.facts["passed"], record.facts["controls_failed_as_they_must"]) == (True, True)
    assert (bad.record().facts["passed"], blind.record().facts["controls_failed_as_they_must"]) == (
        False,
        False,
    )
    assert good.failures() == []
    assert bad.failures() == ["waves, 8 cells: error = 1.5 % (<= 1 %)"]
    assert blind.failures() == [
        "waves, 8 cells: control: whole cells: error = 0.5 % (must break <= 1 %)"
    ]


def test_a_simulation_that_ends_early_fails_its_check() -> None:
    def run(findings: Findings) -> None:
        findings.add("error", 0.0, high=1.0)
        raise StepFailed("no convergence")

    trial = attempt("waves", "8 cells", run)
    assert not trial.passed
    assert trial.failures() == ["waves, 8 cells: no convergence"]
    assert trial.record().facts["error"] == "no convergence"
    assert table("waves", "", [trial]).rows[-1] == [
        "waves, 8 cells",
        "error",
        "no convergence",
        "none",
        "NO",
    ]


def test_the_period_of_a_fading_wave_with_a_drift() -> None:
    t = np.linspace(0.0, 9.0, 400)
    for offset in (0.0, 0.2, -0.2):
        assert signals.period(
            t, np.exp(-0.02 * t) * np.cos(2 * np.pi * t / 1.7) + offset
        ) == pytest.approx(1.7, rel=3e-3)
    assert signals.period(t, np.cos(2 * np.pi * t / 1.7)) == pytest.approx(1.7, rel=1e-4)
    with pytest.raises(ValueError, match="no period"):
        signals.period(t, 1.0 + t)


def test_the_first_mode_of_particles_is_that_of_their_surface() -> None:
    x, y = np.meshgrid((np.arange(400) + 0.5) / 400, (np.arange(400) + 0.5) / 400)
    wet = y < 0.5 + 0.03 * np.cos(np.pi * x) - 0.02 * np.cos(2 * np.pi * x)
    assert signals.mode(x[wet], np.pi, 1 / 400**2, 1.0) == pytest.approx(0.03, rel=0.01)
    assert signals.mode(x[wet], 2 * np.pi, 1 / 400**2, 1.0) == pytest.approx(-0.02, rel=0.01)


def test_the_shift_that_fits_best() -> None:
    t = np.linspace(0.0, 4.0, 300)
    values, at = 1.0 + t**2, np.array([1.0, 1.5, 2.0, 2.7])
    shift, error = signals.best_shift(t, values, at, 1.0 + (at - 0.17) ** 2, 0.3)
    assert shift == pytest.approx(-0.17)
    assert error < 1e-4
    assert signals.best_shift(t, values, at, 1.0 + (at - 0.5) ** 2, 0.3)[0] == pytest.approx(-0.3)
    assert signals.relative_rms(t, 1.1 * values, at, 1.0 + at**2) == pytest.approx(0.1, rel=1e-3)
    for pace in (0.71, 1.0, 1.4):
        assert signals.best_pace(
            t / pace, 1.0 + (t - 0.1) ** 2, at, 1.0 + at**2, 0.3
        ) == pytest.approx(pace, rel=0.01)


def test_the_front_is_the_far_edge_of_the_last_floor_cell_half_full() -> None:
    liquid = np.array([[1.0, 1.0, 0.5, 0.25, 0.75, 0.25], [1.0, 1.0, 1.0, 1.0, 1.0, 1.0]])
    assert signals.front(liquid) == 5
    assert signals.front(np.zeros((2, 4))) == 0


def test_an_even_front_is_found_between_the_cells() -> None:
    """Place of an evenly moving front between the cells.

    The staircase of an even advance lies half a cell ahead where it begins and half a cell behind
    where it ends; in the middle it is exact.
    """
    t = np.linspace(0.0, 5.0, 501)
    places = np.floor(2.0 * t + 0.5)  # a front at 2 t, resolved to a cell
    # A front that falls back is ignored.
    middle, at = signals.stays(t, np.where(t > 4.0, 3.0, places))
    assert np.array_equal(at, np.arange(8))
    assert middle[1:] == pytest.approx(at[1:] / 2.0, abs=0.01)


def test_the_height_of_a_column() -> None:
    assert signals.surface_height(np.array([1.0, 1.0, 0.5, 0.0])) == pytest.approx(2.5)
    assert signals.surface_height(np.array([1.0, 0.0, 1.0, 0.75, 0.25, 0.0])) == pytest.approx(4.0)
    assert signals.surface_height(np.array([1.0, 1.0])) == pytest.approx(2.0)
    assert signals.surface_height(np.array([0.2, 0.1])) == 0.0


def test_orders() -> None:
    assert signals.order([1.0, 0.25, 0.0625]) == pytest.approx(2.0)
    assert signals.order([1.0, 1 / 27], refinement=3.0) == pytest.approx(3.0)


def test_the_data_are_those_of_the_experiment() -> None:
    assert len(dam_break.T) == len(dam_break.Z) == 15
    assert len(dam_break.TAU) == len(dam_break.H) == 16
    assert (np.diff(dam_break.T) > 0).all()
    assert (np.diff(dam_break.Z) > 0).all()
    assert (np.diff(dam_break.TAU) > 0).all()
    assert (np.diff(dam_break.H) < 0).all()
    assert abs(rest.PERIOD - 1.18182) < 1e-5


def test_the_kernel_of_the_density_is_a_quadratic_spline() -> None:
    s = np.linspace(-2.0, 2.0, 4001)
    density = np.gradient(cumulative(s), s)
    exact = np.where(
        np.abs(s) < 0.5, 0.75 - s**2, np.where(np.abs(s) < 1.5, 0.5 * (1.5 - np.abs(s)) ** 2, 0.0)
    )
    assert density == pytest.approx(exact, abs=1e-3)


@pytest.mark.parametrize("degrees", [0.0, 20.0])
def test_the_volume_inside_a_surface_is_that_of_the_half_space(degrees: float) -> None:
    """Volume inside a surface: that of the half space.

    It is not the number of particles times their volume: squeezed to 80 % of their distance, they
    enclose less.
    """
    n, m = 20, 8
    x, y = (
        a.ravel() for a in np.meshgrid((np.arange(n * m) + 0.5) / m, (np.arange(n * m) + 0.5) / m)
    )
    angle = math.radians(degrees)
    wet = -(x - 10.0) * math.sin(angle) + (y - 8.3) * math.cos(angle) < 0.0
    points = np.stack([x[wet], y[wet]], axis=1)
    assert enclosed_cells(points, (n, n), 1 / m**2) == pytest.approx(wet.sum() / m**2, rel=1e-3)
    squeezed = points * [1.0, 0.8]
    assert enclosed_cells(squeezed, (n, n), 1 / m**2) < 0.85 * 20 * 8.3
    assert filled_fraction(points, (n, n), 1 / m**2)[0, :5] == pytest.approx(1.0, abs=2e-3)


def test_the_wave_is_a_closed_surface_of_the_right_volume(tmp_path: Path) -> None:
    rest.write_wave(tmp_path / "wave.obj")
    surface = load_surface("wave.obj", tmp_path)
    x = np.linspace(-0.1, 1.1, rest.POINTS)
    area = trapezoid(rest.DEPTH + 0.1 + rest.AMPLITUDE * np.cos(np.pi * x), x)
    assert surface.volume == pytest.approx(2.0 * area, rel=1e-4)


def test_the_bias_of_a_pressure() -> None:
    dx = 0.04
    y = (np.arange(20) + 0.5) * dx
    for cells in (0.0, 0.5):
        pressure = np.tile(np.maximum(9810.0 * (0.4 + cells * dx - y), 0.0)[:, None], (1, 20))
        pressure[0, 3] = 0.0  # a solid cell
        assert rest._bias(pressure, dx)[0] == pytest.approx(cells, abs=1e-9)


def test_angular_momentum_is_that_of_the_grid_around_the_particles() -> None:
    """Angular momentum on the grid around the particles.

    A rigid rotation has |x|^2 of the nodes of each tent function, not of the particles. The
    difference is the affine part.
    """
    c = transfers.cloud(16, "float64", affine=True)
    expected = c.angular_momentum()
    c.round_trip()
    total = 0.0
    j, i = np.meshgrid(np.arange(18), np.arange(18), indexing="ij")
    for axis, (field, weight) in enumerate(zip(c.fields, c.weights, strict=True)):
        momentum = (field.numpy() * weight.numpy())[1]
        # The coordinate across the component: x for v, y for u.
        arm = (i - 0.5 if axis else j - 0.5) / 16
        total += (1 if axis else -1) * float((arm * momentum).sum())
    assert total == pytest.approx(expected, rel=1e-12)


def test_cells_are_filled_by_their_particles() -> None:
    simulation = create_liquid(
        VOXEL, [1.0, 0.5], 8, [{"shape": "box", "min": [0.0, 0.0], "max": [0.5, 0.25]}]
    )
    expected = np.zeros((4, 8))
    expected[:2, :4] = 1.0
    assert np.array_equal(fill(simulation), expected)


def test_round_trips_keep_their_invariants() -> None:
    trial = transfers.round_trip(16)
    assert trial.failures() == []
    assert trial.record().facts["controls_failed_as_they_must"]


def test_the_advection_has_its_orders_and_worse_ones_do_not() -> None:
    trial = transfers.orders()
    assert trial.failures() == []
    assert [f.what for f in trial.findings if f.control] == [
        "control: Euler's steps, one turn: order in time",
        "control: fields half a cell off: order in space",
    ]
    assert transfers.euler_error(1000) == pytest.approx(
        2.0 * np.pi**2 * np.hypot(0.15, 0.25) / 1000, rel=0.02
    )


@pytest.mark.parametrize(("numerics", "shape"), [(VOXEL, "flat"), (SUB_CELL, "slanted")])
def test_a_block_separates_from_the_ceiling_and_its_controls_do_not(
    numerics: NumericalSettings, shape: str
) -> None:
    trial = walls.falling(24, numerics, shape)
    assert trial.failures() == []
    assert len([f for f in trial.findings if f.control]) == 3


def test_a_layer_slides_along_a_slope_and_is_stopped_by_stairs() -> None:
    trial = walls.sliding(5)
    assert trial.failures() == []
    assert trial.findings[-1].control
    assert trial.findings[-1].value > 5.0


def test_light_bodies_take_more_iterations_without_the_correction() -> None:
    heavy, light, uncorrected = (
        floating._iterations(12, ratio, corrected=corrected)
        for ratio, corrected in ((1.0, True), (1e-3, True), (1e-3, False))
    )
    assert light <= 1.5 * heavy
    assert uncorrected > 1.5 * heavy


@pytest.mark.parametrize("error", [0.5, 2.0])
def test_a_failed_check_ends_the_process_with_1_after_its_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: float
) -> None:
    chart = RecordLines("waves", "waves", "t", "y", {"c": ([0.0, 1.0], [-1.0, 1.0])}, log="")
    check = ValidationCheck(
        about="Waves.",
        trials=[(found, [(error, 3.0)])],
        charts=[lambda trials: chart],
        known="steep",
    )
    monkeypatch.setattr(validation, "CHECKS", {"waves": check})
    monkeypatch.setattr(
        sys, "argv", ["benchmarks", "validation", "--out", str(tmp_path), "--repeat", "1"]
    )
    if error > 1.0:
        with pytest.raises(SystemExit) as ended:
            process.main()
        assert ended.value.code == 1
    else:
        process.main()
    records = {r["name"]: r for r in json.loads((tmp_path / "validation.json").read_text())}
    assert records["waves, 8 cells"]["passed"] is (error < 1.0)
    assert (tmp_path / "validation-waves.png").is_file()
    page = (tmp_path / "validation.md").read_text(encoding="utf-8")
    assert "| waves, 8 cells | error |" in page
    assert (
        f"{int(error < 1.0)} of 1 figures keep their tolerance, and 1 of 1 negative controls fail "
        "theirs" in page
    )
    assert ("| waves, 8 cells: error = 2 % (<= 1 %) | steep |" in page) is (error > 1.0)


def test_each_check_has_its_own_resolutions(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="has its own resolutions"):
        VALIDATION.run(device="cpu", out=tmp_path, sizes=(16,))
