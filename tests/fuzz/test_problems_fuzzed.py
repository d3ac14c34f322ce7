"""Damaged matrices and recorded problems: `warp-lcp solve` reads or refuses them."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import scipy.sparse
from hypothesis import given
from hypothesis import strategies as st
from mutated import mutated
from told import costly, told

from warp_lcp.cli import commands as cli

SIDE = 4
FIELD = np.random.default_rng(61).random((SIDE, SIDE))
PROBLEM = {
    "format": np.array(1),
    "cells": np.where(FIELD < 0.2, 0, np.where(FIELD > 0.9, 2, 1)).astype(np.int8),
    "b": FIELD - 0.5,
    "x0": np.zeros((SIDE, SIDE)),
    "lower": np.array(0.0),
    "upper": np.where(FIELD > 0.5, np.inf, 2.0),
    "face_x": np.ones((SIDE, SIDE + 1), dtype=np.float32),
    "shift": np.asfortranarray(FIELD),
    "step": np.array(3),
    **dict.fromkeys(("time", "dt", "spacing", "tolerance", "absolute_tolerance"), np.array(0.01)),
}


def market(matrix: object, **options: object) -> bytes:
    stream = io.BytesIO()
    scipy.io.mmwrite(stream, matrix, comment="a comment", **options)
    return stream.getvalue()


T = scipy.sparse.diags_array([-1.0, 2.5, -1.0], offsets=[-1, 0, 1], shape=(SIDE, SIDE))
MATRICES = [
    market(T),
    market(T, symmetry="symmetric"),
    market(T.toarray()),
    market(T.astype(int), field="integer"),
    market(T, field="pattern"),
]
VECTORS = [market(FIELD[:, :1]), market(scipy.sparse.coo_array(FIELD[:, :1]))]


def members() -> dict[str, bytes]:
    found = {}
    for name, array in PROBLEM.items():
        stream = io.BytesIO()
        np.save(stream, array)
        found[name] = stream.getvalue()
    return found


def archive(files: dict[str, bytes], packed: int = zipfile.ZIP_DEFLATED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", packed) as file:
        for name, data in files.items():
            file.writestr(f"{name}.npy", data)
    return stream.getvalue()


MEMBERS = members()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("problems")


def solved(folder: Path, **files: bytes) -> int:
    for name, data in files.items():
        (folder / name.replace("_", ".")).write_bytes(data)
    arguments = [folder / name.replace("_", ".") for name in files]
    return told(
        "solve",
        *arguments,
        "--device",
        "cpu",
        "--method",
        "psor",
        "--max-iterations",
        "0",
        codes=(0, cli.FAILED, cli.WRONG_INPUT),
    )


@costly
@given(matrix=mutated(MATRICES), vector=st.sampled_from(VECTORS))
def test_matrices(folder: Path, matrix: bytes, vector: bytes) -> None:
    solved(folder, A_mtx=matrix, b_mtx=vector)


@costly
@given(matrix=st.sampled_from(MATRICES), vector=mutated(VECTORS))
def test_vectors(folder: Path, matrix: bytes, vector: bytes) -> None:
    solved(folder, A_mtx=matrix, b_mtx=vector)


@costly
@given(mutated([archive(MEMBERS), archive(MEMBERS, zipfile.ZIP_STORED)]))
def test_recorded_problems(folder: Path, problem: bytes) -> None:
    solved(folder, problem_npz=problem)


@costly
@given(st.data())
def test_recorded_problems_with_right_checksums(folder: Path, data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(sorted(MEMBERS)))
    solved(
        folder,
        problem_npz=archive(MEMBERS | {name: data.draw(mutated([MEMBERS[name], MEMBERS["b"]]))}),
    )
