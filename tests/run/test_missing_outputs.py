"""Missing steps and frames of a resumed run: named, with a remedy."""

import csv
import json
import random
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from typer.testing import CliRunner

from small_runs import run_into
from warp_lcp.cli import commands as cli
from warp_lcp.run.folder import OutputError
from warp_lcp.run.missing_outputs import spans
from warp_lcp.run.progress import ProgressLines
from warp_lcp.scene.scene_file import load_scene

STEP = 20  # step at which the run stops; checkpoints are those of steps 12, 16 and 20
KINDS = ("particles", "grid")


@pytest.fixture
def out(scene_file: Path, tmp_path: Path) -> Path:
    """Return a stopped run."""
    asked = iter(range(1, 10_000))
    run_into(
        load_scene(scene_file),
        tmp_path / "out",
        observer=ProgressLines(Console(quiet=True)),
        stop=lambda: next(asked) >= STEP,
    )
    return tmp_path / "out"


def resumed(out: Path) -> list[str]:
    """Resume for a frame; return the warning of run.json.

    The terminal must show it too.
    """
    frames = json.loads((out / "run.json").read_text())["frames"]
    result = CliRunner().invoke(
        cli.app,
        ["run", "--resume", "--out", str(out), "--device", "cpu", "--frames", str(frames + 1)],
    )
    assert result.exit_code == 0, result.stderr
    warnings: list[str] = json.loads((out / "run.json").read_text())["warnings"]
    assert all(f"{warning}\n" in result.stderr for warning in warnings)
    return warnings


def steps(out: Path) -> list[int]:
    with open(out / "log.csv", newline="") as file:
        return [int(row["step"]) for row in csv.DictReader(file)]


def frames(out: Path, kind: str) -> list[int]:
    return sorted(int(path.stem[-6:]) for path in out.glob(f"frames/{kind}_*.vtu"))


def cut(path: Path, share: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])


def contents(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = {
        str(path.relative_to(out)): path.read_bytes()
        for path in [*out.glob("frames/*"), *out.glob("*.pvd")]
    }
    found["log.csv"] = re.sub(r",[^,]*$", "", (out / "log.csv").read_text(), flags=re.M)
    return found


def test_a_stopped_run_has_no_missing_outputs(out):
    assert resumed(out) == []
    assert resumed(out) == []


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("share", [0.0, 0.01, 0.33, None])
def test_a_log_that_was_cut_or_deleted(out, share):
    if share is None:
        (out / "log.csv").unlink()
    else:
        cut(out / "log.csv", share)
    left = steps(out)[:-1] if share == 0.33 else []  # the last row is cut
    (line,) = resumed(out)
    assert line.startswith(
        f"log.csv: rows of steps {len(left) + 1} to {STEP} are missing; no earlier checkpoint "
        "exists"
    )
    assert steps(out)[: len(left) + 1] == [*left, STEP + 1]


def test_missing_outputs_are_rewritten_as_reported(out, scene_file, tmp_path):
    shutil.copytree(out, tmp_path / "whole")
    for _ in range(2):
        resumed(tmp_path / "whole")
    lost = frames(out, "grid")[-1]
    (out / "frames" / f"grid_{lost:06d}.vtu").unlink()
    rows = (out / "log.csv").read_text().splitlines(keepends=True)
    (out / "log.csv").write_text("".join(rows[:18] + rows[20:]))
    again = "to recompute them, move the checkpoint{} away and resume from step {}"
    assert resumed(out) == [
        f"log.csv: rows of steps 18 to 19 are missing; {again.format(' of step 20', 16)}",
        f"frames: grid {lost} are missing or truncated; {again.format('s of steps 16 to 20', 12)}",
    ]
    for file in out.glob("checkpoints/*.npz"):
        if int(file.stem[-6:]) > 12:
            file.unlink()
    assert resumed(out) == []
    assert contents(out) == contents(tmp_path / "whole")


def test_frames_without_checkpoints_and_log_are_not_thrown_away(out, scene_file):
    shutil.rmtree(out / "checkpoints")
    (out / "log.csv").unlink()
    for record in ("{}", (out / "run.json").read_text()):
        (out / "run.json").write_text(record)
        with pytest.raises(OutputError, match="no checkpoint to resume from"):
            run_into(
                load_scene(scene_file),
                out,
                observer=ProgressLines(Console(quiet=True)),
                resume=True,
            )
    assert frames(out, "grid") == [0, 1, 2, 3]


@pytest.mark.default_cases(3)
@pytest.mark.parametrize(
    "record",
    [
        "{",
        "[]",
        '{"steps": "many"}',
        '{"overrides": 3}',
        '{"overrides": ["a"]}',
        '{"mesh_files": [1]}',
    ],
)
def test_scene_and_record_files_are_checked(out, scene_file, record):
    (out / "scene.toml").unlink()
    (out / "run.json").write_text(record)
    result = CliRunner().invoke(
        cli.app,
        ["run", str(scene_file), "--resume", "--out", str(out), "--device", "cpu", "--frames", "9"],
    )
    assert result.exit_code == 0, result.stderr
    assert "run.json: was missing or damaged" in result.stderr
    assert "scene.toml: was missing or damaged" in result.stderr


@pytest.mark.parametrize("name", ["log.csv", "scene.toml", "frames", "checkpoints"])
def test_a_folder_in_the_place_of_a_file_or_a_file_in_that_of_a_folder(out, scene_file, name):
    path = out / name
    kind = "a file, expected a folder" if path.is_dir() else "a folder, expected a file"
    path.rename(out.parent / "aside")
    path.mkdir() if path.suffix else path.touch()
    result = CliRunner().invoke(
        cli.app,
        ["run", str(scene_file), "--resume", "--out", str(out), "--device", "cpu", "--frames", "9"],
    )
    assert result.exit_code == 2
    assert f"{path}: is {kind}; move it away" in result.stderr


@pytest.mark.default_cases(3)
@pytest.mark.parametrize(
    "seed",
    [
        *range(8800, 8806),
        *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(8806, 8900)),
    ],
)
def test_all_missing_outputs_are_named(out, seed):
    """Names of whatever is missing.

    Missing rows and frames are those of the messages, and the collections list the existing frames.
    """
    rng = random.Random(seed)
    every = frames(out, "grid")
    for kind in KINDS:
        for number in rng.sample(every, rng.choice([0, 0, 1, 2, 3, len(every)])):
            (out / "frames" / f"{kind}_{number:06d}.vtu").unlink()
        if rng.random() < 0.3:
            (out / f"{kind}.pvd").unlink()
    missing = {kind: sorted({*every} - {*frames(out, kind)}) for kind in KINDS}
    rows = (out / "log.csv").read_text().splitlines(keepends=True)
    damage = rng.choice(["none", "cut", "rows", "bytes", "deleted"])
    if damage == "cut":
        cut(out / "log.csv", rng.random())
    elif damage == "rows":
        (out / "log.csv").write_text(
            "".join([rows[0], *sorted(rng.sample(rows[1:], rng.randint(0, STEP)), key=rows.index)])
        )
    elif damage == "bytes":
        place = rng.randint(1, STEP)
        rows[place] = "\0\udcff" + rows[place][5:]
        (out / "log.csv").write_text("".join(rows), errors="surrogateescape")
    elif damage == "deleted":
        (out / "log.csv").unlink()
    lost = [f"{kind}.pvd" for kind in KINDS if not (out / f"{kind}.pvd").exists()]
    lines = resumed(out)
    holes = sorted({*range(1, STEP + 1)} - {*steps(out)})
    told = [f"log.csv: rows of steps {spans(holes)} are missing"] if holes else []
    listed = ", ".join(f"{kind} {spans(numbers)}" for kind, numbers in missing.items() if numbers)
    told += [f"frames: {listed} are missing or truncated"] if listed else []
    told += [f"{name}: was missing" for name in lost]
    assert [line.split(";")[0] for line in lines] == told
    assert steps(out) == sorted({*steps(out)})
    for kind in KINDS:
        assert [
            int(number)
            for number in re.findall(r"_(\d{6})\.vtu", (out / f"{kind}.pvd").read_text())
        ] == frames(out, kind)


def test_numbers_in_words():
    assert spans([3, 4, 5, 8, 10, 11]) == "3 to 5, 8, 10 to 11"
