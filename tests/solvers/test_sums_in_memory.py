"""Sums of grid methods: no more columns and slots than their arrays have."""

import numpy as np
import pytest

import warp_lcp as wl
from warp_lcp.kernels.vectors import Reduction

METHODS = [
    wl.InteriorPoint(),
    wl.MinimumMapNewton(),
    wl.FischerNewton(),
    wl.PrimalDualActiveSet(),
    wl.MPRGP(),
]


@pytest.mark.parametrize("method", METHODS, ids=lambda method: type(method).__name__)
def test_sums_stay_in_their_arrays(method, monkeypatch):
    """Columns and slots of each sum of a solve: within those that were allocated."""
    add_up, sums = Reduction.add_up, []

    def checked(self, slot, columns=1, **options):
        sums.append((slot, columns))
        assert columns <= self.columns
        assert slot + columns <= self.scalars.size
        add_up(self, slot, columns, **options)

    monkeypatch.setattr(Reduction, "add_up", checked)
    rng = np.random.default_rng(643)
    problem = wl.LCP(
        wl.GridPoisson(np.full((12, 13), wl.FLUID), shift=0.1, device="cpu"),
        rng.standard_normal((12, 13)),
    )
    assert wl.solve(problem, method)
    assert sums
