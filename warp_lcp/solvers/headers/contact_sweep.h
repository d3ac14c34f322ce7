// Contacts first <= s < last of one color, which share no body that moves, w = J'r:
// r_n <- max(0, r_n - rho_n u_n), then r_t <- the nearest point of |r_t| <= mu r_n to r_t - rho_t u_t; g = r before - r.
const double factor = state[FACTOR];
for (int s = first; s < last; ++s) {
    const double *j = J + (long long)s*DIM*2*Q, *law = laws + 4*s;
    double *x = r + DIM*contact[s], *taken = g + DIM*contact[s], *mine = w + Q*one[s], *theirs = w + Q*other[s];
    double v[2*Q], u[DIM], change[DIM];
    for (int c = 0; c < Q; ++c) { v[c] = mine[c]; v[Q + c] = theirs[c]; }
    const auto velocity = [&](int i) {
        double sum = b[DIM*s + i] + e[DIM*s + i]*x[i];
        for (int c = 0; c < 2*Q; ++c) sum += j[2*Q*i + c]*v[c];
        return sum;
    };
    const auto push = [&](int i) { for (int c = 0; c < 2*Q; ++c) v[c] += change[i]*j[2*Q*i + c]; };
    const double wanted = x[0] - factor*law[1]*velocity(0), normal = wanted > 0.0 ? wanted : 0.0, radius = law[0]*normal;
    change[0] = normal - x[0];
    push(0);
    double square = 0.0;
    for (int i = 1; i < DIM; ++i) { u[i] = x[i] - factor*law[2]*velocity(i); square += u[i]*u[i]; }
    const double length = sqrt(square), share = length > radius ? radius/length : 1.0;
    for (int i = 1; i < DIM; ++i) { change[i] = share*u[i] - x[i]; push(i); }
    for (int i = 0; i < DIM; ++i) { x[i] += change[i]; taken[i] = -change[i]; }
    x[0] = normal;
    for (int c = 0; c < Q; ++c) mine[c] = v[c];
    if (other[s] < bodies) for (int c = 0; c < Q; ++c) theirs[c] = v[Q + c];
}
