from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from small_liquids import GRAVITY, advance, box, create, dam, scene
from warp_lcp.fluids import SIMULATOR, LiquidSimulation
from warp_lcp.grid.particles import Particles
from warp_lcp.operators.grid_poisson import FLUID
from warp_lcp.scene.simulator import Simulator, simulators
from warp_lcp.simulation import Cells, HasStages, Points, SimulationFailed, StepFailed

DIMENSIONS = [2, 3]


def snapshot(simulation: LiquidSimulation) -> dict[str, np.ndarray]:
    return simulation.state()


def same(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name]) for name in a)


def test_the_driver_finds_it() -> None:
    assert simulators()["fluids"] is SIMULATOR
    assert isinstance(SIMULATOR, Simulator)


@pytest.mark.parametrize("dimension", DIMENSIONS)
def test_a_dam_breaks(dimension: int) -> None:
    simulation = dam(dimension)
    rows = advance(simulation, 0.4)
    first, last = rows[0], rows[-1]
    assert simulation.time == pytest.approx(0.4)
    assert simulation.step_count == len(rows)
    assert all(tuple(row)[1:] == simulation.columns() for row in rows)
    assert first["mass"] == pytest.approx(1000.0 * 0.375**2 * (0.25 if dimension == 3 else 1.0))
    assert last["mass"] == first["mass"]
    # The level set rounds the corners.
    assert first["volume"] == pytest.approx(first["mass"] / 1000.0, rel=0.015)
    assert last["center_of_mass_y"] < 0.75 * first["center_of_mass_y"]
    energies = [row["kinetic_energy"] + row["potential_energy"] for row in rows]
    assert max(energies) <= energies[0] * 1.01
    assert last["kinetic_energy"] > 0.1 * energies[0]
    assert {row["solve_status"] for row in rows} == {"CONVERGED"}
    assert max(row["solve_residual"] for row in rows) <= 1e-4
    assert max(row["cfl"] for row in rows) < 2.5
    assert all(row["max_divergence"] < 0.1 for row in rows)
    position = simulation.particles.position.numpy()
    assert position[:, 0].max() > 0.8
    assert (position >= 0).all()
    assert (position[:, :dimension] < [1.0, 0.5, 0.25][:dimension]).all()


@pytest.mark.parametrize("dimension", DIMENSIONS)
def test_cells_of_a_frame_are_those_of_the_last_solve(dimension: int) -> None:
    """Liquid cells of a frame: places with liquid at the start of the step, and their pressure.

    The dam is 6 of the 16 cells wide and high. Its pressure grows downward, and is 0 at its top.
    """
    simulation = dam(dimension)
    simulation.step(1e-4)
    cells = next(part for part in simulation.frame() if isinstance(part, Cells))
    expected = np.argwhere(simulation.projection.cells.numpy() == FLUID)
    np.testing.assert_array_equal(simulation.projection.fluid_cells(), expected)
    low, high = cells.index.min(axis=0), cells.index.max(axis=0)
    assert low.tolist() == [0, 0, 0]
    assert high.tolist()[:2] == [5, 5]
    order = np.argsort(cells.index[:, 1], kind="stable")
    assert cells.fields["pressure"][order[0]] > cells.fields["pressure"][order[-1]] > 0.0


def test_the_log_holds_what_the_particles_have() -> None:
    simulation = dam()
    row, before = advance(simulation, 0.1)[-1], simulation._velocity_before[1]
    x, v = (
        a.numpy().astype(np.float64)
        for a in (simulation.particles.position, simulation.particles.velocity)
    )
    mass = row["mass"] / len(x)
    assert row["particles"] == len(x) == 6 * 6 * 4
    dt, fall = row["dt"], -v[:, 1].mean()
    # Work of gravity in half a step.
    work = 0.5 * dt * GRAVITY * (fall + 0.25 * dt * (fall + before) / simulation.kick_dt)
    assert row["kinetic_energy"] == pytest.approx(
        mass * (0.5 * (v**2).sum() + len(v) * work), rel=1e-5
    )
    assert row["potential_energy"] == pytest.approx(mass * GRAVITY * x[:, 1].sum(), rel=1e-5)
    assert row["center_of_mass_y"] == pytest.approx(x[:, 1].mean(), rel=1e-6)
    assert row["max_speed"] == pytest.approx(np.linalg.norm(v, axis=1).max(), rel=1e-6)
    assert row["cfl"] == pytest.approx(row["max_speed"] * row["dt"] / simulation.grid.spacing)
    assert row["solver"] == "projected-multigrid"
    assert row["solve_iterations"] >= 0
    assert row["linear_iterations"] >= row["solve_iterations"]


def test_the_time_step_obeys_the_cfl_number() -> None:
    dx = 1.0 / 16
    still = dam(cfl=2.0)
    assert still.stable_dt() == pytest.approx(np.sqrt(2.0 * dx / GRAVITY))
    moving = create(
        scene(
            size=[1.0, 0.5],
            resolution=16,
            cfl=1.0,
            liquid=[box([0.0, 0.0], [0.5, 0.25], velocity=[3.0, 4.0])],
        )
    )
    assert moving.stable_dt() == pytest.approx(dx / (5.0 + np.sqrt(GRAVITY * dx)))
    weightless = dam(physics={"gravity": [0.0, 0.0]})
    assert weightless.stable_dt() == np.inf


@pytest.mark.parametrize("dimension", DIMENSIONS)
def test_frames_show_particles_and_cells(dimension: int) -> None:
    simulation = dam(dimension)
    for until in (0.0, 0.15):
        advance(simulation, until)
        points, cells = simulation.frame()
        assert isinstance(points, Points)
        assert isinstance(cells, Cells)
        n = simulation.particles.count
        assert points.points.shape == points.fields["velocity"].shape == (n, 3)
        assert points.fields["speed"] == pytest.approx(
            np.linalg.norm(points.fields["velocity"], axis=1)
        )
        assert cells.dimension == dimension
        assert cells.spacing == 1.0 / 16
        assert cells.index.min() >= 0
        assert (cells.index < simulation.grid.counts).all()
        assert len(np.unique(cells.index, axis=0)) == len(cells.index)
        assert set(cells.fields) == {"pressure", "wall", "released"}
        if until == 0.0:
            occupied = np.unique(simulation.particles.cells_of(points.points), axis=0)
            assert (occupied == np.unique(cells.index, axis=0)).all()
            assert (cells.fields["pressure"] == 0.0).all()
        else:
            floor = cells.index[:, 1] == 0
            assert (cells.fields["wall"][floor] == 1).all()
            assert cells.fields["pressure"].max() > 300.0
            assert (cells.fields["pressure"][cells.fields["wall"] == 1] >= 0.0).all()
            assert cells.fields["released"].dtype == np.uint8


@pytest.mark.parametrize("transfer", ["apic", "flip"])
@pytest.mark.parametrize("dimension", DIMENSIONS)
def test_a_restored_run_continues_bit_for_bit(dimension: int, transfer: str) -> None:
    through = dam(dimension, particles={"transfer": transfer})
    advance(through, 0.1)
    saved = through.state()
    frame = through.frame()
    resumed = dam(dimension, particles={"transfer": transfer})
    resumed.restore(saved)
    for a, b in zip(frame, resumed.frame(), strict=True):
        assert all(np.array_equal(a.fields[name], b.fields[name]) for name in a.fields)
    for _ in range(5):
        dt = through.stable_dt()
        assert resumed.stable_dt() == dt
        assert through.step(dt) == resumed.step(dt)
    assert same(snapshot(through), snapshot(resumed))
    assert not same(saved, snapshot(resumed))


def test_two_runs_of_a_scene_are_the_same() -> None:
    a, b = dam(3), dam(3)
    assert advance(a, 0.1) == advance(b, 0.1)
    assert same(snapshot(a), snapshot(b))


def test_states_of_other_scenes_are_refused() -> None:
    simulation = dam()
    state = simulation.state()
    for name, value, words in (
        ("signature", state["signature"] + 1, "grid"),
        ("position", state["position"][:-1], "position"),
        ("velocity", np.full_like(state["velocity"], np.nan), "not finite"),
        ("pressure", state["pressure"].astype(np.float32), "pressure"),
    ):
        with pytest.raises(ValueError, match=words):
            simulation.restore({**state, name: value})
    solid = dam(solid=[box([0.75, 0.0], [1.0, 0.25])]).state()
    with pytest.raises(ValueError, match="solids"):
        simulation.restore(solid)
    with pytest.raises(ValueError, match="affine_0"):
        simulation.restore({name: value for name, value in state.items() if name != "affine_0"})
    with pytest.raises(ValueError, match="grid"):
        simulation.restore(
            dam(particles={"transfer": "flip"}).state()
            | {"affine_0": state["affine_0"], "affine_1": state["affine_1"]}
        )
    assert same(simulation.state(), state)


@pytest.mark.parametrize("steps", [0, 4])
def test_a_failed_solve_leaves_the_state_as_it_was(steps: int) -> None:
    simulation, twin = (dam(solver={"max_iterations": 50, "tolerance": 1e-10}) for _ in range(2))
    for _ in range(steps):
        simulation.step(0.02)
        twin.step(0.02)
    twin.particles.arrange(steps)  # the only effect that a failed step may have
    before, frame = twin.state(), twin.frame()
    simulation.projection.max_iterations = 0
    for _ in range(2):
        with pytest.raises(StepFailed, match=r"MAX_ITERATIONS .*relative residual"):
            simulation.step(0.02)
    assert simulation.step_count == steps
    assert same(before, simulation.state())
    for a, b in zip(frame, simulation.frame(), strict=True):
        assert all(np.array_equal(a.fields[name], b.fields[name]) for name in a.fields)
    simulation.projection.max_iterations = 50
    assert simulation.step(0.01) == twin.step(0.01)
    assert same(twin.state(), simulation.state())


def test_the_limit_of_iterations_is_the_scene_s() -> None:
    with pytest.raises(StepFailed, match=r"after 1 iterations"):
        dam(solver={"max_iterations": 1, "tolerance": 1e-10}).step(0.01)


@pytest.mark.cuda
@pytest.mark.parametrize("dimension", DIMENSIONS)
def test_the_gpu_gives_the_same_liquid(dimension: int) -> None:
    host, device = (advance(dam(dimension, device), 0.2, 0.01)[-1] for device in ("cpu", "cuda:0"))
    for name in ("particles", "mass", "solve_status"):
        assert host[name] == device[name]
    for name in ("kinetic_energy", "potential_energy", "center_of_mass_y"):
        assert device[name] == pytest.approx(host[name], rel=1e-3)


def test_values_that_are_not_finite_end_the_run_with_step_field_and_cell() -> None:
    for name, value in (
        ("velocity", np.nan),
        ("velocity", np.inf),
        ("velocity", 1e30),
        ("position", np.nan),
    ):
        simulation = dam()
        simulation.step(0.01)
        array = getattr(simulation.particles, name)
        host = array.numpy().copy()
        x, y, _ = simulation.particles.cells_of(simulation.particles.position.numpy()[7:8])[0]
        host[7, 1] = value
        array.assign(host)
        with pytest.raises(
            SimulationFailed,
            match=rf"step 1: {name} is not finite in cell \(x, y, z\) = \({x}, {y}, 0\)",
        ):
            simulation.step(0.01)


def test_a_gradient_that_is_not_finite_is_found_on_the_faces() -> None:
    simulation = dam()
    gradient = simulation.particles.affine[0].numpy().copy()
    gradient[3] = np.nan
    simulation.particles.affine[0].assign(gradient)
    with pytest.raises(SimulationFailed, match=r"step 0: the velocity on the faces of cell"):
        simulation.step(0.01)


def test_a_particle_outside_the_domain_ends_the_run() -> None:
    simulation = dam()
    position = simulation.particles.position.numpy().copy()
    for outside in (-0.5, 1.0, 7.0):
        position[3, 0] = outside
        simulation.particles.position.assign(position)
        with pytest.raises(SimulationFailed, match="outside the domain"):
            simulation.step(0.01)


@pytest.mark.parametrize("dt", [0.0, -1.0, float("nan"), float("inf")])
def test_a_step_needs_a_positive_time(dt: float) -> None:
    with pytest.raises(ValueError, match="dt"):
        dam().step(dt)


def test_liquids_without_particles_are_refused() -> None:
    with pytest.raises(ValueError, match=r"liquid\[1\] \(box\) holds no particle"):
        create(
            scene(
                size=[1.0, 0.5],
                resolution=16,
                liquid=[box([0.0, 0.0], [0.5, 0.25]), box([0.1, 0.1], [0.2, 0.2])],
            )
        )
    with pytest.raises(ValueError, match=r"liquid\[0\]"):
        solid = [box([0.4, 0.1], [0.8, 0.4])]
        create(
            scene(size=[1.0, 0.5], resolution=16, liquid=[box([0.5, 0.2], [0.6, 0.3])], solid=solid)
        )


def test_liquids_start_with_their_own_velocity_and_outside_solids() -> None:
    liquid = [box([0.0, 0.0], [0.25, 0.25], velocity=[1.0, 2.0]), box([0.125, 0.0], [0.5, 0.25])]
    simulation = create(
        scene(
            size=[1.0, 0.5], resolution=16, liquid=liquid, solid=[box([0.375, 0.0], [0.4375, 0.5])]
        )
    )
    x, v = simulation.particles.position.numpy(), simulation.particles.velocity.numpy()
    assert (v[x[:, 0] < 0.25] == [1.0, 2.0, 0.0]).all()
    assert (v[x[:, 0] > 0.25] == 0.0).all()
    assert not ((x[:, 0] > 0.375) & (x[:, 0] < 0.4375)).any()
    assert simulation.particles.count == 4 * 4 * 7
    assert any("particles" in note for note in simulation.notes())


@pytest.mark.parametrize("transfer", ["apic", "flip", "pic"])
def test_only_apic_carries_gradients(transfer: str) -> None:
    simulation = dam(particles={"transfer": transfer})
    assert len(simulation.particles.affine) == (2 if transfer == "apic" else 0)
    assert ("affine_0" in simulation.state()) == (transfer == "apic")
    rows = advance(simulation, 0.2)
    assert rows[-1]["max_speed"] > 1.0


def test_pic_damps_more_than_flip() -> None:
    energies = {}
    for transfer in ("apic", "flip", "pic"):
        simulation = dam(particles={"transfer": transfer})
        row = advance(simulation, 1.0)[-1]
        energies[transfer] = row["kinetic_energy"] + row["potential_energy"]
    assert energies["pic"] < energies["apic"]
    assert energies["pic"] < energies["flip"]


def test_the_simple_solver_gives_the_same_liquid() -> None:
    a = dam(solver={"method": "psor", "max_iterations": 2000, "tolerance": 1e-7})
    b = dam(solver={"tolerance": 1e-7})
    rows = [advance(simulation, 0.1, 0.01) for simulation in (a, b)]
    assert rows[0][-1]["solver"] == "psor"
    assert rows[0][-1]["kinetic_energy"] == pytest.approx(rows[1][-1]["kinetic_energy"], rel=1e-4)


@pytest.mark.parametrize("dimension", DIMENSIONS)
def test_gathering_transfers_give_the_same_liquid(dimension: int) -> None:
    """Gathering transfers, as on a GPU, on the CPU."""
    scattered, gathered = dam(dimension), dam(dimension)
    p = gathered.particles
    gathered.particles = Particles(
        p.grid, p.position.numpy(), p.velocity.numpy(), affine=True, indexed=True
    )
    rows = [advance(simulation, 0.2, 0.01)[-1] for simulation in (scattered, gathered)]
    for name in ("kinetic_energy", "potential_energy", "center_of_mass_y", "volume"):
        assert rows[1][name] == pytest.approx(rows[0][name], rel=1e-3)


@pytest.mark.parametrize("method", ["projected-multigrid", "minimum-map-newton"])
def test_the_grid_methods_give_the_same_liquid(method: str) -> None:
    a, b = (dam(3, solver={"method": name, "tolerance": 1e-7}) for name in (method, "psor"))
    b.projection.max_iterations = 5000
    rows = [advance(simulation, 0.05, 0.01) for simulation in (a, b)]
    assert rows[0][-1]["solver"] == method
    assert rows[0][-1]["kinetic_energy"] == pytest.approx(rows[1][-1]["kinetic_energy"], rel=1e-4)


def test_a_step_marks_its_stages() -> None:
    class StageNames:
        def __init__(self) -> None:
            self.found: list[str] = []

        def stage(self, name: str, *arrays: object) -> nullcontext[None]:
            assert arrays
            self.found.append(name)
            return nullcontext()

    plain, watched = dam(), dam()
    assert isinstance(watched, HasStages)
    watched.watch = StageNames()
    assert watched.step(0.01) == plain.step(0.01)
    assert watched.watch.found == [
        "diagnostics",
        "sort",
        "particles-to-grid",
        "surface",
        "pressure set-up",
        "pressure solve",
        "projection",
        "diagnostics",
        "extrapolation",
        "bodies in flight",
        "grid-to-particles",
        "density monitor",
        "advection",
        "bodies in flight",
        "diagnostics",
    ]


def test_a_piston_drives_the_liquid_of_a_scene() -> None:
    """Piston of a scene that drives the liquid.

    A solid with a velocity of its own: its cells stay, its face pushes.
    """
    solid = [box([0.0, 0.0], [0.0625, 0.5])]
    tables = {
        "physics": {"gravity": [0.0, 0.0]},
        "solids": "voxel",
        "pressure": {"surface": "voxel"},
    }
    model = scene(
        size=[1.0, 0.5],
        resolution=16,
        liquid=[box([0.0625, 0.0], [1.0, 0.25])],
        solid=solid,
        **tables,
    )
    simulation = create(model, np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]]))
    row = simulation.step(0.01)
    v = simulation.velocity[1].numpy()[1]
    assert v[5, 2:-1].sum() == pytest.approx(4 * 0.5, rel=1e-3)
    assert row["active"] == 0
    assert row["kinetic_energy"] > 0.0
    assert simulation.velocity[0].numpy()[1, 1:5, 2] == pytest.approx(0.5)


def test_scenes_of_something_else_are_refused() -> None:
    from warp_lcp.scene.scene import Scene

    data = {
        "scene": {"simulator": "fluids"},
        "time": {"duration": 1.0},
        "domain": {"size": [1.0, 1.0], "resolution": 4},
    }
    with pytest.raises(ValueError, match="liquid"):
        SIMULATOR.create(Scene.model_validate(data), device="cpu", folder=Path())
