"""Frames, read back by meshio and by VTK."""

import threading
import xml.etree.ElementTree as ET

import meshio
import numpy as np
import pytest

from warp_lcp.frames.frame_folder import WAITING, FrameFolder, FrameWriter, frame_bytes
from warp_lcp.frames.vtu import read_vtu, write_vtu
from warp_lcp.simulation import Cells, Points, Surface

RNG = np.random.default_rng(5807)


def some_points(count: int = 20) -> Points:
    fields = {
        "velocity": RNG.random((count, 3)).astype(np.float32),
        "flag": RNG.random(count) < 0.5,
        "half": RNG.random(count).astype(np.float16),
        "kind": np.arange(count, dtype=np.int8),
    }
    return Points("particles", RNG.random((count, 3)).astype(np.float32), fields)


def some_cells(dimension: int) -> Cells:
    index = np.array([[3, 2, 1], [4, 2, 1], [4, 3, 1], [9, 9, 1]]) * [1, 1, dimension == 3]
    return Cells(
        "grid",
        index,
        0.25,
        dimension,
        {"pressure": np.arange(4.0), "wall": np.array([True, False, True, False])},
    )


def test_points_round_trip(tmp_path):
    points = some_points()
    write_vtu(tmp_path / "a.vtu", points)
    mesh = meshio.read(tmp_path / "a.vtu")
    assert mesh.points.dtype == np.float32
    np.testing.assert_array_equal(mesh.points, points.points)
    np.testing.assert_array_equal(mesh.cells_dict["vertex"].ravel(), np.arange(20))
    for name, dtype in [
        ("velocity", np.float32),
        ("flag", np.uint8),
        ("half", np.float32),
        ("kind", np.int8),
    ]:
        assert mesh.point_data[name].dtype == dtype
        np.testing.assert_array_equal(mesh.point_data[name], points.fields[name])


@pytest.mark.parametrize(("dimension", "kind", "corners"), [(2, "quad", 12), (3, "hexahedron", 24)])
def test_cells_share_corners(tmp_path, dimension, kind, corners):
    cells = some_cells(dimension)
    write_vtu(tmp_path / "a.vtu", cells)
    mesh = meshio.read(tmp_path / "a.vtu")
    # Three cells in an L: 8 corners a layer, and 4 of the separate one.
    assert len(mesh.points) == corners
    np.testing.assert_allclose(mesh.points[mesh.cells_dict[kind][:, 0]], cells.index * 0.25)
    middle = np.array([0.5, 0.5, 0.5 if dimension == 3 else 0.0])
    np.testing.assert_allclose(
        mesh.points[mesh.cells_dict[kind]].mean(axis=1), (cells.index + middle) * 0.25
    )
    np.testing.assert_array_equal(mesh.cell_data["pressure"][0], np.arange(4.0))
    np.testing.assert_array_equal(mesh.cell_data["wall"][0], [1, 0, 1, 0])


def some_surface(dimension: int) -> Surface:
    """Return a tetrahedron, or a square in 2-D, oriented outward."""
    points = np.array(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
        if dimension == 3
        else [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    )
    corners = (
        [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
        if dimension == 3
        else [[0, 1], [1, 2], [2, 3], [3, 0]]
    )
    fields = {"velocity": RNG.random((4, 3)).astype(np.float32), "body": np.arange(4)}
    return Surface("surface", points.astype(np.float32), np.array(corners, dtype=np.int32), fields)


@pytest.mark.parametrize(("dimension", "kind"), [(2, "line"), (3, "triangle")])
def test_surfaces_round_trip(tmp_path, dimension, kind):
    surface = some_surface(dimension)
    write_vtu(tmp_path / "a.vtu", surface)
    mesh = meshio.read(tmp_path / "a.vtu")
    np.testing.assert_array_equal(mesh.points, surface.points)
    np.testing.assert_array_equal(mesh.cells_dict[kind], surface.corners)
    for name, values in surface.fields.items():
        np.testing.assert_array_equal(mesh.point_data[name], values)


def test_vtk_finds_the_volume_inside_a_surface(tmp_path):
    pyvista = pytest.importorskip("pyvista", reason="VTK reads the files back")
    write_vtu(tmp_path / "a.vtu", some_surface(3))
    mesh = pyvista.read(tmp_path / "a.vtu").extract_surface(algorithm="dataset_surface")
    assert mesh.is_all_triangles
    # VTK's sign: triangles are counterclockwise from outside.
    np.testing.assert_allclose(mesh.volume, 1 / 6)
    outward = mesh.compute_normals(
        point_normals=False, consistent_normals=False, auto_orient_normals=False
    ).cell_data["Normals"]
    assert (np.einsum("ij,ij->i", outward, mesh.cell_centers().points - 0.25) > 0).all()
    write_vtu(tmp_path / "b.vtu", some_surface(2))
    outline = pyvista.read(tmp_path / "b.vtu")
    np.testing.assert_allclose(outline.compute_cell_sizes()["Length"], 1.0)
    assert set(outline.celltypes) == {pyvista.CellType.LINE}


def test_vtk_opens_a_collection(tmp_path):
    pyvista = pytest.importorskip("pyvista", reason="VTK reads the files back")
    folder = FrameFolder(tmp_path)
    for index in range(3):
        folder.write(index, index / 7, [some_points(4 + index), some_surface(3)])
    for name, sizes in [("particles", [4, 5, 6]), ("surface", [4, 4, 4])]:
        reader = pyvista.get_reader(tmp_path / f"{name}.pvd")
        assert reader.time_values == [0.0, 1 / 7, 2 / 7]
        for index, size in enumerate(sizes):
            reader.set_active_time_point(index)
            assert reader.read()[0].n_points == size


@pytest.mark.parametrize("count", [0, 1, 2, 65536, 65537, 65538, 200_000])
def test_arrays_of_every_length_survive_their_pieces(tmp_path, count):
    points = Points(
        "particles",
        RNG.random((count, 3)).astype(np.float32),
        {"kind": np.arange(count, dtype=np.uint8)},
    )
    write_vtu(tmp_path / "a.vtu", points)
    pyvista = pytest.importorskip("pyvista", reason="VTK reads the files back")
    cloud = pyvista.read(tmp_path / "a.vtu")
    np.testing.assert_array_equal(cloud.points.reshape(-1, 3), points.points)
    np.testing.assert_array_equal(cloud.point_data["kind"], points.fields["kind"])
    if count:
        np.testing.assert_array_equal(meshio.read(tmp_path / "a.vtu").points, points.points)


@pytest.mark.parametrize(
    "part",
    [
        some_points(),
        some_points(0),
        some_cells(2),
        some_cells(3),
        Cells("grid", np.empty((0, 3), int), 1.0, 3),
    ],
)
def test_vtk_opens_every_frame(tmp_path, part):
    pyvista = pytest.importorskip("pyvista")
    write_vtu(tmp_path / "a.vtu", part)
    grid = pyvista.read(tmp_path / "a.vtu")
    size = len(part.points if isinstance(part, Points) else part.index)
    assert grid.n_cells == size
    data = grid.point_data if isinstance(part, Points) else grid.cell_data
    assert set(data.keys()) == part.fields.keys()
    if isinstance(part, Cells) and size:
        measure = "Area" if part.dimension == 2 else "Volume"
        # Positive: VTK's corner order.
        np.testing.assert_allclose(grid.compute_cell_sizes()[measure], 0.25**part.dimension)


def test_a_field_of_another_length_is_refused(tmp_path):
    with pytest.raises(ValueError, match="'speed' has 3 entries for 2 points or cells"):
        write_vtu(tmp_path / "a.vtu", Points("particles", np.zeros((2, 3)), {"speed": np.zeros(3)}))
    assert list(tmp_path.iterdir()) == []


def test_estimate_is_near_the_files(tmp_path):
    points, cells = (
        some_points(5000),
        Cells("grid", np.argwhere(np.ones((12, 12, 12))), 0.1, 3, {"pressure": np.zeros(1728)}),
    )
    for part in (points, cells):
        write_vtu(tmp_path / "a.vtu", part)
        size = (tmp_path / "a.vtu").stat().st_size
        assert size * 0.95 < frame_bytes([part]) < size * 1.5


def entries(path):
    return [(float(e.get("timestep")), e.get("file")) for e in ET.parse(path).iter("DataSet")]


def test_collections_grow_and_resume(tmp_path):
    folder = FrameFolder(tmp_path)
    for index in range(4):
        folder.write(index, index / 3, [some_points(3)])
    assert entries(tmp_path / "particles.pvd") == [
        (k / 3, f"frames/particles_{k:06d}.vtu") for k in range(4)
    ]
    (tmp_path / "frames" / "notes.vtu").write_text("not a frame")
    resumed = FrameFolder(tmp_path)
    resumed.resume([0.0, 1 / 3])
    assert len(entries(tmp_path / "particles.pvd")) == 2
    assert sorted(p.name for p in (tmp_path / "frames").iterdir()) == [
        "notes.vtu",
        "particles_000000.vtu",
        "particles_000001.vtu",
    ]
    resumed.write(2, 2 / 3, [some_points(3)])
    assert [time for time, _ in entries(tmp_path / "particles.pvd")] == [0.0, 1 / 3, 2 / 3]
    assert all((tmp_path / file).is_file() for _, file in entries(tmp_path / "particles.pvd"))


class SlowFolder(FrameFolder):
    """Frame folder that blocks writes until released, with one that fails."""

    def __init__(self, folder, fails: int = -1) -> None:
        super().__init__(folder)
        self.fails = fails
        self.gate = threading.Semaphore(0)
        self.threads: set[int] = set()

    def write(self, index, time, frame):
        assert self.gate.acquire(timeout=10)
        self.threads.add(threading.get_ident())
        if index == self.fails:
            raise OSError("no more")
        return super().write(index, time, frame)


def written(path) -> list[int]:
    return sorted(int(file.stem[-6:]) for file in path.glob("frames/*.vtu"))


def test_a_writer_s_frames_are_written_in_order_on_one_other_thread(tmp_path):
    folder = SlowFolder(tmp_path)
    with FrameWriter(folder) as writer:
        for index in range(WAITING):
            writer.put(index, float(index), [some_points(3)])
        assert (writer.newest, written(tmp_path)) == (None, [])  # `put` has not waited
        writer.check()
        folder.gate.release(WAITING)
        writer.flush()
        assert (writer.newest, written(tmp_path)) == (WAITING - 1, list(range(WAITING)))
        folder.gate.release()
        writer.put(WAITING, float(WAITING), [some_points(3)])
    assert written(tmp_path) == list(range(WAITING + 1))  # leaving waits
    assert [time for time, _ in entries(tmp_path / "particles.pvd")] == [
        float(k) for k in range(WAITING + 1)
    ]
    assert len(folder.threads) == 1
    assert threading.get_ident() not in folder.threads


def test_a_writer_holds_few_frames(tmp_path):
    folder = SlowFolder(tmp_path)
    with FrameWriter(folder) as writer:
        for index in range(WAITING):
            writer.put(index, float(index), [some_points(3)])
        release = threading.Timer(0.2, folder.gate.release)
        release.start()
        writer.put(WAITING, float(WAITING), [some_points(3)])
        assert writer.newest is not None  # it has waited until one was written
        folder.gate.release(WAITING)
    release.join()


def test_a_writer_error_is_raised_every_time_and_stops_later_frames(tmp_path):
    folder = SlowFolder(tmp_path, fails=1)
    folder.gate.release(10)
    writer = FrameWriter(folder)
    with pytest.raises(OSError, match="no more"), writer:
        for index in range(3):
            writer.put(index, float(index), [some_points(3)])
    for call in (writer.check, writer.flush, lambda: writer.put(3, 3.0, [])):
        with pytest.raises(OSError, match="no more"):
            call()
    assert (writer.newest, written(tmp_path)) == (0, [0])


def test_another_error_is_not_hidden_by_the_writer_s(tmp_path):
    folder = SlowFolder(tmp_path, fails=0)
    folder.gate.release(10)
    with pytest.raises(RuntimeError, match="first"), FrameWriter(folder) as writer:
        writer.put(0, 0.0, [some_points(3)])
        raise RuntimeError("first")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"Float32", b"Float512"),
        (b'NumberOfComponents="3"', b'NumberOfComponents="0"'),
        (b'NumberOfComponents="3"', b'NumberOfComponents="1000000000000"'),
        (b'format="binary">', b'format="binary">////'),
        (b'format="binary"', b'format="ascii"'),
        (b'Name="types"', b'Name="kinds"'),
        (b"PointData", b"PairData"),
        (b'header_type="UInt64"', b'header_type="UInt64" compressor="vtkZLibDataCompressor"'),
        (b"<UnstructuredGrid>", b"<UnstructuredGrid><Piece/></UnstructuredGrid><UnstructuredGrid>"),
    ],
)
def test_a_frame_with_impossible_sizes_is_refused(tmp_path, old, new):
    write_vtu(
        tmp_path / "a.vtu",
        Points(
            "a", np.ones((4, 3), dtype=np.float32), {"velocity": np.ones((4, 3), dtype=np.float32)}
        ),
    )
    assert read_vtu(tmp_path / "a.vtu").fields["velocity"].shape == (4, 3)
    whole = (tmp_path / "a.vtu").read_bytes()
    assert old in whole
    (tmp_path / "a.vtu").write_bytes(whole.replace(old, new))
    with pytest.raises(ValueError, match=r"a\.vtu: is not a readable frame: "):
        read_vtu(tmp_path / "a.vtu")
