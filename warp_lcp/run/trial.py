"""Time the first frames of a run and compare them with a reference run."""

from __future__ import annotations

import itertools
import math
import statistics
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_lcp.run.check import start
from warp_lcp.run.loop import SAME_TIME
from warp_lcp.run.stepping import stable_dt, take_step
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.table import KeyFault, SceneError
from warp_lcp.simulation import Points, Simulation

FRONT = 99.0  # percentile of the particles that defines the front
LEAST, MOST = 3, 30  # numbers of steps that `step_seconds` measures
ENOUGH = 2.0  # seconds of measurement that are enough after LEAST steps
LOOKS = 6  # most frames that are compared
# Edge of the boxes in which densities are compared [cells]; large enough to average out sampling
# noise.
BIN = 2.0


@dataclass(frozen=True)
class MaterialSnapshot:
    """Mass distribution, energy and front of the material at one time.

    Attributes:
        time: [s].
        mass: mass of the material in each box of a coarse grid [kg; 2-D: kg/m], one axis per
            dimension.
        energy: kinetic and potential energy, 0 at the origin's height [J; 2-D: J/m].
        front: the 99th percentile of the particles' x [m].
    """

    time: float
    mass: np.ndarray
    energy: float
    front: float


@dataclass(frozen=True)
class Trial:
    """Time and results of the first frames of a run.

    Attributes:
        seconds: time of the steps without frames. On the CPU it is that of the process, which other
            programs disturb least.
        steps: number of steps.
        iterations: iterations of the method, in all steps.
        linear_iterations: linear iterations on the finest grid, in all steps.
        looks: values at the start and then at equal intervals of time.
        residual: the largest relative residual of a step; for sand, the coupled residual.
        volume: volume at the start of the first step and of the last [m^3; 2-D: m^2]; None if it is
            not in the log.
        packing: largest fraction of a cell at the start of a step, relative to the densest packing;
            None if it is not in the log.
        penetration: fraction of the particles that end inside solids or walls; None if unknown.
    """

    seconds: float
    steps: int
    iterations: int
    linear_iterations: int
    looks: tuple[MaterialSnapshot, ...]
    residual: float
    volume: tuple[float, float] | None = None
    packing: float | None = None
    penetration: float | None = None

    @property
    def volume_drift(self) -> float | None:
        """Return the relative growth of the volume; None if unknown."""
        return (
            None
            if self.volume is None or self.volume[0] == 0.0
            else self.volume[1] / self.volume[0] - 1.0
        )

    def distance(self, reference: Trial) -> float:
        """Return the displaced fraction of the mass relative to a reference run.

        The mean over the compared times, from 0 (equal) to 1 (all mass is displaced).

        Raises:
            ValueError: the two runs have values at different times.
        """
        shares = []
        for look, other in zip(self.looks[1:], reference.looks[1:], strict=True):
            if look.mass.shape != other.mass.shape or abs(look.time - other.time) > SAME_TIME:
                raise ValueError(
                    "the two runs were sampled in different boxes or at different times"
                )
            total = float(other.mass.sum())
            shares.append(
                0.5 * float(np.abs(look.mass - other.mass).sum()) / total if total > 0.0 else 0.0
            )
        return float(np.mean(shares))

    def energy_error(self, reference: Trial) -> float:
        """Return the largest energy difference over the reference's largest energy."""
        scale = max(abs(look.energy) for look in reference.looks)
        differences = [
            abs(a.energy - b.energy) for a, b in zip(self.looks, reference.looks, strict=True)
        ]
        return max(differences) / scale if scale > 0.0 else 0.0

    def volume_error(self, reference: Trial) -> float:
        """Return the difference of volume growth or packing to a reference.

        0 if unknown.
        """
        for own, other in (
            (self.volume_drift, reference.volume_drift),
            (self.packing, reference.packing),
        ):
            if own is not None and other is not None:
                return abs(own - other)
        return 0.0

    def front_error(self, reference: Trial) -> float:
        """Return the front's lead over a reference's at the end [m]."""
        return self.looks[-1].front - reference.looks[-1].front


def look_times(scene: Scene, frames: int) -> list[float]:
    """Return the times [s] of the compared frames, the last of `frames` among them."""
    last = min(frames, scene.time.frame_count)
    every = max(1, -(-last // LOOKS))
    return [scene.time.frame_time(n) for n in range(last, 0, -every)][::-1]


def trial(
    scene: Scene,
    *,
    device: str,
    frames: int,
    box: float | None = None,
    inspect: Callable[[Simulation], object] | None = None,
) -> Trial:
    """Run a scene's first frames.

    Args:
        scene: the scene.
        device: a Warp device.
        frames: number of frames.
        box: edge of the boxes for the mass distribution [m]. Default: two cells.
        inspect: called with the simulation at the end.

    Raises:
        SceneError: the scene cannot be simulated, or has no particles in frames.
        StepFailed: a step missed its criteria, also with shorter steps.
        SimulationFailed: the run cannot continue.
    """
    simulation = start(scene, device)
    ran = _TrialRun(scene, simulation, device, box or BIN * scene.spacing)
    found = ran.run(look_times(scene, frames), min(frames, scene.time.frame_count))
    if inspect is not None:
        inspect(simulation)
    return found


class _TrialRun:
    """Timed simulation of the first frames."""

    def __init__(self, scene: Scene, simulation: Simulation, device: str, box: float) -> None:
        self.scene, self.simulation, self.device, self.box = scene, simulation, device, box
        self.rows: list[dict[str, float | int | str | None]] = []
        self.seconds = 0.0

    def run(self, times: Sequence[float], frames: int) -> Trial:
        """Step to the last frame and record the values at `times` [s]."""
        looks: list[MaterialSnapshot] = []
        for frame in range(1, frames + 1):
            end = self.scene.time.frame_time(frame)
            while end - self.simulation.time > SAME_TIME / self.scene.time.frames_per_second:
                self._step(end)
                if not looks:
                    looks.append(self._measure_material())  # then energy and mass are known
            if any(abs(end - time) < SAME_TIME for time in times):
                looks.append(self._measure_material())
        volumes = self._known("volume")
        return Trial(
            self.seconds,
            len(self.rows),
            self._sum("solve_iterations"),
            self._sum("linear_iterations"),
            tuple(looks),
            volume=(volumes[0], volumes[-1]) if volumes else None,
            residual=self._largest_of_run(
                "coupled_residual" if "coupled_residual" in self.rows[-1] else "solve_residual"
            )
            or 0.0,
            packing=self._largest_of_run("max_fraction"),
            penetration=self._penetration(),
        )

    def _step(self, end: float) -> None:
        """Run a step toward a time [s], as a run does."""
        clock_of = clock.perf_counter if wp.get_device(self.device).is_cuda else clock.process_time
        begun = clock_of()
        self.rows.append(
            take_step(self.simulation, stable_dt(self.simulation), end, self.scene.time)[2]
        )
        wp.synchronize_device(self.device)
        self.seconds += clock_of() - begun

    def _measure_material(self) -> MaterialSnapshot:
        """Return mass distribution, energy and front at the current time."""
        row, points = self.rows[-1], self._points()
        energy = float(row.get("kinetic_energy") or 0.0) + float(row.get("potential_energy") or 0.0)
        front = float(np.percentile(points[:, 0], FRONT)) if len(points) else 0.0
        dimension, size = self.scene.dimension, self.scene.domain.size
        return MaterialSnapshot(
            self.simulation.time,
            float(row.get("mass") or 0.0) * spread(points[:, :dimension], size, self.box),
            energy,
            front,
        )

    def _points(self) -> np.ndarray:
        """Return the particles of the current frame."""
        points = next(
            (part.points for part in self.simulation.frame() if isinstance(part, Points)), None
        )
        if points is None:
            raise SceneError(
                self.scene.scene.name,
                [
                    KeyFault(
                        "scene.simulator", "has no particles, which the comparison of runs needs"
                    )
                ],
            )
        return points

    def _penetration(self) -> float | None:
        boundary = getattr(self.simulation, "boundary", None)
        points = self._points()
        return (
            None
            if boundary is None or not len(points)
            else 1.0 - float(np.mean(boundary.admits(points)))
        )

    def _sum(self, name: str) -> int:
        return sum(int(row.get(name) or 0) for row in self.rows)

    def _largest_of_run(self, name: str) -> float | None:
        return max(self._known(name), default=None)

    def _known(self, name: str) -> list[float]:
        """Return a column of the log without its empty cells."""
        return [float(value) for row in self.rows if (value := row.get(name)) is not None]


def spread(points: np.ndarray, size: Sequence[float], box: float) -> np.ndarray:
    """Return the fraction of the points in each box of a grid, by tent weights.

    Each tent is as wide as two boxes.

    Args:
        points: [m], shape (n, dimension).
        size: sides of the domain [m].
        box: edge of a box [m].
    """
    dimension = points.shape[1]
    counts = [max(1, round(side / box)) for side in size]
    shares = np.zeros(counts)
    if not len(points):
        return shares
    at = points / box - 0.5
    low = np.floor(at).astype(np.int64)
    upper = at - low
    for corner in range(2**dimension):
        ends = [corner >> axis & 1 for axis in range(dimension)]
        weight = np.prod(
            [upper[:, axis] if end else 1.0 - upper[:, axis] for axis, end in enumerate(ends)],
            axis=0,
        )
        where = [np.clip(low[:, axis] + end, 0, counts[axis] - 1) for axis, end in enumerate(ends)]
        shares += np.bincount(
            np.ravel_multi_index(where, counts), weights=weight, minlength=shares.size
        ).reshape(counts)
    return shares / len(points)


@dataclass(frozen=True)
class RunDifferences:
    """Largest differences from a reference run.

    Args:
        distance: displaced fraction of the mass.
        volume: difference in the growth of a liquid's volume, or in the packing of sand.
    """

    distance: float
    volume: float

    def miss(self, own: Trial, reference: Trial) -> float:
        """Return the larger ratio of a difference to its bound: at most 1 within both."""
        return max(
            own.distance(reference) / self.distance, own.volume_error(reference) / self.volume
        )

    def beside(self, noise: RunDifferences) -> RunDifferences:
        """Return the bounds for a difference plus an independent noise.

        Both add in quadrature: the squared distance from one run of the reference's accuracy is
        that from the mean of such runs plus the noise squared.
        """
        return RunDifferences(
            math.hypot(self.distance, noise.distance), math.hypot(self.volume, noise.volume)
        )


def spread_of(references: Sequence[Trial]) -> RunDifferences:
    """Return the largest differences between equally accurate runs; 0 for one run.

    Smaller differences cannot be resolved.
    """
    pairs = list(itertools.combinations(references, 2))
    distance, volume = (
        max((of(b, a) for a, b in pairs), default=0.0)
        for of in (Trial.distance, Trial.volume_error)
    )
    return RunDifferences(distance, volume)


def step_seconds(scene: Scene, *, device: str) -> tuple[float, int]:
    """Return the median time of a step [s] and the number of steps.

    Of the first steps except the very first, as in a run: a failed step is repeated with a shorter
    dt, and no step follows the last frame except the second. Later steps depend on the motion of
    the liquid. Measured on a CPU for dam-break-2d, dam-break, mesh-obstacle and splash-in-circle: 9
    % above to 16 % below the mean of all steps of a run, 10 to 24 % below its time per step with
    frames and checkpoints.

    Raises:
        SceneError: the scene cannot be simulated.
        StepFailed: a step missed its criteria, also with shorter steps.
        SimulationFailed: the simulation cannot continue.
    """
    simulation, time, frame = start(scene, device), scene.time, 1
    seconds: list[float] = []  # the first step compiles kernels and allocates
    while len(seconds) <= LEAST or (len(seconds) <= MOST and sum(seconds[1:]) < ENOUGH):
        begun = clock.perf_counter()
        take_step(simulation, stable_dt(simulation), time.frame_time(frame), time)
        wp.synchronize_device(device)
        seconds.append(clock.perf_counter() - begun)
        frame += time.frame_time(frame) - simulation.time <= SAME_TIME / time.frames_per_second
        if frame > time.frame_count and len(seconds) > 1:
            break
    return statistics.median(seconds[1:]), len(seconds) - 1
