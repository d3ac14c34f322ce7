// Quads of a thread on CUDA: four cells of a row in each plane of a slab. Index arithmetic uses 32
// bits and is done once per thread.
//
// Fields that are read are loaded once, however often the row function reads them: `__ldg` tells
// the compiler that this launch does not change them. Fields that are written are kept in registers
// until the row function ends.
//
// If the alignment of rows is known, fields are loaded in blocks of 16 bytes (byte fields: 4
// bytes): the two blocks that contain a quad and the cells beside it. The class At describes the
// alignment. FIRST >= 0: rows begin FIRST elements after a multiple of four; with EITHER, every
// second row begins at FIRST + 2. FIRST < 0: unknown, and each cell is loaded on its own. The row
// function is compiled for both beginnings, so that it selects nothing at run time: the compiler
// knows the last two bits of the offsets to other rows and planes. Fields may be shifted by such
// offsets and by even numbers of cells; x[k - 1] and x[k + 1] are the neighbors of cell k.
#ifdef __CUDACC__
const auto load_ = [](const auto* q) { return __ldg(q); };
#else
const auto load_ = [](const auto* q) { return *q; };
#endif
struct Fixed_ {
    enum { FIXED = 1 };
};  // for fields that this launch does not change
struct Kept_ {
    enum { FIXED = 0 };
};
// A function cannot contain templates: these are local classes of generic lambdas.
const auto in_at_ = [](auto at, auto fixed, const auto* q, int first, bool half) {
    using V = decltype(load_(q));
    using At = decltype(at);
    constexpr bool FIXED = decltype(fixed)::FIXED;
    struct In {
        enum { REAL = (V)0.5 != (V)0 };
        // One instruction adds q and p. p: offset of the block, FIRST or FIRST + 2 before the cell.
        const V* q;
        int p;
        bool half;
        // element i of the block at b
        METHOD static V of_block(const V* b, int i) {
#ifdef __CUDACC__
            if constexpr (sizeof(V) == 8) {
                const double2 v = FIXED ? __ldg((const double2*)b) : *(const double2*)b;
                return i ? v.y : v.x;
            } else if constexpr (REAL) {
                const float4 v = FIXED ? __ldg((const float4*)b) : *(const float4*)b;
                return i == 0 ? v.x : i == 1 ? v.y : i == 2 ? v.z : v.w;
            } else {
                const int4 v = FIXED ? __ldg((const int4*)b) : *(const int4*)b;
                return i == 0 ? v.x : i == 1 ? v.y : i == 2 ? v.z : v.w;
            }
#else
            return b[i];
#endif
        }
        METHOD static unsigned word(const V* b) {  // four bytes as one word
#ifdef __CUDACC__
            return FIXED ? __ldg((const unsigned*)b) : *(const unsigned*)b;
#else
            const unsigned char* v = (const unsigned char*)b;
            return v[0] | v[1] << 8 | v[2] << 16 | (unsigned)v[3] << 24;
#endif
        }
        METHOD V operator[](int k) const {
            if constexpr (At::FIRST >= 0) {
                if ((unsigned)(k + 4) < 16u) {  // known at compile time when loops are unrolled
                    const V* b = q + p;
                    const int i = At::FIRST + k, j = i + 2;
                    if constexpr (sizeof(V) == 1) {
                        const unsigned v = word(b + (i & ~3)) >> 8 * (i & 3);
                        const unsigned w = half ? word(b + (j & ~3)) >> 8 * (j & 3) : v;
                        return (V)(w & 255u);
                    } else {
                        constexpr int within = sizeof(V) == 8 ? 1 : 3;
                        const V v = of_block(b + (i & ~within), i & within);
                        if constexpr (!At::EITHER) return v;
                        const V w = of_block(b + (j & ~within), j & within);
                        return half ? w : v;
                    }
                }
            }
            const V* cell = q + (At::FIRST < 0 ? p + k : p + At::FIRST + 2 * half + k);
#ifdef __CUDACC__
            return FIXED ? __ldg(cell) : *cell;
#else
            return *cell;
#endif
        }
        METHOD V operator*() const { return (*this)[0]; }
        METHOD In operator+(int offset) const {
            if constexpr (!At::EITHER) return In{q, p + offset, false};
            return In{q, p + (offset + 2 * half & ~3), (bool)(offset >> 1 & 1) != half};
        }
        METHOD explicit operator bool() const { return q != nullptr; }
    };
    return In{q, At::FIRST < 0 ? first : first - At::FIRST - 2 * half, half};
};
// A field that is written. Cells beyond the quad are accessed in memory.
const auto out_at_ = [&](auto* q, int first, bool half) {
    const auto before = in_at_(Ours_(), Kept_(), q, first, half);
    using V = decltype(load_(q));
    using In = decltype(in_at_(Ours_(), Kept_(), q, first, half));
    struct Out {
        V* q;
        int p;
        V v[4];
        bool used;
        METHOD Out(V* q, int p, const In& before) : q(q), p(p), used(false) {
            if (q)
                for (int k = 0; k < 4; ++k) v[k] = before[k];
        }
        METHOD ~Out() {
            if (!used) return;
            V* to = q + p;
            if constexpr (Ours_::FIRST < 0)
                for (int k = 0; k < 4; ++k) to[k] = v[k];
            else if constexpr (Ours_::FIRST % 2) {
                to[0] = v[0];
                put_two(to + 1, v[1], v[2]);
                to[3] = v[3];
            } else if constexpr (Ours_::FIRST == 0 && !Ours_::EITHER)
                put_four(to);
            else {
                put_two(to, v[0], v[1]);
                put_two(to + 2, v[2], v[3]);
            }
        }
#ifdef __CUDACC__
        METHOD static void put_two(V* to, V a, V b) {
            if constexpr (sizeof(V) == 8)
                *(double2*)to = make_double2(a, b);
            else if constexpr (sizeof(V) == 1)
                *(uchar2*)to = make_uchar2((unsigned char)a, (unsigned char)b);
            else if constexpr ((V)0.5 != (V)0)
                *(float2*)to = make_float2(a, b);
            else
                *(int2*)to = make_int2(a, b);
        }
        METHOD void put_four(V* to) const {
            if constexpr (sizeof(V) == 8) {
                put_two(to, v[0], v[1]);
                put_two(to + 2, v[2], v[3]);
            } else if constexpr (sizeof(V) == 1)
                *(uchar4*)to = make_uchar4((unsigned char)v[0], (unsigned char)v[1],
                                           (unsigned char)v[2], (unsigned char)v[3]);
            else if constexpr ((V)0.5 != (V)0)
                *(float4*)to = make_float4(v[0], v[1], v[2], v[3]);
            else
                *(int4*)to = make_int4(v[0], v[1], v[2], v[3]);
        }
#else
        METHOD static void put_two(V* to, V a, V b) {
            to[0] = a;
            to[1] = b;
        }
        METHOD void put_four(V* to) const {
            for (int k = 0; k < 4; ++k) to[k] = v[k];
        }
#endif
        METHOD V& operator[](int k) {
            if ((unsigned)k > 3) return q[p + k];
            used = true;
            return v[k];
        }
        METHOD V* operator+(int offset) const { return q + (p + offset); }
        METHOD explicit operator bool() const { return q != nullptr; }
    };
    return Out(q, first, before);
};
// accessors of a field, from the field and its first element
const auto reading_ = [&](auto at, bool half) {
    return [=](const auto* q, int first) { return in_at_(at, Fixed_(), q, first, half); };
};
const auto writing_ = [&](bool half) {
    return [=](auto* q, int first) { return out_at_(q, first, half); };
};
struct Quad {
    int p, n, ym, yp, zm, zp, k, j, first, row;
    long long t;
    bool more;
};  // same members as Piece
const auto row_of_ = [](auto at, int step) {
    using At = decltype(at);
    return At::EITHER ? (step & ~3) + 2 : At::FIRST < 0 ? step : step & ~3;
};
const auto plane_of_ = [](auto at, int step) { return decltype(at)::FIRST < 0 ? step : step & ~3; };
const int row_step_ = row_of_(Ours_(), (int)L.s2), plane_step_ = plane_of_(Ours_(), (int)L.s1);
const int yp = FINER ? row_of_(Others_(), (int)L.o2) : row_step_,
          zp = FINER ? plane_of_(Others_(), (int)L.o1) : plane_step_, ym = -yp, zm = -zp, down = zm,
          up = zp;
const int begin_ = slab_ * L.slab, end_ = begin_ + L.slab < L.planes ? begin_ + L.slab : L.planes;
const int first_ = 4 * chunk_, beyond_ = first_ + 4 < L.nx ? first_ + 4 : L.nx;
const long long places_ = (long long)((L.planes + L.slab - 1) / L.slab) * L.rows * L.chunks,
                places = places_;
const long long place_ = (long long)(slab_ * L.rows + row_) * L.chunks + chunk_;
double total_[FOUND ? FOUND : 1];
int whole_[FOUND ? FOUND : 1];
for (int k_i = begin_, p_ = (int)L.base + begin_ * plane_step_ + row_ * row_step_,
         at_ = begin_ * L.rows + row_;
     k_i < end_; ++k_i, p_ += plane_step_, at_ += L.rows) {
    // Quads prefetch nothing, on a CPU that computes them for comparison, too.
    const auto fetch = [](int, int, const auto&...) {};
    int from_ = first_, to_ = beyond_;
    if (L.spans.data) {
        const auto span = L.spans.data[at_];
        from_ = from_ > span[0] ? from_ : span[0];
        to_ = to_ < span[1] ? to_ : span[1];
    }
    // Cell of the other level. One of its cells covers one or two cells of this level on an axis.
    int q = 0;
    if constexpr (LEVELS) {
        const auto over = [](int i, int f) { return f < -1 ? i >> 1 : f > 1 ? 2 * i : i; };
        q = (int)L.o0 + over(k_i, L.fz) * (int)L.o1 + over(row_, L.fy) * (int)L.o2 +
            over(from_, L.fx);
    }
    const bool half_ = Ours_::EITHER && p_ & 2, other_half_ = Others_::EITHER && q & 2;
    const int p = p_ + from_;
    const bool last_ = k_i + 1 == end_;
    const Quad P = {
        p,           to_ > from_ ? to_ - from_ : 0, ym, yp, zm, zp, k_i, row_, from_, at_, place_,
        k_i > begin_};
