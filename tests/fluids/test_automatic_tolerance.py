"""Automatic tolerance of the pressure from the time step.

The error of a solve is small beside that of the time step, and no smaller than necessary.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from small_liquids import GRAVITY, advance, box, create, dam, scene
from warp_lcp.fluids import SIMULATOR, LiquidScene
from warp_lcp.fluids.tolerance import FIRST, FRACTION, LEAST, MOST
from warp_lcp.scene.table import SceneError, validate

AUTO = {"tolerance": "auto"}


def velocity_errors(simulation: Any, steps: int, patch: pytest.MonkeyPatch) -> np.ndarray:
    """Return the velocity error of each step's solve, root mean square [m/s].

    Relative to a solve that continues further.
    """
    solve, errors = wl.solve, []

    def solving(problem: wl.LCP, solver: Any, **options: Any) -> wl.SolveResult:
        start = wp.clone(options["x0"])
        result = solve(problem, solver, **options)
        left = result.x.numpy().ravel().copy()
        exact = (
            solve(problem, solver, stopping=wl.StoppingCriteria(rtol=1e-10), x0=start)
            .x.numpy()
            .ravel()
        )
        error = wp.array(left - exact, dtype=wp.float64)
        product = problem.A.apply(error)
        errors.append(
            np.sqrt(
                max(error.numpy() @ product.numpy(), 0.0) / (problem.unknown.numpy() == 1).sum()
            )
        )
        return result

    with patch.context() as patched:
        patched.setattr(wl, "solve", solving)
        rows = [simulation.step(min(simulation.stable_dt(), 0.01)) for _ in range(steps)]
    simulation.rows = rows
    return np.array(errors)


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("model", ["incompressible", "unilateral"])
def test_a_solve_leaves_a_stated_part_of_the_time_steps_error(
    model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulation = dam(solver=AUTO, pressure={"model": model})
    errors = velocity_errors(simulation, 30, monkeypatch)
    assert simulation.rows[0]["time_error"] is None, "no step came before"
    assert [row["tolerance"] for row in simulation.rows[:2]] == pytest.approx([FIRST, FIRST])
    time_errors = np.array([row["time_error"] for row in simulation.rows[1:]])
    assert (errors[2:] <= 1.5 * FRACTION * time_errors[:-1] + 1e-6).all(), (
        "each is held to the error of the step before it"
    )
    used = np.array([row["tolerance"] for row in simulation.rows[2:]])
    assert (used >= LEAST).all()
    assert (used <= 1.5 * MOST).all()
    assert np.median(used) > 1e-3, "no smaller than it need be"


def test_the_time_error_is_what_halving_the_time_step_makes_less() -> None:
    coarse, fine = (advance(dam(solver=AUTO), 0.2, dt_max=dt) for dt in (4e-3, 2e-3))
    ratio = np.median([row["time_error"] for row in coarse[5:]]) / np.median(
        [row["time_error"] for row in fine[5:]]
    )
    assert 1.5 < ratio < 4.5, (
        "second order a step, where the surface does not jump from cell to cell"
    )


def test_liquid_at_rest_stays_at_rest() -> None:
    model = scene(size=[1.0, 1.0], resolution=16, liquid=[box([0.0, 0.0], [1.0, 0.5])], solver=AUTO)
    rows = advance(create(model), 1.0)
    assert max(row["max_speed"] for row in rows) < 0.05 * np.sqrt(GRAVITY / 16)
    assert max(row["solve_iterations"] for row in rows[5:]) <= 6


def test_free_fall_is_not_iterated_on() -> None:
    model = scene(size=[1.0, 2.0], resolution=32, liquid=[box([0.3, 1.2], [0.7, 1.7])], solver=AUTO)
    rows = advance(create(model), 0.3)
    assert max(row["solve_iterations"] for row in rows[1:]) <= 1
    assert rows[-1]["center_of_mass_y"] == pytest.approx(1.45 - 0.5 * GRAVITY * 0.3**2, abs=0.04)


def test_the_run_is_that_of_an_exact_solver_as_far_as_its_steps_allow() -> None:
    """Front and energy of a run with automatic tolerance.

    They are nearer to those of an exact solver than those are to a run of half the time step.
    """
    runs: dict[str, tuple[float, float]] = {}
    for name, tolerance, dt in (
        ("auto", "auto", 8e-3),
        ("exact", 1e-9, 8e-3),
        ("half", 1e-9, 4e-3),
    ):
        simulation = dam(solver={"tolerance": tolerance})
        row = advance(simulation, 0.3, dt_max=dt)[-1]
        front = float(np.percentile(simulation.particles.position.numpy()[:, 0], 99))
        runs[name] = front, row["kinetic_energy"] + row["potential_energy"]
    for seen in (0, 1):
        assert abs(runs["auto"][seen] - runs["exact"][seen]) < 0.5 * abs(
            runs["half"][seen] - runs["exact"][seen]
        )


def test_a_run_that_is_continued_takes_the_same_steps() -> None:
    def fresh() -> Any:
        return dam(solver=AUTO)

    whole = fresh()
    for _ in range(6):
        whole.step(2e-3)
    kept = whole.state()
    rows = [whole.step(3e-3) for _ in range(3)]
    again = fresh()
    again.restore(kept)
    assert [again.step(3e-3) for _ in range(3)] == rows


def test_precisions_measure_the_same_error() -> None:
    mixed, single = (
        advance(dam(solver=AUTO | {"precision": precision}), 0.1)
        for precision in ("mixed", "single")
    )
    assert [row["time_error"] for row in single[1:6]] == pytest.approx(
        [row["time_error"] for row in mixed[1:6]], rel=0.05, abs=1e-5
    )


def test_bodies_count_in_the_error() -> None:
    ball = {"shape": "sphere", "center": [0.6, 0.2], "radius": 0.1, "density": 500.0}
    rows = advance(dam(solver=AUTO, solid=[ball]), 0.1)
    assert all(row["time_error"] > 0.0 for row in rows[1:])
    assert all(row["solve_status"] == "CONVERGED" for row in rows)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (1.0, "solver.tolerance = 1.0: must be less than 1"),
        (0, "solver.tolerance = 0: must be greater than 0"),
        ("exact", 'solver.tolerance = "exact": must be a number'),
        (True, "solver.tolerance = true: must be a number"),
        (float("nan"), "solver.tolerance"),
    ],
)
def test_other_values_are_refused(value: Any, expected: str) -> None:
    data = {
        "scene": {"simulator": "fluids"},
        "time": {"duration": 1.0},
        "domain": {"size": [1.0, 1.0], "resolution": 8},
        "liquid": [box([0.0, 0.0], [0.5, 0.5])],
        "solver": {"tolerance": value},
    }
    with pytest.raises(SceneError) as refused:
        validate(LiquidScene, data, "scene.toml")
    assert expected in str(refused.value)


def test_a_fixed_tolerance_has_no_columns_of_the_other() -> None:
    assert {"tolerance", "time_error"}.isdisjoint(dam().columns())
    assert {"tolerance", "time_error"} <= set(
        SIMULATOR.create(dam(solver=AUTO).scene, device="cpu", folder=Path()).columns()
    )
