"""Open sides of the domain: no pressure beyond them, and no return flow."""

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from default_run import covering
from small_liquids import GRAVITY, advance, box, create, scene
from warp_lcp.fluids import LiquidScene
from warp_lcp.grid.domain_sides import SIDES

BALL = {"shape": "sphere", "center": [0.1, 0.85, 0.1], "radius": 0.06}


def opened(model: LiquidScene, sides: list[str]) -> LiquidScene:
    """Return the scene with open sides."""
    data = model.model_dump(by_alias=True, exclude_none=True)
    data["domain"]["open"] = sides
    return LiquidScene.model_validate(data)


@pytest.mark.parametrize(
    ("side", "surface", "cut"), covering(SIDES, ["ghost-fluid", "voxel"], [False, True])
)
def test_the_pressure_is_that_of_the_depth_below_an_open_side(
    side: str, surface: str, cut: bool
) -> None:
    # Gravity points away from the open side of a full box. A confused side, a closed face or p = 0
    # at a wrong place would show.
    dimension = 3 if side in ("front", "back") else 2
    axis, high = SIDES.index(side) >> 1, SIDES.index(side) & 1
    size = [1.0, 1.0, 1.0][:dimension]
    gravity = np.zeros(dimension)
    gravity[axis] = -GRAVITY if high else GRAVITY
    ball = {**BALL, "center": [0.5, 0.5, 0.5][:dimension], "radius": 0.15}
    model = opened(
        scene(
            size=size,
            resolution=10,
            liquid=[box([0.0] * dimension, size)],
            physics={"gravity": gravity.tolist()},
            particles={"jitter": 0.0},
            pressure={"surface": surface},
            solver={"tolerance": 1e-8, "precision": "double"},
            **({"solid": [ball]} if cut else {}),
        ),
        [side],
    )
    simulation = create(model)
    assert bool(simulation.boundary.open) == cut
    row = simulation.step(1e-3)
    assert row["solve_status"] == "CONVERGED"
    p = simulation.grid.interior(simulation.projection.pressures(1000.0))
    depth = (np.arange(10) + 0.5) * 0.1
    if high:
        depth = depth[::-1]
    # p = 0 at the centers of the cells beyond, or on the side itself.
    depth = depth + (0.05 if surface == "voxel" else 0.0)
    shape = [1, 1, 1]
    shape[2 - axis] = 10
    expected = np.broadcast_to(1000.0 * GRAVITY * depth.reshape(shape), p.shape)
    away = p[..., :2, :2] if dimension == 2 else p[:2, :2, :2]
    wanted = expected[..., :2, :2] if dimension == 2 else expected[:2, :2, :2]
    scale = 1000.0 * GRAVITY
    np.testing.assert_allclose(away / scale, wanted / scale, atol=0.01 if cut else 2e-3)


@pytest.mark.parametrize(
    ("side", "solids", "cut"),
    covering(["left", "right", "bottom", "top"], ["cut-cell", "voxel"], [False, True]),
)
def test_a_block_leaves_as_if_there_were_no_side(side: str, solids: str, cut: bool) -> None:
    axis, sign = SIDES.index(side) >> 1, 2 * (SIDES.index(side) & 1) - 1
    velocity = [0.0, 0.0]
    velocity[axis] = float(sign)
    solid = {"solid": [{"shape": "sphere", "center": [0.5, 0.5], "radius": 0.05}]} if cut else {}
    low, high = [0.375, 0.375], [0.625, 0.625]
    low[axis], high[axis] = (0.625, 0.875) if sign > 0 else (0.125, 0.375)
    model = scene(
        size=[1.0, 1.0],
        resolution=32,
        liquid=[box(low, high, velocity=velocity)],
        solids=solids,
        physics={"gravity": [0.0, 0.0]},
        **solid,
    )
    simulation = create(opened(model, [side]))
    count = simulation.particles.count
    rows = advance(simulation, 0.25, 0.01)
    # The front has 0.125 to go, the rest is 0.25 long.
    assert simulation.particles.count == pytest.approx(0.5 * count, rel=0.1)
    np.testing.assert_allclose(simulation.particles.velocity.numpy()[:, axis], sign, atol=1e-5)
    rows += advance(simulation, 0.45, 0.01)
    assert simulation.particles.count == 0
    assert sum(row["departed"] for row in rows) == count
    assert rows[-1]["stopped"] == 0
    simulation.step(0.01)  # an empty domain is no error
    assert [frame.points.shape for frame in simulation.frame() if hasattr(frame, "points")] == [
        (0, 3)
    ]


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("cut", [False, True])
def test_a_pool_drains_over_an_open_side_as_a_dam_breaks(dimension: int, cut: bool) -> None:
    # Ritter's solution: the discharge at the place of a broken dam is 8/27 sqrt(g) h^(3/2) until
    # the wave returns.
    size, top = [2.0, 0.5, 0.125][:dimension], [2.0, 0.25, 0.125][:dimension]
    ball = (
        {"solid": [{**BALL, "center": [0.1, 0.45, 0.06][:dimension], "radius": 0.04}]}
        if cut
        else {}
    )
    model = scene(size=size, resolution=64, liquid=[box([0.0] * dimension, top)], **ball)
    simulation = create(opened(model, ["right"]))
    mass = simulation.particles.count
    advance(simulation, 0.6)
    lost = 0.5 * (1.0 - simulation.particles.count / mass)
    expected = 8.0 / 27.0 * GRAVITY**0.5 * 0.25**1.5 * 0.6
    # Shallow water has no vertical motion at the start.
    assert lost == pytest.approx(expected, rel=0.25)


@pytest.mark.parametrize(
    ("sides", "message"),
    [(["top", "top"], "named twice"), (["front"], "3-D"), (["up"], "left"), ("top", "list")],
)
def test_invalid_side_settings_are_refused(sides: Any, message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        opened(scene(size=[1.0, 1.0], resolution=8, liquid=[box([0.0, 0.0], [0.5, 0.5])]), sides)


def test_particles_pushed_through_an_open_side_leave() -> None:
    model = scene(
        size=[1.0, 0.5],
        resolution=32,
        liquid=[box([0.0, 0.0], [0.5, 0.4])],
        density_correction={"every": 1},
    )
    simulation = create(opened(model, ["left"]))
    count = simulation.particles.count
    rows = advance(simulation, 0.5)
    assert sum(row["departed"] for row in rows) == count - simulation.particles.count > 0
