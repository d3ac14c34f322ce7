// What the neighbors of a face of component x, and faces of y and z, add to its row: A x = diagonal x - around.
const long long step[3] = {1, s2, s1}, sa = step[axis], sb = step[axis == 0 ? 1 : 0], sc = step[axis == 2 ? 1 : 2];
const auto pair = [&](const T* n, long long s, long long i) { return n[i + s]*x[i + s] + n[i]*x[i - s]; };
const auto along = [&](long long i) { return cell[i]*x[i + sa] + cell[i - sa]*x[i - sa]; };
const auto mix = [&](const T* v, const T* n, long long s, long long i) {
    return (n[i] - mixed[i - sa])*v[i - sa] - (n[i] - mixed[i])*v[i] + (n[i + s] - mixed[i])*v[i + s] - (n[i + s] - mixed[i - sa])*v[i + s - sa];
};
const auto others = [&](long long i) {
    const T sum = mix(y, xb, sb, i);
    return DEPTH ? sum + pair(DEPTH ? xc : xb, DEPTH ? sc : sb, i) + mix(DEPTH ? z : y, DEPTH ? xc : xb, DEPTH ? sc : sb, i) : sum;
};
const auto around = [&](long long i) { return along(i) + pair(xb, sb, i) + others(i); };
const int* reach = span + 4*(k*(int)(s1/s2) + j);
const int low = first > reach[0] ? first : reach[0], high = last < reach[1] ? last : reach[1];
