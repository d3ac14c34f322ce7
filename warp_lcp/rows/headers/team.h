// A team of threads works through a table of operations. The caller is thread 0; the others wait in here, and are asleep when idle.
//
// Operations are cut into chunks, which whoever is free takes, in order: one number counts those taken, another those done. An operation
// begins when all chunks before it are done, so nobody waits for a thread that holds none, as one whose core another process has. Who takes
// a chunk changes no result. A table's number of runs stands above the count, so that a thread that comes late takes nothing.
#ifndef __CUDA_ARCH__
typedef unsigned long long Word; typedef long long Long; typedef void (*Call)(void*, void*);
enum { RUN, SERVE, CANCEL, QUIT };                                                                    // what is asked for
enum { ALONE, TASKS, SLABS, GAPS };                                                                   // operations
enum { POSTED = 0, TABLE = 1, QUITS = 8, SLEEPERS = 16, MUTEX = 24, CONDITION = 40, CALLS = 56, THREADS = 64 };  // words of a team
enum { YIELD, CLOCK, NAP, LOCK, UNLOCK, WAIT, WAKE, CLOCK_NUMBER };                                   // functions of the system, from CALLS on
enum { NEXT = 0, DONE = 8, COUNT = 16, TOTAL = 17, OPERATIONS = 18, LATE = 19, SHARED = 20, UNFINISHED = 21 };  // words of a table
enum { END = 0, KIND = 1, STAGES = 2, STAGE_COUNT = 3, EACH = 4, ALL = 5, MARGIN = 6, PIECES = 7, WORDS = 8 };  // of an operation
enum { FUNCTION, BOUNDS, ARGUMENTS, BYTES, PLANE_TASKS, PLANES, LAG, FINER, FINER_PLANES, STAGE_WORDS = 10 };  // of a stage
enum { MOST = 4, ROOM = 4096, SPINS = 2000, YIELDS = 1000, IDLE_YIELDS = 4000 };
Word* T = (Word*)team_; Word* H = (Word*)table_;
const auto get = [](const Word* w) { return __atomic_load_n(w, __ATOMIC_SEQ_CST); };
const auto set = [](Word* w, Word v) { __atomic_store_n(w, v, __ATOMIC_SEQ_CST); };
const auto call = [=](int number, auto... arguments) { return ((long (*)(decltype(arguments)...))T[CALLS + number])(arguments...); };
const auto now = [=] { long t[2] = {0, 0}; call(CLOCK, (int)T[CALLS + CLOCK_NUMBER], (void*)t); return (Long)t[0]*1000000000 + t[1]; };
const auto relax = [=](int spins, int yields) {  // a little at first, then let others have the core, then sleep
    if (spins < SPINS) {
#if defined(__x86_64__)
        __builtin_ia32_pause();
#elif defined(__aarch64__)
        __asm__ volatile("yield");
#endif
    } else if (spins < SPINS + yields) call(YIELD);
    else { long t[2] = {0, 50000}; call(NAP, (const void*)t, (void*)nullptr); } };
const auto wake = [=] { call(LOCK, (void*)(T + MUTEX)); call(WAKE, (void*)(T + CONDITION)); call(UNLOCK, (void*)(T + MUTEX)); };

const auto take = [](const Word* made, char* arguments) {  // arguments of our own, which begin with the range of tasks
    const Word* from = (const Word*)made[ARGUMENTS]; Word* to = (Word*)arguments;
    for (Word w = 0; w < (made[BYTES] + 7) / 8; ++w) to[w] = from[w]; };
const auto run = [](const Word* made, char* arguments, Long begin, Long end) {
    ((int*)arguments)[0] = (int)begin; ((int*)arguments)[1] = (int)end;
    ((Call)made[FUNCTION])((void*)made[BOUNDS], arguments); };
const auto plane = [=](const Word* made, char* arguments, Long i, Long least, Long most) {  // plane i of the finest rows, if its turn has come
    const Long finer = (Long)made[FINER], planes = (Long)made[PLANES]; Long k = i;
    if (finer > 1) {  // a coarser level's plane is done once, with its last finer one
        const Long all = (Long)made[FINER_PLANES];
        if (i >= all || ((i + 1) % finer != 0 && i != all - 1)) return;
        k = i / finer;
        if (k*finer < least || k*finer >= most) return; }
    if (k < 0 || k >= planes || i < least) return;
    const Long tasks = (Long)made[PLANE_TASKS];
    run(made, arguments, k*tasks, (k + 1)*tasks); };

// A wave streams through memory once: each stage follows some planes behind the one before. Slabs leave out, beside a cut, as many planes
// as a stage lags: what they would need is the neighbor's. When all are done, the gaps are filled, stage after stage.
const auto work = [=](const Word* op, Long c) {
    char room[MOST][ROOM] __attribute__((aligned(16)));
    const Word* stages[MOST]; const int count = (int)op[STAGE_COUNT]; const Long everything = (Long)1 << 40;
    for (int s = 0; s < count; ++s) {
        stages[s] = (const Word*)op[STAGES] + s*STAGE_WORDS;
        if (op[KIND] != ALONE) take(stages[s], room[s]); }
    const Long each = (Long)op[EACH], all = (Long)op[ALL], slabs = op[KIND] == SLABS ? (Long)op[PIECES] : 0;
    if (op[KIND] == ALONE) ((Call)stages[0][FUNCTION])((void*)stages[0][BOUNDS], (void*)stages[0][ARGUMENTS]);
    else if (op[KIND] == TASKS) run(stages[0], room[0], c*each, (c + 1)*each < all ? (c + 1)*each : all);
    else if (op[KIND] == SLABS) {
        const Long first = c*each, last = c == slabs - 1 ? all + (Long)op[MARGIN] : first + each;
        for (Long i = first; i < last; ++i) for (int s = 0; s < count; ++s) {
            const Long lag = (Long)stages[s][LAG];
            plane(stages[s], room[s], i - lag, c ? first + lag : 0, everything); } }
    else {
        const Long cut = (c + 1)*each;
        for (int s = 0; s < count; ++s) {
            const Long lag = (Long)stages[s][LAG], finer = (Long)stages[s][FINER];
            const Long low = finer > 1 ? 0 : cut - lag, high = cut + lag;
            for (Long i = cut - lag; i < high + (finer > 1 ? finer - 1 : 0); ++i) plane(stages[s], room[s], i, low, high); } } };

const auto help = [=](Word* H, Word runs, Long limit) -> int {  // work through a table; 1: the caller's time is over first
    const Word* op = (const Word*)H[OPERATIONS]; const Word* last = op + WORDS*H[COUNT];
    const Long began = me ? 0 : now(); Long since = began; Word start = 0; int spins = 0;
    for (;;) {
        Word next = get(H + NEXT);
        if (next >> 32 != runs) return 0;
        const Word ticket = next & 0xffffffff;
        while (op < last && ticket >= op[END]) {
            if (!me && op[END] - start > 1) { const Long t = now(); H[SHARED] += t - since; since = t; }
            else if (!me) since = now();
            start = op[END]; op += WORDS; }
        const bool waits = op == last ? (!me && get(H + DONE) < H[TOTAL]) : get(H + DONE) < start || (me && op[KIND] == ALONE);
        if (op == last && !waits) return 0;
        if (waits) {
            if (!me && ++spins == SPINS + YIELDS) ++H[LATE];
            relax(me ? ++spins : spins, YIELDS);
            continue; }
        if (!me && now() - began > limit) return 1;
        if (!__atomic_compare_exchange_n(H + NEXT, &next, next + 1, false, __ATOMIC_SEQ_CST, __ATOMIC_SEQ_CST)) continue;
        spins = 0;
        work(op, (Long)(ticket - start));
        __atomic_fetch_add(H + DONE, 1, __ATOMIC_SEQ_CST); } };

if (mode == QUIT) { set(T + QUITS, 1); wake(); }
else if (mode == CANCEL) {  // nobody takes any more; wait for those who have
    Word next = get(H + NEXT);
    while (!__atomic_compare_exchange_n(H + NEXT, &next, ((next >> 32) + 1) << 32 | 0xffffffff, false, __ATOMIC_SEQ_CST, __ATOMIC_SEQ_CST)) {}
    for (int spins = 0; get(H + DONE) < (next & 0xffffffff); ++spins) relax(spins, YIELDS);
} else if (mode == RUN) {  // share: 0: alone, 1: with the team, 2: go on
    if (share < 2) { H[LATE] = H[SHARED] = 0; set(H + DONE, 0); set(H + NEXT, ((get(H + NEXT) >> 32) + 1) << 32); }
    if (share == 1) {
        set(T + TABLE, table_); set(T + POSTED, T[POSTED] + 1);
        if (get(T + SLEEPERS)) wake(); }
    H[UNFINISHED] = help(H, get(H + NEXT) >> 32, limit_);
} else {
    Word* ours = T + THREADS + 8*me; Word seen = 0;
    for (int spins = 0;;) {
        if (get(T + QUITS)) break;
        const Word posted = get(T + POSTED);
        if (posted != seen) {
            const Word table = get(T + TABLE);
            set(ours, table);  // from here on nobody frees it
            if (table && get(T + POSTED) == posted) {
                help((Word*)table, get((Word*)table + NEXT) >> 32, 0);
                seen = posted; spins = 0; }
            else if (!table && get(T + POSTED) == posted) seen = posted;
            set(ours, 0);
        } else if (spins < SPINS + IDLE_YIELDS) relax(++spins, IDLE_YIELDS);
        else {
            call(LOCK, (void*)(T + MUTEX));
            __atomic_fetch_add(T + SLEEPERS, 1, __ATOMIC_SEQ_CST);
            while (get(T + POSTED) == seen && !get(T + QUITS)) call(WAIT, (void*)(T + CONDITION), (void*)(T + MUTEX));
            __atomic_fetch_sub(T + SLEEPERS, 1, __ATOMIC_SEQ_CST);
            call(UNLOCK, (void*)(T + MUTEX));
            spins = 0; } } }
#endif
