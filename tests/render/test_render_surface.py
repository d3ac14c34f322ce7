"""Images of surfaces and bodies; tests without pyvista are skipped."""

import numpy as np
import pytest

from command_line import invoke
from small_runs import ball, box, sphere, write_run
from warp_lcp.render.actors import is_round, surface_meshes
from warp_lcp.render.image_content import Color, RenderError, VisiblePart
from warp_lcp.render.recording import Recording
from warp_lcp.render.render import ImageStyle, render_run
from warp_lcp.render.solid_meshes import prescribed_solids
from warp_lcp.scene.camera import MARGIN
from warp_lcp.simulation import Points, Surface

ROOM = (1.0, 1.0, 1.0)
PARTICLE = Points(
    "particles",
    np.array([[0.1, 0.1, 0.0]], dtype=np.float32),
    {"velocity": np.array([[1.0, 0.0, 0.0]], dtype=np.float32)},
)
SIZE = (400, 300)
TURN = np.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]], dtype=np.float32)


def pixels(path) -> np.ndarray:
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image, dtype=int)[20:]  # without the line with the time


def draw(folder, **looks) -> list[np.ndarray]:
    return [pixels(path) for path in render_run(folder, looks=ImageStyle(size=SIZE, **looks))]


def is_blue(image):
    return image[..., 2] - image[..., 0] > 50


def is_orange(image):
    return image[..., 0] - image[..., 2] > 50


def middle(mask, folder, page_line=20):
    """Return the mean position of a 2-D image's pixels [m].

    The domain has sides of 1 m; its height limits the image.
    """
    rows, columns = np.nonzero(mask)
    pixel = MARGIN / mask.shape[0]
    return (columns.mean() + 0.5 - SIZE[0] / 2) * pixel + 0.5, (
        mask.shape[0] / 2 - rows.mean() - 0.5
    ) * pixel + 0.5


def test_outlines_are_filled_inside_and_islands_left_out(pyvista, dots, tmp_path):
    outer, inner = ball([0.5, 0.5], 0.35), ball([0.55, 0.52], 0.15)
    both = Surface(
        "surface",
        np.concatenate([outer.points, inner.points]),
        np.concatenate([outer.corners, inner.corners[:, ::-1] + len(outer.points)]),
    )
    (image,) = draw(write_run(tmp_path / "run", [[both]]))
    mask = is_blue(image)
    pixel = MARGIN / image.shape[0]
    assert mask.sum() * pixel**2 == pytest.approx(np.pi * (0.35**2 - 0.15**2), rel=0.05)
    assert not mask[round(image.shape[0] / 2 - 0.02 / pixel), round(SIZE[0] / 2 + 0.05 / pixel)]


def test_the_surface_is_shown_where_there_is_one(dots, tmp_path):
    both = write_run(tmp_path / "both", [[PARTICLE, ball([0.5, 0.5], 0.2)]])
    alone = write_run(tmp_path / "alone", [[PARTICLE]])
    assert Recording(both).show is VisiblePart.SURFACE
    assert (
        Recording(both, Color.SPEED).show is VisiblePart.PARTICLES
    )  # colors are those of particles
    assert Recording(alone).show is VisiblePart.PARTICLES
    assert len(Recording(both).frame(0).points) == 0
    assert Recording(both, show=VisiblePart.BOTH).frame(0).surface is not None
    with pytest.raises(RenderError, match="--color speed is for particles"):
        Recording(both, Color.SPEED, VisiblePart.SURFACE)
    with pytest.raises(RenderError, match="holds no frames of a surface"):
        Recording(alone, show=VisiblePart.SURFACE)
    with pytest.raises(RenderError, match="holds no frames of a surface"):
        Recording(alone, show=VisiblePart.BOTH)


def test_surfaces_come_back_as_they_were_written(dots, tmp_path):
    surface = ball([0.5, 0.4, 0.3], 0.2)
    surface.points[7] = np.nan
    # A NaN that raises "invalid" when it is converted.
    surface.points[7:8].view(np.uint32)[0, 0] = 0x7FA00000
    read = Recording(write_run(tmp_path / "run", [[surface]], size=ROOM)).frame(0).surface
    whole = ~(surface.corners == 7).any(axis=1)
    np.testing.assert_array_equal(read.corners, surface.corners[whole])
    assert np.isfinite(read.points).all()


def test_a_flat_surface_is_filled(pyvista, dots, tmp_path):
    folder = write_run(
        tmp_path / "run", [[PARTICLE, ball([0.4, 0.3], 0.2)], [PARTICLE, ball([0.6, 0.7], 0.1)]]
    )
    for image, center, radius in zip(
        draw(folder), ([0.4, 0.3], [0.6, 0.7]), (0.2, 0.1), strict=True
    ):
        mask = is_blue(image)
        assert mask.sum() * (MARGIN / image.shape[0]) ** 2 == pytest.approx(
            np.pi * radius**2, rel=0.05
        )
        np.testing.assert_allclose(middle(mask, folder), center, atol=0.01)
        top, bottom = np.nonzero(mask)[0].min() + 6, np.nonzero(mask)[0].max() - 6
        column = round(np.nonzero(mask)[1].mean())
        assert image[top, column].sum() > image[bottom, column].sum()  # deeper in color below


def test_flat_solids_cover_the_surface(pyvista, dots, tmp_path):
    text = '[[solid]]\nshape = "box"\nmin = [0.0, 0.0]\nmax = [0.5, 1.0]\n'
    image = draw(write_run(tmp_path / "run", [[ball([0.5, 0.5], 0.3)]], text))[0]
    mask = is_blue(image)
    assert mask.sum() * (MARGIN / image.shape[0]) ** 2 == pytest.approx(
        np.pi * 0.3**2 / 2, rel=0.05
    )


def test_flat_bodies_are_where_their_outlines_are(pyvista, dots, tmp_path):
    frames = [[PARTICLE, ball([x, 0.6], 0.15, "bodies", body=2)] for x in (0.3, 0.5, 0.8)]
    folder = write_run(tmp_path / "run", frames)
    for image, x in zip(draw(folder), (0.3, 0.5, 0.8), strict=True):
        mask = is_orange(image)
        np.testing.assert_allclose(middle(mask, folder), [x, 0.6], atol=0.01)
        assert mask.sum() * (MARGIN / image.shape[0]) ** 2 == pytest.approx(
            np.pi * 0.15**2, rel=0.08
        )


def test_bodies_have_colors_of_their_own_in_every_frame(pyvista, dots, tmp_path):
    one, two = (
        ball([0.3, 0.5, 0.5], 0.15, "bodies", body=1),
        ball([0.7, 0.5, 0.5], 0.15, "bodies", body=4),
    )
    pair = Surface(
        "bodies",
        np.concatenate([one.points, two.points]),
        np.concatenate([one.corners, two.corners + len(one.points)]),
        {"body": np.concatenate([one.fields["body"], two.fields["body"]])},
    )
    text = "[camera]\nposition = [0.5, 0.5, 5.0]\nlook_at = [0.5, 0.5, 0.5]\n"
    first, again = draw(
        write_run(tmp_path / "run", [[PARTICLE, pair], [PARTICLE, pair]], text, ROOM)
    )
    np.testing.assert_array_equal(first, again)
    colored = np.ptp(first, axis=-1) > 40
    left, right = first[:, :200][colored[:, :200]], first[:, 200:][colored[:, 200:]]
    assert len(left) == pytest.approx(len(right), rel=0.2)  # one particle is on the left
    assert np.abs(left.mean(axis=0) - right.mean(axis=0)).max() > 20


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_ball_that_turns_looks_otherwise_and_fills_the_same_place(
    pyvista, dots, tmp_path, dimension
):
    still = ball([0.5] * dimension, 0.2, "bodies", body=1)
    turned = Surface(
        "bodies", (still.points - 0.5) @ TURN + np.float32(0.5), still.corners, still.fields
    )
    if dimension == 2:
        turned.points[:, 2] = 0.0
    text, size = (
        ("[camera]\nposition = [0.5, 0.5, 5.0]\n", ROOM) if dimension == 3 else ("", (1.0, 1.0))
    )
    far = Points("particles", PARTICLE.points * np.float32(0.1), PARTICLE.fields)
    first, second, third = draw(
        write_run(tmp_path / "run", [[far, still], [far, turned], [far, still]], text, size)
    )
    np.testing.assert_array_equal(first, third)
    assert (np.abs(first - second).max(axis=-1) > 20).sum() > 60
    assert is_orange(first).sum() == pytest.approx(is_orange(second).sum(), rel=0.1)


def test_round_bodies_are_recognized():
    for points, corners in (
        sphere(),
        (ball([0.4, 0.6], 0.1).points, ball([0.4, 0.6], 0.1).corners),
    ):
        assert is_round(points, corners)
        assert not is_round(points * [1.0, 1.1, 1.0], corners)
    cube = box([0.0, 0.0, 0.0], [1.0, 1.0, 1.0])
    points, corner = np.unique(cube.points, axis=0, return_inverse=True)
    assert not is_round(points, corner.ravel()[cube.corners])


@pytest.mark.slow
def test_solids_with_mass_do_not_stand_where_they_began(pyvista, dots, tmp_path):
    disc = '[[solid]]\nshape = "sphere"\ncenter = [0.25, 0.5]\nradius = 0.1\n'
    wall = '[[solid]]\nshape = "box"\nmin = [0.9, 0.0]\nmax = [1.0, 0.2]\n'
    for number, (key, count) in enumerate((("", 2), ("mass = 2.0\n", 1), ("density = 500.0\n", 1))):
        frame = [PARTICLE, ball([0.6, 0.6], 0.1, "bodies", body=1)]
        folder = write_run(tmp_path / str(number), [frame], f"{disc}{key}{wall}")
        assert len(prescribed_solids(Recording(folder).scene)) == count
        (image,) = draw(folder)
        gray = (np.ptp(image, axis=-1) < 16) & (image[..., 0] > 150) & (image[..., 0] < 230)
        # The domain's edges are gray too.
        assert (gray[:, : SIZE[0] // 2].sum() > 2000) == (count == 2)
        assert gray[:, SIZE[0] // 2 :].sum() > 300


def test_water_in_a_room_shows_what_is_in_it(pyvista, dots, tmp_path):
    """Transparent water in a room.

    The ball of water is blue, the body in it is visible, and so are particles if both are
    requested.
    """
    swimmer = ball([0.5, 0.5, 0.5], 0.2, "bodies", body=1)
    text = "[camera]\nposition = [0.5, 0.5, 5.0]\n"
    water = write_run(tmp_path / "water", [[PARTICLE, ball([0.5, 0.5, 0.5], 0.3)]], text, ROOM)
    with_body = write_run(
        tmp_path / "body", [[PARTICLE, ball([0.5, 0.5, 0.5], 0.3), swimmer]], text, ROOM
    )
    (plain,), (swum,) = draw(water), draw(with_body)
    assert is_blue(plain).sum() > 2000
    assert (plain != swum).any(axis=-1).sum() > 200
    assert is_blue(plain)[plain.shape[0] // 2, SIZE[0] // 2]
    # Orange, dimmed.
    assert (
        swum[swum.shape[0] // 2, SIZE[0] // 2, 0] > plain[plain.shape[0] // 2, SIZE[0] // 2, 0] + 30
    )
    many = Points(
        "particles",
        np.tile([[0.1, 0.8, 0.5]], (5, 1)).astype(np.float32),
        {"velocity": np.zeros((5, 3), dtype=np.float32)},
    )
    folder = write_run(tmp_path / "both", [[many, ball([0.5, 0.5, 0.5], 0.3)]], text, ROOM)
    (both,), (surface,) = (
        draw(folder, show=VisiblePart.BOTH),
        draw(folder, show=VisiblePart.SURFACE),
    )
    assert (both != surface).any(axis=-1)[:120, :200].sum() > 8


def test_empty_surfaces_and_frames_without_bodies(pyvista, dots, tmp_path):
    nothing = Surface(
        "surface", np.zeros((0, 3), dtype=np.float32), np.zeros((0, 3), dtype=np.int32)
    )
    folder = write_run(
        tmp_path / "run",
        [[ball([0.5, 0.5, 0.5], 0.3)], [nothing]],
        "[camera]\nposition = [0.5, 0.5, 5.0]\n",
        ROOM,
    )
    some, none = draw(folder)
    assert is_blue(some).sum() > 2000
    assert is_blue(none).sum() == 0


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--show", "surface", "--color", "speed"], "--color speed is for particles"),
        (["--set", "time.duration=3"], "--set time.duration=3: only keys of [camera]"),
        (
            ["--set", "camera.position=[0.5, 0.5, 0.5]"],
            "must not be the point that the camera looks at",
        ),
        (["--set", "camera.zoom=2"], "camera.zoom: unknown key"),
        (["--at", "0.5"], "--at: needs --slice"),
        (["--fps", "10"], "--fps: needs --film"),
        (["--show", "cells"], "--show"),
    ],
)
def test_wrong_input_exits_with_2(pyvista, dots, tmp_path, arguments, expected):
    folder = write_run(tmp_path / "run", [[PARTICLE, ball([0.5, 0.5, 0.5], 0.3)]], size=ROOM)
    result = invoke("render", folder, *arguments)
    assert result.exit_code == 2
    assert expected in result.stderr.replace("\n", " ")
    assert "Traceback" not in result.stderr
    assert not (folder / "images").exists()


def test_a_camera_from_the_command_line(pyvista, dots, tmp_path):
    folder = write_run(tmp_path / "run", [[ball([0.2, 0.5, 0.5], 0.1)]], size=ROOM)
    seen = []
    for number, look_at in enumerate(("[0.2, 0.5, 0.5]", "[0.8, 0.5, 0.5]")):
        out = tmp_path / str(number)
        settings = ["camera.position=[0.5, 0.5, 4.0]", f"camera.look_at={look_at}"]
        result = invoke(
            "render",
            folder,
            "--out",
            out,
            "--size",
            "400x300",
            *(word for text in settings for word in ("--set", text)),
        )
        assert result.exit_code == 0
        seen.append(np.nonzero(is_blue(pixels(out / "frame_000000.png")))[1].mean())
    assert seen[0] == pytest.approx(200, abs=3)
    assert seen[1] < 150


def test_each_side_of_the_domain_has_its_own_part_of_a_surface():
    """Separate parts of a surface on each side of the domain.

    Shared normals would smear light over the edges between walls, and between a wall and the free
    surface.
    """
    pytest.importorskip("pyvista")
    pool = box([0.0, 0.0, 0.0], [1.0, 0.4, 1.0])
    pool = Surface("surface", *welded(pool.points, pool.corners), {})
    parts = [mesh for mesh, _ in surface_meshes(pool, "water", (1.0, 1.0, 1.0), 1.0)]
    assert sum(mesh.n_cells for mesh in parts) == len(pool.corners)
    spans = sorted(
        tuple(np.ptp(mesh.points, axis=0).astype(float).round(3).tolist()) for mesh in parts
    )
    assert spans == [
        (0.0, 0.4, 1.0),
        (0.0, 0.4, 1.0),
        (1.0, 0.0, 1.0),
        (1.0, 0.0, 1.0),
        (1.0, 0.4, 0.0),
        (1.0, 0.4, 0.0),
    ]


def welded(points, corners):
    """Return a mesh whose triangles share points at the same place."""
    own, number = np.unique(points, axis=0, return_inverse=True)
    return own, number.ravel()[corners].astype(np.int32)
