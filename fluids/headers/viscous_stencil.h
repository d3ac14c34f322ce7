// What the neighbors of a face of component x, and faces of y and z, add to its row: A x = diagonal x - around.
const long long step[3] = {1, s2, s1}, sa = step[axis], sb = step[axis == 0 ? 1 : 0], sc = step[axis == 2 ? 1 : 2];
const auto across = [&](const T* v, const float* n, long long s, long long i) {
    return n[i + s]*x[i + s] + n[i]*x[i - s] - (n[i] - mixed[i])*v[i] + (n[i] - mixed[i - sa])*v[i - sa] + (n[i + s] - mixed[i])*v[i + s]
        - (n[i + s] - mixed[i - sa])*v[i + s - sa];
};
const auto around = [&](long long i) {
    const T sum = cell[i]*x[i + sa] + cell[i - sa]*x[i - sa] + across(y, xb, sb, i);
    return DEPTH ? sum + across(DEPTH ? z : y, DEPTH ? xc : xb, DEPTH ? sc : sb, i) : sum;
};
const int* reach = span + 2*(k*(int)(s1/s2) + j);
const int low = first > reach[0] ? first : reach[0], high = last < reach[1] ? last : reach[1];
