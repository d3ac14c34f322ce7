"""OpenVDB files: the volumes of a frame, for Blender, Houdini and renderers.

NumPy writes them, version 224 of the format with the trees of `warp_lcp.frames.voxel_tree`: a
header, then each grid with its metadata, its transform, its topology (masks of all nodes) and its
buffers (values of the active voxels of all leaves). Inactive values are not stored: each is
+background or -background. A mask of the node gives the sign. This is OpenVDB's "active mask"
compression.

TinyVDB (0.9) only replaces the values of a grid that it has read, one number a voxel: its level
sets lose their class and their inside, which becomes +background.
"""

from __future__ import annotations

import uuid
from hashlib import blake2b
from pathlib import Path
from struct import pack

import numpy as np

from warp_lcp.files.atomic import replacing
from warp_lcp.frames.voxel_tree import LEAF, LOWER, UPPER, VoxelTree
from warp_lcp.simulation import Volume, VolumeGroup

MAGIC, VERSION, LIBRARY = 0x56444220, 224, (12, 0)
ACTIVE_MASK = 2  # compression
# How inactive values are stored in a node: all +background, or chosen by a mask.
ALL_BACKGROUND, BY_MASK = b"\0", b"\3"
HALF = "_HalfFloat"  # end of the type of grids whose values have 16 bits
# Names of the grids that other programs look for.
GRID_NAMES = {"level_set": "surface"}
MASK = LEAF**3 // 8  # bytes of the mask of a leaf
LOWER_MASK, UPPER_MASK = LOWER**3 // 8, UPPER**3 // 8
HEADER_BYTES = 1000  # at most, of a grid


def write_vdb(path: Path, group: VolumeGroup) -> None:
    """Write volumes as the grids of one OpenVDB file, atomically.

    Level sets have 32 bits a voxel, densities and vectors 16. Voxels are active within the band of
    a level set, and where a density or a vector is not 0.

    Args:
        path: the file.
        group: the volumes.

    Raises:
        OSError: the file cannot be written.
        ValueError: as of `VoxelTree.of`, or a density or vector exceeds 65504.
    """
    grids = [_grid(volume) for volume in group.volumes]
    digest = blake2b(b"".join(part for grid in grids for part in grid), digest_size=16).digest()
    header = (
        pack("<qIIIb", MAGIC, VERSION, *LIBRARY, 1)
        + str(uuid.UUID(bytes=digest)).encode()
        + _metadata(creator="warp_lcp")
        + pack("<I", len(grids))
    )
    with replacing(path) as file:
        position = file.write(header)
        for descriptor, topology, buffers in grids:
            begin = position + len(descriptor) + 24
            middle = begin + len(topology)
            position = middle + len(buffers)
            file.write(descriptor)
            file.write(pack("<3q", begin, middle, position))
            file.write(topology)
            file.write(buffers)


def vdb_bytes(group: VolumeGroup) -> int:
    """Return an upper bound of the size of the file of volumes [bytes]."""
    total = HEADER_BYTES
    for volume in group.volumes:
        leaves, lower = (
            int(np.prod([-(-count // edge) for count in volume.values.shape[:3]]))
            for edge in (LEAF, LEAF * LOWER)
        )
        voxel = (4 if volume.band is not None else 2) * int(np.prod(volume.values.shape[3:]))
        leaf = 3 * MASK + 1 + LEAF**3 * voxel
        total += HEADER_BYTES + 2 * UPPER_MASK + lower * (3 * LOWER_MASK + 1) + leaves * leaf
    return total


def _grid(volume: Volume) -> tuple[bytes, bytes, bytes]:
    """Return the descriptor of a grid, its part up to the topology, and its buffers."""
    tree, is_vector = VoxelTree.of(volume), volume.values.ndim == 4
    halved = volume.band is None
    if halved and len(tree.values) and np.abs(tree.values).max() > np.finfo(np.float16).max:
        raise ValueError(f"the volume {volume.name!r} must not exceed 65504")
    name, kind = GRID_NAMES.get(volume.name, volume.name), "vec3s" if is_vector else "float"
    descriptor = _text(name) + _text(f"Tree_{kind}_5_4_3{HALF if halved else ''}") + _text("")
    masks = np.packbits(tree.active, axis=1, bitorder="little")
    topology = _about(volume, name, tree) + _topology(tree, masks, 3 if is_vector else 1)
    return descriptor, topology, _buffers(tree, masks, np.float16 if halved else np.float32)


def _about(volume: Volume, name: str, tree: VoxelTree) -> bytes:
    """Return compression, metadata and transform of a grid."""
    low, high = _box(tree)
    kind = "fog volume" if volume.values.ndim == 3 else "unknown"
    vectors = {"vector_type": "contravariant relative"} if volume.values.ndim == 4 else {}
    metadata = _metadata(
        **{"class": kind if volume.band is None else "level set"},
        file_bbox_max=high,
        file_bbox_min=low,
        file_compression="active values",
        file_voxel_count=int(tree.active.sum()),
        is_local_space=False,
        is_saved_as_half_float=volume.band is None,
        name=name,
        **vectors,
    )
    spacing = float(volume.spacing)
    first = (np.array(volume.origin) + 0.5) * spacing  # center of the first cell [m]
    scales = [spacing, spacing, 1.0 / spacing, 1.0 / spacing**2, 0.5 / spacing]
    transform = [*first, *np.repeat(scales, 3)]
    return (
        pack("<I", ACTIVE_MASK)
        + metadata
        + _text("UniformScaleTranslateMap")
        + np.array(transform, dtype="<f8").tobytes()
    )


def _box(tree: VoxelTree) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and the last voxel of the leaves, x, y, z; without leaves an empty box."""
    if not len(tree.low):
        return np.zeros(3, dtype=np.int32), np.full(3, -1, dtype=np.int32)
    return tree.low.min(axis=0), tree.low.max(axis=0) + (LEAF - 1)


def _topology(tree: VoxelTree, masks: np.ndarray, components: int) -> bytes:
    """Return the tree without the values of its leaves, each node before its children."""
    background = np.full(components, tree.background, dtype="<f4").tobytes()
    # One buffer; a root without regions of one value, with one child, whose first voxel is 0.
    parts = [pack("<I", 1), background, pack("<II3i", 0, 1, 0, 0, 0)]
    children = np.zeros(UPPER**3, dtype=bool)
    children[tree.lower_places] = True
    parts += [np.packbits(children, bitorder="little").tobytes(), bytes(UPPER_MASK), ALL_BACKGROUND]
    has_child = np.packbits(tree.kinds > 0, axis=1, bitorder="little")
    outside = np.packbits(tree.kinds >= 0, axis=1, bitorder="little")
    # `inactive`: bytes that say which entries without child have +background, else -background.
    for node, kinds in enumerate(tree.kinds):
        inactive = BY_MASK + outside[node].tobytes() if (kinds < 0).any() else ALL_BACKGROUND
        leaves = kinds[kinds > 0] - 1
        parts += [has_child[node].tobytes(), bytes(LOWER_MASK), inactive, masks[leaves].tobytes()]
    return b"".join(parts)


def _buffers(tree: VoxelTree, masks: np.ndarray, dtype: type[np.floating]) -> bytes:
    """Return the values of the active voxels of all leaves, leaf by leaf of each lower node."""
    counts = tree.active.sum(axis=1)
    values = tree.values[tree.active].astype(np.dtype(dtype).newbyteorder("<"))
    begins = np.concatenate([[0], np.cumsum(counts)])
    has_minus = tree.background > 0.0
    outside = np.packbits(tree.active | (_scalars(tree) >= 0.0), axis=1, bitorder="little")
    parts = []
    for leaf in tree.kinds[tree.kinds > 0] - 1:
        parts += [masks[leaf].tobytes(), BY_MASK if has_minus else ALL_BACKGROUND]
        if has_minus:
            parts.append(outside[leaf].tobytes())
        parts.append(values[begins[leaf] : begins[leaf + 1]].tobytes())
    return b"".join(parts)


def _scalars(tree: VoxelTree) -> np.ndarray:
    """Return one number a voxel, whose sign says on which side of a level set it lies."""
    return tree.values if tree.values.ndim == 2 else tree.values[..., 0]


def _metadata(**entries: str | bool | int | np.ndarray) -> bytes:
    """Return a map of metadata: texts, truths, 64-bit integers and vectors of three integers."""
    parts = [pack("<I", len(entries))]
    for name, value in entries.items():
        if isinstance(value, str):
            kind, data = "string", value.encode()
        elif isinstance(value, bool):
            kind, data = "bool", bytes([value])
        elif isinstance(value, int):
            kind, data = "int64", pack("<q", value)
        else:
            kind, data = "vec3i", np.asarray(value, dtype="<i4").tobytes()
        parts += [_text(name), _text(kind), pack("<I", len(data)), data]
    return b"".join(parts)


def _text(text: str) -> bytes:
    """Return a text behind its length."""
    data = text.encode()
    return pack("<I", len(data)) + data
