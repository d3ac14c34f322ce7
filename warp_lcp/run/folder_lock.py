"""Exclusive lock on a run folder, released when the process exits."""

from __future__ import annotations

import errno
import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from warp_lcp.files import Tables
from warp_lcp.files.atomic import open_in_place
from warp_lcp.files.size_limits import one_line

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

LOCK = "run.lock"
BUSY = (errno.EWOULDBLOCK, errno.EACCES)


class FolderBusyError(RuntimeError):
    """Another process runs in the folder.

    The message names it.
    """


@contextmanager
def locked(folder: Path) -> Iterator[list[str]]:
    """Lock a folder until the block, or the process, ends.

    The operating system's lock on the file run.lock is decisive, not the file: a file that a killed
    process left is reused. Its content names the process for people.

    Args:
        folder: an existing folder.

    Yields:
        Remarks: a lock file that was reused, or a file system without locks, on which two runs are
            not kept apart.

    Raises:
        FolderBusyError: another process holds the lock.
        OSError: the file cannot be written, or is a link.
    """
    if fcntl is None:
        yield ["this system has no file locks: make sure that no other run writes into the folder"]
        return
    path = folder / LOCK
    descriptor, remarks = _acquire(path)
    try:
        left = os.read(descriptor, 4096)
        if left and not remarks:
            remarks.append(
                f"{path}: left by {_describe(left)}, which did not end cleanly; taken over"
            )
        holder = {
            "pid": os.getpid(),
            "host": socket.gethostname(),
            "since": datetime.now().astimezone().isoformat(timespec="seconds"),
        }
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, json.dumps(holder).encode(), 0)
        yield remarks
    finally:
        with suppress(OSError):  # already deleted, or a disk that has become read-only
            # Deleted while locked: a process that opened it before sees that it is gone.
            path.unlink()
        os.close(descriptor)


def _acquire(path: Path) -> tuple[int, list[str]]:
    """Return a locked descriptor of the current file at `path`."""
    while True:
        descriptor = open_in_place(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            held = os.read(descriptor, 4096)
            if error.errno in BUSY:
                os.close(descriptor)
                message = (
                    f"{path.parent}: another run writes there ({_describe(held)}); wait for "
                    "it, stop it, or choose another folder"
                )
                raise FolderBusyError(message) from error
            return descriptor, [
                f"{path}: the file system has no locks ({error.strerror}): make sure that no other "
                "run writes there"
            ]
        if _is_at(descriptor, path):
            return descriptor, []
        os.close(descriptor)  # its owner ended, and deleted it, between the two calls


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False


def _describe(text: bytes) -> str:
    """Return the process that wrote a lock file, in words."""
    try:
        holder: Tables = json.loads(text)
        return one_line(
            f"process {int(holder['pid'])} on {holder['host']}, since {holder['since']}"
        )
    except (ValueError, KeyError, TypeError):
        return "an unknown process"
