"""Mutants of the formulas of the algorithms.

They change signs, constants, index sets and conditions. Each has the test file that must fail.
"""

from __future__ import annotations

from typing import NamedTuple


class Formula(NamedTuple):
    """One change of a formula.

    Attributes:
        module: file, relative to the root.
        before: text that occurs once in the file.
        after: its replacement.
        tests: test file that fails with the change.
    """

    module: str
    before: str
    after: str
    tests: str


def _changes(module: str, tests: str, *pairs: tuple[str, str]) -> list[Formula]:
    """Return changes of one file."""
    return [
        Formula(f"warp_lcp/{module}", before, after, f"tests/{tests}") for before, after in pairs
    ]


MAP, NEWTON, PATH = (
    "subproblems/test_nonsmooth_map.py",
    "solvers/test_fischer_newton_steps.py",
    "solvers/test_interior_point_steps.py",
)
ACTIVE, GRADIENTS = "solvers/test_minimum_map_newton_steps.py", "solvers/test_mprgp_steps.py"
SUBSPACE, BLOCKS, PIVOTS = (
    "solvers/test_subspace_minimization_steps.py",
    "solvers/test_block_steps.py",
    "solvers/test_lemke_steps.py",
)

FORMULAS = [
    *_changes(
        "subproblems/headers/nonsmooth_map.h",
        MAP,
        ("const R kp = (R)0, kq = (R)1;", "const R kp = (R)1, kq = (R)0;"),
        ("const R kp = (R)0, kq = (R)1;", "const R kp = (R)0, kq = (R)0;"),
        ("const R kp = (R)0, kq = (R)1;", "const R kp = (R)-1, kq = (R)5;"),
        ("kp = 1 - 0.7071067811865476 * first", "kp = 1 - first"),
        ("kq = 1 - 0.7071067811865476 * second", "kq = 1 + 0.7071067811865476 * second"),
        ("z1 * 0x94D049BB133111EBull", "z1 * 1ull"),
        ("kink2 = high & (e <= tiny)", "kink2 = false"),
        ("kink1 = low & (rho <= tiny)", "kink1 = low & (rho < 0)"),
        ("w * w / (es * (es + c0)) : 1 - c / es", "w * w / (es * (es + c0)) : 1 + c / es"),
        ("c * c / (es * (es + w0)) : 1 + w / es", "c * c / (es * (es + w0)) : 1 - w / es"),
        ("h = high ? -below : w", "h = high ? below : w"),
        ("(2 * a * h) : t - rho", "(2 * a * h) : t + rho"),
        ("p = p1 + q1 * p2, q = q1 * q2;", "p = p1 - q1 * p2, q = q1 * q2;"),
        ("part * f1 + g * extra", "part * f1 - g * extra"),
        ("part * f1 + g * extra", "part * f1"),
        ("a0 * yp : (R)0) - (high ? c0 * w0", "a0 * yp : (R)0) + (high ? c0 * w0"),
        ("(low & (a > 0)) ? yp", "(low & (a < 0)) ? yp"),
        ("(high & (c > 0)) ? w0", "(high & (c < 0)) ? w0"),
        ("(low & (w > 0)) ? a0", "(low & (w < 0)) ? a0"),
        ("(high & (w < 0)) ? c0", "(high & (w > 0)) ? c0"),
        ("g = (1 - part) * over_b", "g = part * over_b"),
        ("least = (low & (a < w)) ? a : w", "least = (low & (a > w)) ? a : w"),
        ("top = high & (-c > least)", "top = high & (c > least)"),
    ),
    *_changes(
        "subproblems/headers/nonsmooth_map.h",
        MAP,
        ("solved ? size * p / qs : 0.0", "solved ? p / qs : 0.0"),
        ("-scale * f / qs", "-scale * f"),
        ("(S)size * p * inverse", "(S)p * inverse"),
        ("solved ? -f * inverse", "solved ? f * inverse"),
        (
            "inverse = (S)1 / qs;\n            const bool solved = inside & !(drop & kink)",
            "inverse = (S)1 / qs; const bool solved = inside",
        ),
        (
            "least_q;\n        const bool solved = inside & !(drop & kink)",
            "least_q; const bool solved = inside",
        ),
    ),
    *_changes(
        "subproblems/headers/nonsmooth_map.h",
        MAP,
        ("(gradient[i] + product[i]) / size", "(gradient[i] - product[i]) / size"),
        ("gradient[i] = g / size", "gradient[i] = g"),
    ),
    *_changes("subproblems/headers/nonsmooth_map.h", MAP, ("size * p * f", "p * f")),
    *_changes(
        "subproblems/nonsmooth_map.py",
        MAP,
        ("LEAST_Q = 1e-6", "LEAST_Q = 1e-3"),
        ("(Kink.ZERO, Kink.APPROXIMATION)", "(Kink.ZERO,)"),
        ("self.residual.norm_of_b() / np.sqrt(count)", "self.residual.norm_of_b()"),
    ),
    *_changes(
        "subproblems/nonsmooth_map.py",
        NEWTON,
        ("((by_x, along), (by_y, product))", "((by_y, along), (by_x, product))"),
        ("np.clip(at - step, lower, upper)", "np.clip(at + step, lower, upper)"),
        ("share * math.sqrt(2 * merit)", "0 * math.sqrt(2 * merit)"),
    ),
    *_changes(
        "solvers/fischer_newton.py",
        NEWTON,
        ("limit - 2 * DECREASE * merit", "limit + 2 * DECREASE * merit"),
        (
            "self.map.advance(self._from, self.system.e, scale, x, projected=True)",
            "self.map.advance(self._from, self.system.e, scale, x, projected=False)",
        ),
        ("return slope < 0 and self", "return slope < 1e300 and self"),
        ("slope = size * self.map.slope(x, self.system.e)", "slope = -2 * self._merit"),
        (
            "self._fusable = grid and settings.safeguard and self.precision is not "
            "Precision.SINGLE\n"
            "        self._search = NonmonotoneSearch(memory=settings.memory if settings.safeguard "
            "else 1)",
            "self._fusable = grid and settings.safeguard and self.precision is not "
            "Precision.SINGLE\n"
            "        self._search = NonmonotoneSearch(memory=settings.memory)",
        ),
        ("SolveStatus.LOCAL_MINIMUM if stationary", "SolveStatus.LOCAL_MINIMUM if not stationary"),
        ("SolveStatus.LOCAL_MINIMUM if stationary", "SolveStatus.NON_DESCENT if stationary"),
    ),
    *_changes(
        "subproblems/energy_monitor.py",
        NEWTON,
        ("DECREASE = 1e-4", "DECREASE = 0.3"),
        ("limit + DECREASE * length * slope", "limit - DECREASE * length * slope"),
        ("            length *= 0.5", "            length *= 0.25"),
        ("return max(self.merits)", "return min(self.merits)"),
        ("[*self.merits, merit][-self.memory :]", "[*self.merits, merit]"),
    ),
    *_changes(
        "solvers/fischer_newton.py",
        NEWTON,
        ("move = ~kinks if map_.kink is Kink.ZERO", "move = ~kinks if map_.kink is Kink.RANDOM"),
        ("_solve(J[np.ix_(move, move)], -f[move])", "_solve(J[np.ix_(move, move)], f[move])"),
        ("0.5 * float(f @ f), projected=True)", "0.5 * float(f @ f), projected=False)"),
        ("0.5 * float(f @ f), projected=False)", "0.5 * float(f @ f), projected=True)"),
        ("REGULARIZATION = 1e-6", "REGULARIZATION = 1e-3"),
        ("-f - q * gap", "-f + q * gap"),
        ("A @ dx + gap,", "A @ dx - gap,"),
        ("self._mu *= self._factor", "self._mu *= 0.5 * self._factor"),
        ("np.maximum(y, 1.0), y)", "y, y)"),
        ("(1 - length) * np.linalg.norm(gap)", "np.linalg.norm(gap)"),
        ("x - gradient / map_.d**2", "x + gradient / map_.d**2"),
        ("if failure and np.linalg.norm(inside)", "if not failure and np.linalg.norm(inside)"),
    ),
    *_changes(
        "subproblems/nonsmooth_map.py",
        NEWTON,
        ("self._element = np.zeros(n), np.ones(n)", "self._element = np.ones(n), np.zeros(n)"),
        ("self._element = np.zeros(n), np.ones(n)", "self._element = np.zeros(n), np.zeros(n)"),
        ("self._element = np.zeros(n), np.ones(n)", "self._element = -np.ones(n), 5 * np.ones(n)"),
        ("over=1 / self.scale", "over=1.0"),
        ("share=1.0 if smoothing", "share=0.5 if smoothing"),
    ),
    *_changes(
        "subproblems/nonsmooth_map.py",
        MAP,
        ("1 - np.sqrt(0.5) * self._rng", "1 - self._rng"),
        ("kinks=KINK * self.scale", "kinks=0.0"),
    ),
    *_changes(
        "subproblems/headers/nonsmooth_map.h",
        MAP,
        ("SMOOTHED(v) ((v) + twice_mu)", "SMOOTHED(v) ((v) - twice_mu)"),
        ("LOWERED(v) ((v) - twice_mu)", "LOWERED(v) ((v) + twice_mu)"),
        ("const bool exact = false;", "const bool exact = true;"),
        ("d[i] * (upper[i] - x[i])", "d[i] * (x[i] - upper[i])"),
        ("p = part * (p1 + q1 * p2)", "p = part * (p1 + p2)"),
    ),
    *_changes(
        "solvers/interior_point.py",
        PATH,
        ("else self.mu / self.steps", "else 0.5 * self.mu / self.steps"),
        ("else self.mu / self.steps", "else 0.1 * self.mu"),
        ("self.steps / (s.horizon + 1)", "2 * self.steps / (s.horizon + 1)"),
        ("min(s.backoff, self.steps", "max(s.backoff, self.steps"),
        ("after / self.mu)) ** 3", "after / self.mu)) ** 2"),
        ("length**2 * products / self.count", "length * products / self.count"),
        (
            "tau, second = self._center(longest, products), 1.0",
            "tau, second = self._center(longest, products), 0.0",
        ),
        ("length = min(1.0, share / longest)", "length = min(1.0, 1 / longest)"),
        ("min(1.0, s.backoff / longest)", "min(1.0, 1 / longest)"),
        (
            "LARGEST_START * self.residual.norm),\n                    self.residual.norm,",
            "LARGEST_START * self.residual.norm),\n                    0.0,",
        ),
        ("self.settings.start * size / math.sqrt(unknowns)", "self.settings.start * size"),
    ),
    *_changes(
        "solvers/headers/interior_point.h",
        PATH,
        ("+ tau * sides", "- tau * sides"),
        ("sides = iw - iv", "sides = iw + iv"),
        ("shift = shift + t[i] / v[i]", "shift = shift - t[i] / v[i]"),
        ("s[i] * iw + t[i] * iv", "s[i] * iw"),
    ),
    *_changes(
        "solvers/headers/interior_point.h",
        PATH,
        ("double g = (tau - dp * dsp) * iw", "double g = (tau + dp * dsp) * iw"),
        ("- (tau + dp * dtp) * iv", "- (tau - dp * dtp) * iv"),
        ("dtp = -t[i] + t[i] * iv * dp;\n        g", "dtp = -t[i] - t[i] * iv * dp; g"),
    ),
    *_changes(
        "solvers/headers/interior_point.h",
        PATH,
        ("ds = (tau - dp * dsp) * iw", "ds = (tau + dp * dsp) * iw"),
        ("dt = (tau + dp * dtp) * iv", "dt = tau * iv"),
        ("- t[i] + t[i] * iv * dx", "- t[i] - t[i] * iv * dx"),
    ),
    *_changes(
        "solvers/headers/interior_point.h",
        PATH,
        ("m = -q > next ? -q : next", "m = -q"),
        ("k = o > last ? o : last", "k = last"),
        ("products += dx * ds - dx * dt", "products += dx * ds + dx * dt"),
        ("third = dx * iv", "third = -dx * iv"),
    ),
    *_changes(
        "solvers/headers/interior_point.h",
        PATH,
        ("k0 = c < 0.5 * span ? c : 0.5 * span", "k0 = c < 0.25 * span ? c : 0.25 * span"),
    ),
    *_changes(
        "solvers/headers/interior_point.h",
        PATH,
        ("c = -y[i] > least ? -y[i] : least", "c = y[i] > least ? y[i] : least"),
    ),
    *_changes(
        "solvers/headers/interior_point.h",
        PATH,
        ("vn = v[i] - length * dx", "vn = v[i] + length * dx"),
    ),
    *_changes(
        "subproblems/headers/reduced_systems.h",
        ACTIVE,
        ("low = v<l", "low = v <= l"),
        ("high = v> u", "high = v >= u"),
        ("held ? (low ? l : u)", "held ? (low ? u : l)"),
        ("v = x[k] - known[k] / e", "v = x[k] - known[k]"),
    ),
    *_changes(
        "subproblems/headers/grid_step.h",
        ACTIVE,
        ("low = below<v", "low = below <= v"),
        ("high = above> v", "high = above >= v"),
        ("(low ? -mark : mark)", "(low ? mark : -mark)"),
    ),
    *_changes(
        "subproblems/headers/grid_step.h", ACTIVE, ("high = g[k] >= mark", "high = g[k] > mark")
    ),
    *_changes(
        "subproblems/host_system.py",
        ACTIVE,
        ("target < self._lower", "target <= self._lower"),
        ("target > self._upper", "target >= self._upper"),
    ),
    *_changes(
        "solvers/minimum_map_newton.py",
        ACTIVE,
        ("norm <= (1 - DECREASE * length) * limit", "norm <= (1 - 0.5 * length) * limit"),
        ("norm <= (1 - DECREASE * length) * limit", "norm <= 2 * limit"),
        ("settings.memory if settings.safeguard else 1", "settings.memory"),
        ("            length *= 0.5", "            length *= 0.25"),
        ("limit = self.system, max(self.norms)", "limit = self.system, min(self.norms)"),
    ),
    *_changes(
        "subproblems/correction_system.py",
        ACTIVE,
        (
            "        if not self._settings.safeguard:\n",
            "        if self._settings.safeguard and not self._settings.safeguard:\n",
        ),
        ("helped = problem.bounded and settings.safeguard", "helped = problem.bounded"),
    ),
    *_changes(
        "subproblems/reduced_system.py",
        ACTIVE,
        ("if settings.safeguard and takes_points", "if takes_points"),
    ),
    *_changes(
        "solvers/headers/gradient_projection.h",
        SUBSPACE,
        ("(x[k] > lower(k))", "(x[k] >= lower(k))"),
        ("(x[k] < upper(k))", "(x[k] <= upper(k))"),
    ),
    *_changes(
        "solvers/headers/gradient_projection.h",
        SUBSPACE,
        ("(v <= was_l)", "(v < was_l)"),
        ("(v >= was_u)", "(v > was_u)"),
    ),
    *_changes(
        "solvers/subspace_minimization.py",
        SUBSPACE,
        ("size * 0.5**halving", "size * 0.25**halving"),
        (
            "residual.evaluate(x) < norm\n                or",
            "residual.evaluate(x) < norm\n                and",
        ),
        ("if solve > 0 and not moved", "if not moved"),
        (
            "for halving in range(max(s.backtracks, 0) + 1)",
            "for halving in range(max(s.backtracks, 0) + 2)",
        ),
        ("(self.residual.y, self.problem.b)", "(self.residual.y, self.residual.y)"),
        (
            "        wp.copy(x, self._before)\n        residual.invalidate()",
            "        residual.invalidate()",
        ),
        (
            "            work.sweep.run(x, forward=True)",
            "            work.sweep.run(x, forward=False)",
        ),
    ),
    *_changes(
        "solvers/staggering.py",
        BLOCKS,
        ("[rows] + self._outer @", "[rows] - self._outer @"),
        ("            slab[:, rows] = 0.0\n", ""),
        (
            "        whole.bounds.follow(self._x)\n        problem.b.assign",
            "        problem.b.assign",
        ),
        ("others[rows] = 0.0", "others[rows] = 1.0"),
        ("x=self._y, less=self._z, target=self._b", "x=self._y, less=None, target=self._b"),
    ),
    *_changes(
        "solvers/staggering.py",
        BLOCKS,
        ("range(count) if forward else reversed(range(count))", "range(count)"),
    ),
    *_changes(
        "sweeps/block_kernels.py",
        BLOCKS,
        ("c += v * x[j]", "c -= v * x[j]"),
        ("t[p, j] -= slope", "t[p, j] += slope"),
        ("new[p] = old[p] + omega * (new[p] - old[p])", "new[p] = old[p] + (new[p] - old[p])"),
        ("if y < -ROUNDING * terms", "if y > ROUNDING * terms"),
        ("if x[p] < l - ROUNDING * size", "if x[p] < l - size"),
        ("                    slope = high.slope[p]\n", ""),
        ("updated.slope[p] = S.coefficient[i]", "updated.slope[p] = ZERO"),
        ("if low.at[p] < 0 and high.at[p] < 0", "if low.at[p] >= 0 and high.at[p] >= 0"),
    ),
    *_changes(
        "solvers/mprgp.py",
        GRADIENTS,
        ("self.gamma**2 * work.residual.reduced", "self.gamma * work.residual.reduced"),
        ("beta = -residual.dot(M.z, self._q)", "beta = residual.dot(M.z, self._q)"),
        ("            length *= 0.5\n", "            length *= 0.25\n"),
        (
            "self._projected_step(self._p, residual.release, curvature)",
            "self._projected_step(direction, residual.release, curvature)",
        ),
        (
            "self._restricted, self._carry = residual.free_set, False",
            "self._restricted, self._carry = residual.free_set, self._carry",
        ),
        (
            "factor, target, p = residual.release / curvature",
            "factor, target, p = 2 * residual.release / curvature",
        ),
        (
            "length = gain / curvature * residual.size\n        else",
            "length = 0.5 * gain / curvature * residual.size\n        else",
        ),
    ),
    *_changes(
        "solvers/headers/gradient_projection.h",
        GRADIENTS,
        ("(held ? v : (T)0) * h / e", "h * h / e"),
        (
            "(x[k] >= u - reach(u)));\n        const T r0 = natural_residual(v, e",
            "false);\n        const T r0 = natural_residual(v, e",
        ),
        ("r * v;\n        release += (held", "r * r; release += (held"),
    ),
    *_changes(
        "solvers/headers/gradient_projection.h",
        GRADIENTS,
        ("(held ? v : (T)0) * inverse * (T)w", "h * inverse * (T)w"),
        ("r * v;\n            release -= (held", "r * r; release -= (held"),
    ),
    *_changes(
        "solvers/headers/gradient_projection.h",
        GRADIENTS,
        ("before - share * q[k]", "before + share * q[k]"),
        ("before = s != 0 ? own : g[k]", "before = g[k]"),
    ),
    *_changes(
        "subproblems/grid_step_kernels.py",
        GRADIENTS,
        ("ratio = -zap / pap", "ratio = zap / pap"),
        ("gz + ratio * gp", "gz - ratio * gp"),
    ),
    *_changes(
        "operators/banded_matrix.py",
        PIVOTS,
        ("t[:-1] - np.multiply.outer", "t[:-1] + np.multiply.outer"),
    ),
    *_changes(
        "solvers/lemke.py",
        PIVOTS,
        (
            "ratios <= ratios.min() + TIE * abs(ratios.min()))[-1])",
            "ratios <= ratios.min() + TIE * abs(ratios.min()))[0])",
        ),
        ("        if ends.any():\n            return int(rows[ends][0])\n", ""),
        (
            "least = ratios <= ratios.min() + TIE * np.abs(ratios).max()",
            "least = ratios >= ratios.max() - TIE * np.abs(ratios).max()",
        ),
        ("ratios = inverse[:, column] / direction[rows]", "ratios = inverse[:, column]"),
        (
            "for column in range(self.m):\n            if inverse",
            "for column in range(1):\n            if inverse",
        ),
        ("ratios = np.divide(q, d, out", "ratios = np.divide(q, np.ones(m), out"),
    ),
    *_changes(
        "solvers/headers/penalty.h",
        "solvers/test_penalty.py",
        ("(spring & is) ? within : v", "v"),
        ("old < 0) | (spring & equal)", "old < 0)"),
        ("is & (y[i] < 0) &", "is & (y[i] > 0) &"),
    ),
    *_changes(
        "solvers/headers/penalty.h", "solvers/test_penalty.py", ("& (side[i] == 0)", "& true")
    ),
    *_changes(
        "solvers/penalty.py",
        "solvers/test_penalty.py",
        ("self._excess / allowed)", "allowed / self._excess)"),
    ),
    *_changes(
        "problem/merits.py",
        "problem/test_merits.py",
        ("(slope < 0)", "(slope > 0)"),
        ("np.abs(terms)", "terms"),
        ("abs(float(sums[0]))", "float(sums[1])"),
        ("np.abs(at).max", "at.max"),
    ),
]
