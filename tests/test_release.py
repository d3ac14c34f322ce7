"""Consistency of release data in several files."""

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from warp_lcp.cli.commands import app

ROOT = Path(__file__).parents[1]
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT, BUILD = SETTINGS["project"], SETTINGS["build-system"]
CITATION = (ROOT / "CITATION.cff").read_text()
RECIPE = (ROOT / ".ci" / "conda" / "recipe.yaml").read_text()
CONTAINER, BATCH = ((ROOT / "deploy" / name).read_text() for name in ("Containerfile", "slurm.sh"))
SCRIPTS = ("deploy/slurm.sh", "tests/distributed/hosts", ".ci/run", ".ci/mpi-environment")


def test_versions_and_licenses_agree():
    assert re.search(r"^version: (.*)$", CITATION, flags=re.M)[1] == PROJECT["version"]
    assert re.search(r"^  version: (\d.*)$", RECIPE, flags=re.M)[1] == PROJECT["version"]
    assert re.search(r"^license: (.*)$", CITATION, flags=re.M)[1] == PROJECT["license"]
    assert f"license: {PROJECT['license']}\n" in RECIPE
    assert PROJECT["description"] in CITATION
    newest = re.search(r"^## \[(.*?)\] - (\S+)$", (ROOT / "CHANGELOG.md").read_text(), flags=re.M)
    assert newest[1] == PROJECT["version"]
    assert re.search(r"^date-released: (.*)$", CITATION, flags=re.M)[1] == newest[2]


def test_the_recipe_wants_what_the_package_wants():
    run = RECIPE.split("  run:\n")[1].split("\n\n")[0]
    wanted = [line.strip().removeprefix("- ").replace(" ", "") for line in run.splitlines()]
    assert wanted == [f"python{PROJECT['requires-python']}", *PROJECT["dependencies"]]
    host = RECIPE.split("  host:\n")[1].split("  run:\n")[0].replace(" ", "")
    assert host.split() == [
        f"-python{PROJECT['requires-python']}",
        "-pip",
        *(f"-{wanted}" for wanted in BUILD["requires"]),
    ]
    (script,) = PROJECT["scripts"].items()
    assert f"- {script[0]} = {script[1]}\n" in RECIPE


def test_the_container_has_what_ranks_need():
    """Packages of the container for ranks.

    The packages of the tests on ranks are those of the extra; Python and PETSc are new enough.
    """
    packages = re.search(
        r"^packages=\((.*)\)$", (ROOT / ".ci" / "mpi-environment").read_text(), flags=re.M
    )[1]
    assert f" {packages} " in CONTAINER
    least = dict(
        requirement.split(">=") for requirement in PROJECT["optional-dependencies"]["distributed"]
    )
    assert {f"python3-{name}" for name in least} <= set(packages.split())
    has = re.search(r"Python ([\d.]+), PETSc ([\d.]+) ", CONTAINER).groups()
    for version, needed in zip(
        has, (PROJECT["requires-python"].removeprefix(">="), least["petsc4py"]), strict=True
    ):
        assert [int(part) for part in version.split(".")] >= [
            int(part) for part in needed.split(".")
        ]
    assert f"{PROJECT['name'].replace('-', '_')}-*.whl" in CONTAINER


def test_the_batch_script_runs_this_command_line():
    run = re.search(r'"\$\{program\[@\]\}" (run .*)$', BATCH, flags=re.M)[1]
    options = {
        name
        for parameter in typer.main.get_command(app).commands["run"].params
        for name in parameter.opts
    }
    assert (
        set(re.findall(r"--\w+", run + re.search(r"set -- (.*);", BATCH)[1]))
        == {"--engine", "--out", "--resume"}
        <= options
    )
    assert f"WARP_LCP:-{next(iter(PROJECT['scripts']))}}}" in BATCH


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_are_bash(name):
    done = subprocess.run(["bash", "-n", ROOT / name], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_command_line_prints_its_version():
    outcome = CliRunner().invoke(app, ["--version"])
    assert outcome.exit_code == 0
    assert re.fullmatch(r"\d+\.\d+\.\d+\S*|not installed as a distribution", outcome.output.strip())


def test_shells_complete_commands():
    words = {"_WARP_LCP_COMPLETE": "complete_bash", "COMP_WORDS": "warp-lcp ch", "COMP_CWORD": "1"}
    outcome = CliRunner().invoke(app, [], prog_name="warp-lcp", env=words)
    assert outcome.output.split() == ["check"]
