// Thread pool compiled on its own, for ThreadSanitizer.
//
// The tables have cut and whole operations. They are run, resumed and cancelled, and threads join
// late.
#include <cstddef>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <pthread.h>
#include <sched.h>
#include <thread>
#include <time.h>
#include <vector>

typedef unsigned long long U;
static void work_through(U team_, U table_, int mode, int me, int share, long long limit_) {
#include "team.h"
}

enum { TASKS_ = 1, CELLS_ = 512 };
struct Arguments {
    int begin, end;
    long long base;
    int* cells;
    int value;
    int other;
};
static void add(void*, void* given) {  // independent tasks
    Arguments* a = (Arguments*)given;
    for (int t = a->begin; t < a->end; ++t) a->cells[t] += a->value;
}
static void next(void*,
                 void* given) {  // planes that read the neighbors written by the previous stage
    Arguments* a = (Arguments*)given;
    for (int t = a->begin; t < a->end; ++t) {
        const int below = t > 0 ? a->cells[t - 1] : 0, above = t + 1 < CELLS_ ? a->cells[t + 1] : 0;
        a->cells[CELLS_ + t] = a->cells[t] + below + above;
    }
}
// Conditions of the loop and of an operation.
static int left, odd;
static void all(void*, void* given) {
    Arguments* a = (Arguments*)given;
    for (int t = 0; t < CELLS_; ++t) a->cells[t] -= a->value;
    --left;
    odd = left % 2;
}

// Arguments: the number of rounds, and the planes between slabs; without a plane neighbors race.
int main(int, char** given) {
    enum { SIZE = 4 };
    const int rounds = atoi(given[1]);
    const U gap = atoi(given[2]);
    std::vector<U> team(64 + 8 * SIZE, 0);
    void* calls[] = {(void*)sched_yield,
                     (void*)clock_gettime,
                     (void*)nanosleep,
                     (void*)pthread_mutex_lock,
                     (void*)pthread_mutex_unlock,
                     (void*)pthread_cond_wait,
                     (void*)pthread_cond_broadcast,
                     (void*)(U)CLOCK_MONOTONIC};
    for (int i = 0; i < 8; ++i) team[56 + i] = (U)calls[i];
    pthread_mutex_init((pthread_mutex_t*)&team[24], nullptr);
    pthread_cond_init((pthread_cond_t*)&team[40], nullptr);
    std::vector<std::thread> others;
    for (int me = 1; me < SIZE; ++me)
        others.emplace_back([&, me] { work_through((U)team.data(), 0, 1, me, 0, 0); });

    std::vector<int> cells(2 * CELLS_, 0), expected(2 * CELLS_, 0);
    Arguments plus{0, 0, 0, cells.data(), 0, 0}, twice{0, 0, 0, cells.data(), 2, 0},
        none{0, 0, 0, cells.data(), 1, 0};
    auto stage = [](void (*f)(void*, void*), Arguments* a, U lag) {
        return std::vector<U>{(U)f, 0, (U)a, sizeof(Arguments), 1, CELLS_, lag, 1, 0, 0};
    };
    std::vector<U> first = stage(add, &plus, 0), wave = stage(add, &twice, 0),
                   last = stage(all, &none, 0), after = stage(next, &none, gap);
    // The first operation reads `three` and its number of tasks when it runs.
    int three = 3;
    const U tasks = CELLS_;
    const U patches[] = {1, offsetof(Arguments, value), (U)&three, sizeof(int)};
    first[9] = (U)patches;
    wave.insert(wave.end(), after.begin(), after.end());
    enum { SLABS_ = 8, PIECES_ = 16, LANES_ = 3, WORDS_ = 13, LANE_ = 8 };
    const U each = CELLS_ / SLABS_;
    std::vector<U> table(24 + 4 * WORDS_ + 4 * LANE_ * LANES_ + SLABS_);
    U *words = &table[24], *taken = words + 4 * WORDS_, *cuts = taken + 4 * LANE_ * LANES_;
    const U made[4][WORDS_] = {
        {PIECES_, 1, (U)first.data(), 1, 1, 0, 0, PIECES_, LANES_, (U)taken, 0, (U)&tasks, 0},
        {PIECES_ + SLABS_, 2, (U)wave.data(), 2, each, CELLS_, 1, SLABS_, LANES_,
         (U)(taken + LANE_ * LANES_), (U)cuts, 0, 0},
        {PIECES_ + SLABS_ + 1, 0, (U)last.data(), 1, 0, 0, 0, 1, 1, (U)(taken + 2 * LANE_ * LANES_),
         0, 0, 0},
        {2 * PIECES_ + SLABS_ + 1, 1, (U)first.data(), 1, 1, 0, 0, PIECES_, LANES_,
         (U)(taken + 3 * LANE_ * LANES_), 0, (U)&tasks, (U)&odd}};
    memcpy(words, made, sizeof(made));
    table[16] = 4;
    table[17] = made[3][0];
    table[21] = (U)&left;
    table[18] = (U)words;
    int wrong = 0, resumed = 0, between = 0;
    for (int round = 0; round < rounds; ++round) {
        const int share = round % 5 ? 1 : 0;
        const long long limit = round % 7 ? 1LL << 40 : 0;
        const int runs = 1 + round % 3;  // consecutive runs in native code
        left = runs;
        work_through((U)team.data(), (U)table.data(), 0, 0, share, limit);
        while (const U unfinished = table[20]) {
            ++resumed;
            between += unfinished == 2;
            work_through((U)team.data(), (U)table.data(), 0, 0, unfinished == 1 ? 2 + share : share,
                         2000);
        }
        for (int run = 1; run <= runs; ++run) {
            for (int t = 0; t < CELLS_; ++t) expected[t] += 5;
            for (int t = 0; t < CELLS_; ++t) {
                expected[CELLS_ + t] = expected[t] + (t > 0 ? expected[t - 1] : 0) +
                                       (t + 1 < CELLS_ ? expected[t + 1] : 0);
            }
            for (int t = 0; t < CELLS_; ++t) expected[t] += (runs - run) % 2 ? 2 : -1;
        }
        wrong += memcmp(cells.data(), expected.data(), sizeof(int) * 2 * CELLS_) != 0;
        if (round % 100 == 50) {  // a cancelled run; cells are set to the expected values after it
            left = 2;
            work_through((U)team.data(), (U)table.data(), 0, 0, 1, 0);
            work_through((U)team.data(), (U)table.data(), 2, 0, 0, 0);
            std::copy(expected.begin(), expected.end(), cells.begin());
            left = 0;
            // A thread that joins late finds no task.
            work_through((U)team.data(), (U)table.data(), 0, 0, 2, 2000);
            wrong += memcmp(cells.data(), expected.data(), sizeof(int) * 2 * CELLS_) != 0;
        }
        // Pause so long that the other threads fall asleep.
        if (round % 500 == 7) {
            timespec t{0, 20000000};
            nanosleep(&t, nullptr);
        }
    }
    work_through((U)team.data(), 0, 3, 0, 0, 0);
    for (auto& other : others) other.join();
    printf("%d rounds, %d wrong, %d resumed, %d of them between runs\n", rounds, wrong, resumed,
           between);
    return wrong != 0 || !between;
}
