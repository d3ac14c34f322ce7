"""Control characters in files and arguments never reach the terminal.

Whatever command reads them.
"""

import errno
import io
import json
import os
import random
from pathlib import Path

import pytest
from rich.table import Table
from typer.testing import CliRunner, Result

from small_runs import MINIMAL, run_into
from warp_lcp.cli import commands as cli
from warp_lcp.files.size_limits import one_line, visible
from warp_lcp.run import folder as run_folder
from warp_lcp.run.progress import ProgressLines
from warp_lcp.run.terminal import Terminal, print_text, table_lines
from warp_lcp.scene.scene_file import load_scene

FORGED = "finished: frame 4 of 4 reached"
CONTROLS = [
    "\x1b[2J\x1b[31m",
    "\x1b]0;owned\x07",
    "\x1b]8;;http://x\x1b\\y\x1b]8;;\x1b\\",
    "\x1bP1;2|x\x1b\\",
    "\x9b2J\x9d0;x\x9c",
    "\x08\x08\x7f\x0b\x0c",
    "\u202e\u2066\u200f\u061c",
    "\u2028\u2029\x85",
]
ALL = "".join(CONTROLS)
WAYS = [*CONTROLS, f"x\n{FORGED}", f"x\r{FORGED}"]
MTX = "%%MatrixMarket matrix coordinate real general\n"


def call(*arguments: object) -> str:
    """Run a command; return its output.

    The output may contain only printing characters and the command's own line breaks.
    """
    result: Result = CliRunner().invoke(cli.app, [str(argument) for argument in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), repr(
        result.exception
    )
    written = result.stdout + result.stderr
    odd = {c for c in written if not c.isprintable() and c not in "\n\t"}
    assert not odd, (arguments, odd)
    if FORGED in " ".join(map(str, arguments)) or result.exit_code:
        assert not any(line.lstrip("│ ").startswith(FORGED) for line in written.splitlines()), (
            arguments
        )
    return written


def quoted(text: str) -> str:
    return json.dumps(text)


def scenes(text: str, folder: Path) -> list[str]:
    """Return scenes that contain a text wherever a scene can."""
    key, mesh = quoted(text), folder / "mesh.obj"
    mesh.write_text(f"v 0 0 {text}\nf {text} 2 3\n", encoding="utf-8")
    solid = f'{MINIMAL}\n[[solid]]\nshape = "mesh"\n'
    return [
        MINIMAL.replace('"dots"', key),
        MINIMAL.replace("[scene]", f"[scene]\nname = {key}"),
        MINIMAL.replace("[scene]", f"[scene]\ndescription = {key}"),
        MINIMAL.replace("[time]", f"[time]\n{key} = 1"),
        MINIMAL.replace("[time]", f"[{key}]\n[time]"),
        MINIMAL.replace("= 20", f"= {key}"),
        MINIMAL.replace("[domain]", f"[domain]\nwall = {key}"),
        f"{MINIMAL}\n[[solid]]\nshape = {key}\n",
        f"{MINIMAL}\n[[solid]]\n{key} = 3\n",
        f"{solid}file = {key}\n",
        f"{solid}file = {quoted(str(mesh))}\n",
        f"{MINIMAL}\n{text}",
    ]


def hostile(text: str, folder: Path, scene: Path) -> None:
    """Run every command on files that contain a text, and with it as an argument."""
    folder.mkdir()
    for number, content in enumerate(scenes(text, folder)):
        file = folder / f"scene_{number}.toml"
        file.write_text(content, encoding="utf-8", newline="")
        call("check", file)
        if number < 3:
            call("tune", file)
            call("run", file, "--device", "cpu", "--frames", 0, "--out", folder / f"out_{number}")
    for command in ("run", "check", "render", "view", "solve", "tune", "bench", text):
        call(command, text)
        call(command, folder / text)
    for more in (
        ["--set", text],
        ["--set", f"scene.{text}=1"],
        ["--set", f"scene.name={text}"],
        ["--device", text],
        [f"--{text}"],
    ):
        call("check", scene, *more)
    for command in ("scenes", "info"):
        call(command, text)
    call("schema", "--simulator", text)
    call("bench", "solvers", "--compare", text, text)


@pytest.mark.parametrize(
    "text", [ALL, *[pytest.param(text, marks=pytest.mark.slow) for text in WAYS]], ids=ascii
)
def test_every_command_escapes_hostile_text(scene_file, tmp_path, monkeypatch, text):
    monkeypatch.chdir(tmp_path)
    hostile(text, tmp_path / "x", scene_file)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_every_command_shows_random_text(scene_file, tmp_path, monkeypatch, seed):
    monkeypatch.chdir(tmp_path)
    draw = random.Random(90_817 + seed)
    some = [
        chr(
            draw.choice(
                [draw.randrange(1, 32), draw.randrange(127, 160), draw.randrange(0x2000, 0x2070)]
            )
        )
        for _ in range(6)
    ]
    hostile(
        "".join(draw.sample(["x", *some, *draw.sample(CONTROLS, 2)], 9)), tmp_path / "x", scene_file
    )


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("text", [ALL, *CONTROLS], ids=ascii)
def test_matrices(tmp_path, text):
    b = tmp_path / "b.mtx"
    b.write_text("%%MatrixMarket matrix array real general\n1 1\n1\n")
    for content in (
        f"%%MatrixMarket {text}\n",
        f"{MTX}%{text}\n1 1 1\n1 1 {text}\n",
        f"{MTX}{text}\n",
        f"{MTX}1 1 1\n1 1 2\n{text}",
    ):
        (tmp_path / "A.mtx").write_text(content, encoding="utf-8", newline="")
        call("solve", tmp_path / "A.mtx", b)
        call("solve", tmp_path / "A.mtx", b, "--method", text, "--lower", text)


@pytest.mark.parametrize("text", [ALL.replace("/", ""), f"x\n{FORGED}"], ids=ascii)
def test_hostile_names_in_a_run_folder_are_escaped(scene_file, tmp_path, text):
    """Files in the folder of a run, which may come from elsewhere."""
    out = tmp_path / "out"
    run = ["run", scene_file, "--out", out, "--device", "cpu", "--frames"]
    call(*run, 1)
    record = json.loads((out / "run.json").read_text())
    (out / "run.json").write_text(
        json.dumps({**record, "versions": dict.fromkeys(record["versions"], text)})
    )
    (out / "run.lock").write_text(json.dumps({"pid": 1, "host": text, "since": text}))
    assert "written with other software" in call(*run, 2, "--resume")
    (out / "log.csv").write_text(text, encoding="utf-8", newline="")
    call(*run, 3, "--resume")
    with run_folder.locked(out):
        (out / "run.lock").write_text(json.dumps({"pid": 1, "host": text, "since": text}))
        assert "another run writes there" in call(*run, 3, "--resume")
    (out / f"foreign{text}").write_text("")
    assert "holds files that do not belong to a run" in call(*run, 1)


@pytest.mark.skipif(os.name == "nt", reason="names are text there")
def test_names_that_are_no_text(dots, tmp_path):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff\xfe"))
    try:
        folder.mkdir()
    except OSError:
        pytest.skip("the file system has no such names")
    (folder / "scene.toml").write_text(MINIMAL)
    call("run", folder / "scene.toml", "--out", folder / "out", "--device", "cpu", "--frames", 0)
    assert (folder / "out" / "run.json").is_file()
    call("check", folder / "no.toml")
    call("render", folder)
    (folder / "mesh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (folder / "mesh.toml").write_text(f'{MINIMAL}[[solid]]\nshape = "mesh"\nfile = "mesh.obj"\n')
    assert "must be UTF-8 text" in call(
        "run", folder / "mesh.toml", "--out", folder / "out", "--device", "cpu", "--frames", 0
    )


def test_colors_and_bars_of_our_own_reach_the_terminal(capsys):
    console = Terminal(force_terminal=True, color_system="standard", width=60)
    table = Table("[bold]one\x1b[2J")
    table.add_row("\x9bA")
    console.print(table)
    print_text(console, "\x1b]0;x\x07")
    written = capsys.readouterr().out
    assert "\x1b[1m" in written
    assert "\x1b[2J" not in written
    assert r"\x9bA" in written
    assert r"\x1b]0;x\x07" in written


@pytest.mark.parametrize("code", [errno.EPIPE, errno.EIO])
def test_a_terminal_that_is_gone_ends_no_run(dots, scene_file, tmp_path, code):
    class ClosedTerminal(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(code, os.strerror(code))

    watcher = ProgressLines(Terminal(file=ClosedTerminal()))
    record = run_into(load_scene(scene_file), tmp_path / "out", observer=watcher, last_frame=2)
    assert record.status == "finished"


def test_numbers_of_a_table_are_right_aligned_and_names_left():
    lines = table_lines(
        ("name", "ms", "unit"), [("a", "5.0", "s"), ("longer", "12.5", "m")], left=(0, 2)
    )
    assert [line.rstrip() for line in lines.splitlines()] == [
        "name      ms  unit",
        "a        5.0  s",
        "longer  12.5  m",
    ]


def test_printable_text_is_unchanged():
    text = "Dammbruch über 3 m: \u6c34 \U0001f30a │ 12 %"
    assert visible(text) == one_line(text) == text
    assert visible("a\nb\tc") == "a\nb\tc"
    assert one_line("a\nb") == r"a\nb"
