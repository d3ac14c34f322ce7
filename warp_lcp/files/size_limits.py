"""Check sizes in files against file and memory; escape text for display."""

from __future__ import annotations

import re
from pathlib import Path

try:
    import resource
except ImportError:  # not on Windows
    resource = None  # type: ignore[assignment]

MEMORY = Path("/proc/meminfo")
LAYOUT = "\n\t"  # control characters allowed in a text of several lines
OWN_SIZE = Path("/proc/self/statm")  # in pages; the address space comes first


class SizeLimitError(ValueError):
    """A size in a file exceeds the file or the free memory.

    The message gives the amount, but not the file's name.
    """


def check_claim(
    what: str, needed: int, *, stored: int | None = None, available: int | None = None
) -> None:
    """Raise an error if a size exceeds the file or the free memory.

    Call it before the allocation, with counts as they were read, of any size or sign.

    Args:
        what: beginning of the message, such as `1000000000000 vertices`.
        needed: memory for reading it [bytes].
        stored: its least size in the file [bytes]; None if a file may omit it, as the zeros of a
            sparse matrix.
        available: bytes of the file available for it.

    Raises:
        ClaimError: the size is negative, larger than the file, or larger than the free memory.
    """
    if needed < 0:
        raise SizeLimitError(f"{what}: a size must be >= 0")
    if stored is not None and available is not None and stored > available:
        raise SizeLimitError(
            f"{what}: these take {_bytes(stored)}, and the file has {_bytes(available)}"
        )
    free = free_host_memory()
    if free is not None and needed > free:
        raise SizeLimitError(
            f"{what}: these need {_bytes(needed)} of memory, and {_bytes(free)} are free"
        )


def read_whole(path: Path, *, copies: int = 2) -> bytes:
    """Return the content of a regular file; devices and pipes have no end.

    Args:
        path: the file.
        copies: copies of its bytes that the reader makes in memory, at least.

    Raises:
        OSError: it cannot be read.
        ClaimError: it is not a file, or does not fit the free memory.
    """
    size = path.stat().st_size
    if not path.is_file():
        raise SizeLimitError("it is not a file")
    check_claim("its content", copies * size)
    return path.read_bytes()


def free_host_memory() -> int | None:
    """Return the memory that this process can still allocate [bytes].

    The free memory of the machine, within the limit of the process; None if unknown.
    """
    limits: list[int] = []
    if MEMORY.exists() and (
        available := re.search(r"MemAvailable:\s+(\d+) kB", MEMORY.read_text(encoding="ascii"))
    ):
        limits.append(1024 * int(available[1]))
    if resource is not None and OWN_SIZE.exists():
        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            limits.append(
                max(
                    0,
                    limit
                    - resource.getpagesize() * int(OWN_SIZE.read_text(encoding="ascii").split()[0]),
                )
            )
    return min(limits, default=None)


def _bytes(count: int) -> str:
    """Return a number of bytes in words."""
    count = min(count, 10**24)  # beyond any practical size
    return (
        f"{count} bytes"
        if count < 10_000
        else f"{count / 1e6:.3g} MB"
        if count < 10_000_000
        else f"{count / 1e9:.3g} GB"
    )


def visible(text: str) -> str:
    r"""Return a text with escapes for characters that do not print.

    Such as control characters, writing directions and unpaired surrogates.

    >>> visible("\x1b]0;title\x07\n\u202e\udcff")
    '\\x1b]0;title\\x07\n\\u202e\\udcff'
    """
    if text.isprintable():
        return text
    return "".join(
        c if c.isprintable() or c in LAYOUT else c.encode("unicode_escape").decode() for c in text
    )


def one_line(text: str) -> str:
    r"""Return a text in one line, with escapes for line breaks.

    A line break could imitate another message.

    >>> one_line("pool\nfinished: frame 4 of 4")
    'pool\\nfinished: frame 4 of 4'
    """
    return (
        text
        if text.isprintable()
        else "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    )
