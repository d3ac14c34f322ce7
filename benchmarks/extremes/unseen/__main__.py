"""Solve problems by kind and seed: `python -m warp_lcp.benchmarks.extremes.unseen KIND[,KIND] FIRST [LAST]`, KIND may be all."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from warp_lcp.benchmarks.extremes.case import judge
from warp_lcp.benchmarks.extremes.unseen import KINDS
from warp_lcp.benchmarks.extremes.unseen.judging import EveryMethodCase, UnseenCase, summary


def main(arguments: Sequence[str]) -> None:
    """Print a line a problem and the table of all."""
    small = [a for a in arguments if a == "--every-method"]
    kind, first, *last = [a for a in arguments if a not in small]
    make = EveryMethodCase if small else UnseenCase
    verdicts = []
    for name in KINDS if kind == "all" else kind.split(","):
        for seed in range(int(first), int(last[0] if last else first) + 1):
            verdicts.append(judge(make(name, seed), "mixed", "cpu"))
            attempt = verdicts[-1].attempt
            counts = ", ".join(f"{key} {attempt.facts[key]}" for key in ("iterations", "equality", "warm", "cold") if key in attempt.facts)
            n = attempt.facts.get("unknowns", "few")
            line = f"{name} {seed}: {attempt.status}, {n} unknowns, {counts}, {attempt.seconds:.2f} s: {verdicts[-1].outcome}"
            sys.stdout.write(f"{line}\n")
            sys.stdout.flush()
    if small:
        return
    table, wrong = summary(verdicts, int(first))
    sys.stdout.write("\n".join([table.remark, " | ".join(table.columns), *(" | ".join(row) for row in table.rows), *wrong]) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
