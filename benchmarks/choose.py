"""Suite `choose`: rules of `wl.recommend` against all applicable methods.

The problems are random, drawn by kind and seed. Each method solves each problem cold, set-up
included, to the same relative residual. The methods of a problem take turns. A rule is judged by
three figures: the share of its problems that its method solves, the method's time over that of the
best method, and the problems that only its alternatives solve. `docs/generate/choice_figures.py`
writes the table of docs/choosing-a-method.md from the stored results.
"""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import warp_lcp as wl
from warp_lcp.benchmarks.choose_problems import KINDS, RARE, draw
from warp_lcp.benchmarks.harness.machine import machine
from warp_lcp.benchmarks.harness.record import BenchmarkRecord, RecordTable, Results
from warp_lcp.benchmarks.harness.timing import Figure, Options, clock
from warp_lcp.method_rules import RULES, method_for, steps_allowed
from warp_lcp.recommend import Recommendation, memory_of

TITLE = "Rules that choose a method"
SEED = 860  # first seed; the tests draw other seeds
RTOL = 1e-6
LONGEST = 4.0  # [s] limit of one trial
ROUNDS = 2  # samples of each method after its first trial, which loads kernels
# A method slower than NEAR times the fastest and than BRIEF [s] keeps the time of its first trial.
NEAR, BRIEF = 4.0, 5e-3
# A choice is right within this factor of the best method, or within this many seconds.
SLOWER, NEGLIGIBLE = 2.0, 5e-4
BUDGETS = (5, 20, 100)  # steps
DEFAULT = "default"  # `wl.solve` without a method: the method of the rule, then its alternatives


@dataclass
class ChoiceTrial:
    """Solves of one problem by one method."""

    seconds: list[float] = field(default_factory=list)
    status: str = "refused"
    iterations: int = 0

    @property
    def solved(self) -> bool:
        """Return whether the residual criterion was met."""
        return self.status == wl.SolveStatus.CONVERGED.name

    @property
    def best(self) -> float:
        """Return the least time [s]."""
        return min(self.seconds)


def measure(options: Options, out: Path) -> Results:
    """Solve `repeat` problems of each kind by every applicable method."""
    seed = SEED if options.seed is None else options.seed
    records = [machine(options.device, repeat=options.repeat)]
    for kind in (*KINDS, *RARE):
        for number in range(seed, seed + options.repeat):
            records.append(problem_record(f"{kind} {number}", draw(kind, number), options.device))
        options.say(f"choose, {kind}: {_summary(records[-options.repeat :])}")
    return Results(
        records, [rule_table(records[1:]), kind_table(records[1:]), budget_table(records[1:])]
    )


def problem_record(name: str, problem: wl.LCP, device: str) -> BenchmarkRecord:
    """Return times and outcomes of all methods on a problem, and the applicable rule."""
    advice = wl.recommend(problem, accuracy=RTOL)
    trials = try_methods(problem, advice, device)
    t = advice.traits
    figures = {"unknowns": Figure(t.unknowns)}
    figures |= {
        method: Figure.least(trial.seconds, "s")
        for method, trial in trials.items()
        if trial.seconds
    }
    facts = {
        "kind": name.rpartition(" ")[0],
        "rule": rule_number(advice),
        "method": advice.name,
        "alternatives": list(advice.alternatives),
        "operator": t.kind,
        "symmetric": t.symmetric,
        "bounds": t.bounds,
        "diagonal": t.diagonal,
        "status": {method: trial.status for method, trial in trials.items()},
        "iterations": {method: trial.iterations for method, trial in trials.items()},
        "budgets": budget_choices(problem, advice),
    }
    return BenchmarkRecord(name, figures, facts)


def rule_number(advice: Recommendation) -> int:
    """Return the number of a recommendation's rule in the decision list, from 1 on."""
    return 1 + next(i for i, rule in enumerate(RULES) if advice.reasons[0] == f"{rule.reason}.")


def try_methods(problem: wl.LCP, advice: Recommendation, device: str) -> dict[str, ChoiceTrial]:
    """Return the trials by method: one each, then ROUNDS interleaved samples.

    Only methods near the fastest get interleaved samples.
    """
    t = advice.traits

    def solver(name: str) -> Callable[[], wl.SolveResult]:
        limit = (
            advice.stopping.max_iterations
            if name == advice.name
            else steps_allowed(name, t.unknowns)
        )
        stopping = wl.StoppingCriteria(
            rtol=RTOL, max_iterations=limit, patience=max(30, limit // 10), max_seconds=LONGEST
        )
        return lambda: wl.solve(problem, method_for(name, t), stopping=stopping)

    solvers = {name: solver(name) for name in t.able}
    solvers[DEFAULT] = lambda: wl.solve(problem)
    trials = {name: ChoiceTrial() for name in solvers}
    for name, solve in solvers.items():
        sample(trials[name], solve, device)
    solved = [trial.best for trial in trials.values() if trial.solved]
    slowest = max(NEAR * min(solved, default=0.0), BRIEF)
    kept = {DEFAULT, advice.name}
    repeated = [
        name
        for name, trial in trials.items()
        if trial.solved and (trial.best <= slowest or name in kept)
    ]
    for name in repeated:
        trials[name].seconds.clear()  # the first trial may have loaded kernels
    for _ in range(ROUNDS):
        for name in repeated:
            sample(trials[name], solvers[name], device)
    return trials


def sample(trial: ChoiceTrial, solve: Callable[[], wl.SolveResult], device: str) -> None:
    """Add one cold solve to a trial."""
    wl.release_workspace()
    now = clock(device)
    begun = now()
    try:
        result = solve()
    except ValueError:  # the method refuses this A
        return
    trial.seconds.append(now() - begun)
    trial.status, trial.iterations = result.status.name, result.iterations


def budget_choices(problem: wl.LCP, advice: Recommendation) -> dict[str, str]:
    """Return the method for each step budget, and for the memory of sweeps."""
    if advice.traits.affine:  # the method does not depend on the budget
        return {}
    recommended = {
        f"{steps} steps": wl.recommend(
            problem, accuracy=RTOL, budget=wl.Budget(iterations=steps)
        ).name
        for steps in BUDGETS
    }
    lean = memory_of("psor", advice.traits)
    return {
        **recommended,
        "memory of a sweep": wl.recommend(
            problem, accuracy=RTOL, budget=wl.Budget(bytes=lean)
        ).name,
    }


def solved_by(record: BenchmarkRecord) -> dict[str, float]:
    """Return the seconds of the methods that solved a problem, the default excluded."""
    status: Mapping[str, str] = record.facts["status"]
    names = (
        name for name, s in status.items() if s == wl.SolveStatus.CONVERGED.name and name != DEFAULT
    )
    return {name: record.figures[name].value for name in names}


def over_best(record: BenchmarkRecord, name: str) -> float | None:
    """Return a method's time over that of the best method; None if it failed."""
    solved, status = solved_by(record), record.facts["status"]
    if status.get(name) != wl.SolveStatus.CONVERGED.name:
        return None
    seconds = record.figures[name].value
    return seconds / min([*solved.values(), seconds])


def is_right(record: BenchmarkRecord, name: str) -> bool:
    """Return whether a method solved a problem nearly as fast as the best method."""
    ratio = over_best(record, name)
    if ratio is None:
        return False
    seconds = record.figures[name].value
    return ratio <= SLOWER or seconds - seconds / ratio <= NEGLIGIBLE


def rule_row(number: int, records: Sequence[BenchmarkRecord]) -> list[str]:
    """Return the table row of a rule.

    The columns are problems, solved, time over the best, the best methods, the gain of the
    alternatives, and the default.
    """
    own_records = [r for r in records if r.facts["rule"] == number]
    method = RULES[number - 1].method
    if not own_records:
        return [str(number), f"`{method}`", "0", *[""] * 5]
    ratios = [x for r in own_records if (x := over_best(r, method)) is not None]
    failed = [r for r in own_records if over_best(r, method) is None]
    fastest = Counter(
        min(found, key=lambda name: found[name]) for r in own_records if (found := solved_by(r))
    )
    added = Counter(
        next((a for a in r.facts["alternatives"] if a in solved_by(r)), "none") for r in failed
    )
    default = sum(r.facts["status"][DEFAULT] == wl.SolveStatus.CONVERGED.name for r in own_records)
    return [
        str(number),
        f"`{method}`",
        str(len(own_records)),
        str(len(ratios)),
        f"{statistics.median(ratios):.2f} ({max(ratios):.1f})" if ratios else "",
        ", ".join(f"`{name}` {n}" for name, n in fastest.most_common(3)),
        ", ".join(
            f"`{name}` {n}" if name != "none" else f"none {n}" for name, n in added.most_common()
        ),
        str(default),
    ]


RULE_COLUMNS = [
    "rule",
    "method",
    "problems",
    "solved",
    "x best (most)",
    "best",
    "alternatives add",
    "solved by default",
]


def rule_table(records: Sequence[BenchmarkRecord]) -> RecordTable:
    """Return a row for each rule."""
    rows = [rule_row(number, records) for number in range(1, len(RULES) + 1)]
    remark = (
        f"To {RTOL:g}, cold, set-up included, at most {LONGEST:g} s a solve. x best: median time "
        "of the rule's method over the fastest "
        "method's (worst). Best: how often each method was the fastest. Alternatives add: of "
        "problems that the rule's method left, the "
        "first alternative that solves them. By default: rule's method and alternatives, no limit "
        "of time."
    )
    return RecordTable("Rules", RULE_COLUMNS, rows, remark)


def kind_table(records: Sequence[BenchmarkRecord]) -> RecordTable:
    """Return a row for each kind of problem."""
    rows = []
    for kind in dict.fromkeys(r.facts["kind"] for r in records):
        own_records = [r for r in records if r.facts["kind"] == kind]
        ratios = [x for r in own_records if (x := over_best(r, DEFAULT)) is not None]
        rules = Counter(r.facts["rule"] for r in own_records)
        right = sum(is_right(r, DEFAULT) for r in own_records)
        cells = [
            kind,
            ", ".join(map(str, sorted(rules))),
            str(len(own_records)),
            str(len(ratios)),
            str(right),
        ]
        rows.append(
            [*cells, f"{statistics.median(ratios):.2f} ({max(ratios):.1f})" if ratios else ""]
        )
    columns = ["kind", "rules", "problems", "solved by default", "near the best", "x best (most)"]
    remark = (
        f"Near the best: within {SLOWER:g} times the fastest method's time or "
        f"{1e3 * NEGLIGIBLE:g} ms, the choice included."
    )
    return RecordTable("Kinds of problems", columns, rows, remark)


def budget_table(records: Sequence[BenchmarkRecord]) -> RecordTable:
    """Return a row for each step budget.

    The row says how often the recommended method solves within the budget, and how often any method
    can.
    """
    rows = []
    for budget in (*(f"{steps} steps" for steps in BUDGETS), "memory of a sweep"):
        own_records = [r for r in records if budget in r.facts["budgets"]]
        most = int(budget.split()[0]) if budget.endswith("steps") else None
        within = [
            [n for n in solved_by(r) if most is None or r.facts["iterations"][n] <= most]
            for r in own_records
        ]
        hits = sum(
            r.facts["budgets"][budget] in names
            for r, names in zip(own_records, within, strict=True)
        )
        rows.append([budget, str(len(own_records)), str(hits), str(sum(map(bool, within)))])
    remark = (
        "Solved: the method that `wl.recommend` names for the budget has solved the problem "
        "within its steps."
    )
    return RecordTable(
        "Budgets",
        ["budget", "problems", "solved", "solved by any method, in any memory"],
        rows,
        remark,
    )


def _summary(records: Sequence[BenchmarkRecord]) -> str:
    right = sum(is_right(r, DEFAULT) for r in records)
    rules = sorted({r.facts["rule"] for r in records})
    return f"default near the best on {right} of {len(records)}, rules {', '.join(map(str, rules))}"
