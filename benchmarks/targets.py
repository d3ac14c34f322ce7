"""The figures to reach, and what was measured of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from warp_lcp.benchmarks.record import MACHINE, SOURCE, Record, Table, read_json
from warp_lcp.benchmarks.timing import Figure

ENGINE = "ProjectedMultigrid"
NOT_MEASURED = "not measured here"
# at most so many times the multigrid linear solve, both cold with a workspace that has solved before
METHODS = {"MinimumMapNewton": 1.7, "MPRGP": 2.0, "FischerNewton": 4.0, "InteriorPoint": 8.0, "InteriorPoint, crossover": 5.0}


@dataclass(frozen=True)
class Target:
    """A figure to reach: `at_least` or at most `limit`; `figure` is None where it was not measured."""

    what: str
    limit: float
    figure: Figure | None
    unit: str = ""
    at_least: bool = False

    @property
    def met(self) -> bool | None:
        """Whether the median meets it."""
        if self.figure is None:
            return None
        return self.figure.value >= self.limit if self.at_least else self.figure.value <= self.limit

    def row(self) -> list[str]:
        """Return the row of the table."""
        goal = f"{'>=' if self.at_least else '<='} {self.limit:g}{self.unit}"
        if self.figure is None:
            return [self.what, goal, NOT_MEASURED, ""]
        measured = f"{self.figure.value:.3g}{self.unit}"
        if self.figure.low is not None and self.figure.high is not None and self.figure.samples > 1:
            measured += f" ({self.figure.low:.3g} to {self.figure.high:.3g})"
        return [self.what, goal, measured, "yes" if self.met else "no"]


def targets(records: Sequence[Record], out: Path) -> Table:
    """Return the table of figures; those of other suites are read from their files in `out`.

    Solves are judged at 128^3 if that was measured, else at the largest size.
    """
    found, remarks = {r.name: r for r in records}, list[str]()
    for other in ("kernels", "run"):
        if (out / f"{other}.json").is_file():
            theirs = read_json(out / f"{other}.json")
            if MACHINE in found and theirs.get(MACHINE, Record(MACHINE)).facts.get(SOURCE) != found[MACHINE].facts.get(SOURCE):
                remarks.append(f"Figures of the suite {other} are of another state of the code than those of the solves.")
            found = theirs | found
    sizes = sorted({r.facts["n"] for r in records if "n" in r.facts})
    n = 128 if 128 in sizes else sizes[-1]
    failed = Figure(sum(r.value("converged") == 0 for r in records))
    rows = [
        t.row()
        for t in [
            Target("solves that did not converge", 0, failed),
            *_kernels(found),
            *_solves(found, n),
            *_methods(found, n),
            *_iterations(found, sizes),
            *_memory_and_host(found, n),
        ]
    ]
    return Table(f"Figures to reach (solves at {n}^3)", ["figure", "target", "measured", "met?"], rows, " ".join(remarks))


def _get(found: dict[str, Record], record: str, figure: str) -> Figure | None:
    return found[record].figures.get(figure) if record in found else None


def _largest(figures: Sequence[Figure | None]) -> Figure | None:
    """Return the largest of the figures, None if one is missing."""
    there = [f for f in figures if f is not None]
    return max(there, key=lambda f: f.value) if there and len(there) == len(figures) else None


def _kernels(found: dict[str, Record]) -> list[Target]:
    product = "128^3 unit: stencil.product, float32"
    hot = [r for r in found.values() if r.name.startswith("256^3") and r.facts.get("role") == "hot" and "of_copy" in r.figures]
    weakest = min(hot, key=lambda r: r.figures["of_copy"].value, default=None)
    name = "" if weakest is None else f": {weakest.name.partition(': ')[2]}, {weakest.facts['form']}"
    below = sum(r.figures["of_copy"].value < 0.5 for r in hot)
    return [
        Target("7-point product at 128^3 over Numba's, same stencil", 1, _get(found, product, "over Numba product"), " x", True),
        Target("... over Numba's with a constant diagonal", 1, _get(found, product, "over Numba product, constant diagonal"), " x", True),
        Target("... over one thread a cell", 30, _get(found, product, "over Warp, one thread a cell"), " x", True),
        Target(
            f"weakest hot kernel at 256^3, of copy bandwidth{name}", 0.5, None if weakest is None else weakest.figures["of_copy"], "", True
        ),
        Target("hot kernels at 256^3 below half of copy bandwidth", 0, Figure(below) if hot else None, f" of {len(hot)}"),
    ]


def _solves(found: dict[str, Record], n: int) -> list[Target]:
    def of(form: str, bounds: str, figure: str) -> Figure | None:
        return _get(found, f"{n}^3 {form} {bounds} {ENGINE}", figure)

    targets = [Target("linear solve against PyAMG, set-up included", 40, of("unit", "linear", "pyamg_over_this"), " x", True)]
    for bounds in ("walls", "everywhere"):
        targets.append(Target(f"LCP ({bounds}), cold, against that PyAMG solve", 32, of("unit", bounds, "pyamg_over_this"), " x", True))
    for bounds in ("walls", "everywhere"):
        targets.append(Target(f"LCP ({bounds}) over linear, cold", 1.25, of("unit", bounds, "over_linear")))
    for bounds in ("walls", "everywhere"):
        targets.append(Target(f"LCP ({bounds}) over linear, warm after a change of 1 %", 1.1, of("unit", bounds, "warm_over_linear")))
    targets.append(Target("LCP over linear, warm in a running scene", 1.1, _get(found, "dam-break, 3-D: walls", "solve_over_linear")))
    for bounds in ("linear", "walls", "everywhere"):
        targets.append(Target(f"face-coefficient arrays over unit coefficients ({bounds})", 2.5, of("faces", bounds, "over_unit")))
    for form in ("cells 1:100", "arrays 1:100"):
        for bounds in ("linear", "walls"):
            targets.append(Target(f"anisotropic {form} over isotropic iterations ({bounds})", 2, of(form, bounds, "iterations_over_unit")))
    return targets


def _methods(found: dict[str, Record], n: int) -> list[Target]:
    return [
        Target(
            f"{name} ({bounds}) over the multigrid linear solve",
            limit,
            _get(found, f"{n}^3 unit {bounds} {name}", "reuse_over_engine"),
            " x",
        )
        for name, limit in METHODS.items()
        for bounds in ("walls", "everywhere")
    ]


def _iterations(found: dict[str, Record], sizes: Sequence[int]) -> list[Target]:
    def counts(bounds: str) -> list[float]:
        figures = [_get(found, f"{n}^3 unit {bounds} {ENGINE}", "iterations") for n in sizes]
        return [f.value for f in figures if f is not None]

    span = f"{sizes[0]}^3 to {sizes[-1]}^3"
    linear = counts("linear")
    targets = [Target(f"iterations to 1e-6, {span}, linear", 10, Figure(max(linear)) if linear else None)]
    for bounds in ("walls", "everywhere"):
        pairs = list(zip(counts(bounds), linear, strict=False))
        more = Figure(max(a - b for a, b in pairs)) if pairs else None
        targets.append(Target(f"... LCP ({bounds}), more than linear", 2, more))
    for bounds in ("linear", "walls", "everywhere"):
        growth = counts(bounds)
        targets.append(Target(f"... growth, {bounds}", 2, Figure(growth[-1] - growth[0]) if len(growth) > 1 else None))
    return targets


def _memory_and_host(found: dict[str, Record], n: int) -> list[Target]:
    def most(form: str) -> Figure | None:
        return _largest([_get(found, f"{n}^3 {form} {bounds} {ENGINE}", "bytes_per_cell") for bounds in ("linear", "walls", "everywhere")])

    overhead = [_get(found, f"{n}^3 unit {bounds} {ENGINE}", "loop_over_bare") for bounds in ("linear", "walls", "everywhere")]
    host = next((name for name in found if name.endswith("host overhead of a cycle")), "")
    return [
        Target("bytes a cell of the solve, unit coefficients, linear", 45, _get(found, f"{n}^3 unit linear {ENGINE}", "bytes_per_cell")),
        Target("bytes a cell of the solve, unit coefficients, the most", 45, most("unit")),
        Target("bytes a cell of the solve, face arrays, the most", 75, most("faces")),
        Target("host overhead of the cycle, as a graph", 0.1, _get(found, host, "as_graph")),
        Target("... before it is one (a cold solve), as recorded launches", 0.1, _get(found, host, "as_recorded_launches")),
        Target("wl.solve over the method's bare loop (workspace reused), the most", 1.1, _largest(overhead)),
        Target("particle-grid-particle round trip, sorted, 3-D", 150, _get(found, "particles, 3-D", "round_trip"), " ns"),
    ]
