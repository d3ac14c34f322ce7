// What cells hold too much, `above`, all that they hold, and 1 and the most above what fits, `densest`.
float worst = -1.0f, over[M];
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : M;
    SIMD8 for (int m = 0; m < n; ++m) {
        const int i = start + m, has = (base[i] != SOLID) & (int)(density[i] > 0.0f);
        const float excess = density[i] - most*capacity[i];
        above += (double)(has & (int)(excess > 0.0f) ? excess : 0.0f);
        all += (double)(has ? density[i] : 0.0f);
        over[m] = has ? density[i] - capacity[i] : -1.0f;
    }
    for (int m = 0; m < n; ++m) worst = over[m] > worst ? over[m] : worst;
}
densest = 1.0 + (double)worst;
