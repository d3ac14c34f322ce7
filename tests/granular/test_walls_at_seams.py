"""Thin walls at the seam of a periodic axis: same faces, velocities, answers as elsewhere."""

from typing import Any

import numpy as np
import pytest

from drawn_seam_walls import COUNTS, KINDS, SeamDraw, drawn, passed, run, tables_of
from drawn_thin_walls import made

# Draws of a wall in the middle of a face, with a side on the seam, and within rounding of it.
SEAMS = [
    ("standing", 0.0, 0.25, 0.0),
    ("standing", 1e-7, 0.05, 0.0),
    ("standing", -0.5e-1, 1.28, 0.0),
    ("leaning", 0.0, 0.5, 20.0),
    ("shaken", 0.2, 0.9, 0.0),
    ("turned", 0.0, 0.25, 0.0),
]


def draw_of(kind: str, place: float, thick: float, angle: float, dimension: int) -> SeamDraw:
    """Return a draw; place and thickness are in cells."""
    dx, axis = 1.0 / COUNTS[dimension][0], 0 if dimension == 2 else 2
    motion: dict[str, Any] | None = None
    if kind == "shaken":
        amplitude = [0.0] * dimension
        amplitude[axis] = 1.3 * dx
        motion = {"kind": "sinusoid", "period": 0.1, "amplitude": amplitude}
    elif kind == "turned":
        motion = {"kind": "sinusoid", "period": 0.2, "angle": 12.0}
        motion |= {"axis": [1, 0, 0]} if dimension == 3 else {}
    return SeamDraw(kind, dimension, axis, place * dx, thick * dx, angle, 6.0, motion, False, True)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize(("kind", "place", "thick", "angle"), SEAMS)
def test_faces_at_the_seam_are_closed_as_elsewhere(
    kind: str, place: float, thick: float, angle: float, dimension: int
) -> None:
    """Fields of a scene and of one shifted by whole cells, at the start and as the wall moves."""
    draw = draw_of(kind, place, thick, angle, dimension)
    layers = COUNTS[dimension][draw.axis] // 4
    at = made(tables_of(draw, 0.0))
    away = made(tables_of(draw, layers / COUNTS[dimension][0]))
    for time in (0.0, 0.013, 0.04, 0.077)[: 1 if draw.motion is None else 4]:
        fields = []
        for simulation in (at, away):
            simulation.boundary.place(time)
            simulation.solids.place(time)
            simulation.solids.begin_step(time, 1e-3)
            assert simulation.grid.barriers is not None
            rows = [
                simulation.solids.index,
                simulation.boundary.capacity,
                simulation.grid.barriers.near,
                *simulation.grid.barriers.number,
                *simulation.boundary.open,
                *simulation.solids.velocity,
            ]
            fields.append([simulation.grid.interior(field.numpy()) for field in rows])
        crossed = np.moveaxis(fields[0][3 + draw.axis], 2 - draw.axis, 0)
        assert (crossed > 0).any()
        for one, other in zip(*fields, strict=True):
            back = np.roll(other, -layers, axis=2 - draw.axis)
            np.testing.assert_allclose(one.astype(float), back.astype(float), atol=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", [21, 22])
def test_sand_presses_on_a_wall_at_the_seam(kind: str, dimension: int, seed: int) -> None:
    """Sand in two rooms: none passes, and its places and densities are as away from the seam."""
    draw = drawn(seed, kind, dimension)
    length = COUNTS[dimension][draw.axis] / COUNTS[dimension][0]
    at, away = run(draw, 0.0), run(draw, 0.25 * length)
    assert passed(at) == passed(away) == 0
    assert np.abs(at.centers - away.centers).max() * COUNTS[dimension][0] < 0.15
    assert at.density == pytest.approx(away.density, abs=0.06)
