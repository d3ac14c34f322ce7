"""Damaged scene files: `check` accepts or refuses them, without side effects."""

from __future__ import annotations

import copy
import datetime
import math
import random
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st
from mutated import mutated
from told import limited, told

from warp_lcp.run import check
from warp_lcp.run.check import check_scene
from warp_lcp.scene.scene_file import built_in_scenes
from warp_lcp.scene.table import SceneError

ROOM = 8 << 20  # bytes of memory to make a scene: those of a few thousand cells
NUMBERS = [
    0,
    -1,
    1,
    2,
    3,
    7,
    4096,
    10**9,
    2**63 - 1,
    -(2**63),
    2**64,
    10**400,
    math.nan,
    math.inf,
    -math.inf,
]
NUMBERS += [0.0, -0.0, 0.5, -2.5, 1e-320, 1e-30, 1e-9, 1e12, 1e30, 1e200, 1.7e308, -1e308]
FACTORS = [2, 3, 10, 1000, 10**6, 10**15, 1e-3, 1e-15, 1e-200, 1e-320, 1e30, 1e200, -1]
WORDS = [
    "",
    " ",
    "é\u200b漢🌊",
    "a\x00b",
    "/",
    ".",
    "..",
    "x" * 5000,
    "nan",
    "{}",
    "%s",
    "'",
    "builtin:",
    "builtin:torus",
    "builtin:x",
]
WORDS += ["box", "sphere", "plane", "mesh", "translation", "rotation", "sinusoid", "keyframes"]
WORDS += ["fluids", "granular", "flip", "unilateral", "voxel", "left", "front", "psor"]
KEYS = [
    *WORDS,
    "scale",
    "rotate",
    "translate",
    "motion",
    "file",
    "invert",
    "smoothing",
    "open",
    "shape",
]
OTHERS = [
    True,
    False,
    [],
    [[]],
    {},
    {"a": {"b": []}},
    datetime.date(2026, 2, 28),
    datetime.time(1, 2),
    [1.0],
    [1.0] * 3,
    [0.1] * 1000,
]
INSERTS = [
    b"[" * 3000,
    b"[[x]]\n",
    b"\n[time]\n",
    b"=",
    b"\r",
    b'"""',
    b"9" * 5000,
    b"0x" + b"f" * 5000,
    b"\ntime" + b".a" * 3000 + b" = 1\n",
]

SMALL = [
    re.sub(rb"resolution = \d+", b"resolution = 20", built_in_scenes()[name].read_bytes())
    for name in (
        "column-collapse-2d",
        "dam-break-2d",
        "floating-bodies-2d",
        "hourglass-2d",
        "retracting-wall",
        "tap-and-drain",
    )
]


@given(st.integers(0, 2**32).map(lambda seed: fuzzed(random.Random(seed))))
def test_changed_scenes(data: bytes) -> None:
    """Exchanged keys and values: `check_scene` accepts or refuses the scene."""
    with TemporaryDirectory() as folder:
        file = Path(folder, "scene.toml")
        file.write_bytes(data)
        try:
            with limited():
                _, lines = check_scene(str(file))
        except SceneError as error:
            assert error.problems and len(str(error)) < 200_000
        else:
            assert dict(lines)["frames"]


@given(
    mutated(SMALL)
    | st.sampled_from(SMALL).flatmap(
        lambda data: st.integers(0, 2**32).map(lambda s: fuzzed(random.Random(s), data))
    )
)
def test_mutated_scenes(data: bytes) -> None:
    """Mutated bytes and values: `check` ends with 0, or with 2 and a message."""
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(check, "free_memory", lambda device: ROOM)
        file = Path(folder, "scene.toml")
        file.write_bytes(data)
        told("check", file, "--device", "cpu")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = " + "[" * 3000, "nested too deeply"),
        ("time" + ".a" * 3000 + " = 1", "nested too deeply"),
        ("x = " + "9" * 5000, "too many digits"),
        ("time.duration = 0x" + "f" * 5000, "too many digits"),
        ("time.duration = 1e300", "time.duration = 1e+300: must not be beyond 1e+18"),
        ("domain.periodic = [{}]", "domain.periodic"),  # a value that is no key of a set
        (
            'solver.preset = {a = 1}\nsolver.method = {a = 1}\n[scene]\nsimulator = "fluids"',
            "solver.method",
        ),
    ],
)
def test_scenes_that_once_raised_a_traceback_are_refused(
    text: str, message: str, tmp_path: Path
) -> None:
    file = tmp_path / "scene.toml"
    file.write_text(text if "[scene]" in text else f'{text}\n[scene]\nsimulator = "fluids"\n')
    with pytest.raises(SceneError) as caught:
        check_scene(str(file))
    assert message in str(caught.value)


def test_overrides_that_no_parser_takes_are_refused() -> None:
    for value in ("9" * 5000, "[" * 3000, "1e300", "0x" + "f" * 5000):
        with pytest.raises(SceneError, match=r"time\.duration"):
            check_scene("dam-break-2d", [f"time.duration={value}"])


def test_keyframes_too_close_for_a_smooth_motion_are_refused() -> None:
    times = "solid.0.motion.times=[0.0, 1e-320, 1.2, 2.2]"
    with pytest.raises(SceneError, match="too close"):
        check_scene("retracting-wall", [times])


def test_a_folder_is_no_scene_and_no_mesh(tmp_path: Path) -> None:
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(SceneError, match="is a folder"):
        check_scene(str(tmp_path / "folder.toml"))
    with pytest.raises(SceneError, match="no such file"):
        check_scene("mesh-obstacle", [f"solid.0.file={tmp_path}"])


def fuzzed(chance: random.Random, original: bytes | None = None) -> bytes:
    """Return a scene with a few random changes of keys, values and sometimes bytes.

    By default the scene is a built-in one.
    """
    text = (
        chance.choice(list(built_in_scenes().values())).read_bytes()
        if original is None
        else original
    )
    data = tomllib.loads(text.decode())
    change = chance.choice([_change, _change_number])
    for _ in range(chance.choice([1, 1, 1, 2, 3, 5])):
        change(data, chance)
    text = tomli_w.dumps(data).encode("utf-8", "replace")
    return _scramble(text, chance) if chance.random() < 0.2 else text


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yield every container of a document with each of its keys."""
    for key, entry in list(value.items() if isinstance(value, dict) else enumerate(value)):
        yield value, key
        if isinstance(entry, (dict, list)):
            yield from _places(entry)


def _value(chance: random.Random) -> Any:
    return copy.deepcopy(chance.choice(chance.choice([NUMBERS, NUMBERS, WORDS, OTHERS])))


def _change_number(data: dict[str, Any], chance: random.Random) -> None:
    """Change a number to one that the scene probably allows.

    So the checks after the first ones are reached.
    """
    owner, key = chance.choice(
        [
            (o, k)
            for o, k in _places(data)
            if isinstance(o[k], (int, float)) and not isinstance(o[k], bool)
        ]
    )
    old = owner[key]
    owner[key] = chance.choice([old + 1, 1e18, *(old * factor for factor in FACTORS)])


def _change(data: dict[str, Any], chance: random.Random) -> None:
    places = list(_places(data))
    if not places:
        return
    owner, key = chance.choice(places)
    old = owner[key]
    numeric = isinstance(old, (int, float)) and not isinstance(old, bool)
    kind = chance.choice(
        [
            "value",
            "value",
            "number",
            "number",
            "drop",
            "rename",
            "swap",
            "nest",
            "repeat",
            "add",
            "text",
        ]
    )
    if kind == "number" and numeric:
        owner[key] = chance.choice(
            [old * 10.0 ** chance.uniform(-6, 6), -old, old + 1, chance.choice(NUMBERS)]
        )
    elif kind == "drop":
        del owner[key]
    elif kind == "rename" and isinstance(owner, dict):
        owner[chance.choice([f"{key}x", key.upper(), key[1:] or "q", chance.choice(WORDS)])] = (
            owner.pop(key)
        )
    elif kind == "swap":
        other, place = chance.choice(places)
        owner[key] = copy.deepcopy(other[place])
    elif kind == "nest":
        owner[key] = chance.choice(
            [[old], {"value": old}, [old] * 3, {key if isinstance(key, str) else "k": old}]
        )
    elif kind == "repeat" and isinstance(old, list) and old:
        owner[key] = [
            copy.deepcopy(chance.choice(old)) for _ in range(chance.choice([2, 3, 10, 200]))
        ]
    elif kind == "add" and isinstance(old, dict):
        old[chance.choice(KEYS)] = _value(chance)
    elif kind == "text" and isinstance(old, str):
        owner[key] = chance.choice(WORDS)
    else:
        owner[key] = _value(chance)


def _scramble(text: bytes, chance: random.Random) -> bytes:
    lines = text.splitlines(keepends=True)
    at, line = chance.randrange(len(text) + 1), chance.randrange(len(lines) + 1)
    kind = chance.randrange(6)
    if kind == 0:
        return text[:at]
    if kind == 1:
        return text[:at] + chance.randbytes(chance.choice([1, 2, 40])) + text[at:]
    if kind == 2:
        return text[:at] + bytes([chance.randrange(32, 127)]) + text[at + 1 :]
    if kind == 3:
        return b"".join([*lines[:line], *lines[line : line + 2], *lines[line:]])
    if kind == 4:
        chance.shuffle(lines)
        return b"".join(lines)
    return text[:at] + chance.choice(INSERTS) + text[at:]
