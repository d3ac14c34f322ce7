"""Tables, sheets and charts of what accuracy costs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

from warp_lcp.benchmarks.record import Chart, Lines, Record, Sheet, Table
from warp_lcp.benchmarks.tradeoff.runs import front_of

PARETO = "Pareto front"
FINEST = "distance_to_finest"
SEEN = {
    "distance": "mass elsewhere than in the reference run of this resolution [share]",
    "distance_to_finest": "mass elsewhere than in the finest reference run [share]",
    "energy_error": "largest error of the energy [share]",
    "front_error": "error of the front at the end [m]",
    "volume_drift": "growth of the volume [share]",
    "packing": "densest cell, less 1",
}
SOLVED = {"residual": "relative residual, recomputed in float64", "error": "error against a converged float64 solution"}
FIGURES = ("seconds", "steps", "iterations", "linear_iterations", "bytes", "residual", *SEEN, "front", "penetration", "error")
SMALLEST = 1e-16  # that a logarithmic axis shows


def run_charts(scene: str, records: Sequence[Record]) -> list[Chart]:
    """Return a chart for each thing that a user sees: its error over the seconds of a run, the Pareto front marked.

    Runs of other resolutions, whose own references are others, count only where all are compared with one, the finest.
    """
    own = [r for r in records if r.facts["scale"] == 1.0]
    return [chart for name, label in SEEN.items() for chart in _charts(scene, records if name == FINEST else own, name, label, "run")]


def solve_charts(scene: str, records: Sequence[Record]) -> list[Chart]:
    """Return residual and error over the seconds of the solves, the Pareto front marked."""
    named = [
        Record(r.name, r.figures, {**r.facts, "curve": f"{r.facts['method']}, {r.facts['precision']}"})
        for r in records
        if r.facts["kind"] == "solve"
    ]
    return [chart for figure, label in SOLVED.items() for chart in _charts(scene, named, figure, label, "solve")]


def _charts(scene: str, records: Sequence[Record], figure: str, label: str, kind: str) -> list[Chart]:
    """Return the chart of a figure over seconds, none where no record has it."""
    curves: dict[str, tuple[list[float], list[float]]] = defaultdict(lambda: ([], []))
    points = []
    for r in records:
        seconds, error = r.value("seconds"), r.value(figure)
        if seconds is None or error is None:
            continue
        point = (seconds, max(abs(error - (figure == "packing")), SMALLEST))
        points.append(point)
        for axis, value in zip(curves[str(r.facts["curve"])], point, strict=True):
            axis.append(value)
    if not points:
        return []
    best = [points[i] for i in front_of(points)]
    curves[PARETO] = ([p[0] for p in best], [p[1] for p in best])
    name = f"{scene}-{kind}-{figure.replace('_', '-')}"
    return [Lines(name, f"{scene}: {label}", f"seconds of a {kind}", label, curves, marked=frozenset({PARETO}))]


def run_sheet(scene: str, records: Sequence[Record]) -> Sheet:
    """Return every setting with all its figures; an empty cell is not known."""
    facts = ("kind", "curve", "settings", "method", "precision", "tolerance", "resolution", "device", "status", "failed")
    rows = []
    for r in records:
        values = [r.value(figure) for figure in FIGURES]
        rows.append([r.name, *(str(r.facts.get(f, "")) for f in facts), *("" if v is None else f"{v:.6g}" for v in values)])
    return Sheet(scene, ["name", *facts, *FIGURES], rows)


def run_table(scene: str, records: Sequence[Record]) -> Table:
    """Return the runs, the Pareto front of seconds and distance marked."""
    ran = [r for r in records if r.figures]
    own = [r for r in ran if r.facts["scale"] == 1.0]
    best, best_of_all = _front(own, "distance"), _front(ran, FINEST)
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
        "packing",
    ]
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
