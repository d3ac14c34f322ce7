"""Frames in meshio's formats.

Written, read back, resumed, drawn, or refused before any work is done.
"""

import importlib.util
import json
from pathlib import Path
from typing import get_args

import meshio
import numpy as np
import pytest
from rich.console import Console
from test_pieces import write as write_pieces

import warp_lcp as wl
from default_run import covering
from small_runs import ball, run_into
from warp_lcp.frames import meshio_format
from warp_lcp.frames.frame_folder import FRAME_FILE, FrameFolder, frame_bytes
from warp_lcp.frames.meshio_format import (
    MODULES,
    SUFFIXES,
    WRITTEN_ONLY,
    FrameFormat,
    MeshConversion,
    from_meshio,
    holds,
    kind_of,
    read_meshio,
    to_meshio,
    write_meshio,
)
from warp_lcp.frames.vti import write_vti
from warp_lcp.frames.vtu import VtuMesh, mesh_of, read_vtu, write_vtu
from warp_lcp.render.image_content import Color, RenderError
from warp_lcp.render.recording import Recording
from warp_lcp.render.render import ImageStyle, render_run
from warp_lcp.run.check import check_ranks, check_scene
from warp_lcp.run.progress import ProgressLines
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.table import SceneError
from warp_lcp.simulation import Cells, Points, Surface, Volume

RNG = np.random.default_rng(3301)
WHOLE = ("xdmf", "vtk", "gmsh", "med")  # formats that hold every part with its fields


def fields(count: int) -> dict[str, np.ndarray]:
    return {
        "velocity": RNG.normal(size=(count, 3)).astype(np.float32),
        "pressure": RNG.normal(size=count),
        "wall": RNG.random(count) < 0.5,
        "body": np.arange(count, dtype=np.int32),
    }


POINTS = RNG.random((7, 3)).astype(np.float32)
FLAT = POINTS * np.array([1, 1, 0], dtype=np.float32)
PARTS = {
    "points": Points("particles", POINTS, fields(7)),
    "triangles": Surface(
        "surface", POINTS, np.array([[0, 1, 2], [1, 2, 3], [4, 5, 6], [3, 4, 6]]), fields(7)
    ),
    "segments": Surface(
        "surface", FLAT, np.array([[0, 1], [1, 2], [2, 3], [4, 5], [5, 6]]), fields(7)
    ),
    "hexahedra": Cells("grid", np.array([[0, 0, 0], [1, 0, 0], [3, 4, 5]]), 0.1, 3, fields(3)),
    "squares": Cells("grid", np.array([[0, 0, 0], [1, 0, 0], [3, 4, 0]]), 0.1, 2, fields(3)),
}


DAMAGED = {"empty": b"", "zeros": b"\0" * 100, "text": b"nonsense\n1 2 3\n", "half": "half"}


def without(part):
    """Return a part of the same kind without points."""
    none = {name: values[:0] for name, values in part.fields.items()}
    if isinstance(part, Points):
        return Points(part.name, part.points[:0], none)
    if isinstance(part, Surface):
        return Surface(part.name, part.points[:0], part.corners[:0], none)
    return Cells(part.name, part.index[:0], part.spacing, part.dimension, none)


def same(found: VtuMesh, expected: VtuMesh, *, bare: bool) -> None:
    np.testing.assert_allclose(found.points, expected.points, rtol=1e-6, atol=1e-7)
    np.testing.assert_array_equal(found.corners, expected.corners)
    if bare:
        return
    assert found.on_cells == expected.on_cells
    assert found.fields.keys() == expected.fields.keys()
    for name, values in expected.fields.items():
        np.testing.assert_allclose(found.fields[name], values, rtol=1e-6, err_msg=name)


@pytest.mark.parametrize("name", SUFFIXES)
@pytest.mark.every_case
def test_large_ids_are_exact_in_formats_that_hold_fields(tmp_path, name):
    ids = RNG.permutation(2**40 + np.arange(7))
    part = Points("particles", POINTS, fields(7) | {"id": ids})
    held = holds(name, Points, 3)
    if held.dress is None or held.dress is MeshConversion.BARE or name in WRITTEN_ONLY:
        return
    file = tmp_path / f"particles_000001.{SUFFIXES[name]}"
    write_meshio(file, part, name)
    np.testing.assert_array_equal(np.ravel(read_meshio(file, name).fields["id"]), ids)


@pytest.mark.parametrize("name", SUFFIXES)
@pytest.mark.parametrize("part", PARTS)
def test_supported_data_round_trip_in_every_format(tmp_path, name, part):
    """Round trip of a part through each format.

    Without messages that would spoil a terminal, except meshio's warnings about the format.
    """
    if name == "med" and importlib.util.find_spec("h5py") is None:
        pytest.skip("needs h5py")
    source_part, held = PARTS[part], holds(name, *kind_of(PARTS[part]))
    file = tmp_path / f"{source_part.name}_000001.{SUFFIXES[name]}"
    assert FRAME_FILE.fullmatch(file.name)
    if held.dress is None:
        assert name not in WHOLE
        with pytest.raises(ValueError, match="cannot store"):
            write_meshio(file, source_part, name)
        assert list(tmp_path.iterdir()) == []
        return
    write_meshio(file, source_part, name)
    assert list(tmp_path.iterdir()) == [file]
    if name in WHOLE:
        assert held.dress is not MeshConversion.BARE
    bare = held.dress is MeshConversion.BARE
    found = from_meshio(getattr(meshio, MODULES.get(name, name)).read(str(file)))
    if name in WRITTEN_ONLY:
        with pytest.raises(ValueError, match="are written for other programs"):
            read_meshio(file, name)
    if name == "stl":  # it holds triangles one by one, without shared points
        np.testing.assert_allclose(
            found.points[found.corners],
            source_part.points[source_part.corners],
            rtol=1e-6,
            atol=1e-7,
        )
    else:
        same(found, mesh_of(source_part), bare=bare)
    if held.empty:
        write_meshio(file, without(source_part), name)
        assert (
            len(from_meshio(getattr(meshio, MODULES.get(name, name)).read(str(file))).points) == 0
        )


@pytest.mark.parametrize("name", ["xdmf", "vtk", "gmsh", "ply"])
def test_meshio_prints_nothing(tmp_path, capfd, name):
    holds.cache_clear()
    part = PARTS["triangles"]
    write_meshio(tmp_path / f"surface_000001.{SUFFIXES[name]}", part, name)
    assert capfd.readouterr() == ("", "")


def test_every_meshio_format_is_supported_or_known_to_be_unsuitable():
    """Formats of meshio: all are listed, or cannot be.

    Left out: other versions of a listed format, another format with the suffix of gmsh's, and
    formats that meshio does not read back.
    """
    versions, unread = {"gmsh22", "vtk42", "vtk51", "ansys"}, {"svg"}
    writers = set(meshio._helpers._writer_map)
    assert set(get_args(FrameFormat)) == {"vtu", *SUFFIXES}
    assert writers >= set(SUFFIXES)
    left_out = writers - set(SUFFIXES) - {"vtu"} - versions - unread
    assert left_out == {"cgns", "nastran", "neuroglancer", "tetgen", "ugrid", "wkt"}
    assert not unread & set(meshio._helpers.reader_map)
    for name, suffix in SUFFIXES.items():
        assert name in meshio.extension_to_filetypes[f".{suffix}"]


@pytest.mark.parametrize("name", ["cgns", "nastran", "tetgen", "ugrid"])
def test_formats_left_out_hold_no_part(monkeypatch, name):
    monkeypatch.setitem(meshio_format.SUFFIXES, name, "part")
    assert all(holds.__wrapped__(name, *kind_of(part)).dress is None for part in PARTS.values())


@pytest.mark.parametrize("part", PARTS)
def test_a_part_as_a_mesh(tmp_path, part):
    source_part = PARTS[part]
    mesh = to_meshio(source_part)
    assert isinstance(mesh, meshio.Mesh)
    assert (
        mesh.cells[0].type
        == {
            "points": "vertex",
            "triangles": "triangle",
            "segments": "line",
            "hexahedra": "hexahedron",
            "squares": "quad",
        }[part]
    )
    same(from_meshio(mesh), mesh_of(source_part), bare=False)
    assert bool(mesh.cell_data) == isinstance(source_part, Cells)
    write_vtu(tmp_path / f"{source_part.name}_000000.vtu", source_part)
    read = meshio.read(tmp_path / f"{source_part.name}_000000.vtu")
    np.testing.assert_array_equal(read.points, mesh.points)
    np.testing.assert_array_equal(read.cells[0].data, mesh.cells[0].data)
    mesh.write(tmp_path / "again.vtk")
    same(from_meshio(meshio.read(tmp_path / "again.vtk")), mesh_of(source_part), bare=False)


def test_a_volume_is_its_active_voxels():
    values = np.full((2, 3, 4), 0.2, dtype=np.float32)  # z, y, x
    values[1, 2, 3], values[0, 0, 1] = -0.05, 0.04
    mesh = to_meshio(Volume("level_set", values, 0.1, band=0.1, origin=(10, 0, 0)))
    corners = mesh.points[mesh.cells[0].data]
    np.testing.assert_allclose(corners.min(axis=1), [[1.1, 0.0, 0.0], [1.3, 0.2, 0.1]], atol=1e-6)
    np.testing.assert_allclose(corners.max(axis=1), [[1.2, 0.1, 0.1], [1.4, 0.3, 0.2]], atol=1e-6)
    np.testing.assert_array_equal(mesh.cell_data["level_set"][0], np.float32([0.04, -0.05]))
    assert len(to_meshio(Volume("density", np.zeros((2, 2, 2), np.float32), 0.1)).points) == 0


@pytest.mark.parametrize("part", PARTS)
def test_an_empty_frame(tmp_path, part):
    """Empty frames.

    meshio's own reader takes no VTU file without cells, not even its own; `read_frame` takes all of
    a run's.
    """
    none = without(PARTS[part])
    file = tmp_path / f"{none.name}_000000.vtu"
    write_vtu(file, none)
    mesh = wl.read_frame(file)
    assert (len(mesh.points), sum(len(block.data) for block in mesh.cells)) == (0, 0)
    assert (
        mesh.cell_data if isinstance(none, Cells) else mesh.point_data
    ).keys() == none.fields.keys()
    with pytest.raises(IndexError):  # once it succeeds, this and the page on frames can be removed
        meshio.read(file)
    for name in ("xdmf", "vtk", "gmsh"):
        folder = FrameFolder(tmp_path / name, frame_format=name)
        (written,) = folder.write(0, 0.0, [none])
        assert written.suffix == (
            ".vtu" if not holds(name, *kind_of(none)).empty else f".{SUFFIXES[name]}"
        )
        assert len(wl.read_frame(written).points) == 0
        assert folder.missing(none.name, 1) == []
        assert not (tmp_path / name / f"{none.name}.pvd").exists()


def test_frames_of_every_kind_are_read(tmp_path):
    write_vti(tmp_path / "grid_000003.vti", PARTS["hexahedra"])
    mesh = wl.read_frame(str(tmp_path / "grid_000003.vti"))
    np.testing.assert_allclose(
        np.sort(mesh.cell_data["pressure"][0]), np.sort(PARTS["hexahedra"].fields["pressure"])
    )
    write_pieces(tmp_path / "many", "vtu")
    for file in (tmp_path / "many" / "frames").glob("*.pvtu"):
        assert len(wl.read_frame(file).points) > 0
    for name in ("notes.txt", "particles_000001.nvdb", "particles.vtu"):
        with pytest.raises(ValueError, match="not a readable frame"):
            wl.read_frame(tmp_path / name)
    with pytest.raises(FileNotFoundError):
        wl.read_frame(tmp_path / "particles_000001.xdmf")


@pytest.mark.filterwarnings("ignore")  # of NumPy, on files without lines
@pytest.mark.parametrize(
    ("name", "content"), covering(list(SUFFIXES), list(DAMAGED), count=len(SUFFIXES))
)
def test_damaged_files_are_named(tmp_path, name, content):
    """Damaged files, named in the message.

    meshio must not end the process, as its own `read` does.
    """
    content = DAMAGED[content]
    part = next(
        (part for part in PARTS.values() if holds(name, *kind_of(part)).dress is not None), None
    )
    if part is None:
        pytest.skip("needs another package")
    file = tmp_path / f"{part.name}_000001.{SUFFIXES[name]}"
    write_meshio(file, part, name)
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2] if content == "half" else content)
    try:
        wl.read_frame(file)  # text that was cut may be a smaller mesh
    except ValueError as error:
        assert str(error).startswith(f"{file}: is not a readable frame: ")


def test_a_run_in_a_format_that_is_not_read_back_goes_on(scene_file, tmp_path):
    scene = load_scene(scene_file, ["time.duration=0.15", "output.format=mdpa"])
    run_into(scene, tmp_path / "out", last_frame=1)
    assert run_into(scene, tmp_path / "out", resume=True).status == "finished"
    with pytest.raises(RenderError, match=r'output.format = "mdpa" is for other programs'):
        Recording(tmp_path / "out")


@pytest.mark.parametrize("name", ["xdmf", "vtk", "gmsh", "ply", "stl"])
def test_the_bytes_of_a_frame_are_estimated(tmp_path, name):
    part = ball([0.0, 0.0, 0.0], 1.0)
    (file,) = FrameFolder(tmp_path, frame_format=name).write(0, 0.0, [part])
    assert (
        0.6 * file.stat().st_size
        < frame_bytes([part], frame_format=name)
        < 1.7 * file.stat().st_size
    )


# ---- runs


def quiet() -> ProgressLines:
    return ProgressLines(Console(quiet=True))


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("name", ["xdmf", "vtk", "gmsh"])
def test_a_run_in_another_format_goes_on_and_is_drawn(scene_file, tmp_path, name):
    plain, other = tmp_path / "plain", tmp_path / "other"
    short = ["time.duration=0.2"]
    run_into(load_scene(scene_file, short), plain)
    scene = load_scene(scene_file, [*short, f"output.format={name}"])
    run_into(scene, other, last_frame=2)
    record = run_into(scene, other, resume=True)
    assert record.status == "finished"
    assert not [warning for warning in record.warnings if "missing" in warning]
    files = sorted(path.name for path in (other / "frames").iterdir())
    assert files == [
        f"{part}_{index:06d}.{SUFFIXES[name]}"
        for part in ("grid", "particles")
        for index in range(5)
    ]
    assert not list(other.glob("*.pvd"))
    for index in range(5):
        for part in ("particles", "grid"):
            same(
                read_meshio(other / "frames" / f"{part}_{index:06d}.{SUFFIXES[name]}", name),
                read_vtu(plain / "frames" / f"{part}_{index:06d}.vtu"),
                bare=False,
            )
    one, two = Recording(plain, Color.SPEED), Recording(other, Color.SPEED)
    assert one.numbers == two.numbers == list(range(5))
    for number in one.numbers:
        for first, second in zip(one.read(number), two.read(number), strict=True):
            np.testing.assert_allclose(second, first, rtol=1e-6, atol=1e-9)
    assert len(list(render_run(other, looks=ImageStyle(cut=True, color=Color.SPEED)))) == 5
    run_into(scene, other, force=True)  # its files are the run's
    (other / "frames" / f"grid_000001.{SUFFIXES[name]}").unlink()
    record = run_into(
        load_scene(scene_file, ["time.duration=0.25", f"output.format={name}"]), other, resume=True
    )
    assert [warning for warning in record.warnings if "grid 1 are missing" in warning]


def test_the_format_may_change_when_a_run_goes_on(scene_file, tmp_path):
    out = tmp_path / "out"
    run_into(load_scene(scene_file, ["time.duration=0.2"]), out, last_frame=2)
    record = run_into(
        load_scene(scene_file, ["time.duration=0.2", "output.format=vtk"]), out, resume=True
    )
    assert record.changed == ['output.format: "vtu" before, "vtk" now']
    assert not [warning for warning in record.warnings if "missing" in warning]
    assert Recording(out).numbers == list(range(5))
    run_into(load_scene(scene_file, ["time.duration=0.25"]), out, resume=True)
    assert Recording(out).numbers == list(range(6))
    # The files that a collection can name.
    assert (out / "particles.pvd").read_text().count("DataSet ") == 4


def test_cells_as_images_beside_another_format(scene_file, tmp_path):
    scene = load_scene(
        scene_file, ["time.duration=0.1", "output.format=ply", "output.grid_format=vti"]
    )
    assert run_into(scene, tmp_path / "out").status == "finished"
    assert {path.suffix for path in (tmp_path / "out" / "frames").iterdir()} == {".ply", ".vti"}
    assert (tmp_path / "out" / "grid.pvd").is_file()
    assert Recording(tmp_path / "out", Color.SPEED).numbers == [0, 1, 2]


REFUSED = {
    "stl": "cannot store particles and grid",
    "off": "output.particles = false, output.grid = false, or choose vtu or xdmf or vtk or gmsh",
    "obj": "cannot store particles",
    "tecplot": "cannot store particles",
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_format_that_does_not_hold_the_parts_is_refused_before_any_work(
    dots, scene_file, tmp_path, name
):
    dots.refuse = "work was done"
    for refused in (
        lambda: run_into(load_scene(scene_file, [f"output.format={name}"]), tmp_path / "out"),
        lambda: check_scene(str(scene_file), [f"output.format={name}"]),
    ):
        with pytest.raises(SceneError, match=REFUSED[name]) as error:
            refused()
        assert f'output.format = "{name}"' in str(error.value)
    assert not (tmp_path / "out").exists()


def test_other_invalid_formats_are_refused(scene_file, tmp_path):
    with pytest.raises(SceneError, match=r"output.format"):
        load_scene(scene_file, ["output.format=doc"])
    with pytest.raises(SceneError, match="surface_ply"):
        check_scene(
            str(scene_file), ["output.format=ply", "output.surface_ply=true", "output.grid=false"]
        )
    with pytest.raises(SceneError, match=r"writes only .vtu pieces"):
        check_ranks(load_scene(scene_file, ["output.format=xdmf"]))
    if importlib.util.find_spec("netCDF4") is None:
        with pytest.raises(SceneError, match="needs netCDF4"):
            check_scene(str(scene_file), ["output.format=exodus"])


def test_fields_unsupported_by_a_format_are_reported(scene_file, tmp_path):
    scene = load_scene(scene_file, ["time.duration=0.1", "output.format=permas"])
    record = run_into(scene, tmp_path / "out", observer=quiet())
    assert record.warnings == [
        'output.format = "permas" writes the geometry of particles and grid, without fields'
    ]
    assert json.loads((tmp_path / "out" / "run.json").read_text())["warnings"] == record.warnings
    with pytest.raises(
        RenderError, match="the frames have no velocity, which --color speed needs; choose plain"
    ):
        list(render_run(tmp_path / "out", looks=ImageStyle(cut=True, color=Color.SPEED)))
    assert list(render_run(tmp_path / "out", looks=ImageStyle(cut=True, color=Color.PLAIN)))


def test_the_surface_of_a_liquid_as_stl(tmp_path):
    """Surface of a liquid as STL, for modelers and slicers.

    The file has no particles and no cells, but triangles alone.
    """
    scene = {
        "scene": {"simulator": "fluids"},
        "time": {"duration": 0.1, "frames_per_second": 20},
        "domain": {"size": [0.8, 0.4, 0.4], "resolution": 8},
        "liquid": [{"shape": "box", "min": [0.0, 0.0, 0.0], "max": [0.4, 0.3, 0.4]}],
        "output": {"particles": False, "grid": False, "surface": True, "format": "stl"},
    }
    seen = []
    for frame in wl.Run(scene, folder=tmp_path / "out", device="cpu"):
        meshes = frame.to_meshio()
        assert meshes.keys() >= {"particles", "grid", "surface"}
        np.testing.assert_array_equal(meshes["particles"].points, frame.particles.position.numpy())
        seen.append(meshes["surface"])
    files = sorted((tmp_path / "out" / "frames").iterdir())
    assert [path.name for path in files] == [f"surface_{index:06d}.stl" for index in range(3)]
    for mesh, file in zip(seen, files, strict=True):
        expected, found = mesh.points[mesh.cells[0].data], wl.read_frame(file)
        np.testing.assert_allclose(found.points[found.cells[0].data], expected, atol=1e-6)


def test_recordings_do_not_take_a_ply_beside_for_a_frame(tmp_path, scene_file):
    run_into(load_scene(scene_file, ["time.duration=0.05"]), tmp_path / "out")
    assert Path(tmp_path / "out").is_dir()
    (tmp_path / "out" / "frames" / "particles_000007.ply").write_bytes(b"ply")
    assert 7 not in Recording(tmp_path / "out").numbers
