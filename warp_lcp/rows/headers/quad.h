// A thread's quads on CUDA: four cells of a row in each plane of a slab. Index arithmetic is of 32
// bits, and done once a thread.
//
// Fields that are read are loaded once, however often the row function reads them: `__ldg` tells
// the compiler that nothing in this launch changes them. Fields that are written are kept in
// registers until the row function ends.
#ifdef __CUDACC__
const auto load_ = [](const auto* q) { return __ldg(q); };
#else
const auto load_ = [](const auto* q) { return *q; };
#endif
// a field that is read; there are no templates within a function, so the class is a lambda's
const auto in_ = [](const auto* q, int first) {
    using V = decltype(load_(q));
    struct In {
        const V* q;
        int p;  // an address is made of both by one instruction
        METHOD V operator[](int k) const {
#ifdef __CUDACC__
            return __ldg(q + (p + k));
#else
            return q[p + k];
#endif
        }
        METHOD V operator*() const { return (*this)[0]; }
        METHOD In operator+(int offset) const { return In{q, p + offset}; }
        METHOD explicit operator bool() const { return q != nullptr; }
    };
    return In{q, first};
};
// a field that is written; cells beyond the quad are in memory
const auto out_ = [](auto* q, int first) {
    using V = decltype(load_(q));
    struct Out {
        V* q;
        int p;
        V v[4];
        bool used;
        METHOD Out(V* q, int p) : q(q), p(p), used(false) {
            if (q)
                for (int k = 0; k < 4; ++k) v[k] = q[p + k];
        }
        METHOD ~Out() {
            if (used)
                for (int k = 0; k < 4; ++k) q[p + k] = v[k];
        }
        METHOD V& operator[](int k) {
            if ((unsigned)k > 3) return q[p + k];
            used = true;
            return v[k];
        }
        METHOD V* operator+(int offset) const { return q + (p + offset); }
        METHOD explicit operator bool() const { return q != nullptr; }
    };
    return Out(q, first);
};
struct Quad {
    int p, n, ym, yp, zm, zp, k, j, first, row;
    long long t;
    bool more;
};  // as Piece
const int row_step_ = (int)L.s2, plane_step_ = (int)L.s1;
const int yp = FINER ? (int)L.o2 : row_step_, zp = FINER ? (int)L.o1 : plane_step_, ym = -yp,
          zm = -zp, down = zm, up = zp;
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
    int from_ = first_, to_ = beyond_;
    if (L.spans.data) {
        const auto span = L.spans.data[at_];
        from_ = from_ > span[0] ? from_ : span[0];
        to_ = to_ < span[1] ? to_ : span[1];
    }
    int q = 0;  // of the other level, whose cells stand for one of ours along an axis, or for two
    if constexpr (LEVELS) {
        const auto over = [](int i, int f) { return f < -1 ? i >> 1 : f > 1 ? 2 * i : i; };
        q = (int)L.o0 + over(k_i, L.fz) * (int)L.o1 + over(row_, L.fy) * (int)L.o2 +
            over(from_, L.fx);
    }
    const int p = p_ + from_;
    const bool last_ = k_i + 1 == end_;
    const Quad P = {
        p,           to_ > from_ ? to_ - from_ : 0, ym, yp, zm, zp, k_i, row_, from_, at_, place_,
        k_i > begin_};
