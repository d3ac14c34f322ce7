// Kernels of distributed particles.

// snippet side_of_box: Position of a particle relative to a box, low <= grid coordinate < high: 0
// inside and away from its sides, 1 inside and within `reach` [cells] of them, 2 outside.
#include "snippets.h:grid_coordinate"
const T low[3] = {low_x, low_y, low_z}, high[3] = {high_x, high_y, high_z};
auto side_of_box = [&](const T* at) -> int {
    const T x = grid_coordinate(at[0]), y = grid_coordinate(at[1]), z = grid_coordinate(at[2]);
    const int in = (int)(x >= low[0]) & (int)(x < high[0]) & (int)(y >= low[1]) &
                   (int)(y < high[1]) & (int)(z >= low[2]) & (int)(z < high[2]);
    const int away = (int)(x >= low[0] + reach) & (int)(x < high[0] - reach) &
                     (int)(y >= low[1] + reach) & (int)(y < high[1] - reach) &
                     (int)(z >= low[2] + reach) & (int)(z < high[2] - reach);
    return 2 - in - away;
};

// snippet copy_bytes: Copy a few bytes between types.
#ifdef __CUDA_ARCH__
#define COPY_BYTES memcpy
#else
#define COPY_BYTES __builtin_memcpy
#endif

// snippet columns: The columns of particles that exist, and their copies to and from messages.
#include "copy_bytes"
float* const columns[] = {(float*)given.position.data, (float*)given.velocity.data,
                          (float*)given.affine_0.data, (float*)given.affine_1.data,
                          (float*)given.affine_2.data, (float*)given.kept.data,
                          (float*)given.identity.data};
auto to_words = [&](int* to, long long p) {  // message: place, then the columns
    COPY_BYTES(to, place + p, 8);
    to += 2;
    for (const float* column : columns)
        if (column) {
            COPY_BYTES(to, column + 3 * p, 12);
            to += 3;
        }
};
auto from_words = [&](const int* from, long long p) {
    COPY_BYTES(place + p, from, 8);
    from += 2;
    for (float* column : columns)
        if (column) {
            COPY_BYTES(column + 3 * p, from, 12);
            from += 3;
        }
};
int words = 2;
for (const float* column : columns) words += column ? 3 : 0;

// snippet in_cells: Whether a cell is in a box that is grown by `more` cells. A box is six numbers:
// its first cell, and the cell after its last.
auto in_cells = [](const int* cell, const int* box, int more) -> bool {
    return cell[0] >= box[0] - more && cell[1] >= box[1] - more && cell[2] >= box[2] - more &&
           cell[0] < box[3] + more && cell[1] < box[4] + more && cell[2] < box[5] + more;
};

// kernel warp_lcp.distributed.particles.where: Position of particles relative to a box, see
// `side_of_box`. `low` and `high` are grid coordinates, `reach` is in cells.
//   compute    float32
//   box        vec3 position; uint8 where
//   numbers    int planes; float32 dx, inverse_dx; int before_x, before_y, before_z; float32 low_x,
//              low_y, low_z, high_x, high_y, high_z, reach
#include "side_of_box"
const T* position = (const T*)given.position.data;
SIMD for (int p = first; p < last; ++p) where[p] =
    (unsigned char)side_of_box(position + 3 * (long long)p);

// kernel warp_lcp.distributed.particles.find_border: List the particles outside a box or near its
// sides, and their cells. Count them, and those in each of the boxes from the third on. Cells are
// clipped to the first box.
//   compute    float32
//   whole      vec3 position; int32 boxes, border, cells
//   box        int32 found
//   numbers    int planes; float32 dx, inverse_dx; int before_x, before_y, before_z; float32 low_x,
//              low_y, low_z, high_x, high_y, high_z, reach; int count, ends
#include "side_of_box"
#include "in_cells"
#include "copy_bytes"
constexpr int BLOCK = 1024;
const T* at = (const T*)given.position.data;
unsigned char side[BLOCK];
int many = 0;
for (int b = 0; b < ends; ++b) found[1 + b] = 0;
for (int from = 0; from < count; from += BLOCK) {
    const int n = count - from < BLOCK ? count - from : BLOCK;
    SIMD for (int e = 0; e < n; ++e) side[e] =
        (unsigned char)side_of_box(at + 3 * (long long)(from + e));
    for (int e = n; e < (n + 7) / 8 * 8; ++e) side[e] = 0;
    for (int e = 0; e < n; e += 8) {
        unsigned long long eight;
        COPY_BYTES(&eight, side + e, 8);
        if (!eight) continue;
        for (int p = e; p < e + 8; ++p) {
            if (!side[p]) continue;
            int* cell = cells + 3 * many;
            border[many++] = from + p;
            for (int d = 0; d < 3; ++d) {
                const T x = grid_coordinate(at[3 * (long long)(from + p) + d]),
                        least = boxes[d] + 1, most = boxes[3 + d];
                const T inside = x > least ? x : least;
                cell[d] = (int)(inside < most ? inside : most) - 1;
            }
            if (planes == 1) cell[2] = boxes[2];
            for (int b = 0; b < ends; ++b) found[1 + b] += in_cells(cell, boxes + 12 + 6 * b, 0);
        }
    }
}
found[0] = many;

// kernel warp_lcp.distributed.particles.pack: Write the particles in each of the boxes from the
// third on to a message, box after box. Along periodic axes positions are shifted by an offset.
// After a positive offset they are at least `end_`, so that rounding does not put them inside the
// box.
//   compute    float32
//   whole      vec3 position, velocity?, affine_0?, affine_1?, affine_2?, kept?, identity?;
//              int64 place; int32 boxes, border, cells, message; float64 offsets
//   box        int32 found
//   numbers    int ends; bool around; float32 end_x, end_y, end_z
#include "columns"
#include "in_cells"
const float end[3] = {end_x, end_y, end_z};
int* to = message;
for (int b = 0; b < ends; ++b)
    for (int e = 0; e < found[0]; ++e) {
        if (!in_cells(cells + 3 * e, boxes + 12 + 6 * b, 0)) continue;
        to_words(to, border[e]);
        for (int d = 0; around && d < 3; ++d) {
            const double offset = offsets[3 * b + d];
            float x;
            COPY_BYTES(&x, to + 2 + d, 4);
            x = (float)((double)x + offset);
            x = offset > 0 && x < end[d] ? end[d] : x;
            COPY_BYTES(to + 2 + d, &x, 4);
        }
        to += words;
    }

// kernel warp_lcp.distributed.particles.give_places: Number the particles in the order of their
// cells: place = `most_a_cell` times the cell's number on the whole grid, plus the number within
// the cell.
//   compute    float32
//   whole      int32 key; int64 place
//   box        int32 found
//   numbers    int count, most_a_cell, before_x, before_y, before_z, nx, ny, all_x, all_y, all_z
auto around = [](int i, int n) -> long long { return (i % n + n) % n; };  // periodic axes
long long next = 0;
for (int p = 0; p < count; ++p) {
    if (p == 0 || key[p] != key[p - 1]) {
        const int row = key[p] / (nx + 2), i = key[p] - row * (nx + 2), k = row / (ny + 2),
                  j = row - k * (ny + 2);
        const long long x = around(i + before_x - 1, all_x), y = around(j + before_y - 1, all_y),
                        z = around(k + before_z - 1, all_z);
        next = ((z * all_y + y) * all_x + x) * most_a_cell;
    }
    place[p] = next++;
}

// kernel warp_lcp.distributed.particles.unpack: Append the particles of messages
//   compute    float32
//   whole      vec3 position, velocity?, affine_0?, affine_1?, affine_2?, kept?, identity?;
//              int64 place; int32 message
//   box        int32 found
//   numbers    int count, come
#include "columns"
for (int p = 0; p < come; ++p) from_words(message + (long long)words * p, count + p);

// kernel warp_lcp.distributed.particles.settle: Order the particles after `unpack`: own particles
// first, then ghosts. The last particles move to the slots of those that have left the second box,
// and of ghosts. `found`: the number of own particles, the number with ghosts, and the number of
// own slots that are filled again, which are the first of `others`.
//   compute    float32
//   whole      vec3 position, velocity?, affine_0?, affine_1?, affine_2?, kept?, identity?;
//              int64 place; int32 boxes, border, cells, message, others, ghosts, flags
//   box        int32 found
//   numbers    int planes; float32 dx, inverse_dx; int before_x, before_y, before_z; float32 low_x,
//              low_y, low_z, high_x, high_y, high_z, reach; int count, come
#include "side_of_box"
#include "columns"
#include "in_cells"
const int total = count + come;
int gone = 0, near = 0, free = 0, moved = 0;
for (int e = 0; e < found[0]; ++e) {
    if (in_cells(cells + 3 * e, boxes + 6, 0)) continue;
    others[gone++] = border[e];
    if (in_cells(cells + 3 * e, boxes + 6, (int)reach)) ghosts[near++] = border[e];
}
for (int p = count; p < total; ++p)
    if (side_of_box((const T*)given.position.data + 3 * (long long)p) == 2) {
        others[gone++] = p;
        ghosts[near++] = p;
    }
const int own = total - gone, end = own + near;
int *leaves = flags, *held = flags + gone;  // for the slots from `own` on
for (int e = 0; e < gone; ++e) leaves[e] = 0;
for (int e = 0; e < near; ++e) held[e] = 0;
for (int e = 0; e < gone; ++e) {
    if (others[e] < own)
        ++free;
    else
        leaves[others[e] - own] = 1;
}
for (int e = 0; e < near; ++e)
    if (ghosts[e] >= own && ghosts[e] < end) held[ghosts[e] - own] = 1;
for (int e = 0; e < gone; ++e)
    if (!leaves[e]) to_words(message + (long long)words * moved++, own + e);
for (int e = 0; e < near; ++e)
    if (ghosts[e] < own || ghosts[e] >= end)
        to_words(message + (long long)words * moved++, ghosts[e]);
moved = 0;
for (int e = 0; e < free; ++e) from_words(message + (long long)words * moved++, others[e]);
for (int e = 0; e < near; ++e)
    if (!held[e]) from_words(message + (long long)words * moved++, own + e);
found[0] = own;
found[1] = end;
found[2] = free;
