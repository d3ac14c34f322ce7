"""Rigid bodies with walls thinner than cells float, sink and keep what is in them."""

from pathlib import Path

import numpy as np
import pytest

from small_liquids import box, create, scene
from stepping import advance

CELLS = 32
WALL = 0.3 / CELLS
LOW, HIGH = 0.3, 0.7  # sides of a cup [m]
LEVEL = 0.4


def cup(folder: Path, bottom: float) -> Path:
    """Write the mesh of a cup, of 0.3 m and open at its top, and return its file."""
    top, w = bottom + 0.3, WALL
    around = [(LOW, bottom), (HIGH, bottom), (HIGH, top), (HIGH - w, top), (HIGH - w, bottom + w)]
    around += [(LOW + w, bottom + w), (LOW + w, top), (LOW, top)]
    n, faces = len(around), []
    for i in range(n):
        j = (i + 1) % n
        faces += [(i, j, n + j), (i, n + j, n + i)]
    for a, b, c, d in ((0, 1, 4, 5), (1, 2, 3, 4), (0, 5, 6, 7)):
        for first, second, third in ((a, b, c), (a, c, d)):
            faces += [(n + first, n + second, n + third), (third, second, first)]
    lines = [f"v {x} {y} {z}" for z in (-1.0, 1.0) for x, y in around]
    lines += ["f " + " ".join(str(corner + 1) for corner in face) for face in faces]
    file = folder / "cup.obj"
    file.write_text("\n".join(lines))
    return file


@pytest.mark.default_cases(1)
@pytest.mark.parametrize(("density", "bottom", "inner"), [(200.0, 0.31, 0.08), (3000.0, 0.33, 0.0)])
def test_a_cup_floats_and_keeps_its_water(
    tmp_path: Path, density: float, bottom: float, inner: float
) -> None:
    pools = [
        box([0.0, 0.0], [LOW, LEVEL]),
        box([HIGH, 0.0], [1.0, LEVEL]),
        box([LOW, 0.0], [HIGH, bottom]),
    ]
    inside = [LOW + WALL, HIGH - WALL]
    if inner:
        pools.append(box([inside[0], bottom + WALL], [inside[1], bottom + WALL + inner]))
    solid = {"shape": "mesh", "file": str(cup(tmp_path, bottom)), "density": density}
    simulation = create(scene(size=[1.0, 1.0], resolution=CELLS, liquid=pools, solid=[solid]))
    assert simulation.grid.barriers is not None and simulation.bodies is not None
    body = simulation.bodies.bodies[0]

    def held() -> int:
        x = (
            simulation.particles.position.numpy() - body.position
        ) @ body.rotation + body.properties.center
        within = (x[:, 0] > inside[0]) & (x[:, 0] < inside[1]) & (x[:, 1] > bottom + WALL)
        return int(np.count_nonzero(within & (x[:, 1] < bottom + 0.3)))

    first, start = held(), body.position[1]
    advance(simulation, 0.4, 0.01)
    assert held() == first
    x, y, _ = simulation.particles.position.numpy().T
    level = np.percentile(y[(x < 0.2) | (x > 0.8)], 99)
    draft = level - (body.position[1] - start + bottom)
    weight = body.properties.mass + 1000.0 * inner * (inside[1] - inside[0])
    assert draft == pytest.approx(weight / (1000.0 * (HIGH - LOW)), abs=0.5 / CELLS)
    assert abs(np.degrees(body.angle)) < 5.0


@pytest.mark.parametrize(("density", "start", "sinks"), [(2000.0, 0.3, True), (500.0, 0.3, False)])
def test_a_plate_sinks_or_rises(density: float, start: float, sinks: bool) -> None:
    plate = box([LOW, start], [HIGH, start + WALL], density=density)
    simulation = create(
        scene(
            size=[1.0, 1.0], resolution=CELLS, liquid=[box([0.0, 0.0], [1.0, LEVEL])], solid=[plate]
        )
    )
    assert simulation.grid.barriers is not None and simulation.bodies is not None
    advance(simulation, 0.15, 0.01)
    way = simulation.bodies.bodies[0].position[1] - start - 0.5 * WALL
    assert (way < -2e-4) if sinks else (way > 2e-4)


def test_small_bodies_cut_cells_as_before() -> None:
    """A ball, or a box that is thin along two axes, is not a wall."""
    for solid in (
        {"shape": "sphere", "center": [0.5, 0.5], "radius": 0.02},
        box([0.5, 0.5], [0.52, 0.53]),
    ):
        model = scene(
            size=[1.0, 1.0],
            resolution=CELLS,
            liquid=[box([0.0, 0.0], [1.0, 0.3])],
            solid=[solid | {"density": 500.0}],
        )
        assert create(model).grid.barriers is None


def test_a_fixed_thin_wall_carries_no_liquid() -> None:
    """Added mass of a plate before a fixed thin wall, in the list of solids: that without the wall.

    The wall's number is larger than those of all bodies.
    """
    plate = box([LOW, 0.2], [HIGH, 0.2 + WALL], density=500.0)
    wall = box([0.9, 0.0], [0.9 + WALL, 1.0])
    masses = []
    for solids in ([plate], [plate, wall]):
        simulation = create(
            scene(
                size=[1.0, 1.0], resolution=16, liquid=[box([0.0, 0.0], [1.0, LEVEL])], solid=solids
            )
        )
        simulation.step(1e-3)
        coupling = simulation.projection.coupling
        assert coupling is not None and coupling.carried is not None
        masses.append(coupling.carried.mass)
    assert masses[0][0, 1, 1] > 0.0
    np.testing.assert_array_equal(masses[0], masses[1])
