"""New figures over old ones, with bounds of noise from the repeated samples of both."""

from __future__ import annotations

from pathlib import Path

from benchmarks.record import MACHINE, read_json
from benchmarks.timing import Figure


def bounds(old: Figure, new: Figure) -> tuple[float, float]:
    """Return the smallest and the largest ratio new / old that the samples allow."""
    old_low, old_high = (old.value, old.value) if old.low is None or old.high is None else (old.low, old.high)
    new_low, new_high = (new.value, new.value) if new.low is None or new.high is None else (new.low, new.high)
    return new_low / old_high, new_high / old_low


def verdict(low: float, high: float) -> str:
    """Return what the bounds of a ratio say."""
    if low > 1:
        return "more"
    return "less" if high < 1 else "within noise"


def comparison(old: Path, new: Path) -> str:
    """Return a table of the figures that both files have.

    Raises:
        ValueError: a file is no result of a suite, or they have no figure in common.
    """
    before, after = read_json(old), read_json(new)
    lines = [f"{'record':<72} {'figure':<18} {'old':>11} {'new':>11} {'new/old':>8}  {'noise':<17} change"]
    for name in (n for n in before if n in after):
        figures = after[name].figures
        for label, figure in before[name].figures.items():
            other = figures.get(label)
            if other is None or figure.value <= 0 or other.value <= 0 or (figure.low or figure.value) <= 0:
                continue
            low, high = bounds(figure, other)
            ratio, noise = other.value / figure.value, f"[{low:.3f}, {high:.3f}]"
            numbers = f"{figure.value:>11.4g} {other.value:>11.4g} {ratio:>8.3f}"
            lines.append(f"{name:<72} {label:<18} {numbers}  {noise:<17} {verdict(low, high)}")
    if len(lines) == 1:
        raise ValueError(f"{old} and {new} have no figure in common")
    machines = [r[MACHINE].facts.get("hardware", {}).get("cpu") if MACHINE in r else None for r in (before, after)]
    if machines[0] != machines[1]:
        lines.append(f"not the same machine: {machines[0]} and {machines[1]}; compare ratios to peers, not seconds")
    return "\n".join(lines)
