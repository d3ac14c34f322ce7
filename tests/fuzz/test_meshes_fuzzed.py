"""Damaged mesh files: each is a closed surface, or refused with its name.

Reading takes no more memory than the file has bytes for.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from mutated import mutated
from told import limited, told

from warp_lcp.grid.triangle_mesh import read_mesh
from warp_lcp.run import check

POINTS = np.array([[x, y, z] for z in (0.25, 0.75) for y in (0.25, 0.75) for x in (0.25, 0.75)])
QUADS = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
TRIANGLES = [[a, b, c] for a, *rest in QUADS for b, c in (rest[:2], rest[1:])]
SCENE = """[scene]
simulator = "fluids"
[time]
duration = 0.1
[domain]
size = [1.0, 1.0, 1.0]
resolution = 8
[[liquid]]
shape = "box"
min = [0.0, 0.0, 0.0]
max = [1.0, 0.2, 1.0]
[[solid]]
shape = "mesh"
file = "mesh{suffix}"
"""


def ply_header(order: str, faces: int) -> bytes:
    vertex = (
        f"element vertex {len(POINTS)}\nproperty float x\nproperty float y\nproperty float "
        "z\nproperty uchar red\n"
    )
    face = f"element face {faces}\nproperty list uchar int vertex_indices\n"
    return f"ply\nformat {order} 1.0\ncomment a cube\n{vertex}{face}end_header\n".encode()


def binary_ply(order: str, sign: str) -> bytes:
    rows = [struct.pack(f"{sign}3fB", *point, 200) for point in POINTS]
    rows += [
        struct.pack(f"{sign}B{len(face)}i", len(face), *face)
        for face in [*QUADS[:3], *TRIANGLES[6:]]
    ]
    return ply_header(order, 9) + b"".join(rows)


def text_ply() -> bytes:
    rows = [" ".join(map(str, [*point, 200])) for point in POINTS] + [
        " ".join(map(str, [4, *face])) for face in QUADS
    ]
    return ply_header("ascii", 6) + "\n".join([*rows, ""]).encode()


def obj() -> bytes:
    rows = ["# a cube", *("v " + " ".join(map(str, point)) for point in POINTS), "vt 0 0", "g side"]
    rows += ["f " + " ".join(f"{corner + 1}/1" for corner in face) for face in QUADS[:3]]
    return "\n".join(
        [
            *rows,
            *("f " + " ".join(str(corner - 8) for corner in face) for face in TRIANGLES[6:]),
            "",
        ]
    ).encode()


def text_stl() -> bytes:
    rows = [
        "".join("vertex {} {} {}\n".format(*POINTS[corner]) for corner in face)
        for face in TRIANGLES
    ]
    return (
        "solid a\n"
        + "".join(f"facet normal 0 0 1\nouter loop\n{row}endloop\nendfacet\n" for row in rows)
        + "endsolid a\n"
    ).encode()


def binary_stl() -> bytes:
    rows = [struct.pack("<12fH", 0.0, 0.0, 0.0, *POINTS[face].ravel(), 0) for face in TRIANGLES]
    return b"a cube".ljust(80) + struct.pack("<I", len(rows)) + b"".join(rows)


FILES = {
    ".obj": [obj()],
    ".ply": [
        text_ply(),
        binary_ply("binary_little_endian", "<"),
        binary_ply("binary_big_endian", ">"),
    ],
    ".stl": [text_stl(), binary_stl()],
}


def accepted(path: Path, data: bytes) -> bool:
    """Return whether a file is a closed surface; a refusal must name it."""
    path.write_bytes(data)
    try:
        with limited(1 << 28):
            surface = read_mesh(path)
            assert np.isfinite(surface.crossings.doubled)
    except ValueError as error:
        assert str(error).startswith(str(path)), error
        return False
    return True


@pytest.mark.parametrize(
    ("suffix", "number"),
    [(suffix, number) for suffix, files in FILES.items() for number in range(len(files))],
)
def test_mesh_files(
    suffix: str,
    number: int,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = tmp_path_factory.mktemp("meshes")
    scene, mesh = folder / "scene.toml", folder / f"mesh{suffix}"
    scene.write_text(SCENE.format(suffix=suffix))
    monkeypatch.setattr(check, "free_memory", lambda device: 1 << 26)
    assert accepted(mesh, FILES[suffix][number])
    assert told("check", scene, "--device", "cpu") == 0

    @given(mutated([FILES[suffix][number]]))
    def reads(data: bytes) -> None:
        accepted(mesh, data)

    reads()


@pytest.mark.parametrize(
    ("suffix", "old", "new", "message"),
    [
        (
            ".ply",
            b"element vertex 8",
            b"element vertex 1000000000000000000",
            "1000000000000000000 x vertex",
        ),
        (".ply", b"element face 6", b"element face 999999999999", "999999999999 x face"),
        (".obj", b"f 1/1", b"f 1" + b"0" * 30, "a number of 31 digits"),
        (".obj", b"v 0.25", b"v 1e300", r"1e[+]300 from the origin"),
    ],
)
def test_sizes_are_not_believed(
    suffix: str, old: bytes, new: bytes, message: str, tmp_path: Path
) -> None:
    path = tmp_path / f"mesh{suffix}"
    assert old in FILES[suffix][0]
    path.write_bytes(FILES[suffix][0].replace(old, new))
    with limited(1 << 28), pytest.raises(ValueError, match=message):
        read_mesh(path)


def test_a_vertex_astray_does_not_merge_all_others(tmp_path: Path) -> None:
    """Mesh with one distant vertex.

    Of n vertices closer than a millionth of the mesh's size there are n^2 / 2 pairs.
    """
    count = 20_000
    chance = np.random.default_rng(4419)
    rows = [
        "v 1e12 0 0",
        *("v " + " ".join(map(str, point)) for point in chance.random((count, 3))),
    ]
    rows += [f"f 1 {number} {number + 1}" for number in range(2, count)]
    path = tmp_path / "mesh.obj"
    path.write_text("\n".join(rows))
    with (
        limited(1 << 28),
        pytest.raises(
            ValueError, match=r"mesh\.obj: most vertices lie within .* is there an outlier"
        ),
    ):
        read_mesh(path)
