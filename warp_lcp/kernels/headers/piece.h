// A piece: cells in x that lie side by side. What a cell's address is, is known here and nowhere
// else.
struct Piece {
    long long p;  // element of the first cell
    int n;  // cells
    // offsets to the rows beside it: below and above along y, down and up along z
    long long ym, yp, zm, zp;
    // of a field that keeps three planes: offset to its place there, and from there to the planes
    // around it
    long long ring, down, up;
    long long q;  // element of the other level that holds, or begins, the first cell
    int k, j, first, row;  // plane, row in it, first cell, counted from 0; row of all
    // place of the thread's sums, and whether something is there already
    int t;
    bool more;
};
// of the sums of all threads; a number may hide the name
const long long places_ = (L.planes + L.slab - 1) / L.slab * L.rows * L.chunks, places = places_;
// along an axis, from level to level
const auto over = [](int i, int f) -> long long { return f > 0 ? (long long)i * f : i / -f; };
// of a plane of a field that keeps three: elements beyond plane k, and to the planes around it
struct Ring {
    long long place, down, up;
};
const auto ring_of = [&](int k) -> Ring {
    // where the field has plane `at`: three in turn a slab, but those beside a cut as in a whole
    // field
    const auto place = [&](int at) {
        if (!L.cut) return at % 3;
        const int s = at / L.cut < L.slabs ? at / L.cut : L.slabs - 1, first = s * L.cut,
                  from = s ? first + L.apart : 0;
        return at < from || (s < L.slabs - 1 && at >= first + L.cut - L.apart)
                   ? at
                   : from + (at - from) % 3;
    };
    // the plane below the first of the ring stands below the first plane and above the last one,
    // unless those are in turn
    const int at = k + L.turn, here = place(at), below = at > 0 ? place(at - 1) : -1,
              above = k == L.planes - 1 && !L.turn ? -1 : place(at + 1);
    return {(here - k + L.lift) * L.s1, (below - here) * L.s1, (above - here) * L.s1};
};
const auto piece = [&](int k, int j, int c, const Ring& ring) -> Piece {
    // not above 2^31
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
