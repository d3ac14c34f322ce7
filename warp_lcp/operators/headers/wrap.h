// Ghost cells before the first and after the last of `cells`, which are `step` elements apart, along a periodic axis.
for (int k = 0; k < n; ++k) { x[k] = x[k + cells*step]; x[k + (cells + 1)*step] = x[k + step]; }
