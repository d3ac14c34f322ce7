"""Checkpoints: exact, verified, and refused with a reason."""

import errno
import json
from pathlib import Path

import numpy as np
import pytest

from warp_lcp.files.atomic import replacing, write_text
from warp_lcp.run.checkpoint import Checkpoint, CheckpointError, CheckpointFolder

STATE = {
    "position": np.random.default_rng(977).random((30, 3)),
    "count": np.array(7),
    "name": np.array("apic"),
    "none": np.empty((0, 3)),
}


@pytest.fixture
def folder(tmp_path: Path) -> CheckpointFolder:
    folder = CheckpointFolder(tmp_path / "checkpoints", "fingerprint")
    folder.write(Checkpoint(12, 0.1 + 0.2, STATE))
    return folder


def test_round_trip_is_exact(folder):
    read = folder.read(12)
    assert (read.step, read.time) == (12, 0.1 + 0.2)
    assert read.state.keys() == STATE.keys()
    for name, array in STATE.items():
        assert read.state[name].dtype == array.dtype
        np.testing.assert_array_equal(read.state[name], array)


def test_objects_need_a_pickle_and_are_refused(folder):
    with pytest.raises(ValueError, match="need a pickle: x"):
        folder.write(Checkpoint(13, 0.0, {"x": np.array([{}])}))
    assert folder.steps() == [12]


def test_pruning_keeps_the_newest(folder):
    for step in (14, 16, 1_000_000):
        folder.write(Checkpoint(step, 0.0, STATE))
    folder.prune(3)
    assert folder.steps() == [1_000_000, 16, 14]
    folder.prune(1)
    assert folder.steps() == [1_000_000]


def test_checkpoints_set_aside_are_neither_read_nor_counted(folder):
    for step in (14, 16):
        folder.write(Checkpoint(step, 0.0, STATE))
    (folder.path(14)).write_text("broken")
    assert [path.name for path in folder.set_aside(12)] == [
        "refused_000016.npz",
        "refused_000014.npz",
    ]
    assert folder.steps() == [12]
    assert (folder.folder / "refused_000014.npz").read_text() == "broken"
    folder.prune(1)
    assert len(list(folder.folder.iterdir())) == 3


def test_the_scene_is_written_with_the_state(tmp_path):
    keys = {"time.cfl": 2.0, "liquid[0].max": [0.4, 0.4], "solid[0].wall": "free-slip"}
    folder = CheckpointFolder(tmp_path / "checkpoints", "fingerprint", keys)
    folder.write(Checkpoint(3, 0.1, STATE))
    assert folder.read(3).keys == keys


def test_a_renamed_checkpoint_is_not_another_step(folder):
    folder.path(12).rename(folder.path(40))
    with pytest.raises(CheckpointError, match="holds step 12; the file was renamed"):
        folder.read(40)


def damage(path: Path, how: str) -> None:
    data = path.read_bytes()
    if how == "truncated":
        path.write_bytes(data[: len(data) // 2])
    elif how == "empty":
        path.write_bytes(b"")
    elif how == "text":
        path.write_text("not a checkpoint")
    elif how == "flipped":
        at = data.index(STATE["position"].tobytes()) + 5
        path.write_bytes(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
    else:
        arrays = dict(np.load(path))
        if how == "foreign key":
            arrays["surprise"] = np.zeros(1)
        elif how == "lost key":
            del arrays["state/count"]
        elif how == "no meta":
            del arrays["meta"]
        elif how == "other scene":
            arrays["meta"] = np.array(str(arrays["meta"]).replace("fingerprint", "another"))
        elif how == "other format":
            arrays["meta"] = np.array(str(arrays["meta"]).replace('"format": 2', '"format": 99'))
        np.savez(path, **arrays)


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ("truncated", "cut short, damaged or not a checkpoint"),
        ("empty", "cut short, damaged or not a checkpoint"),
        ("text", "cut short, damaged or not a checkpoint"),
        ("flipped", "cut short, damaged or not a checkpoint"),
        ("no meta", "cut short, damaged or not a checkpoint"),
        ("foreign key", "holds unexpected arrays: 'surprise'"),
        ("lost key", "wrong checksum"),
        ("other scene", "belongs to another scene"),
        ("other format", "written in format 99, this version reads format 2"),
    ],
)
def test_damage_is_found_and_the_one_before_is_used(folder, how, reason):
    folder.write(Checkpoint(20, 0.5, STATE))
    damage(folder.path(20), how)
    with pytest.raises(CheckpointError, match=reason):
        folder.read(20)
    newest, refused = folder.newest()
    assert newest is not None
    assert newest.step == 12
    assert len(refused) == 1
    assert "step_000020.npz" in refused[0]


def test_no_checkpoint_at_all(tmp_path):
    assert CheckpointFolder(tmp_path / "none", "x").newest() == (None, [])


def test_a_failed_write_leaves_the_file_as_it_was(tmp_path):
    path = tmp_path / "a.txt"
    write_text(path, "before")
    with pytest.raises(OSError, match="No space"), replacing(path) as file:
        file.write(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")
    assert path.read_text() == "before"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_a_flipped_bit_costs_at_most_one_checkpoint(folder):
    """Cost of a flipped bit: at most one checkpoint.

    Bits of the zip's directory change the kind of an array's packing, its place, size, name and
    checksum.
    """
    folder.write(Checkpoint(20, 0.5, STATE))
    path = folder.path(20)
    good = path.read_bytes()
    found = {20: 0, 12: 0}
    begin = good.index(b"PK\x01\x02")
    # All bits of the version, the flags and the packing.
    first = [(begin + number // 8, number % 8) for number in range(8 * 16)]
    for at, bit in [*first, *((at, at % 8) for at in range(begin, len(good), 11))]:
        path.write_bytes(good[:at] + bytes([good[at] ^ 1 << bit]) + good[at + 1 :])
        newest, refused = folder.newest()
        assert newest is not None
        found[newest.step] += 1
        for name, array in STATE.items():
            np.testing.assert_array_equal(newest.state[name], array)
        assert len(refused) == (newest.step == 12)
    assert min(found.values()) > 20  # a date, for example, does not matter


@pytest.mark.parametrize(
    "said",
    [
        {"time": float("nan")},
        {"time": -1.0},
        {"time": None},
        {"step": "12"},
        {"keys": [1]},
        {"checksum": 3},
        {"format": None},
    ],
)
def test_checkpoint_entries_must_have_the_right_type(folder, said):
    arrays = dict(np.load(folder.path(12)))
    arrays["meta"] = np.array(json.dumps(json.loads(str(arrays["meta"])) | said))
    np.savez(folder.path(12), **arrays)
    with pytest.raises(CheckpointError, match="step_000012"):
        folder.read(12)
