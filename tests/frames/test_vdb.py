"""OpenVDB files, read back by OpenVDB and TinyVDB, and byte by byte.

TinyVDB 0.9 reads neither vectors of 16 bits nor the places of leaves beyond 64 voxels, of OpenVDB's
own files either: it sees small scalar grids.
"""

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from film_tools import blender, openvdb
from warp_lcp.frames.frame_folder import FrameFolder, frame_bytes
from warp_lcp.frames.vdb import GRID_NAMES, HALF, write_vdb
from warp_lcp.frames.voxel_tree import LARGEST, LEAF
from warp_lcp.simulation import Volume, VolumeGroup

SPACING, ORIGIN = 0.125, (3, 4, 5)
SMALL, LARGE = (19, 24, 31), (70, 80, 300)  # planes, rows, columns; LARGE: three lower nodes
BAND = 1.5 * SPACING


def group(shape: tuple[int, int, int]) -> VolumeGroup:
    """Return an ellipsoid that is not in the middle, its density and a velocity around it."""
    z, y, x = np.ogrid[tuple(slice(count) for count in shape)]
    nz, ny, nx = shape
    around = [(x - 0.53 * nx) / nx, (y - 0.47 * ny) / ny, (z - 0.41 * nz) / nz]
    radius = np.sqrt(sum(axis**2 for axis in around))
    distance = ((radius - 0.3) * min(shape) * SPACING).astype(np.float32)
    density = np.clip(-distance / SPACING, 0.0, 1.2).astype(np.float32)
    flow = np.stack(np.broadcast_arrays(np.sin(0.1 * x), np.cos(0.2 * y), 0.01 * z + 1.0), axis=-1)
    velocity = np.where((distance < BAND)[..., None], flow, 0.0).astype(np.float32)
    volumes = (
        Volume("level_set", distance, SPACING, BAND, ORIGIN),
        Volume("density", density, SPACING, None, ORIGIN),
        Volume("velocity", velocity, SPACING, None, ORIGIN),
    )
    return VolumeGroup("volume", volumes)


def stored(volume: Volume) -> np.ndarray:
    """Return the values that a file holds, x first."""
    if volume.band is not None:
        values = np.clip(volume.values, -np.float32(volume.band), np.float32(volume.band))
    else:
        values = volume.values.astype(np.float16).astype(np.float32)
    return values.transpose(2, 1, 0, *range(3, values.ndim))


def is_active(volume: Volume) -> np.ndarray:
    values = volume.values
    if volume.band is not None:
        return np.abs(values) < np.float32(volume.band)
    return values.any(axis=3) if values.ndim == 4 else values > 0.0


@pytest.mark.every_case
@pytest.mark.parametrize("shape", [SMALL, LARGE])
def test_openvdb_reads_every_voxel(tmp_path, shape):
    vdb, volumes = openvdb(), group(shape)
    write_vdb(tmp_path / "a.vdb", volumes)
    for volume in volumes.volumes:
        grid = vdb.read(str(tmp_path / "a.vdb"), GRID_NAMES.get(volume.name, volume.name))
        expected = stored(volume)
        values = np.zeros(expected.shape, dtype=np.float32)
        grid.copyToArray(values)
        np.testing.assert_array_equal(values, expected)
        active = np.argwhere(is_active(volume))[:, ::-1]
        assert grid.activeVoxelCount() == len(active)
        low, high = grid.evalActiveVoxelBoundingBox()
        np.testing.assert_array_equal([low, high], [active.min(axis=0), active.max(axis=0)])
        first = (np.array(ORIGIN) + 0.5) * SPACING
        np.testing.assert_allclose(grid.transform.indexToWorld((0, 0, 0)), first)
        np.testing.assert_allclose(grid.transform.indexToWorld((2, 0, 0)) - first, [0.25, 0, 0])
        assert grid.saveFloatAsHalf == (volume.band is None)
        outside = grid.getConstAccessor().getValue((-9, 3, 3))
        np.testing.assert_array_equal(outside, 0.0 if volume.band is None else volume.band)
    classes = [vdb.read(str(tmp_path / "a.vdb"), name).gridClass for name in ("surface", "density")]
    assert classes == [vdb.GridClass.LEVEL_SET, vdb.GridClass.FOG_VOLUME]
    assert vdb.read(str(tmp_path / "a.vdb"), "velocity").vectorType == "contravariant relative"


IN_BLENDER = """
import json, sys
import bpy
bpy.ops.object.volume_import(filepath=sys.argv[1], files=[{"name": "a.vdb"}])
item = bpy.context.object
item.data.grids.load()
grids = [[grid.name, grid.data_type] for grid in item.data.grids]
low, high = list(item.bound_box[0]), list(item.bound_box[6])
print("FOUND" + json.dumps([grids, low, high, item.data.grids.error_message]))
"""


def test_blender_opens_it(tmp_path):
    volumes = group(SMALL)
    write_vdb(tmp_path / "a.vdb", volumes)
    text = blender(IN_BLENDER, tmp_path / "a.vdb")
    grids, low, high, error = json.loads(text[text.index("FOUND") + 5 :].splitlines()[0])
    assert dict(grids) == {"surface": "FLOAT", "density": "FLOAT", "velocity": "VECTOR_FLOAT"}
    assert error == ""
    active = np.argwhere(is_active(volumes.volumes[2]))[:, ::-1]
    first = (active.min(axis=0) + np.array(ORIGIN)) * SPACING
    last = (active.max(axis=0) + 1 + np.array(ORIGIN)) * SPACING
    np.testing.assert_allclose([low, high], [first, last], atol=LEAF * SPACING)


def test_tinyvdb_reads_scalars(tmp_path):
    tinyvdb = pytest.importorskip("tinyvdb", reason="an independent reader of OpenVDB files")
    volumes = group(SMALL)
    write_vdb(tmp_path / "a.vdb", volumes)
    with tinyvdb.open(str(tmp_path / "a.vdb")) as file:
        file.read_grids()
        assert file.grid_count == 3
        for number, volume in enumerate(volumes.volumes):
            grid, active = file.grid(number), is_active(volume)
            assert grid.name == ["surface", "density", "velocity"][number]
            assert grid.metadata["file_voxel_count"] == np.count_nonzero(active)
            nodes = [grid.tree.node(place) for place in range(grid.tree.num_nodes)]
            leaves = [node for node in nodes if node.type == "leaf"]
            counts = [leaf.active_voxel_count for leaf in leaves]
            assert sum(counts) == np.count_nonzero(active)
            if volume.name == "velocity":
                continue
            sparse = grid.to_sparse()
            x, y, z = np.frombuffer(sparse["coords"], dtype=np.int32).reshape(-1, 3).T
            assert len(x) == np.count_nonzero(active)
            values = np.frombuffer(sparse["values"], dtype=np.float32)
            np.testing.assert_array_equal(values, stored(volume)[x, y, z])
            assert active[z, y, x].all()
            np.testing.assert_allclose(
                grid.transform["translation"], (np.array(ORIGIN) + 0.5) * SPACING
            )


def test_vectors_byte_by_byte(tmp_path):
    volumes = group(SMALL)
    write_vdb(tmp_path / "a.vdb", volumes)
    data = (tmp_path / "a.vdb").read_bytes()
    assert struct.unpack_from("<qIIIb", data) == (0x56444220, 224, 12, 0, 1)
    name = b"Tree_vec3s_5_4_3" + HALF.encode()
    begin, middle, end = struct.unpack_from("<3q", data, data.index(name) + len(name) + 4)
    assert end == len(data) and data[begin : begin + 4] == struct.pack("<I", 2)
    velocity = volumes.volumes[2].values
    padded = np.pad(velocity, [*((0, -count % LEAF) for count in SMALL), (0, 0)])
    nz, ny, nx = (count // LEAF for count in padded.shape[:3])
    blocks = padded.reshape(nz, LEAF, ny, LEAF, nx, LEAF, 3).transpose(4, 2, 0, 5, 3, 1, 6)
    place = middle
    for block in blocks.reshape(-1, LEAF**3, 3):
        active = block.any(axis=1)
        if active.any():
            bits = np.unpackbits(np.frombuffer(data, np.uint8, 64, place), bitorder="little")
            np.testing.assert_array_equal(bits, active)
            values = np.frombuffer(data, "<f2", 3 * np.count_nonzero(active), place + 65)
            np.testing.assert_array_equal(values, block[active].astype(np.float16).ravel())
            place += 65 + values.nbytes
    assert place == end


def test_equal_volumes_have_equal_bytes(tmp_path):
    for name in ("a.vdb", "b.vdb"):
        write_vdb(tmp_path / name, group(SMALL))
    assert (tmp_path / "a.vdb").read_bytes() == (tmp_path / "b.vdb").read_bytes()


def test_empty_volumes(tmp_path):
    empty = np.full(SMALL, 1.0, dtype=np.float32)
    volumes = VolumeGroup(
        "volume",
        (
            Volume("level_set", empty, SPACING, BAND),
            Volume("velocity", np.zeros((*SMALL, 3), dtype=np.float32), SPACING),
        ),
    )
    write_vdb(tmp_path / "a.vdb", volumes)
    vdb = openvdb()
    assert [
        vdb.read(str(tmp_path / "a.vdb"), name).activeVoxelCount()
        for name in ("surface", "velocity")
    ] == [0, 0]


@pytest.mark.every_case
@pytest.mark.parametrize(
    ("values", "expected"),
    [
        (np.full(SMALL, np.inf), "must hold finite values of a 3-D grid"),
        (np.zeros((4, 4)), "must hold finite values of a 3-D grid"),
        (np.zeros((4, 4, 4, 2)), "must hold finite values of a 3-D grid"),
        (np.zeros((1, 1, LARGEST + 1)), f"at most {LARGEST} along an axis"),
        (np.full(SMALL, 7e4), "must not exceed 65504"),
    ],
)
def test_invalid_volumes_are_refused(tmp_path, values, expected):
    volumes = VolumeGroup("volume", (Volume("density", values, SPACING),))
    with pytest.raises(ValueError, match=expected):
        write_vdb(tmp_path / "a.vdb", volumes)
    assert list(tmp_path.iterdir()) == []


def test_a_frame_has_one_file(tmp_path: Path):
    folder, volumes = FrameFolder(tmp_path), group(SMALL)
    for index in range(3):
        folder.write(index, float(index), [volumes])
    assert [path.name for path in tmp_path.iterdir()] == ["frames"]
    size = (tmp_path / "frames" / "volume_000001.vdb").stat().st_size
    assert size < frame_bytes([volumes]) < 4 * size
    assert folder.kinds([volumes]) == ["volume"]
    (tmp_path / "frames" / "volume_000001.vdb").unlink()
    assert folder.missing("volume", 3) == [1]
    folder.resume([0.0])
    assert [path.name for path in (tmp_path / "frames").iterdir()] == ["volume_000000.vdb"]
