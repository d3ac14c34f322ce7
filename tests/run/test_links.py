"""Protection against links in a run folder.

A run writes through no link, hard link or pipe that another user has put there.
"""

import os
import shutil
import stat
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from small_runs import run_into, write_run
from warp_lcp.files.atomic import (
    SUFFIX,
    TEMPORARY,
    make_folder,
    open_in_place,
    replacing,
    replacing_by_name,
    reserve,
    write_text,
)
from warp_lcp.render.render import ImageStyle, render_run
from warp_lcp.run.folder import OutputError
from warp_lcp.run.folder_lock import LOCK, locked
from warp_lcp.run.log import Log
from warp_lcp.run.profile import Profiler
from warp_lcp.run.progress import ProgressLines
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.simulation import Cells, Points

pytestmark = pytest.mark.skipif(os.name == "nt", reason="links need a privilege there")

PRECIOUS = "step,time\nprecious\n"
EVERYTHING = """
[scene]
simulator = "fluids"
[time]
duration = 0.1
frames_per_second = 20
[domain]
size = [0.8, 0.4, 0.4]
resolution = 8
[[liquid]]
shape = "box"
min = [0.0, 0.0, 0.0]
max = [0.4, 0.3, 0.4]
[[solid]]
shape = "sphere"
center = [0.6, 0.1, 0.2]
radius = 0.1
[[probe]]
name = "low"
quantity = "pressure"
position = [0.1, 0.1, 0.2]
[output]
surface = true
surface_ply = true
volume = true
forces = true
checkpoint_every = 1
"""
HIDDEN = {
    "run.json": [f".run.json{SUFFIX}", f".run.json.spare{SUFFIX}"],
    "scene.toml": [f".scene.toml{SUFFIX}"],
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    file = tmp_path_factory.mktemp("scene") / "everything.toml"
    file.write_text(EVERYTHING)
    return load_scene(file)


def go(scene: Scene, out: Path, **options: Any) -> Any:
    return run_into(
        scene, out, record_problems=out / "problems", profile=Profiler("cpu"), **options
    )


@pytest.fixture(scope="module")
def whole(scene, tmp_path_factory) -> Path:
    """Return a run with all possible output."""
    out = tmp_path_factory.mktemp("whole") / "out"
    assert go(scene, out).status == "finished"
    return out


@pytest.fixture(scope="module")
def begun(scene, tmp_path_factory) -> Path:
    """Return the same run after its first frame."""
    out = tmp_path_factory.mktemp("begun") / "out"
    assert go(scene, out, last_frame=1).status == "finished"
    return out


def names(whole: Path) -> list[str]:
    """Return the names of all files and folders that a run writes.

    Temporary files of the simplest kind are included.
    """
    found = sorted(str(path.relative_to(whole)) for path in whole.rglob("*"))
    return [
        LOCK,
        *found,
        *(
            hidden
            for name in found
            for hidden in HIDDEN.get(
                name, [f"{Path(name).parent / ('.' + Path(name).name)}{SUFFIX}"]
            )
        ),
    ]


def lay(link: Path, precious: Path) -> None:
    """Replace a file or a folder by a link."""
    folder = link.is_dir()
    if folder and not link.is_symlink():
        shutil.copytree(link, precious)
        shutil.rmtree(link)
    else:
        precious.write_text(PRECIOUS)
        link.unlink(missing_ok=True)
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(precious)


def content(precious: Path) -> dict[str, bytes]:
    files = (
        [precious]
        if precious.is_file()
        else [path for path in precious.rglob("*") if path.is_file()]
    )
    return {str(path): path.read_bytes() for path in files}


def test_everything_is_written(whole):
    kinds = {name.split("_0")[0] for name in names(whole)}
    assert kinds >= {
        "run.lock",
        "run.json",
        "scene.toml",
        "log.csv",
        "probes.csv",
        "forces.csv",
        "profile.json",
        "particles.pvd",
        "frames",
        "frames/particles",
        "frames/grid",
        "frames/surface",
        "frames/density",
        "checkpoints",
        "checkpoints/step",
        "problems",
        "problems/README.md",
        "problems/problem",
    }


def test_a_resumed_run_writes_through_no_link(scene, whole, begun, tmp_path):
    """Links before a resumed run.

    In place of each file and folder: the run is refused, or the link is removed and the file behind
    it stays.
    """
    for number, name in enumerate(names(whole)):
        if name == "problems":  # named by --record-problems, in a place of the user's choice
            continue
        out, precious = (
            shutil.copytree(begun, tmp_path / f"{number}"),
            tmp_path / f"precious_{number}",
        )
        lay(out / name, precious)
        before = content(precious)
        try:
            assert go(scene, out, resume=True).status == "finished", name
            assert not [
                path
                for path in out.rglob("*")
                if path.is_symlink() and path.parent.name != "problems"
            ], name
        except OutputError as error:
            assert "is a link" in str(error), name
        assert content(precious) == before, name
        shutil.rmtree(out)


def test_links_that_come_while_it_runs(scene, whole, tmp_path):
    """Links that appear while the run is active.

    Created after the first step: in place of pending files, and under every name that a temporary
    file had before.
    """
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    elsewhere.mkdir()

    class LinkPlanter(ProgressLines):
        def step(self, row: Any) -> None:
            super().step(row)
            for number, name in enumerate(names(whole) if row["step"] == 1 else ()):
                # Newer ones, which count as checkpoints.
                checkpoint = name.startswith("checkpoints/step")
                if not checkpoint and not (out / name).exists() and not (out / name).is_symlink():
                    lay(out / name, elsewhere / f"{number}")

    record = go(scene, out, observer=LinkPlanter(Console(quiet=True)))
    assert record.status == "finished", record.reason
    assert len(list(elsewhere.iterdir())) > 20
    assert {path.read_text() for path in elsewhere.iterdir()} == {PRECIOUS}


@pytest.mark.parametrize("name", ["frames", "checkpoints"])
def test_a_folder_that_becomes_a_link_while_it_runs(scene, tmp_path, name):
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"

    class FolderMover(ProgressLines):
        def step(self, row: Any) -> None:
            super().step(row)
            if row["step"] == 2:
                # Written beside the run, after the first frame.
                while not (out / "checkpoints" / "step_000001.npz").exists():
                    time.sleep(0.01)
                shutil.copytree(out / name, elsewhere)
                (out / name).rename(tmp_path / "before")  # at once: a thread may be writing
                (out / name).symlink_to(elsewhere)
                self.before = content(elsewhere)

    observer = FolderMover(Console(quiet=True))
    record = go(scene, out, observer=observer)
    assert record.status == "failed"
    assert "is a link" in record.reason
    assert content(elsewhere) == observer.before


@pytest.fixture
def drawn(dots, tmp_path_factory) -> Path:
    cells = Cells(
        "grid", np.array([[1, 1, 0], [2, 1, 0]]), 0.1, 2, {"pressure": np.ones(2, dtype=np.float32)}
    )
    return write_run(
        tmp_path_factory.mktemp("drawn") / "out",
        2 * [[Points("particles", np.full((1, 3), 0.15, np.float32), {}), cells]],
    )


@pytest.mark.parametrize("name", ["images", "images/slice_000000.png", "images/slice_000001.png"])
def test_images(drawn, tmp_path, name):
    out = shutil.copytree(drawn, tmp_path / "out")
    (out / "images").mkdir()
    lay(out / name, tmp_path / "precious")
    before = content(tmp_path / "precious")
    try:
        list(render_run(out, looks=ImageStyle(cut=True)))
        assert stat.S_ISREG((out / name).lstat().st_mode)
    except Exception as error:
        assert "is a link" in str(error)
    assert content(tmp_path / "precious") == before


def test_images_elsewhere_may_go_through_links(drawn, tmp_path):
    """Images in another folder: links are allowed, since the user names it."""
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "there")
    list(render_run(drawn, looks=ImageStyle(cut=True), out=tmp_path / "link"))
    assert list((tmp_path / "there").glob("slice_*.png"))


def test_the_runs_folder_may_be_a_link(scene_file, tmp_path):
    (tmp_path / "large").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "large")
    assert run_into(load_scene(scene_file), tmp_path / "out").status == "finished"
    assert (tmp_path / "large" / "run.json").is_file()


WRITERS: dict[str, Callable[[Path], Any]] = {
    "text": lambda path: write_text(path, "new"),
    "room": lambda path: reserve(path, 100),
    "over room": lambda path: write_text(path, "new", spare=True),
    "log": lambda path: Log(path, ("step",)).close(),
}


@pytest.mark.every_case
@pytest.mark.parametrize("kind", ["link", "hard link", "pipe", "dangling link"])
@pytest.mark.parametrize("writer", WRITERS)
def test_files_in_the_way_are_replaced(tmp_path, writer, kind):
    folder, precious = tmp_path / "folder", tmp_path / "precious"
    folder.mkdir()
    precious.write_text(PRECIOUS)
    for name in ("a.csv", f".a.csv{SUFFIX}", f".a.csv.spare{SUFFIX}"):
        if kind == "pipe":
            os.mkfifo(folder / name)
        elif kind == "hard link":
            os.link(precious, folder / name)
        else:
            (folder / name).symlink_to(precious if kind == "link" else tmp_path / "new")
    WRITERS[writer](folder / "a.csv")
    assert precious.read_text() == PRECIOUS
    assert not (tmp_path / "new").exists()
    if writer != "room":
        assert stat.S_ISREG((folder / "a.csv").lstat().st_mode)


@pytest.mark.skipif(sys.platform == "win32", reason="no flock")
@pytest.mark.parametrize("kind", ["link", "hard link", "pipe", "dangling link", "folder"])
def test_a_lock_that_is_no_plain_file(tmp_path, kind):
    precious, lock = tmp_path / "precious", tmp_path / "folder" / LOCK
    lock.parent.mkdir()
    precious.write_text(PRECIOUS)
    if kind == "pipe":
        os.mkfifo(lock)
    elif kind == "folder":
        lock.mkdir()
    elif kind == "hard link":
        os.link(precious, lock)
    else:
        lock.symlink_to(precious if kind == "link" else tmp_path / "new")
    with (
        pytest.raises(OSError, match=r"is a link|has other hard links|not a plain file|directory"),
        locked(lock.parent),
    ):
        pass
    assert precious.read_text() == PRECIOUS
    assert not (tmp_path / "new").exists()
    assert os.path.lexists(lock)  # nothing is removed


def test_temporary_names_are_not_known_before(tmp_path):
    seen = set()
    for _ in range(20):
        with replacing(tmp_path / "a") as file:
            (name,) = os.listdir(tmp_path)
            file.write(b"a")
        seen.add(name)
        match = TEMPORARY.fullmatch(name)
        assert match is not None
        assert match["name"] == "a"
        (tmp_path / "a").unlink()
    assert len(seen) == 20


def test_the_folder_that_was_opened_counts(tmp_path):
    """Folder that was opened, although its path now leads elsewhere.

    The file is in the opened folder.
    """
    folder = tmp_path / "folder"
    folder.mkdir()
    (tmp_path / "elsewhere").mkdir()
    with replacing(folder / "a") as file:
        folder.rename(tmp_path / "moved")
        folder.symlink_to(tmp_path / "elsewhere")
        file.write(b"new")
    assert (tmp_path / "moved" / "a").read_bytes() == b"new"
    assert not list((tmp_path / "elsewhere").iterdir())


def test_an_encoder_that_opens_the_file_itself(tmp_path):
    with replacing_by_name(tmp_path / "a") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "a").read_text() == "new"
    with pytest.raises(RuntimeError), replacing_by_name(tmp_path / "a") as temporary:
        temporary.write_text("newer")
        raise RuntimeError
    assert (tmp_path / "a").read_text() == "new"
    assert os.listdir(tmp_path) == ["a"]


def test_folders_within(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "frames").symlink_to(tmp_path / "elsewhere")
    for folder in ("frames", "frames/rank_0000"):
        with pytest.raises(OSError, match="is a link"):
            make_folder(tmp_path / "run" / folder, within=tmp_path / "run")
    make_folder(tmp_path / "run" / "frames" / "mine")  # whoever names the folder may do this
    assert (tmp_path / "elsewhere" / "mine").is_dir()


def test_two_threads_write_one_file(tmp_path):
    """Two threads that write one file: each has its own temporary file.

    One complete file remains.
    """

    def write(letter: str) -> None:
        for _ in range(50):
            write_text(tmp_path / "a", 1000 * letter)

    threads = [threading.Thread(target=write, args=[letter]) for letter in "xy"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (tmp_path / "a").read_text() in (1000 * "x", 1000 * "y")
    assert os.listdir(tmp_path) == ["a"]


def test_opened_in_place(tmp_path):
    os.close(open_in_place(tmp_path / "a", os.O_RDWR | os.O_CREAT))
    os.close(open_in_place(tmp_path / "a", os.O_RDWR))
    os.link(tmp_path / "a", tmp_path / "b")
    with pytest.raises(OSError, match="other hard links"):
        open_in_place(tmp_path / "a", os.O_RDWR)
