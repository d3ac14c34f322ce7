// Restart where the gradient has grown, else x += beta p and p = beta p - g; `squares`: of the gradient now, before (0: none).
const T now = squares[0], before = squares[1]; const bool grown = before > 0 && now/before > 1;
const T beta = before > 0 && !grown ? now/before : (T)0, keep = grown ? (T)0 : (T)1;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int k = 0; k < n; ++k) {
        const T q = beta*along[k], c = clipped(x[k] + q, lower(k), upper(k)); const bool in = unknown[k] == 1;
        x[k] = in ? c : x[k]; along[k] = in ? q - keep*g[k] : (T)0; } });
