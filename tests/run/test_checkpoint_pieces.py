"""Checkpoints in parts: validity, old and damaged ones, resuming."""

import numpy as np
import pytest
from rich.console import Console

from small_runs import run_into
from warp_lcp.distributed.collective import Collective
from warp_lcp.run.checkpoint import PIECES, Checkpoint, CheckpointFolder
from warp_lcp.run.continuation import fingerprint
from warp_lcp.run.progress import ProgressLines
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.table import SceneError

SCENE = "of a test"


def state(rank, step):
    return {
        "position": np.full((3 + rank, 2), step, dtype=np.float32),
        "box": np.array([rank, rank + 1]),
    }


def write(folder, step, ranks=3, whose=SCENE):
    """Write a checkpoint as ranks do, but one after the other."""
    pieces = [CheckpointFolder(folder / f"rank_{rank:04d}", whose) for rank in range(ranks)]
    checkpoints = [Checkpoint(step, 0.1 * step, state(rank, step)) for rank in range(ranks)]
    folder.mkdir(parents=True, exist_ok=True)
    for place, checkpoint in zip(pieces, checkpoints, strict=True):
        place.write(checkpoint)
    whole = Checkpoint(
        step, 0.1 * step, {PIECES: np.array([checkpoint.checksum for checkpoint in checkpoints])}
    )
    CheckpointFolder(folder, whose).write(whole)


def names(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*.npz"))


def test_a_rank_writes_its_piece_and_then_the_whole(tmp_path):
    folder = CheckpointFolder(
        tmp_path / "c", SCENE, {"time.cfl": 2.0}, Collective.for_one_process()
    )
    assert (
        folder.write(Checkpoint(4, 0.5, state(0, 4)))
        == tmp_path / "c" / "rank_0000" / "step_000004.npz"
    )
    found, refused = CheckpointFolder(tmp_path / "c", SCENE).newest()
    assert found is not None and not refused
    assert (found.step, found.time, found.keys, len(found.state[PIECES])) == (
        4,
        0.5,
        {"time.cfl": 2.0},
        1,
    )
    piece = folder.pieces(found)[0]
    assert set(piece) == {"position", "box"} and len(piece) == 2
    np.testing.assert_array_equal(piece["position"], state(0, 4)["position"])
    with pytest.raises(KeyError):
        piece["velocity"]
    assert folder.complete(found)
    before = (tmp_path / "c" / "rank_0000" / "step_000004.npz").stat().st_mtime_ns
    folder.write(Checkpoint(4, 0.5, state(0, 4)))  # the one that the run resumed from stays
    assert (tmp_path / "c" / "rank_0000" / "step_000004.npz").stat().st_mtime_ns == before


def test_pieces_without_the_whole_do_not_count(tmp_path):
    write(tmp_path, 3)
    for rank in range(2):  # of a run that was killed then
        CheckpointFolder(tmp_path / f"rank_000{rank}", SCENE).write(
            Checkpoint(5, 0.5, state(rank, 5))
        )
    found, refused = CheckpointFolder(tmp_path, SCENE).newest()
    assert found is not None and found.step == 3 and not refused
    CheckpointFolder(tmp_path, SCENE).prune(2)
    assert names(tmp_path) == [
        *(f"rank_000{rank}/step_000003.npz" for rank in range(3)),
        "step_000003.npz",
    ]


@pytest.mark.parametrize("harm", ["missing", "cut", "of another checkpoint", "of another scene"])
def test_without_a_piece_the_checkpoint_before_is_taken(tmp_path, harm):
    for step in (3, 4):
        write(tmp_path, step)
    piece = tmp_path / "rank_0001" / "step_000004.npz"
    if harm == "missing":
        piece.unlink()
    elif harm == "cut":
        piece.write_bytes(piece.read_bytes()[:-100])
    else:
        whose = SCENE if harm == "of another checkpoint" else "of another test"
        CheckpointFolder(tmp_path / "rank_0001", whose).write(Checkpoint(4, 0.4, state(2, 4)))
    one = CheckpointFolder(tmp_path, SCENE)
    found, refused = one.newest()
    assert found is not None and found.step == 3
    assert len(refused) == 1 and str(piece) in refused[0]
    many = CheckpointFolder(tmp_path, SCENE, {}, Collective.for_one_process())
    newest, _ = many.newest()
    assert newest is not None and newest.step == 4 and not many.complete(newest)
    again, refused_by_many = many.newest()
    assert again is not None and again.step == 3 and many.complete(again)
    assert refused_by_many == refused
    many.set_aside(3)
    left = [name for name in names(tmp_path) if "step_000004" in name]
    assert left == []
    assert "refused_000004.npz" in names(tmp_path)


def test_old_pieces_go_with_their_checkpoint(tmp_path):
    write(tmp_path, 3, ranks=4)
    write(tmp_path, 6, ranks=2)
    many = CheckpointFolder(tmp_path, SCENE, {}, Collective.for_one_process())
    many.prune(1)
    assert names(tmp_path) == [
        "rank_0000/step_000006.npz",
        "rank_0001/step_000006.npz",
        "step_000006.npz",
    ]


def test_a_simulator_that_cannot_join_pieces_says_so(dots, scene_file, tmp_path):
    out, watcher = tmp_path / "out", ProgressLines(Console(quiet=True))
    scene = load_scene(scene_file)
    run_into(scene, out, observer=watcher, last_frame=1)
    for file in (out / "checkpoints").iterdir():
        file.unlink()
    write(out / "checkpoints", 4, whose=fingerprint(scene))
    with pytest.raises(
        SceneError,
        match="the checkpoint was written on several ranks: continue with --engine petsc",
    ):
        run_into(scene, out, observer=watcher, resume=True)
