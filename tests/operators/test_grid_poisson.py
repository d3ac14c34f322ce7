"""GridPoisson against a dense matrix assembled face by face from the definition."""

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from oracle import assemble
from warp_lcp.kernels.fields import CPU_CHUNK

SHAPES = [(5, 4, 6), (6, 7), (1, 3, 4), (3, 1), (2, 2, 2), (1, 1, 1)]
PERIODIC = [(False, False, False), (True, False, False), (True, True, True)]


def faces_of(kind, shape, periodic, rng):
    if kind == "unit":
        return [1.0] * 3, None
    if kind == "numbers":
        return [2.0, 0.5, 3.0], None
    if kind == "shift":
        return [0.3] * 3, rng.random(shape)
    faces = []
    for axis in range(len(shape)):
        face = rng.random([s + (q == len(shape) - 1 - axis) for q, s in enumerate(shape)])
        face[face < 0.2] = 0
        if periodic[axis]:
            front = np.moveaxis(face, len(shape) - 1 - axis, 0)
            front[-1] = front[0]
        faces.append(face)
    faces += [1.0] * (3 - len(faces))
    if kind == "mixed":
        return [faces[0], 1.5, 0.2], 0.5
    return faces, None


@pytest.mark.default_cases(36)
@pytest.mark.parametrize("dtype", [wp.float32, wp.float64])
@pytest.mark.parametrize("periodic", PERIODIC)
@pytest.mark.parametrize("kind", ["unit", "numbers", "arrays", "shift", "mixed"])
@pytest.mark.parametrize("shape", SHAPES)
def test_apply_and_diagonal_equal_the_dense_matrix(shape, kind, periodic, dtype, device):
    rng = np.random.default_rng(5)
    cells = rng.integers(0, 3, shape)
    faces, shift = faces_of(kind, shape, periodic, rng)
    A = wl.GridPoisson(
        cells,
        face_x=faces[0],
        face_y=faces[1],
        face_z=faces[2],
        shift=shift,
        periodic=periodic,
        device=device,
        dtype=dtype,
    )
    dense = assemble(cells, faces, shift, periodic)
    x = rng.standard_normal(shape)
    y = A.apply(wp.array(x, dtype=wp.float64, device=device)).numpy()
    tolerance = 2e-6 if dtype is wp.float32 else 1e-13
    np.testing.assert_allclose(y.ravel(), dense @ x.ravel(), atol=tolerance)
    np.testing.assert_allclose(A.diagonal().numpy().ravel(), np.diag(dense), atol=tolerance)


def test_operator_is_symmetric_and_semi_definite(device):
    rng = np.random.default_rng(8)
    cells = rng.integers(0, 3, (6, 5, 7))
    A = wl.GridPoisson(cells, face_y=rng.random((6, 6, 7)), device=device, dtype=wp.float64)
    x, y = (rng.standard_normal(cells.shape) for _ in range(2))
    Ax, Ay = (A.apply(wp.array(v, dtype=wp.float64, device=device)).numpy() for v in (x, y))
    fluid = cells == wl.FLUID
    assert np.vdot(y[fluid], Ax[fluid]) == pytest.approx(np.vdot(x[fluid], Ay[fluid]), abs=1e-12)
    assert np.vdot(x[fluid], Ax[fluid]) >= 0


def test_masked_is_the_principal_system(device):
    rng = np.random.default_rng(3)
    cells = rng.integers(0, 3, (4, 5, 6))
    free = (rng.random(cells.shape) < 0.6).astype(np.uint8)
    shift = rng.random(cells.shape)
    for faces in ({}, {"face_x": rng.random((4, 5, 7))}):
        A = wl.GridPoisson(cells, **faces, device=device, dtype=wp.float64)
        dense = assemble(cells, [faces.get("face_x", 1.0), 1.0, 1.0])
        p = (free.ravel() > 0) & (cells.ravel() == wl.FLUID)
        expected = dense * np.outer(p, p) + np.diag(shift.ravel() * p)
        masked = A.masked(free, shift)
        x = rng.standard_normal(cells.shape) * p.reshape(cells.shape)
        got = masked.apply(wp.array(x, dtype=wp.float64, device=device)).numpy()
        np.testing.assert_allclose(got.ravel(), expected @ x.ravel(), atol=1e-13)


def test_update_equals_a_new_operator(device):
    rng = np.random.default_rng(11)
    first, second = (rng.integers(0, 3, (4, 6, 5)).astype(np.int8) for _ in range(2))
    face = rng.random((4, 6, 6))
    for faces in ({}, {"face_x": face}):
        A, B = (wl.GridPoisson(c, **faces, device=device) for c in (first, second))
        A.update(wp.array(np.pad(second, 1, constant_values=wl.SOLID), device=device))
        x = wp.array(rng.standard_normal(first.shape), dtype=wp.float64, device=device)
        np.testing.assert_array_equal(A.apply(x).numpy(), B.apply(x).numpy())


@pytest.mark.parametrize("n", [1, 7, 8, 16, 31, 70])
def test_rows_span_their_fluid_cells(n, device, monkeypatch):
    """Spans of rows around their FLUID cells.

    In whole vectors of 16 cells; also the chunks of flat fields that have been in use, as a plain
    loop finds them.
    """
    monkeypatch.setattr("warp_lcp.operators.grid_operator.LARGE", 0)
    rng = np.random.default_rng(n)
    shape = (9, 40, n)
    A = wl.GridPoisson(np.zeros(shape, dtype=np.int8), device=device)
    ever = np.zeros(shape[:2], dtype=bool)
    for share in (0.0, 2.0 / n, 0.02, 1.0):
        cells = np.where(
            rng.random(shape) < share, wl.FLUID, rng.choice([wl.AIR, wl.SOLID], shape)
        ).astype(np.int8)
        cells[rng.random(shape[:2]) < 0.5] = wl.AIR
        A.update(wp.array(np.pad(cells, 1, constant_values=wl.SOLID), device=device))
        spans, row = np.zeros((*shape[:2], 2), dtype=int), n + 2
        for k, j in np.ndindex(shape[:2]):
            found = np.flatnonzero(cells[k, j] == wl.FLUID)
            if found.size:
                spans[k, j] = found[0] // 16 * 16, min(n, -(-(found[-1] + 1) // 16) * 16)
        np.testing.assert_array_equal(A.stencil.spans.numpy(), spans)
        ever |= spans[:, :, 1] > 0
        if A.layout.chunks is not None:
            used = np.zeros(A.layout.size, dtype=bool)
            for k, j in np.argwhere(ever):
                used[((k + 1) * (shape[1] + 2) + j + 1) * row :][:row] = True
            parts = [used[at : at + CPU_CHUNK] for at in range(0, used.size, CPU_CHUNK)]
            np.testing.assert_array_equal(
                A.layout.chunks.numpy()[:, 0], [(0, part.size * part.any()) for part in parts]
            )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"cells": np.ones((3, 3))}, "cells has type float64"),
        ({"cells": np.full((3, 3), 3)}, "cells has values from 3 to 3"),
        ({"cells": np.ones(4, dtype=int)}, "cells has shape"),
        ({"face_x": -1.0}, "face_x holds a negative value"),
        ({"face_y": np.ones((3, 3))}, r"face_y has shape \(3, 3\): expected \(4, 3\)"),
        ({"face_x": np.full((3, 4), np.nan)}, "face_x holds a value that is not finite"),
        ({"shift": -np.ones((3, 3))}, "shift holds a negative value"),
        ({"dtype": int}, "dtype"),
        (
            {"face_x": np.arange(12.0).reshape(3, 4), "periodic": (True, False)},
            "first and the last faces",
        ),
    ],
)
def test_bad_input_is_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        wl.GridPoisson(**{"cells": np.ones((3, 3), dtype=int), "device": "cpu", **arguments})


@pytest.mark.parametrize("device", ["cuda:77", "gpu"])
def test_a_device_that_is_not_there(device):
    with pytest.raises(
        ValueError, match=f"device = '{device}': there is no such device, expected one of cpu"
    ):
        wl.GridPoisson(np.ones((2, 2), int), device=device)
