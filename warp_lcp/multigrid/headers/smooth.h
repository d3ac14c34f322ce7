#include "entries.h"
// y = x + omega (b - A x) over the rows' l1 norms, x taken for 0 if from_zero
if (from_zero) { for (int k = 0; k < n; ++k) y[k] = omega*inverse[k]*b[k]; }
else { ROWS { T s = b[k]; ENTRIES s -= a[e]*x[col[e]]; y[k] = x[i] + omega*inverse[k]*s; } }
