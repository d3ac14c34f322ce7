// i, j, k: the lowest of the nodes around a particle; f: how far it lies beyond them, in cells
#include "grid_coordinate.h"
const T hx = axis == 0 ? (T)0 : (T)0.5, hy = axis == 1 ? (T)0 : (T)0.5, hz = axis == 2 ? (T)0 : (T)0.5;
const T lx = axis == 0 ? (T)EDGE : (T)0, ly = axis == 1 ? (T)EDGE : (T)0, lz = axis == 2 ? (T)EDGE : (T)0;
auto nodes = [&](long long p, int& i, int& j, int& k, T& fx, T& fy, T& fz) {
    EXACT_MATH
    const T x = grid_coordinate(position[3*p], before_x) - hx, y = grid_coordinate(position[3*p + 1], before_y) - hy;
    const T z = planes == 2 ? grid_coordinate(position[3*p + 2], before_z) - hz : (T)1;
    i = (int)x; j = (int)y; k = (int)z;
    fx = x - (T)i; fy = y - (T)j; fz = z - (T)k;
    fx = fx < lx ? lx : fx; fy = fy < ly ? ly : fy; fz = fz < lz ? lz : fz;
    fx = fx > 1 - lx ? 1 - lx : fx; fy = fy > 1 - ly ? 1 - ly : fy; fz = fz > 1 - lz ? 1 - lz : fz;
};
