#include "entries.h"
// one over the sum of the magnitudes of each row; 0 for rows of zeros
ROWS { T s = 0; ENTRIES s += a[e] < 0 ? -a[e] : a[e]; inverse[k] = s > 0 ? (T)1/s : (T)0; }
