"""Solids thinner than cells in sand: no leaks, and sand rests on them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from default_run import covering, slow
from drawn_thin_walls import drawn, run
from scene_tables import box
from warp_lcp.granular import SIMULATOR
from warp_lcp.granular.scene import SandScene

CELLS = 24
CELL = 1.0 / CELLS


def simulate(
    until: float, sand: list[dict[str, Any]], solid: list[dict[str, Any]], **tables: Any
) -> tuple[Any, list[dict[str, Any]]]:
    """Return a simulation of sand after some time, and the rows of its log."""
    data = {
        "scene": {"simulator": "granular"},
        "time": {"duration": 10.0},
        "domain": {"size": [1.0, 1.0], "resolution": CELLS},
    }
    model = SandScene.model_validate(data | {"sand": sand, "solid": solid} | tables)
    simulation, rows = SIMULATOR.create(model, device="cpu", folder=Path()), []
    while simulation.time < until - 1e-9:
        rows.append(simulation.step(min(simulation.stable_dt(), 0.005, until - simulation.time)))
    return simulation, rows


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(("offset", "thickness"), covering([0.0, 0.3, 0.7], [0.1, 0.5]))
def test_sand_rests_on_a_plate(thickness: float, offset: float) -> None:
    top = (8.0 + offset) / CELLS
    simulation, rows = simulate(
        0.3,
        [box([0.0, top], [1.0, top + 6.0 * CELL])],
        [box([-0.1, top - thickness * CELL], [1.1, top])],
    )
    y = simulation.particles.position.numpy()[:, 1]
    assert y.min() > top and np.percentile(y, 99) == pytest.approx(top + 6.0 * CELL, abs=0.6 * CELL)
    assert rows[-1]["max_speed"] < 0.2 and rows[-1]["max_fraction"] < 1.15


def test_no_grain_passes_the_sides_of_a_funnel() -> None:
    """Sides of a funnel without leaks.

    Steep sides of 0.6 cells, with a neck of 5 cells: all sand below the funnel is below its neck.
    """
    sides = [
        {
            "shape": "capsule",
            "from": [-0.05, 0.85],
            "to": [0.4, 0.4],
            "radius": 0.3 * CELL,
            "friction": 0.3,
        },
        {
            "shape": "capsule",
            "from": [1.05, 0.85],
            "to": [0.6, 0.4],
            "radius": 0.3 * CELL,
            "friction": 0.3,
        },
    ]
    simulation, _ = simulate(0.25, [box([0.36, 0.45], [0.64, 0.9])], sides)
    x, y, _ = simulation.particles.position.numpy().T
    assert (y < 0.35).any(), "some has fallen through the neck"
    assert not ((y > 0.4) & ((x + y < 0.8) | (x - y > 0.2))).any()


@pytest.mark.parametrize(
    ("thickness", "until"), [(0.25, 0.15), *map(slow, [(0.25, 0.3), (1.28, 0.3)])]
)
def test_a_shaken_box_keeps_its_sand(thickness: float, until: float) -> None:
    low, high = 0.23, 0.77
    motion = {"kind": "sinusoid", "period": 0.5, "amplitude": [0.1, 0.03]}
    w, solids = thickness * CELL, []
    for axis in range(2):
        for side in range(2):
            start, end = [low - w] * 2, [high + w] * 2
            (start if side else end)[axis] = high if side else low
            solids.append(box(start, end, motion=motion))
    simulation, _ = simulate(until, [box([low, low], [high, 0.5])], solids)
    pose = simulation.boundary.cut.solids[0].motion.pose(simulation.time)
    own = (simulation.particles.position.numpy() - pose.translation)[:, :2]
    assert own.min() > low - 1e-3 * CELL and own.max() < high + 1e-3 * CELL


@pytest.mark.slow
def test_a_hopper_with_thin_sides_discharges_as_one_with_thick_sides() -> None:
    """Its neck is 8 cells wide: gaps between thin walls are whole numbers of cells."""
    cells, foot, neck, angle = 48, 0.4, 8, 30.0
    cell, slope = 1.0 / cells, np.tan(np.radians(angle))

    def discharged(thickness: float) -> int:
        sides = []
        for sign in (-1.0, 1.0):
            x = 0.5 + 0.5 * sign * neck * cell
            ends = sorted([x, x + sign * thickness * cell])
            place = {"rotate": -sign * angle, "about": [x, foot], "friction": 0.3}
            sides.append(box([ends[0], foot], [ends[1], foot + 0.75], **place))
        sand = []
        for y in np.arange(foot, foot + 0.5, 0.5 * cell):
            half = 0.5 * neck * cell + (y - foot + 0.25 * cell) * slope
            sand.append(box([0.5 - half, y], [0.5 + half, y + 0.5 * cell]))
        domain = {"size": [1.0, 1.0], "resolution": cells}
        simulation, _ = simulate(0.5, sand, sides, domain=domain)
        return int(np.count_nonzero(simulation.particles.position.numpy()[:, 1] < foot))

    assert discharged(0.6) == pytest.approx(discharged(3.05), rel=0.03)


def test_a_fast_piston_drives_sand() -> None:
    """A plate that starts at 20 m/s in a pool of sand with room above it.

    The residual of the first step is three times what gravity adds in it, and 0.2 % of the plate's
    speed. No shorter step is better.
    """
    draw = drawn(771004, "piston", "granular", 2)
    draw.until = 0.004
    outcome = run(draw)
    assert outcome.passed == 0
    assert outcome.density < 1.2
