#include "entries.h"
ROWS { const T f = scale[k]; ENTRIES scaled[e] = f*a[e]; }
