"""NanoVDB files of volumes: sparse voxels for renderers and Warp.

NumPy writes them, so that no other thread is blocked. The layout is that of version 32 of the
format, for the trees of `warp_lcp.frames.voxel_tree` (Warp's `native/nanovdb/NanoVDB.h` describes
it): the header of the grid, that of the tree, a root with one entry, one upper node of 32^3
entries, lower nodes of 16^3 entries and leaves of 8^3 voxels. An entry is a value, or the offset of
the child from its own node.

Warp's own writer (1.19: `Volume.allocate_by_tiles`, `save_to_nvdb`) is as fast, but its files have
no name, class, box and number of active voxels (all 0), and the deep inside of a level set reads as
outside: readers that search for "level_set" find nothing. TinyVDB (0.9) saves NanoVDB files that
it has read, but makes no new ones.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warp_lcp.files.atomic import replacing
from warp_lcp.frames.voxel_tree import LEAF, LOWER, UPPER, VoxelTree
from warp_lcp.frames.vtk_xml import raw
from warp_lcp.simulation import Volume

VERSION = 32 << 21 | 3 << 10 | 3
LEVEL_SET, FOG_VOLUME = 1, 2  # classes of grids
FLOAT = 1  # type of values
HAS_BOX, BREADTH_FIRST = 2, 32  # flags
NO_CHECKSUM = 2**64 - 1

GRID = np.dtype(
    [
        ("magic", "S8"),
        ("checksum", "<u8"),
        ("version", "<u4"),
        ("flags", "<u4"),
        ("index", "<u4"),
        ("count", "<u4"),
        ("bytes", "<u8"),
        ("name", "S256"),
        ("float_map", "<f4", 9),
        ("float_inverse", "<f4", 9),
        ("float_origin", "<f4", 3),
        ("float_taper", "<f4"),
        ("map", "<f8", 9),
        ("inverse", "<f8", 9),
        ("origin", "<f8", 3),
        ("taper", "<f8"),
        ("box", "<f8", 6),
        ("voxel", "<f8", 3),
        ("class", "<u4"),
        ("type", "<u4"),
        ("blind_data", "<i8"),
        ("more", "V24"),
    ]
)
BOX = [("low", "<i4", 3), ("high", "<i4", 3)]  # of active voxels
# Leaves, lower, upper, root.
TREE = np.dtype(
    [("offsets", "<i8", 4), ("nodes", "<u4", 3), ("tiles", "<u4", 3), ("voxels", "<u8")]
)
ROOT = np.dtype(
    [
        *BOX,
        ("entries", "<u4"),
        ("background", "<f4"),
        ("statistics", "<f4", 4),
        ("padding", "V16"),
        # Its only entry.
        ("key", "<u8"),
        ("child", "<i8"),
        ("state", "<u4"),
        ("value", "<f4"),
        ("more", "V8"),
    ]
)
# An entry of a node.
VALUE = np.dtype(
    {"names": ["value", "child"], "formats": ["<f4", "<i8"], "offsets": [0, 0], "itemsize": 8}
)
UPPER_NODE, LOWER_NODE = (
    np.dtype(
        [
            *BOX,
            ("flags", "<u8"),
            ("active", "u1", edge**3 // 8),
            ("children", "u1", edge**3 // 8),
            ("statistics", "<f4", 4),
            ("padding", "V16"),
            ("table", VALUE, edge**3),
        ]
    )
    for edge in (UPPER, LOWER)
)
LEAF_NODE = np.dtype(
    [
        ("low", "<i4", 3),
        ("extent", "u1", 3),
        ("flags", "u1"),
        ("active", "u1", LEAF**3 // 8),
        ("statistics", "<f4", 4),
        ("values", "<f4", LEAF**3),
    ]
)
FILE = np.dtype([("magic", "S8"), ("version", "<u4"), ("grids", "<u2"), ("codec", "<u2")])
META = np.dtype(
    [
        ("grid_bytes", "<u8"),
        ("file_bytes", "<u8"),
        ("name_key", "<u8"),
        ("voxels", "<u8"),
        ("type", "<u4"),
        ("class", "<u4"),
        ("world_box", "<f8", 6),
        ("index_low", "<i4", 3),
        ("index_high", "<i4", 3),
        ("voxel", "<f8", 3),
        ("name_bytes", "<u4"),
        ("nodes", "<u4", 4),
        ("tiles", "<u4", 3),
        ("codec", "<u2"),
        ("padding", "<u2"),
        ("version", "<u4"),
    ]
)


def write_nvdb(path: Path, volume: Volume) -> None:
    """Write a volume as a NanoVDB file, uncompressed, atomically.

    Index (i, j, k) is the center of that cell. Where a level set is unknown it has the width of its
    band: + outside and - inside, neither of which is stored. Voxels are active within the band;
    those of a density where it is not 0.

    Args:
        path: the file.
        volume: the values.

    Raises:
        OSError: the file cannot be written.
        ValueError: the values are not on a 3-D grid, not finite, or more than 4096 along an axis.
    """
    grid, header = _grid(volume)
    with replacing(path) as file:
        file.write(header)
        for part in grid:
            file.write(raw(part))


def nvdb_bytes(volume: Volume) -> int:
    """Return an upper bound of the size of the file of a volume [bytes]."""
    leaves, lower = (
        int(np.prod([-(-count // edge) for count in volume.values.shape]))
        for edge in (LEAF, LEAF * LOWER)
    )
    return (
        2 * GRID.itemsize
        + UPPER_NODE.itemsize
        + lower * LOWER_NODE.itemsize
        + leaves * LEAF_NODE.itemsize
    )


def name_key(name: bytes) -> int:
    """Return the hash by which readers search for a grid's name."""
    key = 0
    for letter in name:
        key = (key * 67 + letter + (key >> 56)) % 2**64
    return key


def _grid(volume: Volume) -> tuple[list[np.ndarray], bytes]:
    """Return the parts of a grid in a file, and the file's header."""
    voxels = VoxelTree.of(volume)
    background = voxels.background
    leaves = _leaves(voxels)
    lower, upper = _nodes(voxels)
    root, tree, grid = np.zeros(1, dtype=ROOT), np.zeros(1, dtype=TREE), np.zeros(1, dtype=GRID)
    parts = [grid, tree, root, upper, lower, leaves]
    # Offset of the next part from the tree's beginning.
    begins = np.cumsum([part.nbytes for part in parts]) - grid.nbytes
    tree["offsets"], tree["nodes"] = begins[[4, 3, 2, 1]], [len(leaves), len(lower), 1]
    tree["voxels"] = np.unpackbits(leaves["active"]).sum(dtype=np.int64)
    root["entries"], root["background"], root["child"] = 1, background, root.nbytes
    root["low"], root["high"] = upper["low"], upper["high"] = lower["low"], lower["high"] = _box(
        leaves
    )
    _describe(grid, root, volume, sum(part.nbytes for part in parts))
    return parts, _header(grid, tree, root)


def _leaves(voxels: VoxelTree) -> np.ndarray:
    """Return the leaves, in the order of their positions."""
    leaves = np.zeros(len(voxels.values), dtype=LEAF_NODE)
    leaves["low"], leaves["extent"], leaves["flags"] = voxels.low, LEAF - 1, HAS_BOX
    leaves["values"] = voxels.values
    leaves["active"] = np.packbits(voxels.active, axis=1, bitorder="little")
    return leaves


def _nodes(voxels: VoxelTree) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower nodes, in the order of their positions, and the upper one."""
    kinds, background = voxels.kinds, voxels.background
    lower, upper = np.zeros(len(kinds), dtype=LOWER_NODE), np.zeros(1, dtype=UPPER_NODE)
    lower["table"]["value"] = np.where(kinds < 0, -background, background)
    lower["children"] = np.packbits(kinds > 0, axis=1, bitorder="little")
    node, entry = np.nonzero(kinds > 0)
    begin = (len(lower) - node) * LOWER_NODE.itemsize  # offset of the leaves from the node
    lower["table"]["child"][node, entry] = begin + (kinds[node, entry] - 1) * LEAF_NODE.itemsize
    upper["table"]["value"] = background
    place = voxels.lower_places
    upper["table"]["child"][0, place] = upper.nbytes + np.arange(len(lower)) * LOWER_NODE.itemsize
    children = np.zeros(UPPER**3, dtype=bool)
    children[place] = True
    upper["children"] = np.packbits(children, bitorder="little")
    return lower, upper


def _box(leaves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and the last active voxel along each axis.

    An empty box without active voxels.
    """
    active = (
        np.unpackbits(leaves["active"], axis=1, bitorder="little")
        .astype(bool)
        .reshape(-1, LEAF, LEAF, LEAF)
    )
    low, high = np.zeros(3, dtype=np.int32), np.full(3, -1, dtype=np.int32)
    for axis, others in enumerate([(2, 3), (1, 3), (1, 2)]) if active.any() else ():
        found = (leaves["low"][:, axis, None] + np.arange(LEAF))[active.any(axis=others)]
        low[axis], high[axis] = found.min(), found.max()
    return low, high


def _describe(grid: np.ndarray, root: np.ndarray, volume: Volume, size: int) -> None:
    """Write the metadata of the grid."""
    spacing = float(volume.spacing)
    low = (np.array(volume.origin) + 0.5) * spacing  # center of the first cell
    grid["magic"], grid["checksum"], grid["version"], grid["flags"] = (
        b"NanoVDB1",
        NO_CHECKSUM,
        VERSION,
        HAS_BOX | BREADTH_FIRST,
    )
    grid["count"], grid["bytes"], grid["blind_data"] = 1, size, size
    grid["name"], grid["type"], grid["class"] = (
        volume.name.encode(),
        FLOAT,
        FOG_VOLUME if volume.band is None else LEVEL_SET,
    )
    grid["float_map"] = grid["map"] = spacing * np.eye(3).ravel()
    grid["float_inverse"] = grid["inverse"] = np.eye(3).ravel() / spacing
    grid["float_origin"] = grid["origin"] = low
    grid["float_taper"] = grid["taper"] = 1.0
    grid["voxel"] = spacing
    grid["box"] = np.concatenate([root["low"], root["high"] + 1], axis=1) * spacing + np.tile(
        low, 2
    )


def _header(grid: np.ndarray, tree: np.ndarray, root: np.ndarray) -> bytes:
    """Return the file header, by which readers find the grid."""
    name = bytes(grid["name"][0])
    file, meta = np.zeros(1, dtype=FILE), np.zeros(1, dtype=META)
    file["magic"], file["version"], file["grids"] = b"NanoVDB0", VERSION, 1
    meta["grid_bytes"] = meta["file_bytes"] = grid["bytes"]
    meta["name_key"], meta["name_bytes"] = name_key(name), len(name) + 1
    for key in ("type", "class", "voxel", "version"):
        meta[key] = grid[key]
    meta["world_box"], meta["index_low"], meta["index_high"] = (
        grid["box"],
        root["low"],
        root["high"],
    )
    meta["voxels"], meta["nodes"][:, :3], meta["nodes"][:, 3] = tree["voxels"], tree["nodes"], 1
    return file.tobytes() + meta.tobytes() + name + b"\0"
