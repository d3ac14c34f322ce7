// Particles add to fields around them. On CUDA a task has its own particles, on the CPU planes of the fields (rows in 2-D): all particles
// that touch those are added there in their order, so that each sum is the one that a single thread makes. Where the order is not that in
// which they lie, `runs` has the begin and the end of what lies in order, one run after another. Planes are cut where particles are: share
// s begins in the middle of chunk s/shares of all, so that sorted particles are as many in each share.
// visit(begin, end, ours): `ours` tells of a plane whether it is the task's. Its arithmetic is EXACT_MATH with `fused`: else the compiler might
// round in one form of it otherwise than in the other.
const auto each_share = [&](auto visit) {
    const auto all = [](int) { return true; };
#ifdef __CUDA_ARCH__
    visit((long long)P.first, (long long)P.first + n, all);
#else
    const auto cut = [&](int share) {
        const long long all = (count + chunk - 1)/chunk; int at = 0;
        for (int s = 1; touched && s <= share; ++s) {
            const long long c = s*all/shares; const int middle = (touched[2*c] + touched[2*c + 1])/2;
            at = at < middle ? middle : at; }
        return at; };
    const int from = cut(P.first), to = P.first + n < shares ? cut(P.first + n) : 1 << 30;
    const auto ours = [=](int plane) { return plane >= from && plane < to; };
    const int whole[2] = {0, (int)count}, *run = runs ? runs : whole, *end = run + (runs ? given.runs.shape[0] : 2);
    if (!touched) { for (; run < end; run += 2) visit((long long)run[0], (long long)run[1], all); return; }
    if (runs) { for (; run < end; run += 2) visit((long long)run[0], (long long)run[1], ours); return; }
    for (long long c = 0; c*chunk < count; ++c) {
        const int low = touched[2*c], high = touched[2*c + 1]; const long long begin = c*chunk, end = begin + chunk < count ? begin + chunk : count;
        if (low >= from && high <= to) visit(begin, end, all);
        else if (low < to && high > from) visit(begin, end, ours); }
#endif
};
