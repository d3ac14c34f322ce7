// The distance to walls and its gradient at grid coordinates in the domain, in cells: that of the solids, linear between nodes, or of the
// domain. The smaller of both taken at the nodes would close what is open between a solid and the domain's wall next to it.
const float* level = given.distance.data - back;
const T aim = (T)AIM;
const int counts[3] = {nx, ny, nz};
auto into_domain = [&](T* x) {
    for (int d = 0; d <= planes; ++d) {
        const T end = counts[d] + 1;
        if (ENDLESS >> d & 1) { x[d] = x[d] < 1 ? x[d] + (T)counts[d] : x[d]; x[d] = x[d] < end ? x[d] : x[d] - (T)counts[d]; }
        const T least = first_cell[d];
        x[d] = x[d] > least ? x[d] : least; x[d] = x[d] < end ? x[d] : end;
    }
};
auto closed = [=](int side) { return !(open_sides >> side & 1); };
auto measure = [&](const T* x, T* g) -> T {
    int i = floor_of(x[0], 0), j = floor_of(x[1], 1), k = planes == 2 ? floor_of(x[2], 2) : 1;
    i = i < nx ? i : nx; j = j < ny ? j : ny; k = k < nz ? k : nz;
    const T fx = x[0] - (T)i, fy = x[1] - (T)j, fz = planes == 2 ? x[2] - (T)k : (T)0;
    const T* a = level + (k*s1 + j*s2 + i); const T* b = a + up;
    const T a0 = a[0] + fz*(b[0] - a[0]), a1 = a[1] + fz*(b[1] - a[1]);
    const T c0 = a[s2] + fz*(b[s2] - a[s2]), c1 = a[s2 + 1] + fz*(b[s2 + 1] - a[s2 + 1]);
    const T low = a0 + fx*(a1 - a0), high = c0 + fx*(c1 - c0);
    g[0] = (a1 - a0) + fy*((c1 - c0) - (a1 - a0)); g[1] = high - low; g[2] = 0;
    if (planes == 2) {
        const T d0 = (b[0] - a[0]) + fx*((b[1] - a[1]) - (b[0] - a[0]));
        const T d1 = (b[s2] - a[s2]) + fx*((b[s2 + 1] - a[s2 + 1]) - (b[s2] - a[s2]));
        g[2] = d0 + fy*(d1 - d0);
    }
    T least = low + fy*(high - low);
    for (int d = 0; d <= planes; ++d) {
        const T below = closed(2*d) ? x[d] - (T)first_cell[d] : (T)1e9, above = closed(2*d + 1) ? (T)(counts[d] + 1) - x[d] : (T)1e9;
        const T side = below < above ? below : above;
        if (side < least) { least = side; g[0] = 0; g[1] = 0; g[2] = 0; g[d] = below < above ? (T)1 : (T)-1; }
    }
    return least;
};
auto measure_all = [&](const Block& at, T* result, int n) {
    const T ex = nx + 1, ey = ny + 1, ez = nz + 1, far = 1e9;
    const T x0 = closed(0) ? lx : -far, x1 = closed(1) ? ex : far, y0 = closed(2) ? ly : -far, y1 = closed(3) ? ey : far;
    const T z0 = closed(4) ? lz : -far, z1 = closed(5) ? ez : far;
    SIMD for (int m = 0; m < n; ++m) {
        T x = at[0][m], y = at[1][m], z = planes == 2 ? at[2][m] : (T)1;
        x = x > lx ? x : lx; y = y > ly ? y : ly; z = z > lz ? z : lz;
        x = x < ex ? x : ex; y = y < ey ? y : ey; z = z < ez ? z : ez;
        int i = floor_of(x, 0), j = floor_of(y, 1), k = floor_of(z, 2);
        i = i < nx ? i : nx; j = j < ny ? j : ny; k = k < nz ? k : nz;
        const T fx = x - (T)i, fy = y - (T)j, fz = z - (T)k;
        const T* a = level + (k*s1 + j*s2 + i); const T* b = a + up;
        const T a0 = a[0] + fx*(a[1] - a[0]), a1 = a[s2] + fx*(a[s2 + 1] - a[s2]);
        const T b0 = b[0] + fx*(b[1] - b[0]), b1 = b[s2] + fx*(b[s2 + 1] - b[s2]);
        const T low = a0 + fy*(a1 - a0), high = b0 + fy*(b1 - b0);
        const T ax = x - x0 < x1 - x ? x - x0 : x1 - x, ay = y - y0 < y1 - y ? y - y0 : y1 - y;
        const T az = planes == 2 ? (z - z0 < z1 - z ? z - z0 : z1 - z) : ax, s = low + fz*(high - low);
        const T flat = ax < ay ? ax : ay, side = flat < az ? flat : az;
        result[m] = s < side ? s : side;
    }
};
auto square = [](const T* g) { return g[0]*g[0] + g[1]*g[1] + g[2]*g[2]; };
