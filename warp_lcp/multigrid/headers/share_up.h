// x += the coarse field by the cells' shares, or x = that.
const long long up_ = L.o2;
for (int k = 0; k < n; ++k) {
    const long long at = p + k; const T* c = coarse + (L.fx < -1 ? k / 2 : k);
    const T v = shares[at]*c[0] + shares[size + at]*c[1] + shares[2*size + at]*c[up_] + shares[3*size + at]*c[up_ + 1];
    x[k] = d[k] != 0 ? (add ? x[k] : (T)0) + v : (T)0; }
