"""What others wrote: sizes that nobody believes before they fit the file and the memory, and text that is shown and not obeyed."""

from __future__ import annotations

import re
from pathlib import Path

try:
    import resource
except ImportError:  # not on Windows
    resource = None  # type: ignore[assignment]

MEMORY = Path("/proc/meminfo")
LAYOUT = "\n\t"  # what a text of several lines may hold
OWN_SIZE = Path("/proc/self/statm")  # pages, those of the address space first


class ClaimError(ValueError):
    """A file claims more than it has or than there is room for; the message says how much, not which file."""


def check_claim(
    what: str, needed: int, *, stored: int | None = None, held: int | None = None
) -> None:
    """Refuse what a file claims before anything is allocated for it. Call it with counts as they were read, of any size or sign.

    Args:
        what: the claim, as the message begins, such as `1000000000000 vertices`.
        needed: memory that reading it takes [bytes].
        stored: the least that it takes in the file [bytes]; None: a file may leave it out, as a
            sparse matrix does its zeros.
        held: what the file has for it [bytes].

    Raises:
        ClaimError: it is negative, more than the file has, or more than is free.
    """
    if needed < 0:
        raise ClaimError(f"{what}: a size must be >= 0")
    if stored is not None and held is not None and stored > held:
        raise ClaimError(f"{what}: these take {_bytes(stored)}, and the file has {_bytes(held)}")
    free = free_host_memory()
    if free is not None and needed > free:
        raise ClaimError(
            f"{what}: these need {_bytes(needed)} of memory, and {_bytes(free)} are free"
        )


def read_whole(path: Path, *, copies: int = 2) -> bytes:
    """Return what is in a file, which must be one: a device or a pipe has no end.

    Args:
        path: the file.
        copies: of its bytes that its reader makes in memory, at least.

    Raises:
        OSError: it cannot be read.
        ClaimError: it is not a file, or does not fit the free memory.
    """
    size = path.stat().st_size
    if not path.is_file():
        raise ClaimError("it is not a file")
    check_claim("its content", copies * size)
    return path.read_bytes()


def free_host_memory() -> int | None:
    """Return the memory that this process may still take [bytes]: what the machine has free and its own limit allows; None: not known."""
    found: list[int] = []
    if MEMORY.exists() and (
        available := re.search(r"MemAvailable:\s+(\d+) kB", MEMORY.read_text(encoding="ascii"))
    ):
        found.append(1024 * int(available[1]))
    if resource is not None and OWN_SIZE.exists():
        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            found.append(
                max(
                    0,
                    limit
                    - resource.getpagesize() * int(OWN_SIZE.read_text(encoding="ascii").split()[0]),
                )
            )
    return min(found, default=None)


def _bytes(count: int) -> str:
    """Return a number of bytes as a reader grasps it."""
    count = min(count, 10**24)  # beyond what a float holds nobody counts
    return (
        f"{count} bytes"
        if count < 10_000
        else f"{count / 1e6:.3g} MB"
        if count < 10_000_000
        else f"{count / 1e9:.3g} GB"
    )


def visible(text: str) -> str:
    r"""Return a text with an escape in place of each character that does not print: controls, writing directions, half of a pair.

    >>> visible("\x1b]0;title\x07\n\u202e\udcff")
    '\\x1b]0;title\\x07\n\\u202e\\udcff'
    """
    if text.isprintable():
        return text
    return "".join(
        c if c.isprintable() or c in LAYOUT else c.encode("unicode_escape").decode() for c in text
    )


def one_line(text: str) -> str:
    r"""Return a text that stands within a line, where a break would let it pretend to be another message.

    >>> one_line("pool\nfinished: frame 4 of 4")
    'pool\\nfinished: frame 4 of 4'
    """
    return (
        text
        if text.isprintable()
        else "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    )
