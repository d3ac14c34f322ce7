"""Text that others wrote (scenes, headers, names of files) as a terminal may show it: all of it visible, none of it obeyed."""

from __future__ import annotations

LAYOUT = "\n\t"  # what a text of several lines may hold


def visible(text: str) -> str:
    r"""Return a text with an escape in place of each character that does not print: controls, writing directions, half of a pair.

    >>> visible("\x1b]0;title\x07\n\u202e\udcff")
    '\\x1b]0;title\\x07\n\\u202e\\udcff'
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in LAYOUT else c.encode("unicode_escape").decode() for c in text)


def one_line(text: str) -> str:
    r"""Return a text that stands within a line, where a break would let it pretend to be another message.

    >>> one_line("pool\nfinished: frame 4 of 4")
    'pool\\nfinished: frame 4 of 4'
    """
    return text if text.isprintable() else "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
