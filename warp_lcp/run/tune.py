"""Find the fastest settings for an accuracy by trial runs of the first frames.

The trials run on the device that will run the scene.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from warp_lcp.files.atomic import write_text
from warp_lcp.run.trial import RunDifferences, Trial, spread_of, trial
from warp_lcp.scene.presets import (
    TRIAL_FRAMES,
    Preset,
    PresetName,
    SimulatorPresets,
    changed,
    price_table,
    table_of,
)
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.scene_file import HEADER, dump_scene
from warp_lcp.scene.table import KeyFault, SceneError
from warp_lcp.simulation import SimulationFailed, StepFailed

CLOSE = 1.25  # settings within this ratio of the shortest time are timed again, interleaved
# Ratio of times, or of distances, within the noise of the measurement; among such settings the one
# nearer to the reference is chosen.
SAME = 1.05
ROUNDS = 2  # further timings of those
# Factors on the steps of the reference: runs of equal accuracy, whose distances measure its
# uncertainty.
TWINS = (0.9, 0.8)
TWICE = 1.7  # approximate factor on the number of steps, since a frame has whole steps
CORRECTED_EVERY = (4, 2, 1)  # steps between two density corrections, if the scene has them


@dataclass
class Candidate:
    """Settings of a trial, and its results.

    Attributes:
        settings: settings by `section.key`.
        trial: the trial run; its seconds are those of the first timing.
        distance: displaced fraction of the mass relative to the reference run.
        seconds: the shortest of all timings.
    """

    settings: dict[str, float]
    trial: Trial
    distance: float
    seconds: float

    def words(self) -> str:
        """Return the settings in the format of the command line."""
        return " ".join(f"{key}={value:g}" for key, value in self.settings.items())


@dataclass
class TuningResult:
    """Result of a tuning.

    Attributes:
        scene: the scene with the chosen settings.
        chosen: the chosen settings and their results.
        preset: the preset whose bounds define the accuracy.
        bounds: bounds of the differences: those of the preset or, with an uncertain reference,
            combined with its noise.
        limit: factor on those bounds up to which a run is accepted: 1 or, if no trial is within
            them, slightly more than that of the nearest trial.
        noise: differences between runs of the reference's accuracy; None if not measured, since
            some settings are within the preset's own bounds.
        reference: the reference run.
        tried: all settings that ran, in the order of the trials.
        failed: settings whose run failed, and why.
        frames: number of frames of each trial.
    """

    scene: Scene
    chosen: Candidate
    preset: Preset
    bounds: RunDifferences
    limit: float
    noise: RunDifferences | None
    reference: Trial
    tried: list[Candidate]
    failed: list[str]
    frames: int

    @property
    def met(self) -> bool:
        """Return whether the chosen settings meet the accuracy, or the noise limit."""
        return self.limit <= 1.0

    def verdict(self, accuracy: str) -> list[str]:
        """Return the result in words: settings, accuracy, missed bounds and a remedy."""
        best, limits, volume = (
            self.chosen,
            self.preset,
            self.chosen.trial.volume_error(self.reference),
        )
        words = f"{best.words()}: {best.seconds:.3g} s"
        accuracy_line = (
            f"distance {best.distance:.4f} (at most {limits.distance:g}), volume or packing "
            f"{volume:.3f} (at most {limits.volume:g})"
        )
        if self.noise is None:
            return [f"{accuracy}: {words}", accuracy_line]
        differences = (
            ("distance", best.distance, limits.distance),
            ("volume or packing", volume, limits.volume),
        )
        missed = ", ".join(
            f"{name} by a factor of {own / most:.2g}"
            for name, own, most in differences
            if own > most
        )
        unsure = (
            f"runs as accurate as the reference differ by {self.noise.distance:.4f} and "
            f"{self.noise.volume:.3f}"
        )
        if self.met:
            return [
                f"within the noise of the reference, but not {accuracy}: {words}",
                accuracy_line,
                f"bounds missed: {missed}; but {unsure}: smaller errors cannot be measured",
                "runs diverge this far with any settings in these frames: use fewer --frames to "
                "compare earlier times",
            ]
        return [
            f"nearest of the settings tried, but not {accuracy}: {words}",
            accuracy_line,
            f"bounds missed: {missed}; {unsure}",
            self._remedy(),
        ]

    def _remedy(self) -> str:
        """Return a remedy, from the effect of shorter steps among those tried."""
        finest = max(self.tried, key=lambda c: c.trial.steps)
        coarser = [c for c in self.tried if TWICE * c.trial.steps <= finest.trial.steps]
        if not coarser:
            return "shorter steps than those tried, or a higher domain.resolution, may help"
        next_one = max(coarser, key=lambda c: c.trial.steps)
        times, nearer = (
            finest.trial.steps / next_one.trial.steps,
            finest.distance / next_one.distance,
        )
        if nearer * TWICE <= 1.0:
            return "the distance decreases with the step: shorter steps than those tried would help"
        return (
            f"{times:.2g} times as many steps left {100.0 * nearer:.0f} % of the distance; if the "
            "step were the cause, it would be "
            "half or less: increase domain.resolution instead"
        )

    def rows(self) -> list[tuple[str, ...]]:
        """Return a table of all trials: settings, seconds, steps and distance.

        Further columns are the differences of energy (relative) and front from the reference, and
        the growth of the volume or the packing of sand.
        """
        packed = self.reference.packing is not None
        rows: list[tuple[str, ...]] = [
            (
                "seconds",
                "steps",
                "distance",
                "energy",
                "front [m]",
                "packing" if packed else "volume",
                "settings",
            )
        ]
        for c in self.tried:
            energy, front = (
                c.trial.energy_error(self.reference),
                c.trial.front_error(self.reference),
            )
            last = (
                f"{c.trial.packing or 0.0:.3f}" if packed else f"{c.trial.volume_drift or 0.0:+.3f}"
            )
            rows.append(
                (
                    f"{c.seconds:.3g}",
                    str(c.trial.steps),
                    f"{c.distance:.4f}",
                    f"{energy:.3f}",
                    f"{front:+.3f}",
                    last,
                    c.words(),
                )
            )
        return rows


def tune(
    scene: Scene,
    *,
    accuracy: PresetName,
    device: str,
    frames: int = TRIAL_FRAMES,
    say: Callable[[str], object] = lambda text: None,
) -> TuningResult:
    """Find the settings with the shortest run time for an accuracy.

    An accuracy bounds the distance from a reference run at the same resolution, and the difference
    of the volume: the bounds are those of the preset of its name, see `warp_lcp.scene.presets`.
    Longer time steps take less time and have larger distances, so the longest one that meets the
    bounds is found by bisection, with the preset's tolerance. Then follow the loosest tolerance and
    the least frequent density correction that keep the bounds. The fastest few settings are timed
    again, interleaved.

    If no step meets the bounds, runs of the reference's accuracy, with slightly shorter steps,
    measure the uncertainty of the reference: at a coarse resolution a splash amplifies any
    difference. Distances below this noise cannot be resolved, so the bounds are combined with it.
    If no settings meet these bounds either, the result is the fastest of the nearest settings.

    Args:
        scene: the scene, whose other settings are kept.
        accuracy: name of a preset.
        device: a Warp device.
        frames: number of frames.
        say: gets a line about each trial.

    Raises:
        SceneError: the scene cannot be tuned or simulated.
        StepFailed: the reference run failed.
        SimulationFailed: the reference run failed.
    """
    prices = price_table().get(scene.scene.simulator)
    if prices is None:
        raise SceneError(scene.scene.name, [KeyFault("scene.simulator", "has no settings to tune")])
    return _Search(
        scene, prices, prices.presets[accuracy], device, min(frames, scene.time.frame_count), say
    ).run()


def write_tuned(path: Path, tuning: TuningResult, accuracy: str, device: str) -> None:
    """Write the tuned scene, with the measurements in comments above it.

    Raises:
        OSError: the file cannot be written.
    """
    head = [
        f"# Tuned for {accuracy} accuracy on {device}:",
        *(f"# {line}" for line in tuning.verdict(accuracy)),
        f"# Measured on {tuning.frames} frames:",
        *(f"#   {', '.join(row)}" for row in tuning.rows()),
    ]
    write_text(path, "\n".join(head) + "\n" + dump_scene(tuning.scene).removeprefix(HEADER))


@dataclass
class _Search:
    """Search for the fastest settings."""

    scene: Scene
    prices: SimulatorPresets
    preset: Preset
    device: str
    frames: int
    say: Callable[[str], object]
    tried: list[Candidate] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    _known: dict[tuple[tuple[str, float], ...], Candidate | None] = field(default_factory=dict)

    def run(self) -> TuningResult:
        """Find the fastest settings within the bounds, or the fastest of the nearest."""
        self.reference = self._reference_run()
        self.say(f"reference: {self.reference.seconds:.3g} s, {self.reference.steps} steps")
        self.bounds, self.limit, noise = (
            RunDifferences(self.preset.distance, self.preset.volume),
            1.0,
            None,
        )
        start = {key: value for key, value in self.preset.settings.items() if self._has(key)}
        step = self._longest_step(start)
        if not self.tried:
            raise SimulationFailed(
                f"no settings ran to the end of frame {self.frames}: {self.failed[-1]}"
            )
        if step is None:
            noise = self._noise()
            self.bounds = self.bounds.beside(noise)
            step = self._longest_step(start)
        if step is None:
            nearest = min(self.tried, key=self._miss)
            self.limit, settings = SAME * self._miss(nearest), nearest.settings
        else:
            settings = {**start, **_step_settings(self.prices.steps[step])}
        for key, values in (
            ("solver.tolerance", self.prices.tolerances),
            ("density_correction.every", CORRECTED_EVERY),
        ):
            settings = self._loosest(settings, key, values)
        chosen = self._fastest([c for c in self.tried if self._miss(c) <= self.limit])
        tuned = changed(self.scene, chosen.settings)
        return TuningResult(
            tuned,
            chosen,
            self.preset,
            self.bounds,
            self.limit,
            noise,
            self.reference,
            self.tried,
            self.failed,
            self.frames,
        )

    def _fastest(self, near: list[Candidate]) -> Candidate:
        """Return the fastest settings, after interleaved timings of the close ones."""
        shortest = min(c.seconds for c in near)
        close = [c for c in near if c.seconds <= CLOSE * shortest]
        for _ in range(ROUNDS if len(close) > 1 else 0):
            for c in close:
                again = trial(
                    changed(self.scene, c.settings), device=self.device, frames=self.frames
                )
                c.seconds = min(c.seconds, again.seconds)
        shortest = min(c.seconds for c in close)
        return min((c for c in close if c.seconds <= SAME * shortest), key=lambda c: c.distance)

    def _reference_run(self, part: float = 1.0) -> Trial:
        """Run the reference, or one with a fraction of its steps."""
        settings = dict(self.prices.reference)
        settings |= {key: part * settings[key] for key in ("time.cfl", "time.dt_max")}
        return trial(changed(self.scene, settings), device=self.device, frames=self.frames)

    def _noise(self) -> RunDifferences:
        """Return the differences between runs of the reference's accuracy."""
        self.say("no settings are within the bounds; measuring how accurate the reference is")
        references = [self.reference]
        for part in TWINS:
            try:
                references.append(self._reference_run(part))
            except (StepFailed, SimulationFailed) as error:
                self.failed.append(f"reference with {part:g} times its steps: {error}")
                self.say(self.failed[-1])
        noise = spread_of(references)
        self.say(
            f"equally accurate runs differ by: distance {noise.distance:.4f}, volume or packing "
            f"{noise.volume:.3f}"
        )
        return noise

    def _miss(self, candidate: Candidate) -> float:
        return self.bounds.miss(candidate.trial, self.reference)

    def _has(self, key: str) -> bool:
        return table_of(self.scene, key) is not None

    def _longest_step(self, settings: dict[str, float]) -> int | None:
        """Return the index of the longest step that meets the bounds, by bisection.

        None if none does. Steps shorter than one that meets the bounds meet them too.
        """
        steps = self.prices.steps
        low, high = 0, len(steps)  # the result is in low..high; high means none
        while low < high:
            middle = (low + high) // 2
            if self._meets({**settings, **_step_settings(steps[middle])}):
                high = middle
            else:
                low = middle + 1
        return low if low < len(steps) else None

    def _loosest(
        self, settings: dict[str, float], key: str, values: tuple[float, ...]
    ) -> dict[str, float]:
        """Return the settings with the loosest value that meets the bounds.

        Values are tried from the loosest on; the settings are unchanged if none does.
        """
        for value in values:
            if not self._has(key) or value == settings.get(key):
                break
            if self._meets({**settings, key: value}):
                return {**settings, key: value}
        return settings

    def _meets(self, settings: dict[str, float]) -> bool:
        key = tuple(sorted(settings.items()))
        if key not in self._known:
            self._known[key] = self._try(settings)
        found = self._known[key]
        return found is not None and self._miss(found) <= self.limit

    def _try(self, settings: dict[str, float]) -> Candidate | None:
        """Run the first frames with some settings; return None if that fails."""
        words = " ".join(f"{key}={value:g}" for key, value in settings.items())
        try:
            ran = trial(changed(self.scene, settings), device=self.device, frames=self.frames)
        except (StepFailed, SimulationFailed) as error:
            self.failed.append(f"{words}: {error}")
            self.say(self.failed[-1])
            return None
        candidate = Candidate(settings, ran, ran.distance(self.reference), ran.seconds)
        self.tried.append(candidate)
        self.say(
            f"{words}: {ran.seconds:.3g} s, {ran.steps} steps, distance {candidate.distance:.4f}"
        )
        return candidate


def _step_settings(step: tuple[float, float]) -> dict[str, float]:
    cfl, dt_max = step
    return {"time.cfl": cfl, "time.dt_max": dt_max}
