// Take the results of `constrain.h`.
#include "near_walls.h"
each([&](int i) { field[i] = result[i]; });
