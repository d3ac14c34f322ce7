"""Suite `peers`: this library and other solvers on the same problems.

All solve to the same residual, interleaved in one run.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import warp_lcp as wl
from warp_lcp.benchmarks.cases import RTOL, SolverCase
from warp_lcp.benchmarks.harness.machine import COPIED, machine
from warp_lcp.benchmarks.harness.record import (
    MACHINE,
    Bars,
    BenchmarkRecord,
    RecordTable,
    RecordTarget,
    Results,
    shown,
    spread,
    table_of_targets,
)
from warp_lcp.benchmarks.harness.timing import Figure, Options, ratios
from warp_lcp.benchmarks.peers.peer import Peer, PeerAnswer, PeerFailed, PeerProblem
from warp_lcp.benchmarks.peers.peer_list import PeerList, roster
from warp_lcp.benchmarks.problems import BOUNDS, splash

TITLE = "Pressure solves against peers"
SIZES = (32, 64, 128)
ENGINE = "ProjectedMultigrid"
BUDGET = 60.0  # [s] after which a peer gets no more rounds at a size
LONGEST = 300.0  # [s] limit of the expected time of a solve, extrapolated from the size before
# Factors of the tolerance, tried until the residual is the required one.
TIGHTER = (1.0, 0.3, 0.1, 0.03, 0.01, 1e-3, 1e-4, 1e-5, 1e-6)
SLACK = 1.01  # factor of the residual, since sums have another order
GROWTH = 4 / 3  # least exponent of the expected time, for solves whose iterations grow


@dataclass
class PeerComparison:
    """Peer on one problem, with its answers."""

    peer: Peer  # the solver
    question: PeerProblem  # the problem
    # Tolerance given to the peer, such that its residual is the required one.
    tolerance: float = RTOL
    answers: list[PeerAnswer] = field(default_factory=list)  # one for each round
    residual: float = float("nan")  # residual of the last answer
    remark: str = ""  # why there are no answers

    def calibrate(self) -> None:
        """Find the loosest tolerance that gives the required residual.

        The answer before it counts as a warm-up.
        """
        start_time = time.perf_counter()
        for factor in TIGHTER:
            self.tolerance = factor * RTOL
            try:
                answer = self.peer.solve(self.question, self.tolerance)
            except PeerFailed as error:
                self.remark = str(error)
                return
            self.residual = self.question.residual(answer.x)
            if self.residual <= SLACK * RTOL:
                if answer.total > BUDGET / 3:  # too slow for another round
                    self.answers.append(answer)
                return
            if time.perf_counter() - start_time > BUDGET:
                break
        self.remark = f"residual {self.residual:.1e} at the least"

    def again(self) -> None:
        """Take a sample, unless the peer has failed or used its time."""
        if not self.remark and sum(a.total for a in self.answers) < BUDGET:
            try:
                self.answers.append(self.peer.solve(self.question, self.tolerance))
            except PeerFailed as error:
                self.remark = str(error)

    def record(self, ours: SolverCase) -> BenchmarkRecord:
        """Return the measured figures, with the ratio to ours in the same rounds."""
        peer, scene = self.peer, self.question.scene
        facts = {
            "n": scene.n,
            "bounds": self.question.bounds,
            "method": peer.name,
            "precision": peer.precision,
            "settings": peer.settings,
        }
        name = f"{scene.n}^3 {self.question.bounds} {peer.name}"
        if not self.answers or self.remark:
            return BenchmarkRecord(name, {}, facts | {"remark": self.remark})
        figures = {
            part: Figure.of([getattr(a, part) for a in self.answers], "s")
            for part in ("setup", "solve", "total")
        }
        last = self.answers[-1]
        figures |= {
            "iterations": Figure(last.iterations),
            "residual": Figure(self.residual),
            "asked": Figure(self.tolerance),
        }
        if last.linear_iterations is not None:
            figures["linear_iterations"] = Figure(last.linear_iterations)
        totals = [a.total for a in self.answers]
        figures["over_engine"] = ratios(totals, ours.samples["total"][: len(totals)])
        return BenchmarkRecord(name, figures, facts)


def measure(options: Options, out: Path) -> Results:
    """Measure all solvers at the requested sizes."""
    sizes = sorted(options.sizes or SIZES)
    where = machine(
        options.device, elements=min(COPIED, 64 * max(sizes) ** 3), repeat=options.repeat
    )
    records, seconds = [where], dict[tuple[str, str], tuple[int, float]]()
    with roster(options.device) as available:
        where.facts["peers"] = available.versions
        for name, text in available.versions.items():
            if not text[:1].isdigit():
                options.say(f"{name}: {text}")
        for n in sizes:
            found = _measure_size(n, available, seconds, options)
            records += found
            seconds |= {
                (r.facts["method"], r.facts["bounds"]): (n, t)
                for r in found
                if (t := r.value("total"))
            }
    n = max(sizes)
    asked = RecordTable(
        "Who was asked",
        ["library", "version"],
        [[name, text] for name, text in available.versions.items()],
    )
    tables = [_targets(records, n), asked, *(_table(m, records) for m in sizes)]
    return Results(records, tables, [_bars(bounds, records) for bounds in BOUNDS])


def _measure_size(
    n: int, roster: PeerList, seconds: dict[tuple[str, str], tuple[int, float]], options: Options
) -> list[BenchmarkRecord]:
    """Measure one sample of each solver in every round."""
    scene = splash(n)
    cases = {
        bounds: SolverCase("unit", scene, bounds, wl.ProjectedMultigrid(), options.device)
        for bounds in BOUNDS
    }
    questions = {bounds: PeerProblem(scene, bounds) for bounds in BOUNDS}
    contests = [
        PeerComparison(peer, questions[bounds]) for peer in roster.peers for bounds in peer.bounds
    ]
    for contest in contests:
        peer = contest.peer
        m, last = seconds.get((peer.name, contest.question.bounds), (n, 0.0))
        expected = last * (n / m) ** (3 * GROWTH)
        if n > peer.most:
            contest.remark = f"not asked beyond {peer.most}^3"
        elif expected > LONGEST:
            contest.remark = f"not asked: {expected:.0f} s expected"
        else:
            options.say(f"peers at {n}^3: {contest.question.bounds} {peer.name}")
            contest.calibrate()
    for turn in range(options.repeat + 1):  # the first turn loads kernels
        options.say(f"peers at {n}^3, round {turn} of {options.repeat}")
        for case in cases.values():
            case.cold(keep=turn > 0)
        if turn > 0:
            for contest in contests:
                contest.again()
    ours = [_engine(case) for case in cases.values()]
    return [*ours, *(contest.record(cases[contest.question.bounds]) for contest in contests)]


def _engine(case: SolverCase) -> BenchmarkRecord:
    facts = {
        "n": case.scene.n,
        "bounds": case.bounds,
        "method": case.method,
        "precision": "float64, corrections float32",
    }
    return BenchmarkRecord(
        f"{case.scene.n}^3 {case.bounds} {case.method}",
        case.figures(),
        facts | {"settings": "defaults"},
    )


def _targets(records: Sequence[BenchmarkRecord], n: int) -> RecordTable:
    """Return the targets at the largest size."""

    def least(bounds: str, *names: str) -> Figure | None:
        own_records = [
            r
            for r in records
            if r.facts.get("n") == n
            and r.facts["bounds"] == bounds
            and r.facts["method"].startswith(names)
        ]
        return min(
            (r.figures["over_engine"] for r in own_records if "over_engine" in r.figures),
            key=lambda f: f.value,
            default=None,
        )

    targets = [
        RecordTarget("linear: PyAMG's best", 20, least("linear", "PyAMG"), " x", True),
        RecordTarget("linear: PETSc's CG+MG", 3, least("linear", "PETSc CG+MG"), " x", True),
        RecordTarget("linear: PETSc's best", 3, least("linear", "PETSc"), " x", True),
        *(
            RecordTarget(
                f"{bounds}: PETSc's best SNESVI", 10, least(bounds, "PETSc SNESVI"), " x", True
            )
            for bounds in BOUNDS[1:]
        ),
    ]
    remark = (
        f"Times the engine's seconds in the same rounds, set-up included, at {n}^3, both to a "
        f"relative natural residual of {RTOL:g}."
    )
    return table_of_targets("peer over engine", targets, remark)


def _table(n: int, records: Sequence[BenchmarkRecord]) -> RecordTable:
    columns = [
        "problem",
        "solver",
        "settings",
        "set-up [ms]",
        "solve [ms]",
        "total [ms]",
        "range",
        "iterations",
        "linear",
        "residual",
    ]
    rows = []
    here = [r for r in records if r.facts.get("n") == n]
    for r in sorted(here, key=lambda r: (BOUNDS.index(r.facts["bounds"]), r.value("total") or 1e9)):
        rows.append([r.facts["bounds"], r.facts["method"], r.facts["settings"]])
        if "total" not in r.figures:
            rows[-1] += [*[""] * 7, r.facts["remark"]]
            continue
        rows[-1] += [
            *shown(r, ("setup", "solve", "total"), ".1f", 1e3),
            spread(r.figures["total"], 1e3),
        ]
        rows[-1] += [
            *shown(r, ("iterations", "linear_iterations"), ".0f"),
            *shown(r, ["residual"], ".1e"),
        ]
        rows[-1].append(str(r.figures.get("over_engine", 1)))
    remark = (
        "Peers get the assembled matrix, whose assembly is not counted; the engine's set-up starts "
        "from the arrays of cells and b. "
        "residual: natural, relative, in float64 from the x that came back; a peer's own tolerance "
        "is tightened until it is as asked."
    )
    return RecordTable(f"{n}^3 cells", [*columns, "x the engine's time"], rows, remark)


def _bars(bounds: str, records: Sequence[BenchmarkRecord]) -> Bars:
    """Return the seconds of each solver at the largest size that has any."""
    own_records = [
        r
        for r in records
        if r.name != MACHINE and r.facts["bounds"] == bounds and "total" in r.figures
    ]
    n = max(
        (r.facts["n"] for r in own_records if r.facts["method"] != ENGINE),
        default=max((r.facts["n"] for r in own_records), default=0),
    )
    values = {r.facts["method"]: r.value("total") or 0.0 for r in own_records if r.facts["n"] == n}
    ordered = dict(sorted(values.items(), key=lambda item: item[1]))
    return Bars(bounds, f"{bounds}, {n}^3, cold, to {RTOL:g}", "s", ordered, logarithmic=True)
