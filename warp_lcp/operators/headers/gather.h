// entries in another order; 0 for an index below 0
for (int k = 0; k < n; ++k) taken[k] = order[k] >= 0 ? source[order[k]] : 0;
