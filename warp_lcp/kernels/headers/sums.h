// Add the sums of a piece to those of the thread's piece in the plane below. On CUDA, where a
// thread has a piece in each plane of a slab, they stay in registers until its last plane. Integers
// are summed as integers there, since float64 is slow.
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
