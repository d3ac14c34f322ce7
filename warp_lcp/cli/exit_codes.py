"""Error messages and exit codes of commands."""

from __future__ import annotations

import errno
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn, TextIO

import typer

from warp_lcp.run.interruption import RunInterrupted
from warp_lcp.run.terminal import print_lines
from warp_lcp.simulation import InputError

FAILED = 1
WRONG_INPUT = 2
_SHOW = warnings.showwarning


@contextmanager
def wrong_input() -> Iterator[None]:
    """Print input errors in one line and exit; print renamed scene keys and continue."""
    from warp_lcp.scene.renamed_keys import RenamedKeyWarning

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", RenamedKeyWarning)
            warnings.showwarning = _show_renamed_keys
            yield
    except InputError as error:
        end(str(error), WRONG_INPUT)
    except OSError as error:
        if error.filename is None or error.errno not in (
            errno.ENAMETOOLONG,
            errno.EACCES,
            errno.ENOTDIR,
        ):
            raise
        end(f"{error.filename}: {error.strerror}", WRONG_INPUT)
    except RunInterrupted as error:
        end(f"stopped: interrupted by {error} before the run began", FAILED)


def _show_renamed_keys(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Print a warning about a renamed key as one line; others as Python does."""
    from warp_lcp.scene.renamed_keys import RenamedKeyWarning

    if issubclass(category, RenamedKeyWarning):
        print_lines(str(message), error=True)
    else:
        _SHOW(message, category, filename, lineno, file, line)


def end(message: str, code: int) -> NoReturn:
    """Print a message and exit with a code."""
    print_lines(message, error=True)
    raise typer.Exit(code)
