#include "entries.h"
// y = b - A x
ROWS { T s = b[k]; ENTRIES s -= a[e]*x[col[e]]; y[k] = s; }
