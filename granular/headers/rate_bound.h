// Friction that grows with the rate of shear [Jop, Forterre & Pouliquen 2006]: the radius is r + gain e/(e + half), with e the cell's rate
// of shear times dx [m/s] and half the one at which half of the gain is there, both functions of the pressure.
auto gain_at = [&](T x) INLINE { return RATE && x > (T)0 ? (T)numbers[GAIN]*x : (T)0; };
auto half_at = [&](T x) INLINE { return RATE && x > (T)0 ? (T)numbers[HALFWAY]*sqrt(x) : (T)0; };
auto gained = [](T e, T gain, T half) INLINE { return e > (T)0 ? gain*e/(e + half) : (T)0; };
