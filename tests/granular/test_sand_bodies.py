"""Rigid bodies in sand: floating, sinking, sliding, and the load below."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

import warp_lcp as wl
from default_run import slow
from scene_tables import ball, box
from stepping import advance
from warp_lcp.granular.scene import SandScene
from warp_lcp.granular.simulator import FAR, GranularSimulator, SandSimulation
from warp_lcp.granular.stress import Stress
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.simulation import SimulationFailed, StepFailed, Surface

G, DENSITY = 9.81, 1500.0


def start(
    solids: list[dict[str, Any]], *, size: list[float], depth: float, resolution: int, **tables: Any
) -> SandSimulation:
    """Return a simulation of bodies over a bed of sand.

    Args:
        solids: the tables [[solid]].
        size: size of the domain [m].
        depth: depth of the bed [m].
        resolution: cells along the longest side.
        tables: further tables of the scene.
    """
    flat = len(size) == 2
    bed = {"shape": "box", "min": [0.0] * len(size), "max": [size[0], depth, *size[2:]]}
    scene = {
        "scene": {"simulator": "granular"},
        "time": {"duration": 1.0, "frames_per_second": 20},
        "domain": {"size": size, "resolution": resolution, "friction": 0.5},
        "physics": {"density": DENSITY, "gravity": [0.0, -G] if flat else [0.0, -G, 0.0]},
        "sand": [bed],
        "solid": solids,
    }
    for name, table in tables.items():
        scene[name] = {**scene.get(name, {}), **table} if isinstance(table, dict) else table
    return GranularSimulator().create(SandScene.model_validate(scene), device="cpu", folder=Path())


def height(simulation: SandSimulation) -> float:
    assert simulation.bodies is not None
    return float(simulation.bodies.bodies[0].position[1])


@pytest.mark.parametrize(
    ("ratio", "shallowest", "deepest", "speed", "cells"),
    [
        (5.0, 0.03, 0.09, 0.04, 24),
        *map(slow, [(5.0, 0.03, 0.09, 0.04, 48), (0.2, 0.0, 0.016, 0.01, 48)]),
    ],
)
def test_a_light_ball_stays_on_top_and_a_heavy_one_digs_in_and_stops(
    ratio: float, shallowest: float, deepest: float, speed: float, cells: int
) -> None:
    """Light and heavy ball on sand.

    At a fifth of sand's density it leaves a dent of about a cell of 0.0125 m; at five times the
    density it sinks by most of its radius and then stops. It fell with up to 0.6 m/s.
    """
    sand = {"friction_angle": 26.565}  # sand of 30 degrees bears twice as much
    simulation = start(
        [ball([0.3, 0.28], 0.06, density=ratio * DENSITY)],
        size=[0.6, 0.4],
        depth=0.2,
        resolution=cells,
        material=sand,
    )
    advance(simulation, 0.35, simulation.scene.time.dt_max)
    before = height(simulation)
    advance(simulation, 0.4, simulation.scene.time.dt_max)
    assert shallowest <= 0.2 - (height(simulation) - 0.06) < deepest
    assert abs(before - height(simulation)) / 0.05 < speed


def test_sand_bears_a_block_and_the_floor_bears_both() -> None:
    """Loads of a block on sand and of both on the floor.

    A block on smooth-walled sand stays in place, and the floor's pressure is the weight of sand and
    block.
    """
    loads, forces, simulations = [], [], []
    for solids in ([box([0.2, 0.2], [0.4, 0.3], density=2.0 * DENSITY, friction=0.5)], []):
        simulation = start(
            solids, size=[0.6, 0.4], depth=0.2, resolution=48, domain={"friction": 0.0}
        )
        advance(simulation, 0.3, simulation.scene.time.dt_max)
        floor, pushes = [], []
        for _ in range(20):
            simulation.step(simulation.scene.time.dt_max)
            # The load on the floor is p - s_yy = p + a.
            pressure, deviator = simulation.stress.now.numpy()[:2, 1, 1, 1:-1]
            floor.append(
                (pressure + deviator).sum()
                * DENSITY
                * simulation.grid.spacing**2
                / simulation.stress.kick_dt
            )
            if simulation.carried is not None:
                pushes.append(simulation.carried.impulses()[0] / simulation.stress.kick_dt)
        loads.append(float(np.mean(floor)))
        forces += [np.mean(pushes, axis=0)] if pushes else []
        simulations.append(simulation)
    weight = 2.0 * DENSITY * 0.2 * 0.1 * G
    assert loads[0] - loads[1] == pytest.approx(weight, rel=0.05)
    # Without the half cell below the stresses.
    assert loads[1] == pytest.approx(DENSITY * 0.6 * 0.2 * G, rel=0.05)
    np.testing.assert_allclose(forces[0][:2], [0.0, weight], atol=0.01 * weight)
    assert abs(forces[0][2]) < 0.001 * weight * 0.2
    body = simulations[0].bodies
    assert body is not None
    assert np.abs(body.bodies[0].velocity).max() < 0.01
    assert (
        abs(body.bodies[0].position[0] - 0.3) < 1e-3
        and 0.238 < body.bodies[0].position[1] <= 0.2505
    )
    assert abs(np.degrees(body.bodies[0].angle)) < 0.5


@pytest.mark.parametrize("friction", [0.25, 0.7, slow(0.0)])
def test_a_block_on_a_slope_of_firm_sand_slides_as_coulomb_says(friction: float) -> None:
    """Block on a slope of firm sand, by Coulomb's law.

    On 25 degrees it accelerates by g (sin - mu cos), or stays where friction exceeds the slope.
    """
    slope = np.radians(25.0)
    gravity = [G * float(np.sin(slope)), -G * float(np.cos(slope))]
    block = box([0.1, 0.15], [0.4, 0.25], density=DENSITY, friction=friction)
    simulation = start(
        [block],
        size=[0.9, 0.35],
        depth=0.15,
        resolution=54,
        physics={"gravity": gravity, "density": DENSITY},
        material={"friction_angle": 37.5},
    )
    advance(simulation, 0.06, simulation.scene.time.dt_max)  # it falls a part of a cell first
    assert simulation.bodies is not None
    before = simulation.bodies.bodies[0].velocity[0]
    advance(simulation, 0.2, simulation.scene.time.dt_max)
    gained = (simulation.bodies.bodies[0].velocity[0] - before) / 0.14
    expected = G * (np.sin(slope) - friction * np.cos(slope))
    if expected > 0.0:
        assert gained == pytest.approx(expected, rel=0.15)
    else:
        assert simulation.bodies.bodies[0].velocity[0] < 0.05


def test_densities_from_a_thousandth_of_sands_to_a_thousand_times_it() -> None:
    """Density ratios from 1e-3 to 1e3.

    A ball half sunk needs about as many iterations as a fixed solid, however light; none is thrown.
    """
    iterations, sunk = {}, {}
    for ratio in (None, 1e-3, 1.0, 1e3):
        solid = ball([0.3, 0.2], 0.06, density=DENSITY * (ratio or 1.0))
        if ratio is None:
            del solid["density"]
        simulation = start([solid], size=[0.6, 0.4], depth=0.2, resolution=48)
        rows = [simulation.step(0.002) for _ in range(12)]
        iterations[ratio] = sum(row["solve_iterations"] for row in rows)
        assert max(row["max_speed"] for row in rows) < 1.0
        if simulation.bodies is not None:
            sunk[ratio] = 0.2 - height(simulation)
            assert np.abs(simulation.bodies.bodies[0].velocity).max() < 12 * 0.002 * G
    assert max(iterations[1e-3], iterations[1.0]) < 1.5 * iterations[None]
    assert max(abs(sunk[1e-3]), abs(sunk[1.0])) < 1e-3 < sunk[1e3] < 0.5 * G * 0.024**2 * 1.1


def test_momentum_of_sand_and_body_without_gravity() -> None:
    """Momentum of sand and body without gravity.

    A block of sand that flies into a free body gives it the momentum that it loses.
    """
    target = ball([0.42, 0.2], 0.06, density=DENSITY)
    simulation = start(
        [target],
        size=[0.8, 0.4],
        depth=0.1,
        resolution=64,
        physics={"gravity": [0.0, 0.0], "density": DENSITY},
        sand=[{"shape": "box", "min": [0.1, 0.14], "max": [0.3, 0.24], "velocity": [1.0, 0.0]}],
    )
    assert simulation.bodies is not None

    def momentum() -> tuple[float, float]:
        body = simulation.bodies.bodies[0].momentum  # type: ignore[union-attr]
        sand = simulation.particles.velocity.numpy().sum(axis=0) * simulation.particle_mass
        return float(sand[0] + body[0]), float(body[0])

    first, _ = momentum()
    advance(simulation, 0.16, simulation.scene.time.dt_max)
    last, taken = momentum()
    assert taken > 0.2 * first
    assert last == pytest.approx(first, rel=0.05)


def test_three_dimensions() -> None:
    """Bodies in 3-D: a light ball rests on sand, a pushed one rolls forward."""
    simulation = start(
        [ball([0.12, 0.128, 0.1], 0.05, density=400.0, velocity=[0.5, 0.0, 0.0], friction=0.8)],
        size=[0.3, 0.2, 0.2],
        depth=0.08,
        resolution=24,
    )
    advance(simulation, 0.1, simulation.scene.time.dt_max)
    assert simulation.bodies is not None
    body = simulation.bodies.bodies[0]
    assert 0.115 < body.position[1] < 0.13
    assert body.position[0] > 0.14 and 0.0 < body.velocity[0] < 0.5
    assert body.angular_velocity[2] < -1.0  # forward over sand: about -z
    assert abs(body.angular_velocity[0]) + abs(body.angular_velocity[1]) < 0.2 * abs(
        body.angular_velocity[2]
    )
    surfaces = [
        part for part in simulation.frame() if isinstance(part, Surface) and part.name == "bodies"
    ]
    assert len(surfaces) == 1


def test_continues_bit_for_bit() -> None:
    """Resumed simulation, equal bit for bit."""
    solids = [ball([0.3, 0.26], 0.05, density=3000.0), box([0.4, 0.21], [0.5, 0.28], density=500.0)]

    def make() -> SandSimulation:
        return start(solids, size=[0.6, 0.4], depth=0.2, resolution=30)

    first, second = make(), make()
    for _ in range(8):
        first.step(0.004)
    second.restore(first.state())
    for _ in range(4):
        first.step(0.004)
        second.step(0.004)
    after = second.state()
    for name, value in first.state().items():
        assert np.array_equal(value, after[name]), name


def test_a_failed_solve_leaves_the_bodies_where_they_were(monkeypatch: pytest.MonkeyPatch) -> None:
    """Failed solve: bodies get neither gravity nor an impulse.

    The stresses of the step are not finite.
    """
    simulation = start(
        [ball([0.3, 0.27], 0.05, density=3000.0)], size=[0.6, 0.4], depth=0.2, resolution=30
    )
    simulation.step(0.004)
    assert simulation.bodies is not None
    before = simulation.bodies.state()["bodies"].copy()
    monkeypatch.setattr(simulation.stress, "residual", lambda: (float("nan"), 0.0))
    with pytest.raises(SimulationFailed, match="not finite"):
        simulation.step(0.004)
    assert np.array_equal(simulation.bodies.state()["bodies"], before)


class UnconvergedSolve:
    """Replacement of a solve with stresses that leave a residual."""

    def __init__(self, stress: Stress, residual: float) -> None:
        self.stress, self.residual = stress, residual

    def __call__(self, scale: float) -> wl.SolveResult:
        self.stress.now.fill_(7.0)
        self.stress.residual()
        self.stress.last_residual = self.residual * scale, 0.0
        history = [wl.Record(0, 5.0 * scale, 0, None, "start", 0.0)]
        return wl.SolveResult(
            self.stress.now,
            wl.SolveStatus.STAGNATED,
            310,
            310,
            self.residual * scale,
            self.residual / 5.0,
            history,
        )


def test_stresses_that_are_far_off_fail_a_step_that_can_be_taken_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Retry of a step with a large residual of the stresses.

    The retry is that of a simulation that never failed, bit for bit. Stresses with a small residual
    are accepted.
    """
    twins = [
        start([ball([0.3, 0.27], 0.05, density=3000.0)], size=[0.6, 0.4], depth=0.2, resolution=30)
        for _ in range(2)
    ]
    for simulation in twins:
        simulation.step(0.004)
    with monkeypatch.context() as patch:
        patch.setattr(twins[0], "solve_stress", UnconvergedSolve(twins[0].stress, 1.5 * FAR))
        with pytest.raises(
            StepFailed,
            match=r"STAGNATED after 310 iterations at a residual of 1.50e\+00 rho g dx .*may "
            r"enclose sand",
        ):
            twins[0].step(0.004)
    for simulation in twins:
        simulation.step(0.002)
    first, second = (simulation.state() for simulation in twins)
    for name, value in first.items():
        assert np.array_equal(value, second[name]), name
    monkeypatch.setattr(twins[0], "solve_stress", UnconvergedSolve(twins[0].stress, 0.9 * FAR))
    assert twins[0].step(0.001)["solve_status"] == "STAGNATED"


@pytest.mark.parametrize(
    ("table", "key"),
    [
        ({"solver": {"method": "interleaved-sweeps"}}, "method"),
        ({"domain": {"periodic": [True, False]}}, "periodic"),
    ],
)
def test_scenes_unsupported_with_bodies_are_refused(table: dict[str, Any], key: str) -> None:
    with pytest.raises(ValidationError, match=key):
        start(
            [ball([0.3, 0.27], 0.05, density=3000.0)],
            size=[0.6, 0.4],
            depth=0.2,
            resolution=30,
            **table,
        )


@pytest.mark.parametrize("name", ["balls-on-sand-2d", "carried-box-2d"])
def test_built_in_scenes(name: str) -> None:
    """Built-in scenes: they start, and bodies are in free fall."""
    scene = load_scene(name)
    simulation = GranularSimulator().create(scene, device="cpu", folder=Path())
    rows = [simulation.step(0.004) for _ in range(3)]
    assert simulation.bodies is not None
    assert len(simulation.bodies.bodies) == len(scene.solid) >= 2
    assert -3.1 * 0.004 * G < rows[-1]["body1_vy"] < 0.0
