"""Log entries of particles at the end of a step."""

import numpy as np
import pytest

from warp_lcp.grid.particles import ParticleTotals
from warp_lcp.material.particle_log import CompletedStep, totals_row


def test_entries_are_those_of_the_definitions():
    totals = ParticleTotals(
        count=10, mean_square_speed=4.0, center=np.array([0.5, 0.25, 0.0]), max_speed=3.0
    )
    moved = CompletedStep(2.0, np.array([0.0, -10.0, 0.0]), np.zeros(3), dt=0.01, kick_dt=0.01)
    row = totals_row(totals, moved, particles=10, spacing=0.05)
    assert row == pytest.approx(
        {
            "particles": 10,
            "mass": 20.0,
            "kinetic_energy": 40.0,  # the particles do not move with gravity on the whole
            "potential_energy": 50.0,  # m g y
            "center_of_mass_y": 0.25,
            "max_speed": 3.0,
            "cfl": 0.6,  # 3 m/s in 0.01 s: 0.03 m in cells of 0.05 m
        },
        rel=1e-12,
    )
