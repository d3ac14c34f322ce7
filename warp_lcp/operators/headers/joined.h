// Where faces join cells, and the roots of their trees
const auto* c = cells; int* P_ = parent; const long long s1 = zp, s2 = yp;
const auto x = [&](long long k) { return face_x ? face_x[k] > 0 : cx > 0; };
const auto y = [&](long long k) { return face_y ? face_y[k] > 0 : cy > 0; };
const auto z = [&](long long k) { return face_z ? face_z[k] > 0 : cz > 0; };
const auto find = [&](int i) { while (P_[i] != i) i = P_[i]; return i; };
const bool uniform = !face_x && !face_y && !face_z;
