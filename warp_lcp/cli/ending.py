"""How a command ends: what is wrong with its input on one line, and an exit code."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

import typer

from warp_lcp.run.interruption import Interrupted
from warp_lcp.run.terminal import tell
from warp_lcp.simulation import InputError

FAILED = 1
WRONG_INPUT = 2


@contextmanager
def wrong_input() -> Iterator[None]:
    """Tell of wrong input, and end."""
    try:
        yield
    except InputError as error:
        end(str(error), WRONG_INPUT)
    except OSError as error:
        if error.filename is None or error.errno not in (errno.ENAMETOOLONG, errno.EACCES, errno.ENOTDIR):
            raise
        end(f"{error.filename}: {error.strerror}", WRONG_INPUT)
    except Interrupted as error:
        end(f"stopped: interrupted by {error} before the run began", FAILED)


def end(message: str, code: int) -> NoReturn:
    """Tell why, and end with a code."""
    tell(message, error=True)
    raise typer.Exit(code)
