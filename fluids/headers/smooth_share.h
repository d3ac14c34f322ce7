// The smooth share of liquid, 2 a - b, and its slopes.
const int nz = given.a.shape[0], ny = given.a.shape[1], nx = given.a.shape[2];
const bool inside = j > 0 && j + 1 < ny && (planes != 2 || (k > 0 && k + 1 < nz));
const long long sz = planes == 2 ? s1 : 0;
auto f = [&](long long i) { return (T)2*a[i] - b[i]; };
auto slope = [&](long long i, long long s) { return (T)0.5*(f(i + s) - f(i - s)); };
