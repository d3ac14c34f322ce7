"""Settings that trade speed for accuracy: one table for each simulator."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from warp_lcp.solvers.registry import grid_methods

Step = tuple[float, float]  # time.cfl, time.dt_max [s]
LIQUID_STEPS: tuple[Step, ...] = (
    (8.0, 0.04),
    (4.0, 0.02),
    (2.0, 0.01),
    (1.0, 0.005),
    (0.5, 0.0025),
)
SAND_STEPS: tuple[Step, ...] = ((4.0, 0.04), (2.0, 0.02), (1.0, 0.01), (0.8, 0.005), (0.4, 0.0025))
RESOLUTIONS = (0.5, 0.75, 1.5)  # factors of the scene's own resolution
REFERENCE = 2.0  # factor of the finest run's resolution


@dataclass(frozen=True)
class TradeoffSetting:
    """Scene keys with other values."""

    curve: str  # the curve of the setting; its settings differ in one key alone
    overrides: tuple[str, ...]  # as `warp-lcp run --set` takes them
    scale: float = 1.0  # factor of the resolution

    @property
    def name(self) -> str:
        """Setting in one line."""
        return " ".join(
            [*([f"resolution x {self.scale:g}"] if self.scale != 1.0 else []), *self.overrides]
        )


def settings_of(simulator: str) -> list[TradeoffSetting]:
    """Return the settings to measure.

    Raises:
        ValueError: the simulator has no settings here.
    """
    lists: dict[str, Callable[[], Iterator[TradeoffSetting]]] = {
        "fluids": _liquid,
        "granular": _sand,
    }
    if simulator not in lists:
        raise ValueError(f"simulator {simulator}: has no settings to compare")
    return list(dict.fromkeys(lists[simulator]()))


def _along(
    curve: str, steps: Sequence[Step], tolerance: float, *overrides: str, scale: float = 1.0
) -> Iterator[TradeoffSetting]:
    """Yield a setting with time steps of all lengths."""
    for cfl, dt in steps:
        yield TradeoffSetting(
            curve,
            (
                f"time.cfl={cfl:g}",
                f"time.dt_max={dt:g}",
                f"solver.tolerance={tolerance:g}",
                *overrides,
            ),
            scale,
        )


def _usual(
    steps: Sequence[Step], tolerances: Sequence[float], scaled: Sequence[float]
) -> Iterator[TradeoffSetting]:
    """Yield tolerances, and resolutions with some of them."""
    for tolerance in tolerances:
        yield from _along(f"tolerance {tolerance:g}", steps, tolerance)
    for scale in RESOLUTIONS:
        for tolerance in scaled:
            yield from _along(
                f"resolution x {scale:g}, tolerance {tolerance:g}",
                steps[:4],
                tolerance,
                scale=scale,
            )


def _liquid() -> Iterator[TradeoffSetting]:
    steps = LIQUID_STEPS
    yield from _usual(steps, (1e-1, 1e-2, 1e-4, 1e-6), (1e-2, 1e-4))
    for precision in ("single", "double"):
        yield from _along(
            f"{precision} precision", steps[1:4:2], 1e-4, f"solver.precision={precision}"
        )
    for method in (m for m in grid_methods() if m != "projected-multigrid"):
        yield from _along(
            "other methods",
            steps[2:3],
            1e-4,
            f"solver.method={method}",
            "solver.max_iterations=2000",
        )
    for tolerance in (1e-2, 1e-4):
        yield from _along(
            f"unilateral, tolerance {tolerance:g}",
            steps[1:4],
            tolerance,
            "pressure.model=unilateral",
        )
    yield from _along("surface on faces", steps[1:4], 1e-4, "pressure.surface=voxel")
    yield from _particles(steps[1:3], 1e-4, (1, 4))


def _sand() -> Iterator[TradeoffSetting]:
    steps = SAND_STEPS
    yield from _usual(steps, (1e-1, 1e-2, 1e-3, 1e-4), (1e-2, 1e-3))
    for tolerance in (1e-1, 1e-2, 1e-3):
        yield from _along(
            f"interleaved sweeps, tolerance {tolerance:g}",
            steps[1:4:2],
            tolerance,
            "solver.method=interleaved-sweeps",
        )
    yield from _along("friction in a box", steps[1:4], 1e-3, "friction.model=box")
    for iterations in (20, 40):
        yield from _along(
            f"{iterations} iterations", steps[1:4:2], 1e-3, f"solver.max_iterations={iterations}"
        )
    yield from _particles(steps[1:4:2], 1e-3, (2, 4, 8))


def _particles(
    steps: Sequence[Step], tolerance: float, corrections: Sequence[int]
) -> Iterator[TradeoffSetting]:
    """Yield the particle settings common to both materials."""
    offered = [(f"{n} particles along a cell", f"particles.per_axis={n}") for n in (1, 3)]
    offered += [
        (f"transfer {transfer}", f"particles.transfer={transfer}") for transfer in ("pic", "flip")
    ]
    offered += [
        (f"density correction every {every}", f"density_correction.every={every}")
        for every in corrections
    ]
    for curve, override in [*offered, ("reseeding", "particles.reseed.every=2")]:
        yield from _along(curve, steps, tolerance, override)
