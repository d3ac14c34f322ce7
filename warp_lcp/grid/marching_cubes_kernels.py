# mypy: ignore-errors
"""Kernels of marching cubes: one thread a row of cells, which knows from a scan where its points and triangles go.

A point belongs to the node at the low end of its edge; a node's points are numbered x, y, z from the number that the node keeps.
"""

import warp as wp

from warp_lcp.grid.cell_kernel import F32, cell_kernel
from warp_lcp.native import BLOCK, simd

CLOSEST = 0.01  # of an edge: how near to its end a point may come, so that no triangle shrinks to nothing

# The cases of the cells of a block, and whether any of them has a surface; `visit` gets each that has one. In 2-D the nodes above are
# those below: no edge along z is cut.
CASES = """
    const long long s2 = phi_.shape[2], s1 = s2*phi_.shape[1], at = k*s1 + j*s2, up = planes == 2 ? s1 : 0;
    auto each = [&](auto visit) {
        unsigned char cases[M];
        for (int start = first; start < last; start += M) {
            const int n = last - start < M ? last - start : (int)M;
            const float* a = phi_.data + at + start; const float* b = a + s2; const float* c = a + up; const float* d = b + up;
            unsigned char any = 0;
            SIMD for (int m = 0; m < n; ++m) {
                const unsigned char code = (unsigned char)((a[m] < 0) | (a[m + 1] < 0) << 1 | (b[m] < 0) << 2 | (b[m + 1] < 0) << 3
                    | (c[m] < 0) << 4 | (c[m + 1] < 0) << 5 | (d[m] < 0) << 6 | (d[m + 1] < 0) << 7);
                cases[m] = code;
                any |= (unsigned char)((code != 0) & (code != 255));
            }
            if (!any) continue;
            for (int m = 0; m < n; ++m) if (cases[m] != 0 && cases[m] != 255) visit(start + m, (int)cases[m]);
        }
    };
    const long long wide = planes == 2 ? 16 : 5;
    const int mask = planes == 2 ? 255 : 15;
"""

COUNT = """
    int points = 0, elements = 0;
    each([&](int i, int code) {
        const int here = code & 1;
        points += (here ^ (code >> 1 & 1)) + (here ^ (code >> 2 & 1)) + (here ^ (code >> 4 & 1));
        elements += ((const signed char*)table_.data)[(code & mask)*wide];
    });
    points_.data[k_row*points_.shape[1] + j_row] = points;
    elements_.data[k_row*points_.shape[1] + j_row] = elements;
"""

# Edges along a side of the domain, half a cell from it, count as if they were on it: the surface meets a wall on the wall, in a sharp edge.
# What closes it there, the points between the nodes beside a side and the ring, lies on the side too, just off the sides' common edges.
POINT = """
    float* out = (float*)out_.data;
    int next = ends_.data[k_row*ends_.shape[1] + j_row] - counts_.data[k_row*ends_.shape[1] + j_row];
    const int most[3] = {(int)phi_.shape[2] - 2, (int)phi_.shape[1] - 2, (int)phi_.shape[0] - 2};
    auto place = [&](int axis, int c, float inset) {
        const int n = most[axis];
        if (n == 1 || (c > 1 && c < n)) return (float)c - 0.5f;
        return c <= 1 ? inset : (float)n - inset;
    };
    each([&](int i, int code) {
        const int here = code & 1;
        const int cut[3] = {here ^ (code >> 1 & 1), here ^ (code >> 2 & 1), here ^ (code >> 4 & 1)}, at_node[3] = {i, j, k};
        const long long step[3] = {1, s2, up}, node = at + i;
        number_.data[node] = next;
        for (int axis = 0; axis < 3; ++axis) {
            if (!cut[axis]) continue;
            const int c = at_node[axis], n = most[axis];
            const bool side = c == 0 || c == n;
            const float a = phi_.data[node], b = phi_.data[node + step[axis]];
            float t = a/(a - b), x[3];
            t = t > (float)CLOSEST ? (t < (float)(1 - CLOSEST) ? t : (float)(1 - CLOSEST)) : (float)CLOSEST;
            for (int d = 0; d < 3; ++d) x[d] = place(d, at_node[d], side ? (float)CLOSEST : 0.0f);
            x[axis] = side ? (c == 0 ? 0.0f : (float)n) : (float)c - 0.5f + t;
            for (int d = 0; d < 3; ++d) out[3*next + d] = d == 2 && planes == 1 ? 0.0f : dx*x[d];
            ++next;
        }
    });
"""

CORNER = """
    const int size = planes + 1;
    int* out = out_.data;
    long long next = (long long)size*(ends_.data[k_row*ends_.shape[1] + j_row] - counts_.data[k_row*ends_.shape[1] + j_row]);
    each([&](int i, int code) {
        const signed char* row = (const signed char*)table_.data + (code & mask)*wide;
        for (int n = 0; n < size*row[0]; ++n) {
            const int edge = row[1 + n], axis = edge/4, b = edge%4;
            // the low end of the edge: b's two bits are the other two axes, the lower first
            const int x = axis == 0 ? 0 : b & 1, y = axis == 0 ? b & 1 : (axis == 1 ? 0 : b >> 1), z = axis == 2 ? 0 : b >> 1;
            const long long node = at + i + x + y*s2 + z*up;
            const float* phi = phi_.data + node;
            const bool here = phi[0] < 0;
            out[next++] = number_.data[node] + (axis > 0 && here != (phi[1] < 0)) + (axis > 1 && here != (phi[s2] < 0));
        }
    });
"""

_I32, _I8 = wp.array2d(dtype=wp.int32), wp.array2d(dtype=wp.int8)


def _filled(source: str) -> str:
    return simd(BLOCK + CASES + source.replace("CLOSEST", repr(CLOSEST)))


@wp.func_native(_filled(COUNT))
def count_row(
    planes: int, phi_: F32, table_: _I8, points_: _I32, elements_: _I32, k_row: int, j_row: int, k: int, j: int, first: int, last: int
): ...


@wp.func_native(_filled(POINT))
def point_row(
    planes: int, dx: float, phi_: F32, counts_: _I32, ends_: _I32, number_: wp.array3d(dtype=wp.int32), out_: wp.array(dtype=wp.vec3),
    k_row: int, j_row: int, k: int, j: int, first: int, last: int,
): ...  # fmt: skip


@wp.func_native(_filled(CORNER))
def corner_row(
    planes: int, phi_: F32, table_: _I8, counts_: _I32, ends_: _I32, number_: wp.array3d(dtype=wp.int32), out_: _I32,
    k_row: int, j_row: int, k: int, j: int, first: int, last: int,
): ...  # fmt: skip


@cell_kernel("warp_lcp.grid.marching_cubes")
def count_kernel(plane, row, k, j, first, end, planes: int, phi: F32, table: _I8, points: _I32, elements: _I32):
    """Count the points that a row's nodes own and the triangles of its cells."""
    count_row(planes, phi, table, points, elements, plane, row, k, j, first, end)


@cell_kernel("warp_lcp.grid.marching_cubes")
def point_kernel(
    plane, row, k, j, first, end, planes: int, dx: float, phi: F32, counts: _I32, ends: _I32, number: wp.array3d(dtype=wp.int32),
    out: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """Place the points of a row's nodes, and number the nodes that have any."""
    point_row(planes, dx, phi, counts, ends, number, out, plane, row, k, j, first, end)


@cell_kernel("warp_lcp.grid.marching_cubes")
def corner_kernel(
    plane,
    row,
    k,
    j,
    first,
    end,
    planes: int,
    phi: F32,
    table: _I8,
    counts: _I32,
    ends: _I32,
    number: wp.array3d(dtype=wp.int32),
    out: _I32,
):
    """Write the triangles of a row's cells."""
    corner_row(planes, phi, table, counts, ends, number, out, plane, row, k, j, first, end)
