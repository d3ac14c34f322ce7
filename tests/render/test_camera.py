"""Table [camera] of a scene and its camera."""

import numpy as np
import pytest

from small_runs import write_run
from warp_lcp.run.continuation import Change, change_of
from warp_lcp.scene.camera import MARGIN, Viewpoint, viewpoint
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.table import SceneError


@pytest.fixture
def scene(dots, tmp_path):
    def load(text, size=(2.0, 1.0, 1.0)):
        return load_scene(
            write_run(tmp_path / f"run{len(list(tmp_path.iterdir()))}", [], text, size)
            / "scene.toml"
        )

    return load


@pytest.mark.parametrize(
    ("text", "size", "message"),
    [
        (
            "position = [1.0, 2.0]",
            (2.0, 1.0, 1.0),
            "camera.position = [1.0, 2.0]: must have 3 entries",
        ),
        (
            "position = [1.0, 0.5, 0.5]",
            (2.0, 1.0, 1.0),
            "camera.position = [1.0, 0.5, 0.5]: must not be the point that the camera looks at",
        ),
        (
            "position = [1.0, 0.5, 5.0]\nup = [0.0, 0.0, 2.0]",
            (2.0, 1.0, 1.0),
            "camera.up = [0.0, 0.0, 2.0]: must not be zero or the direction",
        ),
        (
            "position = [1.0, 0.5, 5.0]\nup = [0.0, 0.0, 0.0]",
            (2.0, 1.0, 1.0),
            "must not be zero or the direction",
        ),
        ("position = [1.0, 5.0, 0.5]", (2.0, 1.0, 1.0), "camera.up: must be given"),
        (
            "look_at = [1.0, 0.5, 5.0]",
            (2.0, 1.0, 1.0),
            "camera.look_at = [1.0, 0.5, 5.0]: needs camera.position",
        ),
        ("field_of_view = 0.1", (2.0, 1.0, 1.0), "camera.field_of_view = 0.1: must be at least 1"),
        (
            "min = [0.0, 0.0]",
            (2.0, 1.0, 1.0),
            "camera.min = [0.0, 0.0]: cannot be used in 3-D; allowed are position, look_at",
        ),
        (
            "position = [1.0, 2.0]",
            (2.0, 1.0),
            "camera.position = [1.0, 2.0]: cannot be used in 2-D; allowed are min, max",
        ),
        (
            "min = [0.5, 0.5]\nmax = [0.4, 1.0]",
            (2.0, 1.0),
            "camera.max = [0.4, 1.0]: min = [0.5, 0.5] must be less than max",
        ),
        (
            "min = [2.5, 0.5]",
            (2.0, 1.0),
            "camera.min = [2.5, 0.5]: min = [2.5, 0.5] must be less than max = [2.0, 1.0]",
        ),
        ("target = [0.0, 0.0, 0.0]", (2.0, 1.0, 1.0), "camera.target: unknown key"),
    ],
)
def test_wrong_cameras(scene, text, size, message):
    with pytest.raises(SceneError) as caught:
        scene(f"[camera]\n{text}\n", size)
    assert message in str(caught.value)


def project(view, points, size):
    """Return the images of points [m] in a pinhole camera, and their depths [m].

    x points to the right and y down from the upper left corner [pixels].
    """
    width, height = size
    x, y, depth = ((points - view.position) @ view.axes.T).T
    focal = 0.5 * height / np.tan(np.radians(view.angle / 2))
    return np.stack(
        [0.5 * width + focal * x / depth, 0.5 * height - focal * y / depth, depth], axis=-1
    )


def test_a_run_may_go_on_with_another_camera():
    assert change_of("camera.position") is Change.SAME_STEPS


def test_points_appear_where_a_pinhole_has_them():
    view = Viewpoint(np.array([0.0, 0.0, 4.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]), 90.0, 2.0)
    points = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 2.0, 0.0], [1.0, -1.0, 2.0]])
    expected = [[200.0, 100.0, 4.0], [300.0, 100.0, 4.0], [200.0, 50.0, 4.0], [250.0, 150.0, 2.0]]
    np.testing.assert_allclose(project(view, points, (400, 200)), expected, atol=1e-12)


def test_the_camera_of_a_scene(scene):
    view = viewpoint(
        scene(
            "[camera]\nposition = [1.0, 3.0, 6.0]\nlook_at = [1.0, 0.0, 0.5]\nfield_of_view = "
            "40.0\n"
        ),
        1.5,
    )
    np.testing.assert_allclose(view.position, [1.0, 3.0, 6.0])
    np.testing.assert_allclose(view.axes @ view.axes.T, np.eye(3), atol=1e-12)
    # To the right for a view along -z.
    np.testing.assert_allclose(view.axes[0], [1.0, 0.0, 0.0], atol=1e-12)
    assert view.axes[1, 1] > 0.5
    np.testing.assert_allclose(
        project(view, np.array([[1.0, 0.0, 0.5]]), (300, 200))[0, :2], [150.0, 100.0]
    )
    tilted = viewpoint(scene("[camera]\nposition = [1.0, 0.5, 6.0]\nup = [1.0, 0.0, 0.0]\n"), 1.5)
    np.testing.assert_allclose(tilted.axes[0], [0.0, -1.0, 0.0], atol=1e-12)


@pytest.mark.every_case
@pytest.mark.parametrize("aspect", [0.1, 0.5, 1.0, 3.0, 10.0])
@pytest.mark.parametrize("size", [(2.0, 1.0, 1.0), (0.5, 1.0, 0.4), (2.0, 1.0)])
def test_the_automatic_camera_shows_the_whole_domain_and_no_more_than_it_must(scene, size, aspect):
    view = viewpoint(scene("", size), aspect)
    corners = np.stack(np.meshgrid(*([0.0, side] for side in [*size, 0.0][:3])), axis=-1).reshape(
        -1, 3
    )
    x, y, depth = project(view, corners, (round(1000 * aspect), 1000)).T
    assert (depth > 0).all()
    shares = np.array(
        [
            x.min() / (1000 * aspect),
            1 - x.max() / (1000 * aspect),
            y.min() / 1000,
            1 - y.max() / 1000,
        ]
    )
    assert shares.min() == pytest.approx(0.5 - 0.5 / MARGIN, abs=2e-3)


def test_a_window_of_a_flat_scene(scene):
    view = viewpoint(scene("[camera]\nmin = [0.5, 0.2]\nmax = [1.0, 0.4]\n", (2.0, 1.0)), 2.5)
    low, high = project(view, np.array([[0.5, 0.2, 0.0], [1.0, 0.4, 0.0]]), (500, 200))[:, :2]
    assert 0 < low[0] < high[0] < 500
    assert 0 < high[1] < low[1] < 200
    assert high[0] - low[0] == pytest.approx(500 / MARGIN)
