"""Measures of surfaces for films against shapes of known topology and distance."""

import sys

import numpy as np
import pytest
import warp as wp

from warp_lcp.benchmarks import surfaces
from warp_lcp.benchmarks.surfaces import FilmScene, Lace, lace, normals, ours, rms_change, volume
from warp_lcp.grid.marching_cubes import MarchingCubes
from warp_lcp.grid.staggered import StaggeredGrid

CELLS, CELL = 32, 0.05


def contour(distance):
    """Return the mesh of a distance [cells] of points [cells], negative inside."""
    grid = StaggeredGrid((CELLS,) * 3, CELL, 3, "cpu")
    x = np.stack(np.indices(grid.shape)[::-1], axis=-1) - 0.5
    phi = wp.array(distance(x).astype(np.float32), device="cpu")
    mesh = MarchingCubes(grid).contour(phi, grid.field(wp.int32))
    return mesh.points.numpy().astype(np.float64), mesh.corners.numpy().astype(np.int64)


def ball(x, radius, center=(16.0, 16.0, 16.0)):
    return np.linalg.norm(x - center, axis=-1) - radius


def ring(x):
    around = np.hypot(x[..., 0] - 16.0, x[..., 2] - 16.0) - 9.0
    return np.hypot(around, x[..., 1] - 16.0) - 3.0


def test_lace_counts_pieces_cavities_and_handles():
    assert lace(contour(lambda x: ball(x, 9.0))) == Lace(1, 0, 0)
    assert lace(contour(ring)) == Lace(1, 0, 1)
    shell = contour(lambda x: np.maximum(ball(x, 12.0), -ball(x, 6.0)))
    assert lace(shell) == Lace(2, 1, 0)
    two = contour(lambda x: np.minimum(ring(x), ball(x, 4.0, (16.0, 26.0, 16.0))))
    assert lace(two) == Lace(2, 0, 1)


def test_volume_normals_and_change_of_a_ball():
    small, large = (contour(lambda x, r=r: ball(x, r)) for r in (9.0, 9.4))
    assert volume(small) == pytest.approx(4.0 / 3.0 * np.pi * (9.0 * CELL) ** 3, rel=0.01)
    outward = small[0] - 16.0 * CELL
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    assert np.einsum("ij,ij->i", normals(small), outward).min() > 0.97
    everywhere = np.ones(len(small[0]), dtype=bool)
    assert rms_change(small, large, everywhere) / CELL == pytest.approx(0.4, abs=0.03)
    assert rms_change(small, small, everywhere) == 0.0


@pytest.fixture(scope="module")
def rest():
    """Return a small pool at rest: its scene and the particles of three frames."""
    pool = surfaces._box((0.0, 0.0, 0.0), (1.0, 0.5, 1.0))
    scene = FilmScene((1.0, 1.0, 1.0), 16, (3, 4, 5), {"liquid": [pool]})
    return scene, scene.particles(5)


def test_a_pool_at_rest_is_flat_and_does_not_flicker(rest):
    scene, film = rest
    wrap = ours(scene)
    meshes = [wrap(x) for x in film.values()]
    for mesh in meshes:
        counts = surfaces.upper(mesh, scene, 6.0)
        assert counts.sum() > 100
        heights = mesh[0][counts, 1] / scene.spacing
        assert heights.mean() == pytest.approx(8.0, abs=0.05)
        assert heights.std() < 0.03
    counts = surfaces.upper(meshes[0], scene, 6.0)
    for mesh in meshes[1:]:
        assert rms_change(meshes[0], mesh, counts) / scene.spacing < 0.02


def test_the_particles_are_the_same_again(rest):
    scene, film = rest
    assert all(np.array_equal(x, film[frame]) for frame, x in scene.particles(5).items())
    assert not np.array_equal(scene.particles(6)[3], film[3])


def test_without_pysplashsurf_it_is_named_and_the_rest_is_measured(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pysplashsurf", None)
    assert list(surfaces.methods()) == list(surfaces.OURS)
    assert "pip install pysplashsurf" in capsys.readouterr().err


def test_pysplashsurf_wraps_the_same_particles(rest):
    pytest.importorskip("pysplashsurf")
    scene, film = rest
    mesh = surfaces.SPLASHSURF["pysplashsurf 3, 0.5"](scene)(film[3])
    assert lace(mesh).pieces == 1
    assert volume(mesh) == pytest.approx(0.5, rel=0.1)
