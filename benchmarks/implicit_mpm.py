"""Steps of sand against newton's implicit material point method: the same particles, cells, steps and friction, floor only."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.benchmarks.machine import machine
from warp_lcp.benchmarks.peers.foreign import Home, PeerFailed, Worker
from warp_lcp.benchmarks.record import Record, Results, Table
from warp_lcp.benchmarks.sand import collapse
from warp_lcp.benchmarks.targets import Target
from warp_lcp.benchmarks.timing import Figure, Options, ratios
from warp_lcp.granular import SIMULATOR
from warp_lcp.granular.scene import SandScene

TITLE = "Steps of sand against newton's implicit MPM"
NEWTON = Home("newton", "WARP_LCP_NEWTON_PYTHON", "implicit_mpm", "pip install newton, in a venv of its own, and name its interpreter")
SIZES = (32, 48)  # cells along the domain's longest side
STEPS = 60  # at most 5 ms each: from the release until the sand spreads
LENGTH, FRICTION = 0.96, 0.577  # [m]; slope of the cone and coefficient of the floor
# newton as it comes; with the grid that is faster here and gives the same; and that with a looser tolerance (its own: 1e-4)
VARIANTS: dict[str, dict[str, str | float]] = {
    "defaults": {},
    "dense grid": {"grid_type": "dense"},
    "dense grid, tolerance 1e-3": {"grid_type": "dense", "tolerance": 1e-3},
}
JUDGED = "dense grid"


@dataclass(frozen=True)
class Collapse:
    """Steps of one program.

    Args:
        seconds: of each step [s].
        iterations: of each step.
        start: positions at the start [m], shape (particles, 3).
        end: positions at the end.
    """

    seconds: list[float]
    iterations: list[int]
    start: np.ndarray
    end: np.ndarray

    def figures(self) -> dict[str, Figure]:
        """Return a step's seconds and iterations, and the shape of the pile."""
        center = self.start[:, [0, 2]].mean(axis=0)
        radius = [np.percentile(np.hypot(*(p[:, [0, 2]] - center).T), 99) for p in (self.start, self.end)]
        return {
            "step": Figure.of(self.seconds, "s"),
            "mean_step": Figure(float(np.mean(self.seconds)), "s"),
            "iterations": Figure.of([float(i) for i in self.iterations]),
            "runout": Figure(float(radius[1] - radius[0]), "m"),
            "height": Figure(float(np.percentile(self.end[:, 1], 99)), "m"),
        }


def measure(options: Options, out: Path) -> Results:
    """Run both at the sizes asked for."""
    records = [machine(options.device, elements=1 << 22, repeat=options.repeat)]
    python = NEWTON.interpreter()
    worker = None if python is None else Worker(NEWTON, python)
    version = NEWTON.missing() if worker is None else worker.version
    records[0].facts["peers"] = {"newton": version}
    if worker is None:
        options.say(f"newton: {version}")
    try:
        for n in options.sizes or SIZES:
            records += _measure_size(n, worker, options)
    finally:
        if worker is not None:
            worker.close()
    rows = [[r.name, *("" if (f := r.figures.get(k)) is None else str(f) for k in FIGURES), r.facts.get("remark", "")] for r in records[1:]]
    remark = (
        f"newton {version}. Both take the same particles, cells and time steps; only the floor is in reach. Each stops by a measure of its "
        "own: ours where the natural residual of the stresses is below 1e-3 rho g dx, newton's where its last sweeps changed the strain by "
        "less than the tolerance. runout and height tell that both computed the same collapse."
    )
    last = [r for r in records if r.facts.get("variant") == JUDGED]
    target = Target(f"newton's step ({JUDGED}) over ours", 1, last[-1].figures.get("over_ours") if last else None, " x", True)
    tables = [
        Table("Figure to reach", ["figure", "target", "measured", "met?"], [target.row()]),
        Table("Steps", ["case", *(k.replace("_", " ") for k in FIGURES), "remark"], rows, remark),
    ]
    return Results(records, tables)


FIGURES = ("particles", "step", "mean_step", "iterations", "over_ours", "runout", "height")


def _scene(n: int) -> SandScene:
    """Return a square column as high as wide in the middle of a wide floor."""
    domain = {"size": [LENGTH, LENGTH / 2, LENGTH], "resolution": n, "friction": FRICTION}
    block = [{"shape": "box", "min": [0.34, 0.0, 0.34], "max": [0.62, 0.28, 0.62]}]
    return collapse(n, domain=domain, physics={"gravity": [0.0, -9.81, 0.0]}, sand=block)


def _measure_size(n: int, worker: Worker | None, options: Options) -> list[Record]:
    """Run ours to learn the time steps, then both in turns, the peer in each of its variants."""
    options.say(f"sand at {n} cells")
    scene = _scene(n)
    ours, steps = _ours(scene, None, options.device)
    totals: dict[str, list[float]] = {"ours": []}
    theirs: dict[str, Collapse] = {}
    remark = NEWTON.missing() if worker is None else ""
    for turn in range(options.repeat):
        options.say(f"sand at {n} cells, round {turn + 1} of {options.repeat}")
        ours, _ = _ours(scene, steps, options.device)
        totals["ours"].append(sum(ours.seconds))
        for variant in VARIANTS:
            if worker is None or remark:
                break
            try:
                theirs[variant] = _newton(worker, scene, steps, ours.start, variant, options.device)
            except PeerFailed as error:
                remark = str(error)
                break
            totals.setdefault(variant, []).append(sum(theirs[variant].seconds))
    count = {"particles": Figure(len(ours.start))}
    records = [Record(f"{n} cells: warp_lcp", count | ours.figures(), {"n": n})]
    for variant in VARIANTS:
        name, facts = f"{n} cells: newton, {variant}", {"n": n, "variant": variant}
        if remark or variant not in theirs:
            records.append(Record(name, {}, facts | {"remark": remark}))
            continue
        over = {"over_ours": ratios(totals[variant], totals["ours"])}
        records.append(Record(name, count | theirs[variant].figures() | over, facts))
    return records


def _ours(scene: SandScene, steps: Sequence[float] | None, device: str) -> tuple[Collapse, list[float]]:
    """Run a scene through `steps`, or through those that its own stability asks for; return them too."""
    simulation: Any = SIMULATOR.create(scene, device=device, folder=Path())
    start = simulation.particles.position.numpy()[: simulation.particles.count].copy()
    seconds, iterations, taken = [], [], []
    for number in range(STEPS):
        dt = min(simulation.stable_dt(), scene.time.dt_max) if steps is None else steps[number]
        wp.synchronize_device(device)
        begun = time.perf_counter()
        row = simulation.step(dt)
        wp.synchronize_device(device)
        seconds.append(time.perf_counter() - begun)
        iterations.append(int(row["staggering_iterations"]))
        taken.append(dt)
    return Collapse(seconds, iterations, start, simulation.particles.position.numpy()[: simulation.particles.count].copy()), taken


def _newton(worker: Worker, scene: SandScene, steps: Sequence[float], start: np.ndarray, variant: str, device: str) -> Collapse:
    """Run newton from the same particles.

    Raises:
        PeerFailed: it did not get through.
    """
    dx = LENGTH / scene.domain.resolution
    with tempfile.TemporaryDirectory(prefix="newton-") as folder:
        positions, answer = Path(folder) / "start.npy", Path(folder) / "end.npy"
        np.save(positions, start.astype(np.float32))
        request = {
            "method": "collapse",
            "positions": str(positions),
            "answer": str(answer),
            "device": device,
            "steps": list(steps),
            "dx": dx,
            "particle_spacing": dx / scene.particles.per_axis,
            "density": scene.physics.density,
            "friction": FRICTION,
            "wall_friction": FRICTION,
            "settings": VARIANTS[variant],
        }
        reply = worker.ask(request)
        return Collapse(reply["seconds"], reply["iterations"], start, np.load(answer))
