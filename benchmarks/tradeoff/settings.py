"""The settings that trade speed for accuracy: one list for each simulator."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from warp_lcp.solvers.registry import grid_methods

Step = tuple[float, float]  # time.cfl, time.dt_max [s]
LIQUID_STEPS: tuple[Step, ...] = ((8.0, 0.04), (4.0, 0.02), (2.0, 0.01), (1.0, 0.005), (0.5, 0.0025))
SAND_STEPS: tuple[Step, ...] = ((4.0, 0.04), (2.0, 0.02), (1.0, 0.01), (0.8, 0.005), (0.4, 0.0025))
RESOLUTIONS = (0.5, 0.75, 1.5)  # of the scene's own
REFERENCE = 2.0  # of the finest run's


@dataclass(frozen=True)
class Setting:
    """A scene's keys with other values."""

    curve: str  # what it belongs to: settings that differ in one key alone
    overrides: tuple[str, ...]  # as `warp-lcp run --set` takes them
    scale: float = 1.0  # of the resolution

    @property
    def name(self) -> str:
        """Return it in a line."""
        return " ".join([*([f"resolution x {self.scale:g}"] if self.scale != 1.0 else []), *self.overrides])


def settings_of(simulator: str) -> list[Setting]:
    """Return the settings to try.

    Raises:
        ValueError: there are none for the simulator.
    """
    lists = {"fluids": _liquid, "granular": _sand}
    if simulator not in lists:
        raise ValueError(f"simulator {simulator}: has no settings to compare")
    return list(dict.fromkeys(lists[simulator]()))


def _step(step: Step) -> tuple[str, str]:
    return f"time.cfl={step[0]:g}", f"time.dt_max={step[1]:g}"


def _tolerance(value: float) -> str:
    return f"solver.tolerance={value:g}"


def _liquid() -> Iterator[Setting]:
    for tolerance in (1e-1, 1e-2, 1e-4, 1e-6):
        for step in LIQUID_STEPS:
            yield Setting(f"tolerance {tolerance:g}", (*_step(step), _tolerance(tolerance)))
    for scale in RESOLUTIONS:
        for tolerance in (1e-2, 1e-4):
            for step in LIQUID_STEPS[:4]:
                yield Setting(f"resolution x {scale:g}, tolerance {tolerance:g}", (*_step(step), _tolerance(tolerance)), scale)
    for precision in ("single", "double"):
        for step in LIQUID_STEPS[1:4:2]:
            yield Setting(f"{precision} precision", (*_step(step), _tolerance(1e-4), f"solver.precision={precision}"))
    for method in grid_methods():
        if method != "projected-multigrid":
            yield Setting(
                "other methods", (*_step(LIQUID_STEPS[2]), _tolerance(1e-4), f"solver.method={method}", "solver.max_iterations=2000")
            )
    for tolerance in (1e-2, 1e-4):
        for step in LIQUID_STEPS[1:4]:
            yield Setting(f"unilateral, tolerance {tolerance:g}", (*_step(step), _tolerance(tolerance), "pressure.model=unilateral"))
    for step in LIQUID_STEPS[1:4]:
        yield Setting("surface on faces", (*_step(step), _tolerance(1e-4), "pressure.surface=voxel"))
    yield from _particles(LIQUID_STEPS[1:3], 1e-4, (1, 4))


def _sand() -> Iterator[Setting]:
    for tolerance in (1e-1, 1e-2, 1e-3, 1e-4):
        for step in SAND_STEPS:
            yield Setting(f"tolerance {tolerance:g}", (*_step(step), _tolerance(tolerance)))
    for scale in RESOLUTIONS:
        for tolerance in (1e-2, 1e-3):
            for step in SAND_STEPS[:4]:
                yield Setting(f"resolution x {scale:g}, tolerance {tolerance:g}", (*_step(step), _tolerance(tolerance)), scale)
    for tolerance in (1e-1, 1e-2, 1e-3):
        for step in SAND_STEPS[1:4:2]:
            yield Setting(
                f"interleaved sweeps, tolerance {tolerance:g}", (*_step(step), _tolerance(tolerance), "solver.method=interleaved-sweeps")
            )
    for step in SAND_STEPS[1:4]:
        yield Setting("friction in a box", (*_step(step), _tolerance(1e-3), "friction.model=box"))
    for iterations in (20, 40):
        for step in SAND_STEPS[1:4:2]:
            yield Setting(f"{iterations} iterations", (*_step(step), _tolerance(1e-3), f"solver.max_iterations={iterations}"))
    yield from _particles(SAND_STEPS[1:4:2], 1e-3, (2, 4, 8))


def _particles(steps: tuple[Step, ...], tolerance: float, corrections: tuple[int, ...]) -> Iterator[Setting]:
    """Return what both materials' particles offer."""
    for step in steps:
        base = (*_step(step), _tolerance(tolerance))
        for per_axis in (1, 3):
            yield Setting(f"{per_axis} particles along a cell", (*base, f"particles.per_axis={per_axis}"))
        for transfer in ("pic", "flip"):
            yield Setting(f"transfer {transfer}", (*base, f"particles.transfer={transfer}"))
        for every in corrections:
            yield Setting(f"density correction every {every}", (*base, f"density_correction.every={every}"))
        yield Setting("reseeding", (*base, "particles.reseed.every=2"))
