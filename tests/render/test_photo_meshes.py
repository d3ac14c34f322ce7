"""Meshes of path-traced pictures, and the view transform.

The tests cover normals, liquid against walls and solids, grains, and convex solids.
"""

import numpy as np
import pytest

from warp_lcp.render.photo.meshes import (
    OVERLAP,
    TOUCHING,
    clipped_convex,
    closed_liquid,
    creased,
    face_normals,
    grain_mesh,
    icosphere,
    outward_hull,
    smooth_normals,
)
from warp_lcp.render.photo.view_transform import MIDDLE_GREY, agx, sigmoid
from warp_lcp.simulation import Surface

SEEDS = range(4)
CUBE = np.stack(np.meshgrid([0.0, 1.0], [0.0, 1.0], [0.0, 1.0], indexing="ij"), axis=-1).reshape(
    -1, 3
)


def volume(points, corners):
    a, b, c = np.moveaxis(np.asarray(points, dtype=np.float64)[corners], 1, 0)
    return np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0


def lattice(count):
    """Return a closed cube of triangles, `count` squares along an edge.

    Corners are counterclockwise seen from outside.
    """
    points, corners, start = [], [], 0
    u, v = np.meshgrid(np.linspace(0, 1, count + 1), np.linspace(0, 1, count + 1), indexing="ij")
    node = np.arange((count + 1) ** 2).reshape(count + 1, count + 1)
    a, b, c, d = (of.ravel() for of in (node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]))
    for axis in range(3):
        for end in (0.0, 1.0):
            side = np.empty((u.size, 3))
            side[:, axis], side[:, (axis + 1) % 3], side[:, (axis + 2) % 3] = (
                end,
                u.ravel(),
                v.ravel(),
            )
            own = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]) + start
            points.append(side)
            corners.append(own if end else own[:, ::-1])
            start += u.size
    points, inverse = np.unique(np.concatenate(points).round(12), axis=0, return_inverse=True)
    return points, inverse.ravel()[np.concatenate(corners)]


def test_agx_follows_its_published_polynomial():
    """AgX transform against its published polynomial.

    Wrensch's fit of Sobotka's curve, whose error is below one percent.
    """
    x = np.linspace(0.0, 1.0, 501)
    published = np.polyval([15.5, -40.14, 31.96, -6.868, 0.4298, 0.1191, -0.00232], x)
    assert np.abs(sigmoid(x) - published).max() < 0.01
    assert sigmoid(np.array([0.0, 1.0])) == pytest.approx([0.0, 1.0], abs=1e-12)


def test_agx_of_greys():
    # Rows of the inset matrix sum to 1 within 1e-3.
    np.testing.assert_allclose(agx(np.full(3, MIDDLE_GREY)), 0.5, atol=1e-3)
    greys = agx(np.logspace(-5, 3, 400)[:, None] * np.ones(3))
    assert (np.diff(greys, axis=0) >= 0.0).all()
    assert np.ptp(greys, axis=1).max() < 5e-3
    assert greys[0].max() < 0.01 and greys[-1].min() > 0.99
    # Without NaN.
    assert (
        agx(np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), contrast=1.6, saturation=1.3).max()
        < 1e-6
    )


def test_agx_turns_bright_colors_white_and_keeps_dim_ones():
    red = np.array([1.0, 0.02, 0.02])
    dim, bright = agx(0.18 * red), agx(200.0 * red)
    assert dim[0] - dim[1] > 0.3
    assert bright.min() > 0.6 and bright[0] - bright[1] < 0.4
    assert (agx(0.1 * red, contrast=1.5) < agx(0.1 * red)).all()
    more, less = agx(0.18 * red, saturation=1.3), agx(0.18 * red, saturation=0.7)
    assert np.ptp(more) > np.ptp(dim) > np.ptp(less)


def test_creases_stay_sharp_and_round_sides_smooth():
    points, corners = CUBE, outward_hull(CUBE)
    at, own, normals = creased(points, corners)
    flat = face_normals(at, own)
    np.testing.assert_allclose(
        normals,
        np.repeat(flat / np.linalg.norm(flat, axis=1, keepdims=True), 3, axis=0),
        atol=1e-12,
    )
    assert volume(at, own) == pytest.approx(1.0)
    points, corners = icosphere(2)
    at, _, normals = creased(points, corners)
    assert np.einsum("ij,ij->i", at, normals).min() > 0.99
    np.testing.assert_allclose(smooth_normals(points, corners), points, atol=0.1)


def test_a_liquid_is_flat_at_walls_and_reaches_below_the_floor():
    points, corners = lattice(4)
    surface = Surface("surface", points, corners, {"velocity": np.ones_like(points)})
    # The side z = 1 is free.
    at, own, normals, velocity = closed_liquid(surface, (1.0, 1.0, 2.0), 0.25, None)
    floor = -OVERLAP * 0.25
    assert volume(at, own) == pytest.approx(1.0 - floor)
    assert at[:, 1].min() == pytest.approx(floor)
    free = at[:, 2] > 1.0 - 1e-9
    for axis, end in ((0, 0.0), (0, 1.0), (1, floor), (1, 1.0), (2, 0.0)):
        wall = np.abs(at[:, axis] - end) < 1e-9
        outward = np.eye(3)[axis] * (1.0 if end > 0.5 else -1.0)
        assert (normals[wall & ~free] @ outward > 1.0 - 1e-9).any()
        np.testing.assert_array_equal(velocity[wall, axis], 0.0)
    facets = face_normals(at, own)
    facets /= np.linalg.norm(facets, axis=1, keepdims=True)
    # No normal is bent at an edge.
    np.testing.assert_allclose(np.einsum("ijk,ik->ij", normals[own], facets), 1.0, atol=1e-9)
    assert velocity[free & (at[:, 0] > 0.1) & (at[:, 0] < 0.9)][:, 0].all()


@pytest.mark.parametrize("seed", SEEDS)
def test_a_liquid_is_pressed_against_what_it_touches(seed):
    rng = np.random.default_rng(seed)
    spacing, center, radius = (
        0.1,
        rng.uniform([0.4, 0.4, 0.95], [0.6, 0.6, 1.15]),
        rng.uniform(0.15, 0.3),
    )

    def distance(p):
        return np.linalg.norm(p - center, axis=1) - radius

    points, corners = lattice(12)
    before = np.array(points)
    gap = center[2] - radius - 1.0  # between the side z = 1 and the nearest point of the ball
    # The side comes within half a spacing of the ball, or into it.
    points[:, 2] *= 1.0 + gap - rng.uniform(0.0, 0.5) * spacing
    surface = Surface("surface", points, corners)
    at, _, _, _ = closed_liquid(surface, (2.0, 2.0, 2.0), spacing, distance)
    d_before, d = distance(points), distance(at)
    touched = (
        (np.abs(d_before) < TOUCHING * spacing)
        & (before[:, 2] == 1.0)
        & (d_before > -OVERLAP * spacing)
    )
    facing = touched & (
        ((points - center) / np.linalg.norm(points - center, axis=1, keepdims=True))[:, 2] < -0.4
    )
    assert facing.any()
    for p in points[facing]:  # each has moved along the ball's normal to the overlap
        goal = center + (p - center) / np.linalg.norm(p - center) * (radius - OVERLAP * spacing)
        assert np.linalg.norm(at - goal, axis=1).min() < 0.02 * spacing
    far = d_before > TOUCHING * spacing
    # The points of the floor move.
    assert all(np.linalg.norm(at - p, axis=1).min() < OVERLAP * spacing + 1e-9 for p in points[far])
    assert d.min() > -(OVERLAP + 0.6) * spacing


@pytest.mark.parametrize("seed", SEEDS)
def test_convex_solids_are_cut_at_the_box(seed):
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(2, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rows = np.column_stack([normals, -normals @ rng.uniform(0.4, 0.6, 3)])
    points, corners = clipped_convex(rows, np.zeros(3), np.ones(3))
    samples = (np.stack(np.meshgrid(*[np.arange(60)] * 3), axis=-1).reshape(-1, 3) + 0.5) / 60.0
    inside = (samples @ normals.T + rows[:, 3] <= 0.0).all(axis=1).mean()
    assert volume(points, corners) == pytest.approx(inside, abs=0.01)
    assert clipped_convex(np.array([[1.0, 0.0, 0.0, 0.1]]), np.zeros(3), np.ones(3)) is None


@pytest.mark.parametrize("rounds", [0, 1])
def test_grains_are_closed_irregular_and_determined_by_their_seeds(rounds):
    centers = 3.0 * CUBE
    points, corners, own = grain_mesh(centers, 0.1, np.arange(8), rounds)
    assert points.dtype == np.float32 and len(corners) == 8 * 20 * 4**rounds
    np.testing.assert_array_equal(np.unique(own, return_counts=True)[1], len(points) // 8)
    reach = np.linalg.norm(points - centers[own], axis=1)
    assert reach.min() > 0.03 and reach.max() < 0.3
    volumes = [
        volume(points - centers[grain], corners[own[corners[:, 0]] == grain]) for grain in range(8)
    ]
    assert min(volumes) > 0.0 and np.ptp(volumes) > 0.1 * np.mean(volumes)
    edges = np.sort(
        np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1
    )
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    again = grain_mesh(centers[::-1], 0.1, np.arange(8)[::-1], rounds)[0].reshape(8, -1, 3)[::-1]
    np.testing.assert_array_equal(again.reshape(-1, 3), points)
