"""Comparison of new results with old ones, within their noise.

Bounds of the noise come from the repeated samples of both.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from warp_lcp.benchmarks.harness.record import MACHINE, BenchmarkRecord, read_json
from warp_lcp.benchmarks.harness.timing import Figure

ALLOWED = 0.25  # share of a ratio to a peer that may be lost
# Ratios of a peer's time to ours, in the same rounds. They are comparable across versions of the
# code and across machines.
TO_PEERS = (
    "pyamg_over_this",
    "over_engine",
    "over_ours",
    "over Numba product",
    "over Numba product, constant diagonal",
)


def bounds(old: Figure, new: Figure) -> tuple[float, float]:
    """Return the smallest and the largest ratio new / old that the samples allow."""
    (old_low, old_high), (new_low, new_high) = old.range, new.range
    return new_low / old_high, new_high / old_low


def losses(
    old: Mapping[str, BenchmarkRecord], new: Mapping[str, BenchmarkRecord], allowed: float = ALLOWED
) -> list[str]:
    """Return a line for each ratio to a peer that fell by more than `allowed`.

    It has fallen whichever samples of the two are compared.
    """
    lines = []
    for name in (n for n in old if n in new):
        for label in (f for f in TO_PEERS if f in old[name].figures and f in new[name].figures):
            before, after = old[name].figures[label], new[name].figures[label]
            low, high = bounds(before, after)
            if high < 1 - allowed:
                lines.append(
                    f"{name}: {label} {before} fell to {after}, to [{low:.2f}, {high:.2f}] of it"
                )
    return lines


def comparison(old: Path, new: Path) -> str:
    """Return a table of the figures common to both files.

    Raises:
        ValueError: a file is no result of a suite, or they have no figure in common.
    """
    before, after = read_json(old), read_json(new)
    lines = [
        f"{'record':<72} {'figure':<18} {'old':>11} {'new':>11} {'new/old':>8}  {'noise':<17} "
        "change"
    ]
    for name in (n for n in before if n in after):
        figures = after[name].figures
        for label, figure in before[name].figures.items():
            other = figures.get(label)
            if (
                other is None
                or figure.value <= 0
                or other.value <= 0
                or (figure.low or figure.value) <= 0
            ):
                continue
            low, high = bounds(figure, other)
            ratio, noise = other.value / figure.value, f"[{low:.3f}, {high:.3f}]"
            numbers = f"{figure.value:>11.4g} {other.value:>11.4g} {ratio:>8.3f}"
            change = "more" if low > 1 else "less" if high < 1 else "within noise"
            lines.append(f"{name:<72} {label:<18} {numbers}  {noise:<17} {change}")
    if len(lines) == 1:
        raise ValueError(f"{old} and {new} have no figure in common")
    lost = losses(before, after)
    lines += [f"lost against a peer: {line}" for line in lost]
    if not lost and any(f in r.figures for r in after.values() for f in TO_PEERS):
        lines.append(f"no ratio to a peer fell by more than {100 * ALLOWED:.0f} % beyond noise")
    machines = [_hardware(r) for r in (before, after)]
    if machines[0] != machines[1]:
        lines.append(
            f"not the same machine: {machines[0]} and {machines[1]}; compare ratios to peers, not "
            "seconds"
        )
    return "\n".join(lines)


def _hardware(records: Mapping[str, BenchmarkRecord]) -> str:
    """Return processor and device of a result."""
    hardware = records[MACHINE].facts.get("hardware", {}) if MACHINE in records else {}
    return ", ".join(str(hardware[part]) for part in ("cpu", "device") if part in hardware)
