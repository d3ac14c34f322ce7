"""The gallery's problems against the numbers that others have printed."""

import numpy as np
import pytest

from warp_lcp import gallery

CASES = [
    pytest.param(p, id=f"{p.problem}: {p.case}, {p.source}", marks=[pytest.mark.slow] * (p.slow or (p.problem == "American put" and i > 5)))
    for i, p in enumerate(gallery.PUBLISHED)
]


@pytest.mark.parametrize("published", CASES)
def test_every_printed_digit(published):
    assert abs(published.measure() - float(published.printed)) <= published.tolerance


def test_european_puts_are_those_of_the_characteristic_function():
    model, spots = gallery.Heston(), np.arange(8.0, 13.0)
    prices = model.put(96, 48, 32, american=False, device="cpu").at(spots, 0.0625)
    np.testing.assert_allclose(prices, [model.european(s, 0.0625) for s in spots], atol=2e-3)


def test_the_dome_converges():
    """The slope at the margin is infinite, and where the margin lies between nodes makes the errors jump: over four doublings, an order."""
    errors = [np.abs(dome.solve(device="cpu") - dome.thickness()).mean() for dome in (gallery.IceDome(nodes=n) for n in (9, 33, 65))]
    assert errors[2] < errors[1] < errors[0] and errors[2] < errors[0] / 8


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: gallery.journal_bearing(0, 5), "must be >= 1, the inner nodes"),
        (lambda: gallery.journal_bearing(5, 5, 1.0), r"eccentricity = 1.0: must be in \[0, 1\)"),
        (lambda: gallery.journal_bearing(5, 5, half_width=0), "half_width = 0: must be > 0"),
        (lambda: gallery.sine_obstacle(2, 5), "must be >= 3"),
        (lambda: gallery.torsion(5, border=0), "border = 0: must be > 0"),
        (lambda: gallery.Heston(correlation=1.0), r"correlation = 1.0: must be in \(-1, 1\)"),
        (lambda: gallery.Heston().put(4, 4, 8), "ns = 4: must be >= 8"),
    ],
)
def test_wrong_sizes_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
