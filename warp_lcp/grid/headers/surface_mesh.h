// Kernels of the liquid surface in pictures.

// kernel warp_lcp.grid.surface_mesh.room: Distance to the solids [lattice cells] at a row of
// lattice cells, from the distance at the grid's nodes
//   compute    float32
//   whole      float32 distance
//   box        float32 out
//   numbers    int planes, parts
const int ny = given.distance.shape[1], nx = given.distance.shape[2];
const long long s2 = nx, s1 = s2 * ny;
const float scale = (float)parts, step = 1.0f / scale;
// Stored cell that contains the center of a lattice cell, and the position in it.
auto cell = [&](int fine, float& f) {
    const float x = ((float)fine - 0.5f) * step + 1.0f;
    const int c = (int)x;
    f = x - (float)c;
    return c;
};
float fx, fy, fz = 0;
const int cy = cell(j, fy), cz = planes == 2 ? cell(k, fz) : 1;
const float* d = distance + cz * s1 + cy * s2;
const long long up = planes == 2 ? s1 : 0;
for (int i = first; i < last; ++i) {
    const int c = cell(i, fx);
    auto along = [&](const float* row) { return row[c] + fx * (row[c + 1] - row[c]); };
    const float low = along(d) + fy * (along(d + s2) - along(d)),
                high = along(d + up) + fy * (along(d + up + s2) - along(d + up));
    out[i] = scale * (low + fz * (high - low));
}

// kernel warp_lcp.grid.surface_mesh.boost: Add to the kernels of particles in thin material: the
// thinner, the more, by gain (sqrt(THIN / fullness) - 1) if fullness < THIN. The fullness at a
// particle is share + spread |grad share|, from the smoothed share. At a plane surface the gradient
// makes up for the missing half; in the middle of a sheet, a filament or a drop it is 0. Share and
// gradient are interpolated, so that the surface does not depend on where the particles lie between
// the lattice's nodes. Most particles end at the share of their own lattice cell, CROWDED.
//   compute    float32
//   whole      float32 smooth, capacity?, thin
//   box        vec3 position
//   numbers    int planes; float32 dx, inverse_dx; int before_x, before_y, before_z; float32 each,
//              gain, most, spread
//   constants  LEAST_OPEN, THIN, CROWDED
//   ordered
#include "particles.h:origin"
#include "particles.h:weigh"
#include "particles.h:add"
const T* position = (const T*)given.position.data;
const int nx = given.thin.shape[2] - 2, ny = given.thin.shape[1] - 2, nz = given.thin.shape[0] - 2;
const long long s2 = nx + 2, s1 = s2 * (ny + 2);
auto open_share = [&](T open) { return open > (T)LEAST_OPEN ? open : (T)LEAST_OPEN; };
for (long long p = first; p < last; ++p) {
    auto cell = [&](int axis, int n) {
        const T x = grid_coordinate(position[3 * p + axis], origin[axis]), from = x > 1 ? x : (T)1,
                e = n;
        return (int)(from < e ? from : e);
    };
    const int i = cell(0, nx), j = cell(1, ny), k = planes == 2 ? cell(2, nz) : 1;
    const long long at = k * s1 + j * s2 + i;
    if (smooth[at] >= (T)CROWDED * (capacity ? open_share(capacity[at]) : (T)1)) continue;
    T wx[3], wy[3], wz[3] = {0, 1, 0}, gx[3], gy[3], gz[3] = {0, 0, 0};
    // Weights of a quadratic B-spline along an axis, and their derivatives: with a = sqrt(2 w[0])
    // and b = sqrt(2 w[2]) = 1 - a these are -a, a - b, b.
    auto along = [&](int axis, int n, T* w, T* d) {
        weigh(grid_coordinate(position[3 * p + axis], origin[axis]), n, w);
        d[2] = w[2] - w[0] + (T)0.5;
        d[0] = d[2] - 1;
        d[1] = -d[0] - d[2];
    };
    along(0, nx, wx, gx);
    along(1, ny, wy, gy);
    if (planes == 2) along(2, nz, wz, gz);
    auto each_node = [&](auto visit) {
        for (int c = 2 - planes; c <= planes; ++c)
            for (int b = 0; b < 3; ++b)
                for (int a = 0; a < 3; ++a)
                    visit(at + (c - 1) * s1 + (b - 1) * s2 + a - 1, c, b, a);
    };
    // The field and its gradient at the particle.
    auto sample = [&](const float* field, T& value, T* slope) {
        each_node([&](long long node, int c, int b, int a) {
            const T f = field[node];
            value += f * (wz[c] * wy[b] * wx[a]);
            slope[0] += f * (wz[c] * wy[b] * gx[a]);
            slope[1] += f * (wz[c] * gy[b] * wx[a]);
            slope[2] += f * (gz[c] * wy[b] * wx[a]);
        });
    };
    T share = 0, slope[3] = {0, 0, 0};
    sample(smooth, share, slope);
    if (capacity) {
        T open = 0, narrower[3] = {0, 0, 0};
        sample(capacity, open, narrower);
        open = open_share(open);
        share /= open;
        for (int a = 0; a < 3; ++a) slope[a] = (slope[a] - share * narrower[a]) / open;
    }
    const T steep = slope[0] * slope[0] + slope[1] * slope[1] + slope[2] * slope[2];
    const T fullness = share + spread * sqrt(steep);
    if (fullness >= (T)THIN) continue;
    const T wanted = gain * (sqrt((T)THIN / (fullness > (T)1e-3 ? fullness : (T)1e-3)) - 1);
    const T boost = each * (wanted < most ? wanted : most);
    each_node([&](long long node, int c, int b, int a) {
        add(thin[node], boost * (wz[c] * wy[b] * wx[a]));
    });
}

// kernel warp_lcp.grid.surface_mesh.carve: Remove the inside of solids from the liquid: phi =
// max(phi, -room)
//   compute    float32
//   box        float32 room, phi
SIMD for (int i = first; i < last; ++i) phi[i] = phi[i] > -room[i] ? phi[i] : -room[i];

// kernel warp_lcp.grid.surface_mesh.surface_distance: Distance [lattice cells] from the filled
// share, as for a half space: phi = -spread sqrt(2) erfinv(2 share - 1), by the series up to the
// seventh power (error 0.2 % at the nodes beside the surface). Beyond the domain's sides there is
// air.
//   compute    float32
//   box        float32 phi, smooth, thin, capacity?; int8 known?
//   numbers    int planes; float32 spread
//   constants  LEAST_OPEN
const int nx = given.phi.shape[2] - 2, ny = given.phi.shape[1] - 2, nz = given.phi.shape[0] - 2;
const float scale = -1.2533141f * spread;  // sqrt(pi / 2)
const bool beyond = j == 0 || j > ny || (planes == 2 && (k == 0 || k > nz));
float share[M];
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : (int)M;
    SIMD for (int m = 0; m < n; ++m) share[m] = smooth[start + m] + thin[start + m];
    if (capacity) {
        SIMD for (int m = 0; m < n; ++m) {
            const float c =
                capacity[start + m] > (float)LEAST_OPEN ? capacity[start + m] : (float)LEAST_OPEN;
            known[start + m] = capacity[start + m] > (float)LEAST_OPEN;
            share[m] /= c;
        }
    }
    SIMD for (int m = 0; m < n; ++m) {
        const float f = share[m] < 1 ? share[m] : 1.0f, z = 2 * f - 1, q = z * z;
        const float d = scale * z * (1 + q * (0.26179939f + q * (0.14393173f + q * 0.097663620f)));
        phi[start + m] = (beyond | (start + m == 0) | (start + m > nx)) ? 1.0f : d;
    }
}

// kernel warp_lcp.grid.surface_mesh.restore: Move a curved surface back by as much as smoothing has
// moved it. A Gaussian of variance V moves the surface of a ball, with curvature kappa = 2 / R (the
// sum of both), inward by V / R = V kappa / 2, up to terms of (spread / R)^4: phi -= V kappa / 2.
// The curvature kappa = -div(grad f / |grad f|) is that of the contours of the share f, smoothed
// further so that bumps of the particles are not amplified: contours of a ball or cylinder stay
// round. Most curvatures below `beads` [1 / lattice cells] are the particles': kappa becomes
// kappa^3 / (kappa^2 + beads^2). Sheets are plane, and keep their thickness.
//   compute    float32
//   box        float32 phi, thin, wide, capacity?
//   numbers    int planes; float32 variance, beads, most
//   constants  LEAST_OPEN, FILLED
const float shift = 0.5f * variance, near = 1.5f + shift * most;
auto open_share = [&](long long at) {
    return capacity[at] > (float)LEAST_OPEN ? capacity[at] : (float)LEAST_OPEN;
};
auto share = [&](long long at) { return capacity ? wide[at] / open_share(at) : wide[at]; };
for (int i = first; i < last; ++i) {
    if (phi[i] > near || phi[i] < -near) continue;
    // Beside solids the share is that of the open part, down to the solid's surface.
    if (capacity && capacity[i] < 0.5f) continue;
    const float open = capacity ? open_share(i) : 1.0f;
    const float part = 1 - thin[i] / ((float)FILLED * open);
    if (part <= 0) continue;
    // Gradient and second derivatives, by central differences; z and its mixed ones are 0 in 2-D.
    const long long step[3] = {1, s2, s1};
    const float middle = share(i);
    float slope[3] = {0, 0, 0}, second[3] = {0, 0, 0}, mixed[3] = {0, 0, 0};
    for (int a = 0; a <= planes; ++a) {
        const float low = share(i - step[a]), high = share(i + step[a]);
        slope[a] = 0.5f * (high - low);
        second[a] = high - 2 * middle + low;
        for (int b = 0; b < a; ++b)  // (x, y), (x, z), (y, z) are numbered 0, 1, 2
            mixed[a + b - 1] =
                0.25f * (share(i + step[a] + step[b]) - share(i + step[a] - step[b]) -
                         share(i - step[a] + step[b]) + share(i - step[a] - step[b]));
    }
    const float x = slope[0] * slope[0], y = slope[1] * slope[1], z = slope[2] * slope[2],
                steep = x + y + z;
    if (steep < 1e-8f) continue;
    const float across = x * (second[1] + second[2]) + y * (second[0] + second[2]) +
                         z * (second[0] + second[1]) -
                         2 * (slope[0] * slope[1] * mixed[0] + slope[0] * slope[2] * mixed[1] +
                              slope[1] * slope[2] * mixed[2]);
    const float bend = -across / (steep * sqrtf(steep)), squared = bend * bend;
    const float kappa = bend * squared / (squared + beads * beads);
    phi[i] -= shift * part * (kappa > most ? most : kappa < -most ? -most : kappa);
}

// kernel warp_lcp.grid.mesh_smoothing.see_neighbors: Sum of the neighbors of each point, and their
// number. A closed surface has each edge once in either direction, so that each neighbor is added
// once. The points of an outline have two neighbors.
//   compute    float32
//   whole      vec3 points; float32 sums
//   box        int32 corners
//   ordered
#include "particles.h:add"
const int size = given.corners.shape[1];
const float* points = (const float*)given.points.data;
auto see = [&](long long here, long long there) {
    for (int a = 0; a < 3; ++a) add(sums[4 * here + a], points[3 * there + a]);
    add(sums[4 * here + 3], 1.0f);
};
for (long long t = first; t < last; ++t) {
    const int* c = corners + size * t;
    see(c[0], c[1]);
    if (size == 2) {
        see(c[1], c[0]);
        continue;
    }
    see(c[1], c[2]);
    see(c[2], c[0]);
}

// snippet cube_cases: Cases of the cells of a block (marching cubes). `visit` is called for each
// cell that the surface crosses. In 2-D the nodes above are those below: no edge along z is cut.
const long long up = planes == 2 ? s1 : 0;
auto each = [&](auto visit) {
    unsigned char cases[M];
    for (int start = first; start < last; start += M) {
        const int n = last - start < M ? last - start : (int)M;
        const float* a = phi + start;
        const float* b = a + s2;
        const float* c = a + up;
        const float* d = b + up;
        unsigned char any = 0;
        SIMD for (int m = 0; m < n; ++m) {
            const unsigned char code =
                (unsigned char)((a[m] < 0) | (a[m + 1] < 0) << 1 | (b[m] < 0) << 2 |
                                (b[m + 1] < 0) << 3 | (c[m] < 0) << 4 | (c[m + 1] < 0) << 5 |
                                (d[m] < 0) << 6 | (d[m + 1] < 0) << 7);
            cases[m] = code;
            any |= (unsigned char)((code != 0) & (code != 255));
        }
        if (!any) continue;
        for (int m = 0; m < n; ++m)
            if (cases[m] != 0 && cases[m] != 255) visit(start + m, (int)cases[m]);
    }
};
const long long wide = planes == 2 ? 16 : 5;
const int mask = planes == 2 ? 255 : 15;

// kernel warp_lcp.grid.marching_cubes.count: Count the points that a row's nodes own, and the
// triangles of its cells
//   compute    float32
//   by_row     int32 owned, made
//   whole      int8 table
//   box        float32 phi
//   numbers    int planes
#include "cube_cases"
int points = 0, elements = 0;
each([&](int i, int code) {
    const int here = code & 1;
    points += (here ^ (code >> 1 & 1)) + (here ^ (code >> 2 & 1)) + (here ^ (code >> 4 & 1));
    elements += table[(code & mask) * wide];
});
owned[P.row] = points;
made[P.row] = elements;

// kernel warp_lcp.grid.marching_cubes.points: Place the points of a row's nodes, and number the
// nodes that have any. Edges along a side of the domain, half a cell from it, count as if they were
// on it: the surface meets a wall on the wall, in a sharp edge. The points that close the surface
// there, between the nodes beside a side and the ghost ring, lie on the side too, slightly off the
// common edges of the sides.
//   compute    float32
//   by_row     int32 ends, counts
//   whole      vec3 into
//   box        float32 phi; int32 number
//   numbers    int planes; float32 dx; int before_x, before_y, before_z, most_x, most_y, most_z
//   constants  CLOSEST
#include "cube_cases"
float* to = (float*)into;
int next = ends[P.row] - counts[P.row];
const int most[3] = {most_x, most_y, most_z};  // cells of the domain; nodes have their numbers
auto place = [&](int axis, int c, float inset) {
    const int n = most[axis];
    if (n == 1 || (c > 1 && c < n)) return (float)c - 0.5f;
    return c <= 1 ? inset : (float)n - inset;
};
each([&](int i, int code) {
    const int here = code & 1;
    const int cut[3] = {here ^ (code >> 1 & 1), here ^ (code >> 2 & 1), here ^ (code >> 4 & 1)},
              at_node[3] = {i + before_x, j + before_y, k + before_z};
    const long long step[3] = {1, s2, up}, node = i;
    number[node] = next;
    for (int axis = 0; axis < 3; ++axis) {
        if (!cut[axis]) continue;
        const int c = at_node[axis], n = most[axis];
        const bool side = c == 0 || c == n;
        const float a = phi[node], b = phi[node + step[axis]];
        float t = a / (a - b), x[3];
        t = t > (float)CLOSEST ? (t < (float)(1 - CLOSEST) ? t : (float)(1 - CLOSEST))
                               : (float)CLOSEST;
        for (int d = 0; d < 3; ++d) x[d] = place(d, at_node[d], side ? (float)CLOSEST : 0.0f);
        x[axis] = side ? (c == 0 ? 0.0f : (float)n) : (float)c - 0.5f + t;
        for (int d = 0; d < 3; ++d) to[3 * next + d] = d == 2 && planes == 1 ? 0.0f : dx * x[d];
        ++next;
    }
});

// kernel warp_lcp.grid.marching_cubes.corners: Write the triangles of a row's cells
//   compute    float32
//   by_row     int32 ends, counts
//   whole      int8 table; int32 into
//   box        float32 phi; int32 number
//   numbers    int planes
#include "cube_cases"
const int size = planes + 1;
long long next = (long long)size * (ends[P.row] - counts[P.row]);
each([&](int i, int code) {
    const signed char* row = table + (code & mask) * wide;
    for (int n = 0; n < size * row[0]; ++n) {
        const int edge = row[1 + n], axis = edge / 4, b = edge % 4;
        // Low end of the edge: the two bits of b are the other two axes, the lower one first.
        const int x = axis == 0 ? 0 : b & 1, y = axis == 0 ? b & 1 : (axis == 1 ? 0 : b >> 1),
                  z = axis == 2 ? 0 : b >> 1;
        const long long node = i + x + y * s2 + z * up;
        const float* at = phi + node;
        const bool here = at[0] < 0;
        into[next++] =
            number[node] + (axis > 0 && here != (at[1] < 0)) + (axis > 1 && here != (at[s2] < 0));
    }
});
