# mypy: ignore-errors
"""Kernels of the surface that a picture shows: its field on a lattice, what solids take away of it, and how fast it moves."""

from pathlib import Path
from typing import Any

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I8, cell_kernel
from warp_lcp.grid.level_set_kernels import WEIGHTS
from warp_lcp.grid.particle_loops import particle_loop
from warp_lcp.operators.grid_poisson import SOLID
from warp_lcp.rows import RowPass

FAR = 2.0  # lattice cells: a distance to solids that takes nothing from the liquid
LEAST_OPEN = 0.25  # of a kernel: where less of it is open the distance is continued from outside the solid
# A particle is boosted by gain ((THIN / share)^POWER - 1) where the smoothed share is below THIN: by nothing at a plane surface, where the
# outermost particles have about 0.63, by most in a drop of one particle, by about 1/2 in a sheet of one layer, which keeps its thickness.
THIN, POWER = 0.6, 0.4


_options = {"enable_backward": False, "module": "warp_lcp.grid.surface_mesh"}


def _made(name: str, header: str, fields: str, **more: Any) -> RowPass:
    box = {n: wp.int8 if n == "known" else wp.float32 for n in fields.split()}
    return RowPass(f"warp_lcp.grid.surface_mesh.{name}", Path(__file__).parent / "headers" / header, wp.float32, box=box, **more)


DISTANCE = _made(
    "distance",
    "surface_distance.h",
    "phi smooth thin capacity known",
    numbers={"planes": int, "spread": wp.float32},
    optional=("capacity", "known"),
    constants={"LEAST_OPEN": LEAST_OPEN},
)
ROOM = _made("room", "room.h", "out", whole={"distance": wp.float32}, numbers={"planes": int, "parts": int})
CARVE = _made("carve", "carve.h", "room phi")


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


def _filled(source: str) -> str:
    for name, value in (("LEAST_OPEN", LEAST_OPEN), ("THIN", THIN), ("POWER", POWER), ("WEIGHTS", WEIGHTS)):
        source = source.replace(name, value if isinstance(value, str) else repr(value))
    return source


@wp.func_native(particle_loop(_filled(BOOST)))
def boost_some(
    planes: int, inverse_dx: float, each: float, gain: float, most: float, x_: wp.array(dtype=wp.vec3), smooth_: F32, capacity_: F32,
    out_: F32, first: int, last: int,
): ...  # fmt: skip


@wp.kernel(**_options)
def boost_kernel(
    count: int, grain: int, planes: int, inverse_dx: float, each: float, gain: float, most: float, position: wp.array(dtype=wp.vec3),
    smooth: F32, capacity: F32, out: F32,
):  # fmt: skip
    """Add the kernels of particles that have few others around them, the more the fewer these are."""
    first = wp.tid() * grain
    boost_some(planes, inverse_dx, each, gain, most, position, smooth, capacity, out, first, wp.min(first + grain, count))


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


@wp.kernel(**_options)
def clamp_kernel(points: wp.array(dtype=wp.vec3), size: wp.vec3, out: wp.array(dtype=wp.vec3)):
    """Bring points that are beyond the far sides back to them."""
    p = wp.tid()
    out[p] = wp.min(points[p], size)
