"""Walls rougher than sand: the sand beside them fails first.

So sand that is pushed between them can move.
"""

import numpy as np
import pytest

from small_sands import GRAVITY, box, create, scene

DX, DT, SPEED = 0.05, 0.02, 0.2  # [m], [s], [m/s]


def pushed(
    friction: float | str, *, depth: int, cohesion: float = 0.0, **more: float
) -> tuple[str, float, float]:
    """Push a column six cells wide up between walls, twice.

    Return the last status, its speed [m/s] and the largest pressure [rho g dx].
    """
    floor = box(
        [-1.0, -1.0], [2.0, 2 * DX], motion={"kind": "translation", "velocity": [0.0, SPEED]}
    )
    sand = [box([0.0, 2 * DX], [6 * DX, (depth + 2) * DX])]
    material = {"friction_angle": 40.0, "friction_angle_test": "simple-shear", "cohesion": cohesion}
    size = [6 * DX, (depth + 8) * DX]
    simulation = create(
        scene(
            size=size,
            resolution=depth + 8,
            friction=friction,
            solid=[floor],
            sand=sand,
            material=material,
            **more,
        )
    )
    status = [str(simulation.step(DT)["solve_status"]) for _ in range(2)][-1]
    speed = float(simulation.particles.velocity.numpy()[:, 1].mean())
    return status, speed, float(simulation.stress.now.numpy()[0].max()) / (GRAVITY * DT)


@pytest.mark.parametrize("cohesion", [0.0, 300.0])
def test_a_piston_lifts_sand_between_walls_that_stick(cohesion: float) -> None:
    """Sand lifted by a piston between rough walls.

    With Coulomb's law alone the load of the column is exp(2 mu h / l): the piston went through it,
    and pressures grew with every step.
    """
    status, speed, pressure = pushed("stick", depth=12, cohesion=cohesion)
    assert status == "CONVERGED"
    assert speed == pytest.approx(SPEED, rel=0.01)
    rough = pushed(2.0, depth=12, cohesion=cohesion)
    # The pressure does not depend on mu above the sand's own friction.
    assert pressure == pytest.approx(rough[2], rel=0.05)


def test_smoother_walls_bear_what_coulomb_says() -> None:
    """Load of smoother walls by Coulomb's law.

    The bound is the sand's: below its tangent, 0.84, the walls' coefficient counts, and rougher
    walls load the piston more.
    """
    pressures = [pushed(friction, depth=12)[2] for friction in (0.0, 0.4, 0.8, "stick")]
    assert (np.diff(pressures) > 1.0).all()


def test_a_rough_floor_holds_sand_that_leans_on_it() -> None:
    """Rest on a rough floor.

    On a slope below the angle of repose nothing slides on a wall as rough as sand.
    """
    tilt = np.radians(25.0)
    tables = {
        "physics": {"gravity": [GRAVITY * np.sin(tilt), -GRAVITY * np.cos(tilt)]},
        "periodic": [True, False],
        "friction": "stick",
    }
    simulation = create(
        scene(
            size=[8 * DX, 12 * DX],
            resolution=12,
            sand=[box([0.0, 0.0], [8 * DX, 6 * DX])],
            **tables,
        )
    )
    for _ in range(20):
        simulation.step(DT / 2)
    assert (
        abs(simulation.particles.velocity.numpy()[:, 0].mean())
        < 0.01 * GRAVITY * np.sin(tilt) * 10 * DT
    )
