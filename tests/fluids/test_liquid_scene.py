from typing import Any

import pytest
from pydantic import ValidationError

from small_liquids import box, create, scene
from warp_lcp import fluids
from warp_lcp.fluids import LiquidScene
from warp_lcp.material import domain_window as coverage
from warp_lcp.scene.scene import Scene

LIQUID = [box([0.0, 0.0], [0.5, 0.25])]


def small(**tables: Any) -> LiquidScene:
    return scene(size=[1.0, 0.5], resolution=16, liquid=tables.pop("liquid", LIQUID), **tables)


def test_defaults() -> None:
    model = small()
    assert fluids.SIMULATOR.scene_model is LiquidScene
    assert issubclass(LiquidScene, Scene)
    assert model.pressure.model == "incompressible"
    particles = model.particles
    assert (particles.per_axis, particles.transfer, particles.flip_ratio, particles.jitter) == (
        2,
        "apic",
        0.95,
        0.25,
    )
    assert isinstance(particles.seed, int)


@pytest.mark.parametrize(
    ("tables", "place"),
    [
        ({"pressure": {"model": "compressible"}}, "pressure"),
        ({"pressure": {"model": "unilateral", "surface": "voxel"}}, "surface"),
        ({"particles": {"per_axis": 0}}, "per_axis"),
        ({"particles": {"per_axis": 1.5}}, "per_axis"),
        ({"particles": {"transfer": "mpm"}}, "transfer"),
        ({"particles": {"flip_ratio": 1.5}}, "flip_ratio"),
        ({"particles": {"jitter": -0.1}}, "jitter"),
        ({"particles": {"count": 3}}, "count"),
        ({"liquid": []}, "liquid"),
        ({"liquid": [box([2.0, 0.0], [3.0, 1.0])]}, "liquid"),
        ({"liquid": [box([0.0, 0.0], [0.5, 0.25], velocity=[1.0, 2.0, 3.0])]}, "velocity"),
    ],
)
def test_invalid_keys_and_values_are_refused(tables: dict[str, Any], place: str) -> None:
    with pytest.raises(ValidationError) as caught:
        small(**tables)
    assert any(place in str(part) for error in caught.value.errors() for part in error["loc"])


def test_the_plan_counts_particles() -> None:
    model = small()
    assert model.particle_estimate() == create(model).particles.count == 8 * 4 * 4
    plan = dict(model.plan())
    assert plan["particles"] == "at most 128, 4 a cell, apic"
    assert plan["memory"].endswith("MB")
    overlapping = small(liquid=[*LIQUID, box([0.0, 0.0], [1.0, 0.5]), box([0.0, 0.0], [1.0, 0.5])])
    assert overlapping.particle_estimate() == 16 * 8 * 4


def test_the_plan_says_what_moves_particles_apart() -> None:
    assert not {"density", "reseeding"} & dict(small(density_correction={"every": 0}).plan()).keys()
    assert (
        dict(small().plan())["density"]
        == "at most 1.05 times the density at rest, corrected every step if more than 0.1 % of the "
        "material exceeds it"
    )
    rare = dict(small(particles={"per_axis": 4}, solver={"preset": "preview"}).plan())["density"]
    assert (
        rare
        == "at most 1.025 times the density at rest, corrected every 2 steps if more than 0.05 % "
        "of the material exceeds it"
    )
    plan = dict(
        small(
            density_correction={"every": 2}, particles={"per_axis": 3, "reseed": {"every": 1}}
        ).plan()
    )
    assert plan["density"] == "at most 1.033 times the density at rest, corrected every 2 steps"
    assert plan["reseeding"] == "4 to 18 particles a cell, every step"


def test_the_estimate_of_memory_counts_what_the_options_add(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(coverage, "LEAST_CELLS", 1 << 30)  # grid of the whole domain
    ball = {"shape": "sphere", "center": [0.7, 0.2], "radius": 0.1}
    moving = ball | {"motion": {"kind": "translation", "velocity": [1.0, 0.0]}}
    voxel = {"solids": "voxel", "pressure": {"surface": "voxel"}}
    options = [
        voxel,
        {"solids": "voxel"},
        {"solids": "voxel", "pressure": {"smoothing": 1}},
        {},
        {"solid": [moving]},
    ]
    options += [
        {"solid": [moving], "density_correction": {}, "particles": more}
        for more in ({}, {"reseed": {}})
    ]
    off = {"density_correction": {"every": 0}}
    size = {"size": [1.0, 0.5], "resolution": 1000, "liquid": [box([0.0, 0.0], [0.1, 0.1])]}
    sizes = [
        scene(**size, **({"solid": [ball]} | off | tables)).memory_estimate() for tables in options
    ]
    assert sizes == sorted(set(sizes))
    assert scene(**size, solid=[moving]).memory_estimate() == sizes[-2]  # default of a moving solid
    assert 100 * 2**20 < sizes[0] < 400 * 2**20  # measured: about 160 MB


@pytest.mark.parametrize("per_axis", [1, 2, 3])
def test_the_mass_does_not_depend_on_the_sampling(per_axis: int) -> None:
    simulation = create(
        small(particles={"per_axis": per_axis}, physics={"density": 500.0, "gravity": [0.0, -9.81]})
    )
    row = simulation.step(0.001)
    assert row["particles"] == 8 * 4 * per_axis**2
    assert row["mass"] == pytest.approx(500.0 * 0.5 * 0.25)
