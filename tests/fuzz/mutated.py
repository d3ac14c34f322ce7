"""Mutated bytes of valid files.

Flipped bits, cuts, doubled and foreign parts, and numbers that claim too much.
"""

from __future__ import annotations

import re

from hypothesis import strategies as st

NUMBERS = [
    b"0",
    b"-1",
    b"1e18",
    b"-1e308",
    b"1e-320",
    b"nan",
    b"inf",
    b"999999999999",
    b"9223372036854775808",
    b"1" + b"0" * 30,
    b"0x7f",
    b"",
]
PIECES = [
    b"\x00",
    b"\xff" * 8,
    b"\x1b]0;x\x07",
    b"\n",
    b"[" * 200,
    b'"',
    b"{",
    b"../",
    b"\r\n",
    "\u202e\u00e9".encode(),
    b"%s",
    b"=",
    b" ",
]
NUMBER = re.compile(rb"-?\d[\d.]*(?:[eE][-+]?\d+)?")


@st.composite
def mutated(draw: st.DrawFn, originals: list[bytes], most: int = 4) -> bytes:
    """Draw one of some good files with one to `most` mutations.

    Args:
        draw: draw function of Hypothesis.
        originals: valid files.
        most: largest number of mutations.
    """
    data = draw(st.sampled_from(originals))
    for _ in range(draw(st.integers(1, most))):
        data = _mutation(draw, data, draw(st.sampled_from(originals)))
    return data


def _mutation(draw: st.DrawFn, data: bytes, other: bytes) -> bytes:
    """Draw a mutation of `data`."""
    at = draw(st.integers(0, max(len(data) - 1, 0)))
    end = min(len(data), at + draw(st.sampled_from([1, 2, 4, 16, 256, 4096])))
    match draw(
        st.sampled_from(
            ["bit", "byte", "number", "number", "cut", "drop", "double", "piece", "splice"]
        )
    ):
        case "bit" if data:
            return data[:at] + bytes([data[at] ^ 1 << draw(st.integers(0, 7))]) + data[at + 1 :]
        case "byte":
            return data[:at] + draw(st.binary(min_size=1, max_size=1)) + data[at + 1 :]
        case "number" if found := NUMBER.search(data, at) or NUMBER.search(data):
            return data[: found.start()] + draw(st.sampled_from(NUMBERS)) + data[found.end() :]
        case "cut":
            return data[:at]
        case "drop":
            return data[:at] + data[end:]
        case "double":
            return data[:end] + data[at:]
        case "splice":
            return data[:at] + other[at:end] + data[end:]
        case _:
            return data[:at] + draw(st.sampled_from(PIECES)) + data[at:]
