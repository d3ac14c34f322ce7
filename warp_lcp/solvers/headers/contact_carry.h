// r <- r + beta p, p <- beta p - g with beta = |g|^2 / |g before|^2; p <- 0 where that is above 1
const double fresh = state[now], old = state[1 - now], ratio = old > 0.0 ? fresh/old : 0.0;
const double beta = ratio > 1.0 ? 0.0 : ratio, keep = ratio > 1.0 ? 0.0 : 1.0;
SIMD8 for (int k = 0; k < n; ++k) {
    const double along = way[k], back = g[k];
    r[k] += beta*along;
    way[k] = beta*along - keep*back;
}
