"""Mass, center and inertia of shapes.

Against closed forms of other derivations, sums over voxels and quadrature.
"""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate

from warp_lcp.grid.motion import Pose
from warp_lcp.grid.signed_distance import Box, Capsule, Placement, Plane, Sphere, TriangleMesh
from warp_lcp.grid.triangle_mesh import builtin_mesh, close_surface
from warp_lcp.grid.voxelize import inside
from warp_lcp.rigid.mass_properties import MassProperties, mass_properties
from warp_lcp.rigid.outline import body_surface, mesh_outline

TURNED = Placement.from_degrees(1.7, [20.0, -35.0, 50.0], [0.3, -0.2, 0.5], 3)


def box_mesh(lower, upper, placement=None):
    """Return a box as a mesh of 12 triangles."""
    surface = body_surface(Box(lower=lower, upper=upper), 3)
    closed = close_surface(surface.points, surface.corners, "box")
    assert not closed.warnings  # its triangles face outward
    return TriangleMesh(surface=closed, placement=placement or Placement())


def sampled(geometry, bounds, dimension, count):
    """Return area or volume, center and inertia at density 1.

    From the centers of voxels that lie inside.
    """
    low, high = bounds[:, :dimension]
    step = (high - low) / count
    axes = [low[a] + step[a] * (np.arange(count) + 0.5) for a in range(dimension)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, dimension)
    if dimension == 2:
        points = np.column_stack([points, np.zeros(len(points))])
    points = points[inside([geometry], points, device="cpu")]
    part = step.prod()
    center = points.mean(axis=0)
    r = points - center
    second = np.einsum("ni,nj->ij", r, r) * part
    return len(points) * part, center, np.trace(second) * np.eye(3) - second


def test_of_a_box_in_space():
    properties = mass_properties(Box(lower=[1.0, 2.0, 3.0], upper=[2.0, 4.0, 6.0]), 3, density=10.0)
    assert properties.mass == pytest.approx(60.0)
    np.testing.assert_allclose(properties.center, [1.5, 3.0, 4.5])
    np.testing.assert_allclose(
        properties.inertia, np.diag([60 * 13 / 12, 60 * 10 / 12, 60 * 5 / 12])
    )


@pytest.mark.parametrize(
    ("shape", "mass", "zz"),
    [
        (Box(lower=[1.0, 2.0], upper=[3.0, 3.0]), 2.0, 2.0 * 5.0 / 12.0),
        (Sphere(center=[0.5, 0.5], radius=0.3), np.pi * 0.09, 0.5 * np.pi * 0.3**4),
    ],
)
def test_in_the_plane(shape, mass, zz):
    properties = mass_properties(shape, 2, density=1.0)
    assert properties.mass == pytest.approx(mass)
    assert properties.inertia[2, 2] == pytest.approx(zz)
    assert properties.center[2] == 0.0


def test_mass_scales_the_inertia():
    ball = Sphere(center=[0.0, 0.0, 0.0], radius=0.2, placement=TURNED)
    properties = mass_properties(ball, 3, mass=3.0)
    np.testing.assert_allclose(
        properties.inertia, 0.4 * 3.0 * (0.2 * 1.7) ** 2 * np.eye(3), atol=1e-15
    )
    np.testing.assert_allclose(properties.center, TURNED.translation)


@pytest.mark.parametrize("dimension", [2, 3])
def test_of_a_capsule_by_quadrature(dimension):
    """Mass properties of a capsule by quadrature.

    Slices across the axis are segments or discs.
    """
    r, length = 0.4, 1.1
    end = [0.3, 0.2, 0.9][:dimension]
    axis = length * np.array([0.6, 0.8, 0.0])[:dimension]
    shape = Capsule(start=end, end=(np.array(end) + axis).tolist(), radius=r)
    properties = mass_properties(shape, dimension, density=1.0)

    def half(s):  # half the width of the slice at s
        return np.sqrt(max(r**2 - max(-s, s - length, 0.0) ** 2, 0.0))

    h = 0.5 * length
    pieces = [(-r, 0.0), (0.0, length), (length, length + r)]

    def integral(f):
        return sum(integrate.quad(f, a, b)[0] for a, b in pieces)

    if dimension == 2:
        assert properties.mass == pytest.approx(integral(lambda s: 2 * half(s)))
        about = integral(lambda s: 2 * half(s) * (s - h) ** 2 + 2 * half(s) ** 3 / 3)
        assert properties.inertia[2, 2] == pytest.approx(about)
        return
    assert properties.mass == pytest.approx(integral(lambda s: np.pi * half(s) ** 2))
    along = integral(lambda s: 0.5 * np.pi * half(s) ** 4)
    across = integral(lambda s: np.pi * half(s) ** 2 * ((s - h) ** 2 + 0.25 * half(s) ** 2))
    np.testing.assert_allclose(
        np.linalg.eigvalsh(properties.inertia), sorted([along, across, across]), rtol=1e-8
    )
    direction = axis / length
    np.testing.assert_allclose(properties.inertia @ direction, along * direction, rtol=1e-8)


def test_a_box_as_a_mesh_is_the_box():
    lower, upper = [0.1, 0.2, 0.3], [0.5, 0.9, 0.6]
    exact = mass_properties(Box(lower=lower, upper=upper, placement=TURNED), 3, density=700.0)
    mesh = mass_properties(box_mesh(lower, upper, TURNED), 3, density=700.0)
    assert mesh.mass == pytest.approx(exact.mass, rel=1e-13)
    np.testing.assert_allclose(mesh.center, exact.center, rtol=1e-13)
    np.testing.assert_allclose(mesh.inertia, exact.inertia, rtol=1e-12, atol=1e-12)


def test_a_box_as_a_mesh_in_the_plane_is_the_rectangle():
    place = Placement.from_degrees(0.7, [25.0], [0.2, 0.3], 2)
    lower, upper = [0.1, 0.2], [0.5, 0.9]
    exact = mass_properties(Box(lower=lower, upper=upper, placement=place), 2, density=700.0)
    mesh = mass_properties(box_mesh([*lower, -0.4], [*upper, 0.9], place), 2, density=700.0)
    assert mesh.mass == pytest.approx(exact.mass, rel=1e-13)
    np.testing.assert_allclose(mesh.center, exact.center, rtol=1e-13)
    assert mesh.inertia[2, 2] == pytest.approx(exact.inertia[2, 2], rel=1e-12)


def test_far_from_the_origin_the_inertia_is_the_same():
    """Inertia far from the origin, by the parallel axis theorem.

    About the center it does not depend on the place.
    """
    near = mass_properties(box_mesh([0, 0, 0], [1, 2, 3]), 3, density=1.0)
    far = mass_properties(
        box_mesh([0, 0, 0], [1, 2, 3], Placement(translation=np.array([300.0, -200.0, 100.0]))),
        3,
        density=1.0,
    )
    np.testing.assert_allclose(far.inertia, near.inertia, rtol=1e-10, atol=1e-9)


def test_two_boxes_in_one_mesh_follow_the_parallel_axis_theorem():
    parts = [([0, 0, 0], [1, 1, 1]), ([2, 1, 0], [4, 2, 3])]
    surfaces = [body_surface(Box(lower=low, upper=high), 3) for low, high in parts]
    points = np.concatenate([surface.points for surface in surfaces])
    corners = np.concatenate([surfaces[0].corners, surfaces[1].corners + 8])
    both = mass_properties(
        TriangleMesh(surface=close_surface(points, corners, "two")), 3, density=1.0
    )
    single = [mass_properties(Box(lower=low, upper=high), 3, density=1.0) for low, high in parts]
    mass = sum(p.mass for p in single)
    center = sum(p.mass * p.center for p in single) / mass
    inertia = np.zeros((3, 3))
    for p in single:
        d = p.center - center
        inertia += p.inertia + p.mass * (d @ d * np.eye(3) - np.outer(d, d))
    np.testing.assert_allclose(both.center, center, rtol=1e-12)
    np.testing.assert_allclose(both.inertia, inertia, rtol=1e-12)


@pytest.mark.parametrize("dimension", [2, 3])
def test_of_an_irregular_mesh_by_voxels(dimension):
    rotate = [30.0] if dimension == 2 else [30.0, 70.0, -20.0]
    place = Placement.from_degrees(0.8, rotate, [0.4, 0.6, -0.3][:dimension], dimension)
    mesh = TriangleMesh(surface=builtin_mesh("knot"), placement=place)
    properties = mass_properties(mesh, dimension, density=1.0)
    volume, center, inertia = sampled(mesh, mesh.bounds(), dimension, 200 if dimension == 2 else 60)
    assert properties.mass == pytest.approx(volume, rel=5e-3)
    np.testing.assert_allclose(properties.center, center, atol=1e-3)
    wanted = properties.inertia[2:, 2:] if dimension == 2 else properties.inertia
    given = inertia[2:, 2:] if dimension == 2 else inertia
    np.testing.assert_allclose(wanted, given, atol=6e-3 * np.trace(inertia))


def test_the_outline_has_the_inside_on_its_left():
    for translate in ([0.0, 0.0], [0.3, -0.2]):
        mesh = TriangleMesh(
            surface=builtin_mesh("torus"),
            placement=Placement.from_degrees(1.0, [15.0], translate, 2),
        )
        p, q = np.moveaxis(mesh_outline(mesh), 1, 0)
        assert (p[:, 2] == 0.0).all()
        middle, way = 0.5 * (p + q), q - p
        left = np.stack([-way[:, 1], way[:, 0], np.zeros(len(way))], axis=1)
        left *= 1e-3 / np.linalg.norm(left, axis=1)[:, None]
        assert inside([mesh], middle + left, device="cpu").all()
        assert not inside([mesh], middle - left, device="cpu").any()


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_surface_of_a_shape_encloses_it(dimension):
    """Surface of a shape that encloses it.

    Triangles face outward, segments have the inside on the left: their integral is the shape's
    volume.
    """
    shapes = [
        Box(lower=[0.1] * dimension, upper=[0.3, 0.5, 0.4][:dimension]),
        Sphere(center=[0.2, 0.4, 0.6][:dimension], radius=0.2),
        Capsule(start=[0.0, 0.1, 0.2][:dimension], end=[0.5, 0.3, 0.1][:dimension], radius=0.1),
    ]
    place = Placement.from_degrees(
        1.3, [40.0] if dimension == 2 else [10.0, 20.0, 30.0], [0.1] * dimension, dimension
    )
    for shape, placement in itertools.product(shapes, (Placement(), place)):
        shape = replace(shape, placement=placement)
        surface = body_surface(shape, dimension)
        corners = surface.points[surface.corners]
        if dimension == 2:
            volume = (
                0.5
                * (corners[:, 0, 0] * corners[:, 1, 1] - corners[:, 0, 1] * corners[:, 1, 0]).sum()
            )
        else:
            volume = (
                np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum()
                / 6.0
            )
        assert volume == pytest.approx(
            mass_properties(shape, dimension, density=1.0).mass, rel=2e-2
        )


@pytest.mark.parametrize(
    ("shape", "given", "says"),
    [
        (Plane(point=[0.0, 0.0], normal=[0.0, 1.0]), {"mass": 1.0}, "no mass"),
        (Sphere(center=[0.0, 0.0], radius=1.0, invert=True), {"mass": 1.0}, "no mass"),
        (Sphere(center=[0.0, 0.0], radius=1.0), {"mass": 1.0, "density": 2.0}, "either"),
        (Sphere(center=[0.0, 0.0], radius=1.0), {}, "either"),
        (Sphere(center=[0.0, 0.0], radius=1.0), {"mass": -1.0}, "positive"),
        (box_mesh([0, 0, 1], [1, 1, 2]), {"mass": 1.0}, "z = 0"),
    ],
)
def test_shapes_without_mass_are_refused(shape, given, says):
    with pytest.raises(ValueError, match=says):
        mass_properties(shape, 2, **given)


@pytest.mark.parametrize(
    "inertia",
    [
        np.diag([1.0, 1.0, -1.0]),
        np.array([[1, 1, 0], [0, 1, 0], [0, 0, 1.0]]),
        np.full((3, 3), np.nan),
    ],
)
def test_an_inertia_must_be_symmetric_positive_definite(inertia):
    with pytest.raises(ValueError, match="inertia"):
        MassProperties(mass=1.0, center=np.zeros(3), inertia=inertia)


def test_a_moved_shape_has_the_turned_inertia():
    shape = Capsule(start=[0.0, 0.0, 0.0], end=[1.0, 0.0, 0.0], radius=0.2)
    pose = Pose.about(np.array([0.5, 0.5, 0.0]), TURNED.rotation, np.array([0.1, 0.2, 0.3]))
    before, after = (mass_properties(s, 3, density=2.0) for s in (shape, shape.moved(pose)))
    np.testing.assert_allclose(after.center, pose.apply(before.center), atol=1e-15)
    np.testing.assert_allclose(
        after.inertia, TURNED.rotation @ before.inertia @ TURNED.rotation.T, atol=1e-14
    )
