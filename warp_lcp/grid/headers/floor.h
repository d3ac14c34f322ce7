// The cell that a coordinate along an axis lies in, also where those of a part of a larger grid are below 0.
auto floor_of = [=](T x, int axis) { const int from = axis == 0 ? before_x : axis == 1 ? before_y : before_z; return (int)(x - (T)from) + from; };
