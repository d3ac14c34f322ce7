"""Cost of driving a run from Python.

Run `python -m benchmarks.driven [SCENE ...]` in the source tree. Three runs of the same scene take
turns: by `run_scene`, as on the command line; by `for frame in wl.Run(...)`, with a callback in
each step and access to the particles in each frame; and by `run_scene` again, which shows the noise
of the clock. All write log, frames and checkpoints. Times are CPU seconds, so that other programs
on the machine count less. The output is ratios to the first of the three, with medians and
quartiles.
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from rich.console import Console

import warp_lcp as wl
from warp_lcp.run.loop import RunRequest, run_scene
from warp_lcp.run.progress import ProgressLines
from warp_lcp.run.resolve_scene import resolve_scene

SCENES = {"dam-break-2d": 1.0, "dam-break": 0.3}  # [s] simulated
TURNS = 15


def by_command(scene: str, folder: Path, duration: float) -> None:
    """Run a scene as the command line does."""
    given = resolve_scene(scene, [f"time.duration={duration}"])
    run_scene(
        RunRequest(scene=given.scene, out=folder, overrides=given.overrides),
        observer=ProgressLines(Console(quiet=True)),
    )


def by_program(scene: str, folder: Path, duration: float) -> None:
    """Run a scene from Python, with access to every frame."""
    steps: list[float] = []
    run = wl.Run(
        scene,
        folder=folder,
        device="cpu",
        duration=duration,
        on_step=lambda run: steps.append(run.time),
    )
    for frame in run:
        assert frame.particles.position.numpy()[0, 0] >= 0.0
    assert len(steps) == run.simulation.step_count


def measure(scene: str, duration: float) -> None:
    """Print the ratios of a scene's runs."""
    work, seconds = (by_command, by_program, by_command), []
    for _ in range(TURNS + 1):
        turn_seconds = []
        for run in work:
            with tempfile.TemporaryDirectory() as folder:
                begun = time.process_time()
                run(scene, Path(folder) / "run", duration)
                turn_seconds.append(time.process_time() - begun)
        seconds.append(turn_seconds)
    first, driven, again = np.transpose(seconds[1:])  # the first turn loads kernels
    sys.stdout.write(
        f"{scene}, {duration:g} s, {first.mean():.2f} s of the processor, {TURNS} turns:\n"
    )
    for name, times in (("driven from Python", driven), ("the same again", again)):
        low, middle, high = np.percentile(times / first, [25, 50, 75])
        total = times.sum() / first.sum()
        sys.stdout.write(
            f"  {name} / command line: median {middle:.3f}, quartiles {low:.3f} to {high:.3f}, all "
            f"together {total:.3f}\n"
        )


if __name__ == "__main__":
    for scene in sys.argv[1:] or SCENES:
        measure(scene, SCENES.get(scene, 0.3))
