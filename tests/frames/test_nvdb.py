"""NanoVDB volumes, read back by TinyVDB, by Warp, and byte by byte."""

import struct

import numpy as np
import pytest
import warp as wp

from warp_lcp.frames.frame_folder import FrameFolder, frame_bytes
from warp_lcp.frames.nvdb import name_key, write_nvdb
from warp_lcp.simulation import Volume

SPACING = 0.125
# [m] The ball is not in the middle, so that mixed-up axes show.
CENTER, RADIUS, BAND = np.array([1.6, 1.3, 1.1]), 0.8, 0.3
SHAPE = (19, 24, 31)  # planes, rows, columns


def distance() -> np.ndarray:
    z, y, x = ((np.arange(count) + 0.5) * SPACING for count in SHAPE)
    return np.sqrt(
        (x[None, None, :] - CENTER[0]) ** 2
        + (y[None, :, None] - CENTER[1]) ** 2
        + (z[:, None, None] - CENTER[2]) ** 2
    ).astype(np.float32) - np.float32(RADIUS)


def level_set() -> Volume:
    return Volume("level_set", distance(), SPACING, BAND)


def density() -> Volume:
    return Volume("density", np.clip(-distance() / SPACING, 0.0, 1.0), SPACING)


@pytest.fixture
def tinyvdb():
    return pytest.importorskip(
        "tinyvdb._tinyvdb_nanovdb", reason="an independent reader of NanoVDB files"
    )


def test_another_reader_finds_the_ball(tinyvdb, tmp_path):
    write_nvdb(tmp_path / "a.nvdb", level_set())
    file = tinyvdb.NanoVDBFile(str(tmp_path / "a.nvdb"))
    assert (file.grid_count(), file.grid_name(0), file.grid_type(0), file.grid_class(0)) == (
        1,
        "level_set",
        "Float",
        "LevelSet",
    )
    assert file.voxel_size(0) == SPACING
    near = np.argwhere(np.abs(distance()) < BAND)[:, ::-1]
    assert file.active_voxel_count(0) == len(near)
    low, high = file.bbox(0)
    np.testing.assert_array_equal([low, high], [near.min(axis=0), near.max(axis=0)])
    low, high = file.world_bbox(0)  # centers of the first voxels, and of those after the last
    np.testing.assert_allclose(
        [low, high], (np.array([near.min(axis=0), near.max(axis=0) + 1]) + 0.5) * SPACING
    )
    clamped = np.clip(distance(), -BAND, BAND)
    for x, y, z in np.ndindex(31, 24, 19):
        np.testing.assert_allclose(file.get(0, x, y, z), clamped[z, y, x], rtol=1e-6, atol=1e-7)
    for far in [(-1, 5, 5), (500, 5, 5), (5, -3000, 5)]:
        np.testing.assert_allclose(file.get(0, *far), BAND, rtol=1e-6)  # outside


def test_another_reader_finds_the_density(tinyvdb, tmp_path):
    volume = density()
    write_nvdb(tmp_path / "a.nvdb", volume)
    file = tinyvdb.NanoVDBFile(str(tmp_path / "a.nvdb"))
    assert (file.grid_name(0), file.grid_class(0)) == ("density", "FogVolume")
    assert file.active_voxel_count(0) == np.count_nonzero(volume.values)
    for x, y, z in np.ndindex(31, 24, 19):
        assert file.get(0, x, y, z) == volume.values[z, y, x]
    assert file.get(0, 500, 5, 5) == 0.0


@wp.kernel
def sample_kernel(volume: wp.uint64, points: wp.array[wp.vec3], values: wp.array[wp.float32]):
    p = wp.tid()
    values[p] = wp.volume_sample_f(
        volume, wp.volume_world_to_index(volume, points[p]), wp.Volume.LINEAR
    )


def test_warp_samples_it_in_world_units(tmp_path):
    write_nvdb(tmp_path / "a.nvdb", level_set())
    with open(tmp_path / "a.nvdb", "rb") as file:
        volume = wp.Volume.load_from_nvdb(file, device="cpu")
    rng = np.random.default_rng(6151)
    direction = rng.normal(size=(500, 3))
    # [m]
    points = CENTER + direction / np.linalg.norm(direction, axis=1, keepdims=True) * rng.uniform(
        0.7, 0.9, (500, 1)
    )
    values = wp.zeros(500, dtype=wp.float32, device="cpu")
    wp.launch(
        sample_kernel,
        500,
        [volume.id, wp.array(points, dtype=wp.vec3, device="cpu"), values],
        device="cpu",
    )
    exact = np.linalg.norm(points - CENTER, axis=1) - RADIUS
    # Curvature of a sphere, between voxels.
    np.testing.assert_allclose(values.numpy(), exact, atol=SPACING**2 / 2 / RADIUS)
    info = volume.get_grid_info()
    np.testing.assert_allclose(info.translation, SPACING / 2)
    np.testing.assert_allclose(np.reshape(info.transform_matrix, (3, 3)), np.eye(3) * SPACING)


def test_the_header_byte_by_byte(tmp_path):
    write_nvdb(tmp_path / "a.nvdb", level_set())
    data = (tmp_path / "a.nvdb").read_bytes()
    magic, version, grids, codec = struct.unpack_from("<8sIHH", data)
    assert (magic, version >> 21, grids, codec) == (b"NanoVDB0", 32, 1, 0)
    grid_bytes, file_bytes, key, voxels, kind, group = struct.unpack_from("<4Q2I", data, 16)
    name_bytes = struct.unpack_from("<I", data, 16 + 136)[0]
    begin = 16 + 176 + name_bytes
    assert data[16 + 176 : begin] == b"level_set\0"
    assert grid_bytes == file_bytes == len(data) - begin
    assert (key, kind, group) == (name_key(b"level_set"), 1, 1)
    assert voxels == np.count_nonzero(np.abs(distance()) < BAND)
    assert struct.unpack_from("<3d", data, 16 + 112) == (SPACING,) * 3
    grid = data[begin:]
    assert grid[40:50] == b"level_set\0"
    assert struct.unpack_from("<Q", grid, 32)[0] == len(grid)
    # From index to world.
    assert struct.unpack_from("<9d", grid, 384) == (SPACING, 0, 0, 0, SPACING, 0, 0, 0, SPACING)
    assert struct.unpack_from("<9d", grid, 456) == (8, 0, 0, 0, 8, 0, 0, 0, 8)  # and back
    assert struct.unpack_from("<3d", grid, 528) == (SPACING / 2,) * 3
    assert struct.unpack_from("<I", grid, 632)[0] == 1
    leaves = struct.unpack_from("<I", grid, 672 + 32)[0]
    blocks = np.pad(distance(), [(0, -count % 8) for count in SHAPE], constant_values=1.0).reshape(
        3, 8, 3, 8, 4, 8
    )
    # Voxels far outside take no space.
    assert leaves == np.count_nonzero(blocks.min(axis=(1, 3, 5)) < BAND)


def test_cells_far_inside_take_no_room(tinyvdb, tmp_path):
    z, y, x = np.ogrid[:70, :80, :300]  # the ball fills two lower nodes along x
    values = (np.sqrt((x - 160.0) ** 2 / 9 + (y - 40.0) ** 2 + (z - 35.0) ** 2) - 30.0).astype(
        np.float32
    )
    write_nvdb(tmp_path / "a.nvdb", Volume("level_set", values, 1.0, 2.0))
    file = tinyvdb.NanoVDBFile(str(tmp_path / "a.nvdb"))
    blocks = np.pad(
        np.clip(values, -2, 2), [(0, -count % 8) for count in values.shape], constant_values=2.0
    ).reshape(9, 8, 10, 8, 38, 8)
    varied = (blocks.min(axis=(1, 3, 5)) < 2.0) & (blocks.max(axis=(1, 3, 5)) > -2.0)
    assert file.node_counts(0) == (np.count_nonzero(varied), 2, 1)
    rng = np.random.default_rng(4133)
    for x, y, z in rng.integers(0, [300, 80, 70], (20_000, 3)):
        assert file.get(0, int(x), int(y), int(z)) == np.clip(values[z, y, x], -2.0, 2.0)
    assert (file.get(0, 160, 40, 35), file.get(0, 299, 0, 0)) == (-2.0, 2.0)


def test_an_empty_volume_and_a_full_one(tinyvdb, tmp_path):
    for values, count in [
        (np.zeros(SHAPE, np.float32), 0),
        (np.ones(SHAPE, np.float32), 19 * 24 * 31),
    ]:
        write_nvdb(tmp_path / "a.nvdb", Volume("density", values, SPACING))
        file = tinyvdb.NanoVDBFile(str(tmp_path / "a.nvdb"))
        assert file.active_voxel_count(0) == count
        assert file.get(0, 30, 23, 18) == (count > 0)
        assert file.get(0, 31, 23, 18) == 0.0


@pytest.mark.parametrize("values", [np.full(SHAPE, np.nan), np.zeros((4, 4))])
def test_invalid_volumes_are_refused(tmp_path, values):
    with pytest.raises(ValueError, match="'density' must hold finite values of a 3-D grid"):
        write_nvdb(tmp_path / "a.nvdb", Volume("density", values, SPACING))
    assert list(tmp_path.iterdir()) == []


def test_frames_of_volumes_have_no_collection(tmp_path):
    folder = FrameFolder(tmp_path)
    for index in range(3):
        folder.write(index, float(index), [level_set(), density()])
    assert [path.name for path in tmp_path.iterdir()] == ["frames"]
    assert len(list(tmp_path.glob("frames/level_set_*.nvdb"))) == 3
    size = sum(path.stat().st_size for path in tmp_path.glob("frames/*_000001.nvdb"))
    assert size < frame_bytes([level_set(), density()]) < 4 * size
    FrameFolder(tmp_path).resume([0.0])
    assert sorted(path.name for path in tmp_path.glob("frames/*")) == [
        "density_000000.nvdb",
        "level_set_000000.nvdb",
    ]
