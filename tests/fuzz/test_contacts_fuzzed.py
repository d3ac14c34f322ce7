"""Damaged contact problems (HDF5): `read_fclib` reads them or reports the fault."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given
from hypothesis import strategies as st
from mutated import mutated
from told import costly, limited

from warp_lcp.gallery.fclib import read_fclib

h5py = pytest.importorskip("h5py")
STORED = {"triplet": 0, "columns": -1, "rows": -2}
B = np.diag([2.0, 3.0, 4.0, 5.0]) + np.eye(4, k=1) + np.eye(4, k=-1)


def contacts(kind: str, **changed: Any) -> bytes:
    """Return a local problem of a contact and a joint, or a global one.

    Some of its datasets are changed.
    """
    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        arrays: dict[str, Any] = {
            "info/title": np.bytes_("a title"),
            "spacedim": np.array([3], dtype=np.int32),
        }
        if kind == "global":
            arrays |= (
                matrix("M", B, "columns")
                | matrix("H", np.eye(4)[:, :3], "triplet")
                | matrix("G", np.eye(4)[:, 3:], "triplet")
            )
            arrays |= {
                "vectors/f": np.ones(4),
                "vectors/w": np.ones(3),
                "vectors/b": np.ones(1),
                "vectors/mu": np.array([0.5]),
            }
        else:
            arrays |= (
                matrix("W", B[:3, :3], kind)
                | matrix("V", B[:3, 3:], kind)
                | matrix("R", B[3:, 3:], kind)
            )
            arrays |= {
                "vectors/q": np.ones(3),
                "vectors/s": np.ones(1),
                "vectors/mu": np.array([0.5]),
            }
        for name, array in (arrays | changed).items():
            file[f"fclib_{'global' if kind == 'global' else 'local'}/{name}"] = array
        file["solution/r"], file["solution/l"] = np.ones(3), np.ones(1)
    return stream.getvalue()


def matrix(name: str, values: np.ndarray, kind: str) -> dict[str, np.ndarray]:
    m = scipy.sparse.coo_array(values)
    c = m.tocsc() if kind == "columns" else m.tocsr()
    nz, p, i, x = (
        (m.nnz, m.row, m.col, m.data)
        if kind == "triplet"
        else (STORED[kind], c.indptr, c.indices, c.data)
    )
    numbers = {"nzmax": m.nnz, "m": m.shape[0], "n": m.shape[1], "nz": nz}
    found = {f"{name}/{key}": np.array([value], dtype=np.int32) for key, value in numbers.items()}
    return found | {
        f"{name}/p": p.astype(np.int32),
        f"{name}/i": i.astype(np.int32),
        f"{name}/x": x,
    }


FILES = [contacts(kind) for kind in (*STORED, "global")]
NUMBERS = [
    0,
    1,
    -1,
    -2,
    2,
    3,
    4,
    5,
    2**31 - 1,
    -(2**31),
    10**12,
    2**63 - 1,
    0.5,
    np.nan,
    np.inf,
    -1e308,
]


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("contacts") / "a.hdf5"


def read(path: Path, data: bytes) -> None:
    path.write_bytes(data)
    try:
        with limited():
            read_fclib(path)
    except ValueError as error:
        assert str(error).startswith(f"{path}: "), error


@pytest.mark.parametrize("data", FILES, ids=(*STORED, "global"))
def test_good_contacts_are_read(path: Path, data: bytes) -> None:
    path.write_bytes(data)
    assert read_fclib(path).system.dim == 3


@costly
@given(mutated(FILES))
def test_contacts(path: Path, data: bytes) -> None:
    read(path, data)


@costly
@given(st.data())
def test_contacts_of_other_numbers(path: Path, data: st.DataObject) -> None:
    kind = data.draw(st.sampled_from([*STORED, "global"]))
    names = [
        f"{name}/{key}"
        for name in ("MHG" if kind == "global" else "WVR")
        for key in ("m", "n", "nz", "p", "i", "x")
    ]
    vectors = ("f", "w", "b", "mu") if kind == "global" else ("q", "s", "mu")
    names += [f"vectors/{name}" for name in vectors]
    arrays = st.lists(st.sampled_from(NUMBERS), max_size=6).map(np.array)
    read(
        path,
        contacts(
            kind,
            **data.draw(
                st.dictionaries(
                    st.sampled_from([*names, "spacedim"]), arrays, min_size=1, max_size=3
                )
            ),
        ),
    )
