"""Slender sheets that fold: growth of buckles, stretching by weight, folding frequencies."""

import math

import numpy as np
import pytest

from warp_lcp.benchmarks.validation.coiling import growth_rate
from warp_lcp.benchmarks.validation.sheet_theory import STEP, Chain, Sheet, folding_sheet


def test_a_compressed_chain_buckles_as_a_thin_sheet() -> None:
    thickness, segments, amplitude = 0.02, 40, 1e-5
    chain = Chain(Sheet(thickness), segments)
    chain.areas[:] = thickness / segments
    height = np.linspace(0.0, 1.0 + 2.0 / segments, len(chain.nodes))
    length = height[-2] - height[1]
    shape = 0.5 - 0.5 * np.cos(2.0 * math.pi * np.clip((height - height[1]) / length, 0.0, 1.0))
    chain.nodes = np.stack([amplitude * shape, height], axis=1)
    chain.laid, dt = 2, 1e-5
    before = np.ptp(chain.nodes[:, 0])
    chain.step(dt)
    rate = (np.ptp(chain.nodes[:, 0]) / before - 1.0) / dt
    # Shortened at the rate 1 / length, between clamped ends: one wave.
    assert rate == pytest.approx(growth_rate(thickness, 2.0 * math.pi / length) / length, rel=0.1)


def test_a_hanging_sheet_stretches_under_its_weight() -> None:
    # At y above the free end: 4 mu h u' = rho g h y.
    gravity, thickness, segments, end = 0.8, 0.05, 60, 0.25
    chain = Chain(Sheet(thickness, gravity), segments)
    y = np.arange(0.0, 1.0 - end + 2.5 / segments, 1.0 / segments)
    chain.nodes = np.stack([0.0 * y, y + end + 1e-9], axis=1)
    chain.velocity = np.zeros_like(chain.nodes)
    chain.areas = np.full(len(y) - 1, thickness / segments)
    chain.laid = 0
    chain.step(1e-12)
    free = y <= 1.0 - end
    sinking = -1.0 - chain.velocity[: len(y), 1][free]
    exact = gravity / 8.0 * ((1.0 - end) ** 2 - y[free] ** 2)
    assert sinking == pytest.approx(exact, abs=0.02 * exact[0])


def test_a_sheet_folds_at_a_fixed_multiple_of_speed_over_height_and_faster_if_heavy() -> None:
    light, heavy = (
        folding_sheet(sheet, 4.5, 30).frequency(4) for sheet in (Sheet(0.05), Sheet(0.05, 2.0))
    )
    assert light == pytest.approx(0.63, rel=0.03)
    assert heavy > 1.3 * light


def test_laid_sheet_rests_on_the_plate() -> None:
    sheet, segments = Sheet(0.08), 40
    chain, dt = Chain(sheet, segments), STEP / segments
    for _ in range(round(2.0 / dt)):
        chain.step(dt)
    assert chain.velocity[0] == pytest.approx(0.0)
    assert 0.2 * sheet.thickness < chain.nodes[chain.laid - 1, 1] < sheet.thickness
