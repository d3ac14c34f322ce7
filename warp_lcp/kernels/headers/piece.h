// Piece: consecutive cells of a row along x. Only this header computes the addresses of cells.
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
