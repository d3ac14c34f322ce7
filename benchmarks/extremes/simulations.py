"""Families of simulations: time steps, gravity, speeds and particles that no sensible scene has. Nothing may be lost or become NaN."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.benchmarks.extremes.case import PRECISIONS, Attempt, Case, Expected, Promise
from warp_lcp.benchmarks.extremes.problem import GridProblem
from warp_lcp.fluids import SIMULATOR as FLUIDS
from warp_lcp.fluids import LiquidScene, LiquidSimulation
from warp_lcp.granular import SIMULATOR as GRANULAR
from warp_lcp.granular.scene import SandScene
from warp_lcp.granular.simulator import SandSimulation
from warp_lcp.grid.particles import MARGIN
from warp_lcp.simulation import SimulationFailed, StepFailed

ParticleSimulation = LiquidSimulation | SandSimulation
DONE = Promise(Expected.DONE)
STEPS = 5
BUDGET = 20.0  # seconds of a precision
CROWD = 1_000_000  # particles in one cell; CROWDED once, with the memory that takes
CROWDED = 10_000_000


def ended_with(names: str) -> Promise:
    """Return the promise of a simulation that ends with a message that contains `names`."""
    return Promise(Expected.STOPPED, frozenset({f"failed: {names}"}), names)


@dataclass(frozen=True)
class RunCase:
    """A simulation that takes a few steps.

    Args:
        family: the cases that share an expectation.
        name: unique in its family.
        make: returns it, for a precision and a device.
        dt: of every step [s]; what the CFL number allows if None.
        steps: how many.
        prepare: changes it before the first step.
        check: returns what is wrong with it afterwards, besides what is checked of all.
        expected: what it must come to.
        leaves: whether particles may leave.
        budget: seconds a precision may take.
        precisions: those of the pressure solve that it is tried in.
    """

    family: str
    name: str
    make: Callable[[str, str], ParticleSimulation]
    dt: float | None = None
    steps: int = STEPS
    prepare: Callable[[ParticleSimulation], object] = lambda simulation: None
    check: Callable[[ParticleSimulation], list[str]] = lambda simulation: []
    expected: Promise = DONE
    leaves: bool = False
    budget: float = BUDGET
    precisions: tuple[str, ...] = PRECISIONS

    def promise(self, precision: str) -> Promise:
        """Return what it must come to."""
        return self.expected

    def attempt(self, precision: str, device: str) -> Attempt:
        """Make it and step."""
        simulation = self.make(precision, device)
        self.prepare(simulation)
        before, recorded = simulation.particles.count, list[Mapping[str, np.ndarray]]()
        if isinstance(simulation, LiquidSimulation) and simulation.bodies is None:  # a record has no place for the bodies' term
            simulation.record = recorded.append
        status, message, begun = "done", "", time.perf_counter()
        try:
            for _ in range(self.steps):
                simulation.step(usual_dt(simulation) if self.dt is None else self.dt)
        except (StepFailed, SimulationFailed, ValueError) as error:
            named = self.expected.names and self.expected.names in str(error)
            status, message = f"failed: {self.expected.names if named else type(error).__name__}", str(error)
        wp.synchronize_device(device)
        attempt = Attempt(status, None, time.perf_counter() - begun, message)
        if status == "done":
            attempt.faults += [*lost(simulation, before, leaves=self.leaves), *self.check(simulation)]
            if recorded and isinstance(simulation, LiquidSimulation):
                attempt.residual, fault = independent(recorded[-1], simulation)
                attempt.faults += fault
        return attempt


def usual_dt(simulation: ParticleSimulation) -> float:
    """Return the time step [s] that a run would take."""
    limits = simulation.scene.time
    return min(max(simulation.stable_dt(), limits.dt_min), limits.dt_max)


def lost(simulation: ParticleSimulation, before: int, *, leaves: bool) -> list[str]:
    """Return what is wrong with the particles after a run."""
    wrong, position, velocity = [], simulation.particles.position.numpy(), simulation.particles.velocity.numpy()
    if not leaves and simulation.particles.count != before:
        wrong.append(f"{simulation.particles.count} particles of {before}")
    if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
        wrong.append("particles that are not finite")
    size = np.array([*simulation.scene.domain.size, 0.0][:3])
    if ((position < 0) | (position > size * (1 + 1e-6))).any():
        wrong.append("particles outside the domain")
    return wrong


def independent(kept: Mapping[str, np.ndarray], simulation: LiquidSimulation) -> tuple[float | None, list[str]]:
    """Return the relative residual of the last pressure, from the recorded arrays alone, and what is wrong with it."""
    faces = {name: kept[name] for name in ("face_x", "face_y", "face_z") if name in kept}
    problem = GridProblem(
        cells=kept["cells"].astype(int), b=kept["b"], lower=kept["lower"], upper=kept["upper"], faces=faces, shift=kept.get("shift")
    )
    exact = problem.exact()
    x = problem.unknowns(simulation.grid.interior(simulation.projection.pressure.numpy()))
    own, reference = exact.residual(x), exact.residual(exact.start)
    wanted = max(float(kept["absolute_tolerance"]), float(kept["tolerance"]) * reference)
    rounding = 4 * float(np.finfo(np.float32).eps) * exact.sizes(x)
    fault = [] if own <= 1.01 * wanted + rounding else [f"the pressure's residual is {own:.1e}, asked for {wanted:.1e}"]
    return (own / reference if reference > 0 else own), fault


def liquid(precision: str, device: str, **tables: Any) -> ParticleSimulation:
    """Return a small dam break, whose tables may be overwritten."""
    time_table = {"duration": 10.0, "dt_max": 10.0, "dt_min": 1e-12} | tables.pop("time", {})
    data = {
        "scene": {"simulator": "fluids"},
        "time": time_table,
        "domain": {"size": [1.0, 0.5], "resolution": 16} | tables.pop("domain", {}),
        "solver": {"precision": precision},
        "liquid": [{"shape": "box", "min": [0.0, 0.0], "max": [0.375, 0.375], "velocity": tables.pop("velocity", [0.0, 0.0])}],
    }
    return FLUIDS.create(LiquidScene.model_validate(data | tables), device=device, folder=Path())


def sand(precision: str, device: str, **tables: Any) -> ParticleSimulation:
    """Return a small column of sand; its solver has one precision."""
    data = {
        "scene": {"simulator": "granular"},
        "time": {"duration": 10.0, "dt_max": 10.0, "dt_min": 1e-12} | tables.pop("time", {}),
        "domain": {"size": [1.0, 0.5], "resolution": 16},
        "sand": [{"shape": "box", "min": [0.0, 0.0], "max": [0.375, 0.375], "velocity": tables.pop("velocity", [0.0, 0.0])}],
    }
    return GRANULAR.create(SandScene.model_validate(data | tables), device=device, folder=Path())


def made(kind: Callable[..., ParticleSimulation], **tables: Any) -> Callable[[str, str], ParticleSimulation]:
    """Return what makes the scene."""
    return lambda precision, device: kind(precision, device, **{k: dict(v) if isinstance(v, dict) else v for k, v in tables.items()})


def steps_and_forces() -> Iterator[Case]:
    """Yield time steps from 1e-9 to 10 s, CFL numbers from 0.01 to 50, gravity from none to 1e6 m/s^2, speeds to 1e6 m/s."""
    for kind, precisions in ((liquid, PRECISIONS), (sand, ("single",))):
        family = "liquid" if kind is liquid else "sand"
        more: dict[str, Any] = {"precisions": precisions}
        for dt in (1e-9, 1e-6, 1e-3, 0.1, 1.0, 10.0):
            yield RunCase(family, f"dt = {dt:g} s", made(kind), dt=dt, **more)
        for cfl in (0.01, 0.1, 1.0, 10.0, 50.0):
            yield RunCase(family, f"CFL {cfl:g}", made(kind, time={"cfl": cfl}), **more)
        for g in (0.0, 1e-9, 1e3, 1e6):
            yield RunCase(
                family, f"gravity of {g:g} m/s^2", made(kind, physics={"gravity": [0.0, -g]}), dt=0.01 if g == 0 else None, **more
            )
        yield RunCase(family, "gravity sideways and up", made(kind, physics={"gravity": [300.0, 400.0]}), **more)
        for speed in ([1e6, 0.0], [-1e6, 1e6], [1e-6, 0.0]):
            yield RunCase(family, f"speed of {speed} m/s", made(kind, velocity=speed), **more)
        yield RunCase(family, "1e6 m/s for 1 s a step", made(kind, velocity=[1e6, 0.0]), dt=1.0, **more)
        for bad in (0.0, -1.0, np.nan, np.inf):
            yield RunCase(family, f"dt = {bad}", made(kind), dt=bad, expected=ended_with("dt ="), **more)
        still = {"physics": {"gravity": [0.0, 0.0]}}
        yield RunCase(
            family, "at rest without gravity", made(kind, **still), dt=0.1, check=at_rest if kind is liquid else all_but_at_rest, **more
        )
    yield RunCase(
        "liquid", "all sides open", made(liquid, domain={"open": ["left", "right", "top", "bottom"]}, velocity=[9.0, 0.0]), leaves=True
    )
    yield RunCase("liquid", "full and closed", made(liquid, liquid=[{"shape": "box", "min": [0, 0], "max": [1, 0.5], "velocity": [3, 1]}]))
    yield RunCase("liquid", "free-slip, full and closed", made(
        liquid, domain={"wall": "free-slip"}, liquid=[{"shape": "box", "min": [0, 0], "max": [1, 0.5], "velocity": [3, 1]}]
    ))  # fmt: skip
    yield RunCase("liquid", "flat domain, 2 x 0.0625 m", made(liquid, domain={"size": [2.0, 0.0625], "resolution": 64}, liquid=[FLAT]))
    for density in (1e-6, 1e9):
        yield RunCase("liquid", f"density of {density:g} kg/m^3", made(liquid, physics={"density": density}))


def solids_and_depth() -> Iterator[Case]:
    """Yield 3-D liquid, and rigid bodies of 10^-8 to 10^8 of its density, solids that move too fast, and liquid between them."""
    family = "liquid, 3-D and with bodies"
    size = {"domain": {"size": [0.5, 0.5, 0.25], "resolution": 12}, "liquid": [COLUMN]}
    for dt in (1e-9, 0.1, 10.0):
        yield RunCase(family, f"3-D, dt = {dt:g} s", made(liquid, **size), dt=dt)
    yield RunCase(family, "3-D, gravity of 1e6 m/s^2", made(liquid, **size, physics={"gravity": [0.0, -1e6, 0.0]}))
    yield RunCase(family, "3-D, 1e6 m/s", made(liquid, **size | {"liquid": [COLUMN | {"velocity": [1e6, 1e5, -1e6]}]}))
    for ratio in (1e-8, 1e-4, 1e-2, 1.0, 1e4, 1e8):
        body = {"shape": "box", "min": [0.2, 0.14], "max": [0.4, 0.3], "density": 1000.0 * ratio}
        yield RunCase(family, f"a body of {ratio:g} of its density", made(liquid, solid=[body], liquid=[POND]), check=bodies_inside)
    for speed in (1e-6, 1.0, 1e3):
        motion = {"kind": "translation", "velocity": [speed, 0.0]}
        paddle = {"shape": "box", "min": [0.05, -0.1], "max": [0.15, 0.6], "motion": motion}
        yield RunCase(family, f"a paddle of {speed:g} m/s", made(liquid, solid=[paddle], liquid=[POND]))
    gap = [{"shape": "box", "min": [0.1, -0.1], "max": [0.4, 0.35]}, {"shape": "box", "min": [0.402, -0.1], "max": [0.9, 0.35]}]
    yield RunCase(family, "between solids 2 mm apart", made(liquid, solid=gap, liquid=[POND | {"max": [1.0, 0.45]}]))


COLUMN = {"shape": "box", "min": [0.0, 0.0, 0.0], "max": [0.25, 0.3, 0.25]}
POND = {"shape": "box", "min": [0.0, 0.0], "max": [1.0, 0.25]}


def bodies_inside(simulation: ParticleSimulation) -> list[str]:
    """Return which bodies have left the domain or are nowhere."""
    bodies = simulation.bodies.bodies if simulation.bodies is not None else []
    size = np.array([*simulation.scene.domain.size, 0.0][:3])
    return [f"a body is at {body.position}" for body in bodies if not ((body.position >= 0) & (body.position <= size)).all()]


FLAT = {"shape": "box", "min": [0.0, 0.0], "max": [0.5, 0.03]}


def at_rest(simulation: ParticleSimulation) -> list[str]:
    """Return that something moves, if it does."""
    speed = float(np.abs(simulation.particles.velocity.numpy()).max())
    return [] if speed <= 1e-6 else [f"moves at {speed:.1e} m/s"]


def all_but_at_rest(simulation: ParticleSimulation) -> list[str]:
    """Return that something moves by more than 1 % of a cell in 0.1 s, if it does: sand evens out how it is packed."""
    speed = float(np.abs(simulation.particles.velocity.numpy()).max())
    return [] if speed * 0.1 <= 0.01 * simulation.grid.spacing else [f"moves at {speed:.1e} m/s"]


def particles_anywhere() -> Iterator[Case]:
    """Yield particles on nodes, on walls, outside, all in one cell, and with values that are no numbers."""
    family = "particles"
    for kind in (liquid, sand):
        name = "liquid" if kind is liquid else "sand"
        more: dict[str, Any] = {"precisions": PRECISIONS if kind is liquid else ("single",)}
        yield RunCase(family, f"{name} on nodes", made(kind), prepare=on_nodes, **more)
        yield RunCase(family, f"{name} on walls and in corners", made(kind), prepare=on_walls, **more)
        yield RunCase(family, f"all {name} at one point", made(kind), prepare=at_one_point, **more)
        for where, bad in (("outside", 7.0), ("far outside", 1e30), ("just outside", -1e-3), ("at the far end", 1.0)):
            yield RunCase(family, f"{name} {where}", made(kind), prepare=placed(bad), expected=ended_with("outside the domain"), **more)
        for bad in (np.nan, np.inf):
            yield RunCase(family, f"{name} at {bad}", made(kind), prepare=placed(bad), expected=ended_with("position"), **more)
            yield RunCase(family, f"{name} of speed {bad}", made(kind), prepare=moving(bad), expected=ended_with("velocity"), **more)
        yield RunCase(family, f"{CROWD:.0e} of {name} in one cell", made(kind), prepare=crowded(CROWD), steps=2, **more)
    yield RunCase(
        family, f"{CROWDED:.0e} of liquid in one cell", made(liquid), prepare=crowded(CROWDED), steps=1, budget=90.0, precisions=("mixed",)
    )
    yield RunCase(
        family,
        "10^6 in a cell that flies",
        made(liquid, physics={"gravity": [0.0, 0.0]}),
        prepare=flying(CROWD),
        check=flies,
        dt=1e-3,
        steps=2,
    )


def changed(simulation: ParticleSimulation, change: Callable[[np.ndarray, np.ndarray], object]) -> None:
    """Change positions and velocities in place."""
    position, velocity = simulation.particles.position.numpy().copy(), simulation.particles.velocity.numpy().copy()
    change(position, velocity)
    simulation.particles.position.assign(position)
    simulation.particles.velocity.assign(velocity)


def on_nodes(simulation: ParticleSimulation) -> None:
    """Round all positions to nodes of the grid."""
    h = simulation.grid.spacing
    changed(simulation, lambda x, v: np.copyto(x, np.round(x / h) * h))


def on_walls(simulation: ParticleSimulation) -> None:
    """Put a third of the particles on the floor, a third on a wall, the first four into corners, as near to the far ends as any comes."""
    right, top = np.array(simulation.scene.domain.size) - MARGIN * simulation.grid.spacing

    def change(x: np.ndarray, v: np.ndarray) -> None:
        x[::3, 1], x[1::3, 0] = 0.0, 0.0
        x[:4, :2] = [[0.0, 0.0], [right, 0.0], [0.0, top], [right, top]]

    changed(simulation, change)


def at_one_point(simulation: ParticleSimulation) -> None:
    """Put all particles at one point."""
    changed(simulation, lambda x, v: x.__setitem__((slice(None), slice(0, 2)), [0.21, 0.11]))


def placed(value: float) -> Callable[[ParticleSimulation], object]:
    """Return what puts one particle there along x."""
    return lambda simulation: changed(simulation, lambda x, v: x.__setitem__((5, 0), value))


def moving(value: float) -> Callable[[ParticleSimulation], object]:
    """Return what gives one particle that speed along x."""
    return lambda simulation: changed(simulation, lambda x, v: v.__setitem__((5, 0), value))


def crowd(simulation: ParticleSimulation, count: int, speed: float) -> None:
    """Add particles in one cell of the air."""
    chance, h = np.random.default_rng(6007), simulation.grid.spacing
    position = np.zeros((count, 3), dtype=np.float32)
    position[:, :2] = (np.array([11, 5]) + chance.random((count, 2), dtype=np.float32)) * h
    velocity = np.zeros((count, 3), dtype=np.float32)
    velocity[:, 0] = speed
    simulation.particles.append(position, velocity)


def crowded(count: int) -> Callable[[ParticleSimulation], object]:
    """Return what adds a crowd at rest."""
    return lambda simulation: crowd(simulation, count, 0.0)


def flying(count: int) -> Callable[[ParticleSimulation], object]:
    """Return what adds a crowd that moves at 1 m/s."""
    return lambda simulation: crowd(simulation, count, 1.0)


def flies(simulation: ParticleSimulation) -> list[str]:
    """Return that the crowd is not as fast as it was, if it is not: sums of a million terms in float32."""
    speeds = simulation.particles.velocity.numpy()[:, 0]
    fast = speeds[speeds > 0.5]
    wrong = abs(float(fast.mean(dtype=np.float64)) - 1.0) if len(fast) else 1.0
    return [] if wrong <= 1e-3 and len(fast) >= CROWD else [f"a crowd of {len(fast)} has become {wrong:.1e} slower"]
