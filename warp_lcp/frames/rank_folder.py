"""The folders of ranks: where each of several processes keeps its pieces of a run's frames and checkpoints."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

RANK_FOLDER = re.compile(r"rank_\d{4,}")


def rank_folder(rank: int) -> str:
    """Return the name of a rank's folder."""
    return f"rank_{rank:04d}"


def in_ranks(folder: Path) -> Iterator[Path]:
    """Yield what is in a folder, and in the folders of ranks there; nothing if there is no such folder."""
    for path in folder.iterdir() if folder.is_dir() else ():
        if _is_rank(path):
            yield from path.iterdir()
        else:
            yield path


def remove_empty_ranks(folder: Path) -> None:
    """Delete the folders of ranks in a folder that hold nothing.

    Raises:
        OSError: one cannot be deleted.
    """
    for path in list(folder.iterdir()) if folder.is_dir() else ():
        if _is_rank(path) and not any(path.iterdir()):
            path.rmdir()


def _is_rank(path: Path) -> bool:
    return RANK_FOLDER.fullmatch(path.name) is not None and path.is_dir() and not path.is_symlink()
