// Kernels of the viscous solve: weights, walls and forces.

// snippet viscous_walls: Weights of the links from a component's face to others where walls are.
// `d`: distance of the component's faces; `h`: slip length of a face in a wall; `y`, `z`: distances
// of the other two components. A link to a wall ends at the wall, or behind it by the slip length.
const bool deep = planes == 2;
const long long step[3] = {1, s2, s1}, sa = step[axis], sb = step[axis == 0 ? 1 : 0],
                sc = step[axis == 2 ? 1 : 2];
const int first_other = axis == 0 ? 1 : 0, last_other = axis == 2 ? 1 : 2;
const auto solid = [&](const float* distance, long long i) { return distance[i] <= (float)CLOSE; };
// reciprocal length of a link from i to the wall before q
const auto beyond = [&](long long i, long long q, float slip) {
    const float length = (d[i] + slip) / (d[i] - d[q]);
    return 1.0f / (length > (float)THETA ? length : (float)THETA);
};
// End of such a link [cells from face i], at most at face q, where the products of its edge use the
// wall's velocity. Liquid and wall that rotate together then have no rate of strain, since weight
// times length is that of the whole link.
const auto end_of = [&](long long i, long long q) {
    const float length = h[q] < INFINITY ? (d[i] + h[q]) / (d[i] - d[q]) : 1.0f;
    return length < 1.0f ? (length > (float)THETA ? length : (float)THETA) : 1.0f;
};
// Link along the component's own axis through cell c.
const auto head_on = [&](long long i, long long q, long long c) {
    const bool held = (kind[c] == FLUID) & (contact[c] != RELEASED);
    const bool along = !CUT || d[i] - d[q] >= (float)ALONG;  // no slip across a wall
    const float slip = along ? 0.0f : h[q];
    return held && slip < INFINITY ? cell[c] * beyond(i, q, slip) : 0.0f;
};
// link beside: the weight includes a length above 1 already
const auto beside = [&](long long i, long long q, float weight) {
    const float inverse = h[q] < INFINITY ? beyond(i, q, h[q]) : 0.0f;
    return weight * (inverse > 1.0f ? inverse : (h[q] < INFINITY ? 1.0f : 0.0f));
};

// snippet of_source: Whether a face belongs to a source, by the step along its component's axis.
const auto source = [&](long long q, long long s) {
    return ((kind[q] == SOLID) & (base[q] != SOLID)) |
           ((kind[q - s] == SOLID) & (base[q - s] != SOLID));
};

// kernel fluids.viscosity.distance: Signed distance [cells] of a component's faces from walls that
// liquid may stick to, and the slip length of the wall on faces in one, else -1
//   compute    float32
//   whole      float32 slip
//   box        float32 out, hold, nodes?; int8 kind?; int16 wall?; int32 index?
//   numbers    int axis, planes, walls
//   constants  SOLID, CLOSE, CUT
const int nx = given.out.shape[2], ny = given.out.shape[1], nz = given.out.shape[0];
const long long step[3] = {1, s2, s1}, sa = step[axis], sb = step[axis == 0 ? 1 : 0],
                sc = step[axis == 2 ? 1 : 2];
for (int i = first; i < last; ++i) {
    const int at[3] = {i, j, k}, size[3] = {nx, ny, nz};
    const bool edge = at[axis] == 0;  // nothing is stored below it
    const long long below = edge ? i : i - sa;
    int owner = 0;
    float distance;
    if (CUT) {
        const bool end_b = at[axis == 0 ? 1 : 0] + 1 == size[axis == 0 ? 1 : 0],
                   end_c = planes == 2 && at[axis == 2 ? 1 : 2] + 1 == size[axis == 2 ? 1 : 2];
        const long long up = end_b ? 0 : sb, far = planes == 2 && !end_c ? sc : 0;
        distance = 0.25f * (nodes[i] + nodes[i + up] + nodes[i + far] + nodes[i + up + far]);
        owner = wall[i];
    } else {
        distance = 0.5f;
        owner = index[i] > index[below] ? index[i] : index[below];
    }
    const bool here = kind[i] == SOLID, there = kind[below] == SOLID;  // or a source
    const float whole = here && there ? -0.5f : (here || there ? 0.0f : distance);
    distance = whole < distance ? whole : distance;
    for (int other = 0; other <= planes; ++other) {
        const float x = (float)at[other] - (other == axis ? 1.0f : 0.5f),
                    high = (float)(size[other] - 2) - x;
        if ((walls >> 2 * other & 1) && x < distance) {
            distance = x;
            owner = x > 0.0f ? owner : 0;
        }
        if ((walls >> (2 * other + 1) & 1) && high < distance) {
            distance = high;
            owner = high > 0.0f ? owner : 0;
        }
    }
    const bool solid = distance <= (float)CLOSE;
    out[i] = distance;
    hold[i] = solid ? slip[owner > 0 ? owner : 0] : -1.0f;
}

// kernel fluids.viscosity.weights: Share of cells, edges and faces that the liquid fills, times
// `scale` for cells and edges; see fluids.viscosity. An edge between a body (BODIES) and another
// solid has no stress: a product of their two velocities would stand in no row of the liquid.
//   compute    float32
//   whole      int32 body?
//   box        float32 cell, mixed, xy, xz?, yz?, vx, vy, vz?, dx, dy, dz?, hx, hy, hz?, phi?,
//              thick?, thick_xy?, thick_xz?, thick_yz?; int8 kind, base; uint8 contact; int16
//              wall_x?, wall_y?, wall_z?
//   numbers    int planes; float32 scale
//   constants  AIR, FLUID, SOLID, RELEASED, CLOSE, ALIKE, SLIVER, GHOST, VARIES, BODIES
#include "of_source"
const int nx = given.cell.shape[2] - 2, ny = given.cell.shape[1] - 2, nz = given.cell.shape[0] - 2;
const bool deep = planes == 2;
const float* d[3] = {dx, dy, deep ? dz : dx};
const float* h[3] = {hx, hy, deep ? hz : hx};
float* edge[3] = {xy, deep ? xz : xy, deep ? yz : xy};
float* volume[3] = {vx, vy, deep ? vz : vx};
const long long step[3] = {1, s2, s1};
const auto filled = [&](const long long* cells, int n) {  // mean over some cells
    if (GHOST) {
        float sum = 0.0f;
        for (int c = 0; c < n; ++c) sum += phi[GHOST ? cells[c] : 0];
        return clipped(0.5f - sum / (float)n, 0.0f, 1.0f);
    }
    int open = 0, wet = 0;
    for (int c = 0; c < n; ++c) {
        open += kind[cells[c]] != SOLID;
        wet += kind[cells[c]] == FLUID;
    }
    return open ? (float)wet / (float)open : 0.0f;
};
// Viscosity of the liquid in a cell and on its edges, in units of that in `scale`.
const float* on_edges[3] = {VARIES ? thick_xy : dx, VARIES && deep ? thick_xz : dx,
                            VARIES && deep ? thick_yz : dx};
const auto viscosity = [&](const float* of, long long at) {
    return VARIES && of[VARIES ? at : 0] > 0.0f ? of[VARIES ? at : 0] : 1.0f;
};
const short* wall[3] = {wall_x, wall_y, deep ? wall_z : wall_x};
const auto apart = [&](long long i, int a, int b) {  // whether edge i is between a body and a solid
    if (!BODIES) return false;
    const long long faces[4] = {i, i - step[b], i, i - step[a]};  // two of a, two of b
    int first_owner = -1;
    bool several = false, bodies = false;
    for (int f = 0; f < 4; ++f) {
        const int axis = f < 2 ? a : b;
        const long long q = faces[f];
        if (!(d[axis][q] <= (float)CLOSE)) continue;
        const int nearest = wall[axis][BODIES ? q : 0], number = nearest > 0 ? nearest : 0;
        const bool emits = source(q, step[axis]);
        bodies = bodies || (!emits && body[BODIES ? number : 0] >= 0);
        const int owner = emits ? 1 << 16 : number;
        several = several || (first_owner >= 0 && owner != first_owner);
        first_owner = owner;
    }
    return several && bodies;
};
const auto let_go = [&](long long c) { return (kind[c] == FLUID) & (contact[c] == RELEASED); };
const auto holds = [&](long long c) { return (kind[c] == FLUID) & (contact[c] != RELEASED); };
for (int i = first; i < last; ++i) {
    const bool inside = i >= 1 && i <= nx && j >= 1 && j <= ny && (!deep || (k >= 1 && k <= nz));
    const long long here[1] = {i};
    float share = inside ? filled(here, 1) : 0.0f, walled = 0.0f;
    bool solid = false, sticks = share == 1.0f && holds(i);
    const float own = viscosity(VARIES ? thick : dx, i);
    if (inside)
        for (int axis = 0; axis <= planes; ++axis)
            for (int side = 0; side < 2; ++side) {
                const long long f = i + side * step[axis];
                if (d[axis][f] <= (float)CLOSE) {
                    solid = true;
                    sticks = sticks && h[axis][f] == 0.0f;
                }
            }
    if (solid && sticks) {  // and no edge reaches the surface
        walled = own;
        float least = own, most = own;
        for (int e = 0; e < 2 * planes - 1; ++e)
            for (int corner = 0; corner < 4; ++corner) {
                const long long A = step[e < 2 ? 0 : 1], B = step[e < 1 ? 1 : 2],
                                o = i + (corner & 1) * A + (corner >> 1) * B;
                const long long cells[4] = {o - A - B, o - A, o - B, o};
                if (filled(cells, 4) < 1.0f || apart(o, e < 2 ? 0 : 1, e < 1 ? 1 : 2))
                    walled = 0.0f;
                const float beside = viscosity(on_edges[e], o);
                least = beside < least ? beside : least;
                most = beside > most ? beside : most;
            }
        if (VARIES) walled = most > (float)ALIKE * least || walled == 0.0f ? 0.0f : least;
    }
    cell[i] = scale * (2.0f * share * own - walled);
    mixed[i] = scale * walled;
    for (int axis = 0; axis <= planes; ++axis) {
        const long long cells[2] = {i - step[axis], i};
        const int at = axis == 0 ? i : (axis == 1 ? j : k);
        // the projection gave it no velocity of its own
        const bool airy = kind[cells[0]] == AIR && kind[i] == AIR;
        volume[axis][i] = inside && at > 1 && !airy ? filled(cells, 2) : 0.0f;
    }
    for (int e = 0; e < 2 * planes - 1; ++e) {
        const int a = e < 2 ? 0 : 1, b = e < 1 ? 1 : 2;
        const long long A = step[a], B = step[b], cells[4] = {i - A - B, i - A, i - B, i};
        const long long faces[4] = {i, i - B, i, i - A};  // two of a, two of b
        float factor = 1.0f;
        bool wall = false, released = false, held = false;
        for (int c = 0; c < 4; ++c) {
            released = released || let_go(cells[c]);
            held = held || holds(cells[c]);
        }
        for (int f = 0; f < 4; ++f) {
            const int axis = f < 2 ? a : b;
            const long long q = faces[f], p = faces[f ^ 1];  // of one component
            if (!(d[axis][q] <= (float)CLOSE)) continue;
            wall = true;
            // A link that slip makes longer than 1 has a smaller weight, and so have its products:
            // the remainder is a square.
            const float length = d[axis][p] > (float)CLOSE
                                     ? (d[axis][p] + h[axis][q]) / (d[axis][p] - d[axis][q])
                                     : 1.0f;
            factor =
                !(h[axis][q] < INFINITY) ? 0.0f : (length * factor > 1.0f ? 1.0f / length : factor);
        }
        const float thickness = factor * scale * viscosity(on_edges[e], i);
        const bool free = wall && (released || !held || apart(i, a, b));
        const float part = filled(cells, 4);
        edge[e][i] = free || part < (float)SLIVER ? 0.0f : thickness * part;
    }
}

// kernel fluids.viscosity.diagonal: Diagonal of a component's rows, 0 where there is no unknown;
// what walls add to it; and for faces in a wall whether it holds, else -1
//   compute    float32
//   box        float32 diagonal, drag, held, d, h, cell, xb, xc?, volume, thin?; int8 kind;
//              uint8 contact
//   numbers    int axis, planes
//   constants  FLUID, RELEASED, CLOSE, THETA, ALONG, CUT, THIN
#include "viscous_walls"
const int nx = given.d.shape[2] - 2, ny = given.d.shape[1] - 2, nz = given.d.shape[0] - 2;
for (int i = first; i < last; ++i) {
    const int at = axis == 0 ? i : (axis == 1 ? j : k);
    diagonal[i] = drag[i] = 0.0f;
    held[i] = -1.0f;
    if (solid(d, i)) {  // head on where a cell beside it is liquid
        const bool here = kind[i] == FLUID, below = kind[i - sa] == FLUID;
        const bool holds = (here && contact[i] != RELEASED) ||
                           (below && contact[i - sa] != RELEASED) ||
                           (!here && !below && h[i] < INFINITY);
        held[i] = holds ? 1.0f : 0.0f;
    }
    if (at == 1 || solid(d, i) || i > nx || j > ny || (deep && k > nz)) continue;
    float free = volume[i], wall = 0.0f;
    const auto link = [&](long long q, long long c) {
        if (solid(d, q))
            wall += head_on(i, q, c);
        else
            free += cell[c];
    };
    const auto side = [&](long long q, float weight) {
        if (solid(d, q))
            wall += beside(i, q, weight);
        else
            free += weight;
    };
    link(i + sa, i);
    link(i - sa, i - sa);
    side(i + sb, xb[i + sb]);
    side(i - sb, xb[i]);
    if (deep) {
        side(i + sc, xc[i + sc]);
        side(i - sc, xc[i]);
    }
    if (THIN) wall += thin[THIN ? i : 0];
    drag[i] = wall;
    diagonal[i] = free + wall;
}

// kernel fluids.viscosity.force: Viscous force on a component in a step, minus what it has done
// already: r = -K u - V (u - u1); sums over it
//   compute    float32
//   whole      float32 turn?, shift?
//   box        float32 r, diagonal, u, ub, uc?, d, h, db, dc?, cell, mixed, xb, xc?, volume,
//              change?, own?, solid_b?, solid_c?, thin?, thin_speed?; int8 kind; uint8 contact;
//              int16 wall?; int8 base
//   numbers    int axis, planes, before_x, before_y, before_z; float32 dx
//   sums       residual, taken, given_by_walls, stiff
//   constants  FLUID, SOLID, RELEASED, CLOSE, THETA, ALONG, CUT, MOVING, THIN
#include "viscous_walls"
double lost = 0, driven = 0, square = 0, large = 0;
const auto wall_speed = [&](const float* of, long long i) {
    return MOVING ? (double)of[MOVING ? i : 0] : 0.0;
};
#include "of_source"
// velocity of the wall at the end of the link from i to q along an axis
const auto met = [&](int i, long long q, int other, int side) {
    if (source(q, sa)) return (double)u[q];
    if (!MOVING || !turn) return wall_speed(own, q);
    double x[3] = {i + before_x - 0.5, j + before_y - 0.5, planes == 2 ? k + before_z - 0.5 : 0.0};
    x[axis] -= 0.5;
    x[other] += side * (double)end_of(i, q);
    const int solid = wall[q] > 0 ? wall[q] : 0;
    const float* row = turn + 9 * solid + 3 * axis;
    return dx * (row[0] * x[0] + row[1] * x[1] + row[2] * x[2]) + shift[3 * solid + axis];
};
const auto velocity = [&](const float* u, const float* distance, const float* of, long long i,
                          long long s) {
    return distance[i] <= (float)CLOSE && !source(i, s) ? wall_speed(of, i) : (double)u[i];
};
for (int i = first; i < last; ++i) {
    if (!(diagonal[i] > 0.0f)) {
        r[i] = 0.0f;
        continue;
    }
    const double here = u[i];
    double force = 0.0, power = 0.0;
    const auto pull = [&](long long q, double weight, int other, int side) {
        const double w = met(i, q, other, side);
        force += weight * (w - here);
        power += weight * (w - here) * w;
    };
    const auto link = [&](long long q, long long c, int to) {
        if (solid(d, q))
            pull(q, head_on(i, q, c), axis, to);
        else
            force += cell[c] * (u[q] - here);
    };
    const auto side = [&](long long q, float weight, int other, int to) {
        if (solid(d, q))
            pull(q, beside(i, q, weight), other, to);
        else
            force += weight * (u[q] - here);
    };
    const auto mix = [&](const float* v, const float* distance, const float* of, const float* x,
                         long long s) {
        force -= (x[i] - mixed[i]) * velocity(v, distance, of, i, s) -
                 (x[i] - mixed[i - sa]) * velocity(v, distance, of, i - sa, s) -
                 (x[i + s] - mixed[i]) * velocity(v, distance, of, i + s, s) +
                 (x[i + s] - mixed[i - sa]) * velocity(v, distance, of, i + s - sa, s);
    };
    link(i + sa, i, 1);
    link(i - sa, i - sa, -1);
    side(i + sb, xb[i + sb], first_other, 1);
    side(i - sb, xb[i], first_other, -1);
    mix(ub, db, solid_b, xb, sb);
    if (deep) {
        side(i + sc, xc[i + sc], last_other, 1);
        side(i - sc, xc[i], last_other, -1);
        mix(uc, dc, solid_c, xc, sc);
    }
    if (THIN) {  // solids thinner than cells between this face and the next ones across
        const double w = thin_speed[THIN ? i : 0], weight = thin[THIN ? i : 0];
        force += weight * (w - here);
        power += weight * (w - here) * w;
    }
    const double rest = force - (change ? (double)volume[i] * change[i] : 0.0);
    r[i] = (float)rest;
    square += rest * rest;
    large += (double)diagonal[i] * diagonal[i];
    lost -= here * force;
    driven += power;
}
residual = square;
taken = lost;
given_by_walls = driven;
stiff = large;

// kernel fluids.viscosity.links: Coupling of a component's faces to solids. For each link: its
// weight, or that of a product with a face in the solid, times the velocities of the solid's unit
// motions at the end of the link, or at that face. Without `entry_rows`: number of links in each
// row. Faces of sources have their own velocity, not that of a solid.
//   compute    float32
//   whole      int32 counts, offsets?, entry_rows?, blocks?, body; float64 values?, center
//   box        float32 d, h, db, dc?, cell, mixed, xb, xc?, diagonal; int8 kind; uint8 contact;
//              int16 wall?, wall_b?, wall_c?; int32 index?; int8 base
//   numbers    int axis, planes, before_x, before_y, before_z; float32 dx; int width, from_
//   constants  FLUID, SOLID, RELEASED, CLOSE, THETA, ALONG, CUT
#include "viscous_walls"
#include "of_source"
const int begin = entry_rows ? offsets[k * (int)(s1 / s2) + j] : 0;
int e = begin;
const auto owner = [&](const short* walls, long long q, long long s) {  // of a face
    if (source(q, s)) return -1;
    const int solid = CUT ? walls[CUT ? q : 0]
                          : (index[CUT ? 0 : q] > index[CUT ? 0 : q - s] ? index[CUT ? 0 : q]
                                                                         : index[CUT ? 0 : q - s]);
    return solid >= 0 ? body[solid] : -1;
};
const auto enter = [&](int i, int number, double weight, int along, double x, double y, double z) {
    if (entry_rows) {
        const double* o = center + 3 * number;
        const double r[3] = {dx * x - o[0], dx * y - o[1], planes == 2 ? dx * z - o[2] : 0.0};
        double* moves = values + (long long)e * width;
        for (int m = 0; m < width; ++m) moves[m] = 0.0;
        moves[along] = weight;
        // (w x r) along the axis is w[a1] r[a2] - w[a2] r[a1]
        const int a1 = (along + 1) % 3, a2 = (along + 2) % 3;
        if (planes == 1)
            moves[2] = weight * (along == 0 ? -r[1] : r[0]);
        else {
            moves[3 + a1] = weight * r[a2];
            moves[3 + a2] = -weight * r[a1];
        }
        entry_rows[e] = from_ + (int)((k * (s1 / s2) + j) * s2) + i;
        blocks[e] = number;
    }
    ++e;
};
for (int i = first; i < last; ++i) {
    if (!(diagonal[i] > 0.0f)) continue;
    const double low[3] = {i + before_x - 0.5, j + before_y - 0.5, k + before_z - 0.5};
    for (int n = 0; n < 2 * planes + 2; ++n) {
        const int other = n >> 1, to = 2 * (n & 1) - 1;
        const long long q = i + to * step[other];
        const int number = solid(d, q) ? owner(wall, q, sa) : -1;
        if (number < 0) continue;
        const float* across = other == first_other ? xb : xc;
        const double weight = other == axis ? head_on(i, q, to > 0 ? i : i - sa)
                                            : beside(i, q, across[to > 0 ? i + step[other] : i]);
        double x[3] = {low[0], low[1], low[2]};
        x[axis] -= 0.5;
        x[other] += to * (double)end_of(i, q);
        if (weight > 0.0) enter(i, number, weight, axis, x[0], x[1], x[2]);
    }
    for (int n = 0; n < 4 * planes; ++n) {
        const int other = n < 4 ? first_other : last_other, up = n >> 1 & 1, back = n & 1;
        const float* distance = n < 4 ? db : dc;
        const short* walls = n < 4 ? wall_b : wall_c;
        const float* x_ = n < 4 ? xb : xc;
        const long long q = i + up * step[other] - back * sa;
        const int number = distance[q] <= (float)CLOSE ? owner(walls, q, step[other]) : -1;
        const double weight = (up ? 1.0 : -1.0) * (back ? -1.0 : 1.0) *
                              (x_[i + up * step[other]] - mixed[back ? i - sa : i]);
        if (number < 0 || weight == 0.0) continue;
        double x[3] = {low[0], low[1], low[2]};
        x[axis] -= back;
        x[other] += up - 0.5;
        enter(i, number, weight, other, x[0], x[1], x[2]);
    }
}
counts[k * (int)(s1 / s2) + j] = e - begin;

// kernel fluids.viscosity.cover: Faces in a wall that are partly open, so that the pressure has
// moved them, take the velocity of the wall that holds them
//   compute    float32
//   box        float32 total, u, hold, h, own?; int8 kind, base
//   numbers    int axis
//   constants  SOLID, MOVING
const long long step = axis == 0 ? 1 : (axis == 1 ? s2 : s1);
SIMD for (int i = first; i < last; ++i) {
    const float speed = MOVING ? own[MOVING ? i : 0] : 0.0f;
    const bool source = ((kind[i] == SOLID) & (base[i] != SOLID)) |
                        ((kind[i - step] == SOLID) & (base[i - step] != SOLID));
    const bool stays = (hold[i] > 0.0f) & (h[i] < INFINITY) & !source;
    total[i] = stays ? speed - u[i] : total[i];
}

// kernel fluids.viscosity.add: Add the solution of a solve to a component and to its total change
//   compute    float32
//   box        float32 u, total, more
SIMD for (int i = first; i < last; ++i) {
    u[i] += more[i];
    total[i] += more[i];
}

// kernel fluids.viscosity.sum: Saved velocity plus the viscous change: u = kept + more
//   compute    float32
//   box        float32 u, kept, more
SIMD for (int i = first; i < last; ++i) u[i] = kept[i] + more[i];
