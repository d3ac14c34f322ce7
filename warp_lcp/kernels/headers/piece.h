// What surrounds a row function: the piece of a row, the loop over tasks, partial sums.

// snippet piece: Consecutive cells of a row along x. Only this header computes the addresses of
// cells.
struct Piece {
    long long p;  // index of the first cell's element
    int n;  // number of cells
    // offsets to the adjacent rows: below and above along y (ym, yp) and along z (zm, zp)
    long long ym, yp, zm, zp;
    // ring buffer of three planes: offset of this plane's place, and from there to the planes below
    // and above
    long long ring, down, up;
    long long q;  // element of the other level that contains the first cell, or is its first one
    int k, j, first, row;  // plane, row in it, first cell, all from 0; row number over all planes
    // place of the thread's partial sums, and whether it holds a value already
    int t;
    bool more;
};
// Number of partial sums of all threads. A kernel's number may hide the short name.
const long long places_ = (L.planes + L.slab - 1) / L.slab * L.rows * L.chunks, places = places_;
// index along an axis on another level: times f, or over -f if f < 0
const auto over = [](int i, int f) -> long long { return f > 0 ? (long long)i * f : i / -f; };
// Ring buffer of three planes: offset of plane k, and offsets from there to the planes below and
// above
struct Ring {
    long long place, down, up;
};
const auto ring_of = [&](int k) -> Ring {
    // Plane of the buffer that holds plane `at`: three planes in rotation per slab. The planes
    // beside a cut are stored as in a whole field.
    const auto place = [&](int at) {
        if (!L.cut) return at % 3;
        const int s = at / L.cut < L.slabs ? at / L.cut : L.slabs - 1, first = s * L.cut,
                  from = s ? first + L.apart : 0;
        return at < from || (s < L.slabs - 1 && at >= first + L.cut - L.apart)
                   ? at
                   : from + (at - from) % 3;
    };
    // The place below the ring serves as the plane below the first one and as the plane above the
    // last one, unless those rotate too (L.turn).
    const int at = k + L.turn, here = place(at), below = at > 0 ? place(at - 1) : -1,
              above = k == L.planes - 1 && !L.turn ? -1 : place(at + 1);
    return {(here - k + L.lift) * L.s1, (below - here) * L.s1, (above - here) * L.s1};
};
const auto piece = [&](int k, int j, int c, const Ring& ring) -> Piece {
    // these indices do not exceed 32 bits
    Piece P;
    int first = c * L.grain, last = L.nx - first < L.grain ? L.nx : first + L.grain;
    P.k = k;
    P.j = j;
    P.row = k * L.rows + j;
    if (L.spans.data) {
        const auto span = L.spans.data[P.row];
        first = first > span[0] ? first : span[0];
        last = last < span[1] ? last : span[1];
    }
    if constexpr (BOX)
        if (L.pieces.data) {
            const auto *row = L.pieces.data + 2 * (long long)c, *run = row + 1;
            P.k = (*row)[0];
            P.j = (*row)[1];
            first = (*run)[0];
            last = (*run)[1];
        }
    P.first = first;
    P.n = last > first ? last - first : 0;
    P.p = L.base + k * L.s1 + j * L.s2 + first;
    P.ym = -L.s2;
    P.yp = L.s2;
    P.zm = -L.s1;
    P.zp = L.s1;
    if constexpr (RINGS) {
        P.ring = ring.place;
        P.down = ring.down;
        P.up = ring.up;
    }
    if constexpr (LEVELS)
        P.q = L.o0 + over(k, L.fz) * L.o1 + over(j, L.fy) * L.o2 + over(first, L.fx);
    P.t = (k / L.slab * L.rows + j) * L.chunks + c;
    P.more = k % L.slab > 0;
    return P;
};

// snippet sums: Add the sums of a piece to those of the thread's piece in the plane below. On CUDA,
// where a thread has a piece in each plane of a slab, they stay in registers until its last plane.
// Integers are summed as integers there, since float64 is slow.
double* sums_ = given.out.data + P.t;
const auto joined_ = [](int s, auto a, auto b) { return s < SUMS ? a + b : b > a ? b : a; };
#ifdef __CUDA_ARCH__
#ifndef QUADS
const bool last_ = (k_i + 1) % L.slab == 0 || k_i + 1 == L.planes;
#endif
const auto keep_ = [&](int s, auto v) {
    if constexpr ((decltype(v))0.5 == 0) {
        whole_[s] = P.more ? joined_(s, v, (decltype(v))whole_[s]) : v;
        if (last_) sums_[s * places_] = (double)whole_[s];
    } else {
        total_[s] = P.more ? joined_(s, (double)v, total_[s]) : (double)v;
        if (last_) sums_[s * places_] = total_[s];
    }
};
#define KEEP_(S, NAME) keep_(S, NAME);
EACH_FOUND(KEEP_)
#undef KEEP_
#else
#define VALUE_(S, NAME) (double)NAME,
const double all_[] = {EACH_FOUND(VALUE_)};
#undef VALUE_
for (int s = 0; s < FOUND; ++s, sums_ += places_)
    *sums_ = P.more ? joined_(s, all_[s], *sums_) : all_[s];
#endif

// snippet tasks: Loop over tasks from (i_, j_, c_) on. A task is a chunk of a row in each plane of
// a slab. On CUDA a thread has one task; on the CPU it has as many as a thread of the pool takes at
// once. The body follows and ends with three braces.
const int per_plane_ = L.rows * L.chunks;
int i_ = slab_, at_ = row_ * L.chunks + chunk_;
#ifdef __CUDA_ARCH__
double total_[FOUND ? FOUND : 1];
int whole_[FOUND ? FOUND : 1];
#endif
for (int left_ = count_, here_; left_ > 0; left_ -= here_, ++i_, at_ = 0) {
    here_ = left_ < per_plane_ - at_ ? left_ : per_plane_ - at_;
    for (int k_i = i_ * L.slab; k_i < (i_ + 1) * L.slab && k_i < L.planes; ++k_i) {
        Ring ring_;
        if constexpr (RINGS) ring_ = ring_of(k_i);
        int j_i = at_ / L.chunks, c_ = at_ - j_i * L.chunks;
        for (int m_i = 0; m_i < here_; ++m_i, ++c_) {
            if (c_ == L.chunks) {
                c_ = 0;
                ++j_i;
            }
