"""Floating components against SciPy's connected components of the dense graph."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components

import warp_lcp as wl
from oracle import assemble
from warp_lcp.operators.components import ComponentFinder, FloatingComponents


def expected_labels(cells, faces, shift, periodic):
    """Return sets of cells of floating components.

    They touch no AIR through an open face and have no shift.
    """
    A = assemble(cells, faces, shift, periodic)
    fluid = np.flatnonzero(cells.ravel() == wl.FLUID)
    block = A[np.ix_(fluid, fluid)]
    off = block - np.diag(np.diag(block))
    _, label = connected_components(off != 0, directed=False)
    excess = block.sum(axis=1) > 1e-9
    return {frozenset(fluid[label == c]) for c in np.unique(label) if not excess[label == c].any()}


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    shape=st.sampled_from([(4, 5, 6), (7, 9), (1, 12), (3, 2, 2)]),
    kind=st.sampled_from(["unit", "arrays", "shift"]),
    periodic=st.sampled_from([(False,) * 3, (True, False, True), (True, True, True)]),
    share=st.sampled_from([0.05, 0.3]),
)
def test_same_components_as_scipy(seed, shape, kind, periodic, share):
    rng = np.random.default_rng(seed)
    cells = rng.choice(3, shape, p=[share, 0.9 - share, 0.1])
    if not (cells == wl.FLUID).any():
        return
    faces, shift = [1.0] * 3, None
    if kind == "arrays":
        for axis in range(len(shape)):
            face = (
                rng.random([s + (q == len(shape) - 1 - axis) for q, s in enumerate(shape)]) < 0.6
            ).astype(float)
            front = np.moveaxis(face, len(shape) - 1 - axis, 0)
            front[-1] = front[0]
            faces[axis] = face
    if kind == "shift":
        shift = (rng.random(shape) < 0.05).astype(float)
    A = wl.GridPoisson(
        cells,
        face_x=faces[0],
        face_y=faces[1],
        face_z=faces[2],
        shift=shift,
        periodic=periodic,
        device="cpu",
    )
    found = A.floating_components()
    got = set()
    if found is not None:
        label = found.label.reshape(A.layout.stored_shape)[1:-1, 1:-1, 1:-1].ravel()
        got = {frozenset(np.flatnonzero(label == c)) for c in range(found.count)}
        assert sorted(map(len, got)) == sorted(found.sizes.astype(int))
    assert got == expected_labels(cells, faces, shift, periodic)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_mean_is_taken_from_components_that_are_free_as_a_whole(dtype, device):
    """Projection of a right-hand side: of three components one has an unknown that is not free.

    Cells of no component keep their values.
    """
    rng = np.random.default_rng(653)
    label = rng.permutation(np.repeat([-1, 0, 1, 2], [7, 5, 8, 6])).astype(np.int32)
    r, free = rng.standard_normal(label.size).astype(dtype), np.ones(label.size, dtype=np.uint8)
    free[np.flatnonzero(label == 1)[2]] = 0
    free[label == -1] = 0
    expected = r.copy()
    for c in (0, 2):
        expected[label == c] -= r[label == c].mean()
    field = wp.array(r, device=device)
    FloatingComponents(label, wp.get_device(device)).project(field, wp.array(free, device=device))
    np.testing.assert_allclose(field.numpy(), expected, atol=1e-6)


def test_found_again_after_the_cells_changed():
    cells = np.ones((4, 4), dtype=np.int8)
    A = wl.GridPoisson(cells, device="cpu")
    assert A.floating_components().count == 1
    cells[0, 0] = wl.AIR
    A.update(wp.array(np.pad(cells[None], 1), device="cpu"))
    assert A.floating_components() is None


def test_cells_that_stay_the_same_are_not_searched_again(device, monkeypatch):
    cells = np.full((3, 4, 5), wl.FLUID, dtype=np.int8)
    cells[-1] = wl.AIR
    A = wl.GridPoisson(cells, device=device)
    assert A.floating_components() is None
    monkeypatch.setattr(ComponentFinder, "_grow", lambda *_: pytest.fail("searched"))
    assert A.floating_components() is None
    monkeypatch.undo()
    A.update(wp.array(np.full_like(cells, wl.FLUID), device=device))
    assert A.floating_components().count == 1
