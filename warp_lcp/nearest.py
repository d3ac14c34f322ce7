"""What a message proposes in place of an unknown word."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


def nearest(word: str, known: Iterable[str]) -> str:
    """Return `did you mean ...?` for a word that is near a known one, and the list of known ones otherwise."""
    known = sorted(known)
    match = get_close_matches(word, known, n=1, cutoff=0.6)
    return f"did you mean {match[0]!r}?" if match else f"choose from {', '.join(known)}"
