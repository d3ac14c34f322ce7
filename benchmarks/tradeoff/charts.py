"""Tables and charts of what accuracy costs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

from warp_lcp.benchmarks.harness.record import Chart, Lines, Record, Table
from warp_lcp.benchmarks.tradeoff.runs import front_of

PARETO = "Pareto front"
FINEST = "distance_to_finest"
SMALLEST = 1e-16  # that a logarithmic axis shows


def run_chart(scene: str, records: Sequence[Record]) -> list[Chart]:
    """Return the distance to the finest run over the seconds of the runs, the Pareto front marked."""
    label = "mass elsewhere than in the finest reference run [share]"
    return _chart(scene, FINEST, label, "run", [(str(r.facts["curve"]), r) for r in records])


def solve_chart(scene: str, records: Sequence[Record]) -> list[Chart]:
    """Return the error over the seconds of the solves, the Pareto front marked."""
    solves = [(f"{r.facts['method']}, {r.facts['precision']}", r) for r in records if r.facts["kind"] == "solve"]
    return _chart(scene, "error", "error against a converged float64 solution", "solve", solves)


def _chart(scene: str, figure: str, label: str, kind: str, records: Sequence[tuple[str, Record]]) -> list[Chart]:
    """Return the chart of a figure over seconds, none where no record has it."""
    curves: dict[str, tuple[list[float], list[float]]] = defaultdict(lambda: ([], []))
    points = []
    for curve, r in records:
        if (seconds := r.value("seconds")) is not None and (error := r.value(figure)) is not None:
            points.append((seconds, max(abs(error), SMALLEST)))
            for axis, value in zip(curves[curve], points[-1], strict=True):
                axis.append(value)
    if not points:
        return []
    best = [points[i] for i in front_of(points)]
    curves[PARETO] = ([p[0] for p in best], [p[1] for p in best])
    name = f"{scene}-{kind}-{figure.replace('_', '-')}"
    return [Lines(name, f"{scene}: {label}", f"seconds of a {kind}", label, curves, marked=frozenset({PARETO}))]


def run_table(scene: str, records: Sequence[Record]) -> Table:
    """Return the runs, the Pareto front of seconds and distance marked."""
    ran = [r for r in records if r.figures]
    own = [r for r in ran if r.facts["scale"] == 1.0]
    best, best_of_all = _front(own, "distance"), _front(ran, FINEST)
    columns = ["settings", "", "seconds", "steps", "iterations", "MB", "distance", "to the finest", "energy", "front [m]", "volume"]
    columns.append("packing")
    rows = []
    for r in records:
        preset = str(r.facts["curve"]).startswith("preset ")
        name = f"{r.facts['curve']}: {r.facts['settings']}" if preset else str(r.facts["settings"])
        if not r.figures:
            rows.append([name, "failed", *[""] * (len(columns) - 3), str(r.facts["failed"])[:120]])
            continue
        f = {key: figure.value for key, figure in r.figures.items()}
        seen = [f"{f['distance']:.4f}", f"{f['distance_to_finest']:.4f}", f"{f['energy_error']:.4f}", f"{f['front_error']:+.4f}"]
        more = [f"{f[key]:+.4f}" if key in f else "" for key in ("volume_drift", "packing")]
        cost = [f"{f['seconds']:.3f}", f"{f['steps']:.0f}", f"{f['iterations']:.0f}", f"{f['bytes'] / 1e6:.1f}"]
        rows.append([name, _mark(r, best, best_of_all), *cost, *seen, *more])
    remark = (
        "seconds: the least of all rounds, of the steps alone. distance: share of the mass that is elsewhere than in a run of the same "
        "resolution with the smallest steps and tolerance, in boxes of two cells of the scene, the mean over the frames compared; to the "
        "finest: than in such a run of twice the resolution. Pareto: no other setting of this resolution is faster and nearer to its "
        "reference; Pareto, all: no other one at all is faster and nearer to the finest. energy, front: largest relative and last "
        "difference from the reference. volume: its growth. packing: of the densest cell of sand."
    )
    return Table(f"{scene}: runs", columns, rows, remark)


def _front(records: Sequence[Record], figure: str) -> set[str]:
    """Return the names of the records on the Pareto front of seconds and a figure."""
    return {records[i].name for i in front_of([(r.figures["seconds"].value, r.figures[figure].value) for r in records])}


def _mark(record: Record, best: set[str], best_of_all: set[str]) -> str:
    return ", ".join(["Pareto"] * (record.name in best) + ["Pareto, all"] * (record.name in best_of_all))


def solve_table(scene: str, records: Sequence[Record]) -> Table:
    """Return the solves, the Pareto front of seconds and error marked."""
    solved = [r for r in records if r.facts["kind"] == "solve"]
    best = _front(solved, "error")
    rows = []
    for r in solved:
        f = {key: figure.value for key, figure in r.figures.items()}
        size = f"{f['bytes'] / 1e6:.1f}" if "bytes" in f else ""
        named = [str(r.facts["method"]), str(r.facts["precision"]), f"{r.facts['tolerance']:g}", "Pareto" if r.name in best else ""]
        cost = [f"{f['seconds']:.4f}", f"{f['iterations']:.0f}", size]
        rows.append([*named, *cost, f"{f['residual']:.2e}", f"{f['error']:.2e}", str(r.facts.get("status", ""))])
    reference = next(r for r in records if r.facts["kind"] == "reference")
    remark = (
        "Liquid: problems recorded in a run, from its own first guess; error: relative, in the energy norm, against a float64 solution of "
        f"relative residual {reference.value('residual'):.1e}. Sand: whole steps from states of a run; error: root mean square of the "
        "particles' velocity difference over g dt, residual in units of rho g dx."
    )
    columns = ["method", "precision", "tolerance", "", "seconds", "iterations", "MB", "residual", "error", "status"]
    return Table(f"{scene}: solves", columns, rows, remark)


def preset_table(scene: str, records: Sequence[Record]) -> Table:
    """Return what the presets cost and lose."""
    presets = [r for r in records if str(r.facts["curve"]).startswith("preset ") and r.figures]
    slowest = max((r.figures["seconds"].value for r in presets), default=0.0)
    rows = []
    for r in presets:
        f = {key: figure.value for key, figure in r.figures.items()}
        last = f.get("volume_drift", f.get("packing", 0.0))
        seen = [f"{f['distance']:.4f}", f"{f['energy_error']:.4f}", f"{f['front_error']:+.4f}", f"{last:+.4f}"]
        name = str(r.facts["curve"]).removeprefix("preset ")
        rows.append([name, str(r.facts["settings"]), f"{f['seconds']:.3f}", f"{slowest / f['seconds']:.1f}", *seen])
    columns = ["preset", "settings", "seconds", "times faster", "distance", "energy", "front [m]", "volume or packing"]
    return Table(f"{scene}: presets", columns, rows, "At the same resolution; columns as below.")
