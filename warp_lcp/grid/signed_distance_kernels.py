# mypy: ignore-errors
"""Kernels of signed distances, one a shape, of sample points and of solid cells."""

from collections.abc import Sequence

import numpy as np
import warp as wp

from warp_lcp.grid.cell_kernel import list_kernel
from warp_lcp.kernels.compiler import forward_kernel

MODULE = "warp_lcp.solids"
Points, Distances = wp.array(dtype=wp.vec3), wp.array(dtype=wp.float32)
# Reach of a mesh query, in half diagonals of the mesh; its square is still finite in float32.
FAR = 1.0e10


@wp.struct
class ShapeFrame:
    """Placement of a shape: q = R' (p - t) / s are its coordinates of a point p.

    They are counted from the shape's center, or from another point of it.
    """

    inverse_rotation: wp.mat33
    translation: wp.vec3
    scale: float  # factor on distances
    sign: float  # -1: the shape is inverted


@wp.func
def to_shape(p: wp.vec3, frame: ShapeFrame) -> wp.vec3:
    """Return the shape's coordinates q of a point p."""
    return frame.inverse_rotation * (p - frame.translation) / frame.scale


@wp.func
def to_box(p: wp.vec3, frame: ShapeFrame, half: wp.vec3) -> float:
    """Return the distance of a box about the origin.

    `half` are its half extents, infinite in z in 2-D.
    """
    q = to_shape(p, frame)
    x = wp.abs(q[0]) - half[0]
    y = wp.abs(q[1]) - half[1]
    z = wp.abs(q[2]) - half[2]
    outside = wp.length(wp.vec3(wp.max(x, 0.0), wp.max(y, 0.0), wp.max(z, 0.0)))
    return frame.sign * frame.scale * (outside + wp.min(wp.max(x, wp.max(y, z)), 0.0))


@wp.func
def to_sphere(p: wp.vec3, frame: ShapeFrame, radius: float) -> float:
    """Return the distance of a sphere about the origin."""
    return frame.sign * frame.scale * (wp.length(to_shape(p, frame)) - radius)


@wp.func
def to_capsule(p: wp.vec3, frame: ShapeFrame, axis: wp.vec3, radius: float) -> float:
    """Return the distance of a capsule: points within `radius` of a segment.

    The segment goes from the origin along `axis`.
    """
    q = to_shape(p, frame)
    along = wp.clamp(wp.dot(q, axis) / wp.dot(axis, axis), 0.0, 1.0)
    return frame.sign * frame.scale * (wp.length(q - along * axis) - radius)


@wp.func
def to_plane(p: wp.vec3, frame: ShapeFrame, normal: wp.vec3) -> float:
    """Return the distance of the half-space below the plane through the origin.

    `normal` is the plane's unit normal.
    """
    return frame.sign * frame.scale * wp.dot(to_shape(p, frame), normal)


@wp.func
def to_mesh(p: wp.vec3, frame: ShapeFrame, mesh: wp.uint64) -> float:
    """Return the signed distance of a closed mesh.

    The size is the distance to the closest triangle; the sign comes from the winding number.
    """
    q = to_shape(p, frame)
    # 2: groups of triangles farther than twice their radius count as one dipole. A closed surface
    # has whole winding numbers, so the threshold 0.5 leaves room.
    query = wp.mesh_query_point_sign_winding_number(mesh, q, FAR, 2.0, 0.5)
    distance = FAR
    if query.result:
        distance = wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - q)
    return frame.sign * frame.scale * query.sign * distance


@wp.func
def to_mesh_surface(p: wp.vec3, frame: ShapeFrame, mesh: wp.uint64) -> float:
    """Return the distance to the closest triangle, without sign.

    The sign takes most of the time.
    """
    q = to_shape(p, frame)
    query = wp.mesh_query_point_no_sign(mesh, q, FAR)
    distance = FAR
    if query.result:
        distance = wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - q)
    return frame.scale * distance


@list_kernel(MODULE)
def box_distance(i, points: Points, frame: ShapeFrame, half: wp.vec3, out: Distances):
    """Measure a box."""
    out[i] = to_box(points[i], frame, half)


@list_kernel(MODULE)
def sphere_distance(i, points: Points, frame: ShapeFrame, radius: float, out: Distances):
    """Measure a sphere."""
    out[i] = to_sphere(points[i], frame, radius)


@list_kernel(MODULE)
def capsule_distance(
    i, points: Points, frame: ShapeFrame, axis: wp.vec3, radius: float, out: Distances
):
    """Measure a capsule."""
    out[i] = to_capsule(points[i], frame, axis, radius)


@list_kernel(MODULE)
def least_distance(i, other: Distances, out: Distances):
    """Write the distance of the union of two regions."""
    out[i] = wp.min(out[i], other[i])


@list_kernel(MODULE)
def plane_distance(i, points: Points, frame: ShapeFrame, normal: wp.vec3, out: Distances):
    """Measure a half-space."""
    out[i] = to_plane(points[i], frame, normal)


@list_kernel(MODULE)
def mesh_distance(i, points: Points, frame: ShapeFrame, mesh: wp.uint64, out: Distances):
    """Measure the inside of a closed mesh.

    The size is the distance to the closest triangle; the sign comes from the winding number.
    """
    out[i] = to_mesh(points[i], frame, mesh)


@list_kernel(MODULE)
def mesh_surface_distance(i, points: Points, frame: ShapeFrame, mesh: wp.uint64, out: Distances):
    """Measure the distance to the closest triangle, without sign.

    The sign takes most of the time.
    """
    out[i] = to_mesh_surface(points[i], frame, mesh)


@forward_kernel(module=MODULE)
def mesh_thickness(mesh: wp.uint64, reach: float, out: wp.array(dtype=wp.float32)):
    """Measure the thickness of a mesh from each triangle's center straight inward.

    It is `reach` if the other side is farther, or if another part begins before it.
    """
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


@wp.struct
class StridedBox:
    """Box of nodes or cells as kernels see it, x fastest.

    Each item stands for `stride` nodes along every axis.
    """

    low: wp.vec3i
    high: wp.vec3i  # one past the last
    counts: wp.vec3i  # numbers of items
    origin: wp.vec3i  # cells of a larger grid before the first
    stride: int
    flat: bool  # 2-D: z does not count
    spacing: float  # [m]
    offset: float  # offset of an item's point from its low node, in cells


@wp.func
def first_node(block: StridedBox, item: int):
    """Return the low node (x, y, z) of an item of a block."""
    across = block.counts[0]
    i = item % across
    j = (item // across) % block.counts[1]
    k = item // (across * block.counts[1])
    return block.low + block.stride * wp.vec3i(i, j, k)


@wp.func
def node_position(block: StridedBox, node: wp.vec3i, offset: float):
    """Return the position [m] of a node, moved by `offset` cells along each axis.

    2-D has z = 0.
    """
    z = (float(block.origin[2] + node[2] - 1) + offset) * block.spacing
    if block.flat:
        z = 0.0
    x = (float(block.origin[0] + node[0] - 1) + offset) * block.spacing
    return wp.vec3(x, (float(block.origin[1] + node[1] - 1) + offset) * block.spacing, z)


@forward_kernel(module=MODULE)
def item_points(block: StridedBox, out: Points):
    """Fill the positions [m] of the items of a block.

    Items are nodes, the middles of groups of nodes, or the centers of cells.
    """
    c = wp.tid()
    out[c] = node_position(block, first_node(block, c), block.offset)


@forward_kernel(module=MODULE)
def claim_cells(
    block: StridedBox,
    distance: Distances,
    solid: int,
    index: wp.array3d(dtype=wp.int32),
    covered: wp.array(dtype=wp.int32),
):
    """Assign the open cells of a block whose center lies inside to `solid`.

    Count the cells with their center inside, claimed or not.
    """
    c = wp.tid()
    if distance[c] < 0.0:
        at = first_node(block, c)
        if index[at[2], at[1], at[0]] < 0:
            index[at[2], at[1], at[0]] = solid
        wp.atomic_add(covered, solid, 1)


def block_of(
    low: Sequence[int] | np.ndarray,
    high: Sequence[int] | np.ndarray,
    spacing: float,
    dimension: int,
    origin: Sequence[int],
    *,
    stride: int = 1,
    offset: float = 0.0,
) -> StridedBox:
    """Return the block of nodes or cells low <= (x, y, z) < high.

    Items are groups of `stride` nodes along each axis; their points are moved by `offset` cells.
    """
    block = StridedBox()
    block.low, block.high = wp.vec3i(*(int(v) for v in low)), wp.vec3i(*(int(v) for v in high))
    block.counts = wp.vec3i(*(-(-int(b - a) // stride) for a, b in zip(low, high, strict=True)))
    block.stride, block.flat, block.spacing, block.origin, block.offset = (
        stride,
        dimension == 2,
        spacing,
        wp.vec3i(*origin),
        offset,
    )
    return block
