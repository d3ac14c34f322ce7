#include "entries.h"
// y = A x, or A x + plus
ROWS { T s = plus ? plus[k] : (T)0; ENTRIES s += (T)a[e]*x[col[e]]; y[k] = s; }
