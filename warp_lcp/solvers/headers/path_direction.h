// Of the step dx = scale e + joined dp, on top of the predictor's dp = scale a: ds and dt. A product with an infinite w or v is 0.
// Macros, see path_cells.h.
#define LOWER_DIRECTION const double dp = second*scale*(double)a[i], dx = scale*(double)e[i] + joined*dp; \
    const double iw = 1.0/w[i], dsp = -s[i] - s[i]*iw*dp, ds = (tau - dp*dsp)*iw - s[i] - s[i]*iw*dx;
#define UPPER_DIRECTION const double iv = 1.0/v[i], dtp = -t[i] + t[i]*iv*dp, dt = (tau + dp*dtp)*iv - t[i] + t[i]*iv*dx;
#include "path_cells.h"
