"""Signed distances as Warp kernels, one a shape, and the claim of cells by solids.

A shape lives in its own coordinates q, counted from its center or another point of it. A point p of the domain is q = R' (p - t) / s there,
and a distance comes back times s. `sign` is 1, or -1 for an inverted shape.
"""

import typing

import warp as wp

MODULE = "warp_lcp.solids"
FAR = 1.0e10  # a mesh query's reach, in half diagonals of the mesh; its square is still finite in float32


@wp.func
@typing.no_type_check
def to_shape(p: wp.vec3, inverse_rotation: wp.mat33, translation: wp.vec3, scale: float) -> wp.vec3:
    """Return q of a point p."""
    return inverse_rotation * (p - translation) / scale


@wp.kernel(enable_backward=False, module=MODULE)
@typing.no_type_check
def box_distance(
    points: wp.array(dtype=wp.vec3),
    inverse_rotation: wp.mat33,
    translation: wp.vec3,
    scale: float,
    sign: float,
    half: wp.vec3,
    out: wp.array(dtype=wp.float32),
):
    """Measure a box of half extents `half` (infinite in z in 2-D) about the origin."""
    i = wp.tid()
    q = to_shape(points[i], inverse_rotation, translation, scale)
    x = wp.abs(q[0]) - half[0]
    y = wp.abs(q[1]) - half[1]
    z = wp.abs(q[2]) - half[2]
    outside = wp.length(wp.vec3(wp.max(x, 0.0), wp.max(y, 0.0), wp.max(z, 0.0)))
    out[i] = sign * scale * (outside + wp.min(wp.max(x, wp.max(y, z)), 0.0))


@wp.kernel(enable_backward=False, module=MODULE)
@typing.no_type_check
def sphere_distance(
    points: wp.array(dtype=wp.vec3),
    inverse_rotation: wp.mat33,
    translation: wp.vec3,
    scale: float,
    sign: float,
    radius: float,
    out: wp.array(dtype=wp.float32),
):
    """Measure a sphere about the origin."""
    i = wp.tid()
    q = to_shape(points[i], inverse_rotation, translation, scale)
    out[i] = sign * scale * (wp.length(q) - radius)


@wp.kernel(enable_backward=False, module=MODULE)
@typing.no_type_check
def capsule_distance(
    points: wp.array(dtype=wp.vec3),
    inverse_rotation: wp.mat33,
    translation: wp.vec3,
    scale: float,
    sign: float,
    axis: wp.vec3,
    radius: float,
    out: wp.array(dtype=wp.float32),
):
    """Measure all within `radius` of the segment from the origin along `axis`."""
    i = wp.tid()
    q = to_shape(points[i], inverse_rotation, translation, scale)
    along = wp.clamp(wp.dot(q, axis) / wp.dot(axis, axis), 0.0, 1.0)
    out[i] = sign * scale * (wp.length(q - along * axis) - radius)


@wp.kernel(enable_backward=False, module=MODULE)
@typing.no_type_check
def plane_distance(
    points: wp.array(dtype=wp.vec3),
    inverse_rotation: wp.mat33,
    translation: wp.vec3,
    scale: float,
    sign: float,
    normal: wp.vec3,
    out: wp.array(dtype=wp.float32),
):
    """Measure the half-space below the plane through the origin with a unit `normal`."""
    i = wp.tid()
    q = to_shape(points[i], inverse_rotation, translation, scale)
    out[i] = sign * scale * wp.dot(q, normal)


@wp.kernel(enable_backward=False, module=MODULE)
@typing.no_type_check
def mesh_distance(
    points: wp.array(dtype=wp.vec3),
    inverse_rotation: wp.mat33,
    translation: wp.vec3,
    scale: float,
    sign: float,
    mesh: wp.uint64,
    out: wp.array(dtype=wp.float32),
):
    """Measure the inside of a closed mesh: distance to the closest triangle, sign from the winding number."""
    i = wp.tid()
    q = to_shape(points[i], inverse_rotation, translation, scale)
    # 2: groups of triangles farther than twice their radius count as one dipole; a closed surface has whole numbers, so 0.5 has room.
    query = wp.mesh_query_point_sign_winding_number(mesh, q, FAR, 2.0, 0.5)
    distance = FAR
    if query.result:
        distance = wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - q)
    out[i] = sign * scale * query.sign * distance


@wp.kernel(enable_backward=False, module=MODULE)
@typing.no_type_check
def mesh_surface_distance(
    points: wp.array(dtype=wp.vec3),
    inverse_rotation: wp.mat33,
    translation: wp.vec3,
    scale: float,
    mesh: wp.uint64,
    out: wp.array(dtype=wp.float32),
):
    """Measure the distance to the closest triangle, without the sign, which takes most of the time."""
    i = wp.tid()
    q = to_shape(points[i], inverse_rotation, translation, scale)
    query = wp.mesh_query_point_no_sign(mesh, q, FAR)
    distance = FAR
    if query.result:
        distance = wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - q)
    out[i] = scale * distance


@wp.kernel(enable_backward=False, module=MODULE)
@typing.no_type_check
def mesh_thickness(mesh: wp.uint64, reach: float, out: wp.array(dtype=wp.float32)):
    """Measure from each triangle's center straight inward to the other side; `reach` when it is farther or another part begins."""
    face = wp.tid()
    a = wp.mesh_get_point(mesh, 3 * face)
    b = wp.mesh_get_point(mesh, 3 * face + 1)
    c = wp.mesh_get_point(mesh, 3 * face + 2)
    inward = -wp.mesh_eval_face_normal(mesh, face)
    skip = 1.0e-3 * reach  # leaves the triangle itself behind
    query = wp.mesh_query_ray(mesh, (a + b + c) / 3.0 + skip * inward, inward, reach)
    out[face] = reach
    if query.result and wp.dot(query.normal, inward) > 0.0:
        out[face] = query.t + skip


@wp.kernel(enable_backward=False, module=MODULE)
@typing.no_type_check
def cell_centers(
    low_x: int,
    low_y: int,
    low_z: int,
    count_x: int,
    count_y: int,
    origin: wp.vec3i,
    spacing: float,
    flat: bool,
    out: wp.array(dtype=wp.vec3),
):
    """Fill a block of cell centers [m], x fastest; cell 1 of the padded grid begins `origin` cells from 0, `flat` puts them at z = 0."""
    c = wp.tid()
    i = origin[0] + low_x + c % count_x
    j = origin[1] + low_y + (c // count_x) % count_y
    k = origin[2] + low_z + c // (count_x * count_y)
    z = (float(k) - 0.5) * spacing
    if flat:
        z = 0.0
    out[c] = wp.vec3((float(i) - 0.5) * spacing, (float(j) - 0.5) * spacing, z)


@wp.kernel(enable_backward=False, module=MODULE)
@typing.no_type_check
def claim_cells(
    low_x: int,
    low_y: int,
    low_z: int,
    count_x: int,
    count_y: int,
    distance: wp.array(dtype=wp.float32),
    solid: int,
    index: wp.array3d(dtype=wp.int32),
    covered: wp.array(dtype=wp.int32),
):
    """Give the open cells of a block whose center lies inside to `solid`, and count those that lie inside, claimed or not."""
    c = wp.tid()
    if distance[c] < 0.0:
        i = low_x + c % count_x
        j = low_y + (c // count_x) % count_y
        k = low_z + c // (count_x * count_y)
        if index[k, j, i] < 0:
            index[k, j, i] = solid
        wp.atomic_add(covered, solid, 1)
