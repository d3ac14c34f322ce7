"""Published numbers, digit by digit, and further properties of the problems."""

import itertools
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.integrate
import scipy.sparse
import scipy.stats
import warp as wp

import warp_lcp as wl
from oracle import assemble, boxed, natural_residual
from warp_lcp.gallery import PUBLISHED, Heston, IceDome, journal_bearing, sine_obstacle, torsion

SLOW = pytest.mark.slow
ROWS = [
    # Prices of puts take seconds; others below compare them.
    pytest.param(
        p,
        marks=SLOW if p.slow or p.problem == "American put" else (),
        id=f"{p.problem}, {p.case}, {p.source}",
    )
    for p in PUBLISHED
]
# Triangles of a cell: corners (x, y), the right angle first.
TRIANGLES = (((0, 0), (1, 0), (0, 1)), ((1, 1), (0, 1), (1, 0)))


@pytest.mark.parametrize("published", ROWS)
def test_published_digits_are_met(published):
    value = published.measure()
    off = abs(value - float(published.printed))
    assert off <= published.tolerance, (value, published.printed)
    if published.within:  # The table marks answers that differ in a digit.
        exact = type(published)("", "", published.printed, "", published.measure)
        assert off > exact.tolerance or published.source == "QuantLib"


def test_bearing_is_the_integral_over_triangles():
    """Bearing as an integral over triangles.

    The energy of any u is the sum of integrals of linear elements; the load is by the corner rule.
    """
    nx, ny, e, half_width = 5, 4, 0.7, 3.0
    p = journal_bearing(nx, ny, e, half_width=half_width, device="cpu")
    u = np.zeros((ny + 2, nx + 2))
    u[1:-1, 1:-1] = np.random.default_rng(83).uniform(0, 2, (ny, nx))
    x, y = np.linspace(0, 2 * np.pi, nx + 2), np.linspace(0, 2 * half_width, ny + 2)
    energy = 0.0
    for j, i, corners in itertools.product(range(ny + 1), range(nx + 1), TRIANGLES):
        nodes = [(i + a, j + b) for a, b in corners]
        j0, values = nodes[0][1], [u[k, i] for i, k in nodes]
        horizontal, vertical = sorted((1, 2), key=lambda q: nodes[q][1] != j0)
        slope = (values[horizontal] - values[0]) / x[1], (values[vertical] - values[0]) / y[1]
        cube = np.mean([(1 + e * np.cos(x[i])) ** 3 for i, _ in nodes])
        energy += x[1] * y[1] / 2 * cube * (slope[0] ** 2 + slope[1] ** 2) / 2
    energy -= x[1] * y[1] * e * (np.sin(x) * u).sum()
    assert p.energy(u) == pytest.approx(energy, rel=1e-12)
    assert p.energy(wp.array(u, dtype=wp.float64, device="cpu")) == p.energy(u)


@pytest.mark.parametrize(
    "p",
    [torsion(3, 20.0, border=0.5, device="cpu"), sine_obstacle(5, 4, between=True, device="cpu")],
    ids=lambda p: p.name,
)
def test_border_has_half_the_weight(p):
    """Half weight of the border, by the energy's definition.

    Each inner node has a quarter of the squares of its differences to all four neighbors.
    """
    ny, nx = p.b.shape
    u = np.zeros((ny, nx))
    u[1:-1, 1:-1] = np.random.default_rng(19).uniform(-1, 1, (ny - 2, nx - 2))
    squares = 0.0
    for j, i in itertools.product(range(1, ny - 1), range(1, nx - 1)):
        for dj, di in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            squares += (
                (u[j + dj, i + di] - u[j, i]) ** 2
                / 4
                * ((nx - 1) / (ny - 1) if di else (ny - 1) / (nx - 1))
            )
    assert p.energy(u) == pytest.approx(squares + (p.b * u).sum(), rel=1e-6)


def test_small_problem_by_trying_all_active_sets():
    p = sine_obstacle(4, 4, between=True, device="cpu", dtype=wp.float64).dense()
    assert natural_residual(p.A, p.b, p.lower, p.upper, boxed(p.A, p.b, p.lower, p.upper)) < 1e-12
    x = wl.solve(p.lcp(device="cpu"), stopping=wl.StoppingCriteria(rtol=1e-12)).x.numpy()
    np.testing.assert_allclose(x, boxed(p.A, p.b, p.lower, p.upper), atol=1e-11)


def test_torsion_has_the_bits_it_had():
    p = torsion(4, device="cpu")
    np.testing.assert_array_equal(
        p.dense().A, assemble(np.pad(np.ones((4, 4), int), 1))[np.ix_(*(np.flatnonzero(p.b),) * 2)]
    )
    assert p.A.uniform == (1.0, 1.0, 1.0)


def european(m, spot, variance):
    """Return Heston's closed form of a put, in the version of Albrecher et al.

    By both probabilities that S ends above K.
    """
    kappa, sigma, rho, T = m.reversion, m.volatility, m.correlation, m.expiry

    def characteristic(z):
        beta = kappa - rho * sigma * 1j * z
        d = np.sqrt(beta**2 + sigma**2 * (1j * z + z**2))
        g, decay = (beta - d) / (beta + d), np.exp(-d * T)
        C = kappa * m.mean / sigma**2 * ((beta - d) * T - 2 * np.log((1 - g * decay) / (1 - g)))
        return np.exp(
            1j * z * (np.log(spot) + m.rate * T)
            + C
            + (beta - d) / sigma**2 * (1 - decay) / (1 - g * decay) * variance
        )

    def chance(shift, scale):
        def density(z):
            return (
                np.exp(-1j * z * np.log(m.strike)) * characteristic(z - shift) / (1j * z * scale)
            ).real

        return (
            0.5
            + scipy.integrate.quad(density, 1e-12, 400.0, limit=1000, epsabs=1e-12, epsrel=1e-12)[0]
            / np.pi
        )

    return m.strike * np.exp(-m.rate * T) * (1 - chance(0, 1.0)) - spot * (
        1 - chance(1j, spot * np.exp(m.rate * T))
    )


def black_scholes(m, spot):
    s = np.sqrt(m.mean * m.expiry)
    d = (np.log(spot / m.strike) + m.rate * m.expiry) / s + s / 2
    return m.strike * np.exp(-m.rate * m.expiry) * scipy.stats.norm.cdf(
        s - d
    ) - spot * scipy.stats.norm.cdf(-d)


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("correlation", [0.1, -0.7, 0.0])
def test_european_puts_by_the_closed_form(correlation):
    m, spots = Heston(correlation=correlation), np.arange(8.0, 13.0)
    exact = np.array([european(m, s, 0.0625) for s in spots])
    coarse, fine = (
        np.abs(
            m.put(32 * k, 16 * k, 16 * k, american=False, device="cpu").at(spots, 0.0625) - exact
        ).max()
        for k in (1, 2)
    )
    assert fine < 5e-4
    assert fine < coarse / 2.8  # order two


def test_extrapolated_prices_have_no_error_of_second_order(monkeypatch):
    """Prices with an error in h^2, h the sides of the grid: the extrapolation removes it."""

    def put(self, ns, nv, steps, *, american, device):
        error = 3.0 / ns**2 + 2.0 / nv**2 + 5.0 / steps**2
        return SimpleNamespace(at=lambda spot, variance: spot + variance + error)

    monkeypatch.setattr(Heston, "put", put)
    spots = np.array([9.0, 10.0, 11.0])
    found = Heston().extrapolated(spots, 0.0625, 16, 8, 4)
    np.testing.assert_allclose(found, spots + 0.0625, rtol=1e-14)


def test_steady_variance_is_black_and_scholes():
    m = Heston(volatility=1e-3, mean=0.09)
    assert m.put(96, 48, 32, american=False, device="cpu").at(10.0, 0.09) == pytest.approx(
        black_scholes(m, 10.0), abs=1e-3
    )
    assert european(m, 10.0, 0.09) == pytest.approx(black_scholes(m, 10.0), abs=1e-5)


def test_american_put_is_worth_more_and_is_exercised_below():
    prices, held = (Heston().put(48, 16, 16, american=a, device="cpu") for a in (True, False))
    payoff = np.maximum(10 - prices.S, 0)
    assert (prices.u >= payoff).all()
    assert (prices.u >= held.u - 1e-6).all()
    exercised = (prices.u == payoff) & (prices.S < 10)
    assert (np.diff(exercised.sum(1)) <= 0).all()  # the smaller the variance, the earlier
    assert exercised[0].any()


@pytest.mark.slow
def test_american_puts_on_one_grid():
    """American puts on one grid: all four digits without extrapolation."""
    prices = Heston().put(384, 96, 128, device="cpu").at(np.arange(8.0, 13.0), 0.0625)
    assert [f"{price:.4f}" for price in prices] == [
        "2.0000",
        "1.1076",
        "0.5200",
        "0.2137",
        "0.0820",
    ]


def test_money_grows_by_the_rate():
    model = Heston()
    A = wl.Stencil(
        np.full((9, 13), wl.FLUID),
        model.coefficients(*model.nodes(12, 8)),
        device="cpu",
        dtype=wp.float64,
    )
    growth = A.apply(wp.ones((9, 13), dtype=wp.float64, device="cpu")).numpy()
    np.testing.assert_allclose(growth, model.rate, atol=1e-10)  # constants grow at the rate


def test_ice_flows_by_its_derivative():
    dome, rng = IceDome(nodes=7), np.random.default_rng(29)
    H, v = rng.uniform(500, 3000, (7, 7)), rng.standard_normal((7, 7))
    ahead, behind = (dome.outflow(H + s * v, 0.01)[0] for s in (1e-2, -1e-2))
    np.testing.assert_allclose(
        dome.outflow(H, 0.01)[1] @ v.ravel(),
        ((ahead - behind) / 2e-2).ravel(),
        rtol=1e-6,
        atol=1e-1,
    )
    # The outflow of a volume is the inflow of another.
    assert abs(dome.outflow(H, 0.01)[0].sum()) < 1e-6 * np.abs(dome.outflow(H, 0.01)[0]).max()


def test_ice_balance_is_the_divergence_of_the_known_dome():
    dome = IceDome(nodes=801)
    H, r = dome.thickness(), dome.distance
    h = dome.side / 800
    gy, gx = np.gradient(H, h)
    q = -dome.gamma * H**5 * np.hypot(gx, gy) ** 2
    divergence = np.gradient(q * gx, h, axis=1) + np.gradient(q * gy, h, axis=0)
    away = (r > 0.2) & (r < 0.8)
    np.testing.assert_allclose(
        divergence[away],
        dome.balance()[away],
        rtol=2e-3,
        atol=1e-3 * np.abs(dome.balance()[away]).max(),
    )
    assert dome.thickness()[400, 400] == pytest.approx(3600)
    assert (dome.thickness()[r >= 1] == 0).all()
    assert (dome.balance()[r > 1] < 0).all()


@pytest.mark.slow
def test_ice_dome_converges_to_the_known_one():
    """Convergence of the ice dome to the exact one.

    The measures are thickness at the center, mean error and radius. At the margin the slope is
    infinite, so that the largest error stays large.
    """
    center, mean, radius = [], [], []
    for n in (17, 33, 65):
        dome = IceDome(nodes=n)
        H = dome.solve(device="cpu")
        assert (H >= 0).all()
        center.append(abs(H[n // 2, n // 2] - 3600))
        mean.append(np.abs(H - dome.thickness()).mean())
        radius.append(abs(np.sqrt((H > 0).sum() / np.pi) * dome.side / (n - 1) / dome.radius - 1))
    assert center[2] < center[1] / 2.5 < center[0] / 5
    assert mean[2] < mean[0] / 4
    assert radius[2] < 0.01


def test_arguments_out_of_range_are_named():
    for wrong, name in [
        (lambda: journal_bearing(0, 4), "nx, ny = 0, 4"),
        (lambda: journal_bearing(4, 4, 1.0), "eccentricity"),
        (lambda: journal_bearing(4, 4, half_width=0.0), "half_width"),
        (lambda: sine_obstacle(2, 4), "nx, ny = 2, 4"),
        (lambda: torsion(4, border=0.0), "border"),
        (lambda: Heston(strike=0.0), "strike"),
        (lambda: Heston(rate=-0.1), "rate"),
        (lambda: Heston(correlation=1.0), "correlation"),
        (lambda: Heston().put(4, 16, 16), "ns = 4"),
        (lambda: Heston().put(16, 2, 16), "nv = 2"),
        (lambda: Heston().put(16, 16, 2), "steps = 2"),
        (lambda: IceDome(nodes=2), "nodes"),
        (lambda: IceDome(nodes=9, exponent=1.0), "exponent"),
        (lambda: IceDome(nodes=9, regularization=0.0), "regularization"),
    ]:
        with pytest.raises(ValueError, match=name):
            wrong()


def test_the_page_has_the_table():
    """Table on the page: each number with the result when the page was made."""
    text = (
        Path(__file__).parents[2] / "benchmarks" / "results" / "amd-epyc" / "problems.md"
    ).read_text()
    rows = dict(re.findall(r"^(\| .* \| `.*` \| .* \|) `(.*)` \|$", text, flags=re.M))
    assert list(rows) == [f"| {p.case} | `{p.printed}` | {p.source} |" for p in PUBLISHED]
    for p, here in zip(PUBLISHED, rows.values(), strict=True):
        assert abs(float(here) - float(p.printed)) <= p.tolerance * 1.01
