"""Random arguments of the command line: exit code 0 or 2, and a message."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from mutated import mutated
from told import costly, told

WORDS = [
    b"domain.resolution=8",
    b"liquid.0.max=[1,1]",
    b"solver.method=psor",
    b"time.cfl=2.0",
    b"physics.gravity=[0,-9.81]",
    b"scene.name=x",
]


@costly
@given(st.lists(mutated(WORDS), max_size=3))
def test_overrides(words: list[bytes]) -> None:
    told(
        "check",
        "dam-break-2d",
        "--device",
        "cpu",
        *(option for word in words for option in ("--set", word.decode("utf-8", "replace"))),
    )


@given(mutated([b"dam-break-2d", b"scenes/missing.toml", b"builtin:bunny"]))
def test_names_of_scenes(name: bytes) -> None:
    told("check", "--device", "cpu", "--", name.decode("utf-8", "replace"))
