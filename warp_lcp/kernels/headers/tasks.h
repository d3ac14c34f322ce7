// Loop over tasks from (i_, j_, c_) on. A task is a chunk of a row in each plane of a slab. On CUDA
// a thread has one task; on the CPU it has as many as a thread of the pool takes at once. The body
// follows and ends with three braces.
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
