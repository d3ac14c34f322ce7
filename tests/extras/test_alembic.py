"""Runs as Alembic archives, read back by Alembic and Blender; frames are read by meshio."""

import gc
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import meshio
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from command_line import invoke
from film_tools import blender
from small_runs import ball, box, write_run
from warp_lcp.extras.export import export_run
from warp_lcp.render.image_content import RenderError, VisiblePart
from warp_lcp.simulation import Part, Points, Surface

pytest.importorskip("alembic3d", reason="export needs alembic3d, the extra `alembic`")
from alembic3d import Abc, AbcGeom

RATE, ROOM = 20, (1.0, 1.0, 1.0)

IN_BLENDER = """
import json, sys
import bpy, numpy as np
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.render.fps = 20
bpy.ops.wm.alembic_import(filepath=sys.argv[1], as_background_job=False, set_frame_range=True)
frames, found = range(scene.frame_start, scene.frame_end + 1), {}
def read(values, name):
    numbers = np.empty(3 * len(values), dtype=np.float32)
    values.foreach_get(name, numbers)
    return numbers.reshape(-1, 3)
for number in frames:
    scene.frame_set(number)
    graph = bpy.context.evaluated_depsgraph_get()
    for item in scene.objects:
        if item.type == "EMPTY":
            continue
        data, place = item.evaluated_get(graph).data, np.array(item.matrix_world)
        points = read(data.attributes["position"].data, "vector") @ place[:3, :3].T + place[:3, 3]
        one = {"points": points.tolist()}
        if "velocity" in data.attributes:
            velocity = read(data.attributes["velocity"].data, "vector") @ place[:3, :3].T
            one["velocity"] = velocity.tolist()
        if item.type == "MESH":
            data.calc_loop_triangles()
            one["corners"] = [list(triangle.vertices) for triangle in data.loop_triangles]
        if item.type == "POINTCLOUD":
            one["radius"] = data.points[0].radius
        found[f"{item.name} {number}"] = one
print("FOUND" + json.dumps({"range": [frames[0], frames[-1]], "items": found}))
"""


def moved(points: np.ndarray, number: int) -> np.ndarray:
    """Return a velocity that differs from point to point."""
    return (np.sin(9.0 * points) + number).astype(np.float32)


def frames_of_ball_and_drops(count: int, *, ids: bool = False) -> list[list[Part]]:
    """Return a ball that grows, with a new mesh, and drops that come, leave and mix."""
    rng, frames = np.random.default_rng(771), []
    for number in range(count):
        surface = ball([0.5, 0.4 + 0.02 * number, 0.5], 0.2 + 0.01 * number)
        first = number * 40  # points that are left out
        velocity = moved(surface.points[first:], number)
        kept = (surface.corners >= first).all(axis=1)
        corners = surface.corners[kept] - first
        points = surface.points[first:].astype(np.float32)
        drops = rng.uniform(0.0, 1.0, (30 + 5 * number, 3)).astype(np.float32)
        fields = {"velocity": moved(drops, number)}
        if ids:
            fields["id"] = rng.permutation(100)[: len(drops)].astype(np.int64)
            fields["age"] = rng.uniform(0.0, 1.0, len(drops)).astype(np.float32)
        frames.append(
            [
                Surface("surface", points, corners, {"velocity": velocity}),
                Points("particles", drops, fields),
            ]
        )
    return frames


def opened(file: Path) -> SimpleNamespace:
    archive = Abc.IArchive(str(file))
    top = archive.getTop()
    return SimpleNamespace(archive=archive, top=top, names=[one.getName() for one in top.children])


def exported(folder: Path, file: Path, **options) -> SimpleNamespace:
    list(export_run(folder, file, **options))
    return opened(file)


def at(schema, time: float):
    return schema.getValue(Abc.ISampleSelector(float(time)))  # an int is taken as a time, too


def array(values) -> np.ndarray:
    return np.array(values).reshape(len(values), -1).squeeze()


@pytest.mark.every_case
@pytest.mark.parametrize("ids", [False, True])
def test_an_archive_has_what_the_frames_have(dots, tmp_path, ids):
    folder = write_run(tmp_path / "run", frames_of_ball_and_drops(4, ids=ids), size=ROOM)
    archive = exported(folder, tmp_path / "run.abc", show=VisiblePart.BOTH)
    assert archive.names == ["surface", "particles"]
    surface = AbcGeom.IPolyMesh(archive.top, "surface").getSchema()
    particles = AbcGeom.IPoints(archive.top, "particles").getSchema()
    assert surface.getNumSamples() == particles.getNumSamples() == 4
    assert str(surface.getTopologyVariance()).endswith("kHeterogenousTopology")
    for number in range(4):
        time = number / RATE
        assert surface.getTimeSampling().getSampleTime(number) == pytest.approx(time)
        frame = meshio.read(folder / "frames" / f"surface_{number:06d}.vtu")
        found = at(surface, time)
        np.testing.assert_array_equal(array(found.getPositions()), frame.points)
        np.testing.assert_array_equal(array(found.getVelocities()), frame.point_data["velocity"])
        assert set(array(found.getFaceCounts())) == {3}
        corners = array(found.getFaceIndices()).reshape(-1, 3)[:, ::-1]
        np.testing.assert_array_equal(corners, frame.cells[0].data)
        frame = meshio.read(folder / "frames" / f"particles_{number:06d}.vtu")
        found = at(particles, time)
        own = frame.point_data["id"].ravel() if ids else np.arange(len(frame.points))
        order = np.argsort(own)
        np.testing.assert_array_equal(array(found.getIds()), own[order])
        np.testing.assert_array_equal(array(found.getPositions()), frame.points[order])
        np.testing.assert_array_equal(
            array(found.getVelocities()), frame.point_data["velocity"][order]
        )
        widths = particles.getWidthsParam().getExpandedValue()
        assert list(widths.getVals()) == pytest.approx([0.1])
        if ids:
            age = AbcGeom.IFloatGeomParam(particles.getArbGeomParams(), "age")
            values = age.getExpandedValue(Abc.ISampleSelector(float(time))).getVals()
            np.testing.assert_array_equal(array(values), frame.point_data["age"].ravel()[order])


def test_whitewater_has_kinds(dots, tmp_path):
    frames = []
    for number in range(2):
        drops = np.linspace(0.1, 0.9, 3 * (4 + number), dtype=np.float32).reshape(-1, 3)
        kind = np.arange(len(drops), dtype=np.uint8) % 3
        fields = {"velocity": moved(drops, number), "kind": kind}
        frames.append([ball([0.5, 0.5, 0.5], 0.1), Points("whitewater", drops, fields)])
    folder = write_run(tmp_path / "run", frames, size=ROOM)
    archive = exported(folder, tmp_path / "run.abc")
    assert archive.names == ["surface", "whitewater"]
    points = AbcGeom.IPoints(archive.top, "whitewater").getSchema()
    kinds = AbcGeom.IFloatGeomParam(points.getArbGeomParams(), "kind")
    for number, (_, drops) in enumerate(frames):
        found = at(points, number / RATE)
        np.testing.assert_array_equal(array(found.getPositions()), drops.points)
        values = kinds.getExpandedValue(Abc.ISampleSelector(number / RATE)).getVals()
        np.testing.assert_array_equal(array(values), drops.fields["kind"])


def test_ids_that_alembic_cannot_hold(dots, tmp_path):
    points = np.zeros((2, 3), dtype=np.float32)
    drops = Points("particles", points, {"id": np.array([1, 2**31], dtype=np.int64)})
    folder = write_run(tmp_path / "run", [[drops]], size=ROOM)
    with pytest.raises(RenderError, match=r"ids of particles exceed 2147483647: export USD"):
        list(export_run(folder, tmp_path / "run.abc"))
    assert [entry.name for entry in tmp_path.iterdir()] == ["run"]


def test_blender_shows_the_frames(dots, tmp_path):
    folder = write_run(tmp_path / "run", frames_of_ball_and_drops(4), size=ROOM)
    list(export_run(folder, tmp_path / "run.abc", show=VisiblePart.BOTH, first=1))
    text = blender(IN_BLENDER, tmp_path / "run.abc")
    found = json.loads(text[text.index("FOUND") + 5 :].splitlines()[0])
    assert found["range"] == [1, 3]
    for number in (1, 2, 3):
        for name in ("surface", "particles"):
            frame = meshio.read(folder / "frames" / f"{name}_{number:06d}.vtu")
            one = found["items"][f"{name} {number}"]
            x, y, z = np.array(one["points"]).T  # z is up
            np.testing.assert_allclose(np.stack([x, z, -y], axis=1), frame.points, atol=1e-6)
            x, y, z = np.array(one["velocity"]).T
            velocity = frame.point_data["velocity"]
            np.testing.assert_allclose(np.stack([x, z, -y], axis=1), velocity, atol=1e-6)
            if name == "particles":
                assert one["radius"] == pytest.approx(0.05)
                continue
            points = np.array(one["points"])
            a, b, c = np.moveaxis(points[one["corners"]], 1, 0)
            middle = points.mean(axis=0)  # outward: the ball is open, but seen from its middle
            assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), a - middle) > 0.0).mean() > 0.95


SOLID = """
[[solid]]
shape = "sphere"
center = [0.3, 0.3, 0.5]
radius = 0.1
motion = { kind = "translation", velocity = [0.2, 0.0, 0.0] }
"""


def test_bodies_and_solids_are_placed(dots, tmp_path):
    part = box([-0.1, -0.05, -0.02], [0.1, 0.05, 0.02])
    frames = []
    for number in range(3):
        turn = Rotation.from_rotvec(np.radians([12.0 * number, 40.0 * number, 0.0]))
        points = turn.apply(part.points) + np.array([0.5, 0.3 + 0.05 * number, 0.5])
        body = {"body": np.full(len(points), 2, dtype=np.int32)}
        frames.append(Surface("bodies", points.astype(np.float32), part.corners, body))
    first = ball([0.5, 0.5, 0.5], 0.1)
    folder = write_run(tmp_path / "run", [[first, body] for body in frames], SOLID, ROOM)
    archive = exported(folder, tmp_path / "run.abc")
    assert archive.names == ["surface", "solid_0", "body_2"]
    solid = AbcGeom.IXform(archive.top, "solid_0").getSchema()
    assert list(at(solid, 0.1).getMatrix().translation()) == pytest.approx([0.02, 0.0, 0.0])
    body = AbcGeom.IXform(archive.top, "body_2")
    shape = AbcGeom.IPolyMesh(body, "shape").getSchema()
    assert shape.getNumSamples() == 1
    points = array(at(shape, 0.0).getPositions())
    for number, expected in enumerate(frames):
        matrix = np.array(at(body.getSchema(), number / RATE).getMatrix()).reshape(4, 4)
        placed = points @ matrix[:3, :3] + matrix[3, :3]  # of row vectors
        np.testing.assert_allclose(placed, expected.points, atol=1e-6)


def test_outlines_of_flat_runs_are_curves(dots, tmp_path):
    folder = write_run(tmp_path / "run", [[ball([0.4 + 0.1 * n, 0.5], 0.2)] for n in range(3)])
    archive = exported(folder, tmp_path / "run.abc")
    curves = AbcGeom.ICurves(archive.top, "surface").getSchema()
    frame = meshio.read(folder / "frames" / "surface_000001.vtu")
    found = at(curves, 0.05)
    assert set(array(found.getCurvesNumVertices())) == {2}
    expected = frame.points[frame.cells[0].data.ravel()]
    np.testing.assert_array_equal(array(found.getPositions()), expected)


def test_frames_without_material_and_without_velocity(dots, tmp_path):
    nothing = Surface(
        "surface", np.zeros((0, 3), dtype=np.float32), np.zeros((0, 3), dtype=np.int32)
    )
    folder = write_run(tmp_path / "run", [[nothing], [ball([0.5, 0.5, 0.5], 0.1)]], size=ROOM)
    archive = exported(folder, tmp_path / "run.abc")
    surface = AbcGeom.IPolyMesh(archive.top, "surface").getSchema()
    assert [len(at(surface, number / RATE).getPositions()) > 0 for number in (0, 1)] == [
        False,
        True,
    ]


def test_the_end_of_a_run_may_lie_between_two_frames(dots, tmp_path):
    folder = write_run(tmp_path / "run", [[ball([0.5, 0.5], 0.2)]] * 3)
    text = (folder / "scene.toml").read_text()
    (folder / "scene.toml").write_text(text.replace("duration = 1.0", "duration = 0.09"))
    archive = exported(folder, tmp_path / "run.abc")
    times = AbcGeom.ICurves(archive.top, "surface").getSchema().getTimeSampling()
    assert [times.getSampleTime(number) for number in range(3)] == pytest.approx([0.0, 0.05, 0.09])


def test_wrong_input_leaves_no_file(dots, tmp_path, monkeypatch):
    folder = write_run(tmp_path / "run", [[ball([0.5, 0.5], 0.2)]] * 2)
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.abc").mkdir()
    for file, expected in [
        ("folder.abc", "is a folder; name a file"),
        ("file/a.abc", "cannot be written"),
    ]:
        result = invoke("export", folder, "--out", tmp_path / file)
        assert result.exit_code == 2
        assert expected in " ".join(result.stderr.split())
    result = invoke("export", folder, "--out", tmp_path / "a.abc", "--show", "particles")
    assert "holds no frames of particles" in " ".join(result.stderr.split())
    monkeypatch.setitem(sys.modules, "alembic3d", None)
    result = invoke("export", folder, "--out", tmp_path / "a.abc")
    assert result.exit_code == 2
    assert "pip install 'warp-lcp[alembic]'" in " ".join(result.stderr.split())
    assert sorted(one.name for one in tmp_path.iterdir()) == ["file", "folder.abc", "run"]


@pytest.mark.parametrize("solids", [0, 40])
def test_a_full_disk_is_reported_and_does_not_abort(dots, tmp_path, solids):
    """Disk that is full while frames are added, or already while solids are."""
    resource = pytest.importorskip("resource", reason="limits of files are for POSIX")
    sphere = '[[solid]]\nshape = "sphere"\ncenter = [0.5, 0.5, 0.5]\nradius = {}\n'
    text = "".join(sphere.format(0.1 + 0.001 * number) for number in range(solids))
    folder = write_run(tmp_path / "run", frames_of_ball_and_drops(6), text, size=ROOM)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
        cause = r"run\.abc: cannot be written: no space left, or a failing disk"
        with pytest.raises(RenderError, match=cause):
            list(export_run(folder, tmp_path / "run.abc"))
        gc.collect()  # closing the archive would end the process
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [entry.name for entry in tmp_path.iterdir()] == ["run"]


def test_an_aborted_export_leaves_no_file(dots, tmp_path):
    folder = write_run(tmp_path / "run", [[ball([0.5, 0.5, 0.5], 0.2)]] * 3, size=ROOM)
    export = export_run(folder, tmp_path / "out" / "run.abc")
    next(export)
    export.close()
    assert list((tmp_path / "out").iterdir()) == []
