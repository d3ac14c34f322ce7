# mypy: ignore-errors
"""Kernels of the level set: the particles' density, the distance that a filled share of a cell's kernel means, the volume it encloses.

A cell's kernel is the quadratic B-spline around its center, three cells wide along each axis. G(s), the share of it that a half space
filled up to s cells from its center holds, is a cubic in pieces: (s + 3/2)^3 / 6 up to -1/2, 1/2 + 3/4 s - s^3 / 3 up to 1/2, and
G(-s) = 1 - G(s).
"""

from pathlib import Path

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I8, cell_kernel
from warp_lcp.grid.particle_loops import particle_loop
from warp_lcp.operators.grid_poisson import SOLID
from warp_lcp.rows import RowPass

# Of a cell's kernel: where less is open, too few particles fit to tell (one, of four a cell), and an empty wedge deep in the liquid would
# count as air, into which the liquid falls. Such a cell is given its neighbors' distance.
MIN_CAPACITY = 0.25
TAIL = 1e-4  # the least filled share whose quantile is taken after smoothing
EXTENDED = 2  # layers of cells without a distance of their own that are given one

# The cell c of a coordinate and the weights of cells c - 1, c, c + 1.
WEIGHTS = """
    auto weigh = [](T x, int count, T* w) {
        const T from = x > 1 ? x : (T)1, e = count; const int c = (int)(from < e ? from : e);
        const T f = from - (T)c - (T)0.5, a = (T)0.5 - f, b = (T)0.5 + f;
        w[0] = (T)0.5*a*a; w[1] = (T)0.75 - f*f; w[2] = (T)0.5*b*b;
        return c;
    };
"""

SCATTER = """
    typedef float T;
    const T* position = (const T*)x_.data; T* density = density_.data;
    const int nx = density_.shape[2] - 2, ny = density_.shape[1] - 2, nz = density_.shape[0] - 2;
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
        T wx[3], wy[3], wz[3] = {0, 1, 0};
        const int i = weigh(grid_coordinate(position[3*p], origin[0]), nx, wx);
        const int j = weigh(grid_coordinate(position[3*p + 1], origin[1]), ny, wy);
        const int k = planes == 2 ? weigh(grid_coordinate(position[3*p + 2], origin[2]), nz, wz) : 1;
        #ifndef __CUDA_ARCH__
        typedef T Four __attribute__((vector_size(4*sizeof(T))));
        const Four along = {wx[0], wx[1], wx[2], 0};
        #endif
        for (int c = 2 - planes; c <= planes; ++c) for (int b = 0; b < 3; ++b) {
            const T share = each*wz[c]*wy[b];
            T* row = density + ((k + c - 1)*s1 + (j + b - 1)*s2 + i);
            #ifndef __CUDA_ARCH__
            if (i < nx) {  // four at once, of which the last gets nothing: a third of the stores, 9 ns a particle in 3-D instead of 15
                Four sum;
                __builtin_memcpy(&sum, row - 1, sizeof(Four));
                sum += share*along;
                __builtin_memcpy(row - 1, &sum, sizeof(Four));
                continue;
            }
            #endif
            add(row[-1], share*wx[0]); add(row[0], share*wx[1]); add(row[1], share*wx[2]);
        }
    }
"""

GATHER = """
    typedef float T;
    const T* position = (const T*)x_.data; const int* first_of = offsets.data;
    const int nx = density_.shape[2], ny = density_.shape[1], nz = density_.shape[0];
    const long long s2 = nx, s1 = s2*ny;
    GRID_COORDINATE
    auto weight = [&](int axis, T x, int cell) {
        T d = grid_coordinate(x, origin[axis]) - ((T)cell + (T)0.5);
        d = d < 0 ? -d : d;
        const T outer = d < (T)1.5 ? (T)1.5 - d : (T)0;
        return d < (T)0.5 ? (T)0.75 - d*d : (T)0.5*outer*outer;
    };
    const int x0 = i > 0 ? i - 1 : 0, x1 = i + 1 < nx ? i + 1 : i, y0 = j > 0 ? j - 1 : 0, y1 = j + 1 < ny ? j + 1 : j;
    const int z0 = planes == 2 && k > 0 ? k - 1 : k, z1 = planes == 2 && k + 1 < nz ? k + 1 : k;
    T total = 0;
    for (int c = z0; c <= z1; ++c) for (int b = y0; b <= y1; ++b) {
        const long long row = c*s1 + b*s2;
        const int last = first_of[row + x1 + 1];
        for (long long p = first_of[row + x0]; p < last; ++p) {
            const T z = planes == 2 ? weight(2, position[3*p + 2], k) : (T)1;
            total += weight(0, position[3*p], i)*weight(1, position[3*p + 1], j)*z;
        }
    }
    density_.data[k*s1 + j*s2 + i] = each*total;
"""

_LEVEL_SET, _HEADERS = "warp_lcp.grid.level_set", Path(__file__).parent / "headers"
_CONSTANTS = {"MIN_CAPACITY": MIN_CAPACITY, "TAIL": TAIL, "SOLID": SOLID}
_PHI = {"phi": wp.float32, "known": wp.int8}
BINOMIAL = RowPass(
    f"{_LEVEL_SET}.binomial", _HEADERS / "binomial.h", wp.float32, box={"source": wp.float32, "out": wp.float32}, numbers={"planes": int}
)
DISTANCE = RowPass(
    f"{_LEVEL_SET}.distance",
    _HEADERS / "level_set_distance.h",
    wp.float32,
    box=_PHI | {"density": wp.float32, "capacity": wp.float32, "smooth": wp.float32, "base": wp.int8},
    numbers={"spread": wp.float32, "limit": wp.float32},
    optional=("capacity", "smooth"),
    constants=_CONSTANTS,
)
VOLUME = RowPass(
    f"{_LEVEL_SET}.volume",
    _HEADERS / "volume.h",
    wp.float32,
    box=_PHI | {"distance": wp.float32},
    whole={"sums": wp.float64},
    numbers={"planes": int, "parts": int},
    optional=("distance",),
)


@wp.func_native(particle_loop(SCATTER.replace("WEIGHTS", WEIGHTS)))
def scatter_some(
    planes: int, inverse_dx: float, origin: wp.vec3i, each: float, x_: wp.array(dtype=wp.vec3), density_: F32,
    first: int, last: int,
): ...  # fmt: skip


@wp.func_native(particle_loop(GATHER))
def gather_cell(
    planes: int, inverse_dx: float, origin: wp.vec3i, each: float, offsets: wp.array(dtype=wp.int32), x_: wp.array(dtype=wp.vec3),
    density_: F32, k: int, j: int, i: int,
): ...  # fmt: skip


@wp.kernel(enable_backward=False, module="warp_lcp.grid.density")
def scatter_kernel(
    count: int, grain: int, planes: int, inverse_dx: float, origin: wp.vec3i, each: float, position: wp.array(dtype=wp.vec3),
    density: F32,
):  # fmt: skip
    """Add the share of some particles to the cells around them."""
    first = wp.tid() * grain
    scatter_some(planes, inverse_dx, origin, each, position, density, first, wp.min(first + grain, count))


@cell_kernel("warp_lcp.grid.density")
def gather_kernel(
    k, j, i, planes: int, inverse_dx: float, origin: wp.vec3i, each: float, offsets: wp.array(dtype=wp.int32),
    position: wp.array(dtype=wp.vec3), density: F32,
):  # fmt: skip
    """Let each cell add up the particles around it."""
    gather_cell(planes, inverse_dx, origin, each, offsets, position, density, k, j, i)


@wp.func
def slope_beside(here: float, below: float, above: float, has_below: bool, has_above: bool):
    """Return the central difference, or the one-sided one where only one neighbor has a value."""
    if has_below and has_above:
        return 0.5 * (above - below)
    if has_above:
        return above - here
    if has_below:
        return here - below
    return 0.0


@cell_kernel("warp_lcp.grid.level_set")
def wall_shift_kernel(
    k, j, i, variance: float, limit: float, capacity: F32, phi: F32,
    known: I8, out: F32,
):  # fmt: skip
    """Bring phi from the mean place of the open part of a cell's kernel back to the cell's center.

    A wall cuts a part off the kernel, so that what remains measures the liquid at c + s, s = integral of (x - c) K over the open part by
    its capacity. For a Gaussian of that variance s = variance grad(capacity) / capacity; hence phi - s . grad(phi).
    """
    one = wp.int8(1)
    here = phi[k, j, i]
    value = here
    c = capacity[k, j, i]
    inside = k > 0 and j > 0 and i > 0 and k + 1 < phi.shape[0] and j + 1 < phi.shape[1] and i + 1 < phi.shape[2]
    if inside and known[k, j, i] == one and c < 0.999 and wp.abs(here) < 0.98 * limit:
        gx = slope_beside(here, phi[k, j, i - 1], phi[k, j, i + 1], known[k, j, i - 1] == one, known[k, j, i + 1] == one)
        gy = slope_beside(here, phi[k, j - 1, i], phi[k, j + 1, i], known[k, j - 1, i] == one, known[k, j + 1, i] == one)
        gz = slope_beside(here, phi[k - 1, j, i], phi[k + 1, j, i], known[k - 1, j, i] == one, known[k + 1, j, i] == one)
        grad = wp.vec3(gx, gy, gz) / wp.max(wp.length(wp.vec3(gx, gy, gz)), 1.0)
        s = 0.5 * wp.vec3(
            capacity[k, j, i + 1] - capacity[k, j, i - 1],
            capacity[k, j + 1, i] - capacity[k, j - 1, i],
            capacity[k + 1, j, i] - capacity[k - 1, j, i],
        )
        if phi.shape[0] == 3:
            s[2] = 0.0
        s = s * (variance / wp.max(c, 1e-3))
        s = s / wp.max(wp.length(s), 1.0)
        value = wp.clamp(here - wp.dot(s, grad), -limit, limit)
    out[k, j, i] = value


@cell_kernel("warp_lcp.grid.level_set")
def copy_kernel(k, j, i, source: F32, out: F32):
    """Copy a field."""
    out[k, j, i] = source[k, j, i]


@cell_kernel("warp_lcp.grid.level_set")
def clear_kernel(k, j, i, limit: float, phi: F32, known: I8):
    """Forget what an earlier update left: air."""
    phi[k, j, i] = limit
    known[k, j, i] = wp.int8(0)


@cell_kernel("warp_lcp.grid.level_set")
def whole_cell_capacity_kernel(k, j, i, planes: int, base: I8, capacity: F32):
    """Add up the shares 1/6, 2/3, 1/6 of a cell's kernel that lie in the open cells around it."""
    total = float(0.0)
    for c in range(wp.max(k - planes + 1, 0), wp.min(k + planes, base.shape[0])):
        for b in range(wp.max(j - 1, 0), wp.min(j + 2, base.shape[1])):
            for a in range(wp.max(i - 1, 0), wp.min(i + 2, base.shape[2])):
                if base[c, b, a] != wp.int8(SOLID):
                    w = float(1.0)
                    w *= wp.where(a == i, 2.0 / 3.0, 1.0 / 6.0)
                    w *= wp.where(b == j, 2.0 / 3.0, 1.0 / 6.0)
                    if planes == 2:
                        w *= wp.where(c == k, 2.0 / 3.0, 1.0 / 6.0)
                    total += w
    capacity[k, j, i] = total
