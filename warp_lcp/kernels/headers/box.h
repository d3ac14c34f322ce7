// Task of a thread of a kernel over a box, on CUDA: some cells of a row in each plane of a slab, or
// a segment of a row (L.pieces). Index arithmetic that all planes share is done once. The loop over
// the planes follows.
struct Piece {
    int n, k, j, first, row;
    long long t;
    bool more;
};  // same members as in piece.h, as far as kernels over boxes need them
const long long places_ = (long long)((L.planes + L.slab - 1) / L.slab) * L.rows * L.chunks,
                places = places_;
const long long place_ = (long long)(slab_ * L.rows + row_) * L.chunks + chunk_;
double total_[FOUND ? FOUND : 1];
int whole_[FOUND ? FOUND : 1];
const int c_ = chunk_, begin_ = slab_ * L.slab,
          end_ = begin_ + L.slab < L.planes ? begin_ + L.slab : L.planes;
int plane_ = 0, j_ = row_, from_ = c_ * L.grain,
    to_ = L.nx - from_ < L.grain ? L.nx : from_ + L.grain;
if (L.pieces.data) {  // a box of one plane and row, of which each thread takes a segment
    const auto *segment = L.pieces.data + 2 * (long long)c_, *run = segment + 1;
    plane_ = (*segment)[0];
    j_ = (*segment)[1];
    from_ = (*run)[0];
    to_ = (*run)[1];
}
const int k0 = given.k0, j0 = given.j0, i0 = given.i0;
const int j = j_ + j0, first = from_ + i0;
const long long corner_ = (begin_ + plane_ + k0) * s1 + j * s2;  // of the first plane's row
