"""Forces on solids: hydrostatics, Archimedes, momentum, and their table."""

import csv
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp
from pydantic import ValidationError

import small_sands
from default_run import covering, few
from small_liquids import GRAVITY, advance, box, create, random_tank, scene
from small_runs import run_into
from warp_lcp.fluids import LiquidSimulation
from warp_lcp.fluids.forces_kernels import pressure_kernel
from warp_lcp.fluids.wall_kernels import WallKernelFields, wall_way
from warp_lcp.scene.scene_file import load_scene

WATER = 1000.0 * GRAVITY
FORCES = {"forces": True}


def tank(dimension: int, **tables: Any) -> LiquidSimulation:
    """Return a tank of 20 x 20 (x 20) cells, filled to 14."""
    size, top = [0.8] * dimension, [0.8, 0.56, 0.8][:dimension]
    return create(
        scene(
            size=size, resolution=20, liquid=[box([0.0] * dimension, top)], output=FORCES, **tables
        )
    )


@wp.kernel(enable_backward=False, module="tests.wall_way")
def way_kernel(S: WallKernelFields, way: wp.array3d(dtype=wp.vec3)):  # type: ignore[valid-type]
    k, j, i = wp.tid()
    way[k, j, i] = wall_way(S, k, j, i)


@pytest.mark.parametrize("normal", [(0.6, 0.8, 0.0), (-0.28, 0.96, 0.0), (0.48, -0.6, 0.64)])
def test_the_way_to_a_plane_wall_is_its_distance_along_its_normal(
    normal: tuple[float, float, float],
) -> None:
    """Vector from cell centers to the wall n . x = 2: exact, in the plane and in space."""
    planes, n = (2 if normal[2] else 1), np.array(normal)
    corners = np.stack(np.meshgrid(*[np.arange(6.0)] * 3, indexing="ij")[::-1], axis=-1)
    S = WallKernelFields()
    S.planes = planes
    S.distance = wp.array(corners @ n - 2.0, dtype=wp.float32, device="cpu")
    way = wp.zeros((5, 5, 5), dtype=wp.vec3, device="cpu")
    wp.launch(way_kernel, way.shape, [S, way], device="cpu")
    centers = corners[:5, :5, :5] + [0.5, 0.5, 0.5 * (planes - 1)]
    expected = -(centers @ n - 2.0)[..., None] * n
    np.testing.assert_allclose(way.numpy(), expected, atol=1e-5)


def forces(simulation: LiquidSimulation, until: float) -> dict[str, np.ndarray]:
    """Step to a time; return the last force and torque on the domain and each solid.

    The shape is (3,) in 2-D and (6,) in 3-D.
    """
    if until:
        advance(simulation, until)
    row = simulation.measured["forces"]
    assert tuple(row) == simulation.tables()["forces"]
    names = ["domain", *(f"solid{n}" for n in range(len(simulation.scene.solid)))]
    values = np.array(list(row.values())[2:], dtype=float).reshape(len(names), -1)
    return dict(zip(names, values, strict=True))


def ball(dimension: int, **more: Any) -> dict[str, Any]:
    return {"shape": "sphere", "center": [0.41, 0.27, 0.37][:dimension], "radius": 0.15, **more}


@pytest.mark.parametrize(
    ("dimension", "solids", "surface"),
    covering([2, 3], ["cut-cell", "voxel"], ["ghost-fluid", "voxel"], count=4),
)
def test_archimedes_and_the_weight_on_the_floor(dimension: int, solids: str, surface: str) -> None:
    """Archimedes' principle, and the weight on the floor.

    The ball is pushed up by its displaced volume, as cells are closed; the walls bear that and the
    weight of the liquid.
    """
    simulation = tank(
        dimension, solids=solids, pressure={"surface": surface}, solid=[ball(dimension)]
    )
    found = forces(simulation, 0.3)
    volume = np.pi * 0.15**2 if dimension == 2 else 4.0 / 3.0 * np.pi * 0.15**3
    if solids == "voxel":
        volume = simulation.boundary.solids.covered[0] * simulation.grid.cell_volume
    up = found["solid0"][1] / (WATER * volume)
    # Error for a ball of 3.75 cells, between the grid's nodes.
    lost = {"voxel": 1e-3, "cut-cell": 0.015 if dimension == 2 else 0.042}[solids]
    assert up == pytest.approx(1.0, abs=lost)
    assert np.abs(np.delete(found["solid0"], 1)).max() < 0.02 * WATER * volume, (
        "no other force, no torque about its center"
    )
    filled = 0.8 * 0.56 * (0.8 if dimension == 3 else 1.0)
    if surface == "voxel":
        # Whole cells put the surface half a cell too high.
        filled += 0.5 * simulation.grid.spacing * 0.8 ** (dimension - 1)
    assert found["domain"][1] / (WATER * filled) == pytest.approx(-1.0, abs=1e-3)
    assert abs(found["domain"][0]) < 0.01 * WATER * filled


@pytest.mark.parametrize(("dimension", "solids"), covering([2, 3], ["voxel", "cut-cell"]))
def test_floor_and_walls_bear_the_depth(dimension: int, solids: str) -> None:
    """Hydrostatic forces on floor and walls.

    A floor and a wall as solids, off the cells' faces with cut cells; their torque is about the
    centers of their boxes.
    """
    floor, wall = (0.11, 0.57) if solids == "cut-cell" else (0.12, 0.56)
    low, high = [-0.2] * dimension, [1.0] * dimension
    parts = [box(low, [1.0, floor, 1.0][:dimension]), box([wall, floor, -0.2][:dimension], high)]
    found = forces(tank(dimension, solids=solids, solid=parts), 0.3)
    depth, width = 0.56 - floor, 0.8 if dimension == 3 else 1.0
    weight, push = WATER * depth * wall * width, 0.5 * WATER * depth**2 * width
    both = found["solid0"] + found["solid1"]  # where they touch, either may own the buried part
    assert both[:2] == pytest.approx([push, -weight], rel=0.01)
    assert found["domain"][0] == pytest.approx(-push, rel=0.01), "the left wall"
    assert found["domain"][1] == pytest.approx(0.0, abs=1e-3 * weight), (
        "all of the floor is the solid's"
    )
    alone = forces(tank(dimension, solids=solids, solid=parts[:1]), 0.3)["solid0"]
    assert alone[:2] == pytest.approx(
        [0.0, -WATER * depth * 0.8 * width], rel=2e-3, abs=1e-3 * push
    )
    aside = forces(
        tank(dimension, solids=solids, solid=[box([wall, -0.2, -0.2][:dimension], high)]), 0.3
    )["solid0"]
    # Torque of the center of pressure, above that of the box.
    push, lever = 0.5 * WATER * 0.56**2 * width, 0.56 / 3.0 - 0.4
    assert aside[:2] == pytest.approx([push, 0.0], rel=0.01, abs=1e-3 * push)
    assert aside[-1] == pytest.approx(-push * lever, rel=0.02)


def crowded(dimension: int, solids: str, moves: str) -> LiquidSimulation:
    """Return liquid in motion around solids that share cells.

    One stands, one moves or is a body.
    """
    more: dict[str, Any] = {"stands": {}, "body": {"density": 700.0}}.get(moves, {})
    if moves == "moves":
        more = {"motion": {"kind": "translation", "velocity": [0.3, -0.2, 0.1][:dimension]}}
    standing = box([0.57, 0.0, 0.0][:dimension], [0.8, 0.31, 0.8][:dimension])
    liquid = [
        box([0.0] * dimension, [0.4, 0.7, 0.8][:dimension]),
        box([0.4, 0.0, 0.0][:dimension], [0.8, 0.5, 0.8][:dimension]),
    ]
    tables: dict[str, Any] = {
        "solids": solids,
        "solid": [standing, ball(dimension, **more)],
        "pressure": {"surface": "voxel"},
    }
    return create(
        scene(size=[0.8] * dimension, resolution=20, liquid=liquid, output=FORCES, **tables)
    )


CROWDED = [("voxel", "stands"), ("cut-cell", "stands"), ("cut-cell", "moves"), ("cut-cell", "body")]


@pytest.mark.parametrize(("solids", "moves"), CROWDED)
@pytest.mark.parametrize("dimension", [2, 3])
def test_pressure_momentum_of_the_liquid_goes_to_solids(
    dimension: int, solids: str, moves: str, monkeypatch: Any
) -> None:
    """Momentum that the pressure takes from the liquid and gives to solids.

    On the grid to rounding: the faces' momentum, open fractions times change of velocity, against
    all solids' impulses. With whole cells it includes the stop of the liquid in the half cells
    beside closed faces, otherwise the pressure alone.
    """
    simulation = crowded(dimension, solids, moves)
    projection, mass, checked = simulation.projection, 1000.0 * simulation.grid.cell_volume, []
    project = projection.project

    def watched(velocity: Any, window: Any, *rest: Any) -> Any:
        before = [field.numpy().astype(np.float64) for field in velocity]
        done = project(velocity, window, *rest)
        x, boundary = projection.pressure, simulation.boundary
        gained = np.zeros(3)
        for axis, (field, u, known) in enumerate(
            zip(velocity, before, projection.known, strict=True)
        ):
            open_ = boundary.open[axis].numpy() if boundary.open else 1.0
            gained[axis] = (
                mass * (np.where(known.numpy() == 1, field.numpy() - u, 0.0) * open_).sum()
            )
            if solids == "voxel":  # on closed faces of cells with pressure
                index, filled = boundary.solids.index.numpy() >= 0, x.numpy() != 0.0
                beside = (index & np.roll(filled, 1, 2 - axis)) | (
                    np.roll(index, 1, 2 - axis) & filled
                )
                gained[axis] -= 0.5 * mass * u[beside].sum()
        fields = velocity if solids == "voxel" else [wp.zeros_like(field) for field in velocity]
        bodies = wp.zeros(3, dtype=wp.uint8, device="cpu")
        given = [bodies, boundary.touch, x, *[*fields, fields[0]][:3], 0.0, 0.0, 0.0, mass]
        pushed = simulation.wall_sums.launch_sums(pressure_kernel, window, np.zeros((3, 3)), given)
        assert np.abs(gained + pushed.sum(axis=0)[:3]).max() < 1e-5 * np.abs(pushed).max()
        checked.append(np.abs(pushed[:, 1]).min())
        return done

    monkeypatch.setattr(projection, "project", watched)
    for _ in range(3):
        simulation.step(0.004)
    assert min(checked) > 0.0, "all three bear"


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_force_log_has_the_impulse_of_the_body(dimension: int) -> None:
    """Force on a body by the table and by the coupling.

    Both add up the same faces, each in its own way.
    """
    simulation = crowded(dimension, "cut-cell", "body")
    body, pushes = simulation.bodies.bodies[0], []
    push = simulation.projection.push_bodies

    def watched(result: Any) -> None:
        push(result)
        pushes.append(
            body.received_impulse[:3].copy()
            if dimension == 3
            else body.received_impulse[[0, 1, 5]].copy()
        )

    simulation.projection.push_bodies = watched  # type: ignore[method-assign]
    for _ in range(4):
        simulation.step(0.004)
        told = (
            forces(simulation, 0.0)["solid1"][: 3 if dimension == 3 else None] * simulation.kick_dt
        )
        assert told == pytest.approx(pushes[-1], rel=1e-6, abs=1e-9)
    assert np.abs(pushes).max() > 0.0


@pytest.mark.default_cases(1)
@pytest.mark.parametrize(("dimension", "viscosity"), covering([2, 3], [0.05, 20.0]))
def test_in_thick_liquid_forces_and_weight_are_what_moves_a_body(
    dimension: int, viscosity: float
) -> None:
    """Forces and weight of a body in viscous liquid.

    In each step pressure, viscous stresses and weight sum to the change of momentum, whatever the
    residuals.
    """
    rod = ball(
        dimension,
        density=7800.0,
        velocity=[0.4, -1.0, 0.2][:dimension],
        angular_velocity=300.0 if dimension == 2 else [0.0, 90.0, 200.0],
    )
    simulation = tank(dimension, viscosity={"value": viscosity}, solid=[rod])
    assert simulation.bodies is not None
    body = simulation.bodies.bodies[0]
    weight = body.properties.mass * GRAVITY
    for dt in (0.004, 0.01, 0.002, 0.007):
        before = np.concatenate([body.momentum, body.angular_momentum])
        simulation.step(dt)
        gained = (
            np.concatenate([body.momentum, body.angular_momentum]) - before
        ) / simulation.kick_dt
        gained[1] += weight
        told = forces(simulation, 0.0)["solid0"]
        np.testing.assert_allclose(
            told, gained if dimension == 3 else gained[[0, 1, 5]], rtol=1e-4, atol=1e-5 * weight
        )
    assert np.abs(told[:2]).max() > 0.02 * weight


def test_a_rod_that_sinks_through_honey_evenly_is_borne_by_it() -> None:
    """Rod that sinks steadily through honey.

    The mean force is the weight; at first there is none.
    """
    rod = {"shape": "sphere", "center": [0.02, 0.055], "radius": 0.005, "density": 7800.0}
    tables = {
        "size": [0.04, 0.08],
        "resolution": 32,
        "output": FORCES,
        "viscosity": {"value": 10.0},
        "solid": [rod],
    }
    simulation = create(scene(liquid=[box([0.0, 0.0], [0.04, 0.075])], **tables))
    assert simulation.bodies is not None
    weight, told = simulation.bodies.bodies[0].properties.mass * GRAVITY, []
    for _ in range(30):
        simulation.step(min(simulation.stable_dt(), 0.01))
        told.append(forces(simulation, 0.0)["solid0"][1])
    assert np.mean(told[10:]) == pytest.approx(weight, rel=0.02)


@pytest.mark.parametrize("solids", ["voxel", "cut-cell"])
def test_an_impact_takes_the_momentum(solids: str) -> None:
    """Momentum of an impact.

    A block falls into a tilted tub. The walls get the momentum that particles lose, without
    gravity's, to a few percent.
    """
    tables: dict[str, Any] = {
        "solids": solids,
        "solid": [{"shape": "plane", "point": [0.3, 0.1], "normal": [0.3, 1.0]}],
    }
    block = [box([0.2, 0.4], [0.52, 0.72], velocity=[0.6, -1.0])]
    simulation = create(
        scene(size=[0.8, 0.8], resolution=40, liquid=block, output=FORCES, **tables)
    )

    def momentum() -> np.ndarray:
        return simulation.particle_mass * simulation.particles.velocity.numpy()[:, :2].sum(
            axis=0, dtype=np.float64
        )

    mass = simulation.particle_mass * simulation.particles.count
    start, impulse, elapsed = momentum(), np.zeros(2), 0.0
    while simulation.time < 0.4:
        simulation.step(min(simulation.stable_dt(), 0.01))
        impulse += sum(force[:2] for force in forces(simulation, 0.0).values()) * simulation.kick_dt
        elapsed += simulation.kick_dt
    change = momentum() - start - mass * elapsed * np.array([0.0, -GRAVITY])
    assert np.abs(impulse).max() > mass * 1.0
    assert np.abs(change + impulse).max() < 0.05 * np.abs(impulse).max()


@pytest.mark.parametrize("seed", few([11, 12, 13, 14], 2))
def test_all_solids_together_bear_the_liquid(seed: int) -> None:
    """Sum of the forces on all solids.

    In a pool at rest with any solids, the forces on them and on the walls sum to the weight of the
    particles.
    """
    simulation = create(scene(**random_tank(seed), output=FORCES))
    found = forces(simulation, 0.6)
    weight = simulation.particle_mass * simulation.particles.count * GRAVITY
    total = sum(force[: simulation.grid.dimension] for force in found.values())
    assert total[1] / weight == pytest.approx(-1.0, abs=0.03)
    assert np.abs(np.delete(total, 1)).max() < 0.01 * weight


def test_forces_change_nothing() -> None:
    states = []
    for output in ({}, FORCES):
        simulation = create(
            scene(
                size=[0.8, 0.8],
                resolution=20,
                liquid=[box([0, 0], [0.4, 0.5])],
                solid=[ball(2)],
                output=output,
            )
        )
        assert bool(simulation.tables()) == bool(output)
        advance(simulation, 0.2)
        states.append(simulation.state())
    assert all(np.array_equal(states[0][name], states[1][name]) for name in states[0])


def test_reference_points_move_along() -> None:
    """Moving reference points of torques.

    For a rotating paddle the point is the center of its box, which moves around; for a plane it is
    the origin.
    """
    motion = {"kind": "rotation", "center": [0.4, 0.4], "rate": 90.0}
    solids = [
        box([0.5, 0.38], [0.7, 0.42], motion=motion),
        {"shape": "plane", "point": [0.0, 0.05], "normal": [0.0, 1.0]},
    ]
    simulation = create(
        scene(
            size=[0.8, 0.8],
            resolution=20,
            liquid=[box([0, 0], [0.8, 0.3])],
            solid=solids,
            output=FORCES,
        )
    )
    advance(simulation, 1.0)
    turned = np.radians(90.0 * (simulation.time - simulation.last_dt))
    assert simulation.forces.references[1] == pytest.approx(
        [0.4 + 0.2 * np.cos(turned), 0.4 + 0.2 * np.sin(turned), 0.0], abs=1e-9
    )
    assert (simulation.forces.references[[0, 2]] == 0.0).all()
    assert set(simulation.tables()) == {"forces"}
    assert simulation.tables()["forces"][-1] == "solid1_torque"


def test_an_interrupted_run_writes_the_same_table(tmp_path: Path) -> None:
    overrides = [
        "domain.resolution=24",
        "time.duration=0.3",
        "output.checkpoint_every=5",
        "output.forces=true",
    ]
    model, asked = load_scene("dam-break-2d", overrides), itertools.count(1)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert run_into(model, whole).status == "finished"
    assert run_into(model, parts, stop=lambda: next(asked) >= 7).status == "stopped"
    assert run_into(model, parts, resume=True).status == "finished"
    assert (parts / "forces.csv").read_bytes() == (whole / "forces.csv").read_bytes()
    with open(whole / "forces.csv", newline="") as table:
        rows = list(csv.DictReader(table))
    assert list(rows[0]) == ["step", "time", "domain_fx", "domain_fy", "domain_torque"]
    assert all(float(row["domain_fy"]) < 0.0 for row in rows), "the floor bears"


def test_sand_has_no_forces_on_solids() -> None:
    sand = {"size": [1.0, 0.5], "resolution": 16, "sand": [small_sands.box([0.0, 0.0], [0.3, 0.3])]}
    with pytest.raises(ValidationError, match="is for liquids only"):
        small_sands.scene(**sand, output=FORCES)
