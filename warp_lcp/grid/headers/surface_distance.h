// Filled shares to distances [lattice cells]: phi = -spread sqrt(2) erfinv(2 share - 1), what a half space would be away, by the series up
// to the seventh power (0.2 % off at the nodes beside the surface); beyond the domain's sides there is air.
const int nx = given.phi.shape[2] - 2, ny = given.phi.shape[1] - 2, nz = given.phi.shape[0] - 2;
const float scale = -1.2533141f*spread;  // sqrt(pi / 2)
const bool beyond = j == 0 || j > ny || (planes == 2 && (k == 0 || k > nz));
float share[M];
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : (int)M;
    SIMD for (int m = 0; m < n; ++m) share[m] = smooth[start + m] + thin[start + m];
    if (capacity) {
        SIMD for (int m = 0; m < n; ++m) {
            const float c = capacity[start + m] > (float)LEAST_OPEN ? capacity[start + m] : (float)LEAST_OPEN;
            known[start + m] = capacity[start + m] > (float)LEAST_OPEN;
            share[m] /= c;
        }
    }
    SIMD for (int m = 0; m < n; ++m) {
        const float f = share[m] < 1 ? share[m] : 1.0f, z = 2*f - 1, q = z*z;
        const float d = scale*z*(1 + q*(0.26179939f + q*(0.14393173f + q*0.097663620f)));
        phi[start + m] = (beyond | (start + m == 0) | (start + m > nx)) ? 1.0f : d;
    }
}
