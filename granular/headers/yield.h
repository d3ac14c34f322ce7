// Nearest point of { |n|^2 / 2 + sum over shears of max_q b_q^2 <= r^2 } in the metric |n|^2 / 2 + sum of b_q^2 / 4. With a multiplier mu
// n shrinks by 1 + mu and the largest |b_q| of a shear are cut to m = max_n S_n / (n + 4 mu), S_n the sum of the n largest of the four;
// mu is the root of 1/r - 1/sqrt(|n|^2/2 + sum m^2), nearly linear in mu. The box of Narain et al. bounds each part by itself instead:
// |n|^2 / 2 <= r^2, |b_q| <= r.
// RATE: a step of `soft` leaves the rate of shear e = mu r / soft, by which r itself grows: the step is backward Euler's, and what it comes
// to rest at does not depend on its length. Newton's line for 1/size then meets 1/r(e) where
// r(e) (size - slope mu) + slope soft e = size^2: a quadratic for e.
auto larger = [](T a, T b) INLINE { return a > b ? a : b; };
auto smaller = [](T a, T b) INLINE { return a < b ? a : b; };
auto magnitude = [](T a) INLINE { return a < (T)0 ? -a : a; };
// how much n shrinks, and the largest |b| of each shear
auto yield = [&](T normal2, const T (&largest)[SHEARS][4], T static_, T gain, T half, T soft, T (&cap)[SHEARS]) INLINE {
    T r = static_, e = 0;
    if (BOX) {
        for (int d = 0; d < SHEARS; ++d) cap[d] = r;
        return smaller(r/larger(sqrt(normal2), (T)LEAST_RADIUS), (T)1);
    }
    const T inverse_r = (T)1/(RATE ? r + gain : r), all = sqrt(normal2);
    T mu = all*inverse_r - (T)1, size = 0;  // a lower bound: each part by itself must fit
    UNROLL for (int d = 0; d < SHEARS; ++d) UNROLL for (int n = 0; n < 4; ++n)
        mu = larger(mu, (T)0.25*(largest[d][n]*inverse_r - (T)(n + 1)));
    mu = larger(mu, (T)0);
    T shrink = 0;
    UNROLL for (int iteration = 0; iteration <= NEWTON; ++iteration) {
        shrink = (T)1/((T)1 + mu);
        T by[4];
        UNROLL for (int n = 0; n < 4; ++n) by[n] = (T)1/((T)(n + 1) + (T)4*mu);
        const T a2 = normal2*shrink*shrink;
        T total = a2, slope = a2*shrink;
        UNROLL for (int d = 0; d < SHEARS; ++d) {
            T m = largest[d][0]*by[0], rate = by[0];
            UNROLL for (int n = 1; n < 4; ++n) {
                const T other = largest[d][n]*by[n];
                rate = other > m ? by[n] : rate;
                m = larger(m, other);
            }
            cap[d] = m;
            total += m*m;
            slope += m*m*(T)4*rate;
        }
        size = sqrt(total);
        if (RATE && iteration < NEWTON) {
            const T along = slope/larger(total, (T)LEAST_RADIUS), rest = (T)1 - along*mu, by_rate = along*soft, q = size - rest*static_;
            const T p = by_rate*half + rest*gain - q, root = sqrt(p*p + (T)4*larger(by_rate*q*half, (T)0));
            const T above = p > (T)0 ? (T)2*q*half : root - p, below = p > (T)0 ? p + root : larger((T)2*by_rate, (T)LEAST_RADIUS);
            e = q > (T)0 ? above/below : (T)0;
            mu = e > (T)0 ? soft*e*(e + half)/(static_*(e + half) + gain*e) : (T)0;
        } else if (iteration < NEWTON) {
            const T step = (size*inverse_r - (T)1)*total/larger(slope, (T)LEAST_RADIUS);
            mu = larger(mu + step, (T)0);
        }
    }
    if (RATE) r += gained(e, gain, half);
    const T onto = smaller(r/larger(size, (T)LEAST_RADIUS), (T)1);
    UNROLL for (int d = 0; d < SHEARS; ++d) cap[d] *= onto;
    return onto*shrink;
};
// sums of the one, two, three, four largest
auto sums = [&](T a, T b, T c, T d, T (&out)[4]) INLINE {
    const T ab = larger(a, b), ba = smaller(a, b), cd = larger(c, d), dc = smaller(c, d);
    const T low = smaller(ab, cd), high = larger(ba, dc);
    out[0] = larger(ab, cd); out[1] = out[0] + larger(low, high); out[2] = out[1] + smaller(low, high);
    out[3] = out[2] + smaller(ba, dc);
};
