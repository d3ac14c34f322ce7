"""Check the library on a GPU and write a report: `python -m benchmarks.gpu`.

Run it in the source tree; the report is one page in out/gpu. It measures times, and the share of
the memory bandwidth that kernels reach. Then it checks on the device what holds on the CPU: equal
answers, also of each kernel; the same bits in every run; graphs against single launches; odd grids;
hundreds of steps; constant memory use. The estimates of `benchmarks/gpu_model.py` stand beside the
times. Failed checks are reported as well. `--rehearse` does all of it on the CPU in CUDA's form
(`benchmarks/emulated_cuda.py`).

Each check runs in a process of its own (`benchmarks/claim_processes.py`): first those that measure,
alone; then the others, several at the same time, because most of their time is compilation on one
core. With `--seconds` the checks that are left are stopped after so long, and named in the report.
"""

import importlib
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import warp as wp

if "--rehearse" in sys.argv:
    importlib.import_module("benchmarks.emulated_cuda")  # must precede the package

# ruff: isort: split

import argparse
import functools
import json
import math
import os
import shutil
import subprocess
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from unittest import mock

import numpy as np
import warp as wp

import warp_lcp as wl
from benchmarks.claim_processes import ClaimProcess, run_all
from warp_lcp.benchmarks import gpu_cases, kernels
from warp_lcp.benchmarks.harness.machine import machine
from warp_lcp.benchmarks.harness.record import BenchmarkRecord, RecordTable
from warp_lcp.benchmarks.harness.report import markdown
from warp_lcp.benchmarks.harness.timing import Options
from warp_lcp.benchmarks.problems import natural, splash
from warp_lcp.kernels.launch_graph import CommandBuffer, LaunchGraph, loops_on_device
from warp_lcp.subproblems.device_iteration import DeviceIteration

CLOSE, ALIKE = 1e-5, 2e-2  # relative: for solutions to 1e-8, and for particles after many steps
WRONG = 3  # exit status of `benchmarks.gpu_kernels` where kernels differ
CAPTURE_LAUNCH = wp.capture_launch
ROOT = Path(__file__).resolve().parents[1]


@dataclass
class GpuCheck:
    """One check: whether it passed, and its details."""

    name: str
    holds: bool
    found: str


@dataclass(frozen=True)
class Claim:
    """A claim, the method of `GpuVerdict` that checks it, and whether that measures times."""

    name: str
    method: str
    measures: bool = False


# In the order in which they begin: those that need the machine alone, then the longest ones.
CLAIMS = (
    Claim("residuals by NumPy", "residuals", measures=True),
    Claim("times", "times", measures=True),
    Claim("bandwidth of kernels", "bandwidth", measures=True),
    Claim("answers equal the CPU's", "agreement"),
    Claim("kernels agree with the CPU's, one by one", "each_kernel"),
    Claim("the same bits in every run", "repeats"),
    Claim("steps from graphs are those from launches", "step_graphs"),
    Claim("steps without the host are the host's", "ahead"),
    Claim("graphs do what launches do", "graphs"),
    Claim("a step waits for the device twice", "waiting"),
    Claim("memory stays", "memory"),
    Claim("grids without unknowns are refused", "empty"),
    Claim("times are estimated", "estimates"),
    Claim("compute-sanitizer finds nothing", "sanitized"),
)


class GpuVerdict:
    """All checks of a device.

    Args:
        device: Warp device.
        rehearsal: whether the device is the CPU in CUDA's form, and all problems are small.
        out: folder of the report.
    """

    def __init__(self, device: str, *, rehearsal: bool, out: Path) -> None:
        self.device, self.rehearsal, self.out = device, rehearsal, out
        self.claims: list[GpuCheck] = []
        self.tables: list[RecordTable] = []
        self.left_out: list[str] = []
        self.steps = 10 if rehearsal else gpu_cases.STEPS

    def claim(self, name: str, check: Callable[[], str | None]) -> None:
        """Run one check and record its outcome.

        `check` returns the text to report. It raises AssertionError if the check fails, and returns
        None if the check cannot be made.
        """
        start = time.perf_counter()
        try:
            text, holds = check(), True
        except AssertionError as error:
            text, holds = str(error), False
        except Exception as error:  # any failure of an unknown machine is a result
            text, holds = (
                f"{type(error).__name__}: {error} "
                f"({traceback.extract_tb(error.__traceback__)[-1].name})",
                False,
            )
        if text is not None:
            self.claims.append(GpuCheck(name, holds, text))
            print(
                f"{'PASS' if holds else 'FAIL'}  {name}: {text} ({time.perf_counter() - start:.0f} "
                "s)",
                flush=True,
            )

    def check(self, method: str) -> None:
        """Check one claim in this process, and write its results for `all`."""
        (claim,) = (one for one in CLAIMS if one.method == method)
        self.claim(claim.name, getattr(self, method))
        results = {
            "claims": [asdict(c) for c in self.claims],
            "tables": [asdict(t) for t in self.tables],
        }
        self._results(claim).write_text(json.dumps(results))

    def all(self, workers: int, seconds: float) -> None:
        """Check all claims, each in a process.

        Args:
            workers: number of processes at the same time; those that measure times run alone.
            seconds: time limit [s].
        """
        claims = {claim.name: claim for claim in CLAIMS}
        command = [sys.executable, "-m", "benchmarks.gpu", "--device", self.device]
        command += ["--out", str(self.out), *["--rehearse"] * self.rehearsal]
        tasks = []
        (self.out / "model.md").unlink(missing_ok=True)
        for claim in CLAIMS:
            self._results(claim).unlink(missing_ok=True)
            tasks.append(
                ClaimProcess(claim.name, [*command, "--claim", claim.method], claim.measures)
            )
        for name, status in run_all(tasks, ROOT, workers, seconds):
            self._take(claims[name], status)
            self.write()  # the results survive if this process ends early

    def _results(self, claim: Claim) -> Path:
        """Return the file of a claim's results."""
        return self.out / f"claim-{claim.method}.json"

    def _take(self, claim: Claim, status: int | None) -> None:
        """Add the results of a claim's process, which ended with a status; None: out of time."""
        if status is None:
            self.left_out.append(claim.name)
        elif not self._results(claim).exists():
            self.claims.append(GpuCheck(claim.name, False, f"its process ended with {status}"))
            print(f"FAIL  {claim.name}: its process ended with {status}", flush=True)
        else:
            results = json.loads(self._results(claim).read_text())
            self.claims += [GpuCheck(**one) for one in results["claims"]]
            self.tables += [RecordTable(**one) for one in results["tables"]]
            self._results(claim).unlink()

    def agreement(self) -> str:
        """Compare all cases with those of a process on the CPU."""
        path = self.out / "cpu.npz"
        command = [sys.executable, "-m", "benchmarks.gpu_cases", str(path), "cpu", str(self.steps)]
        # Both compile for minutes, so they run at the same time.
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL) as on_cpu:
            results = gpu_cases.everything(self.device, self.steps)
            assert on_cpu.wait() == 0, f"the process on the CPU ended with {on_cpu.returncode}"
        wrong: list[str] = []
        worst = 0.0
        with np.load(path) as expected:
            wrong += [f"{name} only here" for name in results.keys() - expected.keys()]
            for name, x in expected.items():
                if name not in results:
                    wrong.append(f"{name} not here")
                    continue
                scale, bound = np.abs(x).max() or 1.0, ALIKE if "steps" in name else CLOSE
                off = float(np.abs(results[name] - x).max() / scale)
                worst = max(worst, off / bound)
                if not off <= bound:
                    wrong.append(f"{name} is off by {off:.1e}")
        assert not wrong, "; ".join(sorted(wrong))
        assert worst > 0.0, "every bit is the CPU's: this was no other device"
        return f"{len(results)} cases, at most {worst:.1g} of what is allowed"

    def each_kernel(self) -> str:
        """Compare each kernel's results on the device with those on the CPU.

        The comparison runs in a process of its own, so that a crash there does not end the report.
        """
        command = [
            sys.executable,
            "-m",
            "benchmarks.gpu_kernels",
            self.device,
            *["--rehearse"] * self.rehearsal,
        ]
        done = subprocess.run(
            command, cwd=ROOT, check=False, capture_output=True, text=True, timeout=900
        )
        last_line = (done.stdout.splitlines() or [""])[-1]
        assert done.returncode == 0, (
            last_line
            if done.returncode == WRONG
            else f"ended with {done.returncode}: {done.stderr[-500:]}"
        )
        return last_line

    def residuals(self) -> str:
        """Evaluate residuals of a splash in NumPy, without code of the solvers."""
        scene, n = splash(32 if self.rehearsal else 128), 32 if self.rehearsal else 128
        problem = scene.lcp("walls", device=self.device)
        result = wl.solve(problem, wl.ProjectedMultigrid(), stopping=wl.StoppingCriteria(rtol=1e-7))
        lower = np.where(scene.wall, 0.0, -np.inf)
        start, end = (
            np.linalg.norm(natural(scene.cells, scene.b, lower, x))
            for x in (np.zeros(scene.cells.shape), result.x.numpy())
        )
        assert end <= 1.1e-7 * start, (
            f"{end / start:.1e} at {n}^3, where the solver says {result.relative_residual:.1e}"
        )
        return f"{end / start:.1e} of the start's at {n}^3 in {result.iterations} iterations"

    def repeats(self) -> str:
        """Solve and step twice; compare the bits."""
        first, second = (gpu_cases.large(self.device, 32) for _ in range(2))
        other = [name for name, x in first.items() if not np.array_equal(x, second[name])]
        for name in ("dam-break", "column-collapse-2d"):
            for step, (a, b) in enumerate(
                zip(
                    *(gpu_cases.states(name, self.device, self.steps) for _ in range(2)),
                    strict=True,
                )
            ):
                if not all(np.array_equal(a[key], b[key]) for key in a):
                    other.append(f"{name} from step {step} on")
                    break
        assert not other, f"differ: {', '.join(other)}"
        return f"{len(first)} solves and {self.steps} steps of two scenes"

    def graphs(self) -> str:
        """Solve with single launches; compare the bits with those of graphs."""
        recorded = gpu_cases.large(self.device, 32)
        with (
            mock.patch.object(CommandBuffer, "_captured", lambda _, commands: list(commands)),
            mock.patch.object(wp, "capture_launch", launched),
        ):
            alone = gpu_cases.large(self.device, 32)
        other = [name for name, x in recorded.items() if not np.array_equal(x, alone[name])]
        assert not other, f"differ: {', '.join(other)}"
        return f"{len(alone)} solves, bit for bit"

    def step_graphs(self) -> str:
        """Step scenes with `LaunchGraph.on_device` and without; compare the bits."""
        other, names = [], ("dam-break", "column-collapse-2d")
        for name in names:
            taken = []
            for on in (False, True):
                with mock.patch.object(LaunchGraph, "on_device", on):
                    taken.append(list(gpu_cases.states(name, self.device, self.steps)))
            for step, (a, b) in enumerate(zip(*taken, strict=True)):
                if not all(np.array_equal(a[key], b[key]) for key in a):
                    other.append(f"{name} from step {step} on")
                    break
        assert not other, f"differ: {', '.join(other)}"
        return f"{self.steps} steps of {' and '.join(names)}, bit for bit"

    def ahead(self) -> str | None:
        """Solve, and step a liquid, with convergence tests on the host; compare the bits.

        By default the tests run on the device.
        """
        if not loops_on_device(wp.get_device(self.device)):
            return None

        def both() -> dict[str, np.ndarray]:
            *_, last = gpu_cases.states("dam-break", self.device, self.steps)
            return gpu_cases.large(self.device, 32) | last

        found = both()
        with mock.patch.object(DeviceIteration, "suits", lambda work: False):
            judged = both()
        other = [name for name, x in found.items() if not np.array_equal(x, judged[name])]
        assert not other, f"differ: {', '.join(other)}"
        return f"{len(found) - 2} solves and {self.steps} steps of a liquid, bit for bit"

    def waiting(self) -> str | None:
        """Count the readbacks in steps of a liquid.

        Steps with a density correction are left out.
        """
        if not loops_on_device(wp.get_device(self.device)):
            return None
        simulation, counts = gpu_cases.simulation("dam-break", self.device), []
        with mock.patch.object(
            wp.array, "numpy", autospec=True, side_effect=wp.array.numpy
        ) as read:
            for _ in range(self.steps):
                read.reset_mock()
                row = simulation.step(min(simulation.stable_dt(), gpu_cases.DT))
                counts += [] if row.get("density_status") else [read.call_count]
        # The first steps load kernels.
        assert max(counts[2:]) <= 2, f"up to {max(counts[2:])} times"
        return f"{len(counts) - 2} steps"

    def empty(self) -> str:
        """Check that problems without unknowns are rejected."""
        for shape in ((3, 3), (4, 5, 6)):
            try:
                wl.LCP(wl.GridPoisson(np.full(shape, wl.AIR), device=self.device), np.zeros(shape))
            except ValueError:
                continue
            raise AssertionError(f"{shape} of AIR is taken")
        return "2-D and 3-D"

    def memory(self) -> str | None:
        """Step a liquid; compare the memory in use after half of the steps and after all."""
        if self.rehearsal:
            return None
        used = []
        for step, _ in enumerate(gpu_cases.states("dam-break", self.device, 2 * self.steps)):
            if step % self.steps == self.steps - 1:
                used.append(wp.get_mempool_used_mem_current(self.device))
        assert used[1] <= 1.05 * used[0], (
            f"{used[0] / 1e6:.0f} MB after {self.steps} steps, {used[1] / 1e6:.0f} after "
            f"{2 * self.steps}"
        )
        return f"{used[1] / 1e6:.0f} MB after {2 * self.steps} steps"

    def sanitized(self) -> str | None:
        """Run the small cases under NVIDIA's sanitizer, where it is installed."""
        tool = shutil.which("compute-sanitizer")
        if tool is None or self.rehearsal:
            return None
        cases = [
            sys.executable,
            "-m",
            "benchmarks.gpu_cases",
            str(self.out / "sanitized.npz"),
            self.device,
            "2",
        ]
        done = subprocess.run(
            [tool, "--error-exitcode", "9", *cases],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=600,
            check=False,
        )
        assert done.returncode == 0, done.stdout[-500:]
        return "memcheck"

    def times(self) -> str:
        """Time cold solves and steps."""
        rows, steps = [], []
        for n in (16, 32) if self.rehearsal else (128, 256, 512):
            problem, method = splash(n).lcp("walls", device=self.device), wl.ProjectedMultigrid()
            workspace, seconds = method.init(problem), []
            for _ in range(4):  # the first one loads kernels and captures graphs
                wp.synchronize()
                start = time.perf_counter()
                result = wl.solve(
                    problem, method, stopping=wl.StoppingCriteria(rtol=1e-6), workspace=workspace
                )
                wp.synchronize()
                seconds.append(time.perf_counter() - start)
            rows.append(
                [
                    f"{n}^3",
                    f"{1e3 * min(seconds[1:]):.1f}",
                    str(result.iterations),
                    result.status.name,
                ]
            )
        self.tables.append(
            RecordTable(
                "Cold solves of a splash to 1e-6", ["cells", "ms", "iterations", "status"], rows
            )
        )
        assert all(row[-1] == "CONVERGED" for row in rows), rows
        for n in (16,) if self.rehearsal else (64, 128):
            steps.append(
                [f"{n}", *(f"{1e3 * self._step_time(n, on_device=on):.1f}" for on in (False, True))]
            )
        self.tables.append(
            RecordTable("Steps of the dam break", ["cells along x", "ms", "ms, step graphs"], steps)
        )
        return ", ".join(
            [
                *(f"{cells} {ms} ms" for cells, ms, *_ in rows),
                *(f"a step at {n} {ms} ms, from graphs {graphs}" for n, ms, graphs in steps),
            ]
        )

    def estimates(self) -> str:
        """Write the model's tables of solves and steps, which need no device."""
        cells = ("16", "16") if self.rehearsal else ("128", "64")
        report = subprocess.run(
            [
                sys.executable,
                "-m",
                "benchmarks.gpu_model",
                "--cells",
                cells[0],
                "--step-cells",
                cells[1],
            ],
            cwd=ROOT,
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        (self.out / "model.md").write_text(report)
        return f"from a solve of {cells[0]}^3 cells and steps of {cells[1]} along x"

    def _step_time(self, n: int, *, on_device: bool) -> float:
        """Return the time of a dam break step [s], by CUDA graphs or single launches.

        `LaunchGraph.on_device` selects graphs.
        """
        with mock.patch.object(LaunchGraph, "on_device", on_device):
            simulation = gpu_cases.simulation("dam-break", self.device, n)
            for count in (10, 20):  # steps until it moves, and timed steps
                wp.synchronize()
                start = time.perf_counter()
                for _ in range(count):
                    simulation.step(simulation.stable_dt())
                wp.synchronize()
        return (time.perf_counter() - start) / count

    def bandwidth(self) -> str:
        """Measure the bandwidth of the kernels on the finest grid."""
        n = 16 if self.rehearsal else 256
        found = kernels.measure(
            Options(self.device, (n,), 1 if self.rehearsal else 5, lambda _: None), self.out
        )
        self.tables += found.tables
        return f"{sum(len(t.rows) for t in found.tables[1:])} kernels at {n}^3"

    @functools.cached_property
    def machine(self) -> BenchmarkRecord:
        """Record of the device and its machine."""
        return machine(self.device, elements=1 << 20)

    def write(self) -> None:
        """Write the report, and the file of results."""
        rows = [["PASS" if c.holds else "FAIL", c.name, c.found] for c in self.claims]
        tables = [RecordTable("Claims", ["", "claim", "found"], rows), *self.tables]
        record = self.machine
        order = [claim.name for claim in CLAIMS]
        rows.sort(key=lambda row: order.index(row[1]))
        lines = [
            f"# Verdict on {self.device}{' (a rehearsal on the CPU)' if self.rehearsal else ''}",
            "",
            f"`{json.dumps(record.facts)}`",
            "",
        ]
        if self.left_out:
            lines += [f"Left out, because the time was over: {', '.join(self.left_out)}.", ""]
        for table in tables:
            lines += [f"## {table.title}", "", *markdown(table), ""]
        if (model := self.out / "model.md").exists():
            lines += ["", "## What was foretold", "", model.read_text()]
        (self.out / "verdict.md").write_text("\n".join(lines) + "\n")
        kept = {
            "device": record.facts,
            "claims": [asdict(c) for c in self.claims],
            "tables": [asdict(t) for t in self.tables],
            "left_out": self.left_out,
        }
        (self.out / "verdict.json").write_text(json.dumps(kept, indent=1))


def launched(graph: wp.Graph | list[wp.Launch]) -> None:
    """Launch the commands of a graph.

    A graph that loops on the device stays a graph.
    """
    if isinstance(graph, list):
        for command in graph:
            command.launch()
    else:
        CAPTURE_LAUNCH(graph)


def main() -> int:
    """Run all checks; return 1 if one fails or is left out, 2 if there is no device."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--rehearse",
        action="store_true",
        help="small rehearsal on the CPU, with the CUDA code paths",
    )
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--out", type=Path, default=Path("out/gpu"))
    parser.add_argument(
        "--seconds", type=float, default=math.inf, help="time limit; checks are left out after it"
    )
    parser.add_argument(
        "--workers", type=int, help="checks at the same time; by default half of the cores, up to 8"
    )
    parser.add_argument("--claim", choices=[c.method for c in CLAIMS], help=argparse.SUPPRESS)
    options = parser.parse_args()
    if not options.rehearse and not wp.is_cuda_available():
        print("no CUDA device: use `--rehearse` for a rehearsal on the CPU", file=sys.stderr)
        return 2
    options.out.mkdir(parents=True, exist_ok=True)
    verdict = GpuVerdict(
        "cpu" if options.rehearse else options.device,
        rehearsal=options.rehearse,
        out=options.out.resolve(),
    )
    if options.claim:
        verdict.check(options.claim)
        return 0
    verdict.all(options.workers or default_workers(), options.seconds)
    verdict.write()
    print(f"{options.out}/verdict.md and verdict.json")
    if verdict.left_out:
        print(f"left out: {', '.join(verdict.left_out)}")
    return int(bool(verdict.left_out) or any(not c.holds for c in verdict.claims))


def default_workers() -> int:
    """Return half of the cores of this process, 1 to 8."""
    return min(max(len(os.sched_getaffinity(0)) // 2, 1), 8)


if __name__ == "__main__":
    sys.exit(main())
