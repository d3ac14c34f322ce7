"""Commands in the documentation: modules, options, suites, scenes exist."""

import re
from pathlib import Path

import pytest
import typer

from code_blocks import blocks
from warp_lcp.benchmarks.__main__ import SUITES
from warp_lcp.cli import commands as cli
from warp_lcp.scene.scene_file import built_in_scenes

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
COMMANDS = typer.main.get_command(cli.app).commands
PLACEHOLDER = re.compile(r"[A-Z_]+")  # SCENE, NAME, SUITE, OUT
FILE = re.compile(r"[./\\]|^[<$\"'*]")


def shown(page):
    """Return the typed text of a page.

    It is the lines of blocks, continued ones as one, and the text between backticks.
    """
    lines = [
        line for block in blocks(page, "sh") for line in block.replace("\\\n", " ").splitlines()
    ]
    return [re.sub(r"\s#.*", "", line) for line in lines] + re.findall(
        r"`([^`\n]+)`", page.read_text()
    )


def options(words):
    return {word.partition("=")[0] for word in words if re.match(r"--[a-z]", word)}


def module_of(name):
    """Return the file that `python -m` runs."""
    path = ROOT / name.replace(".", "/")
    found = next(
        (file for file in (path.with_suffix(".py"), path / "__main__.py") if file.is_file()), None
    )
    assert found, f"python -m {name}: there is no such module"
    assert found.name == "__main__.py" or '__name__ == "__main__"' in found.read_text(), (
        f"python -m {name}: does nothing"
    )
    return found


def check_module(line):
    for name, rest in re.findall(r"python3? -m ((?:warp_lcp|benchmarks)[\w.]*)([^&|;]*)", line):
        text = module_of(name).read_text()
        words = rest.split()
        assert {o for o in options(words) - {"--help"} if f'"{o}"' not in text} == set(), (
            f"{line}: no such option"
        )
        if name == "warp_lcp.benchmarks":
            assert words[0] in (*SUITES, "SUITE"), f"{line}: no such suite"


def check_command(line):
    for call in re.findall(r"(?:^|[\s/(])warp-lcp ([a-z][^&|;]*)", line):
        name, *words = call.split()
        assert name in COMMANDS, f"{line}: there is no command {name}"
        command = COMMANDS[name]
        known = {
            option
            for parameter in command.params
            for option in (*parameter.opts, *parameter.secondary_opts)
        } | {"--help"}
        assert options(words) <= known, f"{line}: no such option"
        first = words[0] if words and not words[0].startswith("-") else ""
        if not first or PLACEHOLDER.fullmatch(first) or FILE.search(first):
            continue
        if name == "bench":
            assert first in SUITES, f"{line}: there is no suite {first}"
        if name in ("run", "check", "tune"):
            assert first in built_in_scenes(), f"{line}: there is no scene {first}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_documented_commands_exist(page):
    for line in shown(page):
        check_module(line)
        check_command(line)


def test_enough_commands_are_found():
    lines = [line for page in PAGES for line in shown(page)]
    assert sum("python -m" in line for line in lines) > 5
    assert sum("warp-lcp " in line for line in lines) > 80


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (
            "python -m warp_lcp.benchmarks.inverse_kinematics compare 1000",
            "there is no such module",
        ),
        ("python -m warp_lcp.benchmarks.problems", "does nothing"),
        ("python -m warp_lcp.benchmarks spheres --out out", "no such suite"),
        ("python -m warp_lcp.benchmarks.hostile --sed 5", "no such option"),
        ("warp-lcp rum dam-break", "there is no command rum"),
        ("warp-lcp run dam-brake --out out", "there is no scene dam-brake"),
        ("warp-lcp run dam-break --hurry", "no such option"),
        ("FOO=1 warp-lcp bench solver --size 8", "there is no suite solver"),
    ],
)
def test_wrong_commands_are_detected(line, expected):
    with pytest.raises(AssertionError, match=expected):
        check_module(line)
        check_command(line)
