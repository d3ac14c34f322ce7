// A cut cell adds to the kernels of the cells around it what is open of it: along the axis in which the distance changes most the open
// interval of a line is known and so is the kernel's integral, cubic in the ends; across, three Gauss points (error for planes < 2e-4).
const long long s2 = near_.shape[2], s1 = s2*near_.shape[1], cell = k*s1 + j*s2 + i, sz = planes == 2 ? s1 : 0;
const float* d = near_.data + cell; float* out = out_.data + cell;
const long long step[3] = {1, s2, sz};
float v[8], slope[3] = {0.0f, 0.0f, 0.0f};
for (int c = 0; c < 8; ++c) {
    v[c] = d[(c & 1) + ((c & 2) ? s2 : 0) + ((c & 4) ? sz : 0)];
    for (int a = 0; a < 3; ++a) slope[a] += (c >> a) & 1 ? v[c] : -v[c];
}
int main = 0;
// clearly more, so that cells along a plane at 45 degrees choose the same axis in spite of rounding: else the error is 3e-3
for (int a = 1; a <= planes; ++a) if (slope[a]*slope[a] > 1.05f*slope[main]*slope[main]) main = a;
const int p = (main + 1)%3, q = (main + 2)%3, dim = planes + 1;
const float at[3] = {0.1127016654f, 0.5f, 0.8872983346f}, gauss[3] = {5.0f/18.0f, 4.0f/9.0f, 5.0f/18.0f};
float side[3][3];  // of the kernel of the cell below, of this one and of the cell above, at the Gauss points
for (int g = 0; g < 3; ++g) {
    const float t = at[g], r = t - 0.5f;
    side[0][g] = gauss[g]*0.5f*(1.0f - t)*(1.0f - t); side[1][g] = gauss[g]*(0.75f - r*r); side[2][g] = gauss[g]*0.5f*t*t;
}
float moment[3][3][3];
for (int a = 0; a < 27; ++a) (&moment[0][0][0])[a] = 0.0f;
for (int gp = 0; gp < (p < dim ? 3 : 1); ++gp) for (int gq = 0; gq < (q < dim ? 3 : 1); ++gq) {
    const float tp = p < dim ? at[gp] : 0.0f, tq = q < dim ? at[gq] : 0.0f;
    float end[2];
    for (int e = 0; e < 2; ++e) {
        const int c = e << main, cp = 1 << p, cq = 1 << q;
        end[e] = (1.0f - tq)*((1.0f - tp)*v[c] + tp*v[c | cp]) + tq*((1.0f - tp)*v[c | cq] + tp*v[c | cp | cq]);
    }
    float from = 0.0f, to = 1.0f;
    if (end[0] <= 0.0f && end[1] <= 0.0f) continue;
    if (end[0] <= 0.0f) from = end[0]/(end[0] - end[1]);
    else if (end[1] <= 0.0f) to = end[0]/(end[0] - end[1]);
    auto below = [](float t) { const float s = 1.0f - t; return -s*s*s/6.0f; };
    auto here = [](float t) { const float r = t - 0.5f; return 0.75f*t - r*r*r/3.0f; };
    const float along[3] = {below(to) - below(from), here(to) - here(from), (to*to*to - from*from*from)/6.0f};
    for (int a = 0; a < 3; ++a) for (int b = 0; b < 3; ++b) {
        const float wp_ = p < dim ? side[a][gp] : (float)(a == 1), wq = q < dim ? side[b][gq] : (float)(b == 1);
        for (int m = 0; m < 3; ++m) moment[m][a][b] += along[m]*wp_*wq;
    }
}
for (int m = 0; m < 3; ++m) for (int a = 0; a < 3; ++a) for (int b = 0; b < 3; ++b) {
    if ((p == dim && a != 1) || (q == dim && b != 1)) continue;
    out[(m - 1)*step[main] + (a - 1)*step[p] + (b - 1)*step[q]] += moment[m][a][b];
}
