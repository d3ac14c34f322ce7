"""Coupled solve of velocity and pressure: dense solutions, bounds, exact states, channel, rod."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from default_run import few
from small_liquids import GRAVITY, box, create, scene
from warp_lcp.fluids import LiquidScene, LiquidSimulation, stokes
from warp_lcp.fluids.stokes_kernels import stokes_kernels
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.window_reduction import WindowReduction
from warp_lcp.operators.grid_poisson import AIR, FLUID, SOLID

ALWAYS = 1e-12  # splitting tolerance at which every step is coupled


@dataclass
class DenseStokesProblem:
    """Dense equations of a coupled solve, about a velocity and a pressure.

    A du - D'dx = r and y + D du + C dx >= 0, complementary to x + dx >= lower.
    """

    A: np.ndarray
    D: np.ndarray
    C: np.ndarray
    r: np.ndarray
    y: np.ndarray
    room: np.ndarray  # lower - x, -inf without bound
    asymmetry: float

    def velocity_change(self) -> np.ndarray:
        """Return du of the exact solution."""
        inverse = np.linalg.inv(self.A)
        S = self.D @ inverse @ self.D.T + self.C
        q = self.y + self.D @ (inverse @ self.r)
        dx = np.zeros(len(q))
        bounded = np.isfinite(self.room)
        free = ~bounded
        if not bounded.any():
            dx = -np.linalg.lstsq(S, q, rcond=1e-10)[0]
        else:
            # Unknowns without bound are eliminated; Lemke's method solves the rest.
            F, B = np.flatnonzero(free), np.flatnonzero(bounded)
            inner = np.linalg.pinv(S[np.ix_(F, F)], rcond=1e-10) if len(F) else np.zeros((0, 0))
            M = S[np.ix_(B, B)] - S[np.ix_(B, F)] @ inner @ S[np.ix_(F, B)]
            b = q[B] - S[np.ix_(B, F)] @ inner @ q[F]
            problem = wl.LCP(M, b + M @ self.room[B], 0.0, np.inf)
            dx[B] = self.room[B] + np.asarray(wl.solve(problem, wl.Lemke()).x.numpy()).ravel()
            dx[F] = -inner @ (q[F] + S[np.ix_(F, B)] @ dx[B])
        return inverse @ (self.r + self.D.T @ dx)

    def error(self) -> float:
        """Return the error of the velocity in the norm of A."""
        du = self.velocity_change()
        return float(np.sqrt(du @ self.A @ du))


def dense(simulation: LiquidSimulation) -> DenseStokesProblem:
    """Return the equations at the current velocity and pressure."""
    solve, projection = simulation.stokes, simulation.projection
    kind = projection.kind.numpy()
    solve.allocate()
    operator, residual = solve.operator, solve._preconditioner.r
    operator.free.assign((kind == FLUID).astype(np.uint8))
    solve.residual(simulation.velocity)
    r = residual.numpy().astype(float)
    size = operator.layout.velocities.stop
    volume = np.concatenate([v.numpy().ravel() for v in operator.level.volume])
    faces, cells = np.flatnonzero(volume > 0.0), np.flatnonzero(kind.ravel() == FLUID)
    columns = np.concatenate([faces, size + cells])
    p, q = (wp.zeros(residual.size, dtype=wp.float32, device="cpu") for _ in range(2))
    K = np.zeros((len(columns), len(columns)))
    for number, column in enumerate(columns):
        unit = np.zeros(p.size, dtype=np.float32)
        unit[column] = 1.0
        p.assign(unit)
        q.zero_()
        operator.product(p, q)
        K[:, number] = q.numpy()[columns]
    n = len(faces)
    lower = projection.lower
    x = projection.pressure.numpy().ravel()[cells]
    room = np.full(len(cells), -np.inf) if lower is None else lower.numpy().ravel()[cells] - x
    S = 0.5 * (K + K.T)
    return DenseStokesProblem(
        A=S[:n, :n],
        D=-S[n:, :n],
        C=-S[n:, n:],
        r=r[columns[:n]],
        y=operator.outflows.numpy().ravel()[cells].astype(float),
        room=room,
        asymmetry=float(np.abs(K - K.T).max() / np.abs(K).max()),
    )


def coupled_step(
    simulation: LiquidSimulation, dt: float
) -> tuple[DenseStokesProblem, DenseStokesProblem, Any]:
    """Take a step; return the equations before and after its coupled solve, and its result."""
    found: list[Any] = []
    solve = simulation.stokes.solve

    def watched(*arguments: Any) -> Any:
        simulation.stokes.operator.set_up(arguments[1])
        found.append(dense(simulation))
        # The equations of the viscous solve are those of before again.
        found.append(simulation.stokes.couple(arguments[0], np.inf, arguments[2]))
        found.insert(1, dense(simulation))
        return found[2]

    simulation.stokes.solve = watched
    simulation.step(dt)
    simulation.stokes.solve = solve
    return found[0], found[1], found[2]


def drawn(seed: int) -> LiquidSimulation:
    """Return a drawn pool or block with a solid or two, on few cells."""
    rng = np.random.default_rng(seed)
    dimension = 2 if seed % 3 else 3
    wall = ["sticky", "separating", "separating", "free-slip"][seed % 4]
    low = rng.uniform(0.0, 0.3, dimension)
    high = np.minimum(low + rng.uniform(0.4, 0.7, dimension), 1.0)
    velocity = rng.uniform(-1.0, 1.0, dimension).tolist()
    solids = [
        {
            "shape": "sphere",
            "center": rng.uniform(0.2, 0.8, dimension).tolist(),
            "radius": float(rng.uniform(0.1, 0.25)),
            "wall": str(rng.choice(["sticky", "separating"])),
        }
    ]
    slip = {"slip_length": float(rng.uniform(0.0, 0.1))} if rng.random() < 0.4 else {}
    viscosity = {"value": float(10.0 ** rng.uniform(1.0, 4.0)), **slip}
    return create(
        scene(
            size=[1.0] * dimension,
            resolution=10 if dimension == 2 else 6,
            wall=wall,
            liquid=[box(low.tolist(), high.tolist(), velocity=velocity)],
            solid=solids,
            solids=str(rng.choice(["cut-cell", "voxel"])),
            viscosity={**viscosity, "splitting_tolerance": ALWAYS},
            solver={"tolerance": 1e-5},
        )
    )


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("seed", few(range(12), 5))
def test_it_solves_the_dense_problem(seed: int) -> None:
    simulation = drawn(seed)
    before, after, result = coupled_step(simulation, 0.02)
    assert before.asymmetry < 1e-6
    assert np.linalg.eigvalsh(before.A).min() > 0.0
    assert result.converged
    assert after.error() <= max(3e-4 * before.error(), 3e-5)


@pytest.mark.parametrize("wall", ["separating", "sticky"])
def test_liquid_at_rest_and_in_flight_needs_no_coupled_solve(wall: str) -> None:
    pool = create(
        scene(
            size=[1.0, 1.0],
            resolution=16,
            wall=wall,
            liquid=[box([0.0, 0.0], [1.0, 0.5])],
            viscosity={"value": 1e3, "splitting_tolerance": 0.05},
        )
    )
    block = create(
        scene(
            size=[1.0, 1.0],
            resolution=16,
            liquid=[box([0.25, 0.5], [0.75, 1.0])],
            viscosity={"value": 1e3, "splitting_tolerance": 0.05},
        )
    )
    for simulation in pool, block:
        for _ in range(2):
            row = simulation.step(0.02)
            assert row["stokes_iterations"] == 0
    assert block.step(0.02)["splitting_error"] < 1e-3


def test_a_step_that_needs_no_coupled_solve_has_the_same_bits() -> None:
    rows = []
    for tolerance in float("inf"), 1e9:
        simulation = create(
            scene(
                size=[1.0, 0.5],
                resolution=16,
                liquid=[box([0.0, 0.0], [0.4, 0.4])],
                viscosity={"value": 1.0, "splitting_tolerance": tolerance},
            )
        )
        for _ in range(3):
            simulation.step(0.02)
        rows.append([field.numpy().copy() for field in simulation.velocity])
    assert all(np.array_equal(one, other) for one, other in zip(*rows, strict=True))


def channel(viscosity: float, tolerance: float = 0.05) -> LiquidSimulation:
    """Return a channel of 16 cells between sticky walls, with inflow and outflow."""
    data = {
        "scene": {"simulator": "fluids"},
        "time": {"duration": 1.0},
        "domain": {"size": [1.0, 0.34375], "resolution": 64, "wall": "sticky", "open": ["right"]},
        "liquid": [box([0.0, 0.03125], [1.0, 0.28125])],
        "solid": [box([-1.0, -1.0], [5.0, 0.03125]), box([-1.0, 0.28125], [5.0, 2.0])],
        "source": [box([0.0, 0.03125], [0.03125, 0.28125], velocity=[0.05, 0.0])],
        "viscosity": {"value": viscosity, "splitting_tolerance": tolerance},
        "physics": {"gravity": [0.0, -1e-6]},
        "probe": [
            {"name": "a", "position": [0.4, 0.16], "quantity": "pressure"},
            {"name": "b", "position": [0.7, 0.16], "quantity": "pressure"},
            {"name": "u", "position": [0.55, 0.15625], "quantity": "velocity"},
        ],
    }
    return create(LiquidScene.model_validate(data))


def test_a_channel_of_water_is_solved_as_without() -> None:
    rows = []
    for tolerance in float("inf"), 0.05:
        simulation = channel(0.001, tolerance)
        for _ in range(3):
            row = simulation.step(0.02)
        rows.append([field.numpy().copy() for field in simulation.velocity])
        assert row["viscous_iterations"] <= 3
    assert all(np.array_equal(one, other) for one, other in zip(*rows, strict=True))


def test_a_channel_has_the_gradient_and_the_profile_of_poiseuille() -> None:
    viscosity, height, speed = 500.0, 0.25, 0.05
    simulation = channel(viscosity)
    for _ in range(3):
        row = simulation.step(0.02)
    assert row["stokes_iterations"] <= 40
    found = simulation.measured["probes"]
    gradient = (found["a_pressure"] - found["b_pressure"]) / 0.3
    assert abs(gradient / (12.0 * viscosity * speed / height**2) - 1.0) < 0.02
    assert abs(found["u_vx"] / (1.5 * speed) - 1.0) < 0.02


@pytest.mark.parametrize("viscosity", [1.0, 1e5])
def test_a_block_falls_freely_from_a_ceiling_that_separates(viscosity: float) -> None:
    liquid = [box([0.3, 0.6], [0.7, 1.0])]
    settings = {"value": viscosity, "splitting_tolerance": 0.05}
    simulation = create(scene(size=[1.0, 1.0], resolution=32, liquid=liquid, viscosity=settings))
    start = np.sort(simulation.particles.position.numpy()[:, 1])
    while simulation.time < 0.15 - 1e-9:
        simulation.step(min(0.02, 0.15 - simulation.time))
    fallen = start - np.sort(simulation.particles.position.numpy()[:, 1])
    assert np.abs(fallen - 0.5 * GRAVITY * 0.15**2).max() < 0.01 / 32


def two_layers(height: float, thick: float, thin: float) -> tuple[np.ndarray, np.ndarray]:
    """Return fluxes of two equal layers per pressure gradient, and speeds at 16 places across.

    Poiseuille flow, the thick layer below: the shear stress s - y is continuous, and the velocity
    is 0 at both walls. Shapes (2,) and (16,).
    """
    half = 0.5 * height
    stress = (half**2 / thick + (height**2 - half**2) / thin) / (2 * half / thick + 2 * half / thin)
    y = np.linspace(0.0, height, 16001)
    below = (stress * y - 0.5 * y**2) / thick
    above = -(stress * (height - y) - 0.5 * (height**2 - y**2)) / thin
    speed = np.where(y <= half, below, above)
    fluxes = [np.trapezoid(speed[part], y[part]) for part in (y <= half, y >= half)]
    return np.array(fluxes), np.interp((np.arange(16) + 0.5) / 16 * height, y, speed)


def test_two_layers_have_the_gradient_and_the_profile_of_poiseuille() -> None:
    """Layers of 500,000 and 500 Pa s in a channel of 16 cells, with the fluxes of one gradient.

    The means of viscosities on edges and in cells decide: with arithmetic ones on faces the
    gradient in the thick layer is 1.65 of theory.
    """
    height, thick, thin, speed = 0.25, 500000.0, 500.0, 0.05
    fluxes, profile = two_layers(height, thick, thin)
    gradient = speed * height / fluxes.sum()
    low, middle, high = 0.03125, 0.15625, 0.28125
    lower, upper = {"viscosity": thick}, {"viscosity": thin}
    inflow = [[gradient * flux / (0.5 * height), 0.0] for flux in fluxes]
    data = {
        "scene": {"simulator": "fluids"},
        "time": {"duration": 1.0},
        "domain": {"size": [1.0, 0.3125], "resolution": 64, "wall": "sticky", "open": ["right"]},
        "liquid": [box([0.0, low], [1.0, middle], **lower), box([0.0, middle], [1.0, high])],
        "solid": [box([-1.0, -1.0], [5.0, low]), box([-1.0, high], [5.0, 2.0])],
        "source": [
            box([0.0, low], [low, middle], velocity=inflow[0], **lower),
            box([0.0, middle], [low, high], velocity=inflow[1], **upper),
        ],
        "viscosity": {"value": thin, "splitting_tolerance": 0.05},
        "physics": {"gravity": [0.0, -1e-6]},
        "probe": [
            {"name": "a", "position": [0.4, 0.09375], "quantity": "pressure"},
            {"name": "b", "position": [0.7, 0.09375], "quantity": "pressure"},
        ],
    }
    simulation = create(LiquidScene.model_validate(data))
    for _ in range(4):
        row = simulation.step(0.02)
    assert row["stokes_iterations"] <= 60
    found = simulation.measured["probes"]
    assert abs((found["a_pressure"] - found["b_pressure"]) / 0.3 / gradient - 1.0) < 0.05
    along = simulation.velocity[0].numpy()[1, 3:19, 36]
    error = np.abs(along - gradient * profile)
    assert error.max() < 0.03 * gradient * profile.max()
    assert error[:8].max() < 0.05 * gradient * profile[:8].max()


def test_a_rod_sinks_at_the_speed_of_faxen_and_carries_its_weight() -> None:
    rod = {"shape": "sphere", "center": [0.02, 0.04], "radius": 0.005, "density": 7800.0}
    simulation = create(
        scene(
            size=[0.04, 0.08],
            resolution=32,
            liquid=[box([0.0, 0.0], [0.04, 0.075])],
            solid=[rod],
            viscosity={"value": 10.0, "splitting_tolerance": 0.05},
            output={"forces": True},
        )
    )
    for _ in range(5):
        row = simulation.step(0.02)
    k, weight = 0.25, 7800.0 * GRAVITY * np.pi * 0.005**2
    sinking = (7800.0 - 1000.0) * GRAVITY * np.pi * 0.005**2
    walls = np.log(1 / k) - 0.9157 + 1.7244 * k**2 - 1.7302 * k**4
    speed = sinking * walls / (4.0 * np.pi * 10.0)
    assert abs(-row["body0_vy"] / speed - 1.0) < 0.09
    assert abs(simulation.measured["forces"]["solid0_fy"] / weight - 1.0) < 0.02


@pytest.mark.parametrize("dimension", [2, 3])
def test_energies_are_sums_over_the_cells_of_the_window(dimension: int) -> None:
    """Sum of V u^2 and of u f; with no diagonal, a face's force is V u. Ghost cells do not count.

    Fields are random in all stored cells; a quarter of the faces has no volume.
    """
    grid = StaggeredGrid((9, 6, 5 if dimension == 3 else 1), 0.1, dimension, "cpu")
    rng = np.random.default_rng(641)
    u, force, volume, diagonal = rng.uniform(0.5, 1.0, (4, *grid.shape)).astype(np.float32)
    volume[rng.random(grid.shape) < 0.25] = 0.0
    diagonal[rng.random(grid.shape) < 0.5] = 0.0
    fields = {"u": u, "force": force, "volume": volume, "diagonal": diagonal}
    kernels = stokes_kernels(cut=True, moving=False, ghost=True, varies=False, bounded=True)
    reduction = WindowReduction(kernels.energy, grid)
    reduction.launch(
        grid.domain, **{name: wp.array(field, device="cpu") for name, field in fields.items()}
    )
    inside = np.zeros(grid.shape, dtype=bool)
    inside[tuple(map(slice, grid.domain.low, grid.domain.high))] = True
    kinetic = np.where(inside, volume * u.astype(np.float64) ** 2, 0.0)
    power = np.where(diagonal > 0.0, np.where(inside & (volume > 0.0), u * force, 0.0), kinetic)
    np.testing.assert_allclose(reduction.read(), [kinetic.sum(), power.sum()], rtol=1e-5)


def pool(wall: str, viscosity: float, resolution: int = 24, **keys: Any) -> LiquidSimulation:
    """Return a column of thick liquid that collapses."""
    return create(
        scene(
            size=[1.0, 1.0],
            resolution=resolution,
            wall=wall,
            liquid=[box([0.0, 0.0], [0.5, 0.8])],
            viscosity={"value": viscosity, "splitting_tolerance": 0.05},
            **keys,
        )
    )


def with_mass(simulation: LiquidSimulation) -> list[np.ndarray]:
    """Return the velocities of the faces that are unknowns."""
    volumes = simulation.stokes.operator.level.volume
    pairs = zip(simulation.velocity, volumes, strict=True)
    return [u.numpy()[volume.numpy() > 0.0] for u, volume in pairs]


@pytest.mark.parametrize(("wall", "viscosity"), [("sticky", 1e3), ("separating", 1e5)])
def test_a_start_from_the_last_step_has_the_result_of_one_from_the_split_step(
    wall: str, viscosity: float
) -> None:
    simulations = pool(wall, viscosity), pool(wall, viscosity)
    for _ in range(4):
        simulations[1].stokes.continues = False
        last, split = (simulation.step(0.02) for simulation in simulations)
    assert last["viscous_iterations"] == 0 < split["viscous_iterations"]
    assert 0 < last["stokes_iterations"] <= split["stokes_iterations"] + 1
    # An estimate of |u - u2|_V, at most twice the bound.
    assert 0.05 < last["splitting_error"] <= 2.0 * split["splitting_error"]
    for one, other in zip(*map(with_mass, simulations), strict=True):
        assert np.abs(one - other).max() <= 3e-3 * max(np.abs(other).max(), 1e-12)


def test_the_splitting_error_is_estimated_every_fourth_step(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    simulation = pool("sticky", 1e3)
    errors: list[float] = []
    estimated: list[int] = []
    estimate = type(simulation.stokes)._splitting_error

    def counted(solve: Any) -> float:
        estimated.append(len(errors))
        return estimate(solve)

    monkeypatch.setattr(type(simulation.stokes), "_splitting_error", counted)
    for _ in range(8):
        errors.append(simulation.step(0.02)["splitting_error"])
    assert estimated == [2, 6]
    assert errors[2] == errors[5] != errors[6] == errors[7]


def test_a_failed_start_from_the_last_step_is_followed_by_the_split_step(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    simulations = pool("sticky", 1e3), pool("sticky", 1e3)
    for simulation in simulations:
        simulation.step(0.02)
    monkeypatch.setattr(stokes, "FARTHEST", 0.0)
    simulations[1].stokes.continues = False
    for simulation in simulations:
        assert simulation.step(0.02)["viscous_iterations"] > 0
    for one, other in zip(*(simulation.velocity for simulation in simulations), strict=True):
        np.testing.assert_array_equal(one.numpy(), other.numpy())


def test_thick_liquid_that_becomes_free_returns_to_the_split_step() -> None:
    simulation = create(
        scene(
            size=[1.0, 1.0],
            resolution=16,
            liquid=[box([0.25, 0.5], [0.75, 1.0])],
            viscosity={"value": 1e3, "splitting_tolerance": 0.05},
        )
    )
    simulation.stokes.continues = True  # in free fall, nothing is wrong with the split step
    assert simulation.step(0.02)["viscous_iterations"] == 0
    assert not simulation.stokes.continues
    assert simulation.step(0.02)["splitting_error"] < 1e-3


def test_resumed_coupled_steps_have_the_same_bits() -> None:
    first, second = pool("separating", 1e4), pool("separating", 1e4)
    for _ in range(2):
        first.step(0.02)
    second.restore(first.state())
    rows = [[simulation.step(0.02) for _ in range(2)] for simulation in (first, second)]
    assert rows[0][0]["viscous_iterations"] == 0
    assert rows[0] == rows[1]
    for one, other in zip(first.velocity, second.velocity, strict=True):
        np.testing.assert_array_equal(one.numpy(), other.numpy())


def test_errors_of_a_resumed_step_do_not_depend_on_the_window() -> None:
    # The first step of a resumed run has the whole grid as its window.
    drawn = scene(
        size=[0.6, 0.4],
        resolution=36,
        wall="sticky",
        liquid=[box([0.0, 0.0], [0.35, 0.3])],
        viscosity={"value": 5.0, "splitting_tolerance": 1.0},
    )
    whole = create(drawn)
    for _ in range(5):
        resumed = create(drawn)
        resumed.restore(whole.state())
        rows = [simulation.step(0.01) for simulation in (whole, resumed)]
        assert rows[0]["splitting_error"] == rows[1]["splitting_error"] > 0.0


@pytest.mark.parametrize("resolution", few([16, 32], 1))
def test_iterations_hardly_depend_on_viscosity_and_resolution(resolution: int) -> None:
    counts = []
    for tau in 1e-2, 1.0, 1e2, 1e4, 1e6:
        simulation = create(
            scene(
                size=[1.0] * 3,
                resolution=resolution,
                wall="sticky",  # no contacts
                liquid=[box([0.0] * 3, [0.5, 0.8, 0.8])],
                viscosity={
                    "value": tau * 1000.0 / resolution**2 / 0.02,
                    "splitting_tolerance": ALWAYS,
                },
            )
        )
        result = coupled_from_split_step(simulation, 0.02)
        assert result.converged
        counts.append(result.iterations)
    assert max(counts) <= 20


def coupled_from_split_step(simulation: LiquidSimulation, dt: float) -> Any:
    """Take a step with a coupled solve from the split step's result; return its result."""
    found: list[Any] = []
    solve = simulation.stokes

    def watched(*arguments: Any) -> Any:
        solve.operator.set_up(arguments[1])
        found.append(solve.couple(arguments[0], np.inf, arguments[2]))
        return found[0]

    solve.solve = watched
    simulation.step(dt)
    return found[0]


@pytest.mark.parametrize("seed", range(3))
def test_the_last_projection_solves_for_the_sum_of_pressures(seed: int) -> None:
    """x + x' >= 0 beside separating walls, complementary to the outflow after the correction x'.

    A plain loop of projected Gauss-Seidel sweeps has the same solution: whole cells, a surface on
    their faces, random velocities and pressures.
    """
    simulation = create(
        scene(
            size=[1.0, 1.0],
            resolution=8,
            liquid=[box([0.25, 0.0], [1.0, 0.75])],
            solids="voxel",
            pressure={"surface": "voxel"},
            viscosity={"value": 1e3},
            solver={"tolerance": 1e-6},
        )
    )
    simulation.step(0.02)
    rng, projection = np.random.default_rng(seed), simulation.projection
    kind = projection.kind.numpy()[1]
    for u in simulation.velocity:
        u.assign(rng.uniform(-1.0, 1.0, u.shape).astype(np.float32))
    x = np.where(kind == FLUID, rng.uniform(0.0, 1.0, kind.shape), 0.0)
    x[rng.random(x.shape) < 0.5] = 0.0  # cells that may separate
    projection.pressure.assign(np.pad(x[None], ((1, 1), (0, 0), (0, 0))))
    u, v = (component.numpy()[1].astype(np.float64) for component in simulation.velocity)

    cells = [tuple(cell) for cell in np.argwhere(kind == FLUID)]
    outflow, neighbors, at_wall = {}, {}, {}
    for j, i in cells:
        faces = [((j, i + 1), u[j, i + 1]), ((j, i - 1), -u[j, i])]
        faces += [((j + 1, i), v[j + 1, i]), ((j - 1, i), -v[j, i])]
        opened = [(cell, out) for cell, out in faces if kind[cell] in (FLUID, AIR)]
        outflow[j, i] = sum(out for _, out in opened)
        neighbors[j, i] = [cell for cell, _ in opened]
        at_wall[j, i] = len(opened) < 4
    total = x.copy()
    for _ in range(600):
        for cell in cells:
            y = outflow[cell]
            for other in neighbors[cell]:
                y += (total[cell] - x[cell]) - (total[other] - x[other])
            moved = total[cell] - y / len(neighbors[cell])
            total[cell] = max(moved, 0.0) if at_wall[cell] else moved

    projection.correct(simulation.velocity, simulation.grid.domain, 0.02, 0.02, 1e-9, lambda: None)
    separated = [cell for cell in cells if at_wall[cell] and total[cell] == 0.0]
    assert 0 < len(separated) < sum(at_wall.values())
    np.testing.assert_allclose(projection.pressure.numpy()[1], total, atol=1e-5)
    change = total - x
    for j, i in cells:
        if kind[j, i - 1] != SOLID:
            expected = u[j, i] - change[j, i] + change[j, i - 1]
            assert abs(simulation.velocity[0].numpy()[1, j, i] - expected) < 1e-4


def test_thick_liquid_has_no_jets_in_films_on_walls_that_slip() -> None:
    # A source pours onto a solid 0.8 cells below it. Faces that the solid closes up to 1 % of their
    # area move as the liquid beside them, not freely under its pressure (35 m/s).
    solid = {"shape": "sphere", "center": [0.6767, 0.6609], "radius": 0.223, "wall": "free-slip"}
    simulation = create(
        scene(
            size=[1.0, 1.0],
            resolution=50,
            liquid=[box([0.25, 0.0], [0.6, 0.2])],
            solid=[solid],
            source=[box([0.5834, 0.9], [0.7409, 1.0], velocity=[0.0, -0.76])],
            viscosity={"value": 2000.0},
            cfl=0.9,
        )
    )
    fastest = max(simulation.step(simulation.stable_dt())["max_speed"] for _ in range(6))
    assert fastest < 0.76 * 0.1575 / 0.016  # all of it through one side of the gap
