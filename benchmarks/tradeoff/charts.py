"""Tables and charts of the suite `tradeoff`."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

from warp_lcp.benchmarks.harness.record import (
    BenchmarkRecord,
    Chart,
    RecordLines,
    RecordTable,
    shown,
)
from warp_lcp.benchmarks.tradeoff.runs import front_of

PARETO = "Pareto front"
FINEST = "distance_to_finest"
SMALLEST = 1e-16  # smallest value on a logarithmic axis
RUN_REMARK = (
    "seconds: the least of all rounds, of the steps alone. distance: share of the mass that is "
    "elsewhere than in a run of the same "
    "resolution with the smallest steps and tolerance, in boxes of two cells of the scene, the "
    "mean over the frames compared; to the "
    "finest: than in such a run of twice the resolution. Pareto: no other setting of this "
    "resolution is faster and nearer to its "
    "reference; Pareto, all: no other one at all is faster and nearer to the finest. energy, "
    "front: largest relative and last "
    "difference from the reference. volume: its growth. packing: of the densest cell of sand."
)


def run_chart(scene: str, records: Sequence[BenchmarkRecord]) -> list[Chart]:
    """Return the chart of the distance to the finest run over seconds.

    The Pareto front is marked.
    """
    label = "mass elsewhere than in the finest reference run [share]"
    return _chart(scene, FINEST, label, "run", [(str(r.facts["curve"]), r) for r in records])


def solve_chart(scene: str, records: Sequence[BenchmarkRecord]) -> list[Chart]:
    """Return the chart of the error over the seconds of the solves.

    The Pareto front is marked.
    """
    solves = [
        (f"{r.facts['method']}, {r.facts['precision']}", r)
        for r in records
        if r.facts["kind"] == "solve"
    ]
    return _chart(scene, "error", "error against a converged float64 solution", "solve", solves)


def _chart(
    scene: str, figure: str, label: str, kind: str, records: Sequence[tuple[str, BenchmarkRecord]]
) -> list[Chart]:
    """Return the chart of a figure over seconds; none if no record has it."""
    points = defaultdict[str, list[tuple[float, float]]](list)
    for curve, r in records:
        if (seconds := r.value("seconds")) is not None and (error := r.value(figure)) is not None:
            points[curve].append((seconds, max(abs(error), SMALLEST)))
    if not points:
        return []
    every = [point for curve in points.values() for point in curve]
    points[PARETO] = [every[i] for i in front_of(every)]
    curves = {curve: ([x for x, _ in own], [y for _, y in own]) for curve, own in points.items()}
    name = f"{scene}-{kind}-{figure.replace('_', '-')}"
    return [
        RecordLines(
            name,
            f"{scene}: {label}",
            f"seconds of a {kind}",
            label,
            curves,
            marked=frozenset({PARETO}),
        )
    ]


def _front(records: Sequence[BenchmarkRecord], figure: str) -> set[str]:
    """Return the names of the records on the Pareto front of seconds and a figure."""
    return {
        records[i].name
        for i in front_of([(r.figures["seconds"].value, r.figures[figure].value) for r in records])
    }


def run_table(scene: str, records: Sequence[BenchmarkRecord]) -> RecordTable:
    """Return the table of runs, the Pareto front of seconds and distance marked."""
    ran = [r for r in records if r.figures]
    best, best_of_all = (
        _front([r for r in ran if r.facts["scale"] == 1.0], "distance"),
        _front(ran, FINEST),
    )
    columns = [
        "settings",
        "",
        "seconds",
        "steps",
        "iterations",
        "MB",
        "distance",
        "to the finest",
        "energy",
        "front [m]",
        "volume",
    ]
    rows = []
    for r in records:
        curve, settings = str(r.facts["curve"]), str(r.facts["settings"])
        name = f"{curve}: {settings}" if curve.startswith("preset ") else settings
        if not r.figures:
            rows.append([name, "failed", *[""] * (len(columns) - 2), str(r.facts["failed"])[:120]])
            continue
        mark = ", ".join(["Pareto"] * (r.name in best) + ["Pareto, all"] * (r.name in best_of_all))
        cost = [
            *shown(r, ["seconds"], ".3f"),
            *shown(r, ["steps", "iterations"], ".0f"),
            *shown(r, ["bytes"], ".1f", 1e-6),
        ]
        seen = shown(r, ["distance", FINEST, "energy_error"], ".4f") + shown(
            r, ["front_error", "volume_drift", "packing"], "+.4f"
        )
        rows.append([name, mark, *cost, *seen])
    return RecordTable(f"{scene}: runs", [*columns, "packing"], rows, RUN_REMARK)


def solve_table(scene: str, records: Sequence[BenchmarkRecord]) -> RecordTable:
    """Return the table of solves, the Pareto front of seconds and error marked."""
    solved = [r for r in records if r.facts["kind"] == "solve"]
    best = _front(solved, "error")
    rows = []
    for r in solved:
        named = [
            str(r.facts["method"]),
            str(r.facts["precision"]),
            f"{r.facts['tolerance']:g}",
            "Pareto" if r.name in best else "",
        ]
        cost = [
            *shown(r, ["seconds"], ".4f"),
            *shown(r, ["iterations"], ".0f"),
            *shown(r, ["bytes"], ".1f", 1e-6),
        ]
        rows.append(
            [*named, *cost, *shown(r, ["residual", "error"], ".2e"), str(r.facts.get("status", ""))]
        )
    reference = next(r for r in records if r.facts["kind"] == "reference")
    remark = (
        "Liquid: problems recorded in a run, from its own first guess; error: relative, in the "
        "energy norm, against a float64 solution of "
        f"relative residual {reference.value('residual'):.1e}. Sand: whole steps from states of a "
        "run; error: root mean square of the "
        "particles' velocity difference over g dt, residual in units of rho g dx."
    )
    columns = [
        "method",
        "precision",
        "tolerance",
        "",
        "seconds",
        "iterations",
        "MB",
        "residual",
        "error",
        "status",
    ]
    return RecordTable(f"{scene}: solves", columns, rows, remark)


def preset_table(scene: str, records: Sequence[BenchmarkRecord]) -> RecordTable:
    """Return the table of the presets' costs and errors."""
    presets = [r for r in records if str(r.facts["curve"]).startswith("preset ") and r.figures]
    slowest = max((r.figures["seconds"].value for r in presets), default=0.0)
    rows = []
    for r in presets:
        last = [figure for figure in ("volume_drift", "packing") if figure in r.figures][:1]
        visible = (
            shown(r, ["distance", "energy_error"], ".4f")
            + [*shown(r, ["front_error", *last], "+.4f"), "+0.0000"][:2]
        )
        times = [*shown(r, ["seconds"], ".3f"), f"{slowest / r.figures['seconds'].value:.1f}"]
        rows.append(
            [
                str(r.facts["curve"]).removeprefix("preset "),
                str(r.facts["settings"]),
                *times,
                *visible,
            ]
        )
    columns = [
        "preset",
        "settings",
        "seconds",
        "times faster",
        "distance",
        "energy",
        "front [m]",
        "volume or packing",
    ]
    return RecordTable(
        f"{scene}: presets", columns, rows, "At the same resolution; columns as below."
    )
