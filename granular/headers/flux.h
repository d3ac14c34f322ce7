// What passes a face counts by the face's mass: div(m u). A full cell cannot be compressed: it counts volume, div u, or else a block that
// falls would be squeezed at its front, where lighter faces let less out than comes in from behind. `passes` goes from one to the other.
auto passes = [](T mass, T full) INLINE { return mass + full*((T)1 - mass); };
auto fullness = [](T free) INLINE { const T c = (T)1 - free*(T)(1.0/NEARLY); return c < (T)0 ? (T)0 : c > (T)1 ? (T)1 : c; };
