// a product that is rounded with the sum that it is added to, or not
const auto times = [](double u, double f) { if constexpr (FUSED) return u*f; else { EXACT_MATH return u*f; } };
