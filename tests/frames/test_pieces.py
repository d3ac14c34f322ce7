"""Partitioned frames: index files, read back by this package and by VTK."""

from pathlib import Path

import numpy as np
import pytest

from warp_lcp.distributed.collective import Collective
from warp_lcp.frames.frame_folder import FrameFolder
from warp_lcp.frames.pieces import describe, one_grid, piece_files, write_whole
from warp_lcp.frames.vtu import VtuMesh
from warp_lcp.render import recording
from warp_lcp.render.image_content import Color, RenderError
from warp_lcp.render.recording import Recording
from warp_lcp.run.folder import OutputError, RunFolder, RunRecord
from warp_lcp.run.rank_frames import RankFrames
from warp_lcp.scene.scene_file import dump_scene, load_scene
from warp_lcp.simulation import Cells, Part, Points, Surface

COUNTS = (6, 4, 2)
# Boxes of three ranks.
BOXES = (((0, 0, 0), (2, 4, 2)), ((2, 0, 0), (5, 4, 2)), ((5, 0, 0), (6, 4, 2)))


def whole() -> list[Part]:
    """Return a frame of 300 points, 20 cells and a surface of two triangles."""
    random = np.random.default_rng(411)
    points = (random.random((300, 3)) * COUNTS).astype(np.float32)
    cells = np.argwhere(np.ones(COUNTS, dtype=bool))[random.permutation(48)[:20]]
    corners = np.array(
        [[0.1, 0, 0], [1, 0, 0], [0, 1, 0], [5.1, 0, 0], [5.9, 0, 0], [5, 1, 0]], dtype=np.float32
    )
    return [
        Points(
            "particles",
            points,
            {"velocity": random.standard_normal((300, 3)), "number": np.arange(300)},
        ),
        Cells(
            "grid", cells, 1.0, 3, {"pressure": random.random(20), "wall": cells[:, 1] == 0}, COUNTS
        ),
        Surface("surface", corners, np.arange(6).reshape(2, 3), {"velocity": 2.0 * corners}),
    ]


def piece(box: tuple[tuple[int, int, int], tuple[int, int, int]]) -> list[Part]:
    """Return the part of the frame in a rank's box."""
    points, cells, surface = whole()
    assert isinstance(points, Points) and isinstance(cells, Cells) and isinstance(surface, Surface)
    low, high = box[0][0], box[1][0]
    p = (points.points[:, 0] >= low) & (points.points[:, 0] < high)
    c = (cells.index[:, 0] >= low) & (cells.index[:, 0] < high)
    s = (surface.points[:, 0] >= low) & (surface.points[:, 0] < high)
    return [
        Points(
            "particles",
            points.points[p],
            {name: values[p] for name, values in points.fields.items()},
        ),
        Cells(
            "grid",
            cells.index[c],
            1.0,
            3,
            {name: values[c] for name, values in cells.fields.items()},
            COUNTS,
            box,
        ),
        Surface(
            "surface",
            surface.points[s],
            np.arange(s.sum()).reshape(-1, 3),
            {"velocity": surface.fields["velocity"][s]},
        ),
    ]


def write(folder: Path, grid_format: str, frames: int = 1) -> None:
    """Write the frame as three ranks do, one after the other."""
    folder.mkdir(exist_ok=True)
    for index in range(frames):
        found = []
        for rank, box in enumerate(BOXES):
            collective = Collective.for_one_process()
            collective.ranks.comm.rank = rank  # other data of the ranks are not used
            mine = RankFrames(FrameFolder(folder, grid_format), collective)
            mine.write(index, 0.5 * index, piece(box))
            found.append(mine.describe(piece(box)))
        if index == 0:
            first = RankFrames(FrameFolder(folder, grid_format), Collective.for_one_process())
        first.publish(index, 0.5 * index, found)


@pytest.mark.parametrize("grid_format", ["vtu", "vti"])
def test_vtk_reads_the_frame_of_one_process(tmp_path, grid_format):
    pyvista = pytest.importorskip("pyvista")
    write(tmp_path / "many", grid_format, frames=2)
    one = FrameFolder(tmp_path / "one", grid_format)
    one.folder.mkdir()
    for index in range(2):
        one.write(index, 0.5 * index, whole())
    for name in ("particles", "grid", "surface"):
        readers = [
            pyvista.get_reader(tmp_path / folder / f"{name}.pvd") for folder in ("one", "many")
        ]
        assert readers[0].time_values == readers[1].time_values == [0.0, 0.5]
        readers[1].set_active_time_value(0.5)
        expected, found = readers[0].read()[0], readers[1].read()[0]
        assert type(found) is type(expected)
        assert (found.n_points, found.n_cells) == (
            expected.n_points,
            expected.n_cells,
        ) or grid_format == "vtu"
        a, b = (ordered(mesh, name) for mesh in (expected, found))
        assert a.keys() == b.keys()
        for key in a:
            np.testing.assert_array_equal(a[key], b[key], err_msg=f"{name} {key}")


def ordered(mesh, name):
    """Return fields and positions of a data set in the order of the latter."""
    fields = dict(mesh.cell_data if name == "grid" else mesh.point_data)
    at = mesh.points
    if name == "grid":
        shown = np.flatnonzero(fields.pop("vtkGhostType", np.zeros(mesh.n_cells)) == 0)
        fields = {key: values[shown] for key, values in fields.items()}
        at = mesh.cell_centers().points
    order = np.lexsort(at.T)
    return {key: np.asarray(values)[order] for key, values in fields.items()} | {"at": at[order]}


@pytest.mark.parametrize("grid_format", ["vtu", "vti"])
def test_a_recording_of_pieces_is_that_of_one_process(dots, tmp_path, grid_format):
    text = (
        '[scene]\nsimulator = "dots"\n[time]\nduration = 1.0\nframes_per_second = '
        "2\n[domain]\nsize = [6.0, 4.0, 2.0]\nresolution = 6\n"
    )
    (tmp_path / "scene.toml").write_text(text)
    scene = dump_scene(load_scene(tmp_path / "scene.toml"))
    for folder in ("one", "many"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "scene.toml").write_text(scene)
    write(tmp_path / "many", grid_format, frames=2)
    for index in range(2):
        FrameFolder(tmp_path / "one", grid_format).write(index, 0.5 * index, whole())
    one, many = (
        Recording(tmp_path / folder, Color.PRESSURE, cells=True) for folder in ("one", "many")
    )
    assert many.numbers == one.numbers == [0, 1]
    for a, b in zip(one.read(1), many.read(1), strict=True):
        np.testing.assert_array_equal(np.sort(a, axis=0), np.sort(b, axis=0))
    assert many.scale.high == one.scale.high
    cells = many.frame(1).cells
    assert cells is not None and len(cells.index) == 20
    surface = Recording(tmp_path / "many").frame(0).surface
    assert surface is not None
    np.testing.assert_array_equal(
        surface.points[surface.corners], whole()[2].points.reshape(2, 3, 3)
    )
    assert FrameFolder(tmp_path / "many").missing("particles", 2) == []
    (tmp_path / "many" / "frames" / "rank_0001" / "particles_000001.vtu").unlink()
    # As if the rank had not written it.
    assert FrameFolder(tmp_path / "many").missing("particles", 2) == [1]
    with pytest.raises(RenderError, match=r"rank_0001.particles_000001.vtu: cannot be read"):
        many.read(1)


def test_pieces_without_points_count_only_if_all_are(tmp_path):
    full, none = (
        describe(Points("particles", np.zeros((n, 3)), {"velocity": np.zeros((n, 3))}), "vtu")
        for n in (4, 0)
    )
    write_whole(tmp_path / "a.pvtu", [("rank_0000/a.vtu", none), ("rank_0001/a.vtu", full)])
    assert piece_files(tmp_path / "a.pvtu") == [tmp_path / "rank_0001" / "a.vtu"]
    write_whole(tmp_path / "a.pvtu", [("rank_0000/a.vtu", none), ("rank_0001/a.vtu", none)])
    assert piece_files(tmp_path / "a.pvtu") == [tmp_path / "rank_0000" / "a.vtu"]
    other = describe(Points("particles", np.zeros((4, 3)), {"speed": np.zeros(4)}), "vtu")
    with pytest.raises(
        ValueError, match=r"rank_0001/a\.vtu has other fields than rank_0000/a\.vtu"
    ):
        write_whole(tmp_path / "c.pvtu", [("rank_0000/a.vtu", full), ("rank_0001/a.vtu", other)])
    assert not (tmp_path / "c.pvtu").exists()


def test_images_of_ranks_without_cells_fill_the_whole(tmp_path):
    empty = Cells(
        "grid",
        np.zeros((0, 3), dtype=int),
        0.5,
        2,
        {"pressure": np.zeros(0)},
        (8, 4, 1),
        ((0, 0, 0), (5, 4, 1)),
    )
    full = Cells(
        "grid",
        np.array([[6, 1, 0]]),
        0.5,
        2,
        {"pressure": np.ones(1)},
        (8, 4, 1),
        ((5, 0, 0), (8, 4, 1)),
    )
    write_whole(
        tmp_path / "grid.pvti",
        [("rank_0000/g.vti", describe(empty, "vti")), ("rank_0001/g.vti", describe(full, "vti"))],
    )
    text = (tmp_path / "grid.pvti").read_text()
    assert 'WholeExtent="0 8 0 4 0 0"' in text
    assert (
        '<Piece Extent="0 5 0 4 0 0" Source="rank_0000/g.vti"/>\n<Piece Extent="5 8 0 4 0 0" '
        'Source="rank_0001/g.vti"/>' in text
    )
    assert len(one_grid([empty, full]).index) == 1


def test_pieces_are_files_of_the_run(dots, tmp_path):
    """Part files as files of the run.

    A resumed run deletes later parts; --force deletes all, and nothing that does not belong to a
    run.
    """
    text = (
        '[scene]\nsimulator = "dots"\n[time]\nduration = 1.0\nframes_per_second = '
        "2\n[domain]\nsize = [6.0, 4.0, 2.0]\nresolution = 6\n"
    )
    (tmp_path / "scene.toml").write_text(text)
    out = tmp_path / "out"
    write(out, "vtu", frames=3)
    (out / "run.json").write_text("{}")
    FrameFolder(out).resume([0.0, 0.5])
    left = sorted(str(path.relative_to(out)) for path in out.glob("frames/**/particles*"))
    assert left == sorted(f"frames/{place}_00000{n}.{s}" for n in range(2) for place, s in places())
    assert (out / "particles.pvd").read_text().count(".pvtu") == 2
    folder = RunFolder(out, load_scene(tmp_path / "scene.toml"))
    folder.check_new(force=True)
    (out / "frames" / "rank_0001" / "notes.txt").write_text("mine")
    with pytest.raises(
        OutputError, match=r"holds files that do not belong to a run \(frames.rank_0001.notes.txt, "
    ):
        folder.check_new(force=True)
    (out / "frames" / "rank_0001" / "notes.txt").unlink()
    folder.start(RunRecord("dots", "dots", "cpu"))
    assert list((out / "frames").iterdir()) == []


def test_a_folder_that_ranks_do_not_share_is_refused(dots, scene_file, tmp_path):
    collective = Collective.for_one_process()
    collective.ranks.comm.rank = 1  # the first rank writes elsewhere
    folder = RunFolder(tmp_path / "out", load_scene(scene_file), collective)
    with pytest.raises(
        OutputError,
        match="is not the folder that rank 0 writes; choose one that all machines share",
    ):
        folder.start(RunRecord("dots", "dots", "cpu"))


def places():
    return [("particles", "pvtu"), *((f"rank_000{rank}/particles", "vtu") for rank in range(3))]


def test_a_file_that_is_no_index_is_refused(tmp_path):
    (tmp_path / "particles_000001.pvtu").write_text("<VTKFile")
    with pytest.raises(ValueError, match="is not a readable frame: not XML"):
        piece_files(tmp_path / "particles_000001.pvtu")
    with pytest.raises(RenderError, match="is not a readable frame"):
        recording._read(tmp_path / "particles_000001.pvtu", VtuMesh)


@pytest.mark.parametrize(
    "source",
    [
        "particles_000001.pvtu",  # itself
        "/etc/passwd",
        "../../frames/rank_0000/particles_000001.vtu",
        "rank_0000/../../secret.vtu",
        "rank_0000/particles_000001.pvtu",
        "rank_0000/particles_000002.vtu",
        "rank_0009/particles_000001.vtu",  # a link that leads out of the folder
    ],
)
def test_a_frame_names_pieces_of_its_own_alone(tmp_path, source):
    (tmp_path / "frames").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "frames" / "rank_0009").symlink_to(tmp_path / "elsewhere")
    whole = tmp_path / "frames" / "particles_000001.pvtu"
    write_whole(whole, [(source, describe(whole_points(), "vtu"))])
    with pytest.raises(
        RenderError,
        match=r"particles_000001\.pvtu: is not a readable frame: names '.*': a piece is "
        r"rank_0000/particles",
    ):
        recording._read(whole, VtuMesh)


def whole_points() -> Points:
    return Points("particles", np.zeros((4, 3)), {"velocity": np.zeros((4, 3))})


def test_a_piece_is_named_once(tmp_path):
    write_whole(tmp_path / "a.pvtu", [("rank_0000/a.vtu", describe(whole_points(), "vtu"))] * 2)
    with pytest.raises(ValueError, match="names a piece twice"):
        piece_files(tmp_path / "a.pvtu")


def test_entities_are_refused(tmp_path):
    """Refusal of XML entities: a few lines would become 10^9 characters."""
    lines = "".join(f'<!ENTITY a{n + 1} "{f"&a{n};" * 10}">' for n in range(9))
    (tmp_path / "a.pvtu").write_text(
        f'<!DOCTYPE x [<!ENTITY a0 "xxxxxxxxxx">{lines}]><VTKFile>&a9;</VTKFile>'
    )
    with pytest.raises(ValueError, match="declares a document type"):
        piece_files(tmp_path / "a.pvtu")
