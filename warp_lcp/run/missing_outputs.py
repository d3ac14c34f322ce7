"""Find missing log rows and frames when a run is resumed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path

from warp_lcp.frames.frame_folder import FrameFolder
from warp_lcp.run.checkpoint import CheckpointError, CheckpointFolder
from warp_lcp.run.log import rows_until
from warp_lcp.simulation import Part


def gaps(
    logs: Mapping[Path, Sequence[str]],
    frames: FrameFolder,
    checkpoints: CheckpointFolder,
    *,
    step: int,
    times: Sequence[float],
    frame: Sequence[Part],
) -> list[str]:
    """Return a line for each kind of files with gaps, with a remedy.

    Checkpoints that the remedy needs are kept.

    Args:
        logs: columns of log.csv and of the tables beside it.
        frames: the run's frames.
        checkpoints: the run's checkpoints.
        step: step from which the run continues.
        times: times of the frames up to there, beginning with frame 0 [s].
        frame: the parts of a frame of this run.

    Raises:
        OutputError: the log has other columns.
    """
    lines = []
    for log, columns in logs.items():
        rows = {int(row.split(",", 1)[0]) for row in rows_until(log, ",".join(columns), step)[1:]}
        steps = sorted({*range(1, step + 1)} - rows)
        if steps:
            again = _again(checkpoints, partial(_precedes, steps[0]))
            lines.append(f"{log.name}: rows of steps {spans(steps)} are missing; {again}")
    missing = {
        name: numbers
        for name in frames.kinds(frame)
        if (numbers := frames.missing(name, len(times)))
    }
    if missing:
        first = times[min(min(numbers) for numbers in missing.values())]
        listed = ", ".join(f"{name} {spans(numbers)}" for name, numbers in missing.items())
        lines.append(
            f"{frames.frames.name}: {listed} are missing or truncated; "
            f"{_again(checkpoints, lambda _, time: time < first)}"
        )
    missing_series = [
        part.name
        for part in frame
        if frames.has_collection(part) and not (frames.folder / f"{part.name}.pvd").is_file()
    ]
    return [
        *lines,
        *(f"{name}.pvd: was missing; rebuilt from the existing frames" for name in missing_series),
    ]


def spans(numbers: Iterable[int]) -> str:
    """Return increasing numbers in words, such as `3 to 5, 8`."""
    ends: list[list[int]] = []
    for number in numbers:
        if ends and ends[-1][1] == number - 1:
            ends[-1][1] = number
        else:
            ends.append([number, number])
    return ", ".join(str(low) if low == high else f"{low} to {high}" for low, high in ends)


def _precedes(first: int, step: int, time: float) -> bool:
    """Return whether a checkpoint's step is before another."""
    return step < first


def _again(checkpoints: CheckpointFolder, is_before: Callable[[int, float], bool]) -> str:
    """Return how to recompute missing output.

    `is_before` tells whether a checkpoint's step and time are before it.
    """
    steps = checkpoints.steps()
    for newer, step in pairwise(steps):
        try:
            if is_before(step, checkpoints.read(step).time):
                checkpoints.spared.add(step)
                away = (
                    f" of step {newer}"
                    if newer == steps[0]
                    else f"s of steps {newer} to {steps[0]}"
                )
                return (
                    f"to recompute them, move the checkpoint{away} away and resume from step {step}"
                )
        except CheckpointError:
            continue
    return "no earlier checkpoint exists: only --force (start again) recomputes them"
