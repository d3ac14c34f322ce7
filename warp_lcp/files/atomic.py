"""Atomic file writes, never through a link."""

from __future__ import annotations

import errno
import os
import re
import secrets
import stat
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

SPARE = ".spare"  # suffix of a reserved file
SUFFIX = ".part"  # suffix of temporary files, which a killed run may leave
LINK = "is a link and is not followed"
# Those of older versions have no random part.
TEMPORARY = re.compile(rf"\.(?P<name>.+?)(?:\.[0-9a-f]{{16}})?{re.escape(SUFFIX)}")
NO_LINKS = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
BY_DESCRIPTOR = {os.open, os.rename, os.unlink} <= os.supports_dir_fd  # not on Windows


@dataclass(frozen=True)
class _FolderHandle:
    """Folder for opening, renaming and deleting files by name.

    With a descriptor, later changes of the folder's path have no effect.

    Args:
        path: path of the folder.
        descriptor: descriptor of the folder; None if the platform only supports paths.
    """

    path: Path
    descriptor: int | None

    @classmethod
    @contextmanager
    def opened(cls, path: Path) -> Iterator[_FolderHandle]:
        descriptor = (
            os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC) if BY_DESCRIPTOR else None
        )
        try:
            yield cls(path, descriptor)
        finally:
            if descriptor is not None:
                os.close(descriptor)

    def open(self, name: str, flags: int) -> int:
        return os.open(self._at(name), flags | NO_LINKS, 0o666, dir_fd=self.descriptor)

    def rename(self, name: str, other: str) -> None:
        os.replace(
            self._at(name), self._at(other), src_dir_fd=self.descriptor, dst_dir_fd=self.descriptor
        )

    def unlink(self, name: str) -> None:
        os.unlink(self._at(name), dir_fd=self.descriptor)

    def sync(self) -> None:
        if self.descriptor is None:
            sync_folder(self.path)
        else:
            os.fsync(self.descriptor)

    def _at(self, name: str) -> str:
        return name if self.descriptor is not None else str(self.path / name)


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Yield a new file in the same folder, which replaces `path` at the end.

    After an error, `path` is not replaced.

    Raises:
        OSError: the file cannot be written; `path` is unchanged.
    """
    with _temporary(path) as (folder, name):
        with open(folder.open(name, os.O_WRONLY | os.O_CREAT | os.O_EXCL), "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        folder.rename(name, path.name)
        folder.sync()


@contextmanager
def replacing_by_name(path: Path) -> Iterator[Path]:
    """Yield the path of a new, empty file, for an encoder that opens it itself.

    Otherwise as `replacing`.

    Raises:
        OSError: the file cannot be written; `path` is unchanged.
    """
    with _temporary(path) as (folder, name):
        os.close(folder.open(name, os.O_WRONLY | os.O_CREAT | os.O_EXCL))
        yield path.with_name(name)
        descriptor = folder.open(name, os.O_RDWR)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        folder.rename(name, path.name)
        folder.sync()


@contextmanager
def _temporary(path: Path) -> Iterator[tuple[_FolderHandle, str]]:
    """Yield the folder and a random temporary name beside a file.

    The temporary file is deleted at the end.
    """
    name = f".{path.name.removeprefix('.').removesuffix(SUFFIX)}.{secrets.token_hex(8)}{SUFFIX}"
    with _FolderHandle.opened(path.parent) as folder:
        try:
            yield folder, name
        finally:
            with suppress(FileNotFoundError):
                folder.unlink(name)


def open_in_place(path: Path, flags: int, mode: int = 0o666) -> int:
    """Return the descriptor of a file for writing in place.

    It must be a regular file with one name.

    Args:
        path: the file.
        flags: flags of `os.open`.
        mode: mode of a new file.

    Raises:
        OSError: the file cannot be opened, or is a link, has other names too, or is a pipe, a
            device or a folder.
    """
    try:
        # Without O_NONBLOCK, opening a pipe would block.
        descriptor = os.open(path, flags | NO_LINKS | getattr(os, "O_NONBLOCK", 0), mode)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EMLINK):
            raise OSError(errno.ELOOP, LINK, str(path)) from error
        raise
    status = os.fstat(descriptor)
    if stat.S_ISREG(status.st_mode) and status.st_nlink <= 1:
        return descriptor
    os.close(descriptor)
    what = "has other hard links" if stat.S_ISREG(status.st_mode) else "is not a plain file"
    raise OSError(errno.ELOOP, f"{what} and is not written", str(path))


def sync_folder(folder: Path) -> None:
    """Write a folder's directory entries to the disk.

    After a power failure no file is then older than one that was written before it.

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


def make_folder(folder: Path, *, within: Path | None = None) -> None:
    """Create a folder and its missing parents, durable across a power failure.

    Args:
        folder: the folder.
        within: a folder above; no folder in between may be a link, so that files are written inside
            it.

    Raises:
        OSError: it cannot be created, or leads elsewhere.
    """
    if within is not None and within in folder.parents:
        if folder.is_symlink():
            raise OSError(errno.ELOOP, LINK, str(folder))
        make_folder(folder.parent, within=within)
    if folder.is_dir():
        return
    make_folder(folder.parent)
    folder.mkdir(exist_ok=True)
    with suppress(PermissionError):  # the folder may be writable but not readable
        sync_folder(folder.parent)


def write_text(path: Path, text: str, *, spare: bool = False) -> None:
    """Write a text file atomically.

    Args:
        path: the file.
        text: the content.
        spare: use the room that `reserve` has reserved, if any.

    Raises:
        OSError: the file cannot be written; `path` is unchanged.
    """
    with ExitStack() as stack:
        if not (spare and _write_over(_spare(path), text.encode(), path)):
            stack.enter_context(replacing(path)).write(text.encode())


def reserve(path: Path, size: int) -> None:
    """Reserve disk space for a text of up to `size` bytes.

    The text can then be written even on a full disk.

    Raises:
        OSError: there is not enough space.
    """
    with replacing(_spare(path)) as file:
        file.write(bytes(size))


def _write_over(spare: Path, data: bytes, path: Path) -> bool:
    """Overwrite a reserved file and rename it to `path`; return if there was one.

    On a full disk the data fit into its space.
    """
    with _temporary(path) as (folder, name):
        try:
            descriptor = open_in_place(spare, os.O_RDWR)
        except OSError:  # there is no reserved file, or another file has its name
            return False
        with open(descriptor, "r+b") as file:
            folder.rename(spare.name, name)
            file.write(data)
            file.truncate()
            file.flush()
            os.fsync(file.fileno())
        folder.rename(name, path.name)
        folder.sync()
    return True


def _spare(path: Path) -> Path:
    return path.with_name(f".{path.name}{SPARE}{SUFFIX}")
