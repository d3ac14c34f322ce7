// Solids on a cell's lower faces, and the free surface between cells. In 2-D the third axis repeats the first with a step of 0, so that what
// enters also leaves.
const long long sz = planes == 2 ? s1 : 0;
const float* a[3] = {open_x, open_y, planes == 2 ? open_z : open_x};
const float* solid[3] = {solid_x, solid_y, planes == 2 ? solid_z : solid_x};
// the open fraction of a cell's lower face, what the solid adds to what passes it, and the reciprocal of theta between two cells
auto fraction = [&](int axis, long long i, long long s) {
    return CUT ? a[axis][CUT ? i : 0] : (((kind[i] == SOLID) | (kind[i - s] == SOLID)) ? 0.0f : 1.0f);
};
auto passes = [&](const float* u, int axis, long long i, long long s) {
    const double open = fraction(axis, i, s);
    return open*u[i] + (MOVING ? (1.0 - open)*solid[axis][MOVING ? i : 0] : 0.0);
};
auto inverse_theta = [&](long long i, long long n) {  // FLUID i, AIR n
    const float inverse = GHOST ? 1.0f - phi[GHOST ? n : 0]/phi[GHOST ? i : 0] : 1.0f;
    const float least = inverse > 1.0f ? inverse : 1.0f;  // beyond an open side there is air whatever phi says
    return least < (float)(1.0/THETA_MIN) ? least : (float)(1.0/THETA_MIN);
};
auto outflow = [&](const float* u, const float* v, const float* w, long long i) {
    return passes(u, 0, i + 1, 1) - passes(u, 0, i, 1) + passes(v, 1, i + s2, s2) - passes(v, 1, i, s2)
        + passes(w, 2, i + sz, sz) - passes(w, 2, i, sz);
};
