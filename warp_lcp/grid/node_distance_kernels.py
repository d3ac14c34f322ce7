# mypy: ignore-errors
"""Kernels of solids' distances at nodes, and of flat cells.

A flat cell has distance 0 at all corners; only its center shows whether it is open.
"""

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I8, I16, cell_kernel
from warp_lcp.grid.signed_distance_kernels import (
    Distances,
    Points,
    ShapeFrame,
    StridedBox,
    first_node,
    node_position,
    to_box,
    to_capsule,
    to_plane,
    to_sphere,
)
from warp_lcp.kernels.compiler import forward_kernel

FAR = 4.0  # cells: smaller distances are exact, others at least this large
COARSE = 3  # nodes along an axis of a group that is bounded by one distance
ROUNDING = 1.0e-3  # cells: distances below this have no reliable sign
# Mark of cells with distance 0 at all corners whose center is open: gaps of one cell.
HOLLOW = 1

BOX, SPHERE, CAPSULE, PLANE = range(4)  # kinds of a PlacedShape

NodeList = wp.array(dtype=wp.vec4i)
options = {"module": "warp_lcp.grid.node_distance"}


@wp.struct
class NearestSolids:
    """The two nearest solids of each node.

    See `warp_lcp.grid.node_distance.NodeDistances`.
    """

    near: F32
    owner: I16
    next_near: F32
    next_owner: I16


@wp.struct
class PlacedShape:
    """A shape of a solid at its current place."""

    frame: ShapeFrame
    kind: int  # BOX, SPHERE, CAPSULE or PLANE
    way: wp.vec3  # half extents of a box, axis of a capsule, normal of a plane
    radius: float


@wp.struct
class ShapeGroup:
    """The shapes of a solid, and the box of nodes around it."""

    number: int
    first: int  # first of its shapes
    end: int  # one past the last
    low: wp.vec3i  # first node (x, y, z)
    high: wp.vec3i  # one past the last


@wp.func
def shape_distance(p: wp.vec3, shape: PlacedShape) -> float:
    """Return the distance of a shape [m]."""
    d = float(0.0)
    if shape.kind == BOX:
        d = to_box(p, shape.frame, shape.way)
    elif shape.kind == SPHERE:
        d = to_sphere(p, shape.frame, shape.radius)
    elif shape.kind == CAPSULE:
        d = to_capsule(p, shape.frame, shape.way, shape.radius)
    else:
        d = to_plane(p, shape.frame, shape.way)
    return d


@wp.func
def enter(node: wp.vec3i, d: float, solid: int, nodes: NearestSolids):
    """Enter a solid's distance d [cells] among the two nearest of a node.

    Of solids equally near the first one stays.
    """
    k = node[2]
    j = node[1]
    i = node[0]
    if d < nodes.near[k, j, i]:
        nodes.next_near[k, j, i] = nodes.near[k, j, i]
        nodes.next_owner[k, j, i] = nodes.owner[k, j, i]
        nodes.near[k, j, i] = d
        nodes.owner[k, j, i] = wp.int16(solid)
    elif d < nodes.next_near[k, j, i]:
        nodes.next_near[k, j, i] = d
        nodes.next_owner[k, j, i] = wp.int16(solid)


@wp.func
def snapped(meters: float, spacing: float, snap: float):
    """Return a distance in cells, 0 within `snap` of 0.

    Walls on faces so stay there.
    """
    d = meters / spacing
    if wp.abs(d) < snap:
        d = 0.0
    return d


@forward_kernel(**options)
def claim_nodes(
    block: StridedBox, distance: Distances, snap: float, solid: int, nodes: NearestSolids
):
    """Enter the distances [m] of a solid at a block of nodes."""
    c = wp.tid()
    enter(first_node(block, c), snapped(distance[c], block.spacing, snap), solid, nodes)


@cell_kernel("warp_lcp.grid.node_distance")
def enter_solids(
    k,
    j,
    first,
    end,
    block: StridedBox,
    solids: wp.array(dtype=ShapeGroup),
    shapes: wp.array(dtype=PlacedShape),
    snap: float,
    nodes: NearestSolids,
):
    """Enter the distances of several solids, in sequence, at a row of nodes."""
    for s in range(solids.shape[0]):
        solid = solids[s]
        if k >= solid.low[2] and k < solid.high[2] and j >= solid.low[1] and j < solid.high[1]:
            for i in range(wp.max(first, solid.low[0]), wp.min(end, solid.high[0])):
                node = wp.vec3i(i, j, k)
                p = node_position(block, node, block.offset)
                d = shape_distance(p, shapes[solid.first])
                for part in range(solid.first + 1, solid.end):
                    d = wp.min(d, shape_distance(p, shapes[part]))
                enter(node, snapped(d, block.spacing, snap), solid.number, nodes)


@forward_kernel(**options)
def claim_groups(
    block: StridedBox,
    distance: Distances,
    solid: int,
    nodes: NearestSolids,
    unsure: NodeList,
    sure: NodeList,
    listed: wp.array(dtype=wp.int32),
):
    """Bound the distances of groups of nodes by the distance of their middles.

    Nodes that may be nearer than FAR are listed. A node that is nearer to the middle than the
    surface is lies on the same side: its sign is sure.

    In cells, with the distance d_m at the middle x_m of a group: |d| >= |d_m| - |x - x_m|. A bound
    of FAR or more is entered with the sign of d_m. The sign of a node is sure where the bound
    exceeds ROUNDING.
    """
    c = wp.tid()
    low = first_node(block, c)
    high = wp.min(low + wp.vec3i(block.stride), block.high)
    center = distance[c] / block.spacing
    middle = block.offset
    for k in range(low[2], high[2]):
        for j in range(low[1], high[1]):
            for i in range(low[0], high[0]):
                x = float(i - low[0]) - middle
                y = float(j - low[1]) - middle
                z = float(k - low[2]) - middle
                if block.flat:
                    z = 0.0
                d = wp.abs(center) - wp.length(wp.vec3(x, y, z))
                if d >= FAR:
                    enter(wp.vec3i(i, j, k), wp.sign(center) * d, solid, nodes)
                elif d > ROUNDING:
                    sure[wp.atomic_add(listed, 1, 1)] = wp.vec4i(i, j, k, int(wp.sign(center)))
                else:
                    unsure[wp.atomic_add(listed, 0, 1)] = wp.vec4i(i, j, k, 0)


@forward_kernel(**options)
def listed_points(block: StridedBox, list: NodeList, out: Points):
    """Fill the places [m] of listed nodes, or cell centers by the block's offset."""
    c = wp.tid()
    out[c] = node_position(block, wp.vec3i(list[c][0], list[c][1], list[c][2]), block.offset)


@forward_kernel(**options)
def claim_listed(
    block: StridedBox,
    list: NodeList,
    distance: Distances,
    snap: float,
    solid: int,
    nodes: NearestSolids,
):
    """Enter the distances [m] of a solid at listed nodes.

    Where the list has a sign, the distance gets that sign.
    """
    c = wp.tid()
    node = list[c]
    d = snapped(distance[c], block.spacing, snap)
    if node[3] < 0:
        d = -d
    enter(wp.vec3i(node[0], node[1], node[2]), d, solid, nodes)


@cell_kernel("warp_lcp.grid.node_distance", ordered=True)
def find_flat_cells(
    k, j, i, planes: int, near: F32, list: NodeList, count: wp.array(dtype=wp.int32)
):
    """List the cells with distance 0 at all corners.

    Each is a gap or a plate, one cell wide; only its center shows which.
    """
    if near[k, j, i] == 0.0:
        most = wp.abs(near[k, j, i + 1]) + wp.abs(near[k, j + 1, i]) + wp.abs(near[k, j + 1, i + 1])
        if planes == 2:
            most = most + wp.abs(near[k + 1, j, i]) + wp.abs(near[k + 1, j, i + 1])
            most = most + wp.abs(near[k + 1, j + 1, i]) + wp.abs(near[k + 1, j + 1, i + 1])
        if most == 0.0:
            slot = wp.atomic_add(count, 0, 1)
            if slot < list.shape[0]:
                list[slot] = wp.vec4i(i, j, k, 0)


@forward_kernel(**options)
def mark_listed(list: NodeList, distance: Distances, begin: bool, marks: I8):
    """Mark the listed cells HOLLOW whose center no solid so far covers."""
    c = wp.tid()
    i = list[c][0]
    j = list[c][1]
    k = list[c][2]
    if begin:
        marks[k, j, i] = wp.int8(HOLLOW)
    if distance[c] <= 0.0:
        marks[k, j, i] = wp.int8(0)
