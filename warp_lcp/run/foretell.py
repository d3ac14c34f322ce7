"""What a run will take before it has begun: its steps, seconds and bytes, and what in its scene was hardly meant."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import cast

import numpy as np

from warp_lcp.frames.frames import frame_bytes
from warp_lcp.grid.particles import lattice
from warp_lcp.material.particle_assembly import inside
from warp_lcp.material.particle_scene import ParticleScene
from warp_lcp.material.particle_simulation import ParticleSimulation
from warp_lcp.scene.models import predicted_seconds, prices
from warp_lcp.scene.scene import Scene
from warp_lcp.simulation import Cells, Part, Points, Simulation

FASTEST = 1.0  # of the speed that the whole fall of the material gives: what steps are as long as, see docs/models.md
MANY_FRAMES = 10_000
PIECE = 0.5  # of a step that a frame cuts off
FULL = 0.98  # of the cells: what solids fill is a mistake, most often an inverted shape
BURIED = 0.5  # of a material's points: less than that is how one fills a vessel
LOG_BYTES = 14  # an entry


def foretold(scene: Scene, simulation: Simulation, seconds: float | None = None) -> list[tuple[str, str]]:
    """Return how many steps, seconds and bytes a run will take, as pairs of a word and a line.

    Args:
        scene: what would run.
        simulation: where it begins.
        seconds: a step, as measured; None: by the list of prices.
    """
    if not (isinstance(scene, ParticleScene) and isinstance(simulation, ParticleSimulation)):
        return []
    steps = expected_steps(scene, simulation)
    if seconds is None:
        cells, particles = math.prod(simulation.grid.counts), scene.particle_estimate()
        seconds = predicted_seconds(scene.models(), prices(scene.scene.simulator, scene.dimension), cells, particles)
        where = "by the list of prices, on one core"
    else:
        where = "as measured"
    whole = steps * seconds
    lasts = timedelta(seconds=round(whole)) if whole >= 10.0 else f"{whole:.2g} s"
    return [
        ("steps", f"about {steps:,}"),
        *([("whole run", f"about {lasts} {where}, {1e3 * seconds:.3g} ms a step")] if seconds > 0.0 else []),
        ("disk", f"about {expected_bytes(scene, cast(Simulation, simulation), steps) / 1e6:,.3g} MB"),
    ]


def expected_speed(scene: ParticleScene, simulation: ParticleSimulation) -> float:
    """Return the speed that the steps of a run will be as long as [m/s]: of the start, of sources, solids, and of the fall to come."""
    totals, g = simulation.particles.totals(), float(np.linalg.norm(simulation.gravity))
    driven = [part.top_speed(0.0, scene.time.duration) for part in (simulation.boundary, simulation.sources) if part is not None]
    falls = [_fall(scene, simulation)]
    falls += [float(bounds[0][1]) for source in scene.source if (bounds := source.bounds(scene.dimension)) is not None]  # to the floor
    return max(totals.max_speed, *driven, FASTEST * math.sqrt(2.0 * g * max(falls)))


def _fall(scene: ParticleScene, simulation: ParticleSimulation) -> float:
    """Return how far the material's center will sink until it lies on the floor [m]."""
    totals = simulation.particles.totals()
    if totals.count == 0:
        return 0.0
    size, grid = scene.domain.size, simulation.grid
    volume = totals.count * grid.cell_volume / scene.particles.per_axis**grid.dimension
    level = volume / float(np.prod([side for axis, side in enumerate(size) if axis != 1]))
    return max(float(totals.center[1]) - 0.5 * level, 0.0)


def expected_steps(scene: ParticleScene, simulation: ParticleSimulation) -> int:
    """Return about how many steps a run will take."""
    time, dx, g = scene.time, simulation.grid.spacing, float(np.linalg.norm(simulation.gravity))
    speed = expected_speed(scene, simulation) + math.sqrt(time.cfl * g * dx)
    longest = min(max(time.cfl * dx / speed if speed > 0.0 else math.inf, time.dt_min), time.dt_max)
    a_frame = time.duration / time.frame_count / longest  # whole steps: at one speed the next number, over a run's speeds half a step more
    return round(time.frame_count * max(a_frame + PIECE * min(a_frame, 1.0), 1.0))


def expected_bytes(scene: ParticleScene, simulation: Simulation, steps: int) -> int:
    """Return about how much a run will leave on the disk: frames, of as many particles as there will be, checkpoints and the log."""
    output, wanted = scene.output, {"particles": scene.output.particles, "grid": scene.output.grid}
    first, most = max(scene.particle_estimate(later=False), 1), scene.particle_estimate()
    leaves = bool(scene.drain or scene.domain.open)
    growth = 1.0 + 0.5 * (0.5 if leaves else 1.0) * (
        most / first - 1.0
    )  # the mean of a run: what comes in comes evenly, and half may leave
    frame = [_grown(part, growth) for part in simulation.frame() if wanted.get(part.name, True)]
    each = frame_bytes(frame, output.grid_format, surface_ply=output.surface_ply)
    state = sum(array.nbytes for array in simulation.state().values())
    log = steps * LOG_BYTES * (len(simulation.columns()) + 5)
    return round(each * (scene.time.frame_count + 1) + output.checkpoints_kept * state + log)


def _grown(part: Part, factor: float) -> Part:
    """Return points or cells of so many times as much material; other parts as they are."""
    if not isinstance(part, (Points, Cells)) or factor == 1.0:
        return part
    count = len(part.points) if isinstance(part, Points) else len(part.index)
    taken = np.resize(np.arange(count), round(factor * count))
    fields = {name: values[taken] for name, values in part.fields.items()}
    if isinstance(part, Points):
        return replace(part, fields=fields, points=part.points[taken])
    return replace(part, fields=fields, index=part.index[taken])


def doubts(scene: Scene, simulation: Simulation) -> Iterator[str]:
    """Yield what is allowed and was hardly meant, a line each: frames without end, solids that fill the domain, material inside solids."""
    frames, rate = scene.time.frame_count, scene.time.frames_per_second
    if frames > MANY_FRAMES:
        yield f"{frames:,} frames: time.duration {scene.time.duration:g} s at time.frames_per_second {rate:g}; were so many meant?"
    if not (isinstance(scene, ParticleScene) and isinstance(simulation, ParticleSimulation)):
        return
    if not scene.solid:
        return
    grid, (key, materials) = simulation.grid, scene.materials()
    planes = range(grid.origin[2], grid.origin[2] + grid.counts[2])
    points = np.concatenate([lattice(grid, 1, 0.0, 0, plane) for plane in planes])  # one a cell
    free = simulation.admits(points)
    if free.mean() < 1.0 - FULL:
        yield f"solids fill {100.0 - 100.0 * free.mean():.4g} % of the domain; a shape with invert = true is everything but itself"
    for number, material in enumerate(materials):
        mine = inside([material.to_geometry(Path.cwd(), scene.dimension)], points, device=grid.device)
        covered = 1.0 - float(np.mean(free[mine])) if mine.any() else 0.0
        if covered > BURIED:
            yield f"{key}[{number}] ({material.shape}): {100.0 * covered:.2g} % of it lies inside solids, and is left out"
