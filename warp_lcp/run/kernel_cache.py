"""Detect damaged cached kernels and recompile them."""

from __future__ import annotations

import functools
import json
import shutil
import struct
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import warp as wp

if TYPE_CHECKING:
    from warp._src.context import ModuleExec

ELF = b"\x7fELF"
BINARIES = (".o", ".cubin", ".ptx")


class KernelCacheError(OSError):
    """The kernel cache cannot be used; the message names the folder and a remedy."""


def watch_loads() -> None:
    """Check the files of a kernel module before Warp first loads it.

    Warp would load damaged files and fail.
    """
    load = wp.Module.load
    if hasattr(load, "__wrapped__") or not hasattr(wp.Module, "get_module_identifier"):
        return

    @functools.wraps(load)
    def checked(
        module: wp.Module,
        device: wp.DeviceLike,
        block_dim: int | None = None,
        *more: object,
        **options: object,
    ) -> ModuleExec | None:
        if module.execs:  # as in all launches after the first
            return load(module, device, block_dim, *more, **options)
        try:
            mend(
                Path(wp.config.kernel_cache_dir)
                / module.get_module_identifier(block_dim or module.options["block_dim"])
            )
            return load(module, device, block_dim, *more, **options)
        except OSError as error:
            raise cache_error(error) from error

    wp.Module.load = checked


def cache_error(error: OSError) -> KernelCacheError:
    """Return the error message for the kernel cache."""
    where = f" {wp.config.kernel_cache_dir}" if wp.config.kernel_cache_dir else ""
    file = f" ({error.filename})" if error.filename and f" {error.filename}" != where else ""
    text = (
        f"the folder of compiled kernels{where} cannot be used{file}; repair or delete it, or "
        "have WARP_CACHE_PATH name another one"
    )
    return KernelCacheError(error.errno, f"{error.strerror or error}: {text}")


def mend(folder: Path) -> bool:
    """Delete the folder of a kernel module if a file in it is damaged.

    Returns whether it was.

    Raises:
        OSError: it is damaged, and cannot be deleted.
    """
    if folder.is_dir() and not folder.is_symlink():
        if not any(_damaged(file) for file in folder.iterdir()):
            return False
        shutil.rmtree(folder)
    elif folder.exists():
        folder.unlink()
    else:
        return False
    return True


def _damaged(file: Path) -> bool:
    """Return whether a file is truncated, empty or zero.

    Other damage is not detected.
    """
    if file.suffix not in (*BINARIES, ".meta"):
        return False
    if not file.is_file():
        return True
    data = file.read_bytes()
    if file.suffix == ".meta":
        try:
            return not isinstance(json.loads(data), dict)
        except ValueError:
            return True
    if file.suffix == ".ptx":
        return not data.rstrip(b"\0 \n").endswith(b"}")
    if not data.startswith(ELF):
        return sys.platform == "linux" or not data.strip(b"\0")
    return _cut(data)


def _cut(data: bytes) -> bool:
    """Return whether an ELF file (64 bits) lacks its section table at the end."""
    if len(data) < 64:
        return True
    (begin,) = struct.unpack_from("<Q", data, 0x28)
    size, count = struct.unpack_from("<HH", data, 0x3A)
    table = data[begin : begin + size * count]
    return not count or len(table) < size * count or not table[size:].strip(b"\0")
