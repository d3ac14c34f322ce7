# mypy: ignore-errors
"""A projected step of the traction of walls that cut cells."""

import functools

import warp as wp

from granular.stress_kernels import NEXT_S, NOW_S
from granular.yield_set import SHAPE, native

# Coulomb friction of the wall in a cell, within mu times its load, against the sand's slip along it: the mean of its faces' velocities by
# what is open of them, without the part along the wall's normal n. A layer holds the traction times the wall's area over what is open of
# the cell's two faces along an axis: so much a face takes of it for its own open part. The load is the pressure, which is all that keeps
# sand from going into the wall, and the weight of what no face of the cell stands for: of all that a cell holds with no sand upon it. On
# a wall rougher than sand it is the sand beside it that fails: a band of shear thinner than a cell, which no grid oblique to it has.
TRACTION = (
    SHAPE.replace(", row = k*s[2] + j*s[1]", "")
    + """
    const float* inverse[3] = {inverse_x.data, inverse_y.data, inverse_z.data};
    const T* u[3] = {u_x.data, u_y.data, u_z.data};
    const float* weight = numbers.data + WEIGHT;
    const T omega = RESIDUAL ? (T)1 : (T)numbers.data[SHEAR_STEP], beta = RESIDUAL ? (T)0 : (T)momentum.data[NOW_S];
    const T ahead = (T)momentum.data[NEXT_S]*(T)numbers.data[LOOKAHEAD];
    double es = 0, ee = 0, ss = 0, residual = 0;
    for (int m = first; m < last; ++m) {
        const long long cell = cells.data[m];
        if (!(flags_.data[cell] & HOLDS)) continue;
        const float* n = walls.data + 8*m;  // normal (3), area, what faces leave out along each axis (3), volume
        const T size = n[3], x = now_.data[cell];
        T v[DIM], sum[DIM], across = 0, stiffest = 0, load = x;
        int main = 0;
        for (int a = 1; a < DIM; ++a) main = n[a]*n[a] > n[main]*n[main] ? a : main;
        const int alone = !(flags_.data[cell - (n[main] > 0.0f ? s[main] : -s[main])] & HOLDS);
        for (int a = 0; a < DIM; ++a) {
            const long long o = cell + s[a];
            const T low = cut_.data[a*layer + cell], high = cut_.data[a*layer + o];
            sum[a] = low + high;
            v[a] = sum[a] > (T)0 ? (low*u[a][cell] + high*u[a][o])/sum[a] : (T)0;
            across += n[a]*v[a];
            load += n[a]*weight[a]*fraction_.data[cell]*(alone ? n[7] : n[4 + a])/size;
            if (sum[a] > (T)0) {
                const T stiff = (T)2*size*(low*low*inverse[a][cell] + high*high*inverse[a][o])/(sum[a]*sum[a]);
                stiffest = stiff > stiffest ? stiff : stiffest;
            }
        }
        if (!(stiffest > (T)0)) continue;
        T tau[DIM], from[DIM], total = 0;
        for (int a = 0; a < DIM; ++a) {
            const long long at = (FIRST + 4*SHEARS + a)*layer + cell;
            const T old = now_.data[at];
            from[a] = (RESIDUAL ? old : old + beta*(old - (T)before_.data[at]))*sum[a]/size;
            tau[a] = from[a] - omega/stiffest*(v[a] - across*n[a]);
            total += tau[a]*tau[a];
        }
        const T normal = load > (T)0 ? load : (T)0, wall = (T)friction.data[numbers_of.data[m]]*normal;
        const T sand = (T)numbers.data[FRICTION]*normal + (T)numbers.data[COHESION], bound = wall < sand ? wall : sand;
        const T keep = total > bound*bound ? bound/sqrt(total) : (T)1;
        for (int a = 0; a < DIM; ++a) {
            if (!(sum[a] > (T)0)) continue;
            const long long at = (FIRST + 4*SHEARS + a)*layer + cell;
            const T scale = size/sum[a], old = (T)now_.data[at], value = keep*tau[a];
            const T s_ = value - old/scale, e_ = value - from[a];
            es += stiffest*e_*s_; ee += stiffest*e_*e_; ss += stiffest*s_*s_;
            residual += RESIDUAL ? s_*s_ : e_*e_;
            if (!RESIDUAL) {
                before_.data[at] = (float)old; now_.data[at] = (float)(scale*value); point_.data[at] = (float)(scale*(value + ahead*s_));
            }
        }
    }
    const long long columns = partials.shape[0]/COLUMNS;
    const double found[COLUMNS] = {RESIDUAL ? residual : 0, 0, 0, es, ee, ss, 0, residual};
    for (int c = 0; c < COLUMNS; ++c) partials.data[c*columns + chunk] = found[c];
"""
)

_F32, _U8, _STRESS = wp.array3d(dtype=wp.float32), wp.array3d(dtype=wp.uint8), wp.array4d(dtype=wp.float32)


@functools.cache
def traction_kernel(dimension: int, real, residual: bool) -> wp.Kernel:
    """Return the kernel for 2 or 3 dimensions, velocities of `real`; a step, or what the natural residual would move."""
    field = wp.array3d(dtype=real)
    words = {"NOW_S": NOW_S, "NEXT_S": NEXT_S, "RESIDUAL": int(residual)}

    @wp.func_native(native(TRACTION, dimension, real, box=False, **words))
    def traction_entries(
        cells: wp.array(dtype=wp.int32), numbers_of: wp.array(dtype=wp.int32), walls: wp.array(dtype=wp.float32),
        friction: wp.array(dtype=wp.float32), flags_: _U8, fraction_: _F32, cut_: _STRESS, now_: _STRESS, before_: _STRESS, point_: _STRESS,
        share_x: _F32, u_x: field, u_y: field, u_z: field, inverse_x: _F32, inverse_y: _F32, inverse_z: _F32,
        momentum: wp.array(dtype=wp.float64), numbers: wp.array(dtype=wp.float32), partials: wp.array(dtype=wp.float64),
        chunk: int, first: int, last: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=f"granular.cut_walls_{dimension}d_{real.__name__}_{'residual' if residual else 'step'}")
    def traction(
        grain: int, behind: int, cells: wp.array(dtype=wp.int32), numbers_of: wp.array(dtype=wp.int32), walls: wp.array(dtype=wp.float32),
        friction: wp.array(dtype=wp.float32), flags: _U8, fraction: _F32, openings: _STRESS, now: _STRESS, before: _STRESS, point: _STRESS,
        share_x: _F32, u_x: field, u_y: field, u_z: field, inverse_x: _F32, inverse_y: _F32, inverse_z: _F32,
        momentum: wp.array(dtype=wp.float64), numbers: wp.array(dtype=wp.float32), partials: wp.array(dtype=wp.float64),
    ):  # fmt: skip
        chunk = wp.tid()
        first = chunk * grain
        traction_entries(
            cells, numbers_of, walls, friction, flags, fraction, openings, now, before, point, share_x, u_x, u_y, u_z,
            inverse_x, inverse_y, inverse_z, momentum, numbers, partials, behind + chunk,
            first, wp.min(first + grain, cells.shape[0]),
        )  # fmt: skip

    return traction
