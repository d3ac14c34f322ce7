// Where solids cut cells (CUT): the open part of a cell's lower faces, and how much of a cell its differences along an axis stand for.
#if CUT
auto open = [&](int axis, long long i) INLINE { return (T)openings[axis*layer + i]; };
auto counted = [&](int axis, long long i) INLINE { return (T)openings[(DIM + axis)*layer + i]; };
#else
auto open = [](int, long long) INLINE { return (T)1; };
auto counted = open;
#endif
