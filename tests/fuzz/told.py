"""Command line in this process, with assertions of its promises.

They hold whatever its files contain.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from hypothesis import settings
from typer.testing import CliRunner

from warp_lcp.cli import commands as cli
from warp_lcp.files.size_limits import visible
from warp_lcp.run.check import start
from warp_lcp.scene.scene_file import load_scene

try:
    import resource
except ImportError:  # not on Windows
    resource = None

COUNT = settings().max_examples
# half in the short tests, all of them in `make fuzz`
costly = settings(max_examples=COUNT if COUNT > 100 else COUNT // 2)
MEMORY = 1 << 30  # bytes that reading one small file may take


def told(*arguments: str | Path, codes: tuple[int, ...] = (0, cli.WRONG_INPUT)) -> int:
    """Run a command that reads files; return its exit code, one of `codes`.

    By default `codes` are 0 and 2. The command ends without a traceback, takes at most MEMORY,
    gives the reason of a refusal, and prints nothing that controls a terminal.
    """
    if arguments[0] == "check":
        make_kernels()
    with limited():
        result = CliRunner().invoke(cli.app, [str(argument) for argument in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), repr(
        result.exception
    )
    assert result.exit_code in codes, (result.exit_code, result.output)
    assert result.exit_code == 0 or result.stderr.strip(), "refused without a word"
    assert visible(result.output) == result.output
    return result.exit_code


@cache
def make_kernels() -> None:
    """Compile the kernels of checks of scenes.

    Compilation takes more memory than a check may.
    """
    for scene in (
        "dam-break-2d",
        "column-collapse-2d",
        "floating-bodies-2d",
        "tap-and-drain",
        "mesh-obstacle",
    ):
        start(load_scene(scene, ["domain.resolution=20"]), "cpu")


@contextmanager
def limited(memory: int = MEMORY) -> Iterator[None]:
    """Limit this process to `memory` more bytes of address space.

    Allocations beyond it fail.
    """
    if resource is None or not Path("/proc/self/statm").exists():
        yield
        return
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + memory, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
