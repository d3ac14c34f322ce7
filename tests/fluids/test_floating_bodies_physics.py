"""Rigid bodies in a liquid against known results: added mass, displacement."""

import pytest

from small_liquids import GRAVITY, box, create, scene
from warp_lcp.benchmarks.validation.floating import displacement

STEP = 1e-3  # [s]
WIDE = 6  # diameters of the body in the tank's width


def first_acceleration(dimension, cells, ratio, wall="free-slip"):
    """Return the acceleration from rest of a disc or sphere in a full closed tank."""
    ball = {
        "shape": "sphere",
        "center": [0.5] * dimension,
        "radius": 0.5 / WIDE,
        "density": 1000.0 * ratio,
    }
    down = {"physics": {"gravity": [0.0, -GRAVITY, 0.0][:dimension]}}
    liquid = [box([0.0] * dimension, [1.0] * dimension)]
    tables = {
        "liquid": liquid,
        "solid": [ball],
        "wall": wall,
        "solver": {"tolerance": 1e-6},
        **down,
    }
    simulation = create(scene(size=[1.0] * dimension, resolution=cells * WIDE, **tables))
    row = simulation.step(STEP)
    assert row["solve_status"] == "CONVERGED"
    assert abs(row["body0_vx"]) < 1e-3 * abs(row["body0_vy"])
    return row["body0_vy"] / (0.5 * STEP)  # velocity of the middle of the step


@pytest.mark.parametrize("ratio", [0.01, 0.5, 3.0])
def test_a_disc_sets_off_with_its_added_mass(ratio):
    """Added mass of a disc.

    (1 + q^2) / (1 - q^2) times its displacement in a round tank of 1/q diameters; that of the
    square one is close to it.
    """
    q = 1.0 / WIDE
    added = (1.0 + q**2) / (1.0 - q**2)
    assert first_acceleration(2, 16, ratio) == pytest.approx(
        (1.0 - ratio) * GRAVITY / (ratio + added), rel=0.04
    )


def test_separating_walls_do_not_change_the_added_mass_of_a_disc():
    assert first_acceleration(2, 16, 0.5, "separating") == pytest.approx(
        first_acceleration(2, 16, 0.5), rel=1e-3
    )


@pytest.mark.parametrize("ratio", [0.1, pytest.param(3.0, marks=pytest.mark.slow)])
def test_a_sphere_sets_off_with_its_added_mass(ratio):
    """Added mass of a sphere.

    It is half of its displacement, (1 + 2 q^3) / (1 - q^3) times as much in a round tank of 1/q
    diameters.
    """
    q = 1.0 / WIDE
    added = 0.5 * (1.0 + 2.0 * q**3) / (1.0 - q**3)
    assert first_acceleration(3, 10, ratio) == pytest.approx(
        (1.0 - ratio) * GRAVITY / (ratio + added), rel=0.02
    )


@pytest.mark.slow
@pytest.mark.parametrize(("dimension", "cells"), [(2, 48), (3, 32)])
def test_a_box_floats_at_its_displacement(dimension, cells):
    """Displacement of a floating box.

    It is the mean over its bobbing, measured from the free surface around it.
    """
    trial = displacement(dimension, cells, 0.6)
    assert trial.failures() == []
    assert trial.findings[0].value == pytest.approx(1.0, abs=0.02)
