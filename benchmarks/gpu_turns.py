"""Interleaved timing of two source trees on a GPU.

Run it in the source tree:

    git archive COMMIT | tar -x -C out/base    # the other tree, before python -m
        benchmarks.gpu_turns --base out/base --out benchmarks/results/DEVICE

Workers, a process each, do the same work one after another: this tree, this tree with a cell a
thread (`WARP_LCP_QUADS=0`), and the other tree. The work is cold solves, solves by methods for
grids, and steps of a liquid, of sand and of floating bodies; steps on large grids come last.
`turns.json` and the page `turns.md` are written after each piece of work. Pieces that would begin
after `--seconds` are left out, and one that takes a minute more is stopped. `--verdict` runs
`benchmarks.gpu` after that. `--rehearse` does all of it at small sizes, on the CPU in CUDA's form
(`benchmarks/emulated_cuda.py`).
"""

import importlib
import sys

if __name__ == "__main__" and "--rehearse" in sys.argv and "--worker" in sys.argv:
    importlib.import_module("benchmarks.emulated_cuda")  # must precede the package

# ruff: isort: split

import argparse
import json
import os
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypedDict, TypeVar

Answer = dict[str, float | str]  # figures and words of a piece of work


class WorkItem(TypedDict):
    """A piece of work and the answers of the workers."""

    kind: str
    name: str
    cells: int
    found: dict[str, Answer]


ROOT = Path(__file__).resolve().parents[1]
ANSWER = "ANSWER "  # begins a worker's line with an answer
METHODS = (
    "ProjectedMultigrid",
    "MinimumMapNewton",
    "PrimalDualActiveSet",
    "MPRGP",
    "InteriorPoint",
    "FischerNewton",
    "AcceleratedProjectedGradient",
    "ProjectedSOR",
)
SCENES = {"liquid": "dam-break", "sand": "column-collapse", "bodies": "floating-bodies"}
MOST_ITERATIONS = 200  # of a method: some need thousands
BEFORE, TIMED = 10, 10  # steps until the material moves, and timed steps
SOLVES = 3  # timed solves, of which the fastest counts
LONGER = 60  # [s] that the last piece of work may take beyond the limit


@dataclass(frozen=True)
class WorkSizes:
    """Cells along an axis, for each kind of work."""

    solves: tuple[int, ...] = (128, 256, 512)
    methods: int = 128
    steps: tuple[int, ...] = (64, 128, 256)
    before: int = BEFORE
    timed: int = TIMED


SMALL = WorkSizes(solves=(16,), methods=8, steps=(16,), before=1, timed=1)


def pieces(sizes: WorkSizes) -> Iterator[tuple[str, str, int]]:
    """Yield the pieces of work: kind, method or scene, and cells along an axis.

    Steps on large grids come last: they take longest, and a time limit may leave them out.
    """
    for n in sizes.solves:
        yield "cold solve", "ProjectedMultigrid", n
    for name in SCENES:
        yield "step", name, sizes.steps[0]
    for name in METHODS[1:]:
        yield "solve", name, sizes.methods
    for n in sizes.steps[1:]:
        for name in SCENES:
            yield "step", name, n


ResultT = TypeVar("ResultT")


def timed(work: Callable[[], ResultT]) -> tuple[float, ResultT]:
    """Return the time of some work on the device [s], and its result."""
    import warp as wp

    wp.synchronize()
    start = time.perf_counter()
    found = work()
    wp.synchronize()
    return time.perf_counter() - start, found


def solve(method: str, n: int, device: str) -> dict[str, float | str]:
    """Return the least time of a cold solve to 1e-6 [ms], iterations and status."""
    import warp_lcp as wl
    from warp_lcp.benchmarks.problems import splash

    problem = splash(n).lcp("walls", device=device)
    made = getattr(wl, method)()
    workspace = made.init(problem)
    stopping = wl.StoppingCriteria(rtol=1e-6, max_iterations=MOST_ITERATIONS)
    work = lambda: wl.solve(problem, made, stopping=stopping, workspace=workspace)  # noqa: E731
    work()  # loads kernels and captures graphs
    times, results = zip(*(timed(work) for _ in range(SOLVES)), strict=True)
    last = results[-1]
    return {"ms": 1e3 * min(times), "iterations": last.iterations, "status": last.status.name}


def step(scene: str, n: int, device: str, sizes: WorkSizes) -> dict[str, float | str]:
    """Return the mean time of a step of a scene [ms]."""
    from warp_lcp.scene.scene_file import load_scene
    from warp_lcp.scene.simulator import simulators

    loaded = load_scene(SCENES[scene], [f"domain.resolution={n}"])
    kind = simulators()[loaded.scene.simulator]
    simulation = kind.create(loaded, device=device, folder=Path.cwd())

    def steps(count: int) -> None:
        for _ in range(count):
            simulation.step(simulation.stable_dt())

    steps(sizes.before)
    seconds, _ = timed(lambda: steps(sizes.timed))
    return {"ms": 1e3 * seconds / sizes.timed}


def worker(device: str, sizes: WorkSizes) -> None:
    """Read requests from the standard input, a line each, and answer by lines."""
    for line in sys.stdin:
        kind, name, n = json.loads(line)
        try:
            found = step(name, n, device, sizes) if kind == "step" else solve(name, n, device)
        except Exception as error:  # a failure is recorded, and the next piece of work follows
            found = {"error": f"{type(error).__name__}: {error}"[:300]}
        print(f"\n{ANSWER}{json.dumps(found)}", flush=True)


class TreeWorker:
    """A process that does the work from a source tree.

    Args:
        tree: of the package.
        quads: value of `WARP_LCP_QUADS`.
        rehearse: whether it runs on the CPU in CUDA's form.
        device: Warp device.
    """

    def __init__(self, tree: Path, quads: str, *, rehearse: bool, device: str) -> None:
        environment = {**os.environ, "PYTHONPATH": str(tree), "WARP_LCP_QUADS": quads}
        command = [sys.executable, "-P", __file__, "--worker", "--device", device]
        self._process = subprocess.Popen(
            [*command, *["--rehearse"] * rehearse],
            cwd=tree,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def ask(self, piece: tuple[str, str, int]) -> Answer:
        """Return the result of a piece of work."""
        asked, answers = self._process.stdin, self._process.stdout
        assert asked is not None
        assert answers is not None
        try:
            asked.write(f"{json.dumps(piece)}\n")
            asked.flush()
        except BrokenPipeError:
            return {"error": "its process has ended"}
        for line in answers:
            if line.startswith(ANSWER):
                return json.loads(line.removeprefix(ANSWER))
        return {"error": f"its process has ended with {self._process.wait()}"}

    def end(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()


def end_all(workers: Iterable[TreeWorker]) -> None:
    """End the processes of workers."""
    for one in workers:
        one.end()


@dataclass
class InterleavedTurns:
    """All pieces of work by all workers, with the results so far."""

    out: Path
    names: list[str]
    rows: list[WorkItem] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    def add(self, piece: tuple[str, str, int], found: dict[str, Answer]) -> None:
        """Add the results of a piece of work, and write the files."""
        kind, name, n = piece
        self.rows.append({"kind": kind, "name": name, "cells": n, "found": found})
        self.write()

    def write(self) -> None:
        """Write the results so far as JSON and as a page."""
        kept = {"workers": self.names, "work": self.rows, "left_out": self.left_out}
        (self.out / "turns.json").write_text(json.dumps(kept, indent=1) + "\n")
        (self.out / "turns.md").write_text("\n".join(self.page()) + "\n")

    def page(self) -> Iterator[str]:
        """Yield the lines of the page."""
        yield "# Two source trees in turns"
        yield ""
        yield "Milliseconds; iterations of solves to 1e-6. Written by `benchmarks/gpu_turns.py`."
        yield ""
        yield f"| work | cells | {' | '.join(self.names)} |"
        yield "|---|---|" + "---|" * len(self.names)
        for row in self.rows:
            cells = [shown(row["found"].get(name, {})) for name in self.names]
            yield f"| {row['kind']}: {row['name']} | {row['cells']} | {' | '.join(cells)} |"
        if self.left_out:
            yield ""
            yield f"Left out, for the time was over: {', '.join(self.left_out)}."


def shown(figures: Answer) -> str:
    """Return the text of a piece of work's results, for the page."""
    if "ms" not in figures:
        return str(figures.get("error", ""))
    if "iterations" not in figures:
        return f"{figures['ms']:.3g}"
    status = "" if figures["status"] == "CONVERGED" else f", {figures['status']}"
    return f"{figures['ms']:.3g} in {figures['iterations']}{status}"


def run(options: argparse.Namespace) -> int:
    """Time all pieces of work, interleaved; return the exit status."""
    start_time, sizes = time.monotonic(), SMALL if options.rehearse else WorkSizes()
    options.out.mkdir(parents=True, exist_ok=True)
    device = "cpu" if options.rehearse else options.device
    trees = {"this tree": (ROOT, "1"), "this tree, a cell a thread": (ROOT, "0")}
    if options.base is not None:
        trees["other tree"] = options.base.resolve(), "1"
    workers = {
        name: TreeWorker(tree, quads, rehearse=options.rehearse, device=device)
        for name, (tree, quads) in trees.items()
    }
    turns = InterleavedTurns(options.out, list(workers))
    limit = threading.Timer(options.seconds + LONGER, end_all, [workers.values()])
    limit.daemon = True
    limit.start()
    try:
        wanted = [piece for piece in pieces(sizes) if options.only in f"{piece[0]}: {piece[1]}"]
        for turn, piece in enumerate(wanted):
            if time.monotonic() - start_time > options.seconds:
                turns.left_out.append(" ".join(map(str, piece)))
                continue
            order = list(workers)
            order = order[turn % len(order) :] + order[: turn % len(order)]
            turns.add(piece, {name: workers[name].ask(piece) for name in order})
            print(list(turns.page())[-1], flush=True)
    finally:
        limit.cancel()
        end_all(workers.values())
    turns.write()
    print(
        f"{options.out}/turns.md and turns.json ({time.monotonic() - start_time:.0f} s)", flush=True
    )
    return verdict(options) if options.verdict else 0


def verdict(options: argparse.Namespace) -> int:
    """Run `benchmarks.gpu`; return its exit status."""
    command = [sys.executable, "-m", "benchmarks.gpu", "--out", str(options.out)]
    command += ["--rehearse"] if options.rehearse else ["--device", options.device]
    command += ["--seconds", str(options.verdict)]
    return subprocess.run(command, cwd=ROOT, check=False).returncode


def main() -> int:
    """Time two trees, or run as a worker."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--base", type=Path, help="folder of the other source tree")
    parser.add_argument("--out", type=Path, default=Path("out/turns"))
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--seconds", type=float, default=300, help="no work begins after these")
    parser.add_argument(
        "--verdict", type=float, metavar="SECONDS", help="of `benchmarks.gpu`, at most"
    )
    parser.add_argument("--only", default="", help="work whose name has this, as `step: sand`")
    parser.add_argument("--rehearse", action="store_true", help="small, on the CPU in CUDA's form")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.worker:
        worker("cpu" if given.rehearse else given.device, SMALL if given.rehearse else WorkSizes())
        return 0
    return run(given)


if __name__ == "__main__":
    sys.exit(main())
