"""Estimate steps, time and disk of a run; warn about suspicious settings."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np

from warp_lcp.frames.frame_folder import frame_bytes
from warp_lcp.grid.particle_seeding import lattice
from warp_lcp.grid.voxelize import inside
from warp_lcp.material.particle_scene import ParticleScene
from warp_lcp.material.particle_simulation import ParticleSimulation
from warp_lcp.run.check import check_output
from warp_lcp.scene.models import predicted_seconds, prices
from warp_lcp.scene.scene import Scene
from warp_lcp.simulation import Cells, Part, Points, Simulation

MANY_FRAMES = 10_000
PIECE = 0.5  # mean part of a step that the end of a frame cuts off
FULL = 0.98  # fraction of cells in solids that is suspicious, most often an inverted shape
BURIED = 0.5  # fraction of a material's points in solids; less is normal for material in a vessel
LOG_BYTES = 14  # per entry
FRAME_SECONDS = 3e-3  # per frame, on one core
BYTE_SECONDS = 2.5e-9  # per byte, on one core
WHITEWATER_STATE_BYTES = 36  # a particle in a checkpoint: nine numbers
ROW_SECONDS = 0.8e-3  # per step, besides the simulation: time step and log row


def estimate_run(
    scene: Scene, simulation: Simulation, seconds: float | None = None
) -> list[tuple[str, str]]:
    """Return estimates of steps, run time and disk use, as pairs of word and line.

    Args:
        scene: the scene.
        simulation: the simulation at its start.
        seconds: measured time of a step; that of the cost table if None.
    """
    where = "as measured"
    if isinstance(scene, ParticleScene) and isinstance(simulation, ParticleSimulation):
        steps = expected_steps(scene, simulation)
        if seconds is None:
            seconds, where = expected_step(scene, simulation), "by the cost table, on one core"
    else:
        steps = longest_steps(scene, simulation)
    size = expected_bytes(scene, simulation, steps)
    disk = [("disk", f"about {in_words(size)}")]
    if scene.whitewater_estimate:
        disk = [
            (
                "disk",
                f"about {in_words(size)}, with {scene.whitewater_estimate:,} particles of "
                "whitewater in the mean, as many as dam breaks have",
            )
        ]
    if seconds is None:
        return [("steps", f"about {steps:,}"), *disk]
    frames = scene.time.frame_count * FRAME_SECONDS + size * BYTE_SECONDS
    whole = steps * (seconds + ROW_SECONDS) + frames
    lasts = timedelta(seconds=round(whole)) if whole >= 10.0 else f"{whole:.2g} s"
    spent = f"about {lasts} {where}, {1e3 * seconds:.3g} ms a step, {frames:.2g} s for frames"
    return [
        ("steps", f"about {steps:,}"),
        *([("whole run", spent)] if seconds > 0.0 else []),
        *disk,
    ]


def in_words(size: float) -> str:
    """Return a number of bytes in the largest suitable unit."""
    unit = next((n for n in range(4, 2, -1) if size >= 1000.0**n), 2)
    return f"{size / 1000.0**unit:.3g} {('MB', 'GB', 'TB')[unit - 2]}"


def expected_step(scene: ParticleScene, simulation: ParticleSimulation) -> float:
    """Return the estimated time of a step from the cost table [s].

    For the mean amount of material in the run.
    """
    growth = expected_growth(scene)
    # The grid window grows with the material.
    cells = min(round(math.prod(simulation.grid.counts) * growth), math.prod(scene.cell_counts))
    listed, particles = (
        prices(scene.scene.simulator, scene.dimension),
        round(simulation.particles.count * growth),
    )
    return scene.stirred * predicted_seconds(scene.models(), listed, cells, particles)


def expected_growth(scene: ParticleScene) -> float:
    """Return the mean amount of material in a run relative to the start.

    Inflow is assumed to be uniform, and half of it to leave.
    """
    leaves = bool(scene.drain or scene.domain.open)
    most, first = scene.particle_estimate(), max(scene.particle_estimate(later=False), 1)
    return 1.0 + 0.5 * (0.5 if leaves else 1.0) * (most / first - 1.0)


def expected_speed(scene: ParticleScene, simulation: ParticleSimulation) -> float:
    """Return the speed that limits the steps of a run [m/s].

    The largest of the initial material, sources, solids, and a fall under gravity.
    """
    totals, g = simulation.particles.totals(), float(np.linalg.norm(simulation.gravity))
    parts, end = (simulation.boundary, simulation.sources), scene.time.duration
    solids, sources = (0.0 if part is None else part.top_speed(0.0, end) for part in parts)
    # To the floor.
    falls = [
        float(bounds[0][1])
        for source in scene.source
        if (bounds := source.bounds(scene.dimension)) is not None
    ]
    fallen = max(_fall(scene, simulation), g * max(falls, default=0.0))
    return max(
        solids,
        math.hypot(max(totals.max_speed, sources), scene.fall_speed * math.sqrt(2.0 * fallen)),
    )


def _fall(scene: ParticleScene, simulation: ParticleSimulation) -> float:
    """Return the work of gravity on the material's top [J/kg].

    Along y until all material lies level on the floor, along other axes until the wall.
    """
    totals, gravity, size = simulation.particles.totals(), simulation.gravity, scene.domain.size
    if totals.count == 0:
        return 0.0
    grid = simulation.grid
    volume = totals.count * grid.cell_volume / scene.particles.per_axis**grid.dimension
    level = volume / float(np.prod([side for axis, side in enumerate(size) if axis != 1]))
    work = abs(gravity[1]) * max(float(totals.high[1]) - level, 0.0)
    for axis in {0, 2} & set(range(len(size))) - set(scene.endless):
        work += gravity[axis] * (
            size[axis] - totals.low[axis] if gravity[axis] > 0.0 else -totals.high[axis]
        )
    return float(work)


def expected_steps(scene: ParticleScene, simulation: ParticleSimulation) -> int:
    """Return the estimated number of steps of a run."""
    time, dx, g = scene.time, simulation.grid.spacing, float(np.linalg.norm(simulation.gravity))
    speed = expected_speed(scene, simulation) + math.sqrt(time.cfl * g * dx)
    # Surface tension may limit the step.
    stable = min(time.cfl * dx / speed if speed > 0.0 else math.inf, simulation.stable_dt())
    longest = min(max(stable, time.dt_min), time.dt_max)
    # Steps per frame are rounded up: by half a step on average over a run's speeds.
    a_frame = time.duration / time.frame_count / longest
    return round(time.frame_count * max(a_frame + PIECE * min(a_frame, 1.0), 1.0))


def longest_steps(scene: Scene, simulation: Simulation) -> int:
    """Return the number of steps if all are as long as the first one."""
    dt = min(max(simulation.stable_dt(), scene.time.dt_min), scene.time.dt_max)
    count = scene.time.frame_count
    return count * math.ceil(scene.time.duration / count / dt * (1.0 - 1e-9))


def expected_bytes(scene: Scene, simulation: Simulation, steps: int) -> int:
    """Return the estimated disk use of a run: frames, checkpoints and log [bytes]."""
    output, wanted = scene.output, {"particles": scene.output.particles, "grid": scene.output.grid}
    growth = expected_growth(scene) if isinstance(scene, ParticleScene) else 1.0
    frame = [
        _blank(part, scene.whitewater_estimate)
        if isinstance(part, Points) and part.name == "whitewater"
        else _grown(part, growth)
        for part in simulation.frame()
        if wanted.get(part.name, True)
    ]
    each = frame_bytes(
        frame, output.grid_format, surface_ply=output.surface_ply, frame_format=output.format
    )
    state = sum(array.nbytes for array in simulation.state().values())
    state += scene.whitewater_estimate * WHITEWATER_STATE_BYTES
    log = steps * LOG_BYTES * (len(simulation.columns()) + 5)
    return round(each * (scene.time.frame_count + 1) + output.checkpoints_kept * state + log)


def _blank(part: Points, count: int) -> Points:
    """Return the points with other numbers of them, all zero."""
    fields = {
        name: np.zeros((count, *values.shape[1:]), dtype=values.dtype)
        for name, values in part.fields.items()
    }
    return replace(part, fields=fields, points=np.zeros((count, 3), dtype=part.points.dtype))


def _grown(part: Part, factor: float) -> Part:
    """Return points or cells scaled to more material; other parts unchanged."""
    if not isinstance(part, (Points, Cells)) or factor == 1.0:
        return part
    count = len(part.points) if isinstance(part, Points) else len(part.index)
    taken = np.resize(np.arange(count), round(factor * count))
    fields = {name: values[taken] for name, values in part.fields.items()}
    if isinstance(part, Points):
        return replace(part, fields=fields, points=part.points[taken])
    return replace(part, fields=fields, index=part.index[taken])


def doubts(scene: Scene, simulation: Simulation) -> Iterator[str]:
    """Yield suspicious settings of frames and of solids, a line each.

    In addition to those of `Scene.notes`.
    """
    yield from check_output(scene)
    frames, rate = scene.time.frame_count, scene.time.frames_per_second
    if frames > MANY_FRAMES:
        yield (
            f"{frames:,} frames: time.duration {scene.time.duration:g} s at "
            f"time.frames_per_second {rate:g}; is this intended?"
        )
    if not (isinstance(scene, ParticleScene) and isinstance(simulation, ParticleSimulation)):
        return
    if not scene.solid:
        return
    grid, (key, materials) = simulation.grid, scene.materials()
    planes = range(grid.origin[2], grid.origin[2] + grid.counts[2])
    points = np.concatenate([lattice(grid, 1, 0.0, 0, plane) for plane in planes])  # one a cell
    free = simulation.admits(points)
    if free.mean() < 1.0 - FULL:
        yield (
            f"solids fill {100.0 - 100.0 * free.mean():.4g} % of the domain; with invert = true, "
            "the outside of a shape is solid"
        )
    for number, material in enumerate(materials):
        mine = inside(
            [material.to_geometry(Path.cwd(), scene.dimension)], points, device=grid.device
        )
        covered = 1.0 - float(np.mean(free[mine])) if mine.any() else 0.0
        if covered > BURIED:
            yield (
                f"{key}[{number}] ({material.shape}): {100.0 * covered:.0f} % of it lies inside "
                "solids and is left out"
            )
