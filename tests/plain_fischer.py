"""Fischer-Burmeister map, its penalized form and the minimum map of a box.

They are evaluated row by row from their definitions, without the library.
"""

import math

import numpy as np

DECREASE = 1e-4  # Armijo's constant
LEAST_Q = 1e-6  # q where a system is divided by it
KINK = 1e-14  # times the size of b: rounding of a point at a kink


def psi(a, b):
    """Return a + b - sqrt(a^2 + b^2): 0 where a >= 0, b >= 0 and a b = 0."""
    return a + b - math.hypot(a, b)


def slopes_of_psi(a, b, kink, scale):
    """Return the derivatives of psi by a and b, and whether it is a kink.

    The derivatives are `kink` where both arguments are 0.
    """
    rho = math.hypot(a, b)
    return (*kink, True) if rho <= KINK * scale else (1 - a / rho, 1 - b / rho, False)


def plain_row(form, d, x, y, lower, upper, *, share, scale, kink):
    """Return f, p and q of one row, and whether it is at a kink.

    p d + q A_i is the row of the generalized Jacobian. With a = d (x - l) and c = d (u - x): h =
    -psi(-y, c) replaces y where there is an upper bound, and f = psi(a, h) where there is a lower
    one. Penalized: share f + (1 - share) (a+ y+ - c+ (-y)+) / scale. The minimum map is max(min(y,
    a), -c).
    """
    low, high = math.isfinite(lower), math.isfinite(upper)
    a, c = d * (x - lower) if low else 0.0, d * (upper - x) if high else 0.0
    if form == "natural":
        least = a if low and a < y else y
        if high and -c > least:
            return -c, 1.0, 0.0, False
        return least, float(low and a < y), float(not (low and a < y)), False
    f, p, q, kinked = y, 0.0, 1.0, False
    if high:  # dh = psi_a dy - psi_b dc, and dc = -d dx
        f = -psi(-y, c)
        q, p, kinked = slopes_of_psi(-y, c, kink[::-1], scale)
    if low:
        by_a, by_h, here = slopes_of_psi(a, f, kink, scale)
        kinked = kinked or here
        f, p, q = psi(a, f), by_a + by_h * p, by_h * q
    if form == "penalized":
        rest, above, below = (1 - share) / scale, max(y, 0.0), max(-y, 0.0)
        f = share * f + rest * (max(a, 0.0) * above * low - max(c, 0.0) * below * high)
        p = share * p + rest * (above * (low and a > 0) + below * (high and c > 0))
        q = share * q + rest * (max(a, 0.0) * (low and y > 0) + max(c, 0.0) * (high and y < 0))
    return f, p, q, kinked


class PlainMap:
    """Map f and a generalized Jacobian of a whole problem.

    Args:
        form: "natural", "fischer" or "penalized".
        A, b, lower, upper: the problem.
        share: share of the penalized map.
        kink: (p, q) at kinks.
    """

    def __init__(self, form, A, b, lower, upper, *, share=1.0, kink=(0.0, 1.0)):
        self.A, self.b, self.lower, self.upper = A, b, lower, upper
        self.d, self.form, self.share, self.kink = np.diag(A), form, share, kink
        self.scale = math.sqrt(b @ b / len(b))

    def rows(self, x):
        """Return f, p, q and the kinks, an array each."""
        y = self.A @ x + self.b
        given = {"share": self.share, "scale": self.scale, "kink": self.kink}
        rows = [
            plain_row(self.form, *row, **given)
            for row in zip(self.d, x, y, self.lower, self.upper, strict=True)
        ]
        return tuple(np.array(column) for column in zip(*rows, strict=True))

    def merit(self, x):
        """Return the merit f'f / 2."""
        f = self.rows(x)[0]
        return 0.5 * float(f @ f)

    def jacobian(self, x):
        """Return the Jacobian diag(p d) + diag(q) A."""
        _, p, q, _ = self.rows(x)
        return np.diag(p * self.d) + q[:, None] * self.A


def armijo(merit, along, limit, slope, least=1e-8):
    """Return the first halved step that meets Armijo's condition; 0 if none does.

    The merit must be at most limit + 1e-4 t slope.
    """
    t = 1.0
    while t >= least:
        if merit(along(t)) <= limit + DECREASE * t * slope:
            return t
        t /= 2
    return 0.0
