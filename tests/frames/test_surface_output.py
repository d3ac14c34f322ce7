"""Surfaces in a run's folder: VTU series and PLY files.

They are those of liquid and sand, in 2-D and 3-D. There is none unless the scene requests it.
"""

import meshio
import numpy as np
import pytest
import warp as wp

import small_liquids
import small_sands
from mesh_checks import assert_closed, enclosed
from warp_lcp.frames.frame_folder import FrameFolder, frame_bytes
from warp_lcp.frames.ply import write_ply
from warp_lcp.material import particle_frames
from warp_lcp.simulation import Points, Surface

SURFACE = {"output": {"surface": True}}
DIMENSIONS = pytest.mark.parametrize("dimension", [2, 3])
SIZE = {2: 0.375**2, 3: 0.375**2 * 0.25}


def surface_of(simulation):
    found = [part for part in simulation.frame() if isinstance(part, Surface)]
    assert [part.name for part in found] == ["surface"]
    return found[0]


@DIMENSIONS
def test_a_dam_has_its_surface_at_the_start_and_later(dimension):
    simulation = small_liquids.dam(dimension, **SURFACE)
    start = surface_of(simulation)
    assert start.corners.shape[1] == dimension
    assert_closed(start.corners)
    # Six cells high: edges are round.
    assert enclosed(start.points, start.corners) == pytest.approx(SIZE[dimension], rel=0.04)
    assert start.fields["velocity"] == pytest.approx(0.0, abs=1e-6)
    small_liquids.advance(simulation, 0.15)
    later = surface_of(simulation)
    assert_closed(later.corners)
    assert enclosed(later.points, later.corners) == pytest.approx(SIZE[dimension], rel=0.06)
    speed = np.linalg.norm(later.fields["velocity"], axis=1)
    fastest = np.linalg.norm(simulation.particles.velocity.numpy(), axis=1).max()
    assert 0.7 * fastest < speed.max() < 1.3 * fastest
    front = later.points[:, 0] > later.points[:, 0].max() - 0.03
    assert later.fields["velocity"][front, 0].mean() > 0.7


@DIMENSIONS
def test_a_falling_block_has_its_velocity_from_its_first_frame_on(dimension):
    low, high, velocity = (
        [0.3, 0.4, 0.1][:dimension],
        [0.6, 0.8, 0.4][:dimension],
        [1.0, -2.0, 0.0][:dimension],
    )
    block = small_liquids.box(low, high, velocity=velocity)
    simulation = small_liquids.create(
        small_liquids.scene(
            size=[1.0, 1.0, 0.5][:dimension], resolution=20, liquid=[block], **SURFACE
        )
    )
    surface = surface_of(simulation)
    assert surface.fields["velocity"][:, :dimension] == pytest.approx(
        np.tile(velocity, (len(surface.points), 1)), abs=1e-4
    )
    small_liquids.advance(simulation, 0.02, 0.005)
    moved = surface_of(simulation)
    assert moved.fields["velocity"][:, 1] == pytest.approx(-2.0 - 9.81 * 0.02, abs=0.05)
    state = simulation.state()
    simulation.restore(state)
    again = surface_of(simulation)
    assert np.array_equal(again.points, moved.points)
    assert again.fields["velocity"][:, 1] == pytest.approx(-2.0 - 9.81 * 0.02, abs=0.05)


def test_sand_has_a_surface_too():
    simulation = small_sands.column(2, **SURFACE)
    surface = surface_of(simulation)
    assert_closed(surface.corners)
    assert enclosed(surface.points, surface.corners) == pytest.approx(SIZE[2], rel=0.04)


def test_a_frame_changes_nothing_of_the_run():
    with_it, without = small_liquids.dam(2, **SURFACE), small_liquids.dam(2)
    for _ in range(4):
        for simulation in (with_it, without):
            simulation.step(0.01)
        with_it.frame()
    for name, value in without.state().items():
        assert np.array_equal(with_it.state()[name], value), name


def test_without_surface_output_nothing_is_written(monkeypatch):
    """Without the option no surface, no field, no kernel."""
    launched = []
    monkeypatch.setattr(particle_frames, "faces_from_particles", lambda *a: launched.append(a))
    monkeypatch.setattr(particle_frames, "sample", lambda *a: launched.append(a))
    simulation = small_liquids.dam(2)
    assert simulation.surface_mesh is None
    assert not any(isinstance(part, Surface) for part in simulation.frame())
    assert launched == []
    assert "surface mesh" not in simulation.scene.memory_parts()


@pytest.mark.parametrize("solid", [False, True])
@DIMENSIONS
def test_the_memory_that_is_announced_is_taken(dimension, solid):
    solids = (
        {"solid": [{"shape": "sphere", "center": [0.7, 0.2, 0.1][:dimension], "radius": 0.1}]}
        if solid
        else {}
    )
    simulation = small_liquids.dam(dimension, **SURFACE, **solids)
    mesh = simulation.surface_mesh
    fields = [value for value in vars(mesh).values() if isinstance(value, wp.array)]
    taken = sum(field.capacity for field in [*fields, *mesh._fields])
    announced = simulation.scene.memory_parts()["surface mesh"]
    points = 2 * (32 * 16 + 16 * 8 + 8 * 32) if dimension == 3 else 2 * (32 + 16)
    # A third for so small a lattice.
    ring = np.prod(mesh.lattice.shape) / (32 * 16 * (8 if dimension == 3 else 3))
    assert taken == pytest.approx(ring * (announced - 80 * points), rel=0.02)


def some_surface(dimension):
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=np.float32)
    tetrahedron = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], dtype=np.int32)
    if dimension == 2:
        points, tetrahedron = points[:3], np.array([[0, 1], [1, 2], [2, 0]], dtype=np.int32)
    rng = np.random.default_rng(6043)
    fields = {
        "velocity": rng.random((len(points), 3)).astype(np.float32),
        "id": np.arange(len(points), dtype=np.int32),
    }
    return Surface("surface", points, tetrahedron, fields)


def test_ply_triangles_are_read_back(tmp_path):
    surface = some_surface(3)
    write_ply(tmp_path / "a.ply", surface)
    read = meshio.read(tmp_path / "a.ply")
    assert np.array_equal(read.points, surface.points)
    assert np.array_equal(read.cells_dict["triangle"], surface.corners)
    for number, axis in enumerate("xyz"):
        assert np.array_equal(
            read.point_data[f"velocity_{axis}"], surface.fields["velocity"][:, number]
        )
    assert np.array_equal(read.point_data["id"], surface.fields["id"])
    assert enclosed(read.points, read.cells_dict["triangle"]) == pytest.approx(1 / 6)


def test_ply_segments_are_edges(tmp_path):
    surface = some_surface(2)
    write_ply(tmp_path / "a.ply", surface)
    head, data = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
    assert b"element edge 3\nproperty int vertex1\nproperty int vertex2\n" in head
    assert np.array_equal(np.frombuffer(data[-24:], dtype="<i4").reshape(3, 2), surface.corners)


def test_ply_files_come_beside_the_series_and_go_with_it(tmp_path):
    frame = [Points("particles", np.zeros((2, 3))), some_surface(3)]
    folder = FrameFolder(tmp_path, surface_ply=True)
    for index in range(3):
        written = [file.name for file in folder.write(index, index / 5, frame)]
        assert written == [
            f"particles_{index:06d}.vtu",
            f"surface_{index:06d}.vtu",
            f"surface_{index:06d}.ply",
        ]
    size = sum(file.stat().st_size for file in (tmp_path / "frames").glob("*_000001.*"))
    # Files that are mostly headers.
    assert 0.95 * size < frame_bytes(frame, surface_ply=True) < size + 6000
    FrameFolder(tmp_path, surface_ply=True).resume([0.0])
    assert sorted(file.name for file in (tmp_path / "frames").iterdir()) == [
        "particles_000000.vtu",
        "surface_000000.ply",
        "surface_000000.vtu",
    ]
    assert (tmp_path / "surface.pvd").read_text().count("DataSet") == 1
