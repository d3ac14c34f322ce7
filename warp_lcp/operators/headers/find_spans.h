// The span of a row is what lies between its first and its last FLUID cell, both included, grown to whole vectors of 16 cells, so that
// aggregates stay whole, too. Rows that have one are marked in `reach`, the chunks of flat fields that they lie in in `chunks`; what is
// marked stays so. On the CPU eight cells at a time: a byte of v is 0 where a cell is FLUID, and there alone v - 1 sets a highest bit that
// ~v has, but for bytes behind one of them.
const auto none = [&](int k) {
#ifdef __CUDA_ARCH__
    return false;
#else
    unsigned long long v, ones = 0x0101010101010101ull;
    __builtin_memcpy(&v, cells + k, 8); v ^= ones;
    return ((v - ones) & ~v & ones << 7) == 0;
#endif
};
int first = 0, last = n;
while (first + 8 <= n && none(first)) first += 8;
while (first < n && cells[first] != 1) ++first;
while (last - 8 >= first && none(last - 8)) last -= 8;
while (last > first && cells[last - 1] != 1) --last;
const bool any = last > first; const int end = (last + SPAN_CELLS - 1) / SPAN_CELLS * SPAN_CELLS;
spans[P.row] = any ? wp::vec2i(first / SPAN_CELLS * SPAN_CELLS, end < n ? end : n) : wp::vec2i(0, 0);
if (any) {
    reach[P.row] = wp::vec2i(0, n);
    const long long begin = p - 1, row = yp;  // of the stored row, with its ghosts
    for (long long c = begin / CHUNK; c < chunk_count && c <= (begin + row - 1) / CHUNK; ++c) {
        const long long left = size - c*CHUNK;
        chunks[c] = wp::vec2i(0, (int)(left < CHUNK ? left : CHUNK)); } }
