"""Runs as USD files, read back by USD's library; frames are read by meshio."""

import sys
from pathlib import Path

import meshio
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from command_line import invoke
from mesh_checks import assert_closed, enclosed
from small_liquids import GRAVITY, scene
from small_runs import ball, box, run_into, write_run
from warp_lcp.extras.export import export_format, export_run
from warp_lcp.frames.frame_folder import FrameFolder
from warp_lcp.render.image_content import RenderError, VisiblePart
from warp_lcp.simulation import Points, Surface

pytest.importorskip("pxr", reason="export needs usd-core, the extra `usd`")
from pxr import Gf, Usd, UsdGeom

LAST, RATE, STEP = 4, 30, 1 / 120  # frames, frames per second, longest time step [s]
RADIUS = 0.25
ROOM = (1.0, 1.0, 1.0)


@pytest.fixture(scope="module")
def falls(tmp_path_factory) -> dict[int, Path]:
    """Return runs of a ball of liquid in free fall, in 2-D and 3-D."""
    runs = {}
    for dimension in (2, 3):
        liquid = [{"shape": "sphere", "center": [0.5, 0.65, 0.5][:dimension], "radius": RADIUS}]
        time = {"duration": 1.0, "frames_per_second": RATE, "dt_max": STEP}
        falling = scene(
            size=[1.0] * dimension,
            resolution=16,
            liquid=liquid,
            time=time,
            output={"surface": True},
        )
        runs[dimension] = tmp_path_factory.mktemp("falls") / f"fall-{dimension}"
        run_into(falling, runs[dimension], last_frame=LAST)
    return runs


def exported(folder: Path, file: Path, **options) -> Usd.Stage:
    list(export_run(folder, file, **options))
    return Usd.Stage.Open(str(file))


def prim(stage: Usd.Stage, name: str) -> Usd.Prim:
    return stage.GetDefaultPrim().GetChild(name)


def get(stage: Usd.Stage, name: str, attribute: str, code: float) -> np.ndarray:
    return np.asarray(prim(stage, name).GetAttribute(attribute).Get(code))


def placed(stage: Usd.Stage, name: str, code: float) -> np.ndarray:
    """Return the points of a prim in the stage's coordinates."""
    matrix = UsdGeom.XformCache(code).GetLocalToWorldTransform(prim(stage, name))
    return np.array(
        [
            matrix.Transform(Gf.Vec3d(*map(float, point)))
            for point in get(stage, name, "points", code)
        ]
    )


def corners(stage: Usd.Stage, name: str, code: float) -> np.ndarray:
    """Return the triangles of a mesh that USD finds valid."""
    indices, counts = (
        prim(stage, name).GetAttribute(f"faceVertex{kind}").Get(code)
        for kind in ("Indices", "Counts")
    )
    valid, why = UsdGeom.Mesh.ValidateTopology(
        indices, counts, len(get(stage, name, "points", code))
    )
    assert valid, why
    assert set(counts) == {3}
    return np.asarray(indices).reshape(-1, 3)


def names(stage: Usd.Stage) -> list[str]:
    return [child.GetName() for child in stage.GetDefaultPrim().GetChildren()]


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_stage_says_units_axes_and_times(falls, tmp_path, dimension):
    stage = exported(falls[dimension], tmp_path / "fall.usdc", show=VisiblePart.BOTH)
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert (stage.GetTimeCodesPerSecond(), stage.GetFramesPerSecond()) == (RATE, RATE)
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, LAST)
    assert names(stage) == ["surface", "particles"]
    for name in names(stage):
        for attribute in ("points", "velocities", "extent"):
            assert prim(stage, name).GetAttribute(attribute).GetTimeSamples() == list(
                range(LAST + 1)
            )


@pytest.mark.parametrize("dimension", [2, 3])
def test_particles_are_those_of_the_frames(falls, tmp_path, dimension):
    stage = exported(falls[dimension], tmp_path / "fall.usdc", show=VisiblePart.PARTICLES)
    assert names(stage) == ["particles"]
    (width,) = get(stage, "particles", "widths", 0.0)
    assert width == pytest.approx(1 / 32, rel=0.1)  # two particles along a side of a cell
    for number in range(LAST + 1):
        frame = meshio.read(falls[dimension] / "frames" / f"particles_{number:06d}.vtu")
        np.testing.assert_array_equal(get(stage, "particles", "points", number), frame.points)
        np.testing.assert_array_equal(
            get(stage, "particles", "velocities", number), frame.point_data["velocity"]
        )
        low, high = get(stage, "particles", "extent", number)
        np.testing.assert_allclose(low, frame.points.min(axis=0) - 0.5 * width, atol=1e-6)
        np.testing.assert_allclose(high, frame.points.max(axis=0) + 0.5 * width, atol=1e-6)


@pytest.mark.parametrize("name", ["particles", "surface"])
@pytest.mark.parametrize("dimension", [2, 3])
def test_velocities_are_those_of_a_fall(falls, tmp_path, dimension, name):
    """Velocities of a fall: equal for all points, those of the last step's middle."""
    stage = exported(falls[dimension], tmp_path / "fall.usdc", show=VisiblePart.BOTH)
    for number in range(LAST + 1):
        velocity = get(stage, name, "velocities", number)
        assert len(velocity) == len(get(stage, name, "points", number)) > 50
        assert np.ptp(velocity, axis=0).max() < 1e-4
        np.testing.assert_allclose(
            velocity[0], [0.0, -GRAVITY * number / RATE, 0.0], atol=0.51 * GRAVITY * STEP
        )


def test_velocities_lead_to_the_next_frame(falls, tmp_path):
    """Velocities that lead to the next frame.

    They are for the shutter of a renderer that interpolates points between frames.
    """
    stage = exported(falls[3], tmp_path / "fall.usdc", show=VisiblePart.PARTICLES)
    particles = UsdGeom.PointBased(prim(stage, "particles"))
    for number in range(1, LAST):
        before, after = (
            get(stage, "particles", "points", code).mean(axis=0) for code in (number, number + 1)
        )
        halfway = np.mean(
            particles.ComputePointsAtTime(Usd.TimeCode(number + 0.5), Usd.TimeCode(number)), axis=0
        )
        # Time of the velocity relative to the mean one until the next frame [s].
        late = 0.5 / RATE + 0.5 * STEP
        np.testing.assert_allclose(
            halfway, 0.5 * (before + after), atol=1.01 * GRAVITY * late * 0.5 / RATE
        )
        assert halfway[1] < before[1] - 0.4 * GRAVITY * number / RATE**2


def test_every_surface_is_closed_and_faces_outward(falls, tmp_path):
    stage = exported(falls[3], tmp_path / "fall.usdc")
    assert names(stage) == ["surface"]
    for number in range(LAST + 1):
        points, normals = (get(stage, "surface", name, number) for name in ("points", "normals"))
        triangles = corners(stage, "surface", number)
        assert_closed(triangles)
        assert enclosed(points, triangles) == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.03)
        outward = points - points.mean(axis=0)
        assert ((outward * normals).sum(axis=1) > 0.9 * np.linalg.norm(outward, axis=1)).all()
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
        np.testing.assert_allclose(
            get(stage, "surface", "extent", number),
            [points.min(axis=0), points.max(axis=0)],
            atol=1e-6,
        )
    assert prim(stage, "surface").GetAttribute("subdivisionScheme").Get() == "none"


def test_outlines_of_2_d_are_curves(falls, tmp_path):
    stage = exported(falls[2], tmp_path / "fall.usdc")
    for number in range(LAST + 1):
        frame = meshio.read(falls[2] / "frames" / f"surface_{number:06d}.vtu")
        counts, points = (
            get(stage, "surface", "curveVertexCounts", number),
            get(stage, "surface", "points", number),
        )
        np.testing.assert_array_equal(counts, np.full(len(frame.cells[0].data), 2))
        np.testing.assert_array_equal(points.reshape(-1, 2, 3), frame.points[frame.cells[0].data])
        length = np.linalg.norm(points[1::2] - points[::2], axis=1).sum()
        assert length == pytest.approx(2 * np.pi * RADIUS, rel=0.03)
    assert prim(stage, "surface").GetAttribute("type").Get() == "linear"


def turned(part: Surface, angle: float, shift: list[float]) -> Surface:
    points = Rotation.from_rotvec(np.radians([0.3 * angle, angle, 0.0])).apply(part.points) + shift
    return Surface("bodies", points.astype(np.float32), part.corners, part.fields)


def joined(*parts: Surface) -> Surface:
    first = np.cumsum([0, *(len(part.points) for part in parts)])
    corners = np.concatenate(
        [part.corners + start for part, start in zip(parts, first, strict=False)]
    )
    body = np.concatenate(
        [np.full(len(part.points), number, dtype=np.int32) for number, part in enumerate(parts)]
    )
    return Surface(
        "bodies",
        np.concatenate([part.points for part in parts]),
        corners.astype(np.int32),
        {"body": body},
    )


def test_bodies_keep_their_shape_and_are_placed(dots, tmp_path):
    parts = [
        (box([-0.1, -0.05, -0.02], [0.1, 0.05, 0.02]), [0.5, 0.3, 0.5]),
        (ball([0.0, 0.0, 0.0], 0.1), [0.2, 0.6, 0.4]),
    ]
    frames = [
        joined(
            *(turned(part, 40.0 * number, np.add(place, 0.05 * number)) for part, place in parts)
        )
        for number in range(4)
    ]
    folder = write_run(
        tmp_path / "run", [[ball([0.5, 0.5, 0.5], 0.2), bodies] for bodies in frames], size=ROOM
    )
    stage = exported(folder, tmp_path / "run.usdc")
    assert names(stage) == ["surface", "body_0", "body_1"]
    for number, bodies in enumerate(frames):
        for body in range(2):
            own = bodies.fields["body"] == body
            np.testing.assert_allclose(
                placed(stage, f"body_{body}", number), bodies.points[own], atol=1e-6
            )
            volume = 0.2 * 0.1 * 0.04 if body == 0 else 4 / 3 * np.pi * 0.1**3
            assert enclosed(
                placed(stage, f"body_{body}", number), corners(stage, f"body_{body}", number)
            ) == pytest.approx(volume, rel=0.02)
    for name in ("points", "faceVertexIndices"):
        assert prim(stage, "body_0").GetAttribute(name).GetTimeSamples() == []


def test_bodies_of_2_d(dots, tmp_path):
    frames = [joined(ball([0.3 + 0.1 * number, 0.5], 0.2)) for number in range(3)]
    folder = write_run(tmp_path / "run", [[ball([0.5, 0.5], 0.1), bodies] for bodies in frames])
    stage = exported(folder, tmp_path / "run.usdc")
    for number, bodies in enumerate(frames):
        np.testing.assert_allclose(
            placed(stage, "body_0", number).reshape(-1, 2, 3),
            bodies.points[bodies.corners],
            atol=1e-6,
        )


SOLIDS = """
[[solid]]
shape = "plane"
point = [0.0, 0.1, 0.0]
normal = [0.0, 1.0, 0.0]
[[solid]]
shape = "box"
min = [0.4, 0.1, 0.4]
max = [0.6, 0.2, 0.6]
motion = { kind = "rotation", rate = 90.0, center = [0.5, 0.5, 0.5], axis = [0.0, 0.0, 1.0] }
[[solid]]
shape = "sphere"
center = [0.5, 0.5, 0.5]
radius = 0.5
invert = true
"""


def test_solids_stand_and_move(dots, tmp_path):
    folder = write_run(tmp_path / "run", [[ball(ROOM, 0.2)]] * 21, SOLIDS, size=ROOM)
    stage = exported(folder, tmp_path / "run.usdc")
    assert names(stage) == ["surface", "solid_1", "solid_2"]  # a plane is unbounded
    # 90 degrees in a second.
    for code, low, high in (
        (0.0, [0.4, 0.1, 0.4], [0.6, 0.2, 0.6]),
        (20.0, [0.8, 0.4, 0.4], [0.9, 0.6, 0.6]),
    ):
        np.testing.assert_allclose(
            [
                placed(stage, "solid_1", code).min(axis=0),
                placed(stage, "solid_1", code).max(axis=0),
            ],
            [low, high],
        )
    assert prim(stage, "solid_1").GetAttribute("orientation").Get() == "rightHanded"
    assert prim(stage, "solid_2").GetAttribute("orientation").Get() == "leftHanded"


@pytest.mark.parametrize("dimension", [2, 3])
def test_usd_s_own_validators_find_nothing(falls, tmp_path, dimension):
    validation = pytest.importorskip("pxr.UsdValidation", reason="of a later usd-core")
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    stage = exported(falls[dimension], tmp_path / "fall.usdc", show=VisiblePart.BOTH)
    assert len(validators) > 10
    assert [
        error.GetMessage() for error in validation.ValidationContext(validators).Validate(stage)
    ] == []


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("name", ["run.usdc", "run.usda", "run.USD"])
def test_kinds_of_files(dots, tmp_path, name):
    folder = write_run(
        tmp_path / "run",
        [[ball([0.2 + 0.1 * number, 0.5, 0.5], 0.1)] for number in range(4)],
        size=ROOM,
    )
    file = tmp_path / "new" / name
    result = invoke("export", folder, "--out", file, "--first", 1, "--last", 2)
    assert result.exit_code == 0, result.stderr
    assert f"{file}: 2 frames" in result.stdout.replace("\n", "")
    assert file.read_bytes().startswith(b"#usda" if name.endswith("a") else b"PXR-USDC")
    stage = Usd.Stage.Open(str(file))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (
        1.0,
        2.0,
        20.0,
    )
    assert get(stage, "surface", "points", 2)[:, 0].max() == pytest.approx(0.5)
    assert invoke("export", folder, "--out", file).exit_code == 0  # in place of the older one
    assert [entry.name for entry in file.parent.iterdir()] == [name]


def test_frames_are_on_the_disk_when_they_are_added(dots, tmp_path):
    """Frames are written when they are added, so that one at a time is in memory.

    An aborted export leaves no file.
    """
    folder = write_run(
        tmp_path / "run",
        [[ball([0.5, 0.5, 0.5], 0.1 + 0.01 * number)] for number in range(5)],
        size=ROOM,
    )
    out = tmp_path / "out"
    export, sizes = export_run(folder, out / "run.usdc"), []
    for _ in range(4):
        next(export)
        (crate,) = out.glob(".run.usdc.*/frames.usdc")
        sizes.append(crate.stat().st_size)
    assert min(np.diff(sizes)) > 12 * 2 * 1026  # at least the points and normals of a ball
    export.close()
    assert list(out.iterdir()) == []


def test_frames_without_material_and_without_velocity(dots, tmp_path):
    nothing = Surface(
        "surface", np.zeros((0, 3), dtype=np.float32), np.zeros((0, 3), dtype=np.int32)
    )
    lost = Points("particles", np.array([[0.1, 0.2, 0.3], [np.nan, 0.0, 0.0]], dtype=np.float32))
    folder = write_run(
        tmp_path / "run", [[nothing, lost], [ball([0.5, 0.5, 0.5], 0.1), lost]], size=ROOM
    )
    stage = exported(folder, tmp_path / "run.usdc", show=VisiblePart.BOTH)
    assert (
        len(get(stage, "surface", "points", 0))
        == len(get(stage, "surface", "faceVertexIndices", 0))
        == 0
    )
    np.testing.assert_allclose(get(stage, "particles", "points", 1), [[0.1, 0.2, 0.3]])
    assert not prim(stage, "particles").GetAttribute("velocities").HasValue()


def test_the_end_of_a_run_may_lie_between_two_frames(dots, tmp_path):
    folder = write_run(tmp_path / "run", [[ball([0.5, 0.5], 0.2)]] * 3)
    text = (folder / "scene.toml").read_text()
    (folder / "scene.toml").write_text(text.replace("duration = 1.0", "duration = 0.09"))
    assert exported(folder, tmp_path / "run.usda").GetEndTimeCode() == pytest.approx(1.8)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["run", "--out", "a.obj"], "--out a.obj: must end in .usdc, .usda, .usd or .abc"),
        (["run", "--out", "folder.usd"], "--out folder.usd: is a folder; name a file"),
        (
            ["nowhere", "--out", "a.usdc"],
            "nowhere: is not the folder of a run: there is no such folder",
        ),
        (["run", "--out", "a.usdc", "--show", "particles"], "run: holds no frames of particles"),
        (
            ["run", "--out", "a.usdc", "--first", "7"],
            "--first 7: there are no such frames; the run has 0 to 1",
        ),
        (
            ["run", "--out", "a.usdc", "--first", "1", "--last", "0"],
            "--first 1 --last 0: there are no such frames",
        ),
        (["run", "--out", "file/a.usdc"], "file/a.usdc: cannot be written"),
        (["run"], "Missing option"),
    ],
)
def test_wrong_input(dots, tmp_path, monkeypatch, arguments, expected):
    monkeypatch.chdir(tmp_path)
    write_run(Path("run"), [[ball([0.5, 0.5], 0.2)]] * 2)
    Path("folder.usd").mkdir()
    Path("file").write_text("")
    result = invoke("export", *arguments)
    assert result.exit_code == 2
    assert expected in " ".join(result.stderr.split())
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["file", "folder.usd", "run"]


def test_a_frame_that_is_cut_is_named(dots, tmp_path):
    folder = write_run(tmp_path / "run", [[ball([0.5, 0.5], 0.2)]] * 3)
    (folder / "frames" / "surface_000001.vtu").write_text("<VTKFile")
    with pytest.raises(RenderError, match=r"surface_000001\.vtu: is not a readable frame"):
        list(export_run(folder, tmp_path / "run.usdc"))
    assert [entry.name for entry in tmp_path.iterdir()] == ["run"]


def test_a_full_disk_is_reported(dots, tmp_path):
    resource = pytest.importorskip("resource", reason="limits of files are for POSIX")
    folder = write_run(tmp_path / "run", [[ball([0.5, 0.5, 0.5], 0.2)]] * 5, size=ROOM)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
        # The first error has the cause; the next ones, of USD's callers, repeat it in their own.
        cause = r"run\.usdc: cannot be written: ([^:]*: )?File too large$"
        with pytest.raises(RenderError, match=cause):
            list(export_run(folder, tmp_path / "run.usdc"))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [entry.name for entry in tmp_path.iterdir()] == ["run"]


def test_without_usd_the_command_says_what_to_install(dots, tmp_path, monkeypatch):
    folder = write_run(tmp_path / "run", [[ball([0.5, 0.5], 0.2)]])
    monkeypatch.setitem(sys.modules, "pxr", None)
    result = invoke("export", folder, "--out", tmp_path / "run.usdc")
    assert result.exit_code == 2
    assert "pip install 'warp-lcp[usd]'" in " ".join(result.stderr.split())


def test_frames_of_a_run_at_work_are_those_that_are_there(dots, tmp_path):
    folder = write_run(tmp_path / "run", [[ball([0.5, 0.5], 0.2)]] * 2)
    FrameFolder(folder).write(2, 0.1, [ball([0.6, 0.5], 0.2)])
    assert exported(folder, tmp_path / "run.usdc").GetEndTimeCode() == 2.0
    assert export_format(tmp_path / "a.USDC").name == "USD"


def test_ids_and_ages_are_written_in_the_order_of_ids(tmp_path):
    """Ids in USD: sorted, so that a particle keeps its index while none comes or goes."""
    liquid = [{"shape": "sphere", "center": [0.5, 0.65], "radius": RADIUS}]
    jet = {"shape": "box", "min": [0.0, 0.8], "max": [0.125, 0.95]}
    source = [jet | {"velocity": [1.0, 0.0], "start": 0.05}]
    falling = scene(
        size=[1.0, 1.0],
        resolution=16,
        liquid=liquid,
        source=source,
        time={"duration": 1.0, "frames_per_second": RATE, "dt_max": STEP},
        output={"ids": True},
    )
    run_into(falling, tmp_path / "run", last_frame=LAST)
    stage = exported(tmp_path / "run", tmp_path / "run.usdc")
    before, counts = None, []
    for number in range(LAST + 1):
        frame = meshio.read(tmp_path / "run" / "frames" / f"particles_{number:06d}.vtu")
        order = np.argsort(frame.point_data["id"])
        ids = get(stage, "particles", "ids", number)
        np.testing.assert_array_equal(ids, frame.point_data["id"][order])
        points = get(stage, "particles", "points", number)
        np.testing.assert_array_equal(points, frame.points[order])
        velocity = get(stage, "particles", "velocities", number)
        np.testing.assert_array_equal(velocity, frame.point_data["velocity"][order])
        np.testing.assert_array_equal(
            get(stage, "particles", "primvars:age", number), frame.point_data["age"][order]
        )
        if before is not None:  # of the fall, which begins first
            count = len(before[0])
            np.testing.assert_array_equal(ids[:count], before[0])
            middle = 0.5 * (velocity[:count] + before[2])
            way = points[:count] - before[1]
            np.testing.assert_allclose(way, middle / RATE, atol=2.0 * GRAVITY * STEP / RATE)
        before = ids, points, velocity
        counts.append(len(ids))
    assert prim(stage, "particles").GetAttribute("ids").GetTypeName() == "int64[]"
    assert counts[0] < counts[-1]


def test_frames_without_ids_have_no_attribute_for_them(falls, tmp_path):
    stage = exported(falls[2], tmp_path / "fall.usdc", show=VisiblePart.PARTICLES)
    assert not prim(stage, "particles").GetAttribute("ids").HasAuthoredValue()
    assert not prim(stage, "particles").HasAttribute("primvars:age")
