// x = clip(x - omega (A x + b) / d, lower, upper), row after row forward or backwards, so that each sees those before it
for (int k = 0; k < n; ++k) {
    EXACT_MATH const long long i = forward ? k : n - 1 - k; const auto* row = a + i*n; T s = b[i];
    if (row[i] == 0) continue;
    for (int j = 0; j < n; ++j) s += (T)row[j]*x[j];
    x[i] = wp::clamp(x[i] - (T)omega*s/(T)row[i], lower[i], upper[i]); }
