"""All that there is to do on a machine with a CUDA device: `python -m benchmarks.gpu --out DIR`. A wheel's dependencies are enough.

Solves on both devices are compared, the CUDA tests run where the source tree and pytest are there, the suites measure the device and the
CPU beside it, and DIR/gpu.md says how each part ended.
"""

from __future__ import annotations

import argparse
import importlib.util
import subprocess
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.machine import machine
from warp_lcp.benchmarks.peers.peer import Question
from warp_lcp.benchmarks.problems import BOUNDS, splash
from warp_lcp.benchmarks.record import Record, Table, read_json, write_markdown
from warp_lcp.benchmarks.side_by_side import side_by_side
from warp_lcp.benchmarks.suite import KERNELS, RUN, SCALING, SOLVERS, Suite

TESTS = Path(__file__).parents[1] / "tests"
METHODS = (wl.ProjectedMultigrid(), wl.MinimumMapNewton(), wl.MPRGP(), wl.FischerNewton())
RTOL, SAME = 1e-6, 1e-4  # of residuals; of solutions found on two devices, relative
AGREEMENT_SIZE = 32


@dataclass(frozen=True)
class Part:
    """What was done: `ended` is empty where it went well."""

    name: str
    ended: str
    found: str = ""


def agreement(device: str, n: int = AGREEMENT_SIZE) -> list[Part]:
    """Solve on the CPU and on the device; residuals are computed by SciPy."""
    parts, scene = [], splash(n)
    for bounds in BOUNDS:
        question = Question(scene, bounds)
        for solver in METHODS:
            results = []
            for where in ("cpu", device):
                problem = wl.LCP(wl.GridPoisson(scene.cells, device=where), scene.b, scene.lower(bounds))
                results.append(wl.solve(problem, solver, stopping=wl.StoppingCriteria(rtol=RTOL)))
            x = [r.x.numpy().ravel()[question.where] for r in results]
            residuals = [question.residual(v) for v in x]
            apart = float(np.linalg.norm(x[0] - x[1]) / np.linalg.norm(x[0]))
            found = f"iterations {results[0].iterations} and {results[1].iterations}, residual {residuals[1]:.1e}, apart {apart:.1e}"
            wrong = "" if max(residuals) <= 1.01 * RTOL and apart <= SAME else "the devices disagree"
            parts.append(Part(f"agreement, {n}^3, {bounds}, {type(solver).__name__}", wrong, found))
    return parts


def tests() -> Part:
    """Run the tests that are marked `cuda`."""
    name = "tests marked cuda"
    if not TESTS.is_dir() or importlib.util.find_spec("pytest") is None:
        return Part(name, "", "not run: they need the source tree and the extra dev")
    done = subprocess.run([sys.executable, "-m", "pytest", "-q", "-m", "cuda and not slow"], cwd=TESTS.parent, check=False)
    return Part(name, "" if done.returncode == 0 else f"pytest ended with exit code {done.returncode}")


def _suite(suite: Suite, device: str, out: Path, sizes: tuple[int, ...], repeat: int) -> Part:
    name = f"suite {suite.name} on {device}"
    try:
        files = suite.run(device=device, out=out, sizes=sizes if suite.resizable else (), repeat=repeat)
    except RuntimeError as error:
        return Part(name, str(error))
    return Part(name, "", ", ".join(str(path.relative_to(out.parent)) for path in files if path.suffix == ".md"))


def _merge(device: str, out: Path) -> Part:
    """Write the two scalings side by side."""
    name = "cpu and device side by side"
    try:
        a, b = read_json(out / "cpu" / "scaling.json"), read_json(out / "device" / "scaling.json")
        table = side_by_side(a, b)
    except ValueError as error:
        return Part(name, str(error))
    write_markdown(out / "side-by-side.md", "CPU and CUDA side by side", b["machine"], [table], [])
    return Part(name, "", "side-by-side.md")


def _attempt(name: str, work: Callable[[], list[Part]]) -> list[Part]:
    """Do a part; what it raises ends it, not the others."""
    try:
        return work()
    except (RuntimeError, ValueError, TypeError, MemoryError) as error:
        traceback.print_exc()
        return [Part(name, f"{type(error).__name__}: {error}")]


def main(arguments: list[str] | None = None) -> None:
    """Do everything and write gpu.md."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=__doc__)
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--size", type=int, action="append", default=[], help="of the suites, instead of their own")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--rehearse", action="store_true", help="take the CPU for the device, to try this program")
    given = parser.parse_args(arguments)
    device = "cpu" if given.rehearse else given.device
    if not given.rehearse and not (wp.is_cuda_available() and wp.is_device_available(device) and wp.get_device(device).is_cuda):
        there = ", ".join(str(d) for d in wp.get_devices())
        sys.stderr.write(
            f"{device}: no such CUDA device; Warp sees {there}. Nothing was measured. --rehearse tries this program on the CPU.\n"
        )
        sys.exit(2)
    out, sizes = given.out, tuple(given.size)
    parts = _attempt("agreement", lambda: agreement(device))
    parts += [] if given.rehearse else _attempt("tests marked cuda", lambda: [tests()])
    for suite in (KERNELS, SOLVERS, SCALING, RUN):
        parts.append(_suite(suite, device, out / "device", sizes, given.repeat))
    parts.append(_suite(SCALING, "cpu", out / "cpu", sizes, given.repeat))
    parts.append(_merge(device, out))
    rows = [[p.name, "ok" if not p.ended else p.ended, p.found] for p in parts]
    where: Record = machine(device, elements=1 << 22, repeat=given.repeat)
    write_markdown(out / "gpu.md", "What ran on the device", where, [Table("Parts", ["part", "ended", "found"], rows)], [])
    sys.stderr.write(f"wrote {out / 'gpu.md'}\n")
    sys.exit(1 if any(p.ended for p in parts) else 0)


if __name__ == "__main__":
    main()
