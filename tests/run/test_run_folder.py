"""Ownership of a run folder, and files that may be deleted."""

import json
from pathlib import Path

import pytest

from warp_lcp.run.checkpoint import Checkpoint
from warp_lcp.run.continuation import fingerprint
from warp_lcp.run.folder import OutputError, RunFolder, RunRecord
from warp_lcp.scene.scene_file import load_scene

SPARE = ".run.json.spare.part"  # room for the last run.json, while a run is active
RUN_FILES = [
    "run.json",
    "scene.toml",
    "log.csv",
    "profile.json",
    "particles.pvd",
    "frames/grid_000003.vtu",
    "checkpoints/step_000050.npz",
]


@pytest.fixture
def folder(scene_file, tmp_path) -> RunFolder:
    return RunFolder(tmp_path / "deep" / "out", load_scene(scene_file))


def fill(folder: RunFolder, names: list[str]) -> None:
    for name in names:
        path = folder.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("x")


def test_a_new_or_empty_folder_is_taken(folder):
    folder.check_new(force=False)
    assert folder.path.is_dir()
    folder.check_new(force=False)
    assert list(folder.path.iterdir()) == []


def test_a_folder_where_a_run_died_at_its_first_file_is_taken(folder):
    fill(folder, [".run.json.part", SPARE])
    folder.check_new(force=False)
    folder.start(RunRecord("dots", "dots", "cpu"))
    assert sorted(path.name for path in folder.path.iterdir()) == [SPARE, "run.json", "scene.toml"]


def test_an_earlier_run_needs_force(folder):
    fill(folder, RUN_FILES)
    with pytest.raises(OutputError, match="use --resume to continue it, --force to delete it"):
        folder.check_new(force=False)
    folder.check_new(force=True)
    folder.start(RunRecord("dots", "dots", "cpu"))
    files = sorted(path.name for path in folder.path.rglob("*") if path.is_file())
    assert files == [SPARE, "run.json", "scene.toml"]


def test_leftovers_of_a_killed_run_go_too(folder):
    fill(folder, [*RUN_FILES, ".log.csv.part", "frames/.grid_000004.vtu.part"])
    folder.check_new(force=True)
    folder.start(RunRecord("dots", "dots", "cpu"))
    assert [path.name for path in folder.path.rglob("*.part")] == [SPARE]


@pytest.mark.parametrize(
    "name",
    [
        "notes.txt",
        "frames/photo.png",
        "checkpoints/deep/step_000001.npz",
        "frames2/grid_000001.vtu",
        ".git/config",
    ],
)
def test_force_never_deletes_foreign_files(folder, name):
    fill(folder, [*RUN_FILES, name])
    with pytest.raises(OutputError, match="files that do not belong to a run"):
        folder.check_new(force=True)
    assert (folder.path / name).is_file()
    assert (folder.path / "log.csv").is_file()


def test_a_folder_without_a_record_is_no_run(folder):
    fill(folder, ["scene.toml"])  # possibly the user's own
    with pytest.raises(OutputError, match="files that do not belong to a run"):
        folder.check_new(force=True)


def test_links_are_not_followed(folder, tmp_path):
    fill(folder, RUN_FILES)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "step_000001.npz").write_text("precious")
    (folder.path / "checkpoints" / "step_000050.npz").unlink()
    (folder.path / "checkpoints").rmdir()
    (folder.path / "checkpoints").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutputError, match="files that do not belong to a run"):
        folder.check_new(force=True)


def test_a_file_in_the_way(folder, tmp_path):
    (tmp_path / "deep").write_text("a file")
    with pytest.raises(OutputError, match="cannot be written"):
        folder.check_new(force=False)


def test_the_path_is_a_file(scene_file, tmp_path):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(OutputError, match="is not a folder"):
        RunFolder(tmp_path / "out", load_scene(scene_file)).check_new(force=True)


def test_nothing_to_resume(folder):
    with pytest.raises(OutputError, match="there is no run to resume"):
        folder.resume()


def begun(folder: RunFolder) -> RunFolder:
    folder.check_new(force=False)
    folder.start(RunRecord("dots", "dots", "cpu", mesh_files=folder.mesh_files))
    return folder


def test_steps_without_a_checkpoint_are_not_thrown_away(folder):
    begun(folder).log.write_text("step,time\n1,0.1\n")
    with pytest.raises(OutputError, match="no checkpoint to resume from; --force starts again"):
        folder.resume()


def test_a_run_killed_before_its_first_step_restarts(folder):
    begun(folder)
    for left in ("nothing", "a header"):
        continued = folder.resume()
        assert continued.checkpoint is None, left
        assert "starts again" in continued.remarks[0]
        folder.log.write_text("step,time\n")


def test_a_half_deleted_run_is_not_continued(folder, monkeypatch):
    """Half-deleted run: it is not continued.

    Checkpoints are deleted first, the record never. Whatever --force has not deleted yet when it is
    killed, no run resumes from it.
    """
    fill(folder, RUN_FILES)
    deleted: list[str] = []
    unlink = Path.unlink

    def watched(path: Path, missing_ok: bool = False) -> None:
        deleted.append(path.name)
        unlink(path, missing_ok=missing_ok)

    monkeypatch.setattr(Path, "unlink", watched)
    folder.start(RunRecord("dots", "dots", "cpu"))
    assert deleted[0] == "step_000050.npz"
    assert "run.json" not in deleted
    assert (folder.path / "run.json").read_text() != "x"


def changed(folder: RunFolder, scene_file: Path, *overrides: str) -> RunFolder:
    return RunFolder(folder.path, load_scene(scene_file, overrides))


def test_another_scene_is_not_resumed(folder, scene_file):
    begun(folder)
    overrides = [
        "time.frames_per_second=25.0",
        "physics.density=900.0",
        "time.duration=9.0",
        "output.grid=false",
    ]
    with pytest.raises(OutputError) as caught:
        changed(folder, scene_file, *overrides).resume()
    text = str(caught.value)
    assert "time.frames_per_second: 20.0 before, 25.0 now" in text
    assert "physics.density: 1000.0 before, 900.0 now" in text
    assert "duration:" not in text
    assert "output.grid" not in text
    assert "may change: scene.name, scene.description, time.duration" in text


def test_allowed_changes_are_reported_with_both_values(folder, scene_file):
    begun(folder).checkpoints.write(Checkpoint(8, 0.4, {}))
    overrides = [
        "time.duration=9.0",
        "solver.tolerance=1e-3",
        "output.checkpoints_kept=5",
        "time.cfl=1.0",
        "scene.name=other",
    ]
    continued = changed(folder, scene_file, *overrides).resume()
    assert continued.changed == [
        "output.checkpoints_kept: 3 before, 5 now",
        'scene.name: "dots" before, "other" now',
        "solver.tolerance: 0.0001 before, 0.001 now",
        "time.cfl: 2.0 before, 1.0 now",
        "time.duration: 0.5 before, 9.0 now",
    ]
    assert continued.resampled_from is None
    (remark,) = continued.remarks
    assert remark.startswith(
        "from step 8 on, steps differ from those of the original run: solver.tolerance"
    )
    assert "time.duration" not in remark


def test_a_duration_that_ends_before_the_checkpoint_would_lose_frames(folder, scene_file):
    begun(folder).checkpoints.write(Checkpoint(8, 0.4, {}))
    with pytest.raises(
        OutputError, match=r"time.duration = 0.3 s is less than the checkpoint's time, 0.4 s"
    ):
        changed(folder, scene_file, "time.duration=0.3").resume()
    assert changed(folder, scene_file, "time.duration=0.4").resume().checkpoint is not None


def test_another_resolution_is_detected_from_the_checkpoint(folder, scene_file):
    begun(folder).checkpoints.write(Checkpoint(8, 0.4, {}))
    finer = changed(folder, scene_file, "domain.resolution=16")
    assert finer.resume().resampled_from == 8
    # Killed here: scene.toml is new, the checkpoint is old.
    finer.prepare_continuation(RunRecord("dots", "dots", "cpu"), 8)
    assert finer.resume().resampled_from == 8


MESH_SCENE = """
[scene]
simulator = "dots"
[time]
duration = 0.5
[domain]
size = [1.0, 1.0, 1.0]
resolution = 8
[[solid]]
shape = "mesh"
file = "thing.obj"
"""


def test_a_mesh_counts_by_what_is_in_it(dots, tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "scene.toml").write_text(MESH_SCENE)
    mesh = tmp_path / "a" / "thing.obj"
    mesh.write_text("v 0 0 0\n")
    folder = begun(RunFolder(tmp_path / "out", load_scene(tmp_path / "a" / "scene.toml")))
    folder.checkpoints.write(Checkpoint(8, 0.4, {}))

    (tmp_path / "a").rename(tmp_path / "b")  # moved with its scene, unchanged: the same run
    moved = RunFolder(folder.path, load_scene(tmp_path / "b" / "scene.toml"))
    assert moved.resume().checkpoint is not None

    (tmp_path / "b").rename(tmp_path / "a")
    mesh.write_text("v 0 0 1\n")
    edited = RunFolder(folder.path, load_scene(tmp_path / "a" / "scene.toml"))
    with pytest.raises(
        OutputError,
        match=r"solid\[0\].file = .*thing.obj.*: the content of the file has changed since the run "
        r"began",
    ):
        edited.resume()
    # A checkpoint alone also distinguishes the new mesh from the old.
    assert edited.checkpoints.newest()[0] is None

    mesh.write_text("v 0 0 0\n")
    assert (
        RunFolder(folder.path, load_scene(tmp_path / "a" / "scene.toml")).resume().checkpoint
        is not None
    )


def test_other_software_versions_are_reported(folder):
    begun(folder).checkpoints.write(Checkpoint(8, 0.4, {}))
    record = json.loads((folder.path / "run.json").read_text())
    record["versions"]["numpy"] = "1.2.3"
    (folder.path / "run.json").write_text(json.dumps(record))
    (remark,) = folder.resume().remarks
    assert "numpy 1.2.3, now" in remark
    assert "may not be bitwise identical" in remark


def test_resuming_removes_unfinished_files(folder):
    begun(folder)
    for step in (4, 8, 12):
        folder.checkpoints.write(Checkpoint(step, step / 20, {}))
    fill(
        folder,
        [
            ".log.csv.part",
            "frames/.grid_000004.vtu.part",
            "checkpoints/.step_000016.npz.part",
            "frames/grid_000001.vtu",
        ],
    )
    folder.prepare_continuation(RunRecord("dots", "dots", "cpu"), 8)
    assert [path.name for path in folder.path.rglob(".*")] == [SPARE]
    assert sorted(path.name for path in folder.checkpoints.folder.iterdir()) == [
        "refused_000012.npz",
        "step_000004.npz",
        "step_000008.npz",
    ]
    assert (folder.path / "frames" / "grid_000001.vtu").is_file()
    folder.check_new(force=True)  # all files belong to a run


def test_fingerprint_ignores_keys_that_may_differ(scene_file: Path):
    same = load_scene(
        scene_file,
        [
            "time.duration=9.0",
            "output.checkpoint_every=7",
            "time.dt_max=0.01",
            "domain.resolution=16",
        ],
    )
    assert fingerprint(load_scene(scene_file)) == fingerprint(same)
    assert fingerprint(load_scene(scene_file)) != fingerprint(
        load_scene(scene_file, ["time.frames_per_second=3.0"])
    )
    assert fingerprint(load_scene(scene_file)) != fingerprint(
        load_scene(scene_file, ["domain.size=[1.0, 0.5]"])
    )
