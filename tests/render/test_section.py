"""Sections drawn by Matplotlib, without pyvista."""

import sys

import numpy as np
import pytest

from command_line import invoke
from small_runs import ball, sphere, write_run
from warp_lcp.render.image_content import Color, RenderError, VisiblePart
from warp_lcp.render.render import INSTALL_MATPLOTLIB, ImageStyle, render_run
from warp_lcp.render.section import cut
from warp_lcp.simulation import Cells, Points, Surface

pytest.importorskip("matplotlib", reason="sections need Matplotlib, the extra `render`")
SIZE = (400, 300)
SOLID = '[[solid]]\nshape = "sphere"\ncenter = [{}]\nradius = 0.2\n'


@pytest.fixture(autouse=True)
def no_pyvista(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvista", None)


def material(dimension: int, column: int = 2):
    """Return cells of a layer at x = 0.2 to 0.3 m, each with a particle.

    Their pressure is 100 Pa times their row.
    """
    axes = [[column], range(10), range(10) if dimension == 3 else [0]]
    index = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    points = ((index + 0.5) * [0.1, 0.1, 0.1 if dimension == 3 else 0.0]).astype(np.float32)
    if dimension == 2:
        points[:, 2] = 0.0
    velocity = np.tile(np.array([1.0, 0.0, 0.0], dtype=np.float32), (len(index), 1))
    return [
        Points("particles", points, {"velocity": velocity}),
        Cells("grid", index, 0.1, dimension, {"pressure": 100.0 * index[:, 1]}),
    ]


def draw(folder, **looks):
    from PIL import Image

    images = []
    for path in render_run(folder, looks=ImageStyle(size=SIZE, cut=True, **looks)):
        with Image.open(path) as image:
            images.append(np.asarray(image, dtype=int)[22:])
    return images


def test_a_section_of_a_sphere_is_a_circle():
    points, corners = sphere()
    for z in (0.0, 0.6):
        ends = cut(points[corners], z)
        assert len(ends) > 20
        np.testing.assert_allclose(np.linalg.norm(ends, axis=-1), np.sqrt(1.0 - z**2), atol=5e-3)
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum()
        # Each part of the circle once.
        assert length == pytest.approx(2.0 * np.pi * np.sqrt(1.0 - z**2), rel=5e-3)
        area = 0.5 * (ends[:, 0, 0] * ends[:, 1, 1] - ends[:, 0, 1] * ends[:, 1, 0]).sum()
        assert abs(area) == pytest.approx(np.pi * (1.0 - z**2), rel=1e-2)  # all in one direction
    assert len(cut(points[corners], 1.5)) == 0


@pytest.mark.parametrize("dimension", [2, 3])
def test_pressure_fills_the_cells(dots, tmp_path, dimension):
    folder = write_run(tmp_path / "run", [material(dimension)], size=(1.0,) * dimension)
    (image,) = draw(folder)
    colored = np.ptp(image, axis=-1) > 60
    rows, columns = np.nonzero(colored)
    assert np.ptp(columns) < 0.15 * np.ptp(rows) + 4  # a layer as wide as a cell
    top, bottom = (
        image[row, round(columns.mean()) + 2] for row in (rows.min() + 8, rows.max() - 8)
    )
    assert top[1] > 180  # yellow: the pressure of these cells grows upward
    assert bottom[1] < 60  # violet


def test_particles_near_the_cut_and_no_others(dots, tmp_path):
    particles, cells = material(3)
    front = particles.points[:, 2] > 0.5
    particles = Points(
        "particles", particles.points[front], {"velocity": particles.fields["velocity"][front]}
    )
    folder = write_run(tmp_path / "run", [[particles, cells]], size=(1.0, 1.0, 1.0))
    near, far = (draw(folder, color=Color.SPEED, at=at)[0] for at in (0.72, 0.22))
    blue = [(image[..., 2] - image[..., 0] > 30).sum() for image in (near, far)]
    assert blue[0] > 100
    assert blue[1] == 0


@pytest.mark.parametrize(("at", "radius"), [(0.5, 0.2), (0.62, 0.16), (0.9, 0.0)])
def test_solids_are_cut(dots, tmp_path, at, radius):
    (image,) = draw(
        write_run(tmp_path / "run", [material(3)], SOLID.format("0.6, 0.5, 0.5"), (1.0, 1.0, 1.0)),
        at=at,
    )
    gray = (np.ptp(image, axis=-1) < 12) & (np.abs(image.mean(axis=-1) - 199) < 8)
    frame = np.argwhere((image.max(axis=-1) < 60).sum(axis=1) > 100).ravel()  # lines of the axes
    side = np.ptp(frame)  # pixels per meter
    assert gray.sum() / side**2 == pytest.approx(np.pi * radius**2, abs=0.012)


def test_surfaces_and_bodies_are_outlined(dots, tmp_path):
    body = ball([0.7, 0.5, 0.5], 0.2, "bodies", body=1)
    folder = write_run(
        tmp_path / "run", [[*material(3), ball([0.5, 0.5, 0.5], 0.3), body]], size=(1.0, 1.0, 1.0)
    )
    (image,), (plain,) = draw(folder, show=VisiblePart.BOTH), draw(folder)
    assert (plain[..., 0] - plain[..., 2] > 80).sum() > 30  # the body
    assert ((image != plain).any(axis=-1)).sum() > 150  # the surface


@pytest.mark.parametrize("dimension", [2, 3])
def test_bodies_are_filled_but_for_their_holes(dots, tmp_path, dimension):
    outer, inner = (
        ball([0.6, 0.5, 0.5][:dimension], radius, "bodies", body=1) for radius in (0.3, 0.2)
    )
    corners = np.concatenate([outer.corners, inner.corners[:, ::-1] + len(outer.points)])
    shell = Surface(
        "bodies",
        np.concatenate([outer.points, inner.points]),
        corners,
        {"body": np.ones(len(outer.points) + len(inner.points))},
    )
    (image,) = draw(
        write_run(tmp_path / "run", [[*material(dimension, 0), shell]], size=(1.0,) * dimension),
        color=Color.PLAIN,
        at=0.53 if dimension == 3 else None,
    )
    orange = (np.abs(image - [224, 122, 63]) < 12).all(axis=-1)
    # Pixels per meter.
    side = np.ptp(np.argwhere((image.max(axis=-1) < 60).sum(axis=1) > 100).ravel())
    # Without the lines along its edges.
    assert orange.sum() / side**2 == pytest.approx(np.pi * (0.3**2 - 0.2**2), rel=0.1)


def test_a_surface_alone_is_drawn_over_plain_cells(dots, tmp_path):
    _, cells = material(3)
    surface = ball([0.5, 0.5, 0.5], 0.3)
    folder = write_run(tmp_path / "run", [[cells, surface]], size=(1.0, 1.0, 1.0))
    (image,), (asked,) = draw(folder), draw(folder, show=VisiblePart.SURFACE)
    assert (image[..., 2] - image[..., 0] > 80).sum() > 150  # outline of the surface
    np.testing.assert_array_equal(image, asked)
    with pytest.raises(RenderError, match="holds no frames of particles"):
        draw(folder, color=Color.SPEED)


def test_a_film_and_a_sheet_of_sections(dots, tmp_path):
    folder = write_run(tmp_path / "run", [material(2, column) for column in (2, 4, 6)])
    assert invoke("render", folder, "--slice", "--sheet", "--size", "600x300").exit_code == 0
    assert (folder / "images" / "sheet.png").is_file()
    assert (
        invoke(
            "render", folder, "--slice", "--film", tmp_path / "film.gif", "--size", "320x240"
        ).exit_code
        == 0
    )
    assert (tmp_path / "film.gif").stat().st_size > 1000
    assert invoke("render", folder, "--slice", "--frame", "-1").exit_code == 0
    assert (folder / "images" / "slice_000002.png").is_file()


def test_a_flat_window(dots, tmp_path):
    whole = draw(write_run(tmp_path / "a", [material(2)]))[0]
    part = draw(
        write_run(tmp_path / "b", [material(2)], "[camera]\nmin = [0.0, 0.0]\nmax = [0.5, 0.5]\n")
    )[0]
    area = [(np.ptp(image, axis=-1) > 60).sum() for image in (whole, part)]
    assert area[1] > 1.6 * area[0]  # twice as wide, and half of the rows


def test_wrong_cuts(dots, tmp_path):
    flat = write_run(tmp_path / "flat", [material(2)])
    room = write_run(tmp_path / "room", [material(3)], size=(1.0, 1.0, 1.0))
    with pytest.raises(RenderError, match="--at: is for 3-D runs"):
        draw(flat, at=0.5)
    for at in (-0.1, 1.5, float("nan")):
        with pytest.raises(RenderError, match="must be inside the domain, from 0 to 1 m"):
            draw(room, at=at)


def test_without_pyvista_the_error_names_the_section(dots, tmp_path):
    folder = write_run(tmp_path / "run", [material(2)])
    result = invoke("render", folder)
    assert result.exit_code == 2
    assert "--slice draws a section without it" in result.stderr.replace("\n", " ")
    assert invoke("render", folder, "--slice").exit_code == 0


def test_without_matplotlib_the_command_says_what_to_install(dots, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    result = invoke("render", write_run(tmp_path / "run", [material(2)]), "--slice")
    assert result.exit_code == 2
    assert INSTALL_MATPLOTLIB in result.stderr


@pytest.mark.parametrize("color", [Color.PRESSURE, Color.SPEED])
def test_solids_are_drawn_above_particles(dots, tmp_path, monkeypatch, color):
    """Matplotlib draws larger numbers of the order later."""
    from matplotlib.axes import Axes

    orders = {"scatter": [], "contourf": []}

    def note(name):
        draws = getattr(Axes, name)

        def noted(*arguments, zorder, **looks):
            orders[name].append(zorder)
            return draws(*arguments, zorder=zorder, **looks)

        monkeypatch.setattr(Axes, name, noted)

    for name in orders:
        note(name)
    solid = SOLID.format("0.25, 0.5, 0.55")
    folder = write_run(tmp_path / "run", [material(3)], solid, (1.0, 1.0, 1.0))
    draw(folder, at=0.55, color=color)
    assert orders["scatter"]
    assert max(orders["scatter"]) < min(orders["contourf"])
