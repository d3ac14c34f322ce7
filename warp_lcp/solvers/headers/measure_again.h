// As measure.h, in the places of some rows among those of all.
#include "measure.h"
double* sum = sums + place + P.k*lines + P.j;
sum[0] = (double)zaz; sum[places] = (double)zap; sum[2*places] = (double)gz; sum[3*places] = (double)gp;
