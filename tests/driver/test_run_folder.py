"""Whose folder it is, and what may be deleted."""

from pathlib import Path

import pytest

from warp_lcp.driver.run_folder import OutputError, RunFolder, RunRecord, fingerprint
from warp_lcp.driver.scene_file import load_scene

RUN_FILES = ["run.json", "scene.toml", "log.csv", "profile.json", "particles.pvd", "frames/grid_000003.vtu", "checkpoints/step_000050.npz"]


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


def test_an_earlier_run_needs_force(folder):
    fill(folder, RUN_FILES)
    with pytest.raises(OutputError, match="--resume continues it, --force deletes it"):
        folder.check_new(force=False)
    folder.check_new(force=True)
    folder.start(RunRecord("dots", "dots", "cpu"))
    files = sorted(path.name for path in folder.path.rglob("*") if path.is_file())
    assert files == ["run.json", "scene.toml"]


def test_leftovers_of_a_killed_run_go_too(folder):
    fill(folder, [*RUN_FILES, ".log.csv.part", "frames/.grid_000004.vtu.part"])
    folder.check_new(force=True)
    folder.start(RunRecord("dots", "dots", "cpu"))
    assert not list(folder.path.rglob("*.part"))


@pytest.mark.parametrize(
    "name", ["notes.txt", "frames/photo.png", "checkpoints/deep/step_000001.npz", "frames2/grid_000001.vtu", ".git/config"]
)
def test_force_never_deletes_what_is_no_runs(folder, name):
    fill(folder, [*RUN_FILES, name])
    with pytest.raises(OutputError, match="files that are no run's"):
        folder.check_new(force=True)
    assert (folder.path / name).is_file()
    assert (folder.path / "log.csv").is_file()


def test_a_folder_without_a_record_is_no_run(folder):
    fill(folder, ["scene.toml"])  # perhaps the user's own
    with pytest.raises(OutputError, match="files that are no run's"):
        folder.check_new(force=True)


def test_links_are_not_followed(folder, tmp_path):
    fill(folder, RUN_FILES)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "step_000001.npz").write_text("precious")
    (folder.path / "checkpoints" / "step_000050.npz").unlink()
    (folder.path / "checkpoints").rmdir()
    (folder.path / "checkpoints").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutputError, match="files that are no run's"):
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


def test_no_checkpoint_to_resume(folder):
    folder.check_new(force=False)
    folder.start(RunRecord("dots", "dots", "cpu"))
    with pytest.raises(OutputError, match="no checkpoint to resume from"):
        folder.resume()


def test_another_scene_is_not_resumed(folder, scene_file, tmp_path):
    folder.check_new(force=False)
    folder.start(RunRecord("dots", "dots", "cpu"))
    changed = RunFolder(folder.path, load_scene(scene_file, ["time.cfl=3.0", "time.duration=9.0", "output.grid=false"]))
    with pytest.raises(OutputError) as caught:
        changed.resume()
    assert "time.cfl: 2.0 before, 3.0 now" in str(caught.value)
    assert "duration:" not in str(caught.value)
    assert "output.grid" not in str(caught.value)


def test_fingerprint_ignores_what_may_differ(scene_file: Path):
    same = load_scene(scene_file, ["time.duration=9.0", "output.checkpoint_every=7"])
    assert fingerprint(load_scene(scene_file)) == fingerprint(same)
    assert fingerprint(load_scene(scene_file)) != fingerprint(load_scene(scene_file, ["time.dt_max=0.01"]))
