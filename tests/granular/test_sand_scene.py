"""Scenes of sand: allowed settings and messages."""

import math
from typing import Any

import pytest

from small_sands import box, scene
from warp_lcp.granular.materials import slope
from warp_lcp.granular.scene import STEEPEST_ANGLE, STICKS, SandScene
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.table import SceneError, validate

FILE = """[scene]
simulator = "granular"
[time]
duration = 1.0
[domain]
size = [1.0, 0.5]
resolution = 16
[[sand]]
shape = "box"
min = [0.0, 0.0]
max = [0.5, 0.25]
[[solid]]
shape = "box"
min = [0.75, 0.0]
max = [1.0, 0.25]
"""


def error(tmp_path: Any, *overrides: str) -> str:
    """Return the message about a scene with these keys."""
    file = tmp_path / "pile.toml"
    file.write_text(FILE)
    with pytest.raises(SceneError) as caught:
        load_scene(file, overrides)
    return str(caught.value).removeprefix(f"{file}: ")


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        ("material.name=mud", "material.name = \"mud\": must be 'dry-sand', 'gravel' or 'sugar'"),
        ("material.friction_angle=0", "material.friction_angle = 0: must be greater than 0"),
        ("material.friction_angle=60.0", "material.friction_angle = 60.0: must be less than 60"),
        ("material.friction_angle=steep", 'material.friction_angle = "steep": must be a number'),
        ("material.density=-1", "material.density = -1: must be greater than 0"),
        ("material.max_fraction=1.0", "material.max_fraction = 1.0: must be less than 1"),
        ("material.cohesion=-5", "material.cohesion = -5: must be at least 0"),
        ("material.tensile_strength=-5", "material.tensile_strength = -5: must be at least 0"),
        ("material.tensile_strength=100", "material.tensile_strength = 100.0: must be at most 0"),
        (
            "material.friction_angle_test=shear",
            "material.friction_angle_test = \"shear\": must be 'repose', 'simple-shear', "
            "'plane-strain' or 'triaxial-compression'",
        ),
        (
            "material.wall_friction=-0.1",
            'material.wall_friction = -0.1: must be a number from 0 to 10, or "stick" (friction '
            "coefficient",
        ),
        ("material.colour=red", "material.colour: unknown key; choose from cohesion, density"),
        ("friction.model=sphere", "friction.model = \"sphere\": must be 'cone' or 'box'"),
        (
            "domain.friction=rough",
            'domain.friction = "rough": must be a number from 0 to 10, or "stick" (friction '
            "coefficient of the domain's walls",
        ),
        ("domain.friction=11", "domain.friction = 11: must be a number from 0 to 10"),
        ("domain.wall=free-slip", 'domain.wall = "free-slip": must be "separating"'),
        (
            "domain.periodic=[false, true]",
            "domain.periodic = [false, true]: may be true along x and z only",
        ),
        ("domain.periodic=[true]", "domain.periodic = [true]: must have 2 entries"),
        ("solid.0.friction=-1", "solid[0].friction"),
        ("solid.0.wall=free-slip", 'must be "separating"'),
        ("sand.0.friction_angle=70", "sand[0].friction_angle = 70: must be less than 60"),
        ("sand.0.cohesion=true", "sand[0].cohesion = true: must be a number"),
        ("gauge.height=0.5", "gauge.height = 0.5: must lie in the domain, between 0 and 0.5 m"),
        ("gauge.hight=0.2", "gauge.height: is missing"),
        (
            "solver.method=psor",
            "solver.method = \"psor\": must be 'accelerated-projection' or 'interleaved-sweeps'",
        ),
        ("solver.tolerance=1", "solver.tolerance = 1: must be less than 1"),
        ("solver.tolerance=auto", 'solver.tolerance = "auto": is for liquids only'),
        ("solver.max_iterations=0", "solver.max_iterations = 0: must be at least 10"),
        ("solver.precision=double", "solver.precision = \"double\": must be 'single'"),
        ("time.cfl=0", "time.cfl = 0: must be at least 0.001"),
        ("pressure.model=unilateral", 'pressure: needs scene.simulator = "fluids"'),
        ("liquid=[]", "--set liquid=[]: must read section.key=value"),
    ],
)
def test_invalid_settings_are_refused(tmp_path: Any, overrides: str, expected: str) -> None:
    assert expected in error(tmp_path, overrides)


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (
            ["material.density=1500", "physics.density=1600"],
            "material.density = 1500.0: differs from physics.density = 1600; give one of them",
        ),
        (
            ["domain.periodic=[true, false]", 'domain.open=["left"]'],
            "names a side of a periodic axis",
        ),
        (
            ["domain.periodic=[true, false]", "particles.reseed.every=1"],
            "cannot be combined with reseed, source or drain",
        ),
        (
            ["material.cohesion=10", "material.tensile_strength=20"],
            "must be at most 17.32, the cohesion over the tangent of the friction angle",
        ),
    ],
)
def test_keys_that_contradict_each_other(
    tmp_path: Any, overrides: list[str], expected: str
) -> None:
    assert expected in error(tmp_path, *overrides)


def test_sand_of_two_kinds_is_refused() -> None:
    sand = [
        box([0.0, 0.0], [0.2, 0.2], friction_angle=30.0),
        box([0.5, 0.0], [0.7, 0.2], friction_angle=35.0),
    ]
    with pytest.raises(ValueError, match="must be 30 as in the other"):
        scene(size=[1.0, 0.5], resolution=16, sand=sand)


def test_no_sand_at_all_is_refused() -> None:
    with pytest.raises(ValueError, match=r"no \[\[source\]\] either"):
        scene(size=[1.0, 0.5], resolution=16, sand=[])


def test_sand_has_a_density_correction_and_no_forces_that_speed_it_up_in_flight() -> None:
    model = scene(size=[1.0, 0.5], resolution=16, sand=[box([0.0, 0.0], [0.2, 0.2])])
    assert model.correction is not None
    assert not model.settles
    assert not model.speeds_up


def test_a_material_gives_what_the_table_does_not() -> None:
    """Material with overrides: gravel's own density and angle, another wall friction."""
    data = {
        "scene": {"simulator": "granular"},
        "time": {"duration": 1.0},
        "domain": {"size": [1.0, 0.5], "resolution": 16},
    }
    given = data | {
        "material": {"name": "gravel", "wall_friction": 0.1},
        "sand": [box([0.0, 0.0], [0.2, 0.2])],
    }
    model = validate(SandScene, given, "x")
    assert (model.physics.density, model.friction_angle, model.max_fraction) == (1800.0, 40.0, 0.65)
    assert model.wall_frictions() == [0.1]


def test_walls_and_solids_have_their_own_friction() -> None:
    solids = [
        box([0.5, 0.0], [0.6, 0.1], friction=0.0),
        box([0.7, 0.0], [0.8, 0.1], friction="stick"),
        box([0.9, 0.0], [1.0, 0.1]),
    ]
    model = scene(
        size=[1.0, 0.5],
        resolution=16,
        sand=[box([0.0, 0.0], [0.2, 0.2])],
        solid=solids,
        friction=0.3,
    )
    assert model.wall_frictions() == [0.3, 0.0, STICKS, 0.3]


def test_the_slope_of_the_yield_set() -> None:
    """Slope of the yield set.

    k is tan 30 in simple shear, sin 30 in plane strain, and the mean of both of repose. In triaxial
    compression it is 2 sqrt(3) sin / (3 - sin), the outer cone. 2-D is plane strain. Cohesion
    counts k / tan 30 of it: as such in the first, times cos 30 in the second.
    """
    sand = [box([0.0, 0.0], [0.2, 0.2])]
    tangent, cosine = math.tan(math.radians(30.0)), math.sqrt(0.75)
    assert scene(size=[1.0, 0.5], resolution=16, sand=sand).slope == pytest.approx(
        0.5 * (0.5 + tangent)
    )
    sheared = {"material": {"friction_angle_test": "simple-shear"}}
    assert scene(size=[1.0, 0.5], resolution=16, sand=sand, **sheared).slope == pytest.approx(
        tangent
    )
    for test, factor in (
        ("repose", 0.5 * (1.0 + cosine)),
        ("simple-shear", 1.0),
        ("plane-strain", cosine),
    ):
        material = {"friction_angle_test": test, "cohesion": 10.0}
        assert scene(
            size=[1.0, 0.5], resolution=16, sand=sand, material=material
        ).intercept == pytest.approx(10.0 * factor)
    assert scene(
        size=[1.0, 0.5], resolution=16, sand=sand, material={"friction_angle_test": "plane-strain"}
    ).slope == pytest.approx(0.5)
    triaxial = {"material": {"friction_angle_test": "triaxial-compression"}}
    assert scene(size=[1.0, 0.5], resolution=16, sand=sand, **triaxial).slope == pytest.approx(0.5)
    deep = [box([0.0] * 3, [0.2] * 3)]
    assert scene(size=[1.0, 0.5, 0.5], resolution=16, sand=deep, **triaxial).slope == pytest.approx(
        math.sqrt(3.0) / 2.5
    )


def test_a_cone_that_would_bear_tension_is_refused() -> None:
    """Refusal of a cone that would bear tension.

    The least principal stress is below 0 beyond |s|_F = sqrt(2) sqrt(3) / 2 p where a sample is
    pulled; in 2-D beyond sqrt(2) p.
    """
    flat = [box([0.0, 0.0], [0.2, 0.2])]
    with pytest.raises(
        ValueError, match=r"must be at most 50\.7 where material.friction_angle_test = \"repose\""
    ):
        scene(size=[1.0, 0.5], resolution=16, sand=flat, material={"friction_angle": 51.0})
    sand = [box([0.0] * 3, [0.2] * 3)]
    steep = {"material": {"friction_angle_test": "triaxial-compression", "friction_angle": 37.0}}
    with pytest.raises(ValueError, match=r"must be at most 36\.8"):
        scene(size=[1.0, 0.5, 0.5], resolution=16, sand=sand, **steep)
    k = scene(
        size=[1.0, 0.5, 0.5],
        resolution=16,
        sand=sand,
        material={**steep["material"], "friction_angle": 36.8},
    ).slope
    axial = math.sqrt(2.0) * k * math.sqrt(2.0 / 3.0)  # of the deviator, over p
    assert 0.0 < 1.0 - axial < 0.01


def test_the_plan_lists_material_and_friction() -> None:
    plan = dict(load_scene("column-collapse-2d").plan())
    assert plan["material"].startswith("dry-sand, friction angle 30 degrees")
    assert plan["friction"] == "cone, on walls 0.577"
    assert plan["solver"].startswith("accelerated-projection to 0.001")


@pytest.mark.parametrize(
    ("dimension", "test", "steepest"),
    [
        (2, "repose", 1.0),
        (2, "simple-shear", 1.0),
        (3, "repose", math.sqrt(0.75)),
        (3, "simple-shear", math.sqrt(0.75)),
    ],
)
def test_the_steepest_angles_are_those_of_the_cone(
    dimension: int, test: Any, steepest: float
) -> None:
    """Angles to a tenth of a degree at which the cone begins to bear tension."""
    angle = STEEPEST_ANGLE[test][dimension]
    assert slope(angle, test, dimension) <= steepest < slope(angle + 0.1, test, dimension)


def test_angles_of_friction_that_grows_are_those_of_layers() -> None:
    sand, tangent = [box([0.0, 0.0], [0.2, 0.2])], math.tan(math.radians(30.0))
    grows = {"dynamic_angle": 35.0, "grain_size": 1e-3}
    model = scene(size=[1.0, 0.5], resolution=16, sand=sand, friction=grows)
    assert model.friction_angle_test == "simple-shear"
    assert model.slope == pytest.approx(tangent)
    asked = scene(
        size=[1.0, 0.5],
        resolution=16,
        sand=sand,
        friction=grows,
        material={"friction_angle_test": "repose"},
    )
    assert asked.slope == pytest.approx(0.5 * (0.5 + tangent))


def test_velocities_have_a_tolerance_that_follows_from_that_of_the_residual() -> None:
    sand = [box([0.0, 0.0], [0.5, 0.25])]

    def allowed(**solver: object) -> float:
        model = scene(size=[1.0, 0.5], resolution=16, sand=sand, solver=solver)
        return model.solver.allowed_velocity_error

    assert allowed() == pytest.approx(0.05)
    assert allowed(tolerance=1e-4) == pytest.approx(0.005)
    assert allowed(velocity_tolerance=0.02) == 0.02
    assert allowed(velocity_tolerance=0.0) == 0.0
    assert allowed(method="interleaved-sweeps") == 0.0
    assert allowed(method="interleaved-sweeps", velocity_tolerance=0.02) == 0.02
