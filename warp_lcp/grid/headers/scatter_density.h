// Add the share of particles to the cells around them.
#include "weigh.h"
#include "add.h"
#include "shares.h"
{
#include "origin.h"
const T* position = (const T*)given.position.data;
const int nx = given.density.shape[2] - 2, ny = given.density.shape[1] - 2, nz = given.density.shape[0] - 2;
struct Fields { T* of[1]; };
const auto place = [&](long long p, int& i, int& j, int& k) {
    T w[3];
    i = weigh(grid_coordinate(position[3*p], origin[0]), nx, w) - 1;
    j = weigh(grid_coordinate(position[3*p + 1], origin[1]), ny, w) - 1;
    k = planes == 2 ? weigh(grid_coordinate(position[3*p + 2], origin[2]), nz, w) - 1 : 1; };
const auto width = [=](int i) { return i + 1 < nx ? 4 : 3; };
const auto some = [&](long long begin, long long end, Fields to, long long s1, long long s2) __attribute__((noinline)) {
    PLAIN_MATH
    T* density = to.of[0];
    for (long long p = begin; p < end; ++p) {
        T wx[3], wy[3], wz[3] = {0, 1, 0};
        const int i = weigh(grid_coordinate(position[3*p], origin[0]), nx, wx);
        const int j = weigh(grid_coordinate(position[3*p + 1], origin[1]), ny, wy);
        const int k = planes == 2 ? weigh(grid_coordinate(position[3*p + 2], origin[2]), nz, wz) : 1;
        #ifndef __CUDA_ARCH__
        typedef T Four __attribute__((vector_size(4*sizeof(T))));
        const Four along = {wx[0], wx[1], wx[2], 0};
        #endif
        for (int c = 2 - planes; c <= planes; ++c) for (int b = 0; b < 3; ++b) {
            const T share = each*wz[c]*wy[b];
            T* row = density + ((k + c - 1)*s1 + (j + b - 1)*s2 + i);
            #ifndef __CUDA_ARCH__
            if (i < nx) {  // four at once, of which the last gets nothing: a third of the stores, 9 ns a particle in 3-D instead of 15
                Four sum;
                __builtin_memcpy(&sum, row - 1, sizeof(Four));
                sum += share*along;
                __builtin_memcpy(row - 1, &sum, sizeof(Four));
                continue;
            }
            #endif
            add(row[-1], share*wx[0]); add(row[0], share*wx[1]); add(row[1], share*wx[2]);
        }
    }
};
const long long s2 = nx + 2, s1 = s2*(ny + 2);
each_share(place, some, width, Fields{{density}}, 3, s1, s2);
}
