"""One case of the suite `solvers`: scene, bounds, method and its measurements."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.harness.machine import array_bytes, forget_peak, resident_bytes
from warp_lcp.benchmarks.harness.timing import Figure
from warp_lcp.benchmarks.problems import Splash, warm_changes
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.problem.method_protocol import Solver

RTOL = 1e-6
# A method without fallbacks may need hundreds of steps, and its residual may rise for more steps
# than the default patience allows.
STOPPING = wl.StoppingCriteria(rtol=RTOL, max_iterations=1000, patience=1000)
TOLERANCES = (1e-4, 1e-6, 1e-8)
MIDST = 3  # iterations after which a method has allocated all of its buffers


@dataclass
class SolverCase:
    """Solve that is measured repeatedly."""

    form: str  # coefficients: `unit`, `faces`, `cells 1:100`, `arrays 1:100`
    scene: Splash  # the scene
    bounds: str  # unknowns with p >= 0: a name of BOUNDS
    solver: Solver  # settings of the method
    device: str  # Warp device
    full: bool = True  # whether reuse, warm starts and time to tolerances are measured too
    label: str = ""  # display name of the method; its class name if empty
    # Makes the operator from cells, a device and face coefficients.
    operator: Callable[..., wl.Operator] = wl.GridPoisson
    samples: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    counts: dict[str, float] = field(default_factory=dict)
    history: list[wl.Record] = field(default_factory=list)
    _warm: Iterator[tuple[float, int]] | None = None

    @property
    def method(self) -> str:
        """Display name of the method."""
        return self.label or type(self.solver).__name__

    @property
    def size(self) -> str:
        """Cells along a side to the power of the number of axes."""
        return f"{self.scene.n}^{self.scene.cells.ndim}"

    @property
    def name(self) -> str:
        """Name of the case, unique among the cases."""
        return f"{self.size} {self.form} {self.bounds} {self.method}"

    @property
    def cells(self) -> int:
        """Number of grid cells of all types."""
        return int(self.scene.cells.size)

    def cold(self, *, keep: bool) -> None:
        """Solve cold, all in one sample: operator, problem and workspace from host arrays."""
        lower = self.scene.lower(self.bounds)
        times = [time.perf_counter()]
        A = self.operator(self.scene.cells, device=self.device, **self.scene.faces)
        times.append(time.perf_counter())
        problem = wl.LCP(A, self.scene.b, lower)
        times.append(time.perf_counter())
        work = self.solver.init(problem)
        times.append(time.perf_counter())
        result = wl.solve(problem, self.solver, stopping=STOPPING, workspace=work)
        wp.synchronize_device(self.device)
        times.append(time.perf_counter())
        self.counts |= {
            "iterations": result.iterations,
            "linear_iterations": result.linear_iterations,
            "residual": result.relative_residual,
            "converged": float(bool(result)),
        }
        if keep:
            parts = ("operator", "problem", "workspace", "solve")
            for part, (begun, end) in zip(parts, pairwise(times), strict=True):
                self.samples[part].append(end - begun)
            self.samples["setup"].append(times[3] - times[0])
            self.samples["total"].append(times[4] - times[0])

    def again(self, *, keep: bool) -> None:
        """Solve with a used workspace: cold, then warm after b changed by 1 %."""
        if self._warm is None:
            self._warm = self._solves()
        for label in ("reuse", "warm"):
            seconds, iterations = next(self._warm)
            self.counts[f"{label}_iterations"] = iterations
            if keep:
                self.samples[label].append(seconds)

    def _solves(self) -> Iterator[tuple[float, int]]:
        """Yield seconds and iterations of cold and warm solves in turn.

        The solves are in place and use one workspace.
        """
        problem, b = self._in_place()
        work, fields = (
            self.solver.init(problem),
            [self._stored(v) for v in warm_changes(self.scene)],
        )
        start, turn = wp.zeros_like(b), 0
        while True:
            for warm in (False, True):
                start_time = time.perf_counter()
                result = wl.solve(
                    problem,
                    self.solver,
                    stopping=STOPPING,
                    x0=start if warm else None,
                    workspace=work,
                )
                wp.synchronize_device(self.device)
                yield time.perf_counter() - start_time, result.iterations
                if not warm:
                    wp.copy(start, result.x)
                    turn += 1
                    wp.copy(b, fields[turn % 2])

    def memory(self) -> None:
        """Count the bytes of operator, problem and workspace, b and the bounds included.

        They are counted during a solve in place, and after it.
        """
        forget_peak()
        before, resident, most = array_bytes(), resident_bytes(), list[int]()
        problem, _ = self._in_place()
        work = self.solver.init(problem)

        def look(record: wl.Record) -> None:
            if record.iteration == MIDST:
                most.append(array_bytes())

        wl.solve(problem, self.solver, stopping=STOPPING, workspace=work, callback=look)
        most.append(array_bytes())
        self.counts["bytes_per_cell"] = (max(most) - before) / self.cells
        self.counts["resident_per_cell"] = max(0, resident_bytes(peak=True) - resident) / self.cells

    def to_tolerances(self) -> None:
        """Solve cold to the tightest tolerance and keep the history.

        The time of the set-up is added later.
        """
        problem = self.scene.lcp(self.bounds, device=self.device)
        work = self.solver.init(problem)
        result = wl.solve(
            problem, self.solver, stopping=wl.StoppingCriteria(rtol=TOLERANCES[-1]), workspace=work
        )
        self.history, reference = (
            result.history,
            result.residual / result.relative_residual if result.relative_residual else 1.0,
        )
        for tolerance in TOLERANCES:
            reached = [r for r in self.history if r.residual <= tolerance * reference]
            if reached:
                self.samples[f"to_{tolerance:.0e}"].append(reached[0].seconds)

    def figures(self) -> dict[str, Figure]:
        """Return all measured figures."""
        figures = {name: Figure.of(times, "s") for name, times in self.samples.items()}
        figures |= {
            name: Figure(value, "B" if "per_cell" in name else "")
            for name, value in self.counts.items()
        }
        return figures

    def _in_place(self) -> tuple[wl.LCP, DeviceArray]:
        """Return the problem with b in the stored layout, and b.

        Time-stepping codes keep b in this layout.
        """
        b = self._stored(self.scene.b)
        return self.scene.lcp(self.bounds, device=self.device, b=b), b

    def _stored(self, values: np.ndarray) -> DeviceArray:
        return wp.array(np.pad(values, 1), dtype=wp.float64, device=self.device)
