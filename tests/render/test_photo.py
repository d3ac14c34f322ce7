"""Path-traced pictures of a run: description, camera, settings and files.

Tests that need Mitsuba are skipped where it is missing.
"""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from small_runs import ball, box, write_run
from warp_lcp.cli import commands as cli
from warp_lcp.render.image_content import RenderError, VisiblePart
from warp_lcp.render.photo import photo
from warp_lcp.render.photo.mitsuba_renderer import (
    INSTALL,
    PASS_PATHS,
    Quality,
    displaced,
    find_llvm,
    pass_samples,
    render_radiance,
)
from warp_lcp.render.photo.photo import (
    PhotoSettings,
    expected_seconds,
    frame_range,
    photograph_film,
    photograph_run,
)
from warp_lcp.render.photo.photo_scene import (
    ABSORPTION,
    PhotoScenes,
    SurfaceFinish,
    grain_colors,
    linear_color,
    liquid_absorption,
    particle_surface,
    rigid_pose,
)
from warp_lcp.render.recording import Recording
from warp_lcp.simulation import Points, Surface

ROOM = (1.0, 1.0, 1.0)
SETTINGS = PhotoSettings(size=(64, 36), samples=4)
BODY = '[[solid]]\nshape = "sphere"\ncenter = [0.3, 0.5, 0.4]\nradius = 0.2\ndensity = 500.0\n'
BLOCK = '[[solid]]\nshape = "box"\nmin = [0.7, 0.0, -0.5]\nmax = [1.5, 0.2, 0.4]\n'


def water() -> Surface:
    return box([0.0, 0.0, 0.0], [1.0, 0.4, 1.0])


def grains(count: int = 300) -> Points:
    points = (
        np.random.default_rng(3)
        .uniform([0.2, 0.02, 0.2], [0.8, 0.4, 0.8], (count, 3))
        .astype(np.float32)
    )
    return Points(
        "particles", points, {"velocity": np.full((count, 3), [0.0, -1.0, 0.0], dtype=np.float32)}
    )


@pytest.fixture
def rendered(monkeypatch):
    """Replace the renderer by one that gives uniform gray; list its frames."""
    pytest.importorskip("PIL.Image", reason="pictures need Pillow")
    numbers = []

    def render(scene, quality, number, variant):
        numbers.append(number)
        return np.full((quality.size[1], quality.size[0], 3), 0.18 / photo.EXPOSURE)

    monkeypatch.setattr(photo, "render_radiance", render)
    monkeypatch.setattr(photo, "load_renderer", lambda: None)
    monkeypatch.setattr(photo, "choose_variant", lambda: "scalar_rgb")
    return numbers


def test_pictures_with_the_same_settings_are_kept(dots, tmp_path, rendered):
    folder = write_run(tmp_path / "run", [[water()], [water()], [water()]], size=ROOM)
    notes: list[str] = []

    def shoot(**more):
        rendered.clear(), notes.clear()
        return list(
            photograph_run(
                folder, settings=PhotoSettings(size=(64, 36), **more), noted=notes.append
            )
        )

    files = shoot(samples=4)
    assert [file.name for file in files] == [
        f"photo_{number:06d}.png" for number in range(3)
    ] and rendered == [0, 1, 2]
    files[1].unlink()  # as if it had been stopped
    files[2].write_bytes(files[2].read_bytes()[:100])
    shoot(samples=4)
    assert rendered == [1, 2] and notes == [
        "1 of 3 pictures are there with these settings and are kept"
    ]
    shoot(samples=8)
    assert rendered == [0, 1, 2] and notes == [
        "3 pictures have another samples and are rendered again"
    ]
    frame = folder / "frames" / "surface_000002.vtu"
    frame.write_bytes(
        (folder / "frames" / "surface_000001.vtu").read_bytes().replace(b"\n", b"\n\n", 1)
    )
    shoot(samples=8)
    assert rendered == [2] and notes[1] == "1 pictures have another frame and are rendered again"
    shoot(samples=8, overrides=["camera.position=[3.0, 2.0, 4.0]"])
    assert rendered == [0, 1, 2] and "another camera" in notes[0]


def test_pictures_hold_what_was_rendered(dots, tmp_path, rendered):
    image = pytest.importorskip("PIL.Image")
    folder = write_run(tmp_path / "run", [[water()]], size=ROOM)
    seconds: list[float] = []
    (file,) = photograph_run(folder, settings=SETTINGS, estimated=seconds.append)
    pixels = np.asarray(image.open(file))
    assert pixels.shape == (36, 64, 3) and np.ptp(pixels) <= 1
    # Middle gray, with the contrast of the look.
    assert pixels[0, 0, 0] == pytest.approx(255 * 0.5**photo.CONTRAST, abs=1)
    assert seconds == [expected_seconds(SETTINGS, "scalar_rgb", liquid=True)]


def test_films_are_made_of_the_pictures(dots, tmp_path, rendered):
    pytest.importorskip("imageio_ffmpeg", reason="films need imageio-ffmpeg")
    folder = write_run(tmp_path / "run", [[water()], [water()]], size=ROOM)
    list(photograph_film(folder, tmp_path / "film.gif", settings=SETTINGS))
    assert (tmp_path / "film.gif").stat().st_size > 0
    list(photograph_film(folder, tmp_path / "film.gif", settings=SETTINGS))
    assert rendered == [0, 1]
    with pytest.raises(RenderError, match="must end in"):
        list(photograph_film(folder, tmp_path / "film.avi", settings=SETTINGS))


def test_the_extra_is_named_where_it_is_missing(dots, tmp_path, monkeypatch):
    folder = write_run(tmp_path / "run", [[water()]], size=ROOM)
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    result = CliRunner().invoke(cli.app, ["render", str(folder), "--look", "photo"])
    assert result.exit_code == 2 and INSTALL in result.output.replace("\n", " ")
    assert not (folder / "photo").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--look", "photo", "--sheet"], "--sheet: needs --look quick"),
        (["--look", "photo", "--slice"], "--slice: needs --look quick"),
        (["--look", "photo", "--color", "speed"], "--color: needs --look quick"),
        (["--look", "photo", "--samples", "0"], "--samples 0: must be 1 to"),
        (["--look", "photo", "--shutter", "2"], "--shutter 2: must be 0 to 1"),
        (["--samples", "4"], "--samples: needs --look photo"),
        (["--shutter", "0"], "--shutter: needs --look photo"),
        (["--look", "photo", "--fps", "24"], "--fps: needs --film"),
        (["--frames", "7:9"], "--frames 7:9: there are no such frames; the run has 0 to 0"),
        (["--frames", "7"], "--frames 7: must be A:B"),
    ],
)
def test_wrong_options(dots, tmp_path, options, message):
    folder = write_run(tmp_path / "run", [[water()]], size=ROOM)
    result = CliRunner().invoke(cli.app, ["render", str(folder), *options])
    assert result.exit_code == 2 and message in " ".join(result.output.split())


def test_two_dimensions_are_refused(dots, tmp_path, rendered):
    folder = write_run(tmp_path / "run", [[ball([0.5, 0.5], 0.2)]])
    with pytest.raises(RenderError, match="draws 3-D runs; this one is 2-D"):
        list(photograph_run(folder, settings=SETTINGS))


def test_frame_ranges():
    numbers = [0, 2, 4, 6, 8]
    assert frame_range("2:6", numbers) == [2, 4, 6]
    assert frame_range("3:", numbers) == [4, 6, 8]
    assert frame_range(":-2", numbers) == [0, 2, 4, 6]
    assert frame_range(":", numbers) == numbers


def test_the_estimate_grows_with_pixels_and_samples():
    def seconds(size, samples):
        return expected_seconds(
            PhotoSettings(size=size, samples=samples), "scalar_rgb", liquid=True
        )

    small = seconds((640, 360), 32)
    assert seconds((1280, 720), 32) - small == pytest.approx(
        3.0 * (seconds((640, 360), 64) - small)
    )
    assert seconds((1280, 720), 32) > small > 0.0


@pytest.mark.parametrize(
    ("size", "samples", "instants"),
    [((64, 36), 4, 1), ((1280, 720), 64, 8), ((4096, 4096), 3, 8), ((1920, 1080), 100, 1)],
)
def test_passes_share_the_samples(size, samples, instants):
    shares = pass_samples(Quality(size, samples), instants)
    assert sum(shares) == max(1, round(samples / instants)) and min(shares) >= 1
    assert max(shares) == 1 or max(shares) * size[0] * size[1] <= 1.5 * PASS_PATHS


def test_the_camera_sees_where_the_material_goes(dots, tmp_path):
    frames = [[ball([0.2 + 0.1 * step, 0.3, 0.5], 0.1)] for step in range(5)]
    view = PhotoScenes(
        Recording(write_run(tmp_path / "run", frames, size=(4.0, 2.0, 4.0))), 16 / 9
    ).view
    places = np.concatenate([frame[0].points for frame in frames]) - view.position
    x, y, z = view.axes @ places.T
    slope = np.tan(np.radians(view.angle / 2))
    seen = np.stack([x / (16 / 9), y]) / (slope * z)
    assert np.abs(seen).max() <= 1.02 and np.abs(seen).max(axis=1).max() > 0.9
    chosen = Recording(tmp_path / "run", None, None, ["camera.position=[3.0, 2.0, 4.0]"])
    np.testing.assert_array_equal(PhotoScenes(chosen, 1.0).view.position, [3.0, 2.0, 4.0])


def test_water_bodies_and_solids_are_described(dots, tmp_path):
    moved = ball([0.5, 0.4, 0.5], 0.2, "bodies", body=0)
    moved.fields["velocity"][:] = [0.0, 0.0, 2.0]
    folder = write_run(tmp_path / "run", [[water(), moved]], BODY + BLOCK, size=ROOM)
    scene = PhotoScenes(Recording(folder), 1.0).frame(0)
    meshes = {mesh.name: mesh for mesh in scene.meshes}
    assert set(meshes) == {"solid_0", "body_0", "liquid"}
    assert (
        meshes["liquid"].finish is SurfaceFinish.LIQUID
        and meshes["liquid"].color[0] > meshes["liquid"].color[2] > 0.0
    )
    # Cut at the domain.
    assert (
        meshes["solid_0"].points[:, 0].max() < 1.01 and meshes["solid_0"].points[:, 2].min() > -0.01
    )
    later = {mesh.name: mesh for mesh in displaced(scene, 0.05).meshes}
    np.testing.assert_allclose(
        later["body_0"].points - meshes["body_0"].points,
        [[0.0, 0.0, 0.1]] * len(moved.corners) * 3,
        atol=1e-6,
    )
    np.testing.assert_array_equal(later["solid_0"].points, meshes["solid_0"].points)


def test_particles_become_grains(dots, tmp_path):
    folder = write_run(tmp_path / "run", [[grains()]], size=ROOM)
    (mesh,) = PhotoScenes(Recording(folder), 1.0).frame(0).meshes
    assert mesh.finish is SurfaceFinish.MATTE and len(mesh.corners) % (300 * 80) == 0
    np.testing.assert_allclose(mesh.velocity, [[0.0, -1.0, 0.0]] * len(mesh.points))
    assert mesh.points[:, 1].min() > -0.05
    colors = grain_colors(np.arange(4000))
    assert (
        colors.min() > 0.1
        and colors.max() <= 0.9
        and (colors[:, 0] >= colors[:, 2]).all()
        and len(np.unique(colors, axis=0)) > 500
    )


def test_particles_alone_get_a_surface():
    # 12 x 12 x 12, a cube in a corner.
    places = np.stack(np.meshgrid(*[np.arange(0.025, 0.6, 0.05)] * 3), axis=-1).reshape(-1, 3)
    velocity = np.tile([1.0, 2.0, 3.0], (len(places), 1))
    scene = SimpleNamespace(
        cell_counts=(10, 10, 10),
        spacing=0.1,
        domain=SimpleNamespace(size=(1.0, 1.0, 1.0)),
        particles=SimpleNamespace(per_axis=2),
        output=SimpleNamespace(surface_resolution=None, surface_smoothing=1.0),
    )
    surface = particle_surface(scene, Points("particles", places, {"velocity": velocity}))
    a, b, c = np.moveaxis(surface.points[surface.corners].astype(float), 1, 0)
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0 == pytest.approx(0.6**3, rel=0.05)
    np.testing.assert_array_equal(surface.fields["velocity"][0], [1.0, 2.0, 3.0])


@pytest.mark.parametrize("seed", range(3))
def test_poses_of_bodies_are_found_from_their_points(seed):
    rng = np.random.default_rng(seed)
    first = rng.normal(size=(20, 3))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    shift = rng.normal(size=3)
    pose = rigid_pose(first, first @ turn.T + shift)
    np.testing.assert_allclose(pose.rotation, turn, atol=1e-9)
    np.testing.assert_allclose(pose.translation, shift, atol=1e-9)


def test_colors():
    np.testing.assert_allclose(linear_color("#ffffff"), 1.0)
    np.testing.assert_allclose(linear_color("#808080"), 0.2158605, rtol=1e-5)

    scene = SimpleNamespace(domain=SimpleNamespace(size=(2.0, 1.0, 1.0)))
    np.testing.assert_allclose(2.0 * liquid_absorption(scene), ABSORPTION["water"])


def test_only_known_versions_of_llvm_are_tried(tmp_path, monkeypatch):
    from warp_lcp.render.photo import mitsuba_renderer

    monkeypatch.setattr(mitsuba_renderer, "LLVM_FOLDERS", [str(tmp_path)])
    for name in ("libLLVM-14.so.1", "libLLVM-15.so", "libLLVM.so"):
        (tmp_path / name).touch()
    assert find_llvm() is None
    for name in ("libLLVM-17.so.1", "libLLVM.so.19.1"):
        (tmp_path / name).touch()
    assert find_llvm() == str(tmp_path / "libLLVM.so.19.1")


def shot(folder, seed: int = 1, **more) -> np.ndarray:
    pytest.importorskip("mitsuba", reason="pictures need Mitsuba, the extra `photo`")
    pytest.importorskip("pyoidn", reason="pictures need Open Image Denoise, the extra `photo`")
    recording = Recording(folder, show=more.pop("show", None))
    return render_radiance(
        PhotoScenes(recording, 16 / 9).frame(0), Quality((64, 36), 4, **more), seed
    )


def test_water_and_a_body_are_rendered(dots, tmp_path):
    folder = write_run(
        tmp_path / "run", [[water(), ball([0.3, 0.5, 0.4], 0.2, "bodies", body=0)]], BODY, size=ROOM
    )
    image = shot(folder)
    assert image.shape == (36, 64, 3) and np.isfinite(image).all() and image.min() >= 0.0
    red, blue = image[..., 0], image[..., 2]
    wet, body = blue > 1.15 * red, red > 2.0 * blue
    # The middle of the picture is water, the ball orange.
    assert 0.15 < wet.mean() < 0.7 and 0.01 < body.mean() < 0.2
    assert wet[20:28, 24:40].mean() > 0.8
    corner = image[:6, :6].mean(axis=(0, 1))
    assert np.ptp(corner) < 0.15 * corner.mean()  # the ground is gray
    np.testing.assert_array_equal(image, shot(folder))
    assert np.abs(image - shot(folder, seed=2)).max() > 0.0


def test_the_shutter_blurs_only_what_moves(dots, tmp_path, monkeypatch):
    """Pixels that a ball covers while the shutter is open.

    In 0.02 s a ball of 0.4 m moves by its radius. It is seen at two instants, 0.1 m before and
    behind its middle.
    """
    from warp_lcp.render.photo import mitsuba_renderer

    pytest.importorskip("mitsuba", reason="pictures need Mitsuba, the extra `photo`")
    monkeypatch.setattr(mitsuba_renderer, "denoised", lambda layers: layers[..., 3:6])  # albedo
    folder = write_run(
        tmp_path / "run", [[water(), ball([0.5, 0.6, 0.4], 0.2, "bodies", body=0)]], BODY, size=ROOM
    )
    frame = PhotoScenes(Recording(folder, show=None), 16 / 9).frame(0)
    still = replace(
        frame,
        meshes=[
            replace(mesh, velocity=None)
            for mesh in frame.meshes
            if mesh.finish is not SurfaceFinish.LIQUID
        ],
    )
    assert len(still.meshes) == 1
    moving = replace(
        still,
        meshes=[
            replace(mesh, velocity=np.full_like(mesh.points, [10.0, 0.0, 0.0]))
            for mesh in still.meshes
        ],
    )
    covered = []
    for scene, shutter in ((still, 0.0), (still, 0.02), (moving, 0.0), (moving, 0.02)):
        image = render_radiance(scene, Quality((32, 18), 2, shutter=shutter), 1)
        covered.append(int((image[..., 0] > 1.5 * image[..., 2]).sum()))
    assert covered[0] > 10
    assert covered[1:3] == [covered[0]] * 2
    assert covered[3] > 1.15 * covered[0]


def test_sand_is_rendered(dots, tmp_path, monkeypatch):
    from warp_lcp.scene.scene import Scene

    monkeypatch.setattr(Scene, "palette", "sand")
    image = shot(
        write_run(tmp_path / "run", [[grains()]], size=ROOM),
        show=VisiblePart.PARTICLES,
        shutter=0.01,
    )
    assert np.isfinite(image).all()
    sand = image[..., 0] > 1.25 * image[..., 2]
    assert 0.1 < sand.mean() < 0.9
