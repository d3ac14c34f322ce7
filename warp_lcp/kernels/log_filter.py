"""Log filter for Warp: one line when kernels are compiled.

It replaces Warp's banner and its line for every module.
"""

from __future__ import annotations

import functools
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

import warp as wp

# Modules whose kernels are not reported one by one.
OURS = ("warp_lcp", "fluids", "granular", "benchmarks", "warp")
BANNER = re.compile(r"Warp \S+ initialized:")
LOADED = re.compile(r"\s*Module (\w+)\S* .*load on device '(\S+)'.* took [0-9.]+ ms +\((\w+)\)")


class KernelMessages:
    """A logger for Warp that reports once for each device that kernels are compiled.

    The line appears when the first kernel has been compiled. The logger drops Warp's banner and its
    messages about modules of this library; all else passes through. `wp.config.log_level` has its
    usual meaning: above `wp.LOG_INFO` there is no line either. At `wp.LOG_DEBUG`, and after
    `wp.set_logger(None)`, all messages of Warp appear.

    Args:
        logger: takes the rest.
        stream: takes the line; default: the error stream at the time of the line.
    """

    def __init__(self, logger: wp.Logger, stream: TextIO | None = None) -> None:
        self._logger, self._stream = logger, stream
        self._reported: set[str] = set()
        self.debug, self.error = logger.debug, logger.error

    def info(self, message: str) -> None:
        """Pass a message on, unless it is the banner or is about a module of this library."""
        match = LOADED.match(message)
        hidden = (match is not None and match[1] in OURS) or BANNER.match(message)
        if not hidden or wp.config.log_level <= wp.LOG_DEBUG:
            self._logger.info(message)
        elif match and match[3] == "compiled" and match[2] not in self._reported:
            self._reported.add(match[2])
            print(
                f"compiling kernels for {match[2]}, which takes seconds and is done once; cache: "
                f"{wp.config.kernel_cache_dir}",
                file=self._stream or sys.stderr,
                flush=True,
            )

    def warning(
        self, message: str, category: type[Warning] | None = None, stacklevel: int = 1
    ) -> None:
        """Pass a warning on, with its caller's place."""
        self._logger.warning(message, category, stacklevel=stacklevel + 1)


@functools.cache
def start_warp() -> None:
    """Start Warp, without its native message about a missing CUDA driver.

    No setting of Warp drops that message. At `wp.LOG_DEBUG` it is written. Warp's messages from
    Python go to its logger. Does nothing if Warp has started.

    Raises:
        OSError: there is no place for compiled kernels.
    """
    if wp.config.log_level <= wp.LOG_DEBUG:
        wp.init()
        return
    with _native_messages_dropped():
        wp.init()


@contextmanager
def _native_messages_dropped() -> Iterator[None]:
    """Redirect the native error stream within a `with` block, if there is one."""
    try:
        saved_descriptor = os.dup(2)
    except OSError:  # the stream is closed
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(saved_descriptor, 2)
        os.close(nowhere)
        os.close(saved_descriptor)


def install_log_filter() -> None:
    """Install the log filter in place of Warp's own logger.

    A logger that a program has set stays.
    """
    logger = wp.get_logger()
    if type(logger).__module__.startswith("warp."):
        wp.set_logger(KernelMessages(logger))
