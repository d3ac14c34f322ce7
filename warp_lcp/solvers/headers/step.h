// The direction z + beta `along` in the place of `along`, where there is a z, and `to` = x + step `along`, onto the bounds where that is
// not 0. An x that is `guarded` stays as it is where the step is not finite. `kept` receives x.
const S part = (S)beta; const bool fresh = part == 0, open = !guarded;
if (z && (to || fresh)) SIMD for (int k = 0; k < n; ++k) along[k] = fresh ? z[k] : z[k] + part*along[k];  // rounded twice: a selection
else if (z) SIMD for (int k = 0; k < n; ++k) along[k] = z[k] + part*along[k];  // rounded once
if (kept) SIMD8 for (int k = 0; k < n; ++k) kept[k] = x[k];
if (to) with_bounds([&](auto lower, auto upper) {
    SIMD8 for (int k = 0; k < n; ++k) {
        const T v = x[k] + step*(T)along[k], c = clipped(v, lower(k), upper(k));
        to[k] = ((along[k] != 0) & (open | (v - v == 0))) ? c : x[k]; } });
