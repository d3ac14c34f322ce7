// |d (r - P(r - u^/d))|^2 with u^ = (u_n + mu |u_t|, u_t), P the projection onto |r_t| <= mu r_n, d the mean of the contact's diagonal
for (int s = first; s < last; ++s) {
    const double *j = J + (long long)s*DIM*2*Q, *law = laws + 4*s, *x = r + DIM*contact[s], mu = law[0], d = law[3];
    const double *mine = w + Q*one[s], *theirs = w + Q*other[s];
    double z[DIM], slip = 0.0, length = 0.0;
    for (int i = 0; i < DIM; ++i) {
        double u = b[DIM*s + i] + e[DIM*s + i]*x[i];
        for (int c = 0; c < Q; ++c) u += j[2*Q*i + c]*mine[c] + j[2*Q*i + Q + c]*theirs[c];
        z[i] = u;
        if (i > 0) slip += u*u;
    }
    z[0] += mu*sqrt(slip);
    for (int i = 0; i < DIM; ++i) z[i] = x[i] - z[i]/d;
    for (int i = 1; i < DIM; ++i) length += z[i]*z[i];
    length = sqrt(length);
    const bool inside = length <= mu*z[0], polar = mu*length <= -z[0];
    const double side = (z[0] + mu*length)/(1.0 + mu*mu);
    for (int i = 0; i < DIM; ++i) {
        const double onto = i ? mu*side*z[i]/(length > 0.0 ? length : 1.0) : side, off = d*(x[i] - (inside ? z[i] : polar ? 0.0 : onto));
        square += off*off;
    }
}
