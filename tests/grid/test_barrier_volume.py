"""Volume of the liquid beside thin solids."""

import math

import numpy as np
import pytest

from small_liquids import box, create, scene

CELLS = {2: 16, 3: 8}
OFFSETS = [0.5, 0.8125, 1.125, 1.4375]


def divided(
    dimension: int, thickness: float, offset: float, angle: float, tops: tuple[float, float]
) -> tuple[float, float]:
    """Return the volume in the log, and that of two pools on the sides of a tilted plate.

    Both are in units of the volume of a slab of the domain one cell thick.
    """
    dx = 1.0 / CELLS[dimension]
    at, half = 0.5 + (offset - 1.0) * dx, 0.5 * thickness * dx
    low, high = np.full(dimension, -2.0), np.full(dimension, 3.0)
    low[0], high[0] = at - half, at + half
    about = [at, *[0.0] * (dimension - 1)]
    plate = box(low, high, rotate=angle if dimension == 2 else [0.0, 0.0, angle], about=about)
    lean, wide = math.tan(math.radians(angle)), half / math.cos(math.radians(angle))
    # The plate's middle line is x = at - lean y. Both sides are full up to the lower top; above it,
    # strips of half a cell end in the middle line, and the solid cuts its half off.
    high_top, low_top = tops
    pools = [box(np.zeros(dimension), [1.0, low_top, *[1.0] * (dimension - 2)])]
    exact = low_top * (1.0 - 2.0 * wide)
    for lower in np.arange(low_top, high_top - 1e-9, 0.5 * dx):
        a, b = np.zeros(dimension), np.ones(dimension)
        b[0] = at - lean * (lower + 0.25 * dx)
        a[1], b[1] = lower, lower + 0.5 * dx
        pools.append(box(a, b))
        exact += (b[0] - wide) * 0.5 * dx
    liquid = create(
        scene(
            size=[1.0] * dimension,
            resolution=CELLS[dimension],
            liquid=pools,
            solid=[plate],
            particles={"jitter": 0.0},
        )
    )
    row = liquid.step(1e-5)
    return row["volume"] / dx, exact / dx


@pytest.mark.parametrize(
    ("dimension", "thickness", "offset", "angle"),
    [
        *((2, 0.05, offset, 0.0) for offset in OFFSETS),
        (2, 0.6, 0.8125, 0.0),
        (2, 1.5, 0.5, 0.0),
        (2, 0.05, 0.8125, 20.0),
        (2, 0.6, 1.125, 20.0),
        (2, 1.5, 0.5, 20.0),
        (3, 0.6, 0.8125, 0.0),
        (3, 0.6, 1.125, 20.0),
    ],
)
def test_volume_of_pools_on_both_sides_of_a_plate(
    dimension: int, thickness: float, offset: float, angle: float
) -> None:
    """The error is at most 0.02 of a layer of cells, at any offset from the grid."""
    measured, exact = divided(dimension, thickness, offset, angle, (0.5, 0.25))
    assert measured == pytest.approx(exact, abs=0.02)
