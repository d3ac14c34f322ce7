"""Scene keys of rigid bodies: meaning and refusals."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from warp_lcp.fluids import LiquidScene
from warp_lcp.granular.scene import SandScene
from warp_lcp.material.particle_assembly import make_bodies, placed_solids
from warp_lcp.rigid.body import BodyMotion
from warp_lcp.run.check import check_scene
from warp_lcp.scene.scene import validate
from warp_lcp.scene.table import SceneError

BLOCK = {"shape": "box", "min": [0.4, 0.5], "max": [0.6, 0.6]}
BALL = {"shape": "sphere", "center": [0.5, 0.5, 0.5], "radius": 0.1}
SPIN = [10.0, 20.0, 30.0]


def data(*solids: dict[str, Any], simulator: str = "fluids", **domain: Any) -> dict[str, Any]:
    size = [1.0] * len(solids[0].get("center", solids[0].get("min", [0.0, 0.0])))
    material = {"shape": "box", "min": [0.0] * len(size), "max": [0.2] * len(size)}
    return {
        "scene": {"simulator": simulator},
        "time": {"duration": 1.0},
        "domain": {"size": size, "resolution": 16} | domain,
        "physics": {},
        ("liquid" if simulator == "fluids" else "sand"): [material],
        "solid": list(solids),
    }


def build(*solids: dict[str, Any], simulator: str = "fluids", **domain: Any) -> Any:
    return validate(
        LiquidScene if simulator == "fluids" else SandScene,
        data(*solids, simulator=simulator, **domain),
        "scene.toml",
    )


def made(*solids: dict[str, Any], **more: Any) -> Any:
    scene = build(*solids, **more)
    return make_bodies(scene, placed_solids(scene, Path()))


@pytest.mark.parametrize("simulator", ["fluids", "granular"])
@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            {"mass": 1.0, "density": 500.0},
            "solid[0].density = 500.0: cannot be combined with mass: give one of them",
        ),
        (
            {"mass": 0.0},
            "solid[0].mass = 0.0: must be at least 1e-18 (mass of a rigid body [kg; kg/m in 2-D])",
        ),
        (
            {"density": -1.0},
            "solid[0].density = -1.0: must be at least 1e-18 (density of a rigid body, instead of "
            "mass [kg/m^3])",
        ),
        (
            {"mass": 1.0, "motion": {"kind": "translation", "velocity": [1.0, 0.0]}},
            "solid[0].motion: cannot be combined with mass: a rigid body is moved by forces",
        ),
        (
            {"mass": 1.0, "invert": True},
            "solid[0].invert = true: cannot be combined with mass: the outside of a shape has no "
            "mass",
        ),
        (
            {"velocity": [1.0, 0.0]},
            "solid[0].velocity = [1.0, 0.0]: needs mass or density, which make the solid a rigid "
            "body",
        ),
        (
            {"angular_velocity": 9.0},
            "solid[0].angular_velocity = [9.0]: needs mass or density, which make the solid a "
            "rigid body",
        ),
        (
            {"restitution": 0.5},
            "solid[0].restitution = 0.5: needs mass or density, which make the solid a rigid body",
        ),
        (
            {"mass": 1.0, "velocity": [1.0, 0.0, 0.0]},
            "solid[0].velocity = [1.0, 0.0, 0.0]: must have 2 entries in 2-D",
        ),
        (
            {"mass": 1.0, "angular_velocity": SPIN},
            "solid[0].angular_velocity = [10.0, 20.0, 30.0]: must be one number in 2-D",
        ),
        (
            {"mass": 1.0, "translate": [2.0, 0.0]},
            "solid[0]: lies outside the domain, which extends from the origin to [1.0, 1.0] m",
        ),
    ],
)
def test_contradicting_body_keys_are_refused(
    keys: dict[str, Any], message: str, simulator: str
) -> None:
    with pytest.raises(SceneError) as caught:
        build({**BLOCK, **keys}, simulator=simulator)
    assert str(caught.value) == f"scene.toml: {message}"


def test_a_plane_has_no_mass() -> None:
    with pytest.raises(SceneError, match=r"solid\[0\].density = 2.0: not for a plane"):
        build({"shape": "plane", "point": [0.5, 0.5], "normal": [0.0, 1.0], "density": 2.0})


def test_whole_cells_do_not_move() -> None:
    with pytest.raises(SceneError, match=r'solid\[0\].mass: needs domain.solids = "cut-cell"'):
        build({**BLOCK, "mass": 1.0}, solids="voxel")


def test_a_liquid_rubs_against_bodies_only_where_they_touch() -> None:
    with pytest.raises(
        SceneError,
        match=r"solid\[0\].friction = 0.5: needs mass or density.*a liquid has no friction",
    ):
        build({**BLOCK, "friction": 0.5})
    assert build({**BLOCK, "friction": 0.5}, simulator="granular").wall_frictions()[1] == 0.5
    assert made({**BLOCK, "mass": 1.0}).bodies[0].friction == 0.5
    assert made({**BLOCK, "mass": 1.0, "friction": "stick"}).bodies[0].friction == 1e6
    assert (
        made({**BLOCK, "mass": 1.0}, simulator="granular", friction=0.3).bodies[0].friction == 0.3
    )
    assert (
        made({**BLOCK, "mass": 1.0, "friction": 0.2}, simulator="granular", friction=0.3)
        .bodies[0]
        .friction
        == 0.2
    )


def test_keys_reach_the_body() -> None:
    keys = {
        "density": 800.0,
        "velocity": [1.0, 2.0, 3.0],
        "angular_velocity": SPIN,
        "restitution": 0.4,
    }
    bodies = made(
        {"shape": "box", "min": [0.0, 0.9, 0.9], "max": [0.1, 1.0, 1.0]}, {**BALL, **keys}
    )
    (body,) = bodies.bodies
    assert bodies.numbers == [2]
    assert body.properties.mass == pytest.approx(800.0 * 4.0 / 3.0 * np.pi * 1e-3)
    np.testing.assert_allclose(body.velocity, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(body.angular_velocity, np.radians(SPIN))
    assert (body.restitution, body.name) == (0.4, "solid[1] (sphere)")
    flat = made({**BLOCK, "mass": 2.0, "angular_velocity": 90.0}).bodies[0]
    np.testing.assert_allclose(flat.angular_velocity, [0.0, 0.0, np.pi / 2.0])
    assert flat.properties.mass == 2.0


def test_solids_follow_the_bodies() -> None:
    scene = build(BLOCK, {**BLOCK, "translate": [0.0, 0.2], "mass": 1.0})
    placed = placed_solids(scene, Path())
    bodies = make_bodies(scene, placed)
    assert placed[0].motion is None
    assert isinstance(placed[1].motion, BodyMotion)
    assert placed[1].motion.body is bodies.bodies[0]
    assert make_bodies(build(BLOCK), placed_solids(build(BLOCK), Path())) is None


def test_the_plan_names_them() -> None:
    plan = dict(
        build({**BLOCK, "mass": 1.5}, {**BLOCK, "translate": [0.0, 0.2], "density": 700.0}).plan()
    )
    assert plan["bodies"] == "solid 0 box of 1.5 kg/m, solid 1 box of 700 kg/m^3"
    assert "bodies" not in dict(build(BLOCK).plan())


def test_the_memory_of_moving_solids_counts() -> None:
    assert (
        build({**BLOCK, "mass": 1.5}).memory_parts()["solids"]
        > build(BLOCK).memory_parts()["solids"]
    )


def test_check_refuses_bodies_that_overlap(tmp_path: Path) -> None:
    import tomli_w

    file = tmp_path / "scene.toml"
    file.write_text(
        tomli_w.dumps(data({**BLOCK, "mass": 1.0}, {**BLOCK, "translate": [0.15, 0.05]}))
    )
    with pytest.raises(
        SceneError, match=r"solid\[0\] \(box\) reaches 0.05 m into solid\[1\] \(box\) at the start"
    ):
        check_scene(str(file))
    file.write_text(tomli_w.dumps(data({**BLOCK, "mass": 1.0}, {**BLOCK, "translate": [0.2, 0.0]})))
    check_scene(str(file))


@pytest.mark.parametrize("place", [[0.0, -0.52], [0.45, 0.0]])
def test_a_body_that_reaches_into_a_wall_is_refused(place: list[float]) -> None:
    with pytest.raises(ValueError, match="into the domain's wall"):
        made({**BLOCK, "mass": 1.0, "translate": place})
