"""Files that are there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

SPARE = ".spare"  # of room that is kept
SUFFIX = ".part"  # of the temporary files, which a killed run may leave behind


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path in the same folder; what was written there takes `path`'s place at the end, unless something was raised.

    Raises:
        OSError: the file cannot be written; `path` is as before.
    """
    temporary = path.with_name(f".{path.name}{SUFFIX}")
    try:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
        sync_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Bring a folder's names to the disk, so that after a power failure no file is older than one that was written before it.

    Raises:
        OSError: the folder cannot be read.
    """
    if os.name == "nt":  # folders cannot be opened there
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, unless they are there, so that a power failure does not take them away with what is in them.

    Raises:
        OSError: it cannot be made.
    """
    if folder.is_dir():
        return
    make_folder(folder.parent)
    folder.mkdir(exist_ok=True)
    with suppress(PermissionError):  # one that may be written into, but not read
        sync_folder(folder.parent)


def write_text(path: Path, text: str, *, spare: bool = False) -> None:
    """Write a text file atomically.

    Args:
        path: the file.
        text: what it is to hold.
        spare: take the room that `reserve` has kept, if there is some.

    Raises:
        OSError: the file cannot be written; `path` is as before.
    """
    with replacing(path) as temporary:
        if spare:
            with suppress(FileNotFoundError):
                _spare(path).replace(temporary)
        with open(temporary, "r+b" if temporary.exists() else "wb") as file:  # over what is there: on a full disk, that has its room
            file.write(text.encode())
            file.truncate()


def reserve(path: Path, size: int) -> None:
    """Keep room on the disk for a text of up to `size` bytes, which can be written even once the disk is full.

    Raises:
        OSError: there is no such room.
    """
    with open(_spare(path), "wb") as file:
        file.write(bytes(size))
        file.flush()
        os.fsync(file.fileno())


def _spare(path: Path) -> Path:
    return path.with_name(f".{path.name}{SPARE}{SUFFIX}")
