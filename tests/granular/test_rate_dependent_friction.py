"""Rate-dependent friction mu(I).

The projection of a cell is compared with SciPy's in `test_sand_stress`.
"""

import math

import numpy as np
import pytest

from small_sands import box, create, scene
from warp_lcp.benchmarks.validation import inclined
from warp_lcp.granular.scene import SandScene
from warp_lcp.scene.table import SceneError, validate

GROWS = {"dynamic_angle": 40.0, "grain_size": 0.01}
GLASS = {
    "dynamic_angle": inclined.DYNAMIC,
    "grain_size": inclined.GRAIN,
    "inertial_number": inclined.INERTIAL,
}


def sand(dimension: int = 2, **tables: object) -> SandScene:
    """Return a column with rate-dependent friction."""
    size, high = [1.0, 0.5, 0.25], [0.375, 0.375, 0.25]
    column = [box([0.0] * dimension, high[:dimension])]
    return scene(
        size=size[:dimension], resolution=16, sand=column, **({"friction": GROWS} | tables)
    )


def test_a_layer_runs_as_fast_as_bagnold_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """Speed of a layer by Bagnold's profile.

    It starts with nine tenths of the speed. With constant friction it would run twice as fast by
    then.
    """
    monkeypatch.setattr(inclined, "SETS_IN", 0.25)
    monkeypatch.setattr(inclined, "OFF", 0.9)
    angle, tables = 24.0, {"material": {"friction_angle": inclined.STATIC}}
    y, u = inclined.steady(12, angle, friction=GLASS, **tables)
    expected = inclined.bagnold_profile(y, angle)
    assert u.mean() == pytest.approx(expected.mean(), rel=0.03)
    assert np.abs(u - expected).max() < 0.05 * expected.max()
    _, free = inclined.steady(12, angle, **tables)
    assert free.mean() > 2.0 * expected.mean()


def test_bagnolds_profile_keeps_the_balance_of_forces() -> None:
    """Balance of forces in Bagnold's profile.

    The shear stress mu(I) p of its rate of shear is rho g sin(angle) times the depth, at each
    depth.
    """
    angle, d, h = 28.0, inclined.GRAIN, inclined.DEPTH
    y = np.linspace(0.1, 0.8, 8) * h
    rate = (
        inclined.bagnold_profile(y + 1e-6, angle) - inclined.bagnold_profile(y - 1e-6, angle)
    ) / 2e-6
    # Over rho; the density of a grain is rho over 0.6.
    p = inclined.GRAVITY * math.cos(math.radians(angle)) * (h - y)
    number = rate * d / np.sqrt(0.6 * p)
    static, most = (math.tan(math.radians(a)) for a in (inclined.STATIC, inclined.DYNAMIC))
    stress = (static + (most - static) / (inclined.INERTIAL / number + 1.0)) * p
    assert stress == pytest.approx(
        inclined.GRAVITY * math.sin(math.radians(angle)) * (h - y), rel=1e-6
    )


@pytest.mark.parametrize("dimension", [2, 3])
def test_sand_that_falls_bears_more_than_at_rest_and_no_more_than_its_rate_allows(
    dimension: int,
) -> None:
    """Stress of falling sand: between its bounds at rest and at its rate.

    In cells that yield, stress over pressure lies between both slopes. The reported ratio to the
    bound of their rate is 1.
    """
    simulation = create(sand(dimension, solver={"tolerance": 1e-4, "max_iterations": 3000}))
    for _ in range(12):
        row = simulation.step(5e-3)
    ratio, flags = simulation.outcome.ratio.numpy(), simulation.packing.flags.numpy()
    now = simulation.stress.now.numpy().astype(float)
    normals, count = (now[1:4], 3) if dimension == 3 else (now[1:2], 1)
    size = (0.5 if dimension == 3 else 1.0) * (normals**2).sum(axis=0)
    for shear in range(count):
        first = 1 + count + 4 * shear
        size += np.abs(now[first : first + 4]).max(axis=0) ** 2
    inner = np.zeros(flags.shape, dtype=bool)  # away from walls, whose friction is Coulomb's
    inner[2 if dimension == 3 else 1, 3:-3, 3:-3] = True
    fast = inner & (flags & 2 > 0) & (now[0] > 0.01) & (ratio > 0.99)
    assert fast.sum() > 10
    assert ratio[fast] == pytest.approx(1.0, abs=0.02)
    slope = np.sqrt(size[fast]) / now[0][fast]
    assert slope.min() > math.tan(math.radians(30.0)) - 1e-3
    assert slope.max() < math.tan(math.radians(40.0)) + 1e-3
    assert slope.mean() > math.tan(math.radians(31.0))
    assert row["dissipation"] > 0.0


def test_both_methods_find_the_same_velocity() -> None:
    found = []
    for method, most in (("accelerated-projection", 4000), ("interleaved-sweeps", 3000)):
        simulation = create(
            sand(solver={"method": method, "tolerance": 5e-5, "max_iterations": most})
        )
        for _ in range(2):
            row = simulation.step(5e-3)
        assert row["coupled_residual"] <= 5e-5
        found.append(row["kinetic_energy"])
    assert found[1] == pytest.approx(found[0], rel=2e-3)


@pytest.mark.parametrize(
    ("friction", "expected"),
    [
        ({"dynamic_angle": 40.0}, "friction.grain_size: must be given with friction.dynamic_angle"),
        (
            {"grain_size": 1e-3},
            "friction.grain_size = 0.001: needs friction.dynamic_angle, which is missing",
        ),
        (
            {"inertial_number": 0.3},
            "friction.inertial_number = 0.3: needs friction.dynamic_angle, which is missing",
        ),
        (
            GROWS | {"dynamic_angle": 30.0},
            "friction.dynamic_angle = 30.0: must be above the friction angle, 30 degrees",
        ),
        (
            GROWS | {"dynamic_angle": 50.0},
            "friction.dynamic_angle = 50.0: must be at most 45 where material.friction_angle_test "
            '= "simple-shear"',
        ),
        (
            GROWS | {"model": "box"},
            'friction.model = "box": must be "cone" with friction.dynamic_angle',
        ),
        (GROWS | {"grain_size": 0.0}, "friction.grain_size = 0.0: must be greater than 0"),
    ],
)
def test_missing_or_superfluous_keys_are_named(friction: dict[str, object], expected: str) -> None:
    tables = {
        "domain": {"size": [1.0, 0.5], "resolution": 16},
        "time": {"duration": 1.0},
        "sand": [box([0.0, 0.0], [0.5, 0.25])],
    }
    with pytest.raises(SceneError) as caught:
        validate(
            SandScene,
            {"scene": {"simulator": "granular"}, **tables, "friction": friction},
            "pile.toml",
        )
    assert expected in str(caught.value)


def test_the_plan_says_that_friction_grows() -> None:
    assert (
        "friction",
        "cone, growing to 40 degrees with the rate of shear of grains of 0.01 m, on walls 0.4",
    ) in sand().plan()
