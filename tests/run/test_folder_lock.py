"""Lock of a run folder: one process at a time.

Refused while another holds it, taken over when that one was killed.
"""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from warp_lcp.run.folder_lock import LOCK, FolderBusyError, locked

HOLDER = """
import sys, time
from pathlib import Path
from warp_lcp.run.folder_lock import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(120)
"""

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no flock")


def holder(folder: Path) -> subprocess.Popen:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(folder)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def end(process: subprocess.Popen) -> None:
    process.send_signal(signal.SIGKILL)
    process.wait(timeout=30)
    assert process.stdout is not None
    process.stdout.close()


def test_the_lock_file_names_its_owner_and_is_removed_with_the_lock(tmp_path):
    with locked(tmp_path) as remarks:
        assert remarks == []
        assert json.loads((tmp_path / LOCK).read_text())["pid"] == os.getpid()
        # Others cannot write it, and it is not executable.
        assert (tmp_path / LOCK).stat().st_mode & 0o133 == 0
    assert list(tmp_path.iterdir()) == []


def test_a_second_process_is_refused_and_a_killed_one_is_not_waited_for(tmp_path):
    process = holder(tmp_path)
    try:
        with (
            pytest.raises(
                FolderBusyError, match=f"another run writes there .process {process.pid} on "
            ),
            locked(tmp_path),
        ):
            pass
        assert (tmp_path / LOCK).is_file()  # a refused process removes nothing
    finally:
        end(process)
    assert (tmp_path / LOCK).is_file()
    with locked(tmp_path) as remarks:
        assert len(remarks) == 1
        assert f"left by process {process.pid} on " in remarks[0]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", ["", "{", "[]", '{"pid": "x"}'])
def test_any_file_in_the_way_is_taken_over(tmp_path, text):
    """Any existing file at the lock's path.

    The system's lock counts: a number of another running process does not block it.
    """
    (tmp_path / LOCK).write_text(text)
    with locked(tmp_path) as remarks:
        assert json.loads((tmp_path / LOCK).read_text())["pid"] == os.getpid()
        assert len(remarks) == bool(text)


def test_the_number_of_a_running_process_alone_is_no_lock(tmp_path):
    (tmp_path / LOCK).write_text(
        json.dumps({"pid": os.getpid(), "host": "here", "since": "yesterday"})
    )
    with locked(tmp_path) as remarks:
        assert f"left by process {os.getpid()} on here" in remarks[0]


def test_within_one_process_too(tmp_path):
    with locked(tmp_path), pytest.raises(FolderBusyError), locked(tmp_path):
        pass
    with locked(tmp_path):
        pass


def test_a_file_that_its_holder_removed_is_not_held(tmp_path, monkeypatch):
    """File removed by its holder: not locked.

    Between opening the file and locking it, the holder ends and removes it. The lock must be on the
    file that others will find.
    """
    from warp_lcp.run import folder_lock

    flock, descriptors = folder_lock.fcntl.flock, []

    def late(descriptor: int, operation: int) -> None:
        if not descriptors:
            (tmp_path / LOCK).unlink()
        descriptors.append(descriptor)
        flock(descriptor, operation)

    monkeypatch.setattr(folder_lock.fcntl, "flock", late)
    with locked(tmp_path):
        assert len(descriptors) == 2
        assert os.path.samestat(os.fstat(descriptors[1]), os.stat(tmp_path / LOCK))


def test_a_file_system_without_locks_is_reported(tmp_path, monkeypatch):
    from warp_lcp.run import folder_lock

    def none(descriptor: int, operation: int) -> None:
        raise OSError(37, "No locks available")

    monkeypatch.setattr(folder_lock.fcntl, "flock", none)
    with locked(tmp_path) as remarks:
        assert "has no locks (No locks available)" in remarks[0]
