// Kernels of wall conditions for velocities.

// snippet near_walls: Call act(i) on the faces first <= i < last of a row that a wall may change:
// known faces that are closed, and faces of the ghost ring. A pass over marks and fractions finds
// them, so that rows away from walls cost 5 bytes per face. Pointers are to whole fields.
const int nx = given.known.shape[2] - 2, ny = given.known.shape[1] - 2,
          nz = given.known.shape[0] - 2;
const long long row = k * s1 + j * s2;
const signed char* known = given.known.data;
const float* open = given.open.data;
auto each = [&](auto act) {
    const bool ring =
        j < 1 || (j > ny && axis != 1) || (planes == 2 && (k < 1 || (k > nz && axis != 2)));
    const int low = first > 1 ? first : 1, end = axis == 0 ? nx + 2 : nx + 1,
              high = last < end ? last : end;
    if (ring) {
        for (int i = first; i < last; ++i) act(i);
        return;
    }
    if (first == 0) act(0);
    for (int start = low; start < high; start += M) {
        const int n = high - start < M ? high - start : M;
        unsigned char closed[M], any = 0;
        SIMD for (int m = 0; m < n; ++m) {
            const unsigned char c =
                (int)(open[row + start + m] == 0) & (int)(known[row + start + m] > 0);
            closed[m] = c;
            any |= c;
        }
        if (any)
            for (int m = 0; m < n; ++m)
                if (closed[m]) act(start + m);
    }
    if (last == nx + 2 && end == nx + 1) act(nx + 1);
};

// kernel warp_lcp.material.cut_wall.constrain: Wall condition for a component's closed faces:
// remove the velocity along the normal n relative to the wall, u - ((v - v_wall) . n) n, if it is
// into the wall, or if the material stays on the wall. Only old values are read, so that the order
// of faces does not matter
//   compute    float32
//   whole      mat33 turn; vec3 shift; uint8 separating
//   box        float32 open, result, distance; int8 known; float32 u?, v?, w?; int8 known_u?,
//              known_v?, known_w?; int16 wall_u?, wall_v?, wall_w?; float32 moving_u?, moving_v?,
//              moving_w?; int16 owner?; float32 next_near?; int16 next_owner?; int8 kind; uint8
//              contact
//   numbers    int axis, planes; float32 dx; int before_x, before_y, before_z
//   constants  DEPTH, SOLID, FLUID, TOUCHES_NOTHING, HELD, RELEASED
#include "near_walls"
const float* field[3] = {given.u.data, given.v.data, given.w.data};
const signed char* marks[3] = {given.known_u.data, given.known_v.data, given.known_w.data};
const short* wall[3] = {given.wall_u.data, given.wall_v.data, given.wall_w.data};
const float* moving[3] = {given.moving_u.data, given.moving_v.data, given.moving_w.data};
const float* turn = (const float*)given.turn.data;
const float* shift = (const float*)given.shift.data;
const float* distance = given.distance.data;
const float* next = given.next_near.data;
float* result = given.result.data;
const short* owner = given.owner.data;
const short* next_owner = given.next_owner.data;
const signed char* kind = given.kind.data;
const unsigned char* contact = given.contact.data;
const unsigned char* separating = given.separating.data;
const long long stride[3] = {1, s2, s1};
const int counts[3] = {nx, ny, nz};
// Whether the material beside the wall stays on it. The nearest open cell along the normal decides;
// the search begins at the wall.
auto holds = [&](const float* center, const float* n, float depth, int number) {
    int cell[3] = {1, 1, 1};
    long long e = -1;
    for (int step = 0; step < 6; ++step) {
        for (int d = 0; d <= planes; ++d) {
            const int at = (int)(center[d] + (depth + 0.05f + 0.25f * (float)step) * n[d]);
            cell[d] = at < 1 ? 1 : (at < counts[d] ? at : counts[d]);
        }
        e = cell[2] * s1 + cell[1] * s2 + cell[0];
        if (kind[e] != SOLID) break;
    }
    if (kind[e] != FLUID) return false;
    if (!separating[number]) return true;
    if (contact[e] != TOUCHES_NOTHING) return contact[e] != RELEASED;
    // The cell touches the wall with an edge or a corner: its neighbors on the side of the wall
    // decide.
    bool released = false;
    for (int d = 0; d <= planes; ++d) {
        const long long beside = e - (n[d] > 0 ? stride[d] : -stride[d]);
        if (kind[beside] == FLUID && contact[beside] == HELD) return true;
        released = released || (kind[beside] == FLUID && contact[beside] == RELEASED);
    }
    return !released;
};
auto constrain = [&](int i) {
    int at[3] = {i, j, k};
    // behind the domain's wall: no interpolation reads it
    if (at[axis] == 0) {
        result[row + i] = field[axis][row + i];
        return;
    }
    for (int d = 0; d <= planes; ++d) {  // faces of the ghost ring follow those beside them
        const int most = counts[d] + (d == axis ? 1 : 0);
        at[d] = at[d] < 1 ? 1 : (at[d] < most ? at[d] : most);
    }
    const long long e = at[2] * s1 + at[1] * s2 + at[0], here = row + i;
    const float own = field[axis][e];
    if (known[e] <= 0) {
        result[here] = field[axis][here];
        return;
    }
    result[here] = own;
    if (open[e] > 0) return;
    const int number = wall[axis][e] > 0 ? wall[axis][e] : 0;
    // Distance to wall `number`; at nodes of other walls it is that to the nearest wall.
    auto distance_to = [&](long long node) {
        return owner && owner[node] != number && next_owner[node] == number ? next[node]
                                                                            : distance[node];
    };
    // Distance at the face's nodes (b along the first tangential axis, c along the second), and its
    // gradient at the center of the face.
    const int p = axis == 0 ? 1 : 0, q = axis == 2 ? 1 : 2, nodes = planes == 2 ? 2 : 1;
    const long long back = -stride[axis], ahead = at[axis] <= counts[axis] ? stride[axis] : 0;
    float s = 0, n[3] = {0, 0, 0};
    for (int c = 0; c < nodes; ++c) {
        for (int b = 0; b < 2; ++b) {
            const long long a = e + b * stride[p] + c * stride[q];
            const float d = distance_to(a);
            s += distance[a];
            n[axis] += (distance_to(a + ahead) - distance_to(a + back)) / (ahead ? 2.0f : 1.0f);
            n[p] += b ? 2 * d : -2 * d;
            n[q] += nodes == 1 ? 0.0f : (c ? 2 * d : -2 * d);
        }
    }
    // the domain's wall
    if (number == 0) {
        n[0] = 0;
        n[1] = 0;
        n[2] = 0;
        n[axis] = (at[axis] == 1 ? 2.0f : -2.0f) * (float)nodes;
    }
    const float share = 0.5f / (float)nodes,
                size = share * sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
    s *= share;
    // inside a thin plate there is no useful normal
    if (s < -(float)DEPTH || !(size > 0.1f)) return;
    for (int d = 0; d < 3; ++d) n[d] *= share / size;
    float center[3];
    const int before[3] = {before_x, before_y, before_z};
    for (int d = 0; d < 3; ++d) center[d] = (float)at[d] + (d == axis ? 0.0f : 0.5f);
    // Velocity of the wall at the center; on the domain's faces that of a solid that covers them.
    auto of_wall = [&](int d) {
        if (!moving[0]) return 0.0f;
        if (number == 0) return d == axis ? moving[axis][e] : 0.0f;
        float v = shift[3 * number + d];
        for (int c = 0; c <= planes; ++c)
            v += turn[9 * number + 3 * d + c] * (center[c] + (float)before[c] - 1.0f) * dx;
        return v;
    };
    float relative = n[axis] * (own - of_wall(axis));
    for (int d = 0; d <= planes; ++d) {
        if (d == axis) continue;
        float total = 0;
        int found = 0;
        for (int b = 0; b < 4; ++b) {
            const long long f = e + (b & 1 ? back : 0) + (b & 2 ? stride[d] : 0);
            if (marks[d][f] > 0) {
                total += field[d][f];
                ++found;
            }
        }
        relative += n[d] * ((found ? total / (float)found : 0.0f) - of_wall(d));
    }
    if (relative < 0 || holds(center, n, s < 0 ? -s : 0.0f, number))
        result[here] = own - relative * n[axis];
};
each(constrain);

// kernel warp_lcp.material.cut_wall.take: Copy the results of `constrain`
//   compute    float32
//   box        float32 open, result, field; int8 known
//   numbers    int axis, planes
#include "near_walls"
each([&](int i) { field[i] = result[i]; });

// kernel warp_lcp.material.velocity_extrapolation.keep_spray: Mark open faces as known that are
// unknown but carry weight, and extrapolated ones. Without fractions a face is open between cells
// that are not SOLID. A face with weight is not on the array's edge, since its particles lie in the
// domain.
//   compute    float32
//   box        float32 weight, open?; int8 known, kind
//   numbers    int axis
//   constants  TINY_WEIGHT, SOLID
const long long below = axis == 0 ? 1 : axis == 1 ? (j > 0) * s2 : (k > 0) * s1;
SIMD for (int i = first; i < last; ++i) {
    const signed char mark = known[i];
    const int free =
        open ? open[i] > 0
             : (kind[i] != SOLID) & (kind[axis == 0 && i == 0 ? i : i - below] != SOLID);
    known[i] = (mark > 0) | ((mark == 0) & (int)(weight[i] > (float)TINY_WEIGHT) & free)
                   ? (signed char)1
                   : mark;
}
