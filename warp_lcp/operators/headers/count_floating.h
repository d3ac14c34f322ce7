// How many roots nothing holds
const int q = (int)p; int floating = 0;
SIMD for (int k = 0; k < n; ++k) floating += (cells[k] == 1) & (parent[k] == q + k) & (grounded[k] == 0);
if (floating) count_up(count, floating);
