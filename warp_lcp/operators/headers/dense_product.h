// y = A x or A' x, in the order of the columns
for (int k = 0; k < n; ++k) {
    EXACT_MATH const auto* row = a + (transposed ? p + k : (p + k)*size); const long long step = transposed ? size : 1; T s = 0;
    for (long long j = 0; j < size; ++j) s += (T)row[j*step]*x[j];
    y[k] = s; }
