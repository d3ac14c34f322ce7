# mypy: ignore-errors
"""Kernels of the transfers. `scatter` and `gather_weights` are two forms of one sum, `interpolate` is its adjoint.

Node (k, j, i) of component `axis` lies at the grid coordinates (i, j + 1/2, k + 1/2) with the axis' own 1/2 left out, plus the origin of a
part of a grid. In 2-D the nodes
of one plane are used: the coordinate along z is that of the plane, and the plane above is the same one.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.grid.cell_kernel import cell_kernel
from warp_lcp.grid.particle_loops import particle_loop
from warp_lcp.native import BLOCK, C_TYPES

TINY_WEIGHT = 1e-9  # below it a face counts as untouched
# A particle that lies exactly on the boundary between cells would leave one face of its own cell without weight, hence without gravity.
EDGE = {wp.float32: 1e-5, wp.float64: 1e-12}
VECTORS = {wp.float32: wp.vec3, wp.float64: wp.vec3d}

# i, j, k: the lowest of the nodes around a particle; f: how far it lies beyond them, in cells
NODES = """
    const T hx = axis == 0 ? (T)0 : (T)0.5, hy = axis == 1 ? (T)0 : (T)0.5, hz = axis == 2 ? (T)0 : (T)0.5;
    const T lx = axis == 0 ? (T)EDGE : (T)0, ly = axis == 1 ? (T)EDGE : (T)0, lz = axis == 2 ? (T)EDGE : (T)0;
    auto nodes = [&](long long p, int& i, int& j, int& k, T& fx, T& fy, T& fz) {
        const T x = grid_coordinate(position[3*p], origin[0]) - hx, y = grid_coordinate(position[3*p + 1], origin[1]) - hy;
        const T z = planes == 2 ? grid_coordinate(position[3*p + 2], origin[2]) - hz : (T)1;
        i = (int)x; j = (int)y; k = (int)z;
        fx = x - (T)i; fy = y - (T)j; fz = z - (T)k;
        fx = fx < lx ? lx : fx; fy = fy < ly ? ly : fy; fz = fz < lz ? lz : fz;
        fx = fx > 1 - lx ? 1 - lx : fx; fy = fy > 1 - ly ? 1 - ly : fy; fz = fz > 1 - lz ? 1 - lz : fz;
    };
"""

SCATTER = """
    const T* position = (const T*)x_.data; const T* velocity = (const T*)v_.data; const T* gradient = (const T*)c_.data;
    T* momentum = m_.data; T* weight = w_.data;
    auto add = [](T& element, T value) {
    #ifdef __CUDA_ARCH__
        atomicAdd(&element, value);
    #else
        element += value;
    #endif
    };
    GRID_COORDINATE NODES
    auto visit = [&](auto affine, auto rows) {  // types, not values: tests inside the loop cost a third of its time
        for (long long p = first; p < last; ++p) {
            int i, j, k; T fx, fy, fz;
            nodes(p, i, j, k, fx, fy, fz);
            const T cx = affine() ? gradient[3*p]*dx : (T)0, cy = affine() ? gradient[3*p + 1]*dx : (T)0;
            const T cz = affine() && rows() == 4 ? gradient[3*p + 2]*dx : (T)0;
            const T v = velocity[3*p + axis] - cx*fx - cy*fy - cz*fz;  // what node (k, j, i) sees
            const long long o = k*s1 + j*s2 + i;
            for (int n = 0; n < rows(); ++n) {
                const int b = n & 1, c = n >> 1;
                const long long e = o + b*s2 + c*s1;
                const T share = (b ? fy : 1 - fy)*(c ? fz : 1 - fz), seen = v + (b ? cy : (T)0) + (c ? cz : (T)0);
                const T low = (1 - fx)*share, high = fx*share;
                add(momentum[e], low*seen); add(momentum[e + 1], high*(seen + cx)); add(weight[e], low); add(weight[e + 1], high);
            }
        }
    };
    auto no = [] { return 0; }; auto yes = [] { return 1; }; auto two = [] { return 2; }; auto four = [] { return 4; };
    if (gradient && planes == 2) visit(yes, four); else if (gradient) visit(yes, two);
    else if (planes == 2) visit(no, four); else visit(no, two);
"""

INTERPOLATE = """
    const T* position = (const T*)x_.data; T* velocity = (T*)v_.data; T* gradient = (T*)c_.data;
    const long long up = planes == 2 ? s1 : 0;
    GRID_COORDINATE NODES
    T before[M];
    for (int start = first; start < last; start += M) {
        const int n = last - start < M ? last - start : M;
        SIMD for (int m = 0; m < n; ++m) before[m] = 0;
        if (saved_.data) {
            const T* g = saved_.data;
            SIMD for (int m = 0; m < n; ++m) {
                const long long p = start + m;
                int i, j, k; T fx, fy, fz;
                nodes(p, i, j, k, fx, fy, fz);
                const T* a = g + (k*s1 + j*s2 + i); const T* b = a + up;
                const T a0 = a[0] + fx*(a[1] - a[0]), a1 = a[s2] + fx*(a[s2 + 1] - a[s2]);
                const T b0 = b[0] + fx*(b[1] - b[0]), b1 = b[s2] + fx*(b[s2 + 1] - b[s2]);
                const T low = a0 + fy*(a1 - a0), high = b0 + fy*(b1 - b0);
                before[m] = flip*(velocity[3*p + axis] - (low + fz*(high - low)));
            }
        }
        const T* g = field_.data;
        auto visit = [&](auto keep) {
            SIMD for (int m = 0; m < n; ++m) {
                const long long p = start + m;
                int i, j, k; T fx, fy, fz;
                nodes(p, i, j, k, fx, fy, fz);
                const T* a = g + (k*s1 + j*s2 + i); const T* b = a + up;
                const T da0 = a[1] - a[0], da1 = a[s2 + 1] - a[s2], db0 = b[1] - b[0], db1 = b[s2 + 1] - b[s2];
                const T a0 = a[0] + fx*da0, a1 = a[s2] + fx*da1, b0 = b[0] + fx*db0, b1 = b[s2] + fx*db1;
                const T low = a0 + fy*(a1 - a0), high = b0 + fy*(b1 - b0), dx0 = da0 + fy*(da1 - da0), dx1 = db0 + fy*(db1 - db0);
                velocity[3*p + axis] = low + fz*(high - low) + before[m];
                keep(p, dx0 + fz*(dx1 - dx0), (a1 - a0) + fz*((b1 - b0) - (a1 - a0)), high - low);
            }
        };
        if (gradient) visit([&](long long p, T x, T y, T z) {
            gradient[3*p] = x*inverse_dx; gradient[3*p + 1] = y*inverse_dx; gradient[3*p + 2] = z*inverse_dx; });
        else visit([](long long, T, T, T) {});
    }
"""

# Face (k, j, i) visits the particles of the cells around it; along x they are consecutive, a range a row of cells
GATHER_WEIGHTS = """
    const T* position = (const T*)x_.data; const T* velocity = (const T*)v_.data; const T* gradient = (const T*)c_.data;
    const int* first_of = offsets.data;
    GRID_COORDINATE NODES
    // a particle in cell c reaches the nodes c and c + 1 of its own axis, c - 1 to c + 1 of the others
    const int x0 = i > 0 ? i - 1 : 0, x1 = axis == 0 || i + 1 >= nx ? i : i + 1;
    const int y0 = j > 0 ? j - 1 : 0, y1 = axis == 1 || j + 1 >= ny ? j : j + 1;
    const int z0 = planes == 1 ? k : (k > 0 ? k - 1 : 0), z1 = planes == 1 || axis == 2 || k + 1 >= nz ? k : k + 1;
    T momentum = 0, weight = 0;
    for (int c = z0; c <= z1; ++c) for (int b = y0; b <= y1; ++b) {
        const long long row = c*s1 + b*s2;
        const int last = first_of[row + x1 + 1];
        for (long long p = first_of[row + x0]; p < last; ++p) {
            int pi, pj, pk; T fx, fy, fz;
            nodes(p, pi, pj, pk, fx, fy, fz);
            const int di = i - pi, dj = j - pj, dk = planes == 2 ? k - pk : 0;
            if ((di | dj | dk) & ~1) continue;  // not one of the nodes around it
            const T w = (di ? fx : 1 - fx)*(dj ? fy : 1 - fy)*(planes == 1 ? (T)1 : dk ? fz : 1 - fz);
            T v = velocity[3*p + axis];
            if (gradient) {
                v += dx*(gradient[3*p]*((T)di - fx) + gradient[3*p + 1]*((T)dj - fy));
                if (planes == 2) v += dx*gradient[3*p + 2]*((T)dk - fz);
            }
            momentum += w*v;
            weight += w;
        }
    }
    const long long e = k*s1 + j*s2 + i;
    w_.data[e] = weight;
    field_.data[e] = weight > (T)TINY ? momentum/weight : (T)0;
"""


@functools.cache
def kernels(real: Any) -> SimpleNamespace:
    """Return the kernels for fields and particles of float32 or float64."""
    name = f"warp_lcp.grid.transfer_{real.__name__}"
    vectors, values, typed = wp.array(dtype=VECTORS[real]), wp.array3d(dtype=real), f"typedef {C_TYPES[real]} T;"

    def native(source: str) -> str:
        return particle_loop(typed + source.replace("NODES", NODES).replace("EDGE", repr(EDGE[real])).replace("TINY", repr(TINY_WEIGHT)))

    @wp.func_native(native(SCATTER))
    def scatter_some(
        axis: int, planes: int, dx: real, inverse_dx: real, origin: wp.vec3i, s1: wp.int64, s2: wp.int64,
        x_: vectors, v_: vectors, c_: vectors, m_: values, w_: values, first: int, last: int,
    ): ...  # fmt: skip

    @wp.func_native(native(BLOCK + INTERPOLATE))
    def interpolate_some(
        axis: int, planes: int, inverse_dx: real, origin: wp.vec3i, flip: real, s1: wp.int64, s2: wp.int64,
        x_: vectors, field_: values, saved_: values, v_: vectors, c_: vectors, first: int, last: int,
    ): ...  # fmt: skip

    @wp.func_native(native(GATHER_WEIGHTS))
    def gather_face(
        axis: int, planes: int, dx: real, inverse_dx: real, origin: wp.vec3i, nx: int, ny: int, nz: int, s1: wp.int64, s2: wp.int64,
        offsets: wp.array(dtype=wp.int32), x_: vectors, v_: vectors, c_: vectors, field_: values, w_: values, k: int, j: int, i: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def scatter(
        count: int, grain: int, axis: int, planes: int, dx: real, inverse_dx: real, origin: wp.vec3i,
        position: vectors, velocity: vectors, gradient: vectors, momentum: values, weight: values,
    ):  # fmt: skip
        first = wp.tid() * grain
        ny, nx = momentum.shape[1], momentum.shape[2]
        scatter_some(
            axis, planes, dx, inverse_dx, origin, wp.int64(ny) * wp.int64(nx), wp.int64(nx),
            position, velocity, gradient, momentum, weight, first, wp.min(first + grain, count),
        )  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def interpolate(
        count: int, grain: int, axis: int, planes: int, inverse_dx: real, origin: wp.vec3i, flip: real,
        position: vectors, field: values, saved: values, velocity: vectors, gradient: vectors,
    ):  # fmt: skip
        first = wp.tid() * grain
        ny, nx = field.shape[1], field.shape[2]
        interpolate_some(
            axis, planes, inverse_dx, origin, flip, wp.int64(ny) * wp.int64(nx), wp.int64(nx),
            position, field, saved, velocity, gradient, first, wp.min(first + grain, count),
        )  # fmt: skip

    @cell_kernel(name)
    def gather_weights(
        k, j, i, axis: int, planes: int, dx: real, inverse_dx: real, origin: wp.vec3i, offsets: wp.array(dtype=wp.int32),
        position: vectors, velocity: vectors, gradient: vectors, field: values, weight: values,
    ):  # fmt: skip
        nz, ny, nx = field.shape[0], field.shape[1], field.shape[2]
        gather_face(
            axis, planes, dx, inverse_dx, origin, nx, ny, nz, wp.int64(ny) * wp.int64(nx), wp.int64(nx), offsets,
            position, velocity, gradient, field, weight, k, j, i,
        )  # fmt: skip

    @cell_kernel(name)
    def normalize(k, j, i, weight: values, field: values):
        w = weight[k, j, i]
        if w > real(TINY_WEIGHT):
            field[k, j, i] = field[k, j, i] / w
        else:
            field[k, j, i] = real(0.0)

    return SimpleNamespace(scatter=scatter, interpolate=interpolate, gather_weights=gather_weights, normalize=normalize)
