// Kernels of matrices that are stencils.

// kernel stencil.product: y = A x, or A x + b
//   compute    S
//   stencil    D, W
//   reads      S x, b?
//   writes     S y
if (b)
    SIMD for (int k = 0; k < n; ++k) y[k] = affine(x, b, k);
else
    SIMD for (int k = 0; k < n; ++k) y[k] = product(x, k);

// kernel stencil.transposed: y = A' x of a compact stencil: sum over the neighbors of their weight
// for this cell times their x
//   compute    S
//   stencil    D, W
//   reads      S x
//   writes     S y
//   by_cell
#define ADD(W, X, Y, Z) \
    +W(k - (X) + beside(-(Y), -(Z), zm, zp)) * x[k - (X) + beside(-(Y), -(Z), zm, zp)]
for (int k = 0; k < n; ++k) {
    const T e = diagonal(k);
    y[k] = e != 0 ? e * x[k] - ((T)0 EACH_WEIGHT(ADD)) : (T)0;
}
#undef ADD

// kernel stencil.relax: Projected SOR over the cells of one color: red or black; for a compact
// stencil, even or odd along each axis as the color's bits say
//   compute    S
//   stencil    D, W
//   reads      S b, lower, upper
//   writes     S x
//   numbers    S omega; int color
//   by_cell
const bool compact = STENCIL == 'c';
const int bits = compact ? color : 0;
const int start = compact ? (P.first + bits) % 2 : (P.k + P.j + P.first + color) % 2;
const bool ours = !compact || (P.j % 2 == bits / 2 % 2 && P.k % 2 == bits / 4);
for (int k = ours ? start : n; k < n; k += 2) {
    const T e = diagonal(k);
    if (e != 0) {
        T v = x[k] - omega * (b[k] + e * x[k] - neighbors(x, k)) / e;
        v = v > lower[k] ? v : lower[k];
        x[k] = v < upper[k] ? v : upper[k];
    }
}

// kernel stencil.gradient: Derivative by a coefficient: mu_i x_(i + o), or mu_i x_i where that
// neighbor is SOLID; and the sum
//   compute    float64
//   reads      int8 cells; float64 multiplier, x
//   writes     float64 part?
//   numbers    int step, row, plane
//   sums       sum
const long long to = step +
                     (row < 0   ? ym
                      : row > 0 ? yp
                                : 0) +
                     (plane < 0   ? zm
                      : plane > 0 ? zp
                                  : 0);
const auto value = [&](int k) -> T {
    return cells[k] == 1 ? multiplier[k] * (cells[k + to] == 2 ? x[k] : x[k + to]) : (T)0;
};
T sum = 0;
SIMD for (int k = 0; k < n; ++k) sum += value(k);
if (part) SIMD for (int k = 0; k < n; ++k) part[k] = value(k);

// kernel stencil.diagonal: Diagonal: coefficient of the center plus those of closed neighbors,
// whose value is the cell's own, plus the shift
//   compute    S
//   stencil    S, W
//   reads      int8 cells; S center?, shift?
//   writes     S made
//   numbers    S number
for (int k = 0; k < n; ++k) {
    const T closed =
        around_of([&](int i, int rows,
                      int planes) { return (T)(cells[i + beside(rows, planes, zm, zp)] == 2); },
                  k);
    T v = (center ? (T)center[k] : number) - closed;
    if (shift) v += (T)shift[k];
    made[k] = cells[k] == 1 ? v : (T)0;
}

// kernel stencil.wrap: Fill the ghost cells before the first and after the last of `cells` along a
// periodic axis; cells are `step` elements apart
//   compute    S
//   writes     S x
//   numbers    int cells; int64 step
//   by_cell
for (int k = 0; k < n; ++k) {
    x[k] = x[k + cells * step];
    x[k + (cells + 1) * step] = x[k + step];
}

// kernel matrix_stencil.recognize: Compare the rows of a sparse matrix with those of a compact
// stencil on a box of cells. Counts: rows that are not of this form, that differ from the middle
// one, or that are not of an M-matrix
//   compute    float64
//   writes     float64 made
//   whole      int32 ptr, col; float64 a, middle, weights?
//   numbers    int nx, ny, nz, full, kept; int64 size
//   sums       wrong, centers, differ, positive
//   by_cell
int wrong = 0, centers = 0, differ = 0, positive = 0, count = 0, reached = 0;
const int plane = nx * ny;
double row[27], usual[27];
// Existing neighbors and their fields; the entries of a row equal to the middle one.
int places[27], columns[27], steps[27];
bool rises = false, within = true;
for (int o = 0, field = 0; o < 27; ++o) {
    row[o] = 0;
    if (!(full >> o & 1)) continue;
    const int Y = P.j + o / 3 % 3 - 1, Z = P.k + o / 9 - 1;
    within &= Y >= 0 && Y < ny && Z >= 0 && Z < nz;
    steps[reached] = o % 3 - 1 + (o / 3 % 3 - 1) * nx + (o / 9 - 1) * plane;
    usual[reached++] = middle[o];
    if (o != 13) {
        rises |= middle[o] > 0;
        columns[count] = kept >> o & 1 ? field++ : -1;
        places[count++] = o;
    }
}
const auto inside = [&](int o, int x) {
    const int X = x + o % 3 - 1, Y = P.j + o / 3 % 3 - 1, Z = P.k + o / 9 - 1;
    return X >= 0 && X < nx && Y >= 0 && Y < ny && Z >= 0 && Z < nz;
};
for (int k = 0; k < n; ++k) {
    const int x = P.first + k, i = (P.k * ny + P.j) * nx + x, begin = ptr[i];
    // most rows equal the middle one
    if (within && !weights && x > 0 && x < nx - 1 && ptr[i + 1] - begin == reached) {
        bool same = true;
        for (int q = 0; q < reached; ++q)
            same &= col[begin + q] == i + steps[q] && a[begin + q] == usual[q];
        if (same) {
            made[k] = middle[13];
            wrong += !(middle[13] > 0);
            positive += rises;
            continue;
        }
    }
    for (int e = begin; e < ptr[i + 1]; ++e) {
        const double v = a[e];
        int step = col[e] - i;
        const int Z = nz == 1 ? 0 : (2 * step > plane) - (2 * step < -plane);
        step -= Z * plane;
        const int Y = (2 * step > nx) - (2 * step < -nx), X = step - Y * nx,
                  o = 13 + X + 3 * Y + 9 * Z;
        if (X < -1 || X > 1 || !(full >> o & 1) || !inside(o, x))
            wrong += v != 0;
        else
            row[o] += v;
    }
    wrong += !(row[13] > 0);
    centers += row[13] != middle[13];
    made[k] = row[13];
    row[13] = 0;
    for (int q = 0; q < count; ++q) {
        const int o = places[q];
        const double v = row[o];
        row[o] = 0;
        positive += v > 0;
        differ += v != middle[o] && inside(o, x);
        if (weights && columns[q] >= 0) weights[columns[q] * size + p + k] = -v;
    }
}
