"""Damaged checkpoints: a resumed run uses the one before, and says why."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mutated import mutated
from told import costly, limited, told

from warp_lcp.run.checkpoint import PIECES, Checkpoint, CheckpointError, CheckpointFolder

STATE = {
    "position": np.random.default_rng(59).random((5, 3)),
    "cells": np.zeros((3, 4), dtype=np.int8),
    "name": np.array("apic"),
    "none": np.empty((0, 3)),
    "count": np.array(7),
}
KEYS = {"time.cfl": 2.0, "liquid[0].max": [0.4, 0.4]}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> CheckpointFolder:
    """Return checkpoints of the steps 5 and 12, the latter in parts of two ranks."""
    folder = CheckpointFolder(tmp_path_factory.mktemp("checkpoints"), "fingerprint", KEYS)
    folder.write(Checkpoint(5, 0.25, STATE))
    pieces = [Checkpoint(12, 0.5, STATE | {"rank": np.array(rank)}) for rank in range(2)]
    for rank, piece in enumerate(pieces):
        folder.of_rank(rank).write(piece)
    folder.write(Checkpoint(12, 0.5, {PIECES: np.array([piece.checksum for piece in pieces])}))
    assert folder.newest()[0].step == 12
    return folder


def newest(folder: CheckpointFolder, path: Path, data: bytes) -> Checkpoint | None:
    """Return the checkpoint that a run continues from if a file is changed."""
    good = path.read_bytes()
    try:
        path.write_bytes(data)
        with limited():
            found, refused = folder.newest()
            if found and PIECES in found.state:
                assert all(
                    np.array_equal(piece["position"], STATE["position"])
                    for piece in folder.pieces(found)
                )
        assert all(str(path) in reason for reason in refused), refused
        assert refused or found.step == 12
        return found
    finally:
        path.write_bytes(good)


@costly
@given(st.data())
def test_checkpoints_in_pieces(folder: CheckpointFolder, data: st.DataObject) -> None:
    path = data.draw(
        st.sampled_from([folder.path(12), folder.of_rank(0).path(12), folder.of_rank(1).path(12)])
    )
    found = newest(
        folder, path, data.draw(mutated([path.read_bytes(), folder.path(5).read_bytes()]))
    )
    assert found is not None


@costly
@given(st.data())
def test_checkpoints_whose_zip_is_right(folder: CheckpointFolder, data: st.DataObject) -> None:
    """Checkpoints with a valid zip file.

    Members are changed, as in a file that was made on purpose.
    """
    path = folder.path(5)
    with zipfile.ZipFile(path) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    for name in data.draw(st.lists(st.sampled_from(sorted(members)), min_size=1, max_size=2)):
        members[name] = data.draw(mutated([members[name], members["state/name.npy"]]))
    refusal = refused(folder, rezipped(members))
    assert refusal is None or str(path) in refusal


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=2)
        | st.dictionaries(st.sampled_from([*KEYS, "domain.resolution"]), inner, max_size=2)
    ),
    max_leaves=4,
)


@costly
@given(
    st.dictionaries(
        st.sampled_from(["format", "scene", "step", "time", "keys", "checksum", "more"]),
        JSON,
        max_size=2,
    )
)
def test_checkpoints_that_say_something_else(
    folder: CheckpointFolder, said: dict[str, Any]
) -> None:
    with zipfile.ZipFile(folder.path(5)) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    meta = json.loads(str(np.load(io.BytesIO(members["meta.npy"]))))
    stream = io.BytesIO()
    np.save(stream, np.array(json.dumps(meta | said)))
    refused(folder, rezipped(members | {"meta.npy": stream.getvalue()}))


def rezipped(members: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return stream.getvalue()


def refused(folder: CheckpointFolder, data: bytes) -> str | None:
    """Return why a file is refused as the checkpoint of step 5; None if accepted.

    An accepted state must be the one that was written.
    """
    path = folder.path(5)
    good = path.read_bytes()
    try:
        path.write_bytes(data)
        with limited():
            found = folder.read(5)
        assert all(np.array_equal(found.state[name], array) for name, array in STATE.items())
        return None
    except CheckpointError as error:
        return str(error)
    finally:
        path.write_bytes(good)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a finished run of a few steps."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    assert told(*command(folder)) == 0
    return folder


def command(folder: Path) -> list[str]:
    scene = [
        "ceiling-drop",
        "--set",
        "domain.resolution=8",
        "--set",
        "time.duration=0.05",
        "--set",
        "output.checkpoint_every=1",
    ]
    return ["run", *scene, "--device", "cpu", "--out", str(folder)]


@settings(max_examples=settings().max_examples // 10)  # each example is a run
@given(st.data())
def test_folders_of_runs(run: Path, data: st.DataObject) -> None:
    """Run folders with damaged files: resuming ends with 0 or a refusal."""
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    path = data.draw(st.sampled_from(sorted(before)))
    try:
        path.write_bytes(data.draw(mutated([before[path]])))
        told(*command(run), "--resume", codes=(0, 1, 2))
    finally:
        for made in [path for path in run.rglob("*") if path.is_file() and path not in before]:
            made.unlink()
        for path, content in before.items():
            path.write_bytes(content)
