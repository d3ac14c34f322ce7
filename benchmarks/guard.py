"""A small part of the suite `solvers` that tells in seconds whether the engine has lost against PyAMG: the same records, one size."""

from __future__ import annotations

from pathlib import Path

import warp_lcp as wl
from warp_lcp.benchmarks.cases import RTOL, Case
from warp_lcp.benchmarks.machine import cpu_model, machine
from warp_lcp.benchmarks.peers.linear import pyamg_aggregation
from warp_lcp.benchmarks.peers.peer import Question
from warp_lcp.benchmarks.problems import BOUNDS, splash
from warp_lcp.benchmarks.record import MACHINE, Record, Results, Table, read_json
from warp_lcp.benchmarks.timing import Options, ratios

TITLE = "Ratios to PyAMG"
SIZE = 64
COPIED = 1 << 22
RESULTS = Path(__file__).parent / "results"


def measure(options: Options, out: Path) -> Results:
    """Measure the engine and PyAMG in turns."""
    where = machine(options.device, elements=COPIED, repeat=options.repeat)
    records = []
    for n in options.sizes or (SIZE,):
        scene = splash(n)
        cases = [Case("unit", scene, bounds, wl.ProjectedMultigrid(), options.device) for bounds in BOUNDS]
        question, peer = Question(scene, "linear"), list[float]()
        for turn in range(options.repeat + 1):  # the first one loads kernels
            for case in cases:
                case.cold(keep=turn > 0)
            total = pyamg_aggregation(question, RTOL).total
            peer += [total] if turn > 0 else []
        for case in cases:
            figures = case.figures() | {"pyamg_over_this": ratios(peer, case.samples["total"])}
            records.append(Record(case.name, figures, {"bounds": case.bounds, "n": n}))
    table = Table("Seconds of PyAMG over ours", ["case", "ratio"], [[r.name, str(r.figures["pyamg_over_this"])] for r in records])
    return Results([where, *records], [table])


def kept(suite: str) -> dict[str, Record] | None:
    """Return the results of a suite that are kept for this processor; None without any."""
    for path in sorted(RESULTS.glob(f"*/{suite}.json")):
        found = read_json(path)
        if MACHINE in found and found[MACHINE].facts["hardware"]["cpu"] == cpu_model():
            return found
    return None
