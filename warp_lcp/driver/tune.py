"""The fastest settings for an accuracy: measured on a scene's own first frames, on the device that is to run it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from warp_lcp.driver.atomic import write_text
from warp_lcp.driver.presets import Preset, PresetName, Prices, changed, price_table
from warp_lcp.driver.scene import Scene
from warp_lcp.driver.scene_file import HEADER, dump_scene
from warp_lcp.driver.simulator import SimulationFailed, StepFailed
from warp_lcp.driver.table import Problem, SceneError
from warp_lcp.driver.trial import Trial, trial

FRAMES = 18  # of the calibration, unless asked for otherwise: that many `warp-lcp bench tradeoff` compares
CLOSE = 1.25  # settings that take at most so many times the shortest time are timed again, in turns
SAME = 1.05  # times the shortest: noise of a timing, within which the nearer to the reference is taken
ROUNDS = 2  # more timings of those
CORRECTED_EVERY = (4, 2, 1)  # steps between two density corrections, where the scene has them


@dataclass
class Candidate:
    """Settings that were tried.

    Attributes:
        settings: by `section.key`.
        trial: what they took and showed; its seconds are those of the first timing.
        distance: share of the mass that is elsewhere than in the reference run.
        seconds: the shortest of all timings.
    """

    settings: dict[str, Any]
    trial: Trial
    distance: float
    seconds: float

    def words(self) -> str:
        """Return the settings as the command line takes them."""
        return " ".join(f"{key}={value:g}" for key, value in self.settings.items())


@dataclass
class Tuning:
    """What a tuning found.

    Attributes:
        scene: with the settings chosen.
        chosen: those settings and what they take.
        met: whether they meet the accuracy; False: not even the finest do, which are chosen.
        preset: whose bounds the accuracy is.
        reference: the run that the others were compared with.
        tried: all settings that ran, in the order of the trials.
        failed: settings whose run ended, and why.
        frames: of each trial.
    """

    scene: Scene
    chosen: Candidate
    met: bool
    preset: Preset
    reference: Trial
    tried: list[Candidate]
    failed: list[str]
    frames: int

    def rows(self) -> list[tuple[str, ...]]:
        """Return a table of what was tried: settings, seconds, steps and distance.

        Also the differences of energy (relative) and front from the reference, the growth of the volume, or how densely sand was packed.
        """
        packed = self.reference.packing is not None
        rows: list[tuple[str, ...]] = [
            ("seconds", "steps", "distance", "energy", "front [m]", "packing" if packed else "volume", "settings")
        ]
        for c in self.tried:
            energy, front = c.trial.energy_error(self.reference), c.trial.front_error(self.reference)
            last = f"{c.trial.packing or 0.0:.3f}" if packed else f"{c.trial.volume_drift or 0.0:+.3f}"
            rows.append((f"{c.seconds:.3g}", str(c.trial.steps), f"{c.distance:.4f}", f"{energy:.3f}", f"{front:+.3f}", last, c.words()))
        return rows


def tune(
    scene: Scene, *, accuracy: PresetName, device: str, frames: int = FRAMES, say: Callable[[str], object] = lambda text: None
) -> Tuning:
    """Measure which settings take the least time for an accuracy.

    An accuracy bounds the distance from a reference run at the same resolution, and the volume's difference from it: those of the preset of
    its name, see `warp_lcp.driver.presets`. Longer time steps take less time and lie further away, so the longest that meets the bounds
    is found by bisection, with the preset's tolerance; then the loosest tolerance, and the rarest density correction, that keep them. The
    fastest few are timed again in turns.

    Args:
        scene: whose first frames are run, with everything that it says but for those settings.
        accuracy: name of a preset.
        device: a Warp device.
        frames: how many.
        say: takes a line about each trial.

    Raises:
        SceneError: the scene cannot be tuned or simulated.
        StepFailed: the reference run failed.
        SimulationFailed: the reference run failed.
    """
    prices = price_table().get(scene.scene.simulator)
    if prices is None:
        raise SceneError(scene.scene.name, [Problem("scene.simulator", "has no settings to tune")])
    search = _Search(scene, prices, prices.presets[accuracy], device, min(frames, scene.time.frame_count), say)
    chosen, met = search.run()
    tuned = changed(scene, chosen.settings)
    return Tuning(tuned, chosen, met, search.preset, search.reference, search.tried, search.failed, search.frames)


def near_enough(own: Trial, reference: Trial, preset: Preset) -> bool:
    """Return whether a run is as near to the reference as a preset's accuracy asks."""
    return own.distance(reference) <= preset.distance and own.volume_error(reference) <= preset.volume


def write_tuned(path: Path, tuning: Tuning, accuracy: str, device: str) -> None:
    """Write the tuned scene, with what was measured in comments above it.

    Raises:
        OSError: the file cannot be written.
    """
    words, bounds = "meets" if tuning.met else "does not meet", tuning.preset
    head = [
        f"# Tuned for {accuracy} accuracy on {device}: {tuning.chosen.words()}",
        f"# It {words} the bounds of that accuracy, a distance of {bounds.distance:g} and {bounds.volume:g} of volume or packing,",
        f"# on {tuning.frames} frames. What was measured:",
        *(f"#   {', '.join(row)}" for row in tuning.rows()),
    ]
    write_text(path, "\n".join(head) + "\n" + dump_scene(tuning.scene).removeprefix(HEADER))


@dataclass
class _Search:
    """The trials of a tuning."""

    scene: Scene
    prices: Prices
    preset: Preset
    device: str
    frames: int
    say: Callable[[str], object]
    tried: list[Candidate] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    _known: dict[tuple[tuple[str, Any], ...], Candidate | None] = field(default_factory=dict)

    def run(self) -> tuple[Candidate, bool]:
        """Return the fastest settings that meet the bound, or the finest where none do, and which of the two they are."""
        self.reference = trial(changed(self.scene, self.prices.reference), device=self.device, frames=self.frames)
        self.say(f"reference: {self.reference.seconds:.3g} s, {self.reference.steps} steps")
        start = {key: value for key, value in self.preset.settings.items() if self._has(key)}
        step = self._longest_step(start)
        if step is not None:
            settings = {**start, **_step_settings(self.prices.steps[step])}
            for key, values in (("solver.tolerance", self.prices.tolerances), ("density_correction.every", CORRECTED_EVERY)):
                settings = self._loosest(settings, key, values)
        met = [c for c in self.tried if near_enough(c.trial, self.reference, self.preset)]
        if not met:
            if not self.tried:
                raise SimulationFailed(f"no settings ran to the end of frame {self.frames}: {self.failed[-1]}")
            return min(self.tried, key=lambda c: max(c.distance / self.preset.distance, self._volume(c) / self.preset.volume)), False
        shortest = min(c.seconds for c in met)
        close = [c for c in met if c.seconds <= CLOSE * shortest]
        for _ in range(ROUNDS if len(close) > 1 else 0):
            for c in close:
                again = trial(changed(self.scene, c.settings), device=self.device, frames=self.frames)
                c.seconds = min(c.seconds, again.seconds)
        shortest = min(c.seconds for c in close)
        return min((c for c in close if c.seconds <= SAME * shortest), key=lambda c: c.distance), True

    def _volume(self, candidate: Candidate) -> float:
        return candidate.trial.volume_error(self.reference)

    def _has(self, key: str) -> bool:
        return getattr(self.scene, key.partition(".")[0]) is not None

    def _longest_step(self, settings: dict[str, Any]) -> int | None:
        """Return which of the steps is the longest that meets the bound; None: none does. Shorter ones than it do, by bisection."""
        steps = self.prices.steps
        low, high = 0, len(steps)  # the answer lies in low..high; high: none
        while low < high:
            middle = (low + high) // 2
            if self._meets({**settings, **_step_settings(steps[middle])}):
                high = middle
            else:
                low = middle + 1
        return low if low < len(steps) else None

    def _loosest(self, settings: dict[str, Any], key: str, values: tuple[float, ...]) -> dict[str, Any]:
        """Return the settings with the loosest of the values, loose ones first, that meets the bounds; as they are where none does."""
        for value in values:
            if not self._has(key) or value == settings.get(key):
                break
            if self._meets({**settings, key: value}):
                return {**settings, key: value}
        return settings

    def _meets(self, settings: dict[str, Any]) -> bool:
        key = tuple(sorted(settings.items()))
        if key not in self._known:
            self._known[key] = self._try(settings)
        found = self._known[key]
        return found is not None and near_enough(found.trial, self.reference, self.preset)

    def _try(self, settings: dict[str, Any]) -> Candidate | None:
        """Run the first frames with some settings; None: that failed."""
        words = " ".join(f"{key}={value:g}" for key, value in settings.items())
        try:
            ran = trial(changed(self.scene, settings), device=self.device, frames=self.frames)
        except (StepFailed, SimulationFailed) as error:
            self.failed.append(f"{words}: {error}")
            self.say(self.failed[-1])
            return None
        candidate = Candidate(settings, ran, ran.distance(self.reference), ran.seconds)
        self.tried.append(candidate)
        self.say(f"{words}: {ran.seconds:.3g} s, {ran.steps} steps, distance {candidate.distance:.4f}")
        return candidate


def _step_settings(step: tuple[float, float]) -> dict[str, float]:
    cfl, dt_max = step
    return {"time.cfl": cfl, "time.dt_max": dt_max}
