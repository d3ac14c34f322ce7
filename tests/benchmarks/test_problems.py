"""Problems of the benchmarks, and their assembled matrix against the operator."""

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.problems import (
    BOUNDS,
    anisotropic,
    basin,
    cut_cells,
    splash,
    splash_part,
    warm_changes,
)


def test_splash_has_liquid_on_walls_and_no_outflow_elsewhere():
    scene = splash(20)
    fluid, around = scene.cells == wl.FLUID, np.pad(scene.cells, 1, constant_values=wl.SOLID)
    neighbors = [
        np.roll(around, step, axis)[1:-1, 1:-1, 1:-1] for axis in range(3) for step in (-1, 1)
    ]
    assert np.array_equal(scene.wall, fluid & np.any([n == wl.SOLID for n in neighbors], axis=0))
    assert 0.3 < fluid.mean() < 0.7
    assert (scene.b[~fluid] == 0).all()
    assert np.count_nonzero(scene.b) == fluid.sum()


@pytest.mark.parametrize(
    "part", [(slice(0, 5), slice(3, 20), slice(11, 20)), (slice(6, 9), slice(0, 20), slice(4, 5))]
)
def test_a_part_of_the_splash_equals_the_same_part_of_the_whole(part):
    whole, found = splash(20, phase=0.23), splash_part(20, part, phase=0.23)
    around = np.pad(whole.cells, 1, constant_values=wl.SOLID)[
        tuple(slice(s.start, s.stop + 2) for s in part)
    ]
    assert np.array_equal(found.cells, around)
    assert np.array_equal(found.wall, whole.wall[part])
    assert np.array_equal(found.b, whole.b[part])


def test_matrix_is_the_operator():
    for scene in (splash(12), cut_cells(splash(12))):
        fluid = scene.cells == wl.FLUID
        x = np.zeros(fluid.shape)
        x[fluid] = np.random.default_rng(31).standard_normal(fluid.sum())
        A = wl.GridPoisson(scene.cells, device="cpu", dtype=wp.float64, **scene.faces)
        product = A.apply(wp.array(x, dtype=wp.float64, device="cpu")).numpy()
        assert np.allclose(scene.matrix() @ x[fluid], product[fluid], atol=1e-12)


def test_bounds():
    scene = splash(12)
    assert [np.isfinite(scene.lower(bounds)).sum() for bounds in BOUNDS] == [0, scene.wall.sum(), 1]


def test_cut_cells_are_open_in_part_near_the_sphere_only():
    faces = cut_cells(splash(16)).faces
    assert faces["face_x"].shape == (16, 16, 17)
    assert {f.min() for f in faces.values()} == {0.1}
    assert all(0.8 < np.mean(f == 1.0) < 1.0 for f in faces.values())


def test_anisotropic_coefficients():
    A = wl.GridPoisson(splash(12).cells, device="cpu", **anisotropic(splash(12), 7.0).faces)
    assert A.uniform == (7.0, 1.0, 1.0)


def test_warm_change_is_of_the_size_asked_for():
    first, second = warm_changes(splash(12), 0.03)
    assert np.linalg.norm(second - first) / np.linalg.norm(first) == pytest.approx(0.03)


def test_basin_is_full_and_not_singular():
    scene = basin(10)
    assert (scene.cells == wl.FLUID).sum() == 900
    assert wl.GridPoisson(scene.cells, device="cpu").floating_components() is None
