"""Commands of `warp-lcp`, run in this process or a fork of it."""

import multiprocessing
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import pytest
from typer.testing import CliRunner, Result

from warp_lcp.benchmarks import suite
from warp_lcp.cli import commands


def invoke(*words: object) -> Result:
    """Run a command; each word is turned into text."""
    return CliRunner().invoke(commands.app, [str(word) for word in words])


def succeed(*words: object) -> str:
    """Run a command that must succeed, and return its output."""
    result = invoke(*words)
    assert result.exit_code == 0, f"{words}: {result.stderr}\n{result.exception!r}"
    return result.stdout


@contextmanager
def forked_suites() -> Iterator[None]:
    """Run suites of benchmarks in forks of this process, which has imported what they need.

    A new process takes seconds for that.
    """
    with pytest.MonkeyPatch.context() as patch:
        if hasattr(os, "fork"):
            patch.setattr(suite, "subprocess", ForkedSuite)
        yield


class ForkedSuite:
    """Stand-in for the module `subprocess` of `warp_lcp.benchmarks.suite`."""

    @staticmethod
    def run(
        command: Sequence[str], *, env: dict[str, str], check: bool
    ) -> subprocess.CompletedProcess[str]:
        """Run `python -m warp_lcp.benchmarks ...` in a fork."""
        assert command[1:3] == ["-m", "warp_lcp.benchmarks"] and not check
        process = multiprocessing.get_context("fork").Process(
            target=ForkedSuite.main, args=(command[3:], env)
        )
        process.start()
        process.join()
        assert process.exitcode is not None
        return subprocess.CompletedProcess(command, process.exitcode)

    @staticmethod
    def main(arguments: Sequence[str], env: dict[str, str]) -> None:
        """Measure a suite with other arguments and variables."""
        from warp_lcp.benchmarks.__main__ import main

        sys.argv = ["warp_lcp.benchmarks", *arguments]
        os.environ.update(env)
        main()
