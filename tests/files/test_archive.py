"""Archives of arrays: what they say is checked before it is read."""

import zipfile
from pathlib import Path

import numpy as np
import pytest

from warp_lcp.files import size_limits as claims
from warp_lcp.files.archive import Archive, ArchiveError

ARRAYS = {
    "a": np.arange(24.0).reshape(4, 3, 2),
    "fortran": np.asfortranarray(np.arange(24).reshape(4, 3, 2)),
    "scalar": np.array(2.5),
    "text": np.array(["liquid", "sand"]),
    "none": np.empty((0, 3), dtype=np.float32),
    "flags": np.array([True, False]),
    "swapped": np.arange(3, dtype=">i4"),
}
DESCR = "{'descr': '<f8', 'fortran_order': False, 'shape': (2,), }"


@pytest.fixture(params=[np.savez, np.savez_compressed])
def path(request, tmp_path: Path) -> Path:
    request.param(tmp_path / "a.npz", **ARRAYS)
    return tmp_path / "a.npz"


def member(header: str, data: bytes = bytes(16), version: tuple[int, int] = (1, 0)) -> bytes:
    return (
        b"\x93NUMPY"
        + bytes(version)
        + len(header).to_bytes(2 if version == (1, 0) else 4, "little")
        + header.encode()
        + data
    )


def zipped(path: Path, members: dict[str, bytes], packed: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", packed) as file:
        for name, data in members.items():
            file.writestr(name, data)
    return path


def read(path: Path, name: str = "a") -> np.ndarray:
    with Archive(path) as archive:
        return archive.read([name])[name]


def test_arrays_come_back(path):
    with Archive(path) as archive:
        assert archive.headers.keys() == ARRAYS.keys()
        found = archive.read(list(ARRAYS))
    for name, array in ARRAYS.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)


@pytest.mark.parametrize("name", ["a", "fortran"])
def test_a_box_is_part_of_the_array(path, name):
    box = (slice(1, 3), slice(0, 2), slice(1, 2))
    with Archive(path) as archive:
        np.testing.assert_array_equal(archive.read_box(name, box), ARRAYS[name][box])
        assert archive.read_box("scalar", box) == 2.5


def test_a_box_of_an_array_that_is_not_there_is_an_error_of_the_archive(path):
    with Archive(path) as archive, pytest.raises(ArchiveError, match="absent"):
        archive.read_box("absent", (slice(0, 1),))


def test_other_versions_of_the_format_are_read(tmp_path):
    for version in ((1, 0), (2, 0), (3, 0)):
        np.testing.assert_array_equal(
            read(zipped(tmp_path / "a.npz", {"a.npy": member(DESCR, version=version)})), [0.0, 0.0]
        )
    indented = member(DESCR + "\r\n   ")  # which NumPy takes for one of Python 2 and warns of
    np.testing.assert_array_equal(read(zipped(tmp_path / "a.npz", {"a.npy": indented})), [0.0, 0.0])


@pytest.mark.parametrize(
    ("members", "message"),
    [
        (
            {"a.npy": member(DESCR.replace("(2,)", "(1000000000000000000,)"))},
            "take 8000000000000000000 bytes, and the file has 16",
        ),
        ({"a.npy": member(DESCR.replace("(2,)", "(3,)"))}, "take 24 bytes, and the file has 16"),
        ({"a.npy": member(DESCR.replace("<f8", "|O8"))}, "it holds objects"),
        (
            {"a.npy": member(DESCR.replace("'<f8'", "[('x', '<f8')]"))},
            "not a NumPy header, or it declares structured values",
        ),
        ({"a.npy": member(DESCR.replace("2", "2" * 5000))}, "not a NumPy header"),
        ({"a.npy": member("[" * 9000)}, "not a NumPy header"),
        ({"a.npy": member("{'descr': __import__('os').abort()}")}, "not a NumPy header"),
        ({"a.npy": member(DESCR)[:40]}, "it is cut short"),
        ({"a.npy": member(DESCR, version=(9, 0))}, "its format is 9.0"),
        ({"a.npy": b"no array at all"}, "magic string"),
        ({"a.txt": b"text"}, "'a.txt' is not a plain array"),
        ({"a": b"text"}, "'a' is not a plain array"),
    ],
)
def test_impossible_archives_are_refused(tmp_path, members, message):
    with pytest.raises(ArchiveError, match=message):
        read(zipped(tmp_path / "a.npz", members))


@pytest.mark.parametrize("packed", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_ways_of_packing_are_refused(tmp_path, packed):
    with pytest.raises(ArchiveError, match="is not a plain array"):
        read(zipped(tmp_path / "a.npz", {"a.npy": member(DESCR)}, packed))


def test_two_arrays_of_one_name(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
        file.writestr("a.npy", member(DESCR))
        with pytest.warns(UserWarning, match="Duplicate"):
            file.writestr("a.npy", member(DESCR))
    with pytest.raises(ArchiveError, match="two arrays have the same name"):
        Archive(tmp_path / "a.npz")


def test_a_bomb_is_refused_before_it_is_read(tmp_path, monkeypatch):
    header = DESCR.replace("(2,)", "(4000000,)")
    path = zipped(
        tmp_path / "a.npz",
        {"a.npy": member(header, bytes(32_000_000)), "b.npy": member(DESCR)},
        zipfile.ZIP_DEFLATED,
    )
    assert path.stat().st_size < 40_000
    monkeypatch.setattr(claims, "free_host_memory", lambda: 10**7)
    with pytest.raises(ArchiveError, match=r"need 0[.]032 GB of memory, and 0[.]01 GB are free"):
        read(path)
    assert read(path, "b").shape == (2,)
    monkeypatch.setattr(np.lib.format, "read_array", None)
    with Archive(path) as archive, pytest.raises(ArchiveError, match="it lacks c"):
        archive.read(["c"])


def test_a_size_that_deflate_cannot_reach(tmp_path):
    path = zipped(
        tmp_path / "a.npz",
        {"a.npy": member(DESCR.replace("(2,)", "(40000000,)"))},
        zipfile.ZIP_DEFLATED,
    )
    with zipfile.ZipFile(path) as file:
        size = file.infolist()[0].file_size
    wanted = size - 16 + 320_000_000
    path.write_bytes(
        path.read_bytes().replace(size.to_bytes(4, "little"), wanted.to_bytes(4, "little"))
    )
    with pytest.raises(ArchiveError, match="and the file has"):
        read(path)


@pytest.mark.parametrize(
    "make", [lambda path: None, lambda path: path.mkdir(), lambda path: path.write_bytes(b"")]
)
def test_no_file(tmp_path, make):
    make(tmp_path / "a.npz")
    with pytest.raises(ArchiveError):
        Archive(tmp_path / "a.npz")


def test_any_byte_may_be_another_one(path):
    good = path.read_bytes()
    for at in range(0, len(good), 11):
        path.write_bytes(good[:at] + bytes([good[at] ^ 0x55]) + good[at + 1 :])
        try:
            with Archive(path) as archive:
                found = archive.read(list(archive.headers))
            for name in found.keys() & ARRAYS.keys():
                np.testing.assert_array_equal(found[name], ARRAYS[name])
        except ArchiveError as error:
            assert str(error)
