"""Matrix Market files: SciPy's output, and files that crash SciPy's reader.

The latter are refused.
"""

import bz2
import gzip
import io

import numpy as np
import pytest
import scipy.io
import scipy.sparse

from warp_lcp.cli.matrix_market import HEAD, MarketError, read_market, read_shape
from warp_lcp.files.size_limits import SizeLimitError

RANDOM = np.random.default_rng(733)
FULL = RANDOM.standard_normal((5, 5))
THIN = np.where(RANDOM.random((5, 5)) < 0.4, FULL, 0.0)
OF = {"general": lambda m: m, "symmetric": lambda m: m + m.T, "skew-symmetric": lambda m: m - m.T}
REAL = b"%%MatrixMarket matrix coordinate real general\n"


def read(path, data: bytes, fits=lambda rows, columns: True):
    path.write_bytes(data)
    return read_market(path, fits, "expected another")


def written(matrix, **options) -> bytes:
    stream = io.BytesIO()
    scipy.io.mmwrite(stream, matrix, comment="two\nlines", precision=17, **options)
    return stream.getvalue()


@pytest.mark.parametrize("symmetry", OF)
@pytest.mark.parametrize("sparse", [False, True])
def test_files_written_by_scipy_are_read(tmp_path, symmetry, sparse):
    matrix = OF[symmetry](THIN if sparse else FULL)
    found = read(
        tmp_path / "a.mtx",
        written(scipy.sparse.coo_array(matrix) if sparse else matrix, symmetry=symmetry),
    )
    assert scipy.sparse.issparse(found) == sparse
    np.testing.assert_array_equal(found.toarray() if sparse else found, matrix)


def test_other_fields_shapes_and_spellings(tmp_path):
    whole = np.arange(-3, 3).reshape(2, 3)
    np.testing.assert_array_equal(read(tmp_path / "a.mtx", written(whole)), whole)
    pattern = read(tmp_path / "a.mtx", written(scipy.sparse.coo_array(whole), field="pattern"))
    np.testing.assert_array_equal(pattern.toarray(), whole != 0)
    text = (
        b"%%matrixmarket MATRIX Coordinate Real General\r\n% a\r\n\r\n 2  2 3 \r\n1 1 "
        b".5e1\r\n\r\n 2 2 -inf\r\n1 1 1"
    )
    np.testing.assert_array_equal(
        read(tmp_path / "a.mtx", text).toarray(), [[6.0, 0.0], [0.0, -np.inf]]
    )
    assert read(tmp_path / "a.mtx", REAL + b"3 3 0\n").nnz == 0


@pytest.mark.parametrize(("suffix", "pack"), [("gz", gzip.compress), ("bz2", bz2.compress)])
def test_packed_files(tmp_path, suffix, pack):
    path = tmp_path / f"a.mtx.{suffix}"
    np.testing.assert_array_equal(read(path, pack(written(FULL))), FULL)
    with pytest.raises(MarketError, match="cannot be unpacked"):
        read(path, pack(written(FULL))[:-9])


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "must begin with %%MatrixMarket"),
        (b"%%MatrixMarket vector array real general\n3\n", "must begin with %%MatrixMarket"),
        (REAL + b"\n" * 100_000, "must begin with %%MatrixMarket"),
        (REAL + b"2 2\n1 1\n", "the line with its size does not fit its form"),
        (REAL + b"1" + b"0" * 30 + b" 4 1\n1 1 1\n", "must begin"),
        # These crash SciPy 1.17 with a segmentation fault.
        (REAL + b"2 2 1\n1 1 1.9[[[[[", "an entry that is not a number"),
        (REAL + b"2 2 2\n1 1 1.5\n2 2 1\x00.5\n", "an entry that is not a number"),
        (REAL + b"2 2 2\n1 1 1.5\n2 ", "these take 11 bytes, and the file has 10"),
        (
            REAL + b"2 2 2\n1 1 1.5\n222222 ",
            "it holds 4 numbers, expected 6 for 2 x 2 with 2 entries",
        ),
        (REAL + b"2 2 1\n1 3 1.5\n", "rows 1 to 2 and columns 1 to 2"),
        (REAL + b"2 2 1\n0 1 1.5\n", "rows 1 to 2 and columns 1 to 2"),
        (REAL + b"2 2 1\n1.5 1 1\n", "rows 1 to 2 and columns 1 to 2"),
        (REAL + b"2 2 1\nnan 1 1\n", "rows 1 to 2 and columns 1 to 2"),
        (
            REAL.replace(b"general", b"symmetric") + b"2 3 1\n1 1 1\n",
            "symmetric matrices are square",
        ),
        (REAL.replace(b"real", b"complex") + b"2 2 1\n1 1 1 0\n", "holds complex numbers"),
        (REAL + b"3 3 1000000000000\n1 1 1.0\n", "the file has 8 bytes"),
        (REAL + b"1000000000000 1000000000000 1\n1 1 1.0\n", "1000000000000 entries|GB of memory"),
        (
            REAL.replace(b"coordinate", b"array") + b"4294967296 4294967296\n1.0\n",
            "the file has 4 bytes",
        ),
    ],
)
def test_invalid_files_are_refused_with_a_reason(tmp_path, data, message):
    with pytest.raises(ValueError, match=message) as found:
        read(tmp_path / "a.mtx", data)
    assert isinstance(found.value, MarketError | SizeLimitError) or "complex" in message


def test_a_shape_is_refused_before_its_matrix_is_read(tmp_path):
    with pytest.raises(ValueError, match="has shape 2 x 3: expected another"):
        read(
            tmp_path / "a.mtx",
            REAL + b"2 3 1\nno numbers at all\n",
            lambda rows, columns: rows == columns,
        )


def test_the_shape_is_read_without_the_entries(tmp_path):
    path = tmp_path / "a.mtx"
    path.write_bytes(REAL + b"% " + b"long" * 40_000 + b"\n7 9 1\n" + b"no numbers")
    assert read_shape(path, lambda rows, columns: True, "") == (7, 9)
    # The first block ends within the size.
    cut = REAL + b"%" + b"x" * (HEAD - len(REAL) - len("%\n70")) + b"\n70"
    path.write_bytes(cut + b"0 900 1\n1 1 1\n")
    assert len(cut) == HEAD
    assert read_shape(path, lambda rows, columns: True, "") == (700, 900)
    (tmp_path / "a.mtx.gz").write_bytes(gzip.compress(REAL + b"3 4 1\nno numbers"))
    assert read_shape(tmp_path / "a.mtx.gz", lambda rows, columns: True, "") == (3, 4)
    for data, message in (
        (REAL + b"2 2 9\n1 1 1\n", "2 x 2 with 9 entries: these take 53 bytes, and the file has 6"),
        (b"", "must begin"),
    ):
        path.write_bytes(data)
        with pytest.raises(ValueError, match=message):
            read_shape(path, lambda rows, columns: True, "")


def test_a_device_is_no_file(tmp_path):
    (tmp_path / "zero.mtx").symlink_to("/dev/zero")
    with pytest.raises(SizeLimitError, match="it is not a file"):
        read_market(tmp_path / "zero.mtx", lambda rows, columns: True, "")
