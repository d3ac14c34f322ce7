// Interpolate the velocity at grid coordinates; points outside the domain and NaN are brought inside, along axes without an end from the
// other side.
auto sample = [&](const Block& at, Block& result, int n) {
    const T ex = nx + 1, ey = ny + 1, ez = nz + 1;
    for (int axis = 0; axis <= planes; ++axis) {
        const T* g = (axis == 0 ? given.u.data : (axis == 1 ? given.v.data : given.w.data)) - back;
        const T hx = axis == 0 ? (T)0 : (T)0.5, hy = axis == 1 ? (T)0 : (T)0.5, hz = axis == 2 ? (T)0 : (T)0.5;
        SIMD for (int m = 0; m < n; ++m) {
            T x = at[0][m], y = at[1][m], z = at[2][m];
            if (ENDLESS & 1) { x = x < 1 ? x + (T)nx : x; x = x < ex ? x : x - (T)nx; }
            if (ENDLESS & 4) { z = z < 1 ? z + (T)nz : z; z = z < ez ? z : z - (T)nz; }
            x = x > lx ? x : lx; y = y > ly ? y : ly; z = z > lz ? z : lz;
            x = (x < ex ? x : ex) - hx; y = (y < ey ? y : ey) - hy; z = planes == 2 ? (z < ez ? z : ez) - hz : (T)1;
            int i = floor_of(x, 0), j = floor_of(y, 1), k = floor_of(z, 2);
            i = i < nx ? i : nx; j = j < ny ? j : ny; k = k < nz ? k : nz;  // the next node is stored, too
            const T fx = x - (T)i, fy = y - (T)j, fz = z - (T)k;
            const T* a = g + (k*s1 + j*s2 + i); const T* b = a + up;
            const T a0 = a[0] + fx*(a[1] - a[0]), a1 = a[s2] + fx*(a[s2 + 1] - a[s2]);
            const T b0 = b[0] + fx*(b[1] - b[0]), b1 = b[s2] + fx*(b[s2 + 1] - b[s2]);
            const T low = a0 + fy*(a1 - a0), high = b0 + fy*(b1 - b0);
            result[axis][m] = low + fz*(high - low);
        }
    }
};
