"""Scene of a user-defined material: inherited and replaced tables."""

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest
from pydantic import Field

from scene_tables import scene_error
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.material.particle_assembly import (
    make_boundary,
    make_outlets,
    make_particles,
    make_sources,
    seed_materials,
)
from warp_lcp.material.particle_scene import ParticleScene
from warp_lcp.scene.scene import Domain, validate
from warp_lcp.scene.scene_file import keys
from warp_lcp.scene.shapes import BoxTable, MaterialProperties, PlaneTable, SolidProperties

BOX = {"shape": "box", "min": [0.0, 0.0], "max": [0.4, 0.4]}


class GrainBox(MaterialProperties, BoxTable):
    """Box of grains."""

    size: float = Field(default=1.0, gt=0, description="of a grain [mm]")


class RoughBox(SolidProperties, BoxTable):
    """Solid box with friction."""

    rubs = True
    friction: float | None = Field(default=None, ge=0)


class RoughPlane(SolidProperties, PlaneTable):
    """Solid half space with friction."""

    rubs = True
    friction: float | None = Field(default=None, ge=0)


class GrainDomain(Domain):
    """Domain whose walls have friction, or are open."""

    friction: float = Field(default=0.5, ge=0)
    periodic: list[bool] | None = None


class GrainScene(ParticleScene):
    """Scene of grains."""

    domain: GrainDomain
    solid: list[Annotated[RoughBox | RoughPlane, Field(discriminator="shape")]] = Field(
        default_factory=list
    )
    grain: list[GrainBox] = Field(default_factory=list)

    def materials(self) -> tuple[str, list[GrainBox]]:
        """Return the grains."""
        return "grain", self.grain

    def own_memory_parts(self) -> dict[str, int]:
        """Return the memory of a model of grains."""
        return {"grains": 10 * self.counted_cells, "nothing": 0}


def build(**tables: Any) -> GrainScene:
    data = {
        "scene": {"simulator": "grains"},
        "time": {"duration": 1.0},
        "domain": {"size": [1.6, 0.8], "resolution": 64},
        "grain": [BOX],
    }
    domain = data["domain"] | tables.pop("domain", {})
    return validate(GrainScene, data | {"domain": domain} | tables, "grains.toml")


error = partial(scene_error, build)


def test_own_tables_replace_the_general_ones() -> None:
    scene = build(
        domain={"friction": 0.25, "periodic": [True, False]},
        solid=[{**BOX, "friction": 0.75, "wall": "free-slip"}],
    )
    assert (scene.domain.friction, scene.domain.periodic) == (0.25, [True, False])
    assert (scene.solid[0].friction, scene.solid[0].wall) == (0.75, "free-slip")
    assert keys(scene)["solid[0].friction"] == 0.75
    assert (
        validate(GrainScene, scene.model_dump(by_alias=True, exclude_none=True), "again") == scene
    )


@pytest.mark.parametrize(
    ("tables", "expected"),
    [
        ({"domain": {"friction": -0.5}}, "domain.friction = -0.5: must be at least 0"),
        ({"domain": {"periodic": [True]}}, "domain.periodic = [true]: must have 2 entries"),
        ({"solid": [{**BOX, "friction": -1}]}, "solid[0].friction = -1: must be at least 0"),
        (
            {"solid": [{**BOX, "fiction": 1}]},
            "solid[0].fiction: unknown key; did you mean 'friction'?",
        ),
        (
            {"solid": [{"shape": "sphere", "center": [0, 0], "radius": 1}]},
            'solid[0].shape = "sphere": unknown shape; choose from box, plane',
        ),
        ({"grain": []}, "grain: is missing, and there is no [[source]] either"),
        (
            {"grain": [{**BOX, "size": 0}]},
            "grain[0].size = 0: must be greater than 0 (of a grain [mm])",
        ),
        ({"grain": [{**BOX, "translate": [2.0, 0.0]}]}, "grain[0]: lies outside the domain"),
        (
            {"particles": {"reseed": {"min": 5}}},
            "particles.reseed.min = 5: must be at most the 4 particles of a cell at rest",
        ),
    ],
)
def test_errors_name_its_keys(tables: dict[str, Any], expected: str) -> None:
    assert error(**tables).startswith(f"grains.toml: {expected}")


def test_its_plan_counts_its_own_memory() -> None:
    plain = build()
    assert plain.particle_estimate() == 16 * 16 * 4
    assert plain.memory_parts()["grains"] == 10 * round(64 * 32 * 2.5)
    assert "nothing" not in plain.memory_parts()
    assert ("particles", "at most 1,024, 4 a cell, apic") in plain.plan()
    assert list(plain.memory_parts())[:2] == ["grid", "grains"]


def test_a_minimal_scene_uses_the_shared_parts() -> None:
    """Shared parts of a scene, with counts and owners by arithmetic.

    16 x 16 cells of the first box, 8 x 16 more of the second, the rest of which the first covers.
    """
    second = {"shape": "box", "min": [0.2, 0.0], "max": [0.6, 0.4], "velocity": [1.0, -2.0]}
    source = {"shape": "box", "min": [1.0, 0.7], "max": [1.1, 0.8], "velocity": [0.0, -1.0]}
    scene = build(
        grain=[BOX, second],
        source=[source],
        drain=[BOX],
        solid=[{"shape": "plane", "point": [1.4, 0.0], "normal": [-1.0, 0.0]}],
    )
    grid = StaggeredGrid(scene.cell_counts, scene.spacing, scene.dimension, "cpu")
    boundary, notes = make_boundary(scene, grid, Path())
    assert notes == ()
    _, owner, _ = seed_materials(scene, grid, boundary, Path())
    assert np.bincount(owner).tolist() == [16 * 16 * 4, 8 * 16 * 4]
    particles, notes = make_particles(scene, grid, boundary, Path())
    assert notes == []
    velocity = particles.velocity.numpy()
    assert (velocity[owner == 0] == 0.0).all()
    assert (velocity[owner == 1] == [1.0, -2.0, 0.0]).all()
    sources, outlets = (
        make_sources(scene, grid, boundary, Path()),
        make_outlets(scene, grid, Path()),
    )
    assert sources is not None
    assert outlets is not None
    assert sources.emit(particles, None, 0.0) == 4 * 4 * 4
    # The drain lies in the first box.
    assert outlets.apply(particles, 0.0, 0.0)[0] == 16 * 16 * 4


def test_a_material_without_room_is_named() -> None:
    scene = build(grain=[BOX, BOX])
    grid = StaggeredGrid(scene.cell_counts, scene.spacing, scene.dimension, "cpu")
    with pytest.raises(
        ValueError, match=r"grain\[1\] \(box\) holds no particle: .* in an earlier grain"
    ):
        make_particles(scene, grid, make_boundary(scene, grid, Path())[0], Path())
