"""Hostile simulations: extreme time steps, gravity, speeds and particles.

No particle may be lost and no value may become NaN.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import partial
from pathlib import Path
from types import EllipsisType

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from warp_lcp.benchmarks.extremes.case import (
    PRECISIONS,
    ExpectedOutcome,
    ExtremeAttempt,
    ExtremeCase,
    OutcomeKind,
    stopped,
)
from warp_lcp.benchmarks.extremes.problem import GridProblem
from warp_lcp.files import Tables, TableValue, TableView
from warp_lcp.fluids import SIMULATOR as FLUIDS
from warp_lcp.fluids import LiquidSimulation
from warp_lcp.granular import SIMULATOR as GRANULAR
from warp_lcp.granular.simulator import SandSimulation
from warp_lcp.grid.particle_loops import MARGIN
from warp_lcp.scene.simulator import Simulator
from warp_lcp.simulation import SimulationFailed, StepFailed

ParticleSimulation = LiquidSimulation | SandSimulation
DONE = ExpectedOutcome(OutcomeKind.DONE)
STEPS = 5
BUDGET = 20.0  # seconds of a case in one precision
CROWD = 1_000_000  # particles in one cell; tested once, since it needs much memory
CROWDED = 10_000_000


def ended_with(names: str) -> ExpectedOutcome:
    """Return the promise of a simulation that ends with a message containing `names`."""
    return stopped(f"failed: {names}", names)


@dataclass(frozen=True)
class RunCase(ExtremeCase):
    """Simulation of a few steps."""

    # Makes the simulation for a precision and a device.
    make: Callable[[str, str], ParticleSimulation]
    _: KW_ONLY
    dt: float | None = None  # length of every step [s]; by the CFL number if None
    steps: int = STEPS  # number of steps
    # Changes the simulation before the first step.
    prepare: Callable[[ParticleSimulation], object] = lambda simulation: None
    # Returns further faults, besides those that every case checks.
    check: Callable[[ParticleSimulation], list[str]] = lambda simulation: []
    leaves: bool = False  # whether particles may leave the domain
    expected: ExpectedOutcome = DONE
    budget: float = BUDGET

    def tried(self, precision: str, device: str) -> ExtremeAttempt:
        """Make the simulation and take its steps."""
        simulation = self.make(precision, device)
        self.prepare(simulation)
        before, recorded = simulation.particles.count, list[Mapping[str, np.ndarray]]()
        # A record cannot hold the term of the bodies.
        if isinstance(simulation, LiquidSimulation) and simulation.bodies is None:
            simulation.record = recorded.append
        status, message, start_time = "done", "", time.perf_counter()
        try:
            for _ in range(self.steps):
                simulation.step(usual_dt(simulation) if self.dt is None else self.dt)
        except (StepFailed, SimulationFailed, ValueError) as error:
            named = self.expected.names and self.expected.names in str(error)
            status, message = (
                f"failed: {self.expected.names if named else type(error).__name__}",
                str(error),
            )
        wp.synchronize_device(device)
        attempt = ExtremeAttempt(status, None, time.perf_counter() - start_time, message)
        if status == "done":
            attempt.faults += [
                *lost(simulation, before, leaves=self.leaves),
                *self.check(simulation),
            ]
            if recorded and isinstance(simulation, LiquidSimulation):
                attempt.residual, fault = independent(recorded[-1], simulation)
                attempt.faults += fault
        return attempt


def usual_dt(simulation: ParticleSimulation) -> float:
    """Return the time step [s] of an ordinary run."""
    limits = simulation.scene.time
    return min(max(simulation.stable_dt(), limits.dt_min), limits.dt_max)


def lost(simulation: ParticleSimulation, before: int, *, leaves: bool) -> list[str]:
    """Return faults of the particles after a run."""
    wrong, position, velocity = (
        [],
        simulation.particles.position.numpy(),
        simulation.particles.velocity.numpy(),
    )
    if not leaves and simulation.particles.count != before:
        wrong.append(f"{simulation.particles.count} particles of {before}")
    if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
        wrong.append("particles that are not finite")
    size = np.array([*simulation.scene.domain.size, 0.0][:3])
    if ((position < 0) | (position > size * (1 + 1e-6))).any():
        wrong.append("particles outside the domain")
    return wrong


def independent(
    saved: Mapping[str, np.ndarray], simulation: LiquidSimulation
) -> tuple[float | None, list[str]]:
    """Return the relative residual of the last pressure, and its faults.

    They are computed from the recorded arrays alone.
    """
    faces = {name: saved[name] for name in ("face_x", "face_y", "face_z") if name in saved}
    problem = GridProblem(
        cells=saved["cells"].astype(int),
        b=saved["b"],
        lower=saved["lower"],
        upper=saved["upper"],
        faces=faces,
        shift=saved.get("shift"),
    )
    exact = problem.exact()
    x = problem.unknowns(simulation.grid.interior(simulation.projection.pressure.numpy()))
    own_residual, reference = exact.residual(x), exact.residual(exact.start)
    wanted = max(float(saved["absolute_tolerance"]), float(saved["tolerance"]) * reference)
    rounding = 4 * float(np.finfo(np.float32).eps) * exact.sizes(x)
    fault = (
        []
        if own_residual <= 1.01 * wanted + rounding
        else [f"the pressure's residual is {own_residual:.1e}, asked for {wanted:.1e}"]
    )
    return (own_residual / reference if reference > 0 else own_residual), fault


@dataclass(frozen=True)
class ExtremeMaterial:
    """Column of material that all scenes start from; sand's solver has one precision."""

    name: str
    simulator: Simulator
    precisions: tuple[str, ...]


liquid, sand = (
    ExtremeMaterial("liquid", FLUIDS, PRECISIONS),
    ExtremeMaterial("sand", GRANULAR, ("single",)),
)


def box(low: Sequence[float], high: Sequence[float], **more: object) -> Tables:
    """Return the scene table of a box."""
    return {"shape": "box", "min": low, "max": high, **more}


def simulation_maker(
    kind: ExtremeMaterial, **tables: TableValue
) -> Callable[[str, str], ParticleSimulation]:
    """Return a function that makes a small column.

    The scene's tables may be overridden. `velocity` is that of the column.
    """

    def make(precision: str, device: str) -> ParticleSimulation:
        usual: Tables = {
            "time": {"duration": 10.0, "dt_max": 10.0, "dt_min": 1e-12},
            "domain": {"size": [1.0, 0.5], "resolution": 16},
        }
        data: Tables = {name: values | tables.get(name, {}) for name, values in usual.items()}
        data["scene"] = {"simulator": kind.simulator.name}
        data[kind.name] = [
            box([0.0, 0.0], [0.375, 0.375], velocity=tables.get("velocity", [0.0, 0.0]))
        ]
        data |= {"solver": {"precision": precision}} if kind is liquid else {}
        data |= {
            name: values for name, values in tables.items() if name not in (*usual, "velocity")
        }
        simulation = kind.simulator.create(
            kind.simulator.scene_model.model_validate(data), device=device, folder=Path()
        )
        assert isinstance(simulation, ParticleSimulation)
        return simulation

    return make


def steps_and_forces() -> Iterator[ExtremeCase]:
    """Yield extreme time steps, CFL numbers, gravity and speeds.

    Time steps are from 1e-9 to 10 s, CFL numbers from 0.01 to 50, gravity from 0 to 1e6 m/s^2,
    speeds up to 1e6 m/s.
    """
    for kind in (liquid, sand):

        def case(
            name: str,
            kind: ExtremeMaterial = kind,
            *,
            tables: TableView | None = None,
            **more: TableValue,
        ) -> RunCase:
            return RunCase(
                kind.name,
                name,
                simulation_maker(kind, **(tables or {})),
                precisions=kind.precisions,
                **more,
            )

        for dt in (1e-9, 1e-6, 1e-3, 0.1, 1.0, 10.0):
            yield case(f"dt = {dt:g} s", dt=dt)
        for cfl in (0.01, 0.1, 1.0, 10.0, 50.0):
            yield case(f"CFL {cfl:g}", tables={"time": {"cfl": cfl}})
        for g in (0.0, 1e-9, 1e3, 1e6):
            yield case(
                f"gravity of {g:g} m/s^2", tables=gravity(0.0, -g), dt=0.01 if g == 0 else None
            )
        yield case("gravity sideways and up", tables=gravity(300.0, 400.0))
        for speed in ([1e6, 0.0], [-1e6, 1e6], [1e-6, 0.0]):
            yield case(f"speed of {speed} m/s", tables={"velocity": speed})
        # Liquid must be incompressible alone. Sand's stresses miss their tolerance and would raise
        # its energy by a fifth.
        far = ended_with("would add energy to the sand") if kind is sand else DONE
        yield case("1e6 m/s for 1 s a step", tables={"velocity": [1e6, 0.0]}, dt=1.0, expected=far)
        for bad in (0.0, -1.0, np.nan, np.inf):
            yield case(f"dt = {bad}", dt=bad, expected=ended_with("dt ="))
        still = at_rest if kind is liquid else all_but_at_rest
        yield case("at rest without gravity", tables=gravity(0.0, 0.0), dt=0.1, check=still)
    all_open = simulation_maker(
        liquid, domain={"open": ["left", "right", "top", "bottom"]}, velocity=[9.0, 0.0]
    )
    yield RunCase("liquid", "all sides open", all_open, leaves=True)
    whole = [box([0, 0], [1, 0.5], velocity=[3, 1])]
    yield RunCase("liquid", "full and closed", simulation_maker(liquid, liquid=whole))
    yield RunCase(
        "liquid",
        "free-slip, full and closed",
        simulation_maker(liquid, domain={"wall": "free-slip"}, liquid=whole),
    )
    flat = simulation_maker(
        liquid,
        domain={"size": [2.0, 0.0625], "resolution": 64},
        liquid=[box([0.0, 0.0], [0.5, 0.03])],
    )
    yield RunCase("liquid", "flat domain, 2 x 0.0625 m", flat)
    for density in (1e-6, 1e9):
        yield RunCase(
            "liquid",
            f"density of {density:g} kg/m^3",
            simulation_maker(liquid, physics={"density": density}),
        )


def gravity(*components: float) -> Tables:
    """Return the scene tables of a gravity [m/s^2]."""
    return {"physics": {"gravity": list(components)}}


def solids_and_depth() -> Iterator[ExtremeCase]:
    """Yield 3-D liquid, rigid bodies of extreme density, and fast solids.

    Density ratios are 10^-8 to 10^8. Some solids move too fast, and some press liquid between them.
    """
    case, pond = partial(RunCase, "liquid, 3-D and with bodies"), [box([0.0, 0.0], [1.0, 0.25])]
    column, size = (
        box([0.0, 0.0, 0.0], [0.25, 0.3, 0.25]),
        {"domain": {"size": [0.5, 0.5, 0.25], "resolution": 12}},
    )
    deep = partial(simulation_maker, liquid, **size, liquid=[column])
    for dt in (1e-9, 0.1, 10.0):
        yield case(f"3-D, dt = {dt:g} s", deep(), dt=dt)
    yield case("3-D, gravity of 1e6 m/s^2", deep(**gravity(0.0, -1e6, 0.0)))
    yield case("3-D, 1e6 m/s", deep(liquid=[column | {"velocity": [1e6, 1e5, -1e6]}]))
    for ratio in (1e-8, 1e-4, 1e-2, 1.0, 1e4, 1e8):
        body = box([0.2, 0.14], [0.4, 0.3], density=1000.0 * ratio)
        yield case(
            f"a body of {ratio:g} of its density",
            simulation_maker(liquid, solid=[body], liquid=pond),
            check=bodies_inside,
        )
    for speed in (1e-6, 1.0, 1e3):
        paddle = box(
            [0.05, -0.1], [0.15, 0.6], motion={"kind": "translation", "velocity": [speed, 0.0]}
        )
        yield case(
            f"a paddle of {speed:g} m/s", simulation_maker(liquid, solid=[paddle], liquid=pond)
        )
    gap = [box([0.1, -0.1], [0.4, 0.35]), box([0.402, -0.1], [0.9, 0.35])]
    yield case(
        "between solids 2 mm apart",
        simulation_maker(liquid, solid=gap, liquid=[box([0.0, 0.0], [1.0, 0.45])]),
    )


def bodies_inside(simulation: ParticleSimulation) -> list[str]:
    """Return a fault for each body that has left the domain or has a position of NaN."""
    bodies = simulation.bodies.bodies if simulation.bodies is not None else []
    size = np.array([*simulation.scene.domain.size, 0.0][:3])
    return [
        f"a body is at {body.position}"
        for body in bodies
        if not ((body.position >= 0) & (body.position <= size)).all()
    ]


def at_rest(simulation: ParticleSimulation, most: float = 1e-6) -> list[str]:
    """Return a fault if something moves."""
    speed = float(np.abs(simulation.particles.velocity.numpy()).max())
    return [] if speed <= most else [f"moves at {speed:.1e} m/s"]


def all_but_at_rest(simulation: ParticleSimulation) -> list[str]:
    """Return a fault if something moves by more than 1 % of a cell in 0.1 s.

    Sand rearranges its packing and so moves slightly.
    """
    return at_rest(simulation, 0.1 * simulation.grid.spacing)


def particles_anywhere() -> Iterator[ExtremeCase]:
    """Yield particles on nodes, on walls, outside, in one cell, and with NaN."""
    for kind in (liquid, sand):
        name, case = (
            kind.name,
            partial(RunCase, "particles", make=simulation_maker(kind), precisions=kind.precisions),
        )
        yield case(f"{name} on nodes", prepare=on_nodes)
        yield case(f"{name} on walls and in corners", prepare=on_walls)
        yield case(
            f"all {name} at one point",
            prepare=put("position", (slice(None), slice(0, 2)), [0.21, 0.11]),
        )
        for where, bad in (
            ("outside", 7.0),
            ("far outside", 1e30),
            ("just outside", -1e-3),
            ("at the far end", 1.0),
        ):
            yield case(
                f"{name} {where}",
                prepare=put("position", (5, 0), bad),
                expected=ended_with("outside the domain"),
            )
        for bad in (np.nan, np.inf):
            yield case(
                f"{name} at {bad}",
                prepare=put("position", (5, 0), bad),
                expected=ended_with("position"),
            )
            yield case(
                f"{name} of speed {bad}",
                prepare=put("velocity", (5, 0), bad),
                expected=ended_with("velocity"),
            )
        yield case(f"{CROWD:.0e} of {name} in one cell", prepare=crowd(CROWD), steps=2)
    more = {"prepare": crowd(CROWDED), "steps": 1, "budget": 90.0, "precisions": ("mixed",)}
    crowded = simulation_maker(liquid)
    yield RunCase("particles", f"{CROWDED:.0e} of liquid in one cell", crowded, **more)  # type: ignore[arg-type]
    weightless = simulation_maker(liquid, **gravity(0.0, 0.0))
    yield RunCase(
        "particles",
        "10^6 in a cell that flies",
        weightless,
        prepare=crowd(CROWD, 1.0),
        check=flies,
        dt=1e-3,
        steps=2,
    )


ArrayIndex = slice | EllipsisType | np.ndarray | tuple[int | slice, ...]  # of an array


def put(field: str, at: ArrayIndex, value: ArrayLike) -> Callable[[ParticleSimulation], None]:
    """Return a function that overwrites some positions or velocities of particles."""

    def change(simulation: ParticleSimulation) -> None:
        array = getattr(simulation.particles, field)
        changed = array.numpy().copy()
        changed[at] = value
        array.assign(changed)

    return change


def on_nodes(simulation: ParticleSimulation) -> None:
    """Round all positions to nodes of the grid."""
    h = simulation.grid.spacing
    put("position", ..., np.round(simulation.particles.position.numpy() / h) * h)(simulation)


def on_walls(simulation: ParticleSimulation) -> None:
    """Put a third of the particles on the floor and a third on a wall.

    The first four are in the corners, as near to the far sides as any particle may be.
    """
    right, top = np.array(simulation.scene.domain.size) - MARGIN * simulation.grid.spacing
    put("position", (slice(0, None, 3), 1), 0.0)(simulation)
    put("position", (slice(1, None, 3), 0), 0.0)(simulation)
    put(
        "position", (slice(0, 4), slice(0, 2)), [[0.0, 0.0], [right, 0.0], [0.0, top], [right, top]]
    )(simulation)


def crowd(count: int, speed: float = 0.0) -> Callable[[ParticleSimulation], None]:
    """Return a function that adds particles to one cell of air.

    They have a speed [m/s] along x.
    """

    def add(simulation: ParticleSimulation) -> None:
        chance, position, velocity = (
            np.random.default_rng(6007),
            *(np.zeros((count, 3), dtype=np.float32) for _ in range(2)),
        )
        position[:, :2] = (
            np.array([11, 5]) + chance.random((count, 2), dtype=np.float32)
        ) * simulation.grid.spacing
        velocity[:, 0] = speed
        simulation.particles.append(position, velocity)

    return add


def flies(simulation: ParticleSimulation) -> list[str]:
    """Return a fault if the crowd has changed its speed.

    Its momentum is a sum of a million terms in float32.
    """
    speeds = simulation.particles.velocity.numpy()[:, 0]
    fast = speeds[speeds > 0.5]
    wrong = abs(float(fast.mean(dtype=np.float64)) - 1.0) if len(fast) else 1.0
    return (
        []
        if wrong <= 1e-3 and len(fast) >= CROWD
        else [f"a crowd of {len(fast)} has become {wrong:.1e} slower"]
    )
