import dataclasses

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from grid_fields import distances
from warp_lcp.grid.motion import Pose
from warp_lcp.grid.signed_distance import (
    Box,
    Capsule,
    Geometry,
    Placement,
    Plane,
    Sphere,
    TriangleMesh,
    Union,
)
from warp_lcp.grid.triangle_mesh import builtin_mesh

PLACEMENT = Placement.from_degrees(1.7, [25.0, -70.0, 130.0], [0.3, -0.4, 0.9], 3)


def box_oracle(points, lower, upper):
    """Return the distance to the nearest point of the box outside, or face inside."""
    to_faces = np.concatenate([points - lower, upper - points], axis=1)
    outside = np.linalg.norm(points - np.clip(points, lower, upper), axis=1)
    return np.where((to_faces > 0).all(axis=1), -to_faces.min(axis=1), outside)


def capsule_oracle(points, start, end, radius):
    """Return the distance to the nearer end, or the perpendicular.

    The perpendicular counts where its foot lies between the segment's ends.
    """
    length = np.linalg.norm(end - start)
    unit = (end - start) / length
    along = (points - start) @ unit
    ends = np.minimum(np.linalg.norm(points - start, axis=1), np.linalg.norm(points - end, axis=1))
    across = np.linalg.norm(np.cross(points - start, unit), axis=1)
    return np.where((along > 0) & (along < length), across, ends) - radius


def own_coordinates(points, placement):
    """Undo a placement with a 4 x 4 matrix solve."""
    matrix = np.eye(4)
    matrix[:3, :3] = placement.scale * placement.rotation
    matrix[:3, 3] = placement.translation
    return np.linalg.solve(matrix, np.column_stack([points, np.ones(len(points))]).T)[:3].T


LOWER, UPPER = np.array([-0.5, 0.1, -0.2]), np.array([0.4, 0.5, 0.9])
START, END = np.array([-0.3, 0.2, 0.1]), np.array([0.5, -0.1, 0.4])
POINT, NORMAL = np.array([0.1, 0.2, -0.3]), np.array([1.0, 2.0, -2.0])
CASES = {
    "box": (Box(lower=LOWER, upper=UPPER), lambda q: box_oracle(q, LOWER, UPPER)),
    "sphere": (Sphere(center=POINT, radius=0.6), lambda q: np.linalg.norm(q - POINT, axis=1) - 0.6),
    "capsule": (
        Capsule(start=START, end=END, radius=0.25),
        lambda q: capsule_oracle(q, START, END, 0.25),
    ),
    "plane": (Plane(point=POINT, normal=NORMAL), lambda q: (q - POINT) @ (NORMAL / 3.0)),
}


@pytest.mark.every_case
@pytest.mark.parametrize("invert", [False, True])
@pytest.mark.parametrize("placement", [Placement(), PLACEMENT], ids=["in place", "placed"])
@pytest.mark.parametrize("shape", CASES)
def test_distance_is_euclidean(shape, placement, invert):
    geometry, oracle = CASES[shape]
    geometry = dataclasses.replace(geometry, placement=placement, invert=invert)
    points = np.random.default_rng(8273).uniform(-3.0, 3.0, (2000, 3))
    expected = placement.scale * oracle(own_coordinates(points, placement))
    np.testing.assert_allclose(
        distances(geometry, points), -expected if invert else expected, atol=3e-6
    )
    assert isinstance(geometry, Geometry)


@pytest.mark.cuda
@pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device")
@pytest.mark.parametrize("shape", [*CASES, "mesh"])
def test_cuda_agrees_with_cpu(shape):
    geometry = (
        TriangleMesh(surface=builtin_mesh("knot"), placement=PLACEMENT)
        if shape == "mesh"
        else CASES[shape][0]
    )
    points = np.random.default_rng(8274).uniform(-2.0, 2.0, (2000, 3))
    np.testing.assert_allclose(
        distances(geometry, points, "cuda:0"), distances(geometry, points), atol=1e-5
    )


def test_plane_order():
    floor = Plane(point=[0.0, 0.5], normal=[0.0, 3.0])
    np.testing.assert_allclose(
        distances(floor, np.array([[4.0, 0.2, 0.0], [4.0, 1.5, 0.0]])), [-0.3, 1.0], atol=1e-6
    )


@pytest.mark.parametrize("angle", [0.0, 37.0, 90.0, 180.0, -90.0])
def test_flat_shapes(angle):
    placement = Placement.from_degrees(0.8, angle, [0.4, -0.2], 2)
    points = np.random.default_rng(551).uniform(-2.0, 2.0, (1500, 3))
    points[:, 2] = 0.0
    q = own_coordinates(points, placement)
    lower, upper = np.array([-0.5, 0.1]), np.array([0.7, 0.3])
    box = Box(lower=lower, upper=upper, placement=placement)
    np.testing.assert_allclose(
        distances(box, points), 0.8 * box_oracle(q[:, :2], lower, upper), atol=3e-6
    )
    disc = Sphere(center=[0.2, 0.1], radius=0.5, placement=placement)
    np.testing.assert_allclose(
        distances(disc, points), 0.8 * (np.hypot(q[:, 0] - 0.2, q[:, 1] - 0.1) - 0.5), atol=3e-6
    )
    stadium = Capsule(start=[0.0, 0.1], end=[0.3, 0.6], radius=0.2, placement=placement)
    expected = 0.8 * capsule_oracle(q, np.array([0.0, 0.1, 0.0]), np.array([0.3, 0.6, 0.0]), 0.2)
    np.testing.assert_allclose(distances(stadium, points), expected, atol=3e-6)


def test_rotations_follow_x_then_y_then_z():
    rotation = Placement.from_degrees(1.0, [90.0, 90.0, 0.0], [0.0, 0.0, 0.0], 3).rotation
    # About x to z, about y to x.
    np.testing.assert_array_equal(rotation @ [0.0, 1.0, 0.0], [1.0, 0.0, 0.0])
    turned = Placement.from_degrees(1.0, 30.0, [0.0, 0.0], 2).rotation
    np.testing.assert_allclose(turned @ [1.0, 0.0, 0.0], [np.sqrt(0.75), 0.5, 0.0], atol=1e-15)


@given(
    scale=st.floats(0.01, 100.0),
    rotate=st.tuples(*[st.floats(-720.0, 720.0)] * 3),
    translate=st.tuples(*[st.floats(-5.0, 5.0)] * 3),
    shape=st.sampled_from(["box", "sphere", "capsule"]),
)
@settings(max_examples=40, deadline=None, derandomize=True)
def test_bounds_contain_the_shape(scale, rotate, translate, shape):
    placement = Placement.from_degrees(scale, rotate, translate, 3)
    geometry = dataclasses.replace(CASES[shape][0], placement=placement)
    low, high = geometry.bounds()
    points = np.random.default_rng(9917).uniform(
        low - 0.3 * (high - low), high + 0.3 * (high - low), (400, 3)
    )
    contained = distances(geometry, points) < 0.0
    outside = ((points < low - 1e-4 * scale) | (points > high + 1e-4 * scale)).any(axis=1)
    assert not (contained & outside).any()
    assert dataclasses.replace(geometry, invert=True).bounds() is None


def test_bounds_are_tight():
    np.testing.assert_allclose(
        Sphere(center=[1.0, 2.0], radius=0.5).bounds(), [[0.5, 1.5, -0.5], [1.5, 2.5, 0.5]]
    )
    flat = Box(
        lower=[0.0, 0.0],
        upper=[1.0, 2.0],
        placement=Placement.from_degrees(2.0, 90.0, [0.0, 0.0], 2),
    ).bounds()
    np.testing.assert_allclose(flat, [[-4.0, 0.0, -np.inf], [0.0, 2.0, np.inf]], atol=1e-15)
    assert Plane(point=[0.0, 0.0], normal=[0.0, 1.0]).bounds() is None


def test_placement_keeps_its_arrays():
    rotation = np.eye(3)
    placement = Placement(rotation=rotation)
    rotation[0, 0] = -1.0
    assert placement.rotation[0, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        placement.translation[0] = 1.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Box(lower=[0.0, 0.0], upper=[1.0, 0.0]), "min must be less than its max"),
        (lambda: Box(lower=[0.0, 0.0], upper=[1.0, 1.0, 1.0]), "min has 2 numbers and its max 3"),
        (lambda: Box(lower=[0.0, np.nan], upper=[1.0, 1.0]), "min must be finite"),
        (lambda: Box(lower=[0.0], upper=[1.0]), "min needs 2 or 3 numbers, not 1"),
        (
            lambda: Sphere(center=[0.0, 0.0], radius=0.0),
            "radius = 0.0: must be a finite number > 0",
        ),
        (lambda: Sphere(center=[0.0, np.inf], radius=1.0), "center must be finite"),
        (lambda: Capsule(start=[0.0, 0.0], end=[0.0, 0.0], radius=1.0), "ends coincide"),
        (
            lambda: Capsule(start=[0.0, 0.0], end=[1.0, 0.0, 0.0], radius=1.0),
            "from has 2 numbers and its to 3",
        ),
        (
            lambda: Capsule(start=[0.0, 0.0], end=[1.0, 0.0], radius=np.nan),
            r"radius = \S+: must be a finite number > 0",
        ),
        (lambda: Plane(point=[0.0, 0.0], normal=[0.0, 0.0]), "normal must not be zero"),
        (
            lambda: Plane(point=[0.0, 0.0], normal=[0.0, 0.0, 1.0]),
            "point has 2 numbers and its normal 3",
        ),
        (lambda: Placement(scale=-1.0), r"scale = \S+: must be a finite number > 0"),
        (lambda: Placement(rotation=np.diag([1.0, 1.0, -1.0])), "proper rotation"),
        (lambda: Placement(rotation=np.full((3, 3), np.nan)), "proper rotation"),
        (lambda: Placement(rotation=np.eye(2)), "3 x 3"),
        (lambda: Placement(translation=[0.0, 0.0]), "translation must be 3 finite numbers"),
        (
            lambda: Placement.from_degrees(1.0, [1.0, 2.0], [0.0, 0.0, 0.0], 3),
            "three finite angles",
        ),
        (lambda: Placement.from_degrees(1.0, [1.0, 2.0, 3.0], [0.0, 0.0], 2), "one finite angle"),
        (lambda: Placement.from_degrees(1.0, 0.0, [0.0, 0.0, 0.0], 2), "translate needs 2 numbers"),
        (lambda: Placement.from_degrees(1.0, 0.0, [0.0], 1), "dimension must be 2 or 3"),
    ],
)
def test_bad_values_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_arrays_of_different_length_are_refused():
    points, out = (
        wp.zeros(3, dtype=wp.vec3, device="cpu"),
        wp.zeros(2, dtype=wp.float32, device="cpu"),
    )
    with pytest.raises(ValueError, match="out has shape"):
        Sphere(center=[0.0, 0.0], radius=1.0).signed_distance(points, out)


def test_a_union_is_nearest_to_its_nearest_part():
    parts = (
        Sphere(center=[0.2, 0.3, 0.4], radius=0.2),
        Box(lower=[0.3, 0.3, 0.3], upper=[0.9, 0.5, 0.6]),
        Sphere(center=[0.8] * 3, radius=0.1),
    )
    turned = Pose(
        Placement.from_degrees(1.0, [20.0, 30.0, 40.0], [0.0] * 3, 3).rotation,
        np.array([0.1, 0.0, -0.2]),
    )
    points = np.random.default_rng(77).uniform(-0.5, 1.5, (200, 3))
    for union in (Union(parts=parts), Union(parts=parts).moved(turned)):
        expected = np.min([distances(part, points) for part in union.parts], axis=0)
        assert (distances(union, points) == expected).all()
        low, high = union.bounds()
        inside = expected < 0.0
        assert inside.any()
        assert ((points[inside] >= low) & (points[inside] <= high)).all()
    assert Union(parts=(*parts, Plane(point=[0.0] * 3, normal=[0.0, 0.0, 1.0]))).bounds() is None
