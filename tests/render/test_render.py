"""Images of a run; tests that need pyvista are skipped where it is missing."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from command_line import invoke
from default_run import covering
from small_runs import ball
from warp_lcp.extras.live import LiveRun
from warp_lcp.frames.frame_folder import FrameFolder
from warp_lcp.render.actors import shaded
from warp_lcp.render.image_content import Color, RenderError, VisiblePart
from warp_lcp.render.page import Page
from warp_lcp.render.picture import Picture
from warp_lcp.render.recording import ColorScale, Recording, _round_up, spread
from warp_lcp.render.render import INSTALL, ImageStyle, expected_seconds, parse_size, render_run
from warp_lcp.render.solid_meshes import Outline
from warp_lcp.scene.camera import MARGIN, viewpoint
from warp_lcp.scene.scene_file import dump_scene, load_scene
from warp_lcp.simulation import Cells, Points

RNG = np.random.default_rng(9127)
WHITE = 255
DISC = '[[solid]]\nshape = "sphere"\ncenter = [0.5, 0.5]\nradius = 0.4\ninvert = true\n'


@pytest.fixture
def make_run(dots, tmp_path):
    """Write the folder of a run by hand.

    It has a list of frames, each with the points [m] and velocities [m/s] of its particles.
    """

    def make(
        frames, text: str = "", size=(1.0, 1.0), grid: bool = True, solids: str = "voxel"
    ) -> Path:
        source = tmp_path / "source.toml"
        source.write_text(
            '[scene]\nsimulator = "dots"\nname = "drops"\n[time]\nduration = '
            "1.0\nframes_per_second = 20\n"
            f'[domain]\nsize = {list(size)}\nresolution = 10\nsolids = "{solids}"\n{text}'
        )
        folder = tmp_path / "run"
        folder.mkdir()
        (folder / "scene.toml").write_text(dump_scene(load_scene(source)))
        writer = FrameFolder(folder)
        for index, (points, velocity) in enumerate(frames):
            points, velocity = (
                np.reshape(points, (-1, 3)).astype(np.float32),
                np.reshape(velocity, (-1, 3)).astype(np.float32),
            )
            cells = np.unique(
                np.floor(points[np.isfinite(points).all(axis=1)] * 10).astype(int), axis=0
            )
            parts = [Points("particles", points, {"velocity": velocity})]
            if grid:
                parts.append(
                    Cells("grid", cells, 0.1, len(size), {"pressure": 100.0 * cells[:, 1]})
                )
            writer.write(index, index / 20, parts)
        return folder

    return make


def drops(count: int, dimension: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Return random particles away from the walls, at most one per cell.

    Their speeds are 1 m/s.
    """
    cells = np.stack(np.meshgrid(*[np.arange(1, 9)] * dimension), axis=-1).reshape(-1, dimension)
    points = np.pad((RNG.permutation(cells)[:count] + 0.5) / 10, ((0, 0), (0, 3 - dimension)))
    return points, np.tile([0.6, 0.8, 0.0], (count, 1))


def pixels(path: Path) -> np.ndarray:
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image, dtype=int)


def draw(folder: Path, **looks) -> list[np.ndarray]:
    return [pixels(path) for path in render_run(folder, looks=ImageStyle(size=(400, 300), **looks))]


def is_blue(image: np.ndarray) -> np.ndarray:
    return image[..., 2] - image[..., 0] > 40


def test_without_pyvista_the_command_says_what_to_install(make_run, monkeypatch):
    folder = make_run([drops(3)])
    monkeypatch.setitem(sys.modules, "pyvista", None)
    result = invoke("render", folder)
    assert result.exit_code == 2
    assert INSTALL in result.stderr
    assert "Traceback" not in result.stderr
    assert not (folder / "images").exists()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["{run}/nowhere"], "is not the folder of a run: there is no such folder"),
        (["{run}/frames"], "is not the folder of a run: it has no scene.toml"),
        (
            ["{run}", "--frame", "0", "--frame", "2"],
            "--frame 2: there is no such frame; the run has 0 to 1",
        ),
        (["{run}", "--frame", "-3"], "--frame -3: there is no such frame"),
        (["{run}", "--size", "1280"], "--size 1280: must be a width and a height"),
        (["{run}", "--size", "99999x720"], "of 240 to 4096 pixels"),
        (["{run}", "--sheet", "--size", "4096x10"], "--size 4096x10: must be"),
        (["{run}", "--color", "red"], "--color"),
        (["{run}", "--out", "{run}/scene.toml/images"], "cannot be written"),
    ],
)
def test_wrong_input_exits_with_2(pyvista, make_run, arguments, expected):
    folder = make_run([drops(3), drops(3)])
    result = invoke("render", *[argument.format(run=folder) for argument in arguments])
    assert result.exit_code == 2
    assert expected in result.stderr.replace("\n", " ")
    assert "Traceback" not in result.stderr
    assert not (folder / "images").exists()


def test_a_run_without_frames(pyvista, make_run):
    result = invoke("render", make_run([]))
    assert result.exit_code == 2
    assert "holds no frames of particles" in result.stderr


def test_a_frame_that_is_cut_short(pyvista, make_run):
    folder = make_run([drops(20)])
    file = folder / "frames" / "particles_000000.vtu"
    file.write_bytes(file.read_bytes()[:400])
    result = invoke("render", folder)
    assert result.exit_code == 2
    assert f"{file}: is not a readable frame" in result.stderr


def test_pressure_needs_the_cells(pyvista, make_run):
    folder = make_run([drops(3)], grid=False)
    with pytest.raises(RenderError, match="--color pressure needs a frame of cells"):
        Recording(folder, Color.PRESSURE)


def test_the_command_writes_the_frames_asked_for(pyvista, make_run, tmp_path):
    folder = make_run([drops(5) for _ in range(4)])
    result = invoke(
        "render", folder, "--frame", -1, "--frame", 1, "--frame", 3, "--size", "320x240"
    )
    assert result.exit_code == 0
    assert "2 images" in result.stdout
    assert sorted(path.name for path in (folder / "images").iterdir()) == [
        "frame_000001.png",
        "frame_000003.png",
    ]
    assert pixels(folder / "images" / "frame_000001.png").shape == (240, 320, 3)
    assert (
        invoke("render", folder, "--out", tmp_path / "elsewhere", "--size", "320x240").exit_code
        == 0
    )
    assert len(list((tmp_path / "elsewhere").glob("frame_*.png"))) == 4


def test_the_duration_of_drawing_is_estimated_before_it_begins(pyvista, make_run):
    folder, reported = make_run([drops(5) for _ in range(4)]), []
    looks, frames = ImageStyle(size=(320, 240)), [0, 1, 2]
    drawn = render_run(
        folder,
        frames=frames,
        looks=looks,
        estimated=reported.append,
        on_progress=lambda done, of: reported.append(done),
    )
    next(drawn)
    drawn.close()
    assert reported == [expected_seconds(Recording(folder), frames, looks), 0, 1]
    more = [
        expected_seconds(Recording(folder), frames * 2, looks),
        expected_seconds(Recording(folder), frames, ImageStyle(size=(640, 480))),
    ]
    assert more[0] == 2 * reported[0]
    assert more[1] > reported[0] > 0.0
    result = invoke("render", folder, "--size", "320x240")
    assert result.stderr.startswith("drawing takes about 0:00:01 on one core")
    assert "takes about" not in invoke("render", folder, "--size", "320x240", "--frame", 0).stderr


@pytest.mark.parametrize(
    ("simulator", "key", "expected"),
    [("fluids", "liquid", VisiblePart.SURFACE), ("granular", "sand", VisiblePart.PARTICLES)],
)
def test_by_default_sand_is_drawn_as_grains_and_liquid_as_a_surface(
    simulator, key, expected, tmp_path
):
    """Default looks: sand as grains, liquid as its surface.

    A heap's surface has holes where it is a grain thin, and bulges where it is thick.
    """
    material = {key: [{"shape": "box", "min": [0.0, 0.0], "max": [0.5, 0.5]}]}
    tables = {
        "scene": {"simulator": simulator},
        "time": {"duration": 1.0},
        "domain": {"size": [1.0, 1.0], "resolution": 10},
    }
    (tmp_path / "scene.toml").write_text(
        dump_scene(load_scene({**tables, **material, "output": {"surface": True}}))
    )
    points, velocity = drops(5)
    FrameFolder(tmp_path).write(
        0,
        0.0,
        [
            Points("particles", points.astype(np.float32), {"velocity": velocity}),
            ball([0.5, 0.5], 0.1),
        ],
    )
    assert Recording(tmp_path).show is LiveRun(tmp_path)._recording.show is expected
    assert Recording(tmp_path, show=VisiblePart.SURFACE).show is VisiblePart.SURFACE
    assert Recording(tmp_path, Color.SPEED).show is VisiblePart.PARTICLES
    (tmp_path / "particles.pvd").unlink()
    for file in (tmp_path / "frames").glob("particles*"):
        file.unlink()
    assert Recording(tmp_path).show is VisiblePart.SURFACE, "where there is nothing else"


def test_a_sheet_shows_evenly_spaced_frames(pyvista, make_run):
    folder = make_run([drops(number + 1) for number in range(8)])
    result = invoke("render", folder, "--sheet", "--size", "600x480")
    assert result.exit_code == 0
    assert result.stdout.strip() == str(folder / "images" / "sheet.png")
    image = pixels(folder / "images" / "sheet.png")
    assert image.shape[1] == 600
    page = Page(Recording(folder, Color.SPEED), (600, 480), 6, Picture)
    (width, height), columns = page.tile, page.columns
    page.painter.close()
    areas = []
    for place in range(6):
        top = page.line + place // columns * (height + page.caption) + page.caption
        areas.append(
            is_blue(
                image[top : top + height, place % columns * width : (place % columns + 1) * width]
            ).sum()
        )
    frames = spread(range(8), 6)
    assert frames == [0, 1, 3, 4, 6, 7]
    np.testing.assert_allclose(np.array(areas) / areas[0], np.array(frames) + 1, rtol=0.25)


@pytest.mark.default_cases(1)
@pytest.mark.parametrize(
    ("rate", "label"), [(20, "t = 0.05 s"), (100, "t = 0.01 s"), (1000, "t = 0.001 s")]
)
def test_each_picture_shows_its_own_time(pyvista, make_run, monkeypatch, rate, label):
    folder = make_run([drops(1), drops(1)])
    text = folder / "scene.toml"
    text.write_text(
        re.sub(r"frames_per_second = [0-9.]+", f"frames_per_second = {rate}", text.read_text())
    )
    page, texts = Page(Recording(folder, Color.SPEED), (400, 300), 2, Picture), []
    monkeypatch.setattr(page, "_write", lambda figure, text, x, y, anchor: texts.append(text))
    page.draw([0, 1])
    page.painter.close()
    assert label in texts


def test_discs_have_the_size_of_the_particles(pyvista, make_run):
    folder = make_run([drops(30)])
    page = Page(Recording(folder, Color.SPEED), (400, 300), 1, Picture)
    image = np.asarray(page.draw([0]), dtype=int)[page.line :]
    page.painter.close()
    pixel = MARGIN / page.tile[1]  # [m] per pixel; the height limits the size of a square domain
    assert page.painter.radius == pytest.approx(0.6 * 0.1)
    # Neighbors overlap.
    assert is_blue(image).sum() * pixel**2 == pytest.approx(
        30 * np.pi * page.painter.radius**2, rel=0.25
    )
    assert (image[2:-2, 2:40] == WHITE).all()


def test_discs_lie_where_the_particles_are(pyvista, make_run):
    folder = make_run([([0.25, 0.75, 0.0], [1.0, 0.0, 0.0])])
    page = Page(Recording(folder, Color.SPEED), (400, 300), 1, Picture)
    image = np.asarray(page.draw([0]), dtype=int)[page.line :]
    page.painter.close()
    width, height = page.tile
    center = np.argwhere(is_blue(image)).mean(axis=0) + 0.5
    expected = [height / 2 - 0.25 * height / MARGIN, width / 2 - 0.25 * height / MARGIN]
    np.testing.assert_allclose(center, expected, atol=1.0)


@pytest.mark.slow
def test_flat_walls_hide_what_of_discs_reaches_across_them(pyvista, make_run):
    """Discs cut by flat walls.

    Beside the domain's sides and a round wall each disc ends at the wall; otherwise a saw-tooth of
    discs would be a radius wide.
    """
    along = np.linspace(0.0, 1.0, 16)
    angle = 2.0 * np.pi * along
    sides = [np.stack([np.full(16, end), along], axis=-1) for end in (0.001, 0.999)]
    circle = 0.5 + 0.399 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    points = np.pad(
        np.concatenate([*sides, *(side[:, ::-1] for side in sides), circle]), ((0, 0), (0, 1))
    )
    folder = make_run([(points, np.tile([1.0, 0.0, 0.0], (len(points), 1)))], DISC)
    page = Page(Recording(folder, Color.SPEED), (400, 300), 1, Picture)
    image = np.asarray(page.draw([0]), dtype=int)[page.line :]
    page.painter.close()
    row, column = np.argwhere(is_blue(image)).T
    assert len(row) > 200
    width, height = page.tile
    pixel = MARGIN / height
    far = pixel * np.hypot(row + 0.5 - height / 2, column + 0.5 - width / 2)
    assert far.max() < 0.4 + pixel
    assert far.max() > 0.4 - 4 * pixel


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("size", ["400x300", "300x400"])
def test_balls_do_not_reach_beyond_the_outline_of_a_room(pyvista, make_run, size):
    """Balls within the outline of a room.

    With balls beside all walls the outline is that of the empty room.
    """
    ends = np.array([0.001, 0.999])
    grid = np.stack(np.meshgrid(*[np.linspace(0.05, 0.95, 10)] * 2), axis=-1).reshape(-1, 2)
    walls = [np.insert(grid, axis, end, axis=1) for axis in range(3) for end in ends]
    folder = make_run(
        [(np.concatenate(walls), np.tile([1.0, 0.0, 0.0], (600, 1)))], size=(1.0, 1.0, 1.0)
    )
    page = Page(Recording(folder, Color.SPEED), parse_size(size), 1, Picture)
    drawn = is_blue(np.asarray(page.draw([0]), dtype=int)[page.line :])
    view, (width, height) = viewpoint(page.recording.scene, page.tile[0] / page.tile[1]), page.tile
    page.painter.close()
    corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    x, y, depth = ((corners - view.position) @ view.axes.T).T
    focal = 0.5 * height / np.tan(np.radians(view.angle / 2))
    across, down = width / 2 + focal * x / depth, height / 2 - focal * y / depth
    row, column = np.argwhere(drawn).T
    assert drawn.sum() > 5000
    found, expected = (
        [column.min(), column.max() + 1, row.min(), row.max() + 1],
        [across.min(), across.max(), down.min(), down.max()],
    )
    np.testing.assert_allclose(found, expected, atol=2.5)


def test_flat_solids_are_filled_gray(pyvista, make_run):
    folder = make_run([([0.5, 0.5, 0.0], [1.0, 0.0, 0.0])], DISC)
    page = Page(Recording(folder, Color.SPEED), (400, 300), 1, Picture)
    image = np.asarray(page.draw([0]), dtype=int)[page.line :]
    page.painter.close()
    # Lighter than the outlines.
    gray = (np.ptp(image, axis=-1) < 16) & (image[..., 0] > 150) & (image[..., 0] < 230)
    assert gray.sum() * (MARGIN / page.tile[1]) ** 2 == pytest.approx(
        1.0 - np.pi * 0.4**2, rel=0.03
    )


def test_colors_mean_the_same_in_every_frame(pyvista, make_run):
    slow, fast = [0.5, 0.0, 0.0], [4.0, 0.0, 0.0]
    folder = make_run(
        [([0.25, 0.5, 0.0], slow), ([[0.25, 0.5, 0.0], [0.75, 0.5, 0.0]], [slow, fast])]
    )
    first, second = draw(folder)
    ours = is_blue(first)
    ours[:30] = False  # the legend
    ours[:, 200:] = False
    assert ours.sum() > 50
    np.testing.assert_array_equal(first[ours], second[ours])
    other = second[:, 200:][30:]
    assert other[is_blue(other)].mean() > first[ours].mean() + 30


def test_pressure_and_plain_colors(pyvista, make_run):
    points = [[0.25, 0.15, 0.0], [0.25, 0.85, 0.0]]
    folder = make_run([(points, np.zeros((2, 3)))])
    recording = Recording(folder, Color.PRESSURE)
    np.testing.assert_allclose(recording.read(0)[1], [100.0, 800.0])
    assert recording.scale.label == "pressure [Pa]"
    assert Recording(folder, Color.PLAIN).scale.label == ""
    pressure, plain = draw(folder, color=Color.PRESSURE)[0], draw(folder, color=Color.PLAIN)[0]
    assert (pressure[:20] < 200).sum() > (plain[:20] < 200).sum()  # legend of the pressure
    assert is_blue(plain[25:]).sum() > is_blue(pressure[25:]).sum()


def test_empty_frames_and_numbers_that_are_not_finite(pyvista, make_run):
    nothing = np.zeros((0, 3))
    folder = make_run(
        [
            drops(4),
            (nothing, nothing),
            ([[0.5, 0.5, 0.0], [np.nan, 0.5, 0.0]], [[1, 0, 0], [1, 0, 0]]),
        ],
        grid=False,
    )
    points, values = Recording(folder, Color.SPEED).read(2)
    assert points.shape == (1, 3)
    assert values == pytest.approx([1.0])
    some, none, one = (is_blue(image[30:]).sum() for image in draw(folder))
    assert none == 0
    assert some > one > 0


@pytest.mark.parametrize("size", [(1.0, 0.5, 0.5), (0.5, 1.0, 0.4), (0.3, 0.3, 1.0)])
def test_the_camera_shows_the_whole_room(pyvista, make_run, size):
    image = draw(
        make_run([(np.multiply(size, 0.5), [1.0, 0.0, 0.0])], size=size), color=Color.PLAIN
    )[0][20:]  # without the line with the time
    drawn = np.argwhere((image < 200).any(axis=-1))
    margin = np.array([drawn.min(axis=0), image.shape[:2] - drawn.max(axis=0)]) / image.shape[:2]
    assert margin.min() > 0.02  # nothing is cut,
    assert margin.sum(axis=0).min() < 1.02 - 1.0 / MARGIN  # one direction is filled,
    assert np.abs(margin[0] - margin[1]).max() < 0.02  # and the other is centered


SOLIDS = {
    "box": 'shape = "box"\nmin = [0.2, 0.1, 0.3]\nmax = [0.6, 0.4, 0.5]\nrotate = [10.0, 20.0, '
    "30.0]",
    "sphere": 'shape = "sphere"\ncenter = [0.5, 0.4, 0.5]\nradius = 0.2\nscale = 0.9',
    "capsule": 'shape = "capsule"\nfrom = [0.3, 0.3, 0.3]\nto = [0.6, 0.7, 0.5]\nradius = '
    "0.1\ntranslate = [0.0, 0.0, 0.1]",
    "mesh": 'shape = "mesh"\nfile = "builtin:torus"\nscale = 0.5\nrotate = [40.0, 0.0, '
    "0.0]\ntranslate = [0.5, 0.5, 0.5]",
    "plane": 'shape = "plane"\npoint = [0.0, 0.3, 0.0]\nnormal = [0.2, 1.0, 0.1]\ntranslate = '
    "[0.0, 0.1, 0.0]",
    "cut off": 'shape = "sphere"\ncenter = [0.9, 0.1, 0.5]\nradius = 0.3',
}
ROOM = (1.0, 1.0, 1.0)


TURN = (
    'motion = { kind = "rotation", rate = 90.0, center = [0.5, 0.5, 0.5], axis = [0.2, 1.0, '
    "0.3] }\n"
)


@pytest.mark.parametrize(
    ("name", "invert", "time"), covering(list(SOLIDS), [False, True], [0.0, 0.37])
)
def test_surfaces_lie_where_the_solver_has_them(pyvista, make_run, name, invert, time):
    text = f"[[solid]]\n{SOLIDS[name]}\ninvert = {str(invert).lower()}\n{TURN}"
    shape = load_scene(make_run([], text, size=ROOM, solids="cut-cell") / "scene.toml").solid[0]
    pose = shape.motion.to_motion(3).pose(time)
    mesh = Outline(shape).inside(np.array(ROOM), pose)
    points = np.asarray(mesh.points)
    inside = (np.abs(points - 0.5) < 0.5 - 1e-6).all(axis=1)
    assert inside.any() or name == "plane"  # its corners lie on the walls
    distance = wp.empty(len(points), dtype=wp.float32, device="cpu")
    shape.to_geometry(Path(), 3).moved(pose).signed_distance(
        wp.array(points, dtype=wp.vec3, device="cpu"), distance
    )
    assert np.abs(distance.numpy()[inside]).max(initial=0.0) < 2e-3
    if not invert:
        # The closing of the surface at the walls is inside the solid.
        assert distance.numpy().max() < 2e-3
        assert (points > -1e-6).all()
        assert (points < 1 + 1e-6).all()
    assert mesh.n_open_edges == 0
    corners = points[mesh.triangulate().regular_faces]
    # Positive: every triangle faces outward.
    assert np.linalg.det(corners).sum() / 6 == pytest.approx(mesh.volume, rel=1e-3)


def test_solids_in_a_room_are_gray(pyvista, make_run):
    folder = make_run(
        [([0.9, 0.9, 0.9], [1.0, 0.0, 0.0])],
        "".join(f"[[solid]]\n{SOLIDS[name]}\n" for name in SOLIDS),
        size=ROOM,
    )
    image = draw(folder)[0][25:]
    assert ((np.ptp(image, axis=-1) < 16) & (image < 215).all(axis=-1)).mean() > 0.1


def test_a_flat_solid_stands_where_it_is_at_the_time_of_a_frame(pyvista, make_run):
    """Position of a flat solid at the time of a frame.

    A disc of radius 0.1 m moves at 4 m/s until 0.1 s: in frames at 0, 0.05 and 0.2 s it is at x =
    0.2, 0.4 and 0.6 m.
    """
    motion = '{ kind = "translation", velocity = [4.0, -1.0], stop = 0.1 }'
    wall = '[[solid]]\nshape = "box"\nmin = [0.9, 0.0]\nmax = [1.0, 1.0]\n'
    disc = f'[[solid]]\nshape = "sphere"\ncenter = [0.2, 0.6]\nradius = 0.1\nmotion = {motion}\n'
    folder = make_run([([0.05, 0.05, 0.0], [1.0, 0.0, 0.0])] * 5, disc + wall, solids="cut-cell")
    page = Page(Recording(folder, Color.SPEED), (400, 300), 1, Picture)
    pixel = MARGIN / page.tile[1]  # [m]
    # [m] From the image's left and lower edge to the domain's corner.
    low = 0.5 * (np.array(page.tile) * pixel - 1.0)
    for frame, expected in ((0, [0.2, 0.6]), (1, [0.4, 0.55]), (4, [0.6, 0.5]), (0, [0.2, 0.6])):
        image = np.asarray(page.draw([frame]), dtype=int)[page.line :]
        gray = (np.ptp(image, axis=-1) < 16) & (image[..., 0] > 150) & (image[..., 0] < 230)
        rows, columns = np.nonzero(gray)
        x, y = (columns + 0.5) * pixel - low[0], (page.tile[1] - rows - 0.5) * pixel - low[1]
        ours = (x > 0.05) & (x < 0.85) & (y > 0.05) & (y < 0.95)
        np.testing.assert_allclose([x[ours].mean(), y[ours].mean()], expected, atol=pixel)
        # Nothing remains at its former position.
        assert ours.sum() * pixel**2 == pytest.approx(np.pi * 0.1**2, rel=0.1)
        assert (x[~ours] > 0.9).mean() > 0.8  # the wall is fixed
    page.painter.close()


def test_a_solid_in_a_room_is_drawn_in_every_frame(pyvista, make_run):
    motion = '{ kind = "translation", velocity = [0.0, 8.0, 0.0] }'
    text = f"[[solid]]\n{SOLIDS['sphere']}\nmotion = {motion}\n"
    folder = make_run([([0.9, 0.9, 0.9], [1.0, 0.0, 0.0])] * 4, text, size=ROOM, solids="cut-cell")
    page = Page(Recording(folder, Color.PLAIN), (400, 300), 1, Picture)
    images = [np.asarray(page.draw([frame]), dtype=int)[page.line :] for frame in (0, 1, 3, 0)]
    page.painter.close()
    assert (images[0] != images[1]).any()
    np.testing.assert_array_equal(images[0], images[3])
    gray = [((np.ptp(image, axis=-1) < 16) & (image < 215).all(axis=-1)).sum() for image in images]
    assert gray[1] > 1.5 * gray[2]
    # By 0.15 s the ball has left through the ceiling; the room's edges stay.
    assert gray[0] > 1.5 * gray[2]


def test_containers_do_not_hide_what_is_in_them(pyvista, make_run):
    text = '[[solid]]\nshape = "sphere"\ncenter = [0.5, 0.5, 0.5]\nradius = 0.45\ninvert = true\n'
    folder = make_run([drops(60, 3)], text, size=ROOM)
    assert is_blue(draw(folder, color=Color.PLAIN)[0]).sum() > 5000


def test_liquid_is_lit_from_above_and_drops_are_not():
    block = np.stack(np.meshgrid(*[np.arange(0.025, 1.0, 0.05)] * 3), axis=-1).reshape(-1, 3)
    drop = np.array([[3.0, 3.0, 3.0]])
    colors, outer = shaded(
        np.concatenate([block, drop]), np.full((len(block) + 1, 3), 100.0), 0.1, "water"
    )
    light = colors.mean(axis=1)
    depth = (0.5 - np.abs(block - 0.5)).min(axis=1)  # only points deep inside may be left out
    assert outer[-1]
    assert outer[:-1][depth < 0.1].all()
    assert not outer[:-1][depth > 0.3].any()
    middle = (np.abs(block[:, [0, 2]] - 0.5) < 0.1).all(axis=1)
    top, bottom, core = (
        light[:-1][middle & (np.abs(block[:, 1] - y) < 0.03)].mean() for y in (0.975, 0.025, 0.525)
    )
    assert top > bottom + 20
    assert core == pytest.approx(100.0, abs=1.0)
    assert light[-1] == pytest.approx(100.0, abs=15.0)


def test_scales_end_at_round_numbers():
    assert [_round_up(value) for value in (0.0, 0.7, 1.0, 2.1, 9.7, 10.0, 4321.0)] == [
        1.0,
        0.8,
        1.0,
        2.5,
        10.0,
        10.0,
        5000.0,
    ]
    scale = ColorScale("", 0.0, 2.0, ("#000000", "#643200"))
    np.testing.assert_allclose(
        scale.colors(np.array([-1.0, 1.0, 2.0, 9.0])),
        [[0, 0, 0], [50, 25, 0], [100, 50, 0], [100, 50, 0]],
        atol=1,
    )
    # Colors of viridis.
    np.testing.assert_array_equal(
        ColorScale("", 0.0, 1.0).colors(np.array([0.0, 1.0])), [[68, 1, 84], [253, 231, 36]]
    )


def test_negative_pressure_extends_the_scale(pyvista, make_run):
    folder = make_run([([[0.5, 0.5, 0.0]] * 50, np.zeros((50, 3)))])
    recording = Recording(folder, Color.PRESSURE)
    recording.read = lambda number: (np.zeros((50, 3)), np.linspace(-90.0, 200.0, 50))  # type: ignore[method-assign]
    scale = recording.scale
    assert scale.low == -100.0
    assert scale.high == 200.0


def test_sizes():
    assert parse_size("1280x720") == (1280, 720)
    for text in ("1280", "1280x", "x720", "1280X720", "-1280x720", "1280x720x3", "10x10"):
        with pytest.raises(RenderError, match="such as 1280x720"):
            parse_size(text)
