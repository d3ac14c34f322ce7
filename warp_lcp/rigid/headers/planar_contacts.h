// Contacts of bodies in a plane, see `rigid/planar_contacts.py`: the loops of
// `ContactDetection.find` and `ContactSolve.assembled`, equal to the last bit.

// snippet distances: Signed distances of points to shapes, and outward directions. A shape is SHAPE
// numbers: kind, radius, size, points, whether it is a ball; its bounds; its points. Then, of a
// round shape: start, axis, square of the axis, a direction across it, and a length that counts as
// 0. Of a box: center, axes, half sides, and that length. `rows`: number of points that NumPy has
// in the same product, which decides the rounding.
enum { ROUND, BOX, MOST = 64 };
struct Touch {
    int count;
    double point[MOST][3], normal[MOST][3], gap[MOST];
};
// p R' + t
const auto carried = [&](const double* R, const double* t, int rows, const double* p, double* q) {
    for (int i = 0; i < 3; ++i)
        q[i] = (rows == 1 ? across(R + 3 * i, p) : along(p, 1, R + 3 * i, 1)) + t[i];
};
const auto turned = [&](const double* R, int rows, const double* p, double* q) {  // p R'
    for (int i = 0; i < 3; ++i) q[i] = rows == 1 ? across(R + 3 * i, p) : along(p, 1, R + 3 * i, 1);
};
const auto difference = [](const double* a, const double* b, double* c) {
    for (int i = 0; i < 3; ++i) c[i] = a[i] - b[i];
};
const auto distance_of = [&](const double* shape, int rows, const double* p, double* direction) {
    double d[3];
    const double* from = shape + 39;
    difference(p, from, d);
    if (shape[0] == ROUND) {
        const double *axis = from + 3, square = from[6], *aside = from + 7, none = from[10];
        double share = 0.0;
        if (square != 0.0) {
            share = (rows == 1 ? along(d, 1, axis, 1) : across(d, axis)) / square;
            share = share > 0.0 ? share : 0.0;
            share = share < 1.0 ? share : 1.0;
        }
        for (int i = 0; i < 3; ++i) d[i] -= share * axis[i];
        const double far = length(d);
        for (int i = 0; i < 3; ++i) direction[i] = far <= none ? aside[i] : d[i] / far;
        return far - shape[1];
    }
    const double *R = from + 3, *half = from + 12, none = from[15];
    double local[2], beyond[2], out[2], way[2];
    for (int i = 0; i < 2; ++i) {
        local[i] = along(d, 1, R + i, 3);
        beyond[i] = fabs(local[i]) - half[i];
        out[i] = beyond[i] > 0.0 ? beyond[i] : 0.0;
    }
    const int deepest = beyond[1] > beyond[0];
    const double far = sqrt(out[0] * out[0] + out[1] * out[1]);
    const bool inside = far <= none;
    for (int i = 0; i < 2; ++i)
        way[i] =
            (inside ? (i == deepest ? 1.0 : 0.0) : out[i] / far) * (local[i] < 0.0 ? -1.0 : 1.0);
    for (int i = 0; i < 3; ++i) {
        const double* r = R + 3 * i;
        direction[i] =
            (rows == 1 ? fused(way[0], r[0], way[1] * r[1]) : fused(way[1], r[1], way[0] * r[0])) +
            0.0;
    }
    return inside ? beyond[deepest] : far;
};

// snippet points: Points of one shape that are near another one, or near a plane; `sign` = -1
// reverses normals.
const auto add = [](Touch& touch, const double* p, const double* normal, double gap, double depth,
                    double sign) {
    if (touch.count >= MOST) return;
    for (int i = 0; i < 3; ++i) {
        touch.point[touch.count][i] = p[i] - depth * normal[i];
        touch.normal[touch.count][i] = sign * normal[i];
    }
    touch.gap[touch.count++] = gap;
};
const auto points_of = [&](const double* one, const double* R, const double* t, const double* other,
                           const double* S, const double* u, double margin, double sign,
                           Touch& touch) {
    const int points = (int)one[3];
    const double radius = one[1], reach = margin + radius;
    double at[9][3], local[9][3], way[9][3], gap[9], d[3], normal[3];
    int rows = 0, near = 0;
    for (int c = 0; c < points; ++c) {
        carried(R, t, points, one + 12 + 3 * c, at[rows]);
        difference(at[rows], u, d);
        bool kept = true;
        for (int i = 0; i < 3; ++i) {
            const double x = local[rows][i] = along(d, 1, S + i, 3);
            kept &= points == 1 || (x >= other[6 + i] - reach && x <= other[9 + i] + reach);
        }
        rows += kept;
    }
    for (int c = 0; c < rows; ++c) {
        gap[c] = distance_of(other, rows, local[c], way[c]) - radius;
        near += gap[c] <= margin;
    }
    for (int c = 0; c < rows; ++c)
        if (gap[c] <= margin) {
            turned(S, near, way[c], normal);
            add(touch, at[c], normal, gap[c], radius + 0.5 * gap[c], sign);
        }
};
const auto on_plane = [&](const double* shape, const double* R, const double* t,
                          const double* point, const double* normal, double margin, Touch& touch) {
    const int points = (int)shape[3];
    double at[3], d[3];
    for (int c = 0; c < points; ++c) {
        carried(R, t, points, shape + 12 + 3 * c, at);
        difference(at, point, d);
        const double gap = (points == 1 ? along(d, 1, normal, 1) : across(d, normal)) - shape[1];
        if (gap <= margin) add(touch, at, normal, gap, shape[1] + 0.5 * gap, 1.0);
    }
};

// snippet boxes: Contact points of two boxes by the axis of least overlap, see `box_contacts.py`.
// Both boxes are thick along z. Returns false if edges touch, which does not occur in a plane.
const auto box_on_box = [&](const double* a, const double* Ra, const double* ta, const double* b,
                            const double* Rb, const double* tb, double margin, Touch& touch) {
    double center[2][3], R[2][9], half[2][3], between[3], axes[15][3], apart[15], off[15];
    const double *shapes[2] = {a, b}, *turns[2] = {Ra, Rb}, *shifts[2] = {ta, tb};
    const double thick = a[53] > b[53] ? a[53] : b[53];
    for (int m = 0; m < 2; ++m) {
        carried(turns[m], shifts[m], 1, shapes[m] + 39, center[m]);
        product(turns[m], shapes[m] + 42, R[m]);
        for (int i = 0; i < 3; ++i) half[m][i] = i == 2 ? thick : shapes[m][51 + i];
    }
    difference(center[0], center[1], between);
    int count = 6;
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k) {
            axes[i][k] = R[0][3 * k + i];
            axes[3 + i][k] = R[1][3 * k + i];
        }
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            const double *p = axes[i], *q = axes[3 + j];
            double c[3], square;
            for (int k = 0; k < 3; ++k) {
                const int l = (k + 1) % 3, m = (k + 2) % 3;
                c[k] = p[l] * q[m] - p[m] * q[l];
            }
            square = (c[0] * c[0] + c[1] * c[1]) + c[2] * c[2];
            if (!(square > PARALLEL)) continue;
            for (int k = 0; k < 3; ++k) axes[count][k] = c[k] / sqrt(square);
            ++count;
        }
    double most = 0.0, least = half[0][0];
    int face = 0, edge = 6;
    for (int n = 0; n < count; ++n) {
        double reach[2], turned_axis[3];
        off[n] = across(axes[n], between);
        for (int m = 0; m < 2; ++m) {
            for (int i = 0; i < 3; ++i) turned_axis[i] = fabs(along(axes[n], 1, R[m] + i, 3));
            reach[m] = across(turned_axis, half[m]);
        }
        apart[n] = (fabs(off[n]) - reach[0]) - reach[1];
        most = n == 0 || apart[n] > most ? apart[n] : most;
        if (n < 6 && apart[n] > apart[face]) face = n;
        if (n >= 6 && apart[n] > apart[edge]) edge = n;
    }
    if (most > margin) return true;
    for (int m = 0; m < 2; ++m)
        for (int i = 0; i < 3; ++i) least = half[m][i] < least ? half[m][i] : least;
    if (count > 6 && apart[edge] > apart[face] + FACE_FIRST * least) return false;
    const int r = face < 3 ? 0 : 1, s = 1 - r, axis = face % 3;
    const double sign = face < 3 ? -1.0 : 1.0;
    double toward[3], outward[3], facing[3], polygon[2][16][3], heights[16];
    difference(center[s], center[r], toward);
    const double side = along(axes[face], 1, toward, 1),
                 way = side > 0.0 ? 1.0 : (side < 0.0 ? -1.0 : 1.0);
    for (int i = 0; i < 3; ++i) outward[i] = axes[face][i] * way;
    apply_transposed(R[s], outward, facing);
    int k = 0;
    for (int i = 1; i < 3; ++i)
        if (fabs(facing[i]) > fabs(facing[k])) k = i;
    const int i1 = (k + 1) % 3, i2 = (k + 2) % 3;
    const double depth = (facing[k] > 0.0 ? 1.0 : (facing[k] < 0.0 ? -1.0 : 0.0)) * half[s][k];
    int corners = 4, now = 0;
    for (int i = 0; i < 3; ++i) {
        const double c = center[s][i] - depth * R[s][3 * i + k], u = half[s][i1] * R[s][3 * i + i1],
                     v = half[s][i2] * R[s][3 * i + i2];
        polygon[0][0][i] = (c + u) + v;
        polygon[0][1][i] = (c - u) + v;
        polygon[0][2][i] = (c - u) - v;
        polygon[0][3][i] = (c + u) - v;
    }
    for (int turn = 0; turn < 4; ++turn) {
        const int about = (axis + 1 + turn / 2) % 3;
        double plane[3];
        for (int i = 0; i < 3; ++i) plane[i] = (turn % 2 ? -1.0 : 1.0) * R[r][3 * i + about];
        const double offset = along(plane, 1, center[r], 1) + half[r][about],
                     tiny = 1e-12 * (1.0 + fabs(offset));
        for (int n = 0; n < corners; ++n) heights[n] = along(plane, 1, polygon[now][n], 1) - offset;
        int kept = 0;
        for (int n = 0; n < corners; ++n) {
            const double *p = polygon[now][n], *q = polygon[now][(n + 1) % corners], h = heights[n],
                         next = heights[(n + 1) % corners];
            if (h <= tiny) {
                for (int i = 0; i < 3; ++i) polygon[1 - now][kept][i] = p[i];
                ++kept;
            }
            if ((h > tiny && next < -tiny) || (h < -tiny && next > tiny)) {
                for (int i = 0; i < 3; ++i)
                    polygon[1 - now][kept][i] = p[i] + h / (h - next) * (q[i] - p[i]);
                ++kept;
            }
        }
        corners = kept;
        now = 1 - now;
    }
    double normal[3];
    for (int i = 0; i < 3; ++i) normal[i] = sign * outward[i];
    for (int n = 0; n < corners; ++n) {
        double d[3], *p = polygon[now][n];
        difference(p, center[r], d);
        const double gap =
            (corners == 1 ? along(d, 1, outward, 1) : across(d, outward)) - half[r][axis];
        if (!(gap <= margin)) continue;
        for (int i = 0; i < 3; ++i) p[i] -= 0.5 * gap * outward[i];
        if (!(p[2] > 0.0)) continue;
        p[2] = 0.0;
        add(touch, p, normal, gap, 0.0, 1.0);
    }
    return true;
};

// snippet spread: The deepest point and others far from it, in their order in `chosen`; see
// `spread`.
const auto spread = [&](const Touch& touch, double size, int* chosen) {
    const int n = touch.count;
    if (n < 2) {
        chosen[0] = 0;
        return n;
    }
    double way[MOST], side[MOST], above[MOST], d[3];
    int count = 0, following = 0;
    for (int k = 1; k < n; ++k)
        if (touch.gap[k] < touch.gap[following]) following = k;
    for (int k = 0; k < n; ++k) above[k] = touch.gap[k] - touch.gap[following];
    const auto choose = [&](int which) {
        for (int k = 0; k < n; ++k) {
            difference(touch.point[k], touch.point[which], d);
            const double w = length(d);
            difference(touch.normal[k], touch.normal[which], d);
            const double s = length(d);
            way[k] = count && way[k] < w ? way[k] : w;
            side[k] = count && side[k] < s ? side[k] : s;
        }
        chosen[count++] = which;
    };
    choose(following);
    for (int turn = 0; turn < 2; ++turn) {
        const double lower = turn ? MUCH_LOWER : LOWER;
        const int flat = turn ? FLAT + MORE : FLAT;
        double highest = above[chosen[0]];
        for (int c = 1; c < count; ++c)
            highest = above[chosen[c]] > highest ? above[chosen[c]] : highest;
        while (count < MOST_OF_PAIR) {
            double best = -INFINITY;
            following = -1;
            for (int k = 0; k < n; ++k) {
                if (turn && !(above[k] < highest - LEVEL * size)) continue;
                if (!(side[k] > OTHER_SIDE || (way[k] > SAME * size && count < flat))) continue;
                const double value = (way[k] + size * side[k]) - lower * above[k];
                if (following < 0 || value > best) {
                    best = value;
                    following = k;
                }
            }
            if (following < 0) break;
            choose(following);
        }
    }
    return count;
};

// kernel warp_lcp.rigid.planar_contacts.find: Contacts of a step with their rows. `reals` holds, of
// the bodies, values, masses, inverse inertias, centers, middles of bounds, half sizes of these
// without radius, reaches, frictions, restitutions and shapes. Of each obstacle it holds the margin
// and either `planes` points and normals, or a shape, rotation, translation, middle and half size
// of its bounds. Then come work and, field by field, `capacity` contacts. `indices` holds each
// obstacle's number of planes, -1 for a shape. `total`: number of contacts; -1: this loop cannot
// find them.
//   compute    float64
//   whole      float64 reals; int32 indices
//   box        float64 total
//   numbers    int count, obstacles, length_of_obstacles, capacity; float64 dt, falls, near, AHEAD,
//              ON_SURFACE, PARALLEL, FACE_FIRST, LOWER, MUCH_LOWER, LEVEL, SAME, OTHER_SIDE;
//              int FLAT, MORE, MOST_OF_PAIR
EXACT_MATH
#include "snippets.h:algebra"
#include "motion.h:spins"
#include "distances"
#include "points"
#include "boxes"
#include "spread"
enum { SHAPE = 55 };
const int n = count;
const double *values = reals, *mass = values + 26 * n, *inverse = mass + n,
             *centers = inverse + 9 * n, *middles = centers + 3 * n;
const double *halves = middles + 3 * n, *reaches = halves + 3 * n, *frictions = reaches + n,
             *restitutions = frictions + n;
const double *shapes = restitutions + n, *obstacle = shapes + SHAPE * n;
double *ways = reals + (48 + SHAPE) * n + length_of_obstacles, *shifts = ways + n,
       *middle = shifts + 3 * n, *half = middle + 3 * n;
double* out = half + 3 * n;
double *o_first = out, *o_second = o_first + capacity, *o_obstacle = o_second + capacity,
       *o_point = o_obstacle + capacity;
double *o_normal = o_point + 3 * capacity, *o_gap = o_normal + 3 * capacity,
       *o_frames = o_gap + capacity, *o_one = o_frames + 6 * capacity;
double *o_other = o_one + 6 * capacity, *o_wall = o_other + 6 * capacity,
       *o_target = o_wall + 2 * capacity, *o_friction = o_target + capacity;
double *o_restitution = o_friction + capacity, *o_size = o_restitution + capacity;
int found = 0;
bool known = true;
const auto emit = [&](int i, int j, int which, const double* p, const double* normal, double gap) {
    const int k = found++;
    if (k >= capacity) {
        known = false;
        return;
    }
    const bool standing = j == n;
    const int partner = standing ? i : j;
    const double frames[2][3] = {{normal[0], normal[1], normal[2]}, {-normal[1], normal[0], 0.0}};
    double mine[3], others[3];
    const double nowhere[3] = {0.0, 0.0, 0.0};
    difference(p, values + 26 * i, mine);
    difference(p, standing ? nowhere : values + 26 * j, others);
    o_first[k] = i;
    o_second[k] = j;
    o_obstacle[k] = which;
    o_gap[k] = gap;
    for (int a = 0; a < 3; ++a) {
        o_point[3 * k + a] = p[a];
        o_normal[3 * k + a] = normal[a];
    }
    for (int r = 0; r < 2; ++r) {
        const double* f = frames[r];
        double *one = o_one + 6 * k + 3 * r, *other = o_other + 6 * k + 3 * r;
        for (int a = 0; a < 3; ++a) o_frames[6 * k + 3 * r + a] = f[a];
        one[0] = f[0];
        one[1] = f[1];
        one[2] = mine[0] * f[1] - mine[1] * f[0];
        other[0] = standing ? 0.0 : -f[0];
        other[1] = standing ? 0.0 : -f[1];
        other[2] = standing ? 0.0 : -(others[0] * f[1] - others[1] * f[0]);
        o_wall[2 * k + r] = -0.0;
    }
    o_target[k] = -(gap > 0.0 ? gap : 0.0) / dt;
    o_friction[k] = sqrt(frictions[i] * frictions[partner]);
    o_restitution[k] =
        restitutions[i] > restitutions[partner] ? restitutions[i] : restitutions[partner];
    const double a = shapes[SHAPE * i + 2], b = shapes[SHAPE * partner + 2];
    o_size[k] = a < b ? a : b;
};
const auto emit_spread = [&](int i, int j, int which, const Touch& touch, double size) {
    int chosen[MOST + 8];
    if (touch.count >= MOST) known = false;
    const int kept = spread(touch, size, chosen);
    for (int c = 0; c < kept; ++c)
        emit(i, j, which, touch.point[chosen[c]], touch.normal[chosen[c]], touch.gap[chosen[c]]);
};
const auto between = [&](const double* one, const double* R, const double* t, const double* other,
                         const double* S, const double* u, double margin, Touch& touch) {
    touch.count = 0;
    if (one[0] == BOX && other[0] == BOX) {
        known &= box_on_box(one, R, t, other, S, u, margin, touch);
        return;
    }
    const bool first_alone = one[3] == 1.0, second_alone = other[3] == 1.0;
    if (!second_alone || first_alone) points_of(one, R, t, other, S, u, margin, 1.0, touch);
    if (!first_alone) points_of(other, S, u, one, R, t, margin, -1.0, touch);
};
for (int i = 0; i < n; ++i) {
    const double *R = values + 26 * i + 3, *momentum = values + 26 * i + 12;
    double w[3], v[3], absolute[9];
    spin_of(R, inverse + 9 * i, momentum + 3, w);
    for (int a = 0; a < 3; ++a) v[a] = momentum[a] / mass[i];
    ways[i] = AHEAD * dt * ((length(v) + length(w) * reaches[i]) + falls);
    apply(R, centers + 3 * i, v);
    for (int a = 0; a < 3; ++a) shifts[3 * i + a] = values[26 * i + a] - v[a];
    apply(R, middles + 3 * i, v);
    for (int a = 0; a < 9; ++a) absolute[a] = fabs(R[a]);
    apply(absolute, halves + 3 * i, w);
    for (int a = 0; a < 3; ++a) {
        middle[3 * i + a] = v[a] + shifts[3 * i + a];
        half[3 * i + a] = w[a] + shapes[SHAPE * i + 1];
    }
}
Touch touch;
for (int o = 0; o < obstacles; ++o) {
    const int planes = indices[o];
    const double more = obstacle[0], *points = obstacle + 1, *normals = points + 3 * planes;
    const double *S = points + SHAPE, *u = S + 9, *center = u + 3, *reach = center + 3;
    for (int i = 0; i < n; ++i) {
        const double *shape = shapes + SHAPE * i, *R = values + 26 * i + 3, *t = shifts + 3 * i,
                     *c = middle + 3 * i, margin = ways[i] + more;
        if (planes < 0) {
            double apart = -INFINITY;
            for (int a = 0; a < 3; ++a) {
                const double d = (fabs(c[a] - center[a]) - half[3 * i + a]) - reach[a];
                apart = d > apart ? d : apart;
            }
            if (!(apart <= margin)) continue;
            between(shape, R, t, points, S, u, margin, touch);
            emit_spread(i, n, o, touch, shape[2] < points[2] ? shape[2] : points[2]);
            continue;
        }
        for (int m = 0; m < planes; ++m) {
            const double *p = points + 3 * m, *normal = normals + 3 * m;
            double absolute[3], place[3];
            for (int a = 0; a < 3; ++a) absolute[a] = fabs(normal[a]);
            const bool rows = (n > 1) == (planes > 1);  // the form of NumPy's product
            const double level = (p[0] * normal[0] + p[1] * normal[1]) + p[2] * normal[2];
            const double height = (rows ? along(c, 1, normal, 1) : across(c, normal)) - level;
            if (!(height - (rows ? along(half + 3 * i, 1, absolute, 1)
                                 : across(half + 3 * i, absolute)) <=
                  margin))
                continue;
            if (shape[4] != 0.0) {
                const double gap = height - shape[1];
                if (!(gap <= margin)) continue;
                for (int a = 0; a < 3; ++a) place[a] = c[a] - (shape[1] + 0.5 * gap) * normal[a];
                emit(i, n, o, place, normal, gap);
                continue;
            }
            touch.count = 0;
            on_plane(shape, R, t, p, normal, margin, touch);
            emit_spread(i, n, o, touch, shape[2]);
        }
    }
    obstacle += 1 + (planes < 0 ? SHAPE + 18 : 6 * planes);
}
for (int i = 0; i < n; ++i)
    for (int j = 0; j < i; ++j) {
        const double *one = shapes + SHAPE * i, *other = shapes + SHAPE * j, *c = middle + 3 * i,
                     *d = middle + 3 * j;
        bool overlap = true;
        for (int a = 0; a < 3; ++a) {
            const double h = (half[3 * i + a] + ways[i]) + 0.5 * near,
                         g = (half[3 * j + a] + ways[j]) + 0.5 * near;
            overlap &= c[a] - h <= d[a] + g && d[a] - g <= c[a] + h;
        }
        if (!overlap) continue;
        const double margin = (near + ways[i]) + ways[j];
        double way[3], place[3], normal[3];
        difference(c, d, way);
        const double far = length(way);
        if (one[4] != 0.0 && other[4] != 0.0 && far > ON_SURFACE * other[1]) {
            const double gap = (far - other[1]) - one[1];
            if (!(gap <= margin)) continue;
            for (int a = 0; a < 3; ++a) {
                normal[a] = way[a] / far;
                place[a] = c[a] - (one[1] + 0.5 * gap) * normal[a];
            }
            emit(i, j, -1, place, normal, gap);
            continue;
        }
        between(one, values + 26 * i + 3, shifts + 3 * i, other, values + 26 * j + 3,
                shifts + 3 * j, margin, touch);
        emit_spread(i, j, -1, touch, one[2] < other[2] ? one[2] : other[2]);
    }
for (int t = first; t < last; ++t) total[t] = known ? found : -1;
