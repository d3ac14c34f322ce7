for (int k = 0; k < n; ++k) { parent[k] = (int)(p + k); grounded[k] = 0; }
