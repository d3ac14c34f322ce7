// Of cell i: f, p, q, whether there is a kink, and what they are made of; R is the type of it. FUSED: in units of `scale`, which makes them
// of order one; the map is free of cancellation.
#if FUSED
const double at_ = diagonal(i), size = at_ != 0 ? at_ : 1.0, low_ = lower(i), high_ = upper(i), value = y[i - begin];
const bool inside = unknown[i] == 1, low = low_ > -(double)INFINITY, high = high_ < (double)INFINITY;
const double below_ = size*(x[i] - low_), above_ = size*(x[i] - high_);
const double natural = inside ? natural_residual(value, below_, above_) + 0.0*x[i] : 0.0; square += natural*natural;
const R w = (R)(scale*value), a = low ? (R)(scale*below_) : (R)0, c = high ? (R)(-scale*above_) : (R)0;
#else
const double at_ = unit*(double)d[i], above_ = at_ < 0 ? -at_ : at_, size = above_ == 0 ? 1.0 : above_, low_ = lower(i), high_ = upper(i);
const bool inside = unknown[i] == 1, low = low_ > -(double)INFINITY, high = high_ < (double)INFINITY;
const R a = low ? size*(x[i] - low_) : 0.0, c = high ? size*(high_ - x[i]) : 0.0, w = y[i];
#endif
#if RANDOM  // an element of the unit disc's first quadrant for each kink, a hash of its index
const unsigned long long z0 = ((unsigned long long)(p + i) + seed)*0x9E3779B97F4A7C15ull, z1 = (z0 ^ (z0 >> 29))*0xBF58476D1CE4E5B9ull;
const R first = (double)(unsigned int)(z1 >> 32)*2.3283064365386963e-10;
const R second = (double)(unsigned int)((z1*0x94D049BB133111EBull) >> 32)*2.3283064365386963e-10;
const R kp = 1 - 0.7071067811865476*first, kq = 1 - 0.7071067811865476*second;
#else
const R kp = (R)0, kq = (R)1;
#endif
#if NATURAL
const R least = (low & (a < w)) ? a : w;
const bool top = high & (-c > least), bottom = low & (a < w), kink = false;
const R f = inside ? (top ? -c : least) : (R)0, p = (top | bottom) ? (R)1 : (R)0, q = (R)1 - p;
#else  // 2 a b / (a + b + sqrt) and b^2 / (rho (rho + a)) are psi and 1 - a / rho without cancellation
const R c0 = c > 0 ? c : (R)0, w0 = -w > 0 ? -w : (R)0;
#if UPPER
const R e = root(w*w + c*c), es = e > tiny ? e : (R)1, n = c - w;
const R below = n > 0 ? -2*w*c/(n + es) : n - e, h = high ? -below : w;
const bool kink2 = high & (e <= tiny);
const R p2 = high ? (kink2 ? kp : (c > 0 ? w*w/(es*(es + c0)) : 1 - c/es)) : (R)0;
const R q2 = high ? (kink2 ? kq : (w < 0 ? c*c/(es*(es + w0)) : 1 + w/es)) : (R)1;
#else
const R h = w, p2 = 0, q2 = 1; const bool kink2 = false;
#endif
const R rho = root(a*a + h*h), rs = rho > tiny ? rho : (R)1, t = a + h;
const R a0 = a > 0 ? a : (R)0, h0 = h > 0 ? h : (R)0;
const bool kink1 = low & (rho <= tiny), flat1 = a > 0, flat2 = h > 0;
const R f1 = low ? (t > 0 ? 2*a*h : t - rho)/(t > 0 ? t + rs : (R)1) : h;
const R p1 = low ? (kink1 ? kp : (flat1 ? h*h : rs - a)/(rs*(flat1 ? rs + a0 : (R)1))) : (R)0;
const R q1 = low ? (kink1 ? kq : (flat2 ? a*a : rs - h)/(rs*(flat2 ? rs + h0 : (R)1))) : (R)1;
const bool kink = inside & (kink1 | kink2);
#if PENALIZED
const R yp = w > 0 ? w : (R)0, g = (1 - part)*over_b;
const R extra = (low ? a0*yp : (R)0) - (high ? c0*w0 : (R)0);
const R ep = ((low & (a > 0)) ? yp : (R)0) + ((high & (c > 0)) ? w0 : (R)0);
const R eq = ((low & (w > 0)) ? a0 : (R)0) + ((high & (w < 0)) ? c0 : (R)0);
const R f = inside ? part*f1 + g*extra : (R)0;
const R p = part*(p1 + q1*p2) + g*ep, q = part*q1*q2 + g*eq;
#else
const R f = inside ? f1 : (R)0, p = p1 + q1*p2, q = q1*q2;
#endif
#endif
