"""Lemke's method, pivot by pivot against a tableau of fractions with exact ties.

The rules are the lexicographic one, z0 first, and the first row.
"""

from fractions import Fraction

import numpy as np
import pytest
import scipy.sparse

from warp_lcp.solvers.lemke import BandedBasis, Basis


class ReferenceTableau:
    """Tableau of w - M z - d z0 = q in whole numbers, [Book] appendix C.

    Variables are w: 0 ... m-1, z: m ... 2m-1, z0: 2m. The row that leaves has the lexicographically
    least (q, e_1, ..., e_m)-part over the entering column, but z0 leaves whenever its ratio is
    least. z0 enters in the row whose (q_i, e_i) / d_i is lexicographically least.
    """

    def __init__(self, M, q, d):
        m = len(q)
        self.m, self.variables, self.entering = m, list(range(m)), 2 * m
        columns = np.hstack([np.eye(m, dtype=int), -M, -d[:, None], q[:, None]])
        self.table = [[Fraction(int(v)) for v in row] for row in columns]
        self.row = min(
            (i for i in range(m) if d[i] > 0), key=lambda i: self.key(i, Fraction(int(d[i])))
        )
        self.ties = 0

    def key(self, i, pivot):
        """Return the q-part and the inverse's row over the pivot.

        Lists are compared lexicographically.
        """
        return [self.table[i][-1] / pivot, *(v / pivot for v in self.table[i][: self.m])]

    def pivot(self):
        """Pivot; return True when z0 has left, False on a ray, None to continue."""
        e = self.entering
        if e != 2 * self.m:
            rows = [i for i in range(self.m) if self.table[i][e] > 0]
            if not rows:
                return False
            least = min(self.table[i][-1] / self.table[i][e] for i in rows)
            tied = [i for i in rows if self.table[i][-1] / self.table[i][e] == least]
            self.ties += len(tied) > 1
            z0 = [i for i in tied if self.variables[i] == 2 * self.m]
            self.row = z0[0] if z0 else min(tied, key=lambda i: self.key(i, self.table[i][e]))
        leaving, pivot = self.variables[self.row], self.table[self.row][e]
        self.table[self.row] = [v / pivot for v in self.table[self.row]]
        for i in range(self.m):
            if i != self.row:
                factor = self.table[i][e]
                self.table[i] = [
                    a - factor * b for a, b in zip(self.table[i], self.table[self.row], strict=True)
                ]
        self.variables[self.row] = e
        if leaving == 2 * self.m:
            return True
        self.entering = leaving + self.m if leaving < self.m else leaving - self.m
        return None

    def z(self):
        """Return the values of z."""
        values = np.zeros(2 * self.m + 1)
        values[self.variables] = [float(row[-1]) for row in self.table]
        return values[self.m : 2 * self.m]


def degenerate(seed, m, band=None, largest=2):
    """Return small whole numbers, many of b equal or 0: most ratios tie."""
    rng = np.random.default_rng(seed)
    M = rng.integers(-largest // 2, largest + 1, (m, m))
    M = M if band is None else np.triu(np.tril(M, band), -band)
    return (
        M + 2 * np.eye(m, dtype=int),
        rng.integers(-1, 2, m),
        rng.integers(1, 3, m) if seed % 2 else np.ones(m, dtype=int),
    )


@pytest.mark.parametrize(("band", "largest"), [(None, 2), (None, 7), (1, 2)])
def test_pivots_are_those_of_the_lexicographic_rule(band, largest):
    """Pivots by the lexicographic rule.

    The same variables after every pivot, to the end or the ray, by a dense inverse and by banded
    factors.
    """
    ties, ends, pivots = 0, [], 0
    for seed in range(4901, 4961):
        M, q, d = degenerate(seed, 7, band, largest)
        if not (q < 0).any():
            continue
        plain = ReferenceTableau(M, q, d)
        bases = [Basis(M.astype(float), q.astype(float), d.astype(float))]
        if band is not None:
            bases.append(
                BandedBasis(
                    scipy.sparse.csr_array(M.astype(float)), q.astype(float), d.astype(float)
                )
            )
        outcome = None
        while outcome is None:
            outcome = plain.pivot()
            for basis in bases:
                assert basis.pivot() is outcome
                assert sorted(basis.variables.tolist()) == sorted(plain.variables), seed
            pivots += 1
        ends.append(outcome)
        ties += plain.ties
        if outcome:
            for basis in bases:
                np.testing.assert_allclose(basis.z(), plain.z(), atol=1e-12)
                w = M @ basis.z() + q
                assert (w >= -1e-12).all()
                np.testing.assert_allclose(w * basis.z(), 0.0, atol=1e-12)
    assert ties > 20
    assert pivots > 100
    assert ends.count(True) > 20


def test_z0_leaves_as_soon_as_it_may():
    """z0 leaves as early as possible.

    Three rows tie, of which z0's is not the lexicographically least: it leaves nevertheless, and
    the path has ended.
    """
    seen = 0
    for seed in range(4971, 5031):
        M, q, d = degenerate(seed, 4)
        if not (q < 0).any():
            continue
        basis, plain, outcome = (
            Basis(M.astype(float), q.astype(float), d.astype(float)),
            ReferenceTableau(M, q, d),
            None,
        )
        while outcome is None:
            e = plain.entering
            ratios = {
                i: plain.table[i][-1] / plain.table[i][e]
                for i in range(4)
                if e != 8 and plain.table[i][e] > 0
            }
            tied = [i for i in ratios if ratios[i] == min(ratios.values())]
            tied_rows = [i for i in tied if plain.variables[i] == 8]
            seen += (
                bool(tied_rows)
                and min(tied, key=lambda i: plain.key(i, plain.table[i][e])) != tied_rows[0]
            )
            outcome = plain.pivot()
            assert basis.pivot() is outcome
            assert not tied_rows or outcome
    assert seen > 0
