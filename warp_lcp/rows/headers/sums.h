// What a piece has found joins that of the thread's piece in the plane below: on CUDA, where it has one in each, in registers until its last.
const auto joined_ = [](int s, double a, double b) -> double { return s < SUMS ? a + b : b > a ? b : a; };
#ifdef __CUDA_ARCH__
for (int s = 0; s < FOUND; ++s) total_[s] = P.more ? joined_(s, all_[s], total_[s]) : all_[s];
if ((k_i + 1) % L.slab == 0 || k_i + 1 == L.planes) for (int s = 0; s < FOUND; ++s) sums_[s*places_] = total_[s];
#else
for (int s = 0; s < FOUND; ++s, sums_ += places_) *sums_ = P.more ? joined_(s, all_[s], *sums_) : all_[s];
#endif
