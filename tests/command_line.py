"""Commands of `warp-lcp`, run in this process."""

from typer.testing import CliRunner, Result

from warp_lcp.cli import commands


def invoke(*words: object) -> Result:
    """Run a command; each word is turned into text."""
    return CliRunner().invoke(commands.app, [str(word) for word in words])


def succeed(*words: object) -> str:
    """Run a command that must succeed, and return its output."""
    result = invoke(*words)
    assert result.exit_code == 0, f"{words}: {result.stderr}\n{result.exception!r}"
    return result.stdout
