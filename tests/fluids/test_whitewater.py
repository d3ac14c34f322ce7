"""Whitewater: amounts, motion by kind, walls, determinism, resume, and no cost when off."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

import small_liquids
from small_liquids import box, create, scene
from small_runs import StepCounter, run_into, written_files
from warp_lcp.extras.export import export_run
from warp_lcp.fluids import LiquidScene
from warp_lcp.fluids import whitewater_kernels as kernels
from warp_lcp.fluids.whitewater import COLUMNS, KINDS, STATE, directions, oldest
from warp_lcp.fluids.whitewater_table import WhitewaterSettings
from warp_lcp.grid.grid_part import ONE_PROCESS
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.render.recording import Recording
from warp_lcp.render.section import Section
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.table import SceneError
from warp_lcp.simulation import Points

SPRAY, FOAM, BUBBLE = range(3)
LIVELY = {"trapped_air_rate": 2e6, "crest_rate": 2e5, "length": 0.1}
FALLING = {
    2: [box([0.0, 0.0], [1.0, 0.15]), box([0.3, 0.25], [0.6, 0.45], velocity=[1.0, -2.0])],
    3: [
        box([0.0, 0.0, 0.0], [1.0, 0.15, 0.25]),
        box([0.3, 0.25, 0.0], [0.6, 0.45, 0.25], velocity=[1.0, -2.0, 0.0]),
    ],
}


def splash(dimension: int = 2, device: str = "cpu", **tables: Any) -> Any:
    """Return a block of water that falls into a pool, with whitewater."""
    size = [1.0, 0.5, 0.25][:dimension]
    tables = {"whitewater": LIVELY} | tables
    return create(
        scene(size=size, resolution=24, liquid=FALLING[dimension], **tables), device=device
    )


def stepped(simulation: Any, steps: int, dt: float = 0.01) -> Any:
    """Return the simulation after some steps."""
    for _ in range(steps):
        simulation.step(dt)
    return simulation


def put(simulation: Any, position: list[list[float]], velocity: list[list[float]]) -> None:
    """Replace the whitewater by given particles of a long life."""
    shape = (len(position), 3)
    arrays = {name: np.zeros(shape, dtype=np.float32) for name in STATE}
    arrays["whitewater_position"][:] = position
    arrays["whitewater_velocity"][:] = velocity
    arrays["whitewater_state"][:] = [0.0, 100.0, FOAM]
    simulation.whitewater.restore(arrays)


def arrays_of(simulation: Any) -> dict[str, np.ndarray]:
    return {name: array.copy() for name, array in simulation.whitewater.state().items()}


QUIET = {"whitewater": {"trapped_air_rate": 0.0, "crest_rate": 0.0, "air_drag": 0.0}}


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_splash_emits_all_kinds_and_leaves_the_liquid_alone(dimension: int) -> None:
    with_foam = stepped(splash(dimension), 30)
    without = stepped(splash(dimension, whitewater=None), 30)
    particles = with_foam.whitewater.particles
    assert particles.count > 50
    kinds = np.bincount(with_foam.whitewater.points().fields["kind"], minlength=3)
    assert (kinds > 0).all()
    for name, array in without.particles.arrays().items():
        np.testing.assert_array_equal(array.numpy(), with_foam.particles.arrays()[name].numpy())
    position = particles.position.numpy()
    assert (position >= 0.0).all()
    assert (position <= [1.0, 0.5, 0.25]).all()
    if dimension == 2:
        assert not position[:, 2].any()


def test_liquid_at_rest_and_liquid_in_rigid_motion_emit_nothing() -> None:
    pool = create(scene(size=[1.0, 0.5], resolution=24, liquid=FALLING[2][:1], whitewater=LIVELY))
    stepped(pool, 5)
    assert pool.whitewater.particles.count == 0
    block = [box([0.3, 0.1], [0.6, 0.3], velocity=[3.0, 0.0])]
    flying = scene(
        size=[1.0, 0.5],
        resolution=24,
        liquid=block,
        physics={"gravity": [0.0, 0.0]},
        whitewater=LIVELY | {"crest_rate": 0.0},
    )
    simulation = stepped(create(flying), 5)
    assert simulation.whitewater.particles.count == 0  # fast, but no liquid approaches other


def test_the_same_seed_gives_the_same_bits_and_another_one_does_not() -> None:
    one, same = (arrays_of(stepped(splash(), 25)) for _ in range(2))
    other = arrays_of(stepped(splash(whitewater=LIVELY | {"seed": 1}), 25))
    for name in STATE:
        np.testing.assert_array_equal(one[name], same[name])
    assert (
        one["whitewater_position"].shape != other["whitewater_position"].shape
        or (one["whitewater_position"] != other["whitewater_position"]).any()
    )


@pytest.mark.parametrize("follow", [True, False])
def test_random_numbers_belong_to_cells_of_the_domain(follow: bool) -> None:
    """A grid around the liquid alone emits the same particles at the start."""
    tables = {"domain": {"size": [2.0, 1.0], "resolution": 48, "follow": follow}}
    data = scene(size=[2.0, 1.0], resolution=48, liquid=FALLING[2], whitewater=LIVELY)
    model = LiquidScene.model_validate(data.model_dump(exclude_unset=True) | tables)
    emitted = arrays_of(stepped(create(model), 12))["whitewater_position"]
    whole = arrays_of(stepped(create(data), 12))["whitewater_position"]
    np.testing.assert_array_equal(emitted, whole)


def test_a_state_continues_bit_for_bit() -> None:
    simulation = stepped(splash(), 20)
    state = simulation.state()
    stepped(simulation, 5)
    other = splash()
    other.restore(state)
    stepped(other, 5)
    for name, array in arrays_of(simulation).items():
        np.testing.assert_array_equal(array, arrays_of(other)[name])


def test_a_state_without_whitewater_or_with_a_wrong_one_is_refused() -> None:
    simulation = stepped(splash(), 3)
    state = simulation.state()
    with pytest.raises(ValueError, match="lacks whitewater_position"):
        splash().restore({name: a for name, a in state.items() if name not in STATE})
    bad = state | {"whitewater_velocity": np.zeros((7, 3), dtype=np.float32)}
    with pytest.raises(ValueError, match="whitewater_velocity is float32"):
        splash().restore(bad)


def test_a_resumed_run_has_the_same_files(tmp_path: Path) -> None:
    overrides = ["domain.resolution=32", "time.duration=0.6", "output.checkpoint_every=5"]
    model = load_scene("dam-break-2d", [*overrides, "whitewater.length=0.2"])
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert run_into(model, whole, observer=StepCounter()).status == "finished"
    watch = StepCounter()
    run_into(model, parts, observer=watch, stop=lambda: watch.steps >= 12)
    assert run_into(model, parts, observer=StepCounter(), resume=True).status == "finished"
    files = written_files(whole)
    assert files == written_files(parts)
    assert (whole / "frames" / "whitewater_000010.vtu").is_file()


def test_spray_flies_along_its_parabola() -> None:
    simulation = create(scene(size=[1.0, 0.5], resolution=24, liquid=FALLING[2][:1], **QUIET))
    put(simulation, [[0.3, 0.4, 0.0]], [[1.0, 0.5, 0.0]])
    stepped(simulation, 10)
    now = arrays_of(simulation)
    height = 0.4 + 0.5 * 0.1 - 9.81 * 0.01**2 * 55  # symplectic Euler: n (n + 1) / 2 kicks
    np.testing.assert_allclose(now["whitewater_position"][0], [0.4, height, 0.0], atol=1e-5)
    assert now["whitewater_state"][0, 2] == SPRAY


def test_a_new_particle_goes_with_the_liquid_before_its_birth() -> None:
    """It moves for the whole step, and falls for the rest of it."""
    simulation = create(scene(size=[1.0, 0.5], resolution=24, liquid=FALLING[2][:1], **QUIET))
    put(simulation, [[0.3, 0.4, 0.0]], [[1.0, 0.5, 0.0]])
    state = arrays_of(simulation)
    state["whitewater_state"][0, 0] = -0.0025
    simulation.whitewater.restore(state)
    stepped(simulation, 1)
    now, fall = arrays_of(simulation), 9.81 * 0.0075
    np.testing.assert_allclose(now["whitewater_velocity"][0], [1.0, 0.5 - fall, 0.0], atol=1e-5)
    height = 0.4 + 0.01 * (0.5 - fall)
    np.testing.assert_allclose(now["whitewater_position"][0], [0.31, height, 0.0], atol=1e-5)
    assert now["whitewater_state"][0, 0] == pytest.approx(0.0075)


def test_a_bubble_rises_at_its_speed_and_becomes_foam() -> None:
    deep = [box([0.0, 0.0], [1.0, 0.4])]
    simulation = create(scene(size=[1.0, 0.5], resolution=24, liquid=deep, **QUIET))
    put(simulation, [[0.5, 0.05, 0.0]], [[0.0, 0.0, 0.0]])
    stepped(simulation, 20)
    before = arrays_of(simulation)["whitewater_position"][0, 1]
    stepped(simulation, 20)
    now = arrays_of(simulation)
    assert (now["whitewater_position"][0, 1] - before) / 0.2 == pytest.approx(0.25, abs=0.01)
    assert now["whitewater_state"][0, 2] == BUBBLE
    stepped(simulation, 150)
    now = arrays_of(simulation)
    assert now["whitewater_state"][0, 2] == FOAM
    assert now["whitewater_position"][0, 1] == pytest.approx(0.4, abs=0.02)


def test_foam_dissolves_after_its_life() -> None:
    simulation = create(scene(size=[1.0, 0.5], resolution=24, liquid=FALLING[2][:1], **QUIET))
    put(simulation, [[0.2, 0.15, 0.0], [0.7, 0.15, 0.0]], [[0.0] * 3] * 2)
    state = arrays_of(simulation)
    state["whitewater_state"][0, 1] = 0.03
    simulation.whitewater.restore(state)
    stepped(simulation, 5)
    assert simulation.whitewater.particles.count == 1
    assert arrays_of(simulation)["whitewater_position"][0, 0] == pytest.approx(0.7, abs=0.01)


SOLIDS = {
    "cut": ({"shape": "box", "min": [0.4, 0.0], "max": [0.63, 0.37]}, "cut-cell"),
    "voxel": ({"shape": "box", "min": [0.375, 0.0], "max": [0.625, 0.375]}, "voxel"),
    "thin": ({"shape": "box", "min": [0.5, 0.0], "max": [0.51, 0.45]}, "cut-cell"),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_spray_stops_at_solids(name: str) -> None:
    solid, kind = SOLIDS[name]
    simulation = create(
        scene(
            size=[1.0, 0.5],
            resolution=24,
            liquid=[box([0.0, 0.0], [0.2, 0.1])],
            solid=[solid],
            solids=kind,
            **QUIET,
        )
    )
    rng = np.random.default_rng(5)
    position = np.zeros((200, 3))
    position[:, :2] = rng.uniform([0.1, 0.15], [0.3, 0.3], (200, 2))
    put(simulation, position, [[6.0, 0.0, 0.0]] * 200)
    stepped(simulation, 8)
    now = arrays_of(simulation)["whitewater_position"]
    assert len(now) == 200
    assert (now[:, 0] <= solid["min"][0] + 1e-5).all()


def test_the_oldest_go_if_there_are_too_many() -> None:
    simulation = splash(whitewater=LIVELY | {"max_particles": 40})
    removed = 0
    for _ in range(30):
        row = simulation.step(0.01)
        assert sum(row[name] for name in COLUMNS[:3]) == simulation.whitewater.particles.count
        assert simulation.whitewater.particles.count <= 40
        removed += row["whitewater_removed"]
    assert removed > 0
    ages = arrays_of(simulation)["whitewater_state"][:, 0]
    assert (np.diff(ages) <= 0.011).all()  # the first are the oldest, up to a step


def test_of_equal_ages_those_with_the_least_life_go_first() -> None:
    """The choice does not depend on the order of the particles."""
    rng = np.random.default_rng(8)
    age, life = rng.integers(0, 4, 60), rng.permutation(60)
    state = np.column_stack([age, life, age]).astype(np.float32)
    position = rng.random((60, 3)).astype(np.float32)
    for count in (1, 17, 59, 60):
        expected = np.lexsort([life, -age])[:count]
        for order in (np.arange(60), rng.permutation(60)):
            found = order[oldest(state[order], position[order], count, ONE_PROCESS)]
            np.testing.assert_array_equal(np.sort(found), np.sort(expected))


def test_huge_rates_take_no_more_memory_than_the_largest_number() -> None:
    def first_emission(rate: float, most: int) -> Any:
        """Return a splash after its first step that emits particles."""
        tables = LIVELY | {"crest_rate": rate, "trapped_air_rate": rate, "max_particles": most}
        simulation = splash(whitewater=tables)
        while simulation.whitewater.particles.count == 0:
            row = simulation.step(0.01)
        return simulation, row["whitewater_removed"]

    every, none = first_emission(1e7, 1_000_000)
    limited, removed = first_emission(1e7, 40)
    assert none == 0
    assert removed == every.whitewater.particles.count - 40
    youngest = np.sort(np.argsort(arrays_of(every)["whitewater_state"][:, 0], kind="stable")[:40])
    for name, array in arrays_of(limited).items():
        np.testing.assert_array_equal(array, arrays_of(every)[name][youngest])
    # More than integers of 32 bits can count.
    huge, removed = first_emission(1e17, 40)
    assert huge.whitewater.particles.count == 40
    assert 0 < removed < 2**31


def test_open_sides_and_drains_take_particles() -> None:
    simulation = create(
        scene(
            size=[1.0, 0.5],
            resolution=24,
            liquid=FALLING[2][:1],
            drain=[box([0.0, 0.3], [0.2, 0.5])],
            domain={"size": [1.0, 0.5], "resolution": 24, "open": ["right"]},
            **QUIET,
        )
    )
    put(
        simulation,
        [[0.9, 0.4, 0.0], [0.3, 0.4, 0.0], [0.5, 0.4, 0.0]],
        [[9, 0, 0], [-9, 0, 0], [0, 0, 0]],
    )
    stepped(simulation, 3)
    assert simulation.whitewater.particles.count == 1


def test_frames_have_kind_and_age() -> None:
    simulation = stepped(splash(), 25)
    part = next(part for part in simulation.frame() if part.name == "whitewater")
    assert isinstance(part, Points)
    assert set(part.fields) == {"velocity", "kind", "age"}
    assert (part.fields["age"] >= 0.0).all()
    counts = np.bincount(part.fields["kind"], minlength=3)
    row = simulation.step(0.01)
    assert set(COLUMNS) <= row.keys()
    assert len(counts) == len(KINDS)


def test_nothing_is_imported_without_the_table() -> None:
    program = (
        "import sys; sys.path.insert(0, 'tests'); import small_liquids;"
        "s = small_liquids.dam(); s.step(0.01); s.frame(); s.state();"
        "print([n for n in sys.modules if 'whitewater' in n and 'table' not in n])"
    )
    root = Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=root, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip().splitlines()[-1] == "[]"
    assert small_liquids.dam().whitewater is None


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("trapped_air", [2.0, 1.0], "0 <= least < most"),
        ("speed", [-1.0, 1.0], "0 <= least < most"),
        ("crest", [1.0], "at least 2 entries"),
        ("length", 0.0, "greater than 0"),
        ("max_particles", 0, "at least 1"),
        ("rise_speed", -0.1, "greater than 0"),
    ],
)
def test_wrong_values_are_refused(key: str, value: Any, message: str) -> None:
    with pytest.raises(SceneError, match=message) as caught:
        load_scene("dam-break-2d", [f"whitewater.{key}={value}"])
    assert f"whitewater.{key}" in str(caught.value)


@pytest.mark.parametrize(("length", "notes"), [(0.1, 0), (1e-3, 1), (1e3, 1)])
def test_a_length_that_emits_nothing_is_noted(length: float, notes: int) -> None:
    scene = load_scene("dam-break-2d", [f"whitewater.length={length}"])
    assert sum("whitewater.length" in note for note in scene.notes()) == notes


def test_a_surface_of_cells_is_refused() -> None:
    with pytest.raises(SceneError, match="ghost-fluid"):
        load_scene("dam-break-2d", ["whitewater.seed=1", 'pressure.surface="voxel"'])


def test_a_full_box_has_none() -> None:
    full = create(
        scene(size=[1.0, 0.5], resolution=16, liquid=[box([0.0, 0.0], [1.0, 0.5])], whitewater={})
    )
    assert full.whitewater is None
    assert not set(COLUMNS) & set(full.columns())


def test_default_speeds_scale_with_the_scene() -> None:
    small, large = (
        WhitewaterSettings().resolved(
            longest=longest, spacing=0.01, gravity=[0.0, -9.81], dimension=2
        )
        for longest in (1.6, 160.0)
    )
    assert small.length == pytest.approx(0.1)
    assert large.speed == pytest.approx([10.0 * speed for speed in small.speed or ()])
    unbounded = WhitewaterSettings().resolved(
        longest=None, spacing=0.01, gravity=[0.0, 0.0, 0.0], dimension=3
    )
    assert unbounded.length == pytest.approx(0.04)


@forward_kernel(module="test_whitewater")
def emission_kernel(
    F: kernels.LiquidFields,
    E: kernels.EmissionSettings,
    points: wp.array(dtype=wp.vec3),
    trapped: wp.array(dtype=wp.float32),
    crest: wp.array(dtype=wp.float32),
    normals: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    a, b, n, _v = kernels.emission(F, E, points[i])
    trapped[i] = a
    crest[i] = b
    normals[i] = n


def emission_at(
    dimension: int, phi: Any, velocity: Any, points: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return trapped, crest and normal at grid points.

    Ramps from 0 to 1: trapped is the approach, crest the curvature times the reach, weighed.
    """
    counts = (40, 40, 40 if dimension == 3 else 1)
    grid = StaggeredGrid(counts, 1.0, dimension, "cpu")
    K, J, I = (a.astype(np.float64) for a in np.indices(grid.shape))
    X, Y, Z = I + 0.5, J + 0.5, K + 0.5 if dimension == 3 else 0.0 * K
    values = np.zeros((*grid.shape, 4), dtype=np.float32)
    for axis, component in enumerate(velocity(X, Y, Z)):
        values[..., axis] = component
    values[..., 3] = kernels.AIR - np.clip(phi(X, Y, Z), -kernels.AIR, kernels.AIR)
    fields = kernels.LiquidFields()
    fields.planes, fields.dx = grid.planes, 1.0
    fields.centers = wp.array(values, dtype=wp.vec4, device="cpu")
    fields.base = grid.field(wp.int8)
    numbers = kernels.EmissionSettings()
    numbers.directions = wp.array(directions(dimension), dtype=wp.vec3, device="cpu")
    numbers.count, numbers.reach = len(numbers.directions), reach
    numbers.trapped = numbers.crest = 1.0
    numbers.trapped_air_range = numbers.crest_range = wp.vec2(0.0, 1.0)
    numbers.energy_range = wp.vec2(0.0, 1e-6)
    at = wp.array(points, dtype=wp.vec3, device="cpu")
    out = [wp.zeros(len(points), dtype=wp.float32, device="cpu") for _ in range(2)]
    normal = wp.zeros(len(points), dtype=wp.vec3, device="cpu")
    wp.launch(emission_kernel, len(points), [fields, numbers, at, *out, normal], device="cpu")
    return out[0].numpy(), out[1].numpy(), normal.numpy()


@pytest.mark.parametrize("dimension", [2, 3])
def test_curvature_and_normal_of_a_ball(dimension: int) -> None:
    """R kappa of a ball of radius r is R / r, and a crest counts 2 f of its area."""
    radius, reach, middle = 12.0, 5.0, 20.5
    rng = np.random.default_rng(3)
    ways = rng.normal(size=(400, 3))
    if dimension == 2:
        ways[:, 2] = 0.0
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    center = np.array([middle, middle, middle if dimension == 3 else 0.0])
    points = center + radius * ways
    points[:, 2] = points[:, 2] if dimension == 3 else 1.5

    def phi(x: Any, y: Any, z: Any) -> Any:
        depth = (z - middle) ** 2 if dimension == 3 else 0.0
        return np.sqrt((x - middle) ** 2 + (y - middle) ** 2 + depth) - radius

    def outward(x: Any, y: Any, z: Any) -> Any:
        return [x - middle, y - middle, z - middle if dimension == 3 else 0.0 * z]

    _, crest, normal = emission_at(dimension, phi, outward, points, reach)
    wanted = reach / radius
    filled = np.arccos(0.5 * wanted) / np.pi if dimension == 2 else 0.5 * (1.0 - 0.5 * wanted)
    # The mean of the product is smaller than that of the means, by the variance of f.
    assert crest.mean() == pytest.approx(2.0 * filled * wanted, rel=0.12)
    assert np.einsum("ij,ij->i", normal, ways).min() > 0.93
    _, inward, _ = emission_at(
        dimension, phi, lambda *at: [-c for c in outward(*at)], points, reach
    )
    assert not inward.any()  # velocity leaves into the liquid


@pytest.mark.parametrize("dimension", [2, 3])
def test_approach_of_liquid(dimension: int) -> None:
    """Twice the mean of the approach over the directions; 0 for rotation and separation."""
    at = np.array([[20.5, 20.5, 20.5 if dimension == 3 else 1.5]])
    rate, reach = 0.05, 4.0

    def full(x: Any, y: Any, z: Any) -> Any:
        return 0.0 * x - 3.0

    def squeezed(x: Any, y: Any, z: Any) -> Any:  # toward the plane x = 20.5, out along y
        return [-rate * (x - 20.5) + 1.0, rate * (y - 20.5), 0.0 * z]

    def turning(x: Any, y: Any, z: Any) -> Any:
        return [-rate * (y - 20.5) + 1.0, rate * (x - 20.5), 0.0 * z]

    def spreading(x: Any, y: Any, z: Any) -> Any:
        return [rate * (x - 20.5) + 1.0, rate * (y - 20.5), 0.0 * z]

    r = directions(dimension).astype(np.float64)
    expected = 2.0 * np.maximum(rate * reach * (r[:, 0] ** 2 - r[:, 1] ** 2), 0.0).mean()
    assert emission_at(dimension, full, squeezed, at, reach)[0][0] == pytest.approx(
        expected, rel=1e-4
    )
    for flow in (turning, spreading):
        assert emission_at(dimension, full, flow, at, reach)[0][0] == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_approach_of_two_streams_does_not_depend_on_the_width_of_their_front(
    dimension: int,
) -> None:
    """Its integral across the front is 4 U R mean(r_x^2), however far cells spread the front."""
    speed, reach, step = 0.5, 4.0, 0.25
    x = np.arange(8.0, 33.0, step)
    points = np.column_stack([x, 0.0 * x + 20.5, 0.0 * x + (20.5 if dimension == 3 else 1.5)])
    r = directions(dimension).astype(np.float64)
    expected = 4.0 * speed * reach * (r[:, 0] ** 2).mean()

    def full(x: Any, y: Any, z: Any) -> Any:
        return 0.0 * x - 3.0

    for width in (2.0, 4.0, 8.0):

        def meeting(x: Any, y: Any, z: Any, width: float = width) -> Any:
            return [-speed * np.clip((x - 20.5) / (0.5 * width), -1.0, 1.0), 0.0 * y + 1.0, 0.0 * z]

        trapped = emission_at(dimension, full, meeting, points, reach)[0]
        assert step * trapped.sum() == pytest.approx(expected, rel=0.01)


def test_directions_are_a_design() -> None:
    """Means of polynomials over the directions: those over the circle and the sphere."""
    for dimension in (2, 3):
        r = directions(dimension).astype(np.float64)
        np.testing.assert_allclose(np.linalg.norm(r, axis=1), 1.0, atol=1e-6)
        np.testing.assert_allclose(r.mean(axis=0), 0.0, atol=1e-6)
        np.testing.assert_allclose(
            (r.T @ r / len(r))[:dimension, :dimension], np.eye(dimension) / dimension, atol=1e-6
        )
        fourth = 3.0 / 8.0 if dimension == 2 else 1.0 / 5.0
        np.testing.assert_allclose((r[:, 0] ** 4).mean(), fourth, atol=1e-6)


def test_the_expected_number_is_that_of_rate_volume_and_time() -> None:
    """The mean emission of a step: the same for half the step, twice."""

    simulation = stepped(splash(), 18)
    whitewater, everywhere = simulation.whitewater, simulation.grid.everywhere
    fields = whitewater._fields(simulation, everywhere)

    def born(dt: float, parts: int, draws: int = 1000) -> float:
        total = 0
        for step in range(draws * parts):
            whitewater.particles.resize(0)
            whitewater._emit(fields, everywhere, 10_000 * parts + step, dt / parts)
            total += whitewater.particles.count
        return total / draws

    one, halves = born(0.02, 1), born(0.02, 2)
    assert one > 20
    assert halves == pytest.approx(one, rel=0.08)  # four standard deviations


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a short run with whitewater."""
    folder = tmp_path_factory.mktemp("whitewater") / "run"
    keys = ["domain.resolution=32", "time.duration=0.6", "whitewater.trapped_air_rate=1e6"]
    run_into(load_scene("dam-break-2d", keys), folder, observer=StepCounter())
    return folder


def test_recorded_frames_have_whitewater(run_folder: Path) -> None:
    recording = Recording(run_folder)
    last = recording.whitewater(recording.numbers[-1])
    assert last is not None
    assert len(last.points) > 10
    assert set(np.unique(last.fields["kind"])) <= {SPRAY, FOAM, BUBBLE}
    files = [file.name for file in recording.files(recording.numbers[-1])]
    assert f"whitewater_{recording.numbers[-1]:06d}.vtu" in files
    assert Recording(run_folder).frame(0).whitewater is not None


def test_sections_draw_whitewater(run_folder: Path) -> None:
    pytest.importorskip("matplotlib")
    recording = Recording(run_folder, cells=True)
    section = Section(recording, (320, 160))
    frame = recording.frame(recording.numbers[-1])
    bare = section.draw(replace(frame, whitewater=None))
    assert (section.draw(frame) != bare).any()


def test_usd_has_kinds(run_folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    file = tmp_path / "run.usda"
    numbers = list(export_run(run_folder, file))
    stage = Usd.Stage.Open(str(file))
    prim = next(p for p in stage.Traverse() if p.GetName() == "whitewater")
    points, code = UsdGeom.Points(prim), float(numbers[-1])
    kinds = UsdGeom.PrimvarsAPI(prim).GetPrimvar("kind")
    ages = UsdGeom.PrimvarsAPI(prim).GetPrimvar("age")
    recorded = Recording(run_folder).whitewater(numbers[-1])
    assert recorded is not None
    np.testing.assert_array_equal(np.array(kinds.Get(code)), recorded.fields["kind"])
    np.testing.assert_allclose(np.array(ages.Get(code)), recorded.fields["age"])
    np.testing.assert_allclose(np.array(points.GetPointsAttr().Get(code)), recorded.points)
    assert len(points.GetVelocitiesAttr().Get(code)) == len(recorded.points)
