#include "transfer.h"
// Cells amid four coarse ones: what the cell's row gives of its neighbors' shares.
if (fx == 2 && fy == 2 && P.j % 2) for (int k = 1 - P.first % 2; k < n; k += 2) {
    const long long at = p + k; const T e = d[k];
    const auto share = [&](int slot, int x, int y) -> T { return shares[slot*size + at + x + y*yp]; };
    const T inverse = e != 0 ? 1/e : (T)0, west = v(-1, 0, at), east = v(1, 0, at), south = v(0, -1, at), north = v(0, 1, at);
    shares[at] = inverse*(v(-1, -1, at) + south*share(0, 0, -1) + west*share(0, -1, 0));
    shares[size + at] = inverse*(v(1, -1, at) + south*share(1, 0, -1) + east*share(0, 1, 0));
    shares[2*size + at] = inverse*(v(-1, 1, at) + north*share(0, 0, 1) + west*share(2, -1, 0));
    shares[3*size + at] = inverse*(v(1, 1, at) + north*share(1, 0, 1) + east*share(2, 1, 0)); }
