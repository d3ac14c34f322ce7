// result += the diagonal of U W U'
const int last = count[0];
for (int k = 0; k < n && p + k < last; ++k) {
    EXACT_MATH const long long e = p + k; const int row = entry_rows[e]; double s = 0;
    if (e > 0 && entry_rows[e - 1] == row) continue;
    for (long long m = e; m < last && entry_rows[m] == row; ++m)
        for (long long o = e; o < last && entry_rows[o] == row; ++o)
            for (int i = 0; i < width; ++i)
                for (int j = 0; j < width; ++j)
                    s += (double)values[m*width + i]*(double)values[o*width + j]
                        *weights[((long long)blocks[m]*width + i)*rank + (long long)blocks[o]*width + j];
    result[row] += s; }
