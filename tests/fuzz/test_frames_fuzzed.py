"""Damaged frames of a run: images are drawn, or the fault is reported."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mutated import mutated
from told import costly, limited

from warp_lcp.frames.frame_folder import FrameFolder
from warp_lcp.frames.pieces import describe, write_whole
from warp_lcp.render.image_content import Color, RenderError, VisiblePart
from warp_lcp.render.recording import Recording
from warp_lcp.scene.table import SceneError
from warp_lcp.simulation import Cells, Part, Points, Surface

SCENE = """
scene.simulator = "fluids"
time = {duration = 0.1, frames_per_second = 10}
domain = {size = [1.0, 1.0, 1.0], resolution = 4}
camera = {position = [2.0, 1.0, 1.0], look_at = [0.5, 0.5, 0.5]}
[[liquid]]
shape = "box"
min = [0, 0, 0]
max = [0.5, 0.5, 0.5]
"""
RANDOM = np.random.default_rng(2741)
POINTS = RANDOM.random((5, 3)).astype(np.float32)
INDEX = np.array([[0, 1, 2], [3, 2, 1], [1, 1, 0]])
PARTS: list[Part] = [
    Points("particles", POINTS, {"velocity": POINTS - 0.5}),
    Cells(
        "grid", INDEX, 0.25, 3, {"pressure": RANDOM.random(3), "wall": INDEX[:, 1] == 1}, (4, 4, 4)
    ),
    Surface("surface", POINTS, np.array([[0, 1, 2], [1, 2, 3]]), {"velocity": POINTS}),
    Surface("bodies", POINTS, np.array([[2, 3, 4]]), {"body": np.arange(5.0)}),
]


def write_run(folder: Path) -> None:
    """Write frames of one process and, with the number 1, of two ranks.

    They are written in both formats.
    """
    folder.mkdir()
    (folder / "scene.toml").write_text(SCENE)
    for index, kind in enumerate(("vti", "vtu", "vti")):
        FrameFolder(folder, kind).write(index, 0.1 * index, PARTS)
    for part in PARTS:
        kind = "vtu" if part.name != "grid" else "vti"
        whole = folder / "frames" / f"{part.name}_000001.{kind}"
        for rank in range(2):
            whole.parent.joinpath(f"rank_000{rank}").mkdir(exist_ok=True)
            shutil.copy(
                whole.with_name(whole.name.replace("000001", "000002")),
                whole.parent / f"rank_000{rank}" / whole.name,
            )
        if part.name != "bodies":  # frame 1 has parts of all but these
            (whole.parent / f"{part.name}_000001.vtu").unlink()
            pieces = [(f"rank_000{rank}/{whole.name}", describe(part, kind)) for rank in range(2)]
            write_whole(whole.with_suffix(f".p{kind}"), pieces)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("frames") / "run"
    write_run(folder)
    yield folder


def recordings(folder: Path) -> list[Recording]:
    """Return all recordings of the run."""
    chosen = ((Color.PRESSURE, VisiblePart.BOTH, True), (Color.SPEED, VisiblePart.BOTH, False))
    return [Recording(folder, color, show, cells=cells) for color, show, cells in chosen]


def shown(recording: Recording) -> str:
    """Read everything that images show; return the fault, "" if none."""
    vars(recording).pop("scale", None)
    try:
        with limited():
            for number in recording.numbers:
                recording.frame(number)
            assert recording.scale.high > recording.scale.low
            assert recording.particle_spacing() > 0.0
        return ""
    except RenderError as error:
        assert str(error).strip(), "refused without a word"
        return str(error)


def test_good_frames_are_shown(run: Path) -> None:
    assert [shown(recording) for recording in recordings(run)] == ["", ""]


@pytest.fixture(scope="module")
def known(run: Path) -> list[Recording]:
    return recordings(run)


@costly
@given(st.data())
def test_frames(run: Path, known: list[Recording], data: st.DataObject) -> None:
    files = sorted(file for file in (run / "frames").rglob("*.*vt?"))
    file = data.draw(st.sampled_from(files))
    good = file.read_bytes()
    others = [good, data.draw(st.sampled_from(files)).read_bytes()]
    try:
        file.write_bytes(data.draw(mutated(others)))
        for recording in known:
            shown(recording)
    finally:
        file.write_bytes(good)


@costly
@given(mutated([SCENE.encode()]))
def test_scenes_of_runs(run: Path, scene: bytes) -> None:
    try:
        (run / "scene.toml").write_bytes(scene)
        with limited():
            Recording(run)
    except (RenderError, SceneError) as error:
        assert str(error).strip(), "refused without a word"
    finally:
        (run / "scene.toml").write_text(SCENE)


@costly
@given(
    st.lists(
        mutated(
            [
                b"camera.position=[1, 2, 3]",
                b"camera.look_at=[0.5, 0.5, 0]",
                b"camera.field_of_view=30",
            ]
        ),
        max_size=2,
    )
)
def test_cameras(run: Path, words: list[bytes]) -> None:
    try:
        with limited():
            Recording(run, overrides=[word.decode("utf-8", "replace") for word in words])
    except (RenderError, SceneError) as error:
        assert str(error).strip(), "refused without a word"
