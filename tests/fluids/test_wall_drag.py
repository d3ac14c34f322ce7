"""Drag along walls: law of a sheet, slanted walls, momentum, moving walls.

And cases without drag.
"""

import math
from typing import Any, no_type_check

import numpy as np
import pytest
import warp as wp
from pydantic import ValidationError
from scipy.integrate import solve_ivp

import small_sands
from default_run import covering, few
from small_liquids import GRAVITY, advance, box, create, random_tank, scene
from warp_lcp.fluids import LiquidSimulation
from warp_lcp.fluids.wall_drag_kernels import WallDragFields, fill
from warp_lcp.operators.grid_poisson import AIR, FLUID

DX = 0.05
FORCES = {"forces": True}
VOXEL: dict[str, Any] = {"solids": "voxel", "pressure": {"surface": "voxel"}}


def sheet(
    depth: float,
    c: float,
    dimension: int = 2,
    *,
    speed: float = 1.0,
    floor: float = 0.0,
    **tables: Any,
) -> LiquidSimulation:
    """Return a sheet over a floor that slides to the right.

    It is so many cells deep. The floor may be a solid off the cells' faces.
    """
    size, low, high = (
        [4.0, 0.8, 0.4][:dimension],
        [0.2, floor * DX, 0.0][:dimension],
        [2.2, (floor + depth) * DX, 0.4][:dimension],
    )
    solid = [box([-1.0] * dimension, [9.0, floor * DX, 9.0][:dimension])] if floor else []
    liquid = [box(low, high, velocity=[speed, 0.0, 0.0][:dimension])]
    drag = {"wall_drag": {"coefficient": c, "domain": 0.0 if floor else c}} if c else {}
    return create(
        scene(
            size=size, resolution=80, liquid=liquid, solid=solid, output=FORCES, **(drag | tables)
        )
    )


def middle(simulation: LiquidSimulation, speed: float = 1.0) -> float:
    """Return the mean velocity along x [m/s] of the sheet without its ends.

    Waves from the ends have not reached that part.
    """
    x, v = (
        a.numpy()[:, 0].astype(np.float64)
        for a in (simulation.particles.position, simulation.particles.velocity)
    )
    way = 0.9 * speed * simulation.time
    return float(v[(x > 1.0 + way) & (x < 1.4 + way)].mean())


def lost(simulation: LiquidSimulation, depth: float, c: float) -> float:
    """Return the speed loss of a sheet over that of u0 / (1 + c/2 u0 t / h).

    Velocities are those of the middle of steps.
    """
    time = simulation.time - 0.5 * simulation.last_dt
    return (1.0 - middle(simulation)) / (1.0 - 1.0 / (1.0 + 0.5 * c * time / (depth * DX)))


@pytest.mark.parametrize(
    ("sheet_of", "surface"),
    covering(
        [(2, 0.1, 0.0), (2, 0.01, 0.0), (2, 0.01, 1.0), (3, 0.1, 1.0)], [({}, 0.05), (VOXEL, 1e-3)]
    ),
)
def test_a_sheet_slows_down_by_its_law(
    sheet_of: tuple[int, float, float], surface: tuple[dict[str, Any], float]
) -> None:
    """Deceleration of a sheet a cell deep.

    To the accuracy of the thickness that the surface shows.
    """
    (dimension, c, floor), (tables, bound) = sheet_of, surface
    simulation = sheet(1.0, c, dimension, floor=floor, **tables)
    advance(simulation, 0.3)
    assert lost(simulation, 1.0, c) == pytest.approx(1.0, abs=bound)
    assert middle(sheet(1.0, 0.0, dimension, **tables)) == 1.0


@wp.kernel(enable_backward=False, module="tests.wall_drag")
@no_type_check
def fill_kernel(D: WallDragFields, out: wp.array3d(dtype=float)):
    k, j, i = wp.tid()
    out[k, j, i] = fill(D, k, j, i)


@pytest.mark.parametrize("surface", [True, False])
def test_cells_of_liquid_are_half_full_at_least_and_those_of_air_at_most(surface: bool) -> None:
    """Fill of cells: liquid cells at least half full, air cells at most.

    Cells without neighbors in liquid, and slivers, are FLUID though their centers lie outside the
    surface.
    """
    phi = [-2.0, -0.3, 0.2, 0.5, 2.0]
    D = WallDragFields()
    D.kind = wp.array([[[FLUID] * 5 + [AIR] * 5]], dtype=wp.int8, device="cpu")
    if surface:
        D.phi = wp.array([[phi + phi]], dtype=wp.float32, device="cpu")
    out = wp.zeros((1, 1, 10), dtype=float, device="cpu")
    wp.launch(fill_kernel, out.shape, [D, out], device="cpu")
    expected = (
        [1.0, 0.8, 0.5, 0.5, 0.5, 0.5, 0.5, 0.3, 0.0, 0.0] if surface else [1.0] * 5 + [0.0] * 5
    )
    np.testing.assert_allclose(out.numpy().ravel(), expected, atol=1e-6)


@pytest.mark.parametrize(
    "tables",
    [{}, {"pressure": {"model": "unilateral"}}, {"particles": {"narrow_band": {}}}, {"cfl": 0.4}],
)
def test_other_models_of_the_liquid_are_dragged(tables: dict[str, Any]) -> None:
    """Drag in other models of the liquid.

    Eight cells deep, once the pressure exists: c/2 rho u^2 on two meters of floor.
    """
    simulation = sheet(8.0, 0.01, **tables)
    advance(simulation, 0.06)
    assert simulation.measured["forces"]["domain_fx"] == pytest.approx(
        0.005 * 1000.0 * 2.0, rel=0.2
    )


@pytest.mark.parametrize("cfl", [0.5, 4.0])
def test_the_length_of_steps_does_not_matter(cfl: float) -> None:
    simulation = sheet(1.0, 0.1, cfl=cfl)
    advance(simulation, 0.3)
    assert lost(simulation, 1.0, 0.1) == pytest.approx(1.0, abs=0.03)


def test_of_a_deep_flow_the_cells_beside_the_wall_slow_down() -> None:
    """Deep flow whose cells beside the wall slow down.

    The law holds at first. Later the stress is that of the slower cells, and the rest continues.
    """
    simulation = sheet(4.0, 0.1, physics={"gravity": [0.0, -1.0]})
    assert simulation.step(0.01)["drag_work"] == pytest.approx(
        0.05 * 1000.0 * 2.0 * simulation.kick_dt, rel=0.05
    )
    advance(simulation, 0.3)
    x, v = simulation.particles.position.numpy(), simulation.particles.velocity.numpy()[:, 0]
    lowest = v[(x[:, 1] < 0.5 * DX) & (x[:, 0] > 1.2) & (x[:, 0] < 1.8)].mean()
    assert lowest == pytest.approx(1.0 / (1.0 + 0.05 * 0.3 / DX), rel=0.05), (
        "as if these cells were alone"
    )
    assert 0.8 < lost(simulation, 4.0, 0.1) < 1.0


@pytest.mark.parametrize(("depth", "c"), [(4.0, 0.2), (8.0, 0.4)])
def test_a_channel_keeps_what_the_cells_beside_its_wall_do_not_lose(depth: float, c: float) -> None:
    """Momentum of a channel with drag beside its wall.

    One of N cells slows down: with S = c/2 u0 t / h the mean is 1 - S / (1 + N S) of u0; by the law
    of the mean it would be 1 / (1 + S).
    """
    simulation = sheet(depth, c, physics={"gravity": [0.0, -1.0]})
    advance(simulation, 0.5)
    share = 0.5 * c * (simulation.time - 0.5 * simulation.last_dt) / (depth * DX)
    found = middle(simulation)
    assert found == pytest.approx(1.0 - share / (1.0 + depth * share), rel=0.02)
    assert found > 1.05 / (1.0 + share), "the limit that the documentation states"


def test_a_viscous_channel_is_dragged_as_its_equation_says() -> None:
    """Viscous channel with drag.

    du/dt = nu u_yy, nu u_y = c/2 u^2 at the floor and 0 at the surface: viscosity mixes the slow
    layer at the wall with the flow above.
    """
    cells, c, nu, fine = 4, 0.2, 0.05, 64
    tables: dict[str, Any] = {
        "viscosity": {"value": 1000.0 * nu},
        "wall": "free-slip",
        "physics": {"gravity": [0.0, -1.0]},
    }
    simulation = sheet(cells, c, **tables)
    advance(simulation, 0.5)
    d = cells * DX / fine

    def change(_time: float, u: np.ndarray) -> np.ndarray:
        # Between the lowest value and the floor: pull (u - u_floor) = c/2 u_floor^2.
        pull = 2.0 * nu / d
        floor = (math.sqrt(pull**2 + 2.0 * c * pull * u[0]) - pull) / c
        return np.diff(np.concatenate(([0.5 * c * floor**2], nu * np.diff(u) / d, [0.0]))) / d

    exact = (
        solve_ivp(
            change,
            (0.0, simulation.time - 0.5 * simulation.last_dt),
            np.ones(fine),
            method="BDF",
            rtol=1e-6,
        )
        .y[:, -1]
        .mean()
    )
    assert exact < 0.9
    assert middle(simulation) == pytest.approx(exact, rel=0.02)


@pytest.mark.default_cases(4)
@pytest.mark.parametrize(
    ("degrees", "dimension"), covering([0.0, 7.0, 20.0, 31.0, 45.0, 68.0], [2, 3])
)
def test_walls_at_any_angle_drag_by_their_area(dimension: int, degrees: float) -> None:
    """Drag of walls at any angle by their area.

    A layer along a plane, gravity across it: the first step's stress is c/2 rho u^2 along the flow,
    on the wet area.
    """
    angle, c, depth, length = math.radians(degrees), 0.05, 0.2, 0.8
    along, up = (
        np.array([math.cos(angle), math.sin(angle), 0.0]),
        np.array([-math.sin(angle), math.cos(angle), 0.0]),
    )
    center = np.array([0.7, 0.7, 0.0])
    low, high = center - [0.5 * length, 0.0, 0.0], center + np.array([0.5 * length, depth, 0.2])
    layer = box(
        low.tolist()[:dimension], high.tolist()[:dimension], about=center.tolist()[:dimension]
    )
    layer["rotate"] = [degrees] if dimension == 2 else [0.0, 0.0, degrees]
    flow, width = (
        [(1.5 * along).tolist(), 0.2] if dimension == 3 else [(1.5 * along).tolist()[:2], 1.0]
    )
    plane = {
        "shape": "plane",
        "point": center.tolist()[:dimension],
        "normal": up.tolist()[:dimension],
        "drag": c,
    }
    tables: dict[str, Any] = {
        "physics": {"gravity": (-GRAVITY * up).tolist()[:dimension]},
        "output": FORCES,
    }
    size = [1.4, 1.4, 0.2][:dimension]
    liquid = [layer | {"velocity": flow}]
    rows = []
    for drag in (c, 0.0):
        simulation = create(
            scene(size=size, resolution=56, liquid=liquid, solid=[plane | {"drag": drag}], **tables)
        )
        simulation.step(1e-3)
        rows.append(simulation.measured["forces"])
    names = ["solid0_fx", "solid0_fy", "solid0_fz"][:dimension]
    force = np.array([rows[0][name] - rows[1][name] for name in names])
    expected = 0.5 * c * 1000.0 * 1.5**2 * length * width
    assert force @ along[:dimension] == pytest.approx(expected, rel=0.04)
    assert abs(force @ up[:dimension]) < 0.01 * expected


def test_drag_momentum_of_the_liquid_goes_to_walls() -> None:
    """Momentum that liquid loses and walls get.

    Momentum of the particles, which only the floor takes, and energy of the faces.
    """
    simulation = sheet(2.0, 0.05)
    mass = simulation.particle_mass

    def momentum() -> float:
        return float(mass * simulation.particles.velocity.numpy()[:, 0].sum(dtype=np.float64))

    start, impulse, work, power = momentum(), 0.0, 0.0, 0.0
    while simulation.time < 0.3:
        row = simulation.step(min(simulation.stable_dt(), 0.01))
        force = simulation.measured["forces"]["domain_fx"]
        impulse += force * simulation.kick_dt
        work += row["drag_work"]
        power += force * simulation.kick_dt * middle(simulation)
        assert row["drag_work"] > 0.0
    assert impulse > 0.03 * start
    assert start - momentum() == pytest.approx(impulse, rel=0.05)
    assert work == pytest.approx(power, rel=0.15), (
        "force times speed, that of the cells beside the floor is less than the mean"
    )


@pytest.mark.parametrize("seed", few([21, 22, 23, 24], 2))
def test_momentum_and_energy_of_any_flow(seed: int) -> None:
    """Momentum and energy of any flow.

    In random flows around random solids faces never gain speed. Their loss is the walls' gain, and
    `drag_work`.
    """
    rng = np.random.default_rng(seed)
    tables = random_tank(seed)
    dimension = len(tables["size"])
    tables["liquid"][0]["velocity"] = rng.uniform(-2.0, 2.0, dimension).tolist()
    drag = {
        "coefficient": float(10.0 ** rng.uniform(-3, 1)),
        "domain": float(10.0 ** rng.uniform(-3, 1)),
    }
    simulation = create(
        scene(**tables, wall_drag=drag, pressure={"surface": "voxel"}, output=FORCES)
    )
    projection, boundary, mass = (
        simulation.projection,
        simulation.boundary,
        1000.0 * simulation.grid.cell_volume,
    )
    act, checked = simulation.wall_drag.act, []

    def watched(sums: Any, window: Any, velocity: Any, *rest: Any) -> Any:
        before = [field.numpy().astype(np.float64) for field in velocity]
        work, impulses = act(sums, window, velocity, *rest)
        fluid, lost_momentum, energy, sizes = (
            (projection.kind.numpy() == 1).astype(float),
            np.zeros(3),
            0.0,
            np.zeros(2),
        )
        for axis, (u, field) in enumerate(zip(before, velocity, strict=True)):
            now = field.numpy().astype(np.float64)
            assert (np.abs(now) <= np.abs(u)).all()
            free = boundary.open[axis].numpy() if boundary.open else 1.0
            m = mass * free * 0.5 * (fluid + np.roll(fluid, 1, 2 - axis))
            lost_momentum[axis], energy = (
                (m * (u - now)).sum(),
                energy + 0.5 * (m * (u**2 - now**2)).sum(),
            )
            sizes += (m * np.abs(u)).sum(), (m * u**2).sum()
        # Faces are float32.
        assert (
            np.abs(impulses[:, :3].sum(axis=0) - lost_momentum).max()
            <= 1e-5 * np.abs(impulses).max() + 1e-7 * sizes[0]
        )
        assert work == pytest.approx(energy, rel=1e-5, abs=1e-7 * sizes[1])
        checked.append(np.abs(impulses).max())
        return work, impulses

    simulation.wall_drag.act = watched
    advance(simulation, 0.05)
    assert max(checked) > 0.0


def test_walls_that_move_pull() -> None:
    """Drag of moving walls.

    A belt drags resting liquid along, never beyond its speed. A belt as fast as the liquid does
    nothing.
    """
    belt = box(
        [-9.0, -1.0], [3.0, 0.025], motion={"kind": "translation", "velocity": [1.0, 0.0]}, drag=0.2
    )
    for speed, expected in ((0.0, None), (1.0, 1.0)):
        liquid = [box([0.2, 0.025], [2.2, 0.125], velocity=[speed, 0.0])]
        simulation = create(
            scene(size=[4.0, 0.8], resolution=80, liquid=liquid, solid=[belt], output=FORCES)
        )
        row = simulation.step(0.01)
        force = simulation.measured["forces"]["solid0_fx"]
        if expected is None:
            assert force == pytest.approx(-0.1 * 1000.0 * 2.0, rel=0.1)
            assert row["drag_work"] < 0.0, "it gives energy"
        else:
            assert abs(force) < 1e-3 * 200.0
        advance(simulation, 0.3)
        assert middle(simulation, speed) == pytest.approx(
            expected or 0.17, abs=0.05 if expected is None else 1e-3
        )


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_strongest_drag_stops_and_does_not_turn(dimension: int) -> None:
    """Strongest drag: it stops the flow and does not reverse it.

    Whatever the coefficient, faces beside the wall keep their sign and lose speed, and the step is
    stable.
    """
    size, high = [1.0, 0.5, 0.5][:dimension], [0.5, 0.4, 0.3][:dimension]
    solids = [{"shape": "sphere", "center": [0.6, 0.2, 0.2][:dimension], "radius": 0.13}]
    for _ in range(2):
        liquid = [box([0.0] * dimension, high, velocity=[1.5, -0.3, 0.7][:dimension])]
        simulation = create(
            scene(
                size=size,
                resolution=20,
                liquid=liquid,
                solid=solids,
                wall_drag={"coefficient": 1e6},
            )
        )
        recorded: list[tuple[np.ndarray, np.ndarray]] = []
        act = simulation.wall_drag.act

        def watched(
            sums: Any,
            window: Any,
            velocity: Any,
            *rest: Any,
            act: Any = act,
            recorded: Any = recorded,
        ) -> Any:
            before = [field.numpy().copy() for field in velocity]
            done = act(sums, window, velocity, *rest)
            recorded.extend(
                (u, field.numpy().copy()) for u, field in zip(before, velocity, strict=True)
            )
            return done

        simulation.wall_drag.act = watched
        rows = advance(simulation, 0.3)
        assert all(row["drag_work"] >= 0.0 for row in rows)
        assert all(
            (np.abs(now) <= np.abs(u)).all() and (now * u >= -1e-6).all() for u, now in recorded
        )
        assert max(np.abs(now).max() for _, now in recorded) < 10.0
        solids = [
            solids[0] | {"radius": 0.07},
            box([0.8, -1.0, -1.0][:dimension], [0.83, 9.0, 9.0][:dimension]),
        ]


def test_drag_does_not_hold_liquid_that_leaves_a_wall() -> None:
    """Liquid that leaves its wall, without drag.

    Thrown off the floor it is RELEASED; held by a free-slip ceiling it would not be.
    """
    liquid = [box([0.3, 0.0], [0.9, 0.2], velocity=[1.0, 3.0])]
    simulation = create(
        scene(
            size=[2.0, 1.0],
            resolution=40,
            liquid=liquid,
            wall_drag={"coefficient": 0.5},
            output=FORCES,
        )
    )
    row = simulation.step(0.01)
    assert row["active"] > 0
    assert row["drag_work"] == simulation.measured["forces"]["domain_fx"] == 0.0
    stuck = create(
        scene(
            size=[2.0, 1.0],
            resolution=40,
            liquid=liquid,
            wall_drag={"coefficient": 0.5},
            wall="free-slip",
        )
    )
    assert stuck.step(0.01)["drag_work"] > 0.0


def test_bodies_are_dragged_along() -> None:
    """Drag on a plate that floats in a stream.

    It gets the momentum that the stream loses.
    """
    plate = box([0.8, 0.17], [1.4, 0.23], density=500.0, wall="free-slip", drag=0.2)
    momenta = []
    for drag in (0.2, 0.0):
        liquid = [box([0.0, 0.0], [2.0, 0.2], velocity=[1.0, 0.0])]
        simulation = create(
            scene(
                size=[2.0, 0.8],
                resolution=40,
                liquid=liquid,
                solid=[plate | {"drag": drag}],
                output=FORCES,
            )
        )
        simulation.step(0.005)
        momenta.append(
            (
                simulation.bodies.bodies[0].momentum[0],
                simulation.measured["forces"]["solid0_fx"] * simulation.kick_dt,
            )
        )
    gained, told = np.subtract(*momenta)
    assert gained == pytest.approx(told, rel=1e-6)
    assert gained == pytest.approx(0.1 * 1000.0 * 0.6 * simulation.kick_dt, rel=0.25), (
        "beneath it, and a little at its ends"
    )


@pytest.mark.parametrize(
    "tables", [{}, {"particles": {"narrow_band": {}}}, {"particles": {"transfer": "flip"}}]
)
def test_no_coefficient_no_change(tables: dict[str, Any]) -> None:
    states = []
    for more in ({}, {"wall_drag": {}}, {"wall_drag": {"coefficient": 0.01, "domain": 0.0}}):
        simulation = sheet(4.0, 0.0, **tables, **more)
        assert ("drag_work" in simulation.columns()) == (simulation.wall_drag is not None) == False  # noqa: E712
        advance(simulation, 0.05)
        states.append(simulation.state())
    assert all(np.array_equal(states[0][name], state[name]) for state in states for name in state)
    dragged = sheet(4.0, 0.1, **tables)
    advance(dragged, 0.05)
    assert not np.array_equal(dragged.state()["velocity"], states[0]["velocity"])


def test_a_restored_run_continues_identically() -> None:
    through, resumed = sheet(1.5, 0.1, floor=1.3), sheet(1.5, 0.1, floor=1.3)
    advance(through, 0.1)
    resumed.restore(through.state())
    for simulation in (through, resumed):
        advance(simulation, 0.2)
    assert through.measured == resumed.measured
    assert all(
        np.array_equal(a, b)
        for a, b in zip(through.state().values(), resumed.state().values(), strict=True)
    )


def test_wrong_coefficients_are_refused() -> None:
    with pytest.raises(ValidationError, match="coefficient"):
        sheet(1.0, -0.1)
    with pytest.raises(ValidationError, match="is for liquids"):
        small_sands.scene(
            size=[1.0, 0.5],
            resolution=16,
            sand=[small_sands.box([0.0, 0.0], [0.3, 0.3])],
            solid=[small_sands.box([0.5, 0.0], [0.6, 0.1], drag=0.1)],
        )
