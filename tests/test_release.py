"""What a release says of itself in several places is the same in all of them."""

import re
import tomllib
from pathlib import Path

from typer.testing import CliRunner

from warp_lcp.cli.commands import app

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CITATION = (ROOT / "CITATION.cff").read_text()
RECIPE = (ROOT / ".ci" / "conda" / "recipe.yaml").read_text()


def test_versions_and_licenses_agree():
    assert re.search(r"^version: (.*)$", CITATION, flags=re.M)[1] == PROJECT["version"]
    assert re.search(r"^  version: (\d.*)$", RECIPE, flags=re.M)[1] == PROJECT["version"]
    assert re.search(r"^license: (.*)$", CITATION, flags=re.M)[1] == PROJECT["license"]
    assert f"license: {PROJECT['license']}\n" in RECIPE
    assert PROJECT["description"] in CITATION
    assert f"## [{PROJECT['version']}]" in (ROOT / "CHANGELOG.md").read_text()


def test_the_recipe_wants_what_the_package_wants():
    run = RECIPE.split("  run:\n")[1].split("\n\n")[0]
    wanted = [line.strip().removeprefix("- ").replace(" ", "") for line in run.splitlines()]
    assert wanted == [f"python{PROJECT['requires-python']}", *PROJECT["dependencies"]]
    (script,) = PROJECT["scripts"].items()
    assert f"- {script[0]} = {script[1]}\n" in RECIPE


def test_the_command_line_tells_its_version():
    outcome = CliRunner().invoke(app, ["--version"])
    assert outcome.exit_code == 0
    assert re.fullmatch(r"\d+\.\d+\.\d+\S*|not installed as a distribution", outcome.output.strip())


def test_shells_complete_commands():
    words = {"_WARP_LCP_COMPLETE": "complete_bash", "COMP_WORDS": "warp-lcp ch", "COMP_CWORD": "1"}
    outcome = CliRunner().invoke(app, [], prog_name="warp-lcp", env=words)
    assert outcome.output.split() == ["check"]
