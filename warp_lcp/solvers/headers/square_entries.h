// The diagonal of U'U on the unknowns, then the rows of each block
for (int q = 0; q < rank + rank/width; ++q) squares[q] = 0;
for (int e = 0; e < count[0]; ++e) {
    if (d[entry_rows[e]] == 0) continue;
    squares[rank + blocks[e]] += 1;
    for (int q = 0; q < width; ++q) { EXACT_MATH const double u = (double)values[(long long)e*width + q]; squares[blocks[e]*width + q] += u*u; } }
