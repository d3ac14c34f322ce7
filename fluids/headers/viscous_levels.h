// Between a level and the finer one: coarse cell n covers cells 2n - 1 and 2n, coarse face n is face 2n - 1, and of parts of the two so many more.
const int shift[3] = {shift_x, shift_y, shift_z};
const auto clamped = [](int i, int n) { return i < 0 ? 0 : (i < n ? i : n - 1); };
