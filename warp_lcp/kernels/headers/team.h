// Thread pool that works through a table of operations. The caller is thread 0; the other threads
// wait in this function and sleep when idle.
//
// Operations are cut into chunks, which are distributed over lanes. A thread takes the chunks of
// its own lane from the front, so that it finds their data in its core's cache, then those of other
// lanes from the back. An operation begins when all chunks before it are done. No thread waits for
// another that holds no chunk, for example because another process uses its core. The results do
// not depend on which thread takes a chunk. The counter of a lane includes the table's number of
// runs, so that a thread that arrives late takes nothing, and counters are not reset.
#ifndef __CUDA_ARCH__
// not inlined: inlining doubles the compile time
#define APART __attribute__((noinline))
typedef unsigned long long Word;
typedef long long Long;
typedef void (*Call)(void*, void*);
// modes
enum { RUN, SERVE, CANCEL, QUIT };
// kinds of operations
enum { ALONE, TASKS, SLABS, COPY };
// layout of a pool, in words
enum {
    POSTED = 0,
    TABLE = 1,
    IDLE_SPINS = 2,
    QUITS = 8,
    SLEEPERS = 16,
    MUTEX = 24,
    CONDITION = 40,
    CALLS = 56,
    THREADS = 64
};
// system functions, in the words from CALLS on
enum { YIELD, CLOCK, NAP, LOCK, UNLOCK, WAIT, WAKE, CLOCK_NUMBER };
// layout of a table, in words
enum {
    RUNS = 0,
    DONE = 8,
    COUNT = 16,
    TOTAL = 17,
    OPERATIONS = 18,
    SHARED = 19,
    UNFINISHED = 20,
    AGAIN = 21
};
// layout of an operation
enum {
    END,
    KIND,
    STAGES,
    STAGE_COUNT,
    EACH,
    ALL,
    MARGIN,
    CHUNKS,
    LANES,
    TAKEN,
    CUTS,
    SIZED,
    WHEN,
    WORDS
};
// layout of a stage
enum {
    FUNCTION,
    BOUNDS,
    ARGUMENTS,
    BYTES,
    PLANE_TASKS,
    PLANES,
    LAG,
    FINER,
    FINER_PLANES,
    PATCHES,
    STAGE_WORDS
};
enum { LANE_WORDS = 8, MOST = 4, ROOM = 4096, SPINS = 2000, YIELDS = 1000, IDLE_YIELDS = 4000 };
Word* T = (Word*)team_;
Word* H = (Word*)table_;
const auto get = [](const Word* w) { return __atomic_load_n(w, __ATOMIC_SEQ_CST); };
const auto set = [](Word* w, Word v) { __atomic_store_n(w, v, __ATOMIC_SEQ_CST); };
const auto call = [=](int number, auto... arguments) {
    return ((long (*)(decltype(arguments)...))T[CALLS + number])(arguments...);
};
const auto now = [=] {
    long t[2] = {0, 0};
    call(CLOCK, (int)T[CALLS + CLOCK_NUMBER], (void*)t);
    return (Long)t[0] * 1000000000 + t[1];
};
// Wait: spin at first, then yield the core, then sleep.
const auto relax = [=](int spins, int most, int yields) APART {
    if (spins < most) {
#if defined(__x86_64__)
        __builtin_ia32_pause();
#elif defined(__aarch64__)
        __asm__ volatile("yield");
#endif
    } else if (spins < most + yields)
        call(YIELD);
    else {
        long t[2] = {0, 50000};
        call(NAP, (const void*)t, (void*)nullptr);
    }
};
const auto wake = [=] {
    call(LOCK, (void*)(T + MUTEX));
    call(WAKE, (void*)(T + CONDITION));
    call(UNLOCK, (void*)(T + MUTEX));
};

// Copy the arguments of a stage for this thread. They begin with the range of tasks.
const auto take = [](const Word* made, char* arguments) {
    const Word* from = (const Word*)made[ARGUMENTS];
    Word* to = (Word*)arguments;
    for (Word w = 0; w < (made[BYTES] + 7) / 8; ++w) to[w] = from[w];
    // Patches: arguments that change from run to run (windows, lists, numbers) are read from their
    // source.
    const Word* patch = (const Word*)made[PATCHES];
    if (!patch) return;
    for (Word left = *patch++; left > 0; --left, patch += 3)
        __builtin_memcpy(arguments + patch[0], (const void*)patch[1], patch[2]);
};
// Copy bytes of a field, or clear them.
const auto copy = [](const Word* made, Long begin, Long end) {
    const char* from = (const char*)made[FUNCTION];
    char* to = (char*)made[ARGUMENTS];
    if (from)
        __builtin_memcpy(to + begin, from + begin, end - begin);
    else
        __builtin_memset(to + begin, 0, end - begin);
};
const auto run = [](const Word* made, char* arguments, Long begin, Long end) {
    ((int*)arguments)[0] = (int)begin;
    ((int*)arguments)[1] = (int)end;
    ((Call)made[FUNCTION])((void*)made[BOUNDS], arguments);
};
// Run plane i, counted on the finest level, if it is due.
const auto plane = [=](const Word* made, char* arguments, Long i, Long least, Long most) APART {
    const Long finer = (Long)made[FINER], planes = (Long)made[PLANES];
    Long k = i;
    if (finer > 1) {  // a coarser level's plane runs once, with its last finer plane
        const Long all = (Long)made[FINER_PLANES];
        if (i >= all || ((i + 1) % finer != 0 && i != all - 1)) return;
        k = i / finer;
        if (k * finer < least || k * finer >= most) return;
    }
    if (k < 0 || k >= planes || i < least) return;
    const Long tasks = (Long)made[PLANE_TASKS];
    run(made, arguments, k * tasks, (k + 1) * tasks);
};

const auto start_of = [](const Word* op, Word lane) { return lane * op[CHUNKS] / op[LANES]; };
// Take a chunk of a lane and return it. -1: none is left, or the next one is not `wanted`.
const auto take_of = [=](const Word* op, Word lane, Word runs, bool back, Long wanted)
                         APART -> Long {
    Word* word = (Word*)op[TAKEN] + lane * LANE_WORDS;
    const Word start = start_of(op, lane), all = start_of(op, lane + 1) - start;
    for (;;) {
        Word w = get(word);
        if ((int)(unsigned)((w >> 32) - runs) > 0) return -1;
        const Word front = w >> 32 == runs ? w & 0xffff : 0,
                   behind = w >> 32 == runs ? w >> 16 & 0xffff : 0;
        const Long chunk = (Long)(back ? start + all - 1 - behind : start + front);
        if (front + behind >= all || (wanted >= 0 && chunk != wanted)) return -1;
        const Word more = runs << 32 | (behind + back) << 16 | (front + !back);
        if (__atomic_compare_exchange_n(word, &w, more, false, __ATOMIC_SEQ_CST, __ATOMIC_SEQ_CST))
            return chunk;
    }
};
const auto take_any = [=](const Word* op, Word runs) -> Long {
    for (Word l = 0; l < op[LANES]; ++l) {
        const Long chunk = take_of(op, (me + l) % op[LANES], runs, l > 0, -1);
        if (chunk >= 0) return chunk;
    }
    return -1;
};
// Whether this thread now owns the chunk.
const auto take_next = [=](const Word* op, Word runs, Word chunk) {
    for (Word l = 0; l < op[LANES]; ++l)
        if (chunk < start_of(op, l + 1)) return take_of(op, l, runs, false, (Long)chunk) >= 0;
    return false;
};

// Fused kernel: stream through memory once, each stage some planes (its lag) behind the one before.
// A thread that also takes the next slab continues across the cut. Otherwise it leaves a gap beside
// the cut, as wide as a stage's lag, since the values there need those of the neighboring slab. Of
// the two threads beside the gap, the one that finishes last fills it.
const auto stream = [=](const Word* op, Word runs, Long c, const Word** stages,
                        char (*room)[ROOM]) -> Word {
    const int count = (int)op[STAGE_COUNT];
    const Long each = (Long)op[EACH], slabs = (Long)op[CHUNKS], everything = (Long)1 << 40,
               from = c;
    for (Long i = c * each;; ++c) {
        const Long last = c == slabs - 1 ? (Long)(op[ALL] + op[MARGIN]) : (c + 1) * each;
        for (; i < last; ++i)
            for (int s = 0; s < count; ++s) {
                const Long lag = (Long)stages[s][LAG];
                plane(stages[s], room[s], i - lag, from ? from * each + lag : 0, everything);
            }
        if (c == slabs - 1 || !take_next(op, runs, (Word)(c + 1))) break;
    }
    for (int side = 0; side < 2; ++side) {
        const Long beside = side ? c + 1 : from;
        if (!beside || beside == slabs ||
            __atomic_exchange_n((Word*)op[CUTS] + beside, runs, __ATOMIC_SEQ_CST) != runs)
            continue;
        for (int s = 0; s < count; ++s) {
            const Long cut = beside * each, lag = (Long)stages[s][LAG],
                       finer = (Long)stages[s][FINER];
            const Long low = finer > 1 ? 0 : cut - lag, high = cut + lag;
            for (Long i = cut - lag; i < high + (finer > 1 ? finer - 1 : 0); ++i)
                plane(stages[s], room[s], i, low, high);
        }
    }
    return (Word)(c + 1 - from);
};

// Execute a chunk and those that follow it; return their number.
const auto work = [=](const Word* op, Word runs, Long c) -> Word {
    // the condition changes between operations only
    if (op[WHEN] && !*(const volatile int*)op[WHEN]) return 1;
    // SIZED: the number of tasks is known at run time. Use as many pieces as they fill, at most
    // CHUNKS, equally many for each lane. Piece q belongs to chunk c if c*pieces/chunks <= q < (c +
    // 1)*pieces/chunks, so that all lanes have pieces.
    Long all = (Long)op[ALL], each = (Long)op[EACH], first = c;
    if (op[SIZED]) {
        all = *(const Long*)op[SIZED];
        const Long chunks = (Long)op[CHUNKS], lanes = (Long)op[LANES];
        Long pieces = each > 0 && all / each < chunks ? all / each : chunks;
        pieces = pieces > lanes ? pieces - pieces % lanes : pieces > 0 ? pieces : 1;
        first = c * pieces / chunks;
        if (all <= 0 || first == (c + 1) * pieces / chunks) return 1;
        each = (all + pieces - 1) / pieces;
    }
    char room[MOST][ROOM] __attribute__((aligned(16)));
    const Word* stages[MOST];
    for (int s = 0; s < (int)op[STAGE_COUNT]; ++s) {
        stages[s] = (const Word*)op[STAGES] + s * STAGE_WORDS;
        if (op[KIND] == TASKS || op[KIND] == SLABS || (op[KIND] == ALONE && stages[s][PATCHES]))
            take(stages[s], room[s]);
    }
    if (op[KIND] == SLABS) return stream(op, runs, c, stages, room);
    const Word* made = stages[0];
    if (op[KIND] == ALONE) {
        ((Call)made[FUNCTION])((void*)made[BOUNDS],
                               made[PATCHES] ? (void*)room[0] : (void*)made[ARGUMENTS]);
        return 1;
    }
    const Long begin = first * each, end = begin + each < all ? begin + each : all;
    if (begin >= end) return 1;
    if (op[KIND] == COPY)
        copy(made, begin, end);
    else
        run(made, room[0], begin, end);
    return 1;
};

// Work through a table. Returns 1 if the caller's time is over first.
const auto help = [=](Word* H, Word runs, Long limit) APART -> int {
    const Word* op = (const Word*)H[OPERATIONS];
    const Word* last = op + WORDS * H[COUNT];
    const Long began = me ? 0 : now();
    Long since = began;
    int spins = 0;
    for (;;) {
        if (get(H + RUNS) != runs) return 0;
        const Word done = get(H + DONE);
        while (op < last && done >= op[END]) {
            if (!me && op[CHUNKS] > 1) {
                const Long t = now();
                H[SHARED] += t - since;
                since = t;
            } else if (!me)
                since = now();
            op += WORDS;
        }
        if (op == last) return 0;
        if (!me && now() - began > limit) return 1;
        // small operations are left to the caller
        const bool theirs = me && (op[KIND] == ALONE || (op[CHUNKS] == 1 && spins < SPINS));
        const Long chunk = theirs ? -1 : take_any(op, runs);
        if (chunk >= 0) {
            __atomic_fetch_add(H + DONE, work(op, runs, chunk), __ATOMIC_SEQ_CST);
            spins = 0;
        } else if (me && !theirs && op + WORDS == last)
            return 0;
        else
            relax(++spins, SPINS, YIELDS);
    }
};

if (mode == QUIT) {
    set(T + QUITS, 1);
    wake();
} else if (mode == CANCEL) {
    // Mark all chunks as taken, also for threads that arrive later, and wait for those in progress.
    const Word runs = get(H + RUNS), after = (runs + 1) & 0xffffffff;
    Word left = 0;
    int spins = 0;
    for (Word o = 0; o < H[COUNT]; ++o)
        for (Word l = 0; l < ((Word*)H[OPERATIONS] + o * WORDS)[LANES]; ++l) {
            const Word* op = (const Word*)H[OPERATIONS] + o * WORDS;
            const Word all = start_of(op, l + 1) - start_of(op, l);
            const Word w = __atomic_exchange_n((Word*)op[TAKEN] + l * LANE_WORDS, after << 32 | all,
                                               __ATOMIC_SEQ_CST);
            left += all - (w >> 32 == runs ? (w & 0xffff) + (w >> 16 & 0xffff) : 0);
        }
    while (get(H + DONE) + left < H[TOTAL]) relax(++spins, SPINS, YIELDS);
    set(H + RUNS, after);
} else if (mode == RUN) {  // share & 1: with the pool; share & 2: resume an unfinished run
    // 0: run once; else repeat until the number at this address is 0
    const volatile int* again = (const volatile int*)H[AGAIN];
    const Long until = now() + limit_;
    for (bool resumes = share & 2;; resumes = false) {
        if (!resumes) {
            set(H + DONE, 0);
            set(H + RUNS, (get(H + RUNS) + 1) & 0xffffffff);
            if (share & 1) {
                set(T + TABLE, table_);
                set(T + POSTED, T[POSTED] + 1);
                if (get(T + SLEEPERS)) wake();
            }
        }
        H[UNFINISHED] = help(H, get(H + RUNS), until - now());
        if (H[UNFINISHED] || !again || !*again) break;
        if (now() > until) {
            H[UNFINISHED] = 2;
            break;
        }
    }  // 2: stopped between two runs
} else {
    Word* ours = T + THREADS + 8 * me;
    Word seen = 0;
    // Between tables the interpreter needs a tenth of a millisecond. On a busy machine a thread
    // that yields in this time loses its core for longer.
    const int most = (int)T[IDLE_SPINS];
    for (int spins = 0;;) {
        if (get(T + QUITS)) break;
        const Word posted = get(T + POSTED);
        if (posted != seen) {
            const Word table = get(T + TABLE);
            set(ours, table);  // the table is not freed from here on
            if (table && get(T + POSTED) == posted) {
                help((Word*)table, get((Word*)table + RUNS), 0);
                seen = posted;
                spins = 0;
            } else if (!table && get(T + POSTED) == posted)
                seen = posted;
            set(ours, 0);
        } else if (spins < most + IDLE_YIELDS)
            relax(++spins, most, IDLE_YIELDS);
        else {
            call(LOCK, (void*)(T + MUTEX));
            __atomic_fetch_add(T + SLEEPERS, 1, __ATOMIC_SEQ_CST);
            while (get(T + POSTED) == seen && !get(T + QUITS))
                call(WAIT, (void*)(T + CONDITION), (void*)(T + MUTEX));
            __atomic_fetch_sub(T + SLEEPERS, 1, __ATOMIC_SEQ_CST);
            call(UNLOCK, (void*)(T + MUTEX));
            spins = 0;
        }
    }
}
#undef APART
#endif
