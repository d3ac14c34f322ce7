"""PLY files of surfaces, for modelers such as Blender.

meshio writes such files too, but with the time of day in them, so that files of two runs differ in
bytes, and with segments as faces of two corners.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warp_lcp.files.atomic import replacing
from warp_lcp.simulation import Surface

TYPES = {
    "f4": "float",
    "f8": "double",
    "i4": "int",
    "u4": "uint",
    "i2": "short",
    "u2": "ushort",
    "i1": "char",
    "u1": "uchar",
}
AXES = ("x", "y", "z")
HEADER_BYTES = 1000


def write_ply(path: Path, surface: Surface) -> None:
    """Write a surface as a binary PLY file, atomically.

    Triangles are elements `face`, segments `edge`.

    Args:
        path: the file.
        surface: its fields become properties of the vertices; vectors have one per axis, such as
            `velocity_x`.

    Raises:
        OSError: the file cannot be written.
    """
    columns = {axis: surface.points[:, number].astype("<f4") for number, axis in enumerate(AXES)}
    for name, values in surface.fields.items():
        parts = (
            {name: values}
            if values.ndim == 1
            else {f"{name}_{axis}": values[:, number] for number, axis in enumerate(AXES)}
        )
        columns |= {key: part.astype(part.dtype.newbyteorder("<")) for key, part in parts.items()}
    vertices = np.rec.fromarrays(
        list(columns.values()), dtype=[(name, column.dtype) for name, column in columns.items()]
    )
    count, size = surface.corners.shape
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property {TYPES[column.dtype.str[1:]]} {name}" for name, column in columns.items()]
    if size == 3:
        elements = np.empty(count, dtype=[("size", "u1"), ("corners", "<i4", 3)])
        elements["size"], elements["corners"] = 3, surface.corners
        header += [f"element face {count}", "property list uchar int vertex_indices"]
    else:
        elements = surface.corners.astype("<i4")
        header += [f"element edge {count}", "property int vertex1", "property int vertex2"]
    with replacing(path) as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode())
        file.write(vertices.tobytes())
        file.write(elements.tobytes())


def ply_bytes(surface: Surface) -> int:
    """Return the estimated size of the file of a surface [bytes]."""
    fields = sum(values.nbytes for values in surface.fields.values())
    return (
        HEADER_BYTES
        + surface.points.nbytes
        + fields
        + len(surface.corners) * (4 * surface.corners.shape[1] + 1)
    )
