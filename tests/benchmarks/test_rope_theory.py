"""Steady coils of slender ropes: their limits and their balance of power."""

import math

import numpy as np
import pytest

from warp_lcp.benchmarks.validation.coiling import expected_deflection, growth_rate
from warp_lcp.benchmarks.validation.rope_theory import DOWN, Rope, steady_coil


def test_a_thin_rope_without_gravity_turns_four_times_in_the_time_of_its_fall() -> None:
    # The error is of the order of the radius squared.
    coils = [steady_coil(Rope(radius)) for radius in (0.01, 0.02, 0.04)]
    gaps = [4.0 - coil.frequency for coil in coils]
    assert gaps[0] < 0.005
    assert gaps[1] / gaps[0] == pytest.approx(4.0, rel=0.1)
    assert gaps[2] / gaps[1] == pytest.approx(4.0, rel=0.1)


@pytest.mark.parametrize("rope", [Rope(0.05), Rope(0.05, 3.0), Rope(0.03, 30.0)])
def test_the_work_of_nozzle_and_gravity_is_dissipated(rope: Rope) -> None:
    work, lost = steady_coil(rope).power()
    assert lost > 0.0
    assert work == pytest.approx(lost, rel=0.01)


@pytest.mark.parametrize("rope", [Rope(0.05), Rope(0.04, 2.5, 0.005), Rope(0.05, descent=0.06)])
def test_the_rope_comes_to_rest_on_the_plate(rope: Rope) -> None:
    coil = steady_coil(rope)
    position, tangent = coil.unknowns[0:3, -1], coil.unknowns[3:6, -1]
    velocity = coil.unknowns[6, -1] * tangent
    velocity = velocity + np.cross([0.0, 0.0, coil.frequency], position)
    assert velocity == pytest.approx(rope.descent * DOWN, abs=1e-4)
    assert np.linalg.norm(coil.unknowns[3:6], axis=0) == pytest.approx(1.0, abs=1e-3)
    assert coil.length > 1.0


def test_gravity_sets_the_frequency_of_heavy_ropes() -> None:
    # From three bending lengths on, Omega = c (g Q^3 / (nu a^8))^(1/4), with c falling slowly.
    coils = [steady_coil(Rope(0.03, gravity)) for gravity in (2.0, 8.0, 30.0)]
    assert 1.0 / coils[0].bending_length > 3.0
    factors = [coil.gravitational for coil in coils]
    assert factors[0] == pytest.approx(0.52, rel=0.03)
    assert factors[2] == pytest.approx(factors[0], rel=0.05)
    assert coils[2].frequency > 4.0 * coils[0].frequency


def test_inertia_slows_a_thick_rope() -> None:
    still, moving = steady_coil(Rope(0.05)), steady_coil(Rope(0.05, reynolds=0.005))
    assert 0.96 < moving.frequency / still.frequency < 0.99


def test_a_coil_that_does_not_exist_is_an_error() -> None:
    with pytest.raises(ValueError, match="no steady coil"):
        steady_coil(Rope(0.9, reynolds=1e4))


def test_thin_sheets_grow_as_bending_and_compression_tell() -> None:
    for thickness in (0.01, 0.1):
        assert growth_rate(thickness, 1.0) == pytest.approx(12.0 / thickness**2, rel=thickness)
    grown = expected_deflection(np.array([0.0, 0.001]))
    rate = math.log(grown[1] / grown[0]) / 0.001
    assert rate == pytest.approx(growth_rate(1.0, math.pi / 6), rel=0.1)
