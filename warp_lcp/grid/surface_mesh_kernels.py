# mypy: ignore-errors
"""Kernels of the surface that a picture shows: its field on a lattice, what solids take away of it, and how fast it moves."""

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I8, cell_kernel
from warp_lcp.grid.level_set_kernels import WEIGHTS
from warp_lcp.grid.particle_loops import particle_loop
from warp_lcp.native import BLOCK, simd
from warp_lcp.operators.grid_poisson import SOLID

FAR = 2.0  # lattice cells: a distance to solids that takes nothing from the liquid
LEAST_OPEN = 0.25  # of a kernel: where less of it is open the distance is continued from outside the solid
# A particle is boosted by gain ((THIN / share)^POWER - 1) where the smoothed share is below THIN: by nothing at a plane surface, where the
# outermost particles have about 0.63, by most in a drop of one particle, by about 1/2 in a sheet of one layer, which keeps its thickness.
THIN, POWER = 0.6, 0.4


_options = {"enable_backward": False, "module": "warp_lcp.grid.surface_mesh"}


@wp.kernel(**_options)
def mirror_kernel(axis: int, fold: bool, field: F32):
    """Give the ring at both ends of an axis the values beside it, after adding to those what the ring holds; a thread a line."""
    a, b = wp.tid()
    last = field.shape[2 - axis] - 1
    for end in range(2):
        ring = end * last
        beside = wp.where(end == 0, 1, last - 1)
        if axis == 0:
            if fold:
                field[a, b, beside] += field[a, b, ring]
            field[a, b, ring] = field[a, b, beside]
        elif axis == 1:
            if fold:
                field[a, beside, b] += field[a, ring, b]
            field[a, ring, b] = field[a, beside, b]
        else:
            if fold:
                field[beside, a, b] += field[ring, a, b]
            field[ring, a, b] = field[beside, a, b]


# A particle looks at the share in its own lattice cell; few have to go on
BOOST = """
    typedef float T;
    const T* position = (const T*)x_.data; const T* smooth = smooth_.data; const T* capacity = capacity_.data; T* out = out_.data;
    const int nx = out_.shape[2] - 2, ny = out_.shape[1] - 2, nz = out_.shape[0] - 2;
    const long long s2 = nx + 2, s1 = s2*(ny + 2);
    auto add = [](T& element, T value) {
    #ifdef __CUDA_ARCH__
        atomicAdd(&element, value);
    #else
        element += value;
    #endif
    };
    GRID_COORDINATE WEIGHTS
    for (long long p = first; p < last; ++p) {
        auto cell = [&](int axis, int n) {
            const T x = grid_coordinate(position[3*p + axis]), from = x > 1 ? x : (T)1, e = n; return (int)(from < e ? from : e);
        };
        const int i = cell(0, nx), j = cell(1, ny), k = planes == 2 ? cell(2, nz) : 1;
        const long long at = k*s1 + j*s2 + i;
        T share = smooth[at];
        if (capacity) share /= capacity[at] > (T)LEAST_OPEN ? capacity[at] : (T)LEAST_OPEN;
        if (share >= (T)THIN) continue;
        const T wanted = gain*((T)pow((T)THIN/(share > (T)1e-3 ? share : (T)1e-3), (T)POWER) - 1);
        const T boost = each*(wanted < most ? wanted : most);
        T wx[3], wy[3], wz[3] = {0, 1, 0};
        weigh(grid_coordinate(position[3*p]), nx, wx);
        weigh(grid_coordinate(position[3*p + 1]), ny, wy);
        if (planes == 2) weigh(grid_coordinate(position[3*p + 2]), nz, wz);
        for (int c = 2 - planes; c <= planes; ++c) for (int b = 0; b < 3; ++b) for (int a = 0; a < 3; ++a)
            add(out[at + (c - 1)*s1 + (b - 1)*s2 + a - 1], boost*wz[c]*wy[b]*wx[a]);
    }
"""

# phi = -spread sqrt(2) erfinv(2 share - 1), what a half space would be away, by the series up to the seventh power (0.2 % off at the nodes
# beside the surface); beyond the domain's sides there is air
DISTANCE = """
    const int nx = phi_.shape[2] - 2, ny = phi_.shape[1] - 2, nz = phi_.shape[0] - 2;
    const long long s2 = nx + 2, s1 = s2*(ny + 2), at = k*s1 + j*s2;
    const float* smooth = smooth_.data + at; const float* thin = thin_.data + at;
    const float* capacity = capacity_.data ? capacity_.data + at : nullptr;
    float* phi = phi_.data + at; signed char* known = known_.data ? (signed char*)known_.data + at : nullptr;
    const float scale = -1.2533141f*spread;  // sqrt(pi / 2)
    const bool beyond = j == 0 || j > ny || (planes == 2 && (k == 0 || k > nz));
    float share[M];
    for (int start = first; start < last; start += M) {
        const int n = last - start < M ? last - start : (int)M;
        SIMD for (int m = 0; m < n; ++m) share[m] = smooth[start + m] + thin[start + m];
        if (capacity) {
            SIMD for (int m = 0; m < n; ++m) {
                const float c = capacity[start + m] > (float)LEAST_OPEN ? capacity[start + m] : (float)LEAST_OPEN;
                known[start + m] = capacity[start + m] > (float)LEAST_OPEN;
                share[m] /= c;
            }
        }
        SIMD for (int m = 0; m < n; ++m) {
            const float f = share[m] < 1 ? share[m] : 1.0f, z = 2*f - 1, q = z*z;
            const float d = scale*z*(1 + q*(0.26179939f + q*(0.14393173f + q*0.097663620f)));
            phi[start + m] = (beyond | (start + m == 0) | (start + m > nx)) ? 1.0f : d;
        }
    }
"""

CARVE = """
    const long long at = ((long long)k*phi_.shape[1] + j)*phi_.shape[2];
    float* phi = phi_.data + at; const float* room = room_.data + at;
    SIMD for (int i = first; i < last; ++i) phi[i] = phi[i] > -room[i] ? phi[i] : -room[i];
"""

# Distance to the solids at a row of lattice cells from that at the grid's nodes, in lattice cells
ROOM = """
    const int ny = distance_.shape[1], nx = distance_.shape[2];
    const long long s2 = nx, s1 = s2*ny;
    const float scale = (float)parts, step = 1.0f/scale;
    auto cell = [&](int fine, float& f) {  // the stored cell that a lattice cell's center lies in, and where in it
        const float x = ((float)fine - 0.5f)*step + 1.0f; const int c = (int)x;
        f = x - (float)c;
        return c;
    };
    float fx, fy, fz = 0;
    const int cy = cell(j, fy), cz = planes == 2 ? cell(k, fz) : 1;
    const float* d = distance_.data + cz*s1 + cy*s2; const long long up = planes == 2 ? s1 : 0;
    float* out = out_.data + (long long)k*out_.shape[1]*out_.shape[2] + (long long)j*out_.shape[2];
    for (int i = first; i < last; ++i) {
        const int c = cell(i, fx);
        auto along = [&](const float* row) { return row[c] + fx*(row[c + 1] - row[c]); };
        const float low = along(d) + fy*(along(d + s2) - along(d)), high = along(d + up) + fy*(along(d + up + s2) - along(d + up));
        out[i] = scale*(low + fz*(high - low));
    }
"""


def _filled(source: str) -> str:
    for name, value in (("LEAST_OPEN", LEAST_OPEN), ("THIN", THIN), ("POWER", POWER), ("WEIGHTS", WEIGHTS)):
        source = source.replace(name, value if isinstance(value, str) else repr(value))
    return source


@wp.func_native(particle_loop(_filled(BOOST)))
def boost_some(
    planes: int, inverse_dx: float, each: float, gain: float, most: float, x_: wp.array(dtype=wp.vec3), smooth_: F32, capacity_: F32,
    out_: F32, first: int, last: int,
): ...  # fmt: skip


@wp.func_native(simd(BLOCK + _filled(DISTANCE)))
def distance_row(
    planes: int, spread: float, smooth_: F32, thin_: F32, capacity_: F32, phi_: F32, known_: I8,
    k: int, j: int, first: int, last: int,
): ...  # fmt: skip


@wp.func_native(simd(ROOM))
def room_row(planes: int, parts: int, distance_: F32, out_: F32, k: int, j: int, first: int, last: int): ...


@wp.func_native(simd(CARVE))
def carve_row(room_: F32, phi_: F32, k: int, j: int, first: int, last: int): ...


@wp.kernel(**_options)
def boost_kernel(
    count: int, grain: int, planes: int, inverse_dx: float, each: float, gain: float, most: float, position: wp.array(dtype=wp.vec3),
    smooth: F32, capacity: F32, out: F32,
):  # fmt: skip
    """Add the kernels of particles that have few others around them, the more the fewer these are."""
    first = wp.tid() * grain
    boost_some(planes, inverse_dx, each, gain, most, position, smooth, capacity, out, first, wp.min(first + grain, count))


@cell_kernel("warp_lcp.grid.surface_mesh")
def distance_kernel(k, j, first, end, planes: int, spread: float, smooth: F32, thin: F32, capacity: F32, phi: F32, known: I8):
    """Turn filled shares into distances [lattice cells]."""
    distance_row(planes, spread, smooth, thin, capacity, phi, known, k, j, first, end)


@cell_kernel("warp_lcp.grid.surface_mesh")
def room_kernel(k, j, first, end, planes: int, parts: int, distance: F32, out: F32):
    """Interpolate the distance to solids that cut cells."""
    room_row(planes, parts, distance, out, k, j, first, end)


@wp.func
def is_solid(base: I8, planes: int, parts: int, k: int, j: int, i: int):
    """Tell whether a lattice cell lies in a cell that is SOLID; cells of the ring are not."""
    c = wp.where(planes == 2, (k - 1) // parts + 1, 1)
    return base[c, (j - 1) // parts + 1, (i - 1) // parts + 1] == wp.int8(SOLID)


@cell_kernel("warp_lcp.grid.surface_mesh")
def whole_cell_room_kernel(k, j, i, planes: int, parts: int, base: I8, out: F32):
    """Say half a lattice cell on both sides of the faces of whole solid cells, far elsewhere."""
    d = float(FAR)
    if is_solid(base, planes, parts, k, j, i):
        d = float(-0.5)
    else:
        for a in range(2):
            s = 2 * a - 1
            if is_solid(base, planes, parts, k, j, wp.clamp(i + s, 1, out.shape[2] - 2)):
                d = float(0.5)
            if is_solid(base, planes, parts, k, wp.clamp(j + s, 1, out.shape[1] - 2), i):
                d = float(0.5)
            if planes == 2 and is_solid(base, planes, parts, wp.clamp(k + s, 1, out.shape[0] - 2), j, i):
                d = float(0.5)
    out[k, j, i] = d


@cell_kernel("warp_lcp.grid.surface_mesh")
def fill_kernel(k, j, i, planes: int, parts: int, least: float, depth: F32, base: I8, density: F32):
    """Make lattice cells full that lie in open cells deeper than `least`."""
    c = wp.where(planes == 2, (k - 1) // parts + 1, 1)
    b = (j - 1) // parts + 1
    a = (i - 1) // parts + 1
    if depth[c, b, a] >= least and base[c, b, a] != wp.int8(SOLID):
        density[k, j, i] = 1.0


@cell_kernel("warp_lcp.grid.surface_mesh")
def open_share_kernel(k, j, i, room: F32, out: F32):
    """Estimate which share of each lattice cell is open."""
    out[k, j, i] = wp.clamp(room[k, j, i] + 0.5, 0.0, 1.0)


@cell_kernel("warp_lcp.grid.surface_mesh")
def carve_kernel(k, j, first, end, room: F32, phi: F32):
    """Take what lies inside solids away from the liquid."""
    carve_row(room, phi, k, j, first, end)


@wp.kernel(**_options)
def clamp_kernel(points: wp.array(dtype=wp.vec3), size: wp.vec3, out: wp.array(dtype=wp.vec3)):
    """Bring points that are beyond the far sides back to them."""
    p = wp.tid()
    out[p] = wp.min(points[p], size)
