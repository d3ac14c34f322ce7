"""`warp-lcp run --engine petsc` on ranks: one folder, one log, one exit code."""

import csv
import shlex
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from dots_on_ranks import COUNT, SCENE, DotsOnRanksSimulator
from typer.testing import CliRunner

from small_runs import read_record
from warp_lcp.cli import commands as cli
from warp_lcp.distributed import launch
from warp_lcp.frames.pieces import one_mesh, piece_files
from warp_lcp.frames.vtu import read_vtu
from warp_lcp.render.recording import Recording
from warp_lcp.scene import simulator

PROGRAM = Path(__file__).with_name("dots_on_ranks.py")


@pytest.fixture
def run(mpi, tmp_path, monkeypatch):
    """Run commands on the scene of dots on ranks, or on 0 ranks without MPI.

    The commands run one after the other on the same ranks. Each text is completed by the scene and
    `--device cpu`; the exit code is that of the last.
    """
    scene = tmp_path / "dots.toml"
    scene.write_text(SCENE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        simulator,
        "entry_points",
        lambda group: [SimpleNamespace(name="dots", load=DotsOnRanksSimulator)],
    )

    def go(ranks, *commands, exit_code=0):
        words = [[*shlex.split(command), "--device", "cpu"] for command in commands]
        if ranks == 0:
            result = [CliRunner().invoke(cli.app, command) for command in words][-1]
            assert result.exit_code == exit_code, result.output
            return result
        joined = [word for command in words for word in (*command, "--engine", "petsc", "then")]
        return mpi(ranks, PROGRAM, *joined[:-1], exit_code=exit_code)

    return go


def log(folder: Path) -> list[dict[str, float]]:
    with open(folder / "log.csv", newline="") as file:
        return [
            {name: float(value) for name, value in row.items() if name != "seconds"}
            for row in csv.DictReader(file)
        ]


def particles(folder: Path, index: int) -> dict[str, np.ndarray]:
    """Return the dots of a frame by their numbers, from one file or from parts."""
    whole = folder / "frames" / f"particles_{index:06d}.pvtu"
    files = piece_files(whole) if whole.is_file() else [whole.with_suffix(".vtu")]
    mesh = one_mesh([read_vtu(file) for file in files])
    order = np.argsort(mesh.fields["identity"])
    return {
        "points": mesh.points[order],
        "velocity": mesh.fields["velocity"][order],
        "identity": mesh.fields["identity"][order],
    }


def assert_same_run(a: Path, b: Path) -> None:
    """Compare logs, and every frame's dots."""
    rows = log(a), log(b)
    assert len(rows[0]) == len(rows[1]) > 100
    for one, other in zip(*rows, strict=True):
        assert one == pytest.approx(other, rel=1e-12)
    for index in range(11):
        one, other = particles(a, index), particles(b, index)
        np.testing.assert_array_equal(one["identity"], np.arange(COUNT))
        for name in one:
            np.testing.assert_array_equal(one[name], other[name])


def test_ranks_write_the_run_of_one_process(run, tmp_path):
    run(0, "run dots.toml --out one")
    done = run(3, "run dots.toml --out three --profile")
    assert (
        done.stderr.count("frame 10/10")
        == done.stderr.count("on 3 ranks (cpu)")
        == done.stdout.count("finished: frame 10 of 10")
        == 1
    )
    assert done.stdout.count("rest ") == 1  # the profile
    assert_same_run(tmp_path / "one", tmp_path / "three")
    found = read_record(tmp_path / "three")
    assert (found["status"], found["engine"], found["ranks"], found["frames"]) == (
        "finished",
        "petsc",
        3,
        10,
    )
    assert (tmp_path / "three" / "particles.pvd").read_text().count(".pvtu") == 11
    assert (tmp_path / "three" / "grid.pvd").read_text().count(".pvtu") == 11
    left = [
        path
        for path in (tmp_path / "three").rglob("*")
        if path.name.endswith(".part") or path.name == "run.lock"
    ]
    assert not left


def test_a_rank_is_killed_and_other_ranks_go_on(run, tmp_path):
    """Continue on another number of ranks after a rank was killed.

    The killed rank gives no message.
    """
    run(0, "run dots.toml --out one")
    killed = run(3, "DOTS_TROUBLE='70 1 killed' run dots.toml --out out", exit_code=None)
    assert killed.returncode != 0
    assert "finished" not in killed.stdout
    assert read_record(tmp_path / "out")["status"] == "running"
    resumed = run(2, "run dots.toml --out out --resume")
    assert "did not end cleanly; taken over" in resumed.stderr
    found = read_record(tmp_path / "out")
    assert (found["status"], found["resumed_from_step"], found["ranks"]) == ("finished", 68, 2)
    assert_same_run(tmp_path / "one", tmp_path / "out")


def test_damaged_pieces_are_found(run, tmp_path):
    """Fall back to the checkpoint before a damaged one.

    A file without its parts is no checkpoint.
    """
    run(0, "run dots.toml --out one")
    run(2, "run dots.toml --out out --frames 3")
    checkpoints = tmp_path / "out" / "checkpoints"
    newest, second, _ = sorted(
        (int(path.stem[5:]) for path in checkpoints.glob("step_*.npz")), reverse=True
    )
    file = checkpoints / "rank_0001" / f"step_{newest:06d}.npz"
    file.write_bytes(file.read_bytes()[:-200])
    resumed = run(3, "run dots.toml --out out --resume")
    assert (
        f"rank_0001/step_{newest:06d}.npz: cut short, damaged or not a checkpoint" in resumed.stderr
    )
    assert read_record(tmp_path / "out")["resumed_from_step"] == second
    assert_same_run(tmp_path / "one", tmp_path / "out")
    pieces = {path.stem for path in checkpoints.glob("rank_*/step_*.npz")}
    assert pieces == {path.stem for path in checkpoints.glob("step_*.npz")}
    for file in checkpoints.glob("rank_0002/step_*.npz"):
        file.unlink()
    refused = run(2, "run dots.toml --out out --resume", exit_code=2)
    assert refused.stderr.count("no checkpoint to resume from; --force starts again") == 1
    assert "rank_0002" in refused.stderr


TROUBLES = {  # with the status of the run and its message
    "40 -1 failed": ("failed", "failed: step 40: velocity is not finite"),
    "40 -1 missed": ("failed", "retries 6: the solve missed its criteria"),
    "40 1 interrupted": ("stopped", "stopped: interrupted"),
    "40 1 disk": (
        "failed",
        "failed: the disk is full: rank 1: [Errno 28] No space left on device; files written "
        "before are intact",
    ),
}


WRONG = {  # commands, with what is said of each
    "run dots.toml --out out": "holds a run already",
    "run dots.toml --out out --resume --force": "exclude each other",
    "run dots.toml --out out --set time.cfl=0": "time.cfl = 0: must be at least 0.001",
    "run dots.toml --out out --force --set output.surface_ply=true": "output.surface_ply = true: ",
    "run dots.toml --out out --force --record-problems problems": "--record-problems cannot be "
    "combined with --engine petsc",
    "DOTS_REFUSE=liquid[0] run dots.toml --out out --force": "dots: liquid[0]",
    "DOTS_REFUSE=liquid[1{rank}] run dots.toml --out out --force": "rank 0: dots: liquid[10]; rank "
    "1: dots: liquid[11]",
}


def test_wrong_input_and_troubles_end_a_run_with_a_message(run, tmp_path):
    """Errors of several commands on the same ranks.

    Each error is printed once, and does not affect the next command.
    """
    commands = [
        f"DOTS_TROUBLE='{trouble}' run dots.toml --out {number}"
        for number, trouble in enumerate(TROUBLES)
    ]
    done = run(2, "run dots.toml --out out --frames 1", *WRONG, *commands, exit_code=1)
    for code, times in enumerate((1, len(TROUBLES), len(WRONG))):
        assert done.stderr.count(f"exit code {code}") == 2 * times
    for expected in WRONG.values():
        assert done.stderr.count(expected) == 1
    assert done.stderr.count("--resume --engine petsc") == len(TROUBLES)
    assert "Traceback" not in done.stderr
    assert read_record(tmp_path / "out")["status"] == "finished"  # as it was
    for number, (status, expected) in enumerate(TROUBLES.values()):
        assert done.stderr.count(expected) == 1
        found = read_record(tmp_path / str(number))
        assert found["status"] == status
        assert (
            (tmp_path / str(number) / "particles.pvd").read_text().count(".pvtu")
            == found["frames"] + 1
            == 4
        )


@pytest.mark.parametrize(
    ("trouble", "expected"),
    [
        ("40 0 missed", "rank 0 of 2: the solve missed its criteria"),
        ("40 1 bug", "KeyError: 'no such key'"),
    ],
)
def test_a_rank_that_fails_alone_ends_the_others(run, tmp_path, trouble, expected):
    """End of all ranks after one fails alone.

    The others wait for it inside MPI. It reports the error, writes it into run.json and ends them.
    """
    done = run(2, f"DOTS_TROUBLE='{trouble}' run dots.toml --out out", exit_code=1)
    assert f"{expected}\nall ranks are aborted" in done.stderr
    found = read_record(tmp_path / "out")
    assert found["status"] == "failed"
    assert found["reason"].startswith(f"rank {trouble.split()[1]}")
    assert found["reason"].endswith(expected)


def test_engines_continue_each_other(run, tmp_path):
    """Continue a run of two ranks by one process, and by two ranks again."""
    run(0, "run dots.toml --out one")
    run(2, "run dots.toml --out out --frames 3")
    run(0, "run dots.toml --out out --frames 7 --resume")
    assert (read_record(tmp_path / "out")["engine"], read_record(tmp_path / "out")["frames"]) == (
        "single",
        7,
    )
    run(2, "run dots.toml --out out --resume")
    assert_same_run(tmp_path / "one", tmp_path / "out")
    for name in ("particles", "grid"):
        collection = (tmp_path / "out" / f"{name}.pvd").read_text()
        assert (collection.count(".pvtu"), collection.count(".vtu")) == (7, 4)


def test_different_input_is_named(mpi, tmp_path):
    (tmp_path / "dots.toml").write_text(SCENE)
    text = f"""
    import sys
    sys.path.insert(0, {str(PROGRAM.parent)!r})
    import dots_on_ranks
    from mpi4py import MPI
    rank = MPI.COMM_WORLD.rank
    own = ["--frames", str(rank), "--set", f"time.cfl={{1 + rank // 2}}"]
    dots_on_ranks.main(["run", "dots.toml", "--engine", "petsc", "--device", "cpu", *own])
    """
    done = mpi(3, text, exit_code=2)
    expected = (
        "different scenes or options\n  --frames: 0 on rank 0, 1 on rank 1\n  time.cfl: 1.0 "
        "on rank 0, 2.0 on rank 2\n"
    )
    assert done.stderr.count(expected) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("variable", ["", "OMPI_COMM_WORLD_RANK", "PMI_RANK"])
def test_without_mpi_one_message_says_how_to_install(run, monkeypatch, variable):
    monkeypatch.setitem(sys.modules, "mpi4py", None)
    if variable:  # mpiexec has started several, of which this is not the first
        monkeypatch.setenv(variable, "1")
    said = run(0, "run dots.toml --engine petsc", exit_code=2).stderr
    assert (
        ("pip install 'warp-lcp[distributed]'" in said and "PETSC_DIR" in said)
        if not variable
        else said == ""
    )


def test_ranks_of_another_mpi_are_refused(mpi, tmp_path):
    """Refuse ranks started by another MPI.

    As by srun, whose --mpi this MPI does not know. `mpi` skips where there is none.
    """
    words = [
        sys.executable,
        "-c",
        "from warp_lcp.cli.commands import main; main()",
        "run",
        "dam-break",
        "--engine",
        "petsc",
    ]
    environment = launch.environment() | {"SLURM_STEP_NUM_TASKS": "3"}
    done = subprocess.run(
        words, env=environment, cwd=tmp_path, text=True, capture_output=True, check=False
    )
    assert done.returncode == 2
    assert "3 processes were started, but mpi4py sees only one" in done.stderr


SMALL = (
    "--set domain.resolution=24 --set time.duration=0.2 --set output.checkpoint_every=4 --set "
    "output.grid_format=vti"
)
COLUMNS = ("time", "dt", "particles", "mass", "kinetic_energy", "potential_energy", "max_speed")


@pytest.mark.parametrize(
    ("scene", "columns"),
    [
        ("dam-break-2d", ("volume", "active")),
        ("column-collapse-2d", ("runout", "height", "yielded")),
    ],
)
def test_a_material_goes_on_on_other_numbers_of_ranks(mpi, tmp_path, scene, columns):
    """Continue material on other numbers of ranks.

    From two ranks to three, and to one process: one log, and frames with the particles and cells of
    a run in one process.
    """
    one, out = tmp_path / "one", tmp_path / "out"
    words = shlex.split(f"run {scene} --device cpu {SMALL}")
    go = ["-c", "from warp_lcp.cli.commands import main; main()", *words]
    mpi(2, *go, "--out", "out", "--engine", "petsc", "--frames", 2)
    mpi(3, *go, "--out", "out", "--engine", "petsc", "--frames", 4, "--resume")
    for options in (["--out", str(one)], ["--out", str(out), "--resume"]):
        alone = CliRunner().invoke(cli.app, [*words, *options])
        assert alone.exit_code == 0, alone.output
    with open(one / "log.csv", newline="") as a, open(out / "log.csv", newline="") as b:
        rows = list(zip(csv.DictReader(a), csv.DictReader(b), strict=True))
    assert len(rows) > 10
    for expected, found in rows:
        for name in (*COLUMNS, *columns):
            assert float(found[name]) == pytest.approx(float(expected[name]), rel=1e-6)
    whole, parts = Recording(one, cells=True), Recording(out, cells=True)
    assert whole.numbers == parts.numbers
    for number in whole.numbers:
        a, b = whole.frame(number), parts.frame(number)
        assert a.cells is not None and b.cells is not None
        assert {*map(tuple, a.cells.index.tolist())} == {*map(tuple, b.cells.index.tolist())}
        near = np.linalg.norm(a.points[:, None] - b.points, axis=2).min(axis=1)
        assert len(a.points) == len(b.points)
        assert near.max() < 1e-5
        np.testing.assert_allclose(np.sort(a.values), np.sort(b.values), atol=0.05)
