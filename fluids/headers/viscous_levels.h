// Between a level and the finer one: coarse cell n covers cells 2n - 1 and 2n, coarse face n is face 2n - 1.
const auto clamped = [](int i, int n) { return i < 0 ? 0 : (i < n ? i : n - 1); };
