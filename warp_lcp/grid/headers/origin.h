#include "grid_coordinate.h"
const int origin[3] = {before_x, before_y, before_z};  // cells of a larger grid before the first one of this
