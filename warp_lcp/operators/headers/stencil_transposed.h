// y = A' x of a compact stencil: a neighbor's weight for this cell times the neighbor.
#define ADD(W, X, Y, Z) + W(k - (X) + beside(-(Y), -(Z), zm, zp))*x[k - (X) + beside(-(Y), -(Z), zm, zp)]
for (int k = 0; k < n; ++k) { const T e = diagonal(k); y[k] = e != 0 ? e*x[k] - ((T)0 EACH_WEIGHT(ADD)) : (T)0; }
#undef ADD
