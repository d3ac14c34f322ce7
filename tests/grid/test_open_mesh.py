"""Walls whose middle is an open mesh."""

from pathlib import Path

import numpy as np
import pytest

from small_liquids import advance, box, create, scene
from warp_lcp.grid.triangle_mesh import close_surface, load_surface, thickened


def patch(height, count=12):
    """Return a patch of count^2 squares over the unit square, at z = height(x, y)."""
    x = np.linspace(0.0, 1.0, count + 1)
    a, b = (grid.ravel() for grid in np.meshgrid(x, x, indexing="ij"))
    vertices = np.stack([a, b, height(a, b)], axis=1)
    first = (np.arange(count)[:, None] * (count + 1) + np.arange(count)).ravel()
    across = first + count + 1
    triangles = np.concatenate(
        [
            np.stack([first, across, across + 1], axis=1),
            np.stack([first, across + 1, first + 1], axis=1),
        ]
    )
    return vertices, triangles


def bowl(radius, rings=10, sectors=32):
    """Return the lower half of a sphere around the origin, open at its rim y = 0."""
    angle = 2.0 * np.pi * np.arange(sectors) / sectors
    down = 0.5 * np.pi * np.arange(rings) / rings
    ring = np.stack([np.cos(angle), np.zeros(sectors), np.sin(angle)], axis=1)
    points = [np.cos(d) * ring + np.array([0.0, -np.sin(d), 0.0]) for d in down]
    vertices = radius * np.concatenate([*points, [[0.0, -1.0, 0.0]]])
    triangles = []
    for r in range(rings - 1):
        for s in range(sectors):
            a, b = r * sectors + s, r * sectors + (s + 1) % sectors
            triangles += [(a, b, b + sectors), (a, b + sectors, a + sectors)]
    last = (rings - 1) * sectors
    triangles += [(last + s, last + (s + 1) % sectors, rings * sectors) for s in range(sectors)]
    return vertices, np.array(triangles)


@pytest.mark.parametrize("seed", range(4))
def test_a_bent_patch_becomes_a_wall_of_its_thickness(seed):
    rng = np.random.default_rng([6127, seed])
    thickness, tilt, bend = rng.uniform(0.002, 0.05), rng.normal(size=2), rng.normal(size=2)
    vertices, triangles = patch(
        lambda x, y: tilt[0] * x + tilt[1] * y + 0.3 * np.sin(2.0 * bend[0] * x) * bend[1] * y
    )
    corners = vertices[triangles]
    area = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    # Some triangles face the other way; the order of triangles does not matter.
    turned = rng.random(len(triangles)) < 0.3
    triangles = np.where(turned[:, None], triangles[:, ::-1], triangles)
    surface = close_surface(
        *thickened(vertices, rng.permutation(triangles), thickness, "patch"), "patch"
    )
    assert surface.volume == pytest.approx(area.sum() * thickness, rel=0.03)
    assert surface.warnings == ()


def test_faces_beside_a_fold_keep_their_distance():
    # Two squares at a right angle, along y and z: the faces are at x = +-t / 2 and z = +-t / 2.
    vertices = np.array(
        [[0, 0, 1], [0, 1, 1], [0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0]], dtype=float
    )
    triangles = np.array([[0, 2, 3], [0, 3, 1], [2, 4, 5], [2, 5, 3]])
    points, _ = thickened(vertices, triangles, 0.1, "angle")
    fold = points[[np.flatnonzero((np.abs(points[:, 0]) < 0.2) & (points[:, 2] < 0.2))]][0]
    assert np.allclose(np.abs(fold[:, [0, 2]]), 0.05)


def test_a_wall_has_the_thickness_of_the_scene_whatever_its_scale(tmp_path):
    from warp_lcp.grid.signed_distance import Placement, TriangleMesh

    vertices, triangles = patch(lambda x, _y: 0.0 * x)
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in triangles + 1]
    (tmp_path / "patch.obj").write_text("\n".join(lines))
    mesh = TriangleMesh.from_file(
        "patch.obj", folder=tmp_path, placement=Placement(scale=3.0), thickness=0.02
    )
    assert mesh.volume == pytest.approx(9.0 * 0.02, rel=1e-6)


def strip_with_one_side(count=24):
    """Return a Moebius strip."""
    angle = 2.0 * np.pi * np.arange(count) / count
    middle = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    across = np.stack(
        [
            np.cos(0.5 * angle) * np.cos(angle),
            np.cos(0.5 * angle) * np.sin(angle),
            np.sin(0.5 * angle),
        ],
        axis=1,
    )
    vertices = np.concatenate([middle - 0.2 * across, middle + 0.2 * across])
    triangles = []
    for n in range(count):
        a, b = n, n + count
        c, d = (n + 1, n + 1 + count) if n < count - 1 else (count, 0)
        triangles += [(a, c, d), (a, d, b)]
    return vertices, np.array(triangles)


def test_meshes_that_are_no_walls_are_refused(tmp_path):
    vertices, triangles = patch(lambda x, y: 0.1 * x * y)
    with pytest.raises(ValueError, match=r"not closed.*or give its thickness"):
        close_surface(vertices, triangles, "patch")
    with pytest.raises(ValueError, match="more than a hundred-thousandth of its diagonal"):
        thickened(vertices, triangles, 1e-6, "patch")
    with pytest.raises(ValueError, match="one side only"):
        thickened(*strip_with_one_side(), 0.01, "strip")
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 1.0]])
    with pytest.raises(ValueError, match="more than two triangles"):
        thickened(corners, np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]]), 0.01, "book")
    with pytest.raises(ValueError, match="this mesh is closed"):
        thickened(corners[:4], np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]), 0.01, "one")
    with pytest.raises(ValueError, match="this mesh is closed"):
        load_surface("builtin:torus", tmp_path, 0.01)


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("thickness", [0.05, 0.6])
def test_a_bowl_of_an_open_mesh_holds_its_water(tmp_path: Path, thickness: float):
    cell = 1.0 / 16
    vertices, triangles = bowl(0.35)
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in triangles + 1]
    (tmp_path / "bowl.obj").write_text("\n".join(lines))
    simulation = create(
        scene(
            size=[1.0, 1.0, 1.0],
            resolution=16,
            liquid=[box([0.32, 0.4, 0.32], [0.68, 0.6, 0.68])],
            solid=[
                {
                    "shape": "mesh",
                    "file": str(tmp_path / "bowl.obj"),
                    "thickness": thickness * cell,
                    "translate": [0.51, 0.62, 0.49],
                }
            ],
        )
    )
    rows = advance(simulation, 0.3)
    away = simulation.particles.position.numpy() - np.array([0.51, 0.62, 0.49])
    # The rim is at 0; drops may rise above it, inside.
    assert (np.linalg.norm(away, axis=1) < 0.35).all()
    assert (away[:, 1] < cell).all()
    assert (away[:, 1] < 0.0).mean() > 0.99
    assert all(row["solve_status"] in (None, "CONVERGED") for row in rows)
