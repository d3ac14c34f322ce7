// Where solids cut cells (CUT): the open part of a cell's lower faces, and how much of a cell its differences along an axis stand for.
#if CUT
auto open = [&](int axis, long long i) INLINE { return (T)openings[axis*layer + i]; };
auto counted = [&](int axis, long long i) INLINE { return (T)openings[(DIM + axis)*layer + i]; };
#else
auto open = [](int, long long) INLINE { return (T)1; };
auto counted = open;
#endif
// What passes a face counts by the face's mass: div(m u). A full cell cannot be compressed: it counts volume, div u, or else a block that
// falls would be squeezed at its front, where lighter faces let less out than comes in from behind. `passes` goes from one to the other.
auto passes = [](T mass, T full) INLINE { return mass + full*((T)1 - mass); };
auto fullness = [](T free) INLINE { const T c = (T)1 - free*(T)(1.0/NEARLY); return c < (T)0 ? (T)0 : c > (T)1 ? (T)1 : c; };
