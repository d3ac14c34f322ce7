// Kernels of distributed vectors and particles.

// kernel vector_copies.enter: A vector to a field: rows with a diagonal of 0 are no unknowns and
// enter as 0
//   compute    S
//   reads      D d
//   writes     S x
//   other      float64 v
//   numbers    float64 scale
SIMD for (int k = 0; k < n; ++k) { const T e = (T)(scale*v[k]); x[k] = d[k] != 0 ? e : (T)0; }

// kernel vector_copies.leave: A field to a vector: rows with a diagonal of 0 leave with what
// another vector holds there, or as 0 if there is none
//   compute    S
//   reads      D d; S x
//   other      float64 v, others?
//   numbers    float64 scale
if (others) { SIMD for (int k = 0; k < n; ++k) { const double e = scale*(double)x[k], held = others[k]; v[k] = d[k] != 0 ? e : held; } }
else { SIMD for (int k = 0; k < n; ++k) { const double e = scale*(double)x[k]; v[k] = d[k] != 0 ? e : 0.0; } }

// kernel warp_lcp.distributed.particles.where: Where particles are: a box begins at the grid
// coordinates `low` and ends at `high`; `reach` is in cells
//   compute    float32
//   box        vec3 position; uint8 where
//   numbers    int planes; float32 dx, inverse_dx; int before_x, before_y, before_z; float32 low_x,
//              low_y, low_z, high_x, high_y, high_z, reach
#include "snippets.h:grid_coordinate"
const T* position = (const T*)given.position.data;
const T low[3] = {low_x, low_y, low_z}, high[3] = {high_x, high_y, high_z};
SIMD for (int p = first; p < last; ++p) {
    const long long q = 3*(long long)p;
    const T x = grid_coordinate(position[q]), y = grid_coordinate(position[q + 1]), z = grid_coordinate(position[q + 2]);
    const int in = (int)(x >= low[0]) & (int)(x < high[0]) & (int)(y >= low[1]) & (int)(y < high[1])
        & (int)(z >= low[2]) & (int)(z < high[2]);
    const int away = (int)(x >= low[0] + reach) & (int)(x < high[0] - reach) & (int)(y >= low[1] + reach) & (int)(y < high[1] - reach)
        & (int)(z >= low[2] + reach) & (int)(z < high[2] - reach);
    where[p] = (unsigned char)(2 - in - away);
}
