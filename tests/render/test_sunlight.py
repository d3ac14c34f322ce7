"""Shadows, grains of sand, and a liquid's surface at solids."""

from pathlib import Path

import numpy as np
import pytest

from warp_lcp.grid.motion import Pose
from warp_lcp.render.grains import A_PARTICLE, GRAINS, grains
from warp_lcp.render.solid_meshes import apart
from warp_lcp.render.sunlight import ACROSS, BEHIND, LIGHT, Sunlight, scattered
from warp_lcp.scene.shapes import BoxTable
from warp_lcp.simulation import Surface

RNG = np.random.default_rng(5519)
WIDTH = 0.01


def test_the_light_and_the_axes_of_its_map_are_orthonormal():
    axes = np.stack([LIGHT, *ACROSS])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-14)


def test_points_behind_an_object_are_in_its_shadow():
    plate = np.stack(
        np.meshgrid(np.arange(0.3, 0.7, WIDTH), [0.5], np.arange(0.3, 0.7, WIDTH)), axis=-1
    ).reshape(-1, 3)
    sun = Sunlight([plate, np.zeros((0, 3))], WIDTH)
    x, z = RNG.uniform(0.0, 1.0, (2, 4000))
    floor = np.stack([x, np.zeros(4000), z], axis=-1)
    light = sun.reaches(floor)
    # Intersection of the ray to the lamp with the plate's plane.
    through = floor + 0.5 / LIGHT[1] * LIGHT
    depth = (0.2 - np.abs(through[:, [0, 2]] - 0.5)).min(axis=1)
    assert (light[depth > 4 * WIDTH] == 0.0).all()
    assert (light[depth < -4 * WIDTH] == 1.0).all()
    assert ((light > 0.0) & (light < 1.0)).any()  # its edge is soft
    # Before the plate, as the plate itself.
    np.testing.assert_array_equal(sun.reaches(plate + 0.1 * LIGHT), 1.0)
    np.testing.assert_array_equal(sun.reaches(plate), 1.0)
    assert (sun.reaches(plate - 2.0 * BEHIND * WIDTH * LIGHT) < 1.0).all()


def test_an_empty_scene_has_no_shadow():
    np.testing.assert_array_equal(Sunlight([], WIDTH).reaches(RNG.uniform(size=(50, 3))), 1.0)


def test_the_floor_shows_the_shadow():
    pytest.importorskip("pyvista")
    block = RNG.uniform([0.4, 0.1, 0.4], [0.6, 0.3, 0.6], (20000, 3))
    mesh, looks = Sunlight([block], WIDTH).floor([1.0, 0.5, 0.8])
    np.testing.assert_allclose(
        np.reshape(mesh.bounds, (3, 2)), [[0.0, 1.0], [-5e-4] * 2, [0.0, 0.8]], atol=1e-6
    )
    assert looks["rgb"]
    dark = mesh["color"][:, 0] < 200
    expected = np.array([0.5, 0.0, 0.5]) - 0.2 / LIGHT[1] * np.array([LIGHT[0], 0.0, LIGHT[2]])
    np.testing.assert_allclose(mesh.points[dark].mean(axis=0)[[0, 2]], expected[[0, 2]], atol=0.02)


def test_points_are_scattered_over_a_mesh_evenly():
    pyvista = pytest.importorskip("pyvista")
    points = scattered(pyvista.Box((0.0, 1.0, 0.0, 0.5, 0.0, 0.5)), 0.02)
    assert len(points) == pytest.approx(2 * 2.5 / 0.02**2, rel=0.01)
    # On its sides.
    assert np.abs(np.abs(points - [0.5, 0.25, 0.25]) - [0.5, 0.25, 0.25]).min(axis=1).max() < 1e-6
    assert (points[:, 0] == 0.0).mean() == pytest.approx(0.1, rel=0.1)
    assert scattered(pyvista.PolyData(), 0.02).shape == (0, 3)


@pytest.mark.parametrize("size", [(1.0, 0.8), (1.0, 0.8, 0.6)])
def test_grains_lie_about_their_particles_and_do_not_leave(size):
    points = np.pad(RNG.uniform(0.0, size, (500, len(size))), ((0, 0), (0, 3 - len(size))))
    at, colors, radius = grains(points, np.full((500, 3), 150.0), 0.02, size)
    assert at.shape == colors.shape == (500 * A_PARTICLE, 3)
    inside = at[:, : len(size)]
    assert (inside >= radius).all()
    assert (inside <= np.array(size) - radius).all()
    assert np.abs(at.reshape(500, -1, 3) - points[:, None]).max() <= max(0.7 * 0.02, radius) + 1e-12
    assert (at[:, len(size) :] == 0.0).all()
    assert colors.mean() == pytest.approx(150.0, rel=0.02)
    assert colors.std() > 5.0
    # Particles of a run change places in their list; the image stays.
    order = RNG.permutation(500)
    again, _, _ = grains(points[order], np.full((500, 3), 150.0), 0.02, size)
    np.testing.assert_array_equal(again.reshape(500, -1, 3), at.reshape(500, -1, 3)[order])


def test_the_number_of_grains_is_bounded():
    many = RNG.uniform(size=(GRAINS // 3, 3))
    assert len(grains(many, np.ones_like(many), 0.01, (1.0, 1.0, 1.0))[0]) == len(many) * 3
    assert len(grains(many[:0], many[:0], 0.01, (1.0, 1.0, 1.0))[0]) == 0


def test_a_surface_is_left_out_where_it_touches_a_solid():
    """Surface left out where it touches a solid.

    A film of liquid lies on a box: its lower side is left out, its upper one stays, and so does the
    rest.
    """
    solid = BoxTable(shape="box", min=[0.0, 0.0, 0.0], max=[1.0, 0.5, 1.0]).to_geometry(Path(), 3)

    def square(y, up):
        corners = [[0, 2, 1], [0, 3, 2]] if up else [[0, 1, 2], [0, 2, 3]]
        return np.array([[0.4, y, 0.4], [0.6, y, 0.4], [0.6, y, 0.6], [0.4, y, 0.6]]), np.array(
            corners
        )

    sides = [square(0.51, False), square(0.54, True), square(0.7, False)]
    points, corners = (
        np.concatenate([p for p, _ in sides]),
        np.concatenate([c + 4 * n for n, (_, c) in enumerate(sides)]),
    )
    left = apart(Surface("surface", points, corners, {}), [(solid, Pose.identity())], 0.1)
    np.testing.assert_array_equal(left.corners, corners[2:])
