from pathlib import Path

import meshio
import numpy as np
import pytest
import warp as wp

from grid_fields import distances
from warp_lcp.grid.signed_distance import Placement, TriangleMesh
from warp_lcp.grid.triangle_mesh import (
    ClosedSurface,
    builtin_mesh,
    close_surface,
    load_surface,
    read_mesh,
    winding_number,
)

SPOT = Path(__file__).resolve().parents[2] / "../shared/data/spot.obj"
CPU = wp.get_device("cpu")

CUBE = np.array([[x, y, z] for z in (0.0, 1.0) for y in (0.0, 1.0) for x in (0.0, 1.0)])
QUADS = np.array(
    [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
)
CUBE_TRIANGLES = np.concatenate([QUADS[:, [0, 1, 2]], QUADS[:, [0, 2, 3]]])


def icosphere(levels):
    """Return vertices on the unit sphere and outward triangles.

    They are those of an icosahedron, each triangle divided into four `levels` times.
    """
    g = (1.0 + np.sqrt(5.0)) / 2.0
    vertices = np.array(
        [
            [-1, g, 0],
            [1, g, 0],
            [-1, -g, 0],
            [1, -g, 0],
            [0, -1, g],
            [0, 1, g],
            [0, -1, -g],
            [0, 1, -g],
            [g, 0, -1],
            [g, 0, 1],
            [-g, 0, -1],
            [-g, 0, 1],
        ]
    )
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    distance = np.linalg.norm(vertices[:, None] - vertices[None], axis=-1)
    near = np.isclose(distance, distance[distance > 0].min())
    triangles = [
        (i, j, k)
        for i in range(12)
        for j in range(i)
        for k in range(j)
        if near[i, j] and near[j, k] and near[k, i]
    ]
    corners = vertices[np.array(triangles)]
    for _ in range(levels):
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        ab, bc, ca = a + b, b + c, c + a
        corners = np.concatenate(
            [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
        corners /= np.linalg.norm(corners, axis=2, keepdims=True)
    outward = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) > 0
    corners[~outward] = corners[~outward][:, ::-1]
    return corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)


def parity_inside(points, surface, direction):
    """Return the number of triangles that a ray meets (Moeller and Trumbore).

    There is one number for each point.
    """
    a, b, c = (surface.vertices[surface.triangles[:, corner]] for corner in range(3))
    e1, e2 = b - a, c - a
    h = np.cross(direction, e2)
    determinant = np.einsum("ij,ij->i", e1, h)
    odd = np.empty(len(points), dtype=bool)
    for i, point in enumerate(points):
        s = point - a
        q = np.cross(s, e1)
        u, v = np.einsum("ij,ij->i", s, h) / determinant, q @ direction / determinant
        t = np.einsum("ij,ij->i", e2, q) / determinant
        odd[i] = np.count_nonzero((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)) % 2
    return odd


def test_sphere_of_triangles_is_nearly_a_sphere():
    surface = close_surface(*icosphere(3), name="icosphere")
    assert surface.vertices.shape == (642, 3)
    assert surface.triangles.shape == (1280, 3)
    assert surface.warnings == ()
    assert 0.98 < surface.volume / (4.0 / 3.0 * np.pi) < 1.0
    mesh = TriangleMesh(
        surface=surface,
        placement=Placement.from_degrees(0.5, [10.0, 20.0, 30.0], [1.0, 2.0, 3.0], 3),
    )
    assert mesh.volume == pytest.approx(surface.volume / 8.0)
    points = np.random.default_rng(4410).uniform(0.0, 4.0, (4000, 3))
    exact = np.linalg.norm(points - [1.0, 2.0, 3.0], axis=1) - 0.5
    sagitta = 0.5 * (
        1.0 - np.linalg.norm(surface.vertices[surface.triangles].mean(axis=1), axis=1).min()
    )
    error = distances(mesh, points) - exact
    assert error.min() > -1e-5  # the faceted sphere lies within the sphere
    assert error.max() < sagitta + 1e-5


@pytest.mark.parametrize("invert", [False, True])
def test_distance_to_a_cube_mesh_is_exact_far_from_the_origin(invert):
    offset = np.array([3.0e5, -2.0e5, 1.0e5])
    surface = close_surface(CUBE + offset, CUBE_TRIANGLES, "cube")
    mesh = TriangleMesh(
        surface=surface, invert=invert, placement=Placement(scale=2.0, translation=-2.0 * offset)
    )
    points = np.random.default_rng(4411).uniform(-1.0, 3.0, (1000, 3))
    inner = np.minimum(points, 2.0 - points).min(axis=1)
    outer = np.linalg.norm(points - np.clip(points, 0.0, 2.0), axis=1)
    expected = np.where(inner > 0, -inner, outer)
    np.testing.assert_allclose(
        distances(mesh, points), -expected if invert else expected, atol=1e-5
    )


def test_device_mesh_is_made_once():
    surface = builtin_mesh("torus")
    assert surface.on_device(CPU) is surface.on_device(CPU)


def test_builtin_torus():
    surface = builtin_mesh("torus")
    assert surface.volume == pytest.approx(2.0 * np.pi**2 * 0.35 * 0.15**2, rel=0.005)
    points = np.random.default_rng(4412).uniform(-0.6, 0.6, (3000, 3))
    exact = np.hypot(np.hypot(points[:, 0], points[:, 1]) - 0.35, points[:, 2]) - 0.15
    np.testing.assert_allclose(distances(TriangleMesh(surface=surface), points), exact, atol=8e-4)


def test_builtin_knot_is_a_tube_with_its_curve_inside():
    surface = builtin_mesh("knot")
    assert surface.warnings == ()
    extent = np.ptp(surface.vertices, axis=0)
    assert extent.max() == pytest.approx(1.0)
    t = np.linspace(0.0, 2.0 * np.pi, 200)
    curve = np.stack(
        [np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], axis=-1
    )
    scale = extent[2] / 3.0  # the curve spans z = [-1, 1], the tube half a unit more
    curve *= scale
    curve[:, 1] += surface.vertices[:, 1].max() - (curve[:, 1].max() + 0.5 * scale)
    np.testing.assert_allclose(
        distances(TriangleMesh(surface=surface), curve), -0.5 * scale, rtol=0.03
    )
    length = np.linalg.norm(np.diff(curve, axis=0), axis=1).sum()
    assert surface.volume == pytest.approx(np.pi * (0.5 * scale) ** 2 * length, rel=0.02)


def test_unknown_builtin_lists_the_known():
    with pytest.raises(ValueError, match=r"builtin:bunny; choose from builtin:knot, builtin:torus"):
        load_surface("builtin:bunny")


def test_winding_number_counts():
    corners = CUBE[CUBE_TRIANGLES]
    assert winding_number(np.array([0.3, 0.6, 0.2]), corners) == pytest.approx(1.0)
    assert winding_number(np.array([1.3, 0.6, 0.2]), corners) == pytest.approx(0.0, abs=1e-12)


def test_thickness():
    surface = close_surface(CUBE * [1.0, 0.05, 1.0], CUBE_TRIANGLES, "plate")
    # All but the narrow sides.
    assert surface.thin_fraction(0.05002, CPU) == pytest.approx(2.0 / 2.2, abs=1e-3)
    assert surface.thin_fraction(0.04998, CPU) == 0.0


# --- files ---


def assert_unit_cube(surface):
    assert isinstance(surface, ClosedSurface)
    assert surface.vertices.shape == (8, 3)
    assert surface.triangles.shape == (12, 3)
    assert surface.volume == pytest.approx(1.0, abs=1e-6)
    assert surface.warnings == ()


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("suffix", ["stl", "ply"])
def test_reads_what_meshio_writes(tmp_path, suffix, binary):
    path = tmp_path / f"cube.{suffix}"
    meshio.Mesh(CUBE, [("triangle", CUBE_TRIANGLES)]).write(path, binary=binary)
    assert_unit_cube(read_mesh(path))


@pytest.mark.parametrize("binary", [False, True])
def test_reads_quads_and_the_other_name_of_a_ply_list(tmp_path, binary):
    path = tmp_path / "cube.PLY"
    meshio.ply.write(path, meshio.Mesh(CUBE, [("quad", QUADS.astype(np.int32))]), binary=binary)
    data = path.read_bytes()
    assert b"vertex_indices" in data
    path.write_bytes(data.replace(b"vertex_indices", b"vertex_index"))
    assert_unit_cube(read_mesh(path))


def obj_text(faces, vertices=CUBE):
    return "\n".join([*("v " + " ".join(map(str, v)) for v in vertices), *faces]) + "\n"


def test_reads_an_obj_with_seams_colors_and_polygons(tmp_path):
    lines = [
        "# a cube",
        "mtllib cube.mtl",
        *("v " + " ".join(map(str, v)) + " 0.5 0.5 0.5" for v in CUBE),
        "vt 0 0",
        "vt 0 1",
        "vn 0 0 1",
        "g side",
    ]
    lines += ["f " + " ".join(f"{v + 1}/1/1" for v in quad) for quad in QUADS[:3]]
    lines += ["f " + " ".join(f"{v + 1}/2" for v in quad) for quad in QUADS[3:5]]
    a, b, c, d = (v + 1 for v in QUADS[5])
    lines += [f"f {a} {b} \\", f"  {c}", f"f {a}//1 {c}//1 {d}//1", ""]
    path = tmp_path / "cube.obj"
    path.write_text("\n".join(lines))
    assert_unit_cube(read_mesh(path))
    assert_unit_cube(load_surface("cube.obj", tmp_path))


def test_reads_relative_indices(tmp_path):
    path = tmp_path / "cube.obj"
    path.write_text(obj_text(["f " + " ".join(str(v - 8) for v in quad) for quad in QUADS]))
    assert_unit_cube(read_mesh(path))


def test_reads_a_text_stl_with_capitals_and_blank_lines(tmp_path):
    facets = (
        "FACET NORMAL 0 0 0\nOUTER LOOP\n"
        + "".join("VERTEX {} {} {}\n".format(*v) for v in CUBE[t])
        + "ENDLOOP\nENDFACET\n\n"
        for t in CUBE_TRIANGLES
    )
    path = tmp_path / "cube.stl"
    path.write_text("SOLID cube\n" + "".join(facets) + "ENDSOLID\n\n")
    assert_unit_cube(read_mesh(path))


def test_binary_stl_may_begin_like_a_text_one(tmp_path):
    path = tmp_path / "cube.stl"
    meshio.Mesh(CUBE, [("triangle", CUBE_TRIANGLES)]).write(path, binary=True)
    data = path.read_bytes()
    path.write_bytes(b"solid cube".ljust(80) + data[80:])
    assert_unit_cube(read_mesh(path))


OBJ = obj_text(["f " + " ".join(str(v + 1) for v in quad) for quad in QUADS])
TEXT_STL = (
    "solid cube\n"
    + "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join("vertex {} {} {}\n".format(*v) for v in CUBE[t])
        + "endloop\nendfacet\n"
        for t in CUBE_TRIANGLES
    )
    + "endsolid cube\n"
)
PLY = (
    "ply\nformat ascii 1.0\ncomment a cube\nelement vertex 8\nproperty float x\nproperty float "
    "y\nproperty float z\nelement face 6\n"
    "property list uchar int vertex_indices\nend_header\n"
    + "".join("{} {} {}\n".format(*v) for v in CUBE)
    + "".join("4 {} {} {} {}\n".format(*quad) for quad in QUADS)
)
TEXTS = {"obj": OBJ, "stl": TEXT_STL, "ply": PLY}
SPELLINGS = {
    "mark": lambda text: b"\xef\xbb\xbf" + text,
    "CRLF": lambda text: text.replace(b"\n", b"\r\n"),
    "CR": lambda text: text.replace(b"\n", b"\r"),
    "mark and CRLF": lambda text: b"\xef\xbb\xbf" + text.replace(b"\n", b"\r\n"),
    "tabs": lambda text: text.replace(b" ", b"\t"),
    "blanks at the ends": lambda text: text.replace(b"\n", b"  \n"),
    "bytes behind": lambda text: text + b"\n\0\0",
}


@pytest.mark.every_case
@pytest.mark.parametrize("spelling", SPELLINGS)
@pytest.mark.parametrize("suffix", TEXTS)
def test_however_a_text_is_spelled(tmp_path, suffix, spelling):
    path = tmp_path / f"cube.{suffix}"
    path.write_bytes(SPELLINGS[spelling](TEXTS[suffix].encode()))
    assert_unit_cube(read_mesh(path))


@pytest.mark.parametrize("suffix", TEXTS)
def test_wide_text_is_refused_as_such(tmp_path, suffix):
    path = tmp_path / f"cube.{suffix}"
    path.write_bytes(TEXTS[suffix].encode("utf-16"))
    with pytest.raises(ValueError, match="it is UTF-16 text; save it as UTF-8"):
        read_mesh(path)


@pytest.mark.every_case
@pytest.mark.parametrize("head", [b"", b"solid cube", b"  SOLID"])
@pytest.mark.parametrize("behind", [b"", b"x", bytes(49), bytes(50), b"made by a scanner"])
def test_binary_stl_with_bytes_behind_its_triangles(tmp_path, head, behind):
    path = tmp_path / "cube.stl"
    meshio.Mesh(CUBE, [("triangle", CUBE_TRIANGLES)]).write(path, binary=True)
    path.write_bytes(head.ljust(80, b" ") + path.read_bytes()[80:] + behind)
    assert_unit_cube(read_mesh(path))


@pytest.mark.parametrize("head", [b"", b"solid cube"])
@pytest.mark.parametrize(
    ("count", "message"),
    [
        (13, "it declares 13 triangles and holds 12"),
        (2**32 - 1, "holds 12"),
        (0, "it declares no triangles"),
    ],
)
def test_binary_stl_with_a_wrong_count(tmp_path, head, count, message):
    path = tmp_path / "cube.stl"
    meshio.Mesh(CUBE, [("triangle", CUBE_TRIANGLES)]).write(path, binary=True)
    path.write_bytes(head.ljust(80, b"\0") + count.to_bytes(4, "little") + path.read_bytes()[84:])
    with pytest.raises(ValueError, match=message):
        read_mesh(path)


@pytest.mark.every_case
@pytest.mark.parametrize("suffix", TEXTS)
@pytest.mark.parametrize(
    ("word", "message"),
    [("nan", "not finite"), ("-inf", "not finite"), ("1_0", "1_0"), ("0,5", "0,5")],
)
def test_coordinates_that_are_no_numbers(tmp_path, suffix, word, message):
    path = tmp_path / f"cube.{suffix}"
    first = " ".join(map(str, CUBE[3]))
    assert first in TEXTS[suffix]
    path.write_text(TEXTS[suffix].replace(first, f"{word} 0 0"))
    with pytest.raises(ValueError, match=message):
        read_mesh(path)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.stl", "", "the mesh file is empty"),
        ("a.ply", PLY.replace("4 ", "-4 ", 1), "a list of a face has -4 entries"),
        ("a.obj", OBJ.replace("f ", "f 1_", 1), "1_"),
        ("a.obj", "", "no vertices"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nl 1 2\n", "no triangles"),
        ("a.obj", "v 0 0 zero\n", "not a readable OBJ"),
        ("a.obj", "v 0 0 0\nv 0 1\nf 1 2 1\n", "not a readable OBJ"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "vertex that does not exist"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "vertex that does not exist"),
        ("a.stl", "\x7fELF", "not a readable STL"),
        ("a.stl", "solid a\nendsolid a\n", "no triangles"),
        ("a.stl", "solid a\nfacet\nvertex 0 0 0\nendfacet\nendsolid a\n", "1 corners in 1 facets"),
        (
            "a.stl",
            "solid a\nfacet\nvertex 0 0 x\nvertex 0 0 0\nvertex 0 0 0\nendfacet\nendsolid a\n",
            "not a readable STL",
        ),
        ("a.ply", "", "not a readable PLY"),
        (
            "a.ply",
            "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\n",
            "not a readable PLY",
        ),
        ("a.ply", "ply\nformat ascii 1.0\nelement camera 3\nend_header\n", "no vertices"),
        (
            "a.ply",
            "ply\nformat ascii 1.0\nelement vertex 3\nproperty quad x\nend_header\n",
            "unknown line in its header: 'property quad x'",
        ),
        (
            "a.ply",
            "ply\nformat ascii 1.0\nproperty float x\nelement vertex 3\nend_header\n",
            "unknown line in its header: 'property float x'",
        ),
        ("a.vtk", "", r"must be one of \.obj, \.ply, \.stl"),
    ],
)
def test_unreadable_files_are_named(tmp_path, capsys, name, content, message):
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_mesh(path)
    assert str(path) in str(caught.value)
    assert capsys.readouterr().out == ""


def test_missing_file_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"gone\.obj: there is no such mesh file"):
        load_surface("gone.obj", tmp_path)
    (tmp_path / "folder.obj").mkdir()
    with pytest.raises(ValueError, match=r"folder\.obj: the mesh file cannot be read"):
        load_surface("folder.obj", tmp_path)


# --- defects ---


@pytest.mark.parametrize("bad", ["nan", "inf"])
def test_vertices_that_are_not_finite(tmp_path, bad):
    vertices = [[*CUBE[0][:2], bad], *CUBE[1:].tolist()]
    path = tmp_path / "cube.obj"
    path.write_text(
        obj_text(["f " + " ".join(str(v + 1) for v in quad) for quad in QUADS], vertices)
    )
    with pytest.raises(ValueError, match=r"cube\.obj: 1 of 8 vertices is not finite"):
        read_mesh(path)


def test_open_surface_counts_its_open_edges():
    with pytest.raises(
        ValueError,
        match=r"cube: the surface is not closed: 3 of its 18 edges are open, the first at .*would "
        r"leak.*Fill the holes",
    ):
        close_surface(CUBE, CUBE_TRIANGLES[:-1], "cube")


def test_degenerate_triangles_are_dropped():
    vertices = np.concatenate([CUBE, [[0.5, 0.5, 0.0], [0.0, 0.0, 0.0]]])
    triangles = np.concatenate([CUBE_TRIANGLES, [[0, 0, 1], [2, 3, 2], [0, 9, 3]]])
    surface = close_surface(vertices, triangles, "cube")
    assert surface.warnings == (
        "cube: dropped 3 degenerate triangles (without area), the first at [0.3333, 0, 0]",
    )
    assert surface.triangles.shape == (12, 3)
    assert surface.volume == pytest.approx(1.0)


def test_a_seam_may_be_closed_by_a_triangle_without_area():
    # The first face's diagonal, split on one of its sides only.
    a, c, b = QUADS[0][0], QUADS[0][2], 8
    vertices = np.concatenate([CUBE, [[0.5, 0.5, 0.0]]])
    halves = [[a, QUADS[0][1], b], [b, QUADS[0][1], c]]
    triangles = np.concatenate([CUBE_TRIANGLES[1:], halves, [[a, b, c]]])
    surface = close_surface(vertices, triangles, "cube")
    assert surface.warnings == (
        "cube: dropped 1 degenerate triangles (without area), the first at [0.5, 0.5, 0]",
    )
    assert surface.volume == pytest.approx(1.0)
    points = np.random.default_rng(4413).uniform(-0.5, 1.5, (500, 3))
    assert (
        (distances(TriangleMesh(surface=surface), points) < 0)
        == ((points > 0) & (points < 1)).all(axis=1)
    ).all()


def test_only_degenerate_triangles():
    with pytest.raises(ValueError, match="all 2 triangles are degenerate"):
        close_surface(CUBE, np.array([[0, 1, 1], [2, 2, 2]]), "cube")
    with pytest.raises(ValueError, match="no triangles"):
        close_surface(CUBE, np.empty((0, 3)), "cube")


def test_flat_surface_encloses_nothing():
    with pytest.raises(ValueError, match="encloses no volume"):
        close_surface(CUBE[:4], np.array([[0, 1, 3], [0, 3, 2], [0, 3, 1], [0, 2, 3]]), "sheet")


def test_repeated_triangles_are_dropped():
    surface = close_surface(
        CUBE, np.concatenate([CUBE_TRIANGLES, CUBE_TRIANGLES[:3][:, [1, 2, 0]]]), "cube"
    )
    assert surface.warnings == (
        "cube: dropped 3 repeated triangles, the first at [0.3333, 0.6667, 0]",
    )
    assert surface.volume == pytest.approx(1.0)


def test_close_vertices_are_welded():
    corners = CUBE[CUBE_TRIANGLES].reshape(-1, 3)
    noise = np.random.default_rng(4414).uniform(-2e-7, 2e-7, corners.shape)
    assert_unit_cube(close_surface(corners + noise, np.arange(36).reshape(-1, 3), "cube"))


def test_disagreeing_triangles_are_turned():
    triangles = CUBE_TRIANGLES.copy()
    triangles[[2, 7, 9]] = triangles[[2, 7, 9]][:, ::-1]
    surface = close_surface(CUBE, triangles, "cube")
    (warning,) = surface.warnings
    assert (
        warning
        == "cube: turned 3 of 12 triangles that disagreed with their neighbors' orientation, the "
        "first at [0.6667, 0, 0.3333]"
    )
    assert surface.volume == pytest.approx(1.0)


def test_inside_out_is_turned():
    surface = close_surface(CUBE, CUBE_TRIANGLES[:, ::-1], "cube")
    assert surface.warnings == ("cube: the mesh was inside out; turned",)
    assert surface.volume == pytest.approx(1.0)


def test_one_of_two_parts_inside_out_is_turned():
    vertices = np.concatenate([2.0 * CUBE, CUBE + 5.0])
    triangles = np.concatenate([CUBE_TRIANGLES, 8 + CUBE_TRIANGLES[:, ::-1]])
    surface = close_surface(vertices, triangles, "cubes")
    assert surface.warnings == (
        "cubes: 1 of its 2 parts were inside out, the first at [5.333, 5.667, 5]; turned",
    )
    assert surface.volume == pytest.approx(9.0)


@pytest.mark.parametrize("inside_out", [False, True])
def test_a_hollow_stays_hollow(inside_out):
    vertices = np.concatenate([3.0 * CUBE, CUBE + 1.0])
    triangles = np.concatenate([CUBE_TRIANGLES, 8 + CUBE_TRIANGLES[:, ::-1]])
    surface = close_surface(vertices, triangles[:, ::-1] if inside_out else triangles, "shell")
    assert surface.volume == pytest.approx(26.0)
    np.testing.assert_allclose(
        distances(TriangleMesh(surface=surface), np.array([[1.5, 1.5, 1.5], [0.5, 1.5, 1.5]])),
        [0.5, -0.5],
        atol=1e-6,
    )


def test_parts_that_touch_along_an_edge_are_closed():
    vertices = np.concatenate([CUBE, CUBE + np.array([1.0, 1.0, 0.0])])
    surface = close_surface(vertices, np.concatenate([CUBE_TRIANGLES, 8 + CUBE_TRIANGLES]), "cubes")
    assert surface.vertices.shape == (14, 3)
    assert surface.volume == pytest.approx(2.0)


def test_touching_part_inside_out_is_turned():
    vertices = np.concatenate([CUBE, CUBE + np.array([1.0, 1.0, 0.0])])
    surface = close_surface(
        vertices, np.concatenate([CUBE_TRIANGLES, 8 + CUBE_TRIANGLES[:, ::-1]]), "cubes"
    )
    assert surface.warnings == (
        "cubes: 1 of its 2 parts were inside out, the first at [1.333, 1.667, 0]; turned",
    )
    assert surface.volume == pytest.approx(2.0)


def test_tangled_edges_are_refused():
    # Every second cube of a block whose sides are joined: four squares meet at every edge. The
    # places of the vertices do not matter.
    n = 4
    cells = [cell for cell in np.ndindex(n, n, n) if sum(cell) % 2 == 0]
    corners = np.array(cells)[:, None] + CUBE[None].astype(int)
    number = np.ravel_multi_index(tuple(np.moveaxis(corners % n, -1, 0)), (n, n, n))
    quads = number[:, QUADS].reshape(-1, 4)
    vertices = np.random.default_rng(4417).random((n**3, 3))
    quads[7] = quads[7][::-1]
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    with pytest.raises(ValueError, match=r"at 4 edges more than two triangles meet"):
        close_surface(vertices, triangles, "block")


def test_one_sided_surface_is_refused():
    # A Klein bottle as an n x n grid whose last row is joined to the first one reversed. Its shape
    # does not matter.
    n = 12
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")

    def number(row, column):
        return np.where(row == n, (n - column) % n, row % n * n + column % n)

    a, b, c, d = number(i, j), number(i + 1, j), number(i + 1, j + 1), number(i, j + 1)
    triangles = np.concatenate(
        [np.stack([a, b, c], axis=-1).reshape(-1, 3), np.stack([a, c, d], axis=-1).reshape(-1, 3)]
    )
    vertices = np.random.default_rng(4415).random((n * n, 3))
    with pytest.raises(ValueError, match="one side only"):
        close_surface(vertices, triangles, "bottle")


@pytest.mark.skipif(not SPOT.exists(), reason="../shared/data/spot.obj is not there")
def test_spot():
    surface = read_mesh(SPOT)
    assert surface.warnings == ()
    assert surface.triangles.shape == (5856, 3)
    assert 0.5 < surface.volume < 1.0
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    points = np.random.default_rng(4416).uniform(low, high, (500, 3))
    inside = distances(TriangleMesh(surface=surface), points) < 0.0
    direction = np.array([0.3612, 0.8431, 0.3989])
    np.testing.assert_array_equal(
        inside, parity_inside(points, surface, direction / np.linalg.norm(direction))
    )
    assert 100 < inside.sum() < 400
