"""Stable wedges of sand, and the measurement of heaps.

Heaps at all resolutions are in the suite `validation`.
"""

import math

import numpy as np
import pytest

from warp_lcp.benchmarks.validation import sand_heap
from warp_lcp.benchmarks.validation.scenes import positions, steps

CELLS, STANDS = 40, 0.5  # cells of the length; [s]


def sinks(friction_angle: float, duration: float = STANDS) -> tuple[float, float]:
    """Return the relative loss of height, total and of the center, of a wedge.

    The wedge has 27 degrees.
    """
    simulation = sand_heap.cut_wedge(CELLS, 27.0, material={"friction_angle": friction_angle})
    top, center = sand_heap.height(simulation), positions(simulation)[:, 1].mean()
    for _ in steps(simulation, duration):
        pass
    return 1.0 - sand_heap.height(simulation) / top, 1.0 - float(
        positions(simulation)[:, 1].mean() / center
    )


def test_a_wedge_flatter_than_a_layer_that_stops_stands() -> None:
    """Rest of a wedge flatter than a layer that stops.

    If partly filled cells beside air were no part of the pressure problem, its center would sink by
    5 % in a second.
    """
    top, center = sinks(30.0)
    assert top < sand_heap.SHRINKS
    assert center < 0.015  # loose grains of the cut surface settle once


def test_a_wedge_twice_as_steep_as_its_friction_slumps() -> None:
    top, center = sinks(sand_heap.half_as_steep(27.0), duration=0.25)
    assert top > 5.0 * sand_heap.SHRINKS
    assert center > 0.05


def test_a_wedge_and_a_dome_are_distinguished_at_any_position() -> None:
    x = np.arange(0.0, 1.2, 0.0125)
    steep = math.tan(math.radians(33.0))
    wedge = np.maximum(0.2 - np.abs(x - 0.5037) * steep, 0.0)
    dome = 0.2 * np.maximum(1.0 - ((x - 0.5037) / 0.3) ** 2, 0.0)
    angle, off, top = sand_heap.fit((x, wedge), sand_heap.wedge)
    assert (angle, top) == (pytest.approx(33.0, abs=1e-2), pytest.approx(0.2, rel=1e-3))
    assert off < 1e-4 * top
    assert sand_heap.fit((x, wedge), sand_heap.dome)[1] > 0.04 * top
    assert sand_heap.fit((x, dome), sand_heap.wedge)[1] > 0.04 * top
    assert sand_heap.fit((x, dome), sand_heap.dome)[1] < 1e-4 * top


def test_an_outline_holds_the_sand() -> None:
    simulation = sand_heap.cut_wedge(CELLS, 27.0)
    x, y = sand_heap.outline(simulation)
    area = 0.25 * sand_heap.BASE**2 * math.tan(math.radians(27.0))
    assert float(y.sum() * simulation.grid.spacing) == pytest.approx(area, rel=0.01)
    assert float(np.average(x, weights=y)) == pytest.approx(0.5 * sand_heap.LENGTH, abs=1e-3)
    assert sand_heap.fit((x, y), sand_heap.wedge)[0] == pytest.approx(27.0, abs=0.3)


@pytest.mark.parametrize(("angle", "slope"), [(30.0, 27.0), (30.0, 37.0), (22.0, 27.0)])
def test_a_cone_stands_or_slumps_as_its_angle_says(angle: float, slope: float) -> None:
    """Rest of cones flatter than the angle of repose.

    Compression along one axis alone would let sand of 30 degrees yield at 23.8.
    """
    loses = sand_heap.slope_lost("cone", 12, angle, slope, duration=0.3)
    assert loses < sand_heap.SAGS if slope < angle else loses > 4.0 * sand_heap.SAGS


def test_a_cone_is_measured_around_its_axis() -> None:
    simulation = sand_heap.cut_spatial("cone", 24, 30.0, 30.0)
    for diagonal in (None, False, True):
        line = sand_heap.spatial_outline(simulation, shape="cone", diagonal=diagonal)
        assert sand_heap.fit(line, sand_heap.wedge)[0] == pytest.approx(30.0, abs=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["cone", "wedge"])
def test_a_heap_in_3d_has_the_angle_of_repose(shape: sand_heap.Shape) -> None:
    """Between the slope at which layers stop and that at which sand at rest yields."""
    heap, _ = sand_heap.pour_spatial(shape, 24, 30.0)
    k = 0.5 * (math.sin(math.radians(30.0)) + math.tan(math.radians(30.0)))
    one_seed = 1.4  # degrees between heaps of different seeds and their mean
    assert heap.angle > math.degrees(math.atan(k)) - one_seed
    assert heap.angle < math.degrees(math.asin(k)) + one_seed
    assert abs(heap.creep) < sand_heap.CREEP


@pytest.mark.slow
def test_a_heap_poured_slowly_lies_where_sand_stops_and_stays() -> None:
    heap = sand_heap.pour(96, 20.0, lasts=2.0)
    assert heap.angle == pytest.approx(20.0, abs=sand_heap.NEAR)
    assert abs(heap.creep) < sand_heap.CREEP
