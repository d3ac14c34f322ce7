"""Water drawn over an image, where geometry and optics tell what must be seen. Needs no display and no pyvista."""

import numpy as np
import pytest

from small_runs import ball, box, sphere
from warp_lcp.render import water
from warp_lcp.render.water import ABSORPTION, draw_water, vertex_normals
from warp_lcp.scene.camera import Viewpoint
from warp_lcp.simulation import Surface

WIDTH, HEIGHT = 160, 120
LIGHT = np.array([0.0, 1.0, 0.0])
VIEW = Viewpoint(np.array([0.0, 0.0, 10.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]), 25.0, WIDTH / HEIGHT)


def scene(color=(255, 255, 255), depth=np.inf):
    return np.full((HEIGHT, WIDTH, 3), color, dtype=np.uint8), np.full((HEIGHT, WIDTH), depth)


def drawn(surface, image, depth, size=1.0, view=VIEW):
    return draw_water(surface, image, depth, view, size=size, light=LIGHT).astype(int)


def test_the_sphere_of_these_tests_faces_outward():
    points, corners = sphere()
    assert np.linalg.det(points[corners]).sum() / 6 == pytest.approx(4 / 3 * np.pi, rel=0.01)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1.0)


def test_normals_of_a_sphere():
    points, corners = sphere()
    np.testing.assert_allclose((vertex_normals(points, corners) * points).sum(axis=1), 1.0, atol=1e-3)


def test_water_covers_what_a_ball_covers():
    image, depth = scene()
    changed = (drawn(ball([0.4, 0.3, 0.0], 1.0), image, depth) != 255).any(axis=-1)
    pixel = 10.0 * 2.0 * VIEW.slope / HEIGHT  # [m] at the ball's middle
    assert changed.sum() * pixel**2 == pytest.approx(np.pi, rel=0.03)  # a little larger, for it is seen from near
    row, column = np.argwhere(changed).mean(axis=0) + 0.5
    assert column == pytest.approx(WIDTH / 2 + 0.4 / pixel, abs=1.0)
    assert row == pytest.approx(HEIGHT / 2 - 0.3 / pixel, abs=1.0)


def test_nothing_changes_without_water_or_behind_what_is_opaque():
    image, depth = scene((10, 120, 240), 8.0)  # a wall before the ball
    np.testing.assert_array_equal(drawn(ball([0.0, 0.0, 0.0], 1.0), image, depth), image)
    image, depth = scene((10, 120, 240))
    nothing = Surface("surface", np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32))
    np.testing.assert_array_equal(drawn(nothing, image, depth), image)
    behind = Viewpoint(np.array([0.0, 0.0, 10.0]), np.array([0.0, 0.0, 20.0]), np.array([0.0, 1.0, 0.0]), 25.0, WIDTH / HEIGHT)
    np.testing.assert_array_equal(drawn(ball([0.0, 0.0, 0.0], 1.0), image, depth, view=behind), image)


def test_light_fades_with_the_way_through_the_water(monkeypatch):
    """Through the middle of a slab, away from its color and what it mirrors, the law of Beer and Lambert."""
    monkeypatch.setattr(water, "DEEP", np.zeros(3))
    linear = {}
    for thickness in (0.02, 0.04):
        image, depth = scene((255, 255, 255), 10.5)
        middle = drawn(box([-1.0, -1.0, -thickness], [1.0, 1.0, 0.0]), image, depth)[HEIGHT // 2, WIDTH // 2]
        linear[thickness] = (middle / 255.0) ** 2
    mirrored = 0.04  # of the light, at normal incidence: the same for both
    ratio = (linear[0.04] - mirrored * 0.1) / (linear[0.02] - mirrored * 0.1)
    np.testing.assert_allclose(ratio, np.exp(-ABSORPTION * 0.02), atol=0.05)


def test_what_lies_in_the_water_shortens_the_way():
    image, depth = scene((255, 255, 255), 10.5)
    surface = box([-1.0, -1.0, -0.4], [1.0, 1.0, 0.0])
    bottom = drawn(surface, image, depth)[HEIGHT // 2, WIDTH // 2]
    near = drawn(surface, image, np.full_like(depth, 10.05))[HEIGHT // 2, WIDTH // 2]
    assert near[0] > bottom[0] + 60  # less red is lost


def test_water_behind_water_is_seen():
    image, depth = scene((255, 255, 255), 12.0)
    sheet, wall = box([-1.0, -1.0, 0.0], [1.0, 1.0, 0.01]), box([-1.0, -1.0, -1.5], [1.0, 1.0, -0.5])
    both = Surface(
        "surface", np.concatenate([sheet.points, wall.points]), np.concatenate([sheet.corners, wall.corners + len(sheet.points)])
    )
    middle = HEIGHT // 2, WIDTH // 2
    alone, together = drawn(sheet, image, depth)[middle], drawn(both, image, depth)[middle]
    assert together[0] < alone[0] - 80


def test_a_bent_ray_sees_what_straight_ones_do_not():
    """Looking down at an angle on a pool, a stripe on its floor appears nearer to the surface: shifted up, as Snell's law has it."""
    view = Viewpoint(np.array([0.0, 5.0, 5.0]), np.zeros(3), np.array([0.0, 1.0, -1.0]) / np.sqrt(2.0), 25.0, WIDTH / HEIGHT)
    pool = box([-2.0, -0.2, -2.0], [2.0, 0.0, 2.0])
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    slope = 2.0 * view.slope / HEIGHT
    through = np.stack([(x - WIDTH / 2) * slope, (HEIGHT / 2 - y) * slope, np.ones_like(x)], axis=-1) @ view.axes
    floor = (-0.2 - 5.0) / through[..., 1]  # depth of the pool's floor
    z = 5.0 + floor * through[..., 2]
    image = np.where((np.abs(z + 0.0) < 0.05)[..., None], 0, 255).repeat(3, axis=-1).astype(np.uint8)
    before = np.argwhere(image[:, WIDTH // 2, 2] == 0).mean()
    seen = drawn(pool, image, floor, size=100.0, view=view)[:, WIDTH // 2, 2]
    after = np.argwhere(seen < seen.min() + 40).mean()
    angle = np.arcsin(np.sin(np.pi / 4) / 1.333)
    shift = 0.2 * (1.0 - np.tan(angle))  # along the surface [m]: where the bent ray enters, compared with the straight one
    pixels = shift * np.cos(np.pi / 4) / (np.hypot(5.0, 5.0) * slope)
    assert before - after == pytest.approx(pixels, abs=1.5)
