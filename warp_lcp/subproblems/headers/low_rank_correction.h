// Kernels of the Woodbury preconditioner for a term of low rank.

// kernel low_rank_correction.squares: Diagonal of U'U on the unknowns, then the rows of each block
//   compute    float64
//   whole      int32 entry_rows, blocks; V values; int32 count; D d; float64 squares
//   numbers    int width, rank
//   by_cell
for (int q = 0; q < rank + rank / width; ++q) squares[q] = 0;
for (int e = 0; e < count[0]; ++e) {
    if (d[entry_rows[e]] == 0) continue;
    squares[rank + blocks[e]] += 1;
    for (int q = 0; q < width; ++q) {
        EXACT_MATH const double u = (double)values[(long long)e * width + q];
        squares[blocks[e] * width + q] += u * u;
    }
}

// kernel low_rank_correction.squares_by_turns: As low_rank_correction.squares, by many threads, a
// column of sums each
//   compute    float64
//   whole      int32 entry_rows, blocks; V values; int32 count; D d
//   numbers    int width, rank
//   sums       first
//   by_cell
double* sums = given.out.data + P.t;
const int last = count[0], all = rank + rank / width;
if (!P.more)
    for (int q = 0; q < all; ++q) sums[q * places] = 0;
for (int k = 0; k < n && p + k < last; ++k) {
    const long long e = p + k;
    if (d[entry_rows[e]] == 0) continue;
    sums[(rank + blocks[e]) * places] += 1;
    for (int q = 0; q < width; ++q) {
        EXACT_MATH const double u = (double)values[e * width + q];
        sums[((long long)blocks[e] * width + q) * places] += u * u;
    }
}
const double first = P.more ? 0 : sums[0];

// kernel low_rank_correction.dots: Products of r with the fields in slots, a column of sums each
//   compute    S
//   reads      S r
//   whole      S Z
//   numbers    int slots; int64 size
//   sums       first
//   by_cell
T first = 0;
for (int s = 0; s < slots; ++s) {
    const T* v = Z + s * size + p;
    double* column = given.out.data + s * places + P.t;
    T sum = 0;
    SIMD for (int k = 0; k < n; ++k) sum += v[k] * r[k];
    if (s == 0)
        first = sum;
    else
        *column = P.more ? *column + (double)sum : (double)sum;
}

// kernel low_rank_correction.subtract: z -= sum_s factors_s Z_s on the unknowns
//   compute    S
//   reads      D d
//   writes     S z
//   whole      S Z; float64 factors
//   numbers    int slots; int64 size
//   by_cell
for (int begin = 0; begin < n; begin += M) {
    const int end = n - begin < M ? n : begin + (int)M;
    T sum[M];
    SIMD for (int k = begin; k < end; ++k) sum[k - begin] = 0;
    for (int s = 0; s < slots; ++s) {
        const T f = (T)factors[s];
        const T* v = Z + s * size + p;
        SIMD for (int k = begin; k < end; ++k) sum[k - begin] += f * v[k];
    }
    SIMD for (int k = begin; k < end; ++k) {
        const T v = z[k] - sum[k - begin];
        z[k] = d[k] != 0 ? v : z[k];
    }
}
