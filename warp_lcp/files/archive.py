"""Safe reader of .npz files of plain arrays.

Types and sizes are checked against the file and the memory before an array is read; nothing is
unpickled.
"""

from __future__ import annotations

import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from pathlib import Path
from types import TracebackType
from typing import IO, Self

import numpy as np

from warp_lcp.files.size_limits import SizeLimitError, check_claim

SUFFIX = ".npy"  # suffix of an archive's members
HEADER = re.compile(  # as NumPy writes it; NumPy's reader evaluates the text
    rb"\{'descr': '(?P<type>[<>|=][?bBiufcSUO]\d*)', 'fortran_order': (?P<order>True|False), "
    rb"'shape': \((?P<shape>(?:\d{1,19}, ?)*(?:\d{1,19})?)\),? ?\}\s*"
)
# Bytes of a header's length, by the version of the format.
LENGTH_BYTES = {(1, 0): 2, (2, 0): 4, (3, 0): 4}
LONGEST = 10_000  # characters of a header, NumPy's own limit
DEFLATED = 1032  # largest expansion of a byte by deflate (zlib.net/zlib_tech.html)
FAULTS = (  # errors of zipfile, zlib and NumPy for invalid archives
    OSError,
    ValueError,
    TypeError,
    LookupError,
    ArithmeticError,
    EOFError,
    MemoryError,
    RuntimeError,
    SyntaxError,
    struct.error,
    zipfile.BadZipFile,
    zlib.error,
)


class ArchiveError(ValueError):
    """Error of an archive: not of plain arrays, or damaged.

    The message does not include the file's name.
    """


@dataclass(frozen=True)
class Header:
    """Header of an array in an archive.

    Args:
        shape: shape of the array.
        dtype: its type.
        fastest_first: Fortran order: the first axis varies fastest.
        length: bytes of its member before the first value.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    fastest_first: bool
    length: int

    @property
    def nbytes(self) -> int:
        """Memory of the array [bytes]."""
        return prod(self.shape) * self.dtype.itemsize

    def __str__(self) -> str:
        """Return type and shape for messages."""
        return f"{self.dtype} of shape {self.shape}"


class Archive:
    """Open .npz file; use it in a `with` block.

    Args:
        path: the file.

    Attributes:
        headers: headers of all arrays, by name.

    Raises:
        ArchiveError: the file cannot be read, is no archive, or has impossible headers.
    """

    headers: dict[str, Header]

    def __init__(self, path: Path) -> None:
        """Open a file and read the headers of its arrays."""
        with _faults_named():
            if path.exists() and not path.is_file():  # opening a pipe would block
                raise ArchiveError("it is not a file")
            # `close` closes it; zipfile would leave a broken file open.
            self._stream = open(path, "rb")  # noqa: SIM115
        try:
            with _faults_named():
                self._file = zipfile.ZipFile(self._stream)
                self._members = {
                    info.filename.removesuffix(SUFFIX): info for info in self._file.infolist()
                }
                self._check_members(path.stat().st_size)
                self.headers = {name: self._header(info) for name, info in self._members.items()}
        except ArchiveError:
            self._stream.close()
            raise

    def read(self, names: Collection[str]) -> dict[str, np.ndarray]:
        """Read arrays.

        Raises:
            ArchiveError: there are no such arrays, they are damaged, or together they do not fit
                the free memory.
        """
        self._check_memory(names)
        found = {}
        for name in names:
            with _faults_named(name), self._file.open(self._members[name]) as stream:
                found[name] = np.lib.format.read_array(stream, allow_pickle=False)
        return found

    def read_box(self, name: str, box: tuple[slice, ...]) -> np.ndarray:
        """Read a part of an array, or all of an array without axes.

        The file is read from its start to the end of the part, one plane or row at a time.

        Args:
            name: name of the array.
            box: a slice with start and stop for each axis, within the array.

        Raises:
            ArchiveError: there is no such array, it is damaged, or does not fit the free memory.
        """
        header = self.headers.get(name)
        if header is None or not header.shape or header.fastest_first:
            whole = self.read([name])[name]
            return np.ascontiguousarray(whole[box]) if whole.ndim else whole
        rows, *other_axes = box
        plane = prod(header.shape[1:]) * header.dtype.itemsize
        shape = [part.stop - part.start for part in box]
        with _faults_named(name), self._file.open(self._members[name]) as stream:
            check_claim(
                f"{'x'.join(map(str, shape))} values", prod(shape) * header.dtype.itemsize + plane
            )
            values = np.empty(shape, dtype=header.dtype)
            _exactly(stream, header.length)
            for row in range(rows.stop):
                read = _exactly(stream, plane)
                if row >= rows.start:
                    values[row - rows.start] = np.frombuffer(read, dtype=header.dtype).reshape(
                        header.shape[1:]
                    )[tuple(other_axes)]
        return values

    def close(self) -> None:
        """Close the file and its stream."""
        self._file.close()
        self._stream.close()

    def __enter__(self) -> Self:
        """Return the open archive itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the file when the block ends."""
        self.close()

    def _check_members(self, size: int) -> None:
        """Raise an error for members with contradictory or impossible sizes."""
        infos = self._file.infolist()
        if len(self._members) != len(infos):
            raise ArchiveError("two arrays have the same name")
        if sum(info.compress_size for info in infos) > size:
            raise ArchiveError(f"its arrays take more than its {size} bytes")
        for name, info in self._members.items():
            if (
                info.filename != name + SUFFIX
                or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
                or info.flag_bits & 1
            ):
                raise ArchiveError(f"{info.filename!r} is not a plain array")
            most = info.compress_size * (
                DEFLATED if info.compress_type == zipfile.ZIP_DEFLATED else 1
            )
            check_claim(
                f"{name!r} of {info.file_size} bytes", 0, stored=info.file_size, available=most
            )

    def _header(self, info: zipfile.ZipInfo) -> Header:
        """Read the header of an array, and compare it with the member's size."""
        with _faults_named(info.filename.removesuffix(SUFFIX)), self._file.open(info) as stream:
            version = np.lib.format.read_magic(stream)
            if version not in LENGTH_BYTES:
                raise ArchiveError(f"its format is {'.'.join(map(str, version))}")
            length = int.from_bytes(_exactly(stream, LENGTH_BYTES[version]), "little")
            begin = np.lib.format.MAGIC_LEN + LENGTH_BYTES[version] + length
            match = HEADER.fullmatch(_exactly(stream, length)) if length <= LONGEST else None
            if match is None:
                raise ArchiveError(
                    "its header is not a NumPy header, or it declares structured values"
                )
            dtype = np.dtype(match["type"].decode())
            if dtype.hasobject:
                raise ArchiveError("it holds objects")
            shape = tuple(int(count) for count in match["shape"].split(b",") if count.strip())
            header = Header(shape, dtype, match["order"] == b"True", begin)
            if header.nbytes != info.file_size - begin:
                what = f"{'x'.join(map(str, shape)) or 'one'} of {dtype.itemsize} bytes"
                raise ArchiveError(
                    f"{what}: these take {header.nbytes} bytes, and the file has "
                    f"{info.file_size - begin}"
                )
            return header

    def _check_memory(self, names: Collection[str]) -> None:
        """Raise an error for missing arrays, or if memory is insufficient."""
        missing = sorted(set(names) - self.headers.keys())
        if missing:
            raise ArchiveError(f"it lacks {', '.join(missing)}")
        try:
            check_claim(f"{len(names)} arrays", sum(self.headers[name].nbytes for name in names))
        except SizeLimitError as error:
            raise ArchiveError(str(error)) from error


@contextmanager
def _faults_named(name: str = "") -> Iterator[None]:
    """Convert errors while an archive is read into one that names the array."""
    try:
        # NumPy warns about headers that Python 2 wrote.
        with warnings.catch_warnings(action="ignore", category=UserWarning):
            yield
    except FAULTS as error:
        if isinstance(error, ArchiveError) and not name:
            raise
        reason = (
            (error.strerror if isinstance(error, OSError) else None)
            or str(error)
            or type(error).__name__
        )
        raise ArchiveError(f"{name!r}: {reason}" if name else reason) from error


def _exactly(stream: IO[bytes], count: int) -> bytes:
    """Return exactly `count` bytes.

    Raises:
        ArchiveError: there are fewer.
    """
    read = stream.read(count)
    if len(read) != count:
        raise ArchiveError("it is cut short")
    return read
