// x, less what is to be left out, on the members; elsewhere what was there, or 0
const auto select = [&](auto value) {
    SIMD for (int k = 0; k < n; ++k) { const double v = value(k), rest = kept ? target[k] : 0.0; target[k] = member[k] ? v : rest; } };
if (less) select([&](int k) { return x[k] - less[k]; }); else select([&](int k) { return x[k]; });
