"""Recorded pressure problems of a run.

The read problem is the solved one, and every method can solve it.
"""

import json

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from command_line import invoke
from oracle import assemble, natural_residual
from small_liquids import box, create, dam, scene
from warp_lcp.files import size_limits as claims
from warp_lcp.recorded_problem import FORMAT, cell_counts, files, load
from warp_lcp.run.folder import OutputError
from warp_lcp.run.problem_folder import ProblemFolder
from warp_lcp.simulation import HasRecordedProblems

RAMP = box([0.2, -0.2], [0.6, 0.08], rotate=20)  # partly beneath the liquid
CASES = {
    "voxel": lambda: dam(solids="voxel", pressure={"surface": "voxel"}),
    "cut": lambda: dam(solid=[RAMP]),
    "3-D": lambda: dam(3),
    "unilateral": lambda: dam(solid=[RAMP], pressure={"model": "unilateral"}),
    "moving": lambda: dam(
        solid=[RAMP | {"motion": {"kind": "translation", "velocity": [0.5, 0.0]}}]
    ),
}


def record(simulation, folder, steps=3):
    """Step, and return the accepted pressure of every step."""
    assert isinstance(simulation, HasRecordedProblems)
    simulation.record = ProblemFolder(folder).write
    pressures = []
    for _ in range(steps):
        simulation.step(min(simulation.stable_dt(), 0.01))
        inner = simulation.grid.interior(simulation.projection.pressure.numpy())
        pressures.append(inner.copy())
    return pressures


@pytest.mark.parametrize("name", CASES)
def test_the_recorded_problem_is_the_one_that_was_solved(tmp_path, name):
    simulation = CASES[name]()
    pressures = record(simulation, tmp_path)
    assert [path.name for path in files(tmp_path)] == [
        f"problem_{step:06d}.npz" for step in range(3)
    ]
    for path, pressure in zip(files(tmp_path), pressures, strict=True):
        problem = load(path, device="cpu")
        recorded = dict(np.load(path, allow_pickle=False))
        # The oracle uses the description of the file alone. With a shifted face, or the shift of
        # another step, the run's x is no solution.
        faces = [recorded.get(f"face_{axis}", 1.0) for axis in "xyz"]
        A = assemble(recorded["cells"], faces, recorded.get("shift"))
        fluid = recorded["cells"].ravel() == wl.FLUID
        A = A[np.ix_(fluid, fluid)]
        np.testing.assert_allclose(problem.dense().A, A, atol=2e-6 * np.abs(A).max())
        b, lower, upper = (
            np.broadcast_to(recorded[key], recorded["cells"].shape).ravel()[fluid]
            for key in ("b", "lower", "upper")
        )
        x = pressure.ravel()[fluid]
        reference = natural_residual(A, b, lower, upper, np.clip(0.0 * b, lower, upper))
        allowed = max(
            float(recorded["absolute_tolerance"]), float(recorded["tolerance"]) * reference
        )
        assert natural_residual(A, b, lower, upper, x) <= 1.5 * allowed + 1e-6 * np.abs(
            A
        ).max() * np.linalg.norm(x)
        criteria = wl.StoppingCriteria(rtol=1e-9, atol=1e-12, max_iterations=300)
        for start in (None, problem.x0):
            result = wl.solve(
                problem.lcp(), wl.MinimumMapNewton(precision="double"), stopping=criteria, x0=start
            )
            assert result, result.status
            np.testing.assert_allclose(
                result.x.numpy(), pressure, atol=2e-3 * np.abs(pressure).max()
            )


def test_coefficients_are_there_only_where_they_vary(tmp_path):
    record(CASES["voxel"](), tmp_path / "voxel", 1)
    record(CASES["cut"](), tmp_path / "cut", 1)
    plain, cut = (set(np.load(files(tmp_path / name)[0]).files) for name in ("voxel", "cut"))
    assert not plain & {"face_x", "face_y", "face_z", "shift"}
    assert {"face_x", "face_y", "shift"} <= cut
    assert "face_z" not in cut
    text = (tmp_path / "cut" / "README.md").read_text()
    assert all(f"`{key}`" in text for key in cut)


def test_numbers_and_first_guess(tmp_path):
    simulation = CASES["voxel"]()
    first, *_ = record(simulation, tmp_path)
    problems = [load(path, device="cpu") for path in files(tmp_path)]
    assert [p.step for p in problems] == [0, 1, 2]
    assert [p.time for p in problems] == pytest.approx(
        [0.0, problems[0].dt, problems[0].dt + problems[1].dt]
    )
    assert problems[0].spacing == simulation.grid.spacing
    assert problems[0].tolerance == simulation.projection.tolerance
    assert not problems[0].x0.any()
    both = (first != 0) & (problems[1].x0 != 0)  # the last pressure, scaled with the step
    # Forces act for half of each of two steps.
    ratio = (problems[0].dt + problems[1].dt) / problems[0].dt
    np.testing.assert_allclose(problems[1].x0[both], ratio * first[both], rtol=1e-12)
    assert both.sum() > 20


def test_recording_changes_nothing(tmp_path):
    plain, recorded = CASES["cut"](), CASES["cut"]()
    assert plain.record is None
    record(recorded, tmp_path)
    for _ in range(3):
        plain.step(min(plain.stable_dt(), 0.01))
    for name, array in plain.state().items():
        np.testing.assert_array_equal(array, recorded.state()[name], name)


def test_spray_has_no_problem(tmp_path):
    spray = create(scene(size=[1.0, 1.0], resolution=8, liquid=[box([0.51, 0.51], [0.57, 0.57])]))
    record(spray, tmp_path, 1)
    assert files(tmp_path) == []
    assert (tmp_path / "README.md").is_file()


def test_damaged_files_are_refused(tmp_path):
    record(CASES["voxel"](), tmp_path, 1)
    (path,) = files(tmp_path)
    whole, recorded = path.read_bytes(), dict(np.load(path))
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"problem_000000\.npz: is not a recorded problem"):
        load(path)
    np.savez(path, **{**recorded, "format": FORMAT + 1})
    with pytest.raises(ValueError, match="its format is 2, this version reads 1"):
        load(path)
    np.savez(path, **{key: recorded[key] for key in recorded if key != "b"})
    with pytest.raises(ValueError, match="it lacks b"):
        load(path)
    np.savez(path, **{**recorded, "b": recorded["b"][1:]})
    with pytest.raises(ValueError, match="is not a recorded problem"):
        load(path)


@pytest.mark.parametrize(
    ("name", "array", "message"),
    [
        # 8 bytes that became a field.
        ("b", np.array(1.0), r"b is float64 of shape \(\): must be numbers of shape \("),
        ("lower", np.zeros(3), "lower is float64 of shape"),
        ("face_x", np.ones((2, 2)), "face_x is float64 of shape"),
        ("dt", np.array("soon"), "dt is <U4 of shape"),
        ("cells", np.zeros(10**6, dtype=np.int8), "cells is .* must be int8 of 2 or 3 axes"),
        ("format", np.ones(10**6), "format is float64 of shape"),
    ],
)
def test_arrays_must_fit_the_cells(tmp_path, name, array, message):
    record(CASES["voxel"](), tmp_path, 1)
    (path,) = files(tmp_path)
    np.savez_compressed(path, **{**np.load(path), name: array})
    for read in (load, cell_counts):
        with pytest.raises(
            ValueError, match=rf"problem_000000\.npz: is not a recorded problem: {message}"
        ):
            read(path)


def test_arrays_that_no_problem_has_are_not_read(tmp_path, monkeypatch):
    record(CASES["voxel"](), tmp_path, 1)
    (path,) = files(tmp_path)
    np.savez_compressed(path, **{**np.load(path), "bomb": np.zeros(2**23)})
    assert path.stat().st_size < 100_000
    monkeypatch.setattr(claims, "free_host_memory", lambda: 2**25)
    load(path, device="cpu")


def test_a_folder_takes_one_run(tmp_path):
    record(CASES["voxel"](), tmp_path, 1)
    with pytest.raises(OutputError, match="holds recorded problems already"):
        ProblemFolder(tmp_path)
    ProblemFolder(tmp_path, more=True)
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="--record-problems"):
        ProblemFolder(tmp_path / "file" / "below")


def test_the_solution_that_the_command_writes_solves_the_problem(tmp_path):
    record(dam(), tmp_path / "problems", steps=1)
    (path,) = files(tmp_path / "problems")
    done = invoke("solve", path, "--out", tmp_path / "x.npy", "--tolerance", 1e-9)
    assert done.exit_code == 0, done.stderr
    problem, x = load(path).lcp(), np.load(tmp_path / "x.npy")
    assert x.shape == problem.layout.shape
    residual = wl.NaturalResidual(problem)
    norm, first = (
        residual.evaluate(problem.layout.load(v, wp.float64)) for v in (x, np.zeros(x.shape))
    )
    assert norm < 1e-6 * first


def test_record_and_replay_by_the_command_line(tmp_path):
    folder = tmp_path / "problems"
    run = [
        "run",
        "dam-break",
        "--device",
        "cpu",
        "--set",
        "domain.resolution=16",
        "--set",
        "time.duration=0.1",
    ]
    done = invoke(*run, "--out", tmp_path / "run", "--frames", 1, "--record-problems", folder)
    assert done.exit_code == 0, done.stderr
    count = len(files(folder))
    assert count == json.loads((tmp_path / "run" / "run.json").read_text())["steps"]
    again = invoke(
        *run, "--out", tmp_path / "run", "--frames", 1, "--force", "--record-problems", folder
    )
    assert again.exit_code == 2
    assert "holds recorded problems already" in again.stderr
    more = invoke(
        *run, "--out", tmp_path / "run", "--frames", 2, "--resume", "--record-problems", folder
    )
    assert more.exit_code == 0, more.stderr
    assert (
        len(files(folder))
        == json.loads((tmp_path / "run" / "run.json").read_text())["steps"]
        > count
    )
    count = len(files(folder))
    for path in files(folder):
        problem = load(path)
        for method in ("projected-multigrid", "minimum-map-newton", "mprgp"):
            for start in (None, problem.x0):
                stopping = wl.StoppingCriteria(
                    rtol=problem.tolerance, atol=problem.absolute_tolerance, max_iterations=1000
                )
                assert wl.solve(problem.lcp(), wl.METHODS[method](), stopping=stopping, x0=start)
