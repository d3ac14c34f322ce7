"""Benchmark suites for the command line.

Each measures in a process of its own, whose libraries use one thread.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from warp_lcp.benchmarks.harness.compare import comparison
from warp_lcp.distributed import launch

WRONG_INPUT = 2  # exit code of a suite with wrong input
RANKS = "ranks"  # module and files of `scaling --engine petsc`
# Set before NumPy is imported: PyAMG's set-up takes 20 times as long when two BLAS threads compete
# for two cores.
ONE_THREAD = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
    "WARP_LCP_THREADS": "1",
}


@dataclass(frozen=True)
class Suite:
    """Set of measurements."""

    name: str  # name on the command line; the files are NAME.json, NAME.md and NAME-*.png
    summary: str  # description for the help text
    # Minutes on two cores with compiled kernels, and the optional extras.
    takes: str
    resizable: bool = True  # whether other sizes can be requested
    scenes: bool = False  # whether a scene can be requested
    seeded: bool = False  # whether seeds of random problems can be requested

    def run(
        self,
        *,
        device: str,
        out: Path,
        sizes: tuple[int, ...] = (),
        repeat: int = 5,
        scene: str = "",
        seed: int | None = None,
        shared: bool = False,
        threads: int | None = None,
    ) -> list[Path]:
        """Measure in a process of its own.

        See `warp_lcp.cli.suites.Benchmark.run`. A failed check raises an error; the files remain.
        """
        if sizes and not self.resizable:
            raise ValueError(
                f"size = {sizes[0]}: cannot be given for the suite {self.name}, which has its own "
                "resolutions"
            )
        if repeat < 1:
            raise ValueError(f"repeat = {repeat}: must be >= 1")
        if min(sizes, default=8) < 8:
            raise ValueError(f"size = {min(sizes)}: must be >= 8, the cells along a side")
        if scene and not self.scenes:
            raise ValueError(f"{scene}: the suite {self.name} has its own scenes; use tradeoff")
        if seed is not None and not self.seeded:
            raise ValueError(
                f"--seed {seed}: the suite {self.name} has no random problems; use extremes"
            )
        if seed is not None and seed < 0:
            raise ValueError(f"--seed {seed}: must be >= 0")
        name = RANKS if shared else self.name
        arguments = [name, "--device", device, "--out", str(out), "--repeat", str(repeat)]
        arguments += ["--scene", scene] if scene else []
        arguments += ["--seed", str(seed)] if seed is not None else []
        for size in sizes:
            arguments += ["--size", str(size)]
        environment = {
            **os.environ,
            **ONE_THREAD,
            **({"WARP_LCP_THREADS": str(threads)} if threads else {}),
        }
        process = subprocess.run(
            [sys.executable, "-m", "warp_lcp.benchmarks", *arguments], env=environment, check=False
        )
        if shared and launch.rank_here():  # the first of several ranks prints for all
            raise SystemExit(process.returncode)
        if process.returncode == WRONG_INPUT:
            raise ValueError(f"the suite {name} rejected its input")
        if process.returncode != 0:
            raise RuntimeError(f"the suite {name} ended with exit code {process.returncode}")
        return sorted(p for p in out.glob(f"{name}*") if p.suffix in (".json", ".md", ".png"))

    def compare(self, old: Path, new: Path) -> str:
        """Return a table of new figures over old ones, with bounds from their ranges.

        Raises:
            ValueError: a file is no result of a suite.
        """
        return comparison(old, new)


KERNELS = Suite(
    "kernels",
    "each hot kernel on the finest grid against this machine's copy bandwidth, Numba and a plain "
    "Warp kernel",
    "8 minutes; peers: Numba",
)
SOLVERS = Suite(
    "solvers",
    "linear and LCP solves: set-up, iterations, time to a tolerance, memory; against PyAMG and "
    "SciPy; every method on small problems",
    "7 minutes",
)
CHOOSE = Suite(
    "choose",
    "rules of wl.recommend on random problems: how often a rule's method solves, its time over the "
    "best method's, its alternatives",
    "10 minutes",
    False,
    seeded=True,
)
PUBLISHED = Suite(
    "published",
    "published methods for the pressure LCP, as published and as implemented here, on the same "
    "splash: iterations and seconds",
    "5 minutes",
)
SCALING = Suite(
    "scaling",
    "linear and LCP solves from 32^3 up to what memory holds: seconds to three tolerances, bytes a "
    "cell, exponents, floors",
    "3 minutes; with --engine petsc MPI and PETSc",
)
TANK = Suite(
    "tank",
    "a tank filled to 30 %, up to 768^3 cells: seconds, iterations and bytes a cell of the box and "
    "of the liquid, on all cores",
    "3 minutes",
)
THREADS = Suite(
    "threads",
    "kernels, cycles, solves and steps of scenes on 1, 2, 4, ... threads up to all cores, against "
    "what memory allows",
    "4 minutes",
)
DEVICES = Suite(
    "devices",
    "the same solves, contacts, steps and kernels on any machine, CPU or GPU, one file for each; "
    "`--compare` puts two side by side",
    "4 minutes",
)
DOMAINS = Suite(
    "domains",
    "the same liquid in domains of 48^3 to 768^3 cells: a step, its memory, a checkpoint; "
    "regridding around a flying ball",
    "2 minutes",
)
PEERS = Suite(
    "peers",
    "the same problems by PyAMG, AMGCL, SciPy, PETSc, OSQP, PIQP, Clarabel, Warp's CG, if "
    "installed",
    "10 minutes; peers: OSQP, PIQP, Clarabel; PETSc, AMGCL by themselves",
)
RUN = Suite("run", "steps per second of built-in scenes, and the cost of particles", "2 minutes")
HOST = Suite(
    "host",
    "host time of a step by stage, beside its native calls alone; native calls, launches, host "
    "reads and allocations of each",
    "2 minutes",
    scenes=True,
)
SAND = Suite(
    "sand",
    "sand: the coupled methods at equal residual, the yield sets, steps of large scenes",
    "6 minutes",
)
CONTACTS = Suite(
    "contacts",
    "rigid contacts: methods on the scenes of figures 2.9 and 2.11, NNCG against PGS at equal "
    "sweeps",
    "5 minutes",
    False,
)
BOOK = Suite(
    "book",
    "appendix C of Niebe and Erleben, figures 2.3, 2.10 and 2.12: as printed, and corrected",
    "8 minutes",
)
MODELS = Suite(
    "models",
    "time per step and memory of each model of a scene: the cost table of `warp-lcp check`",
    "30 minutes",
)
TRADEOFF = Suite(
    "tradeoff",
    "cost of accuracy: seconds, iterations and bytes of runs and solves against residuals, errors "
    "and visible differences",
    "25 minutes",
    scenes=True,
)
VALIDATION = Suite(
    "validation",
    "liquids, sand and bodies against known answers, with negative controls: rest, sloshing, "
    "ceiling, dam break, floating, piles and more",
    "40 minutes",
    False,
)
EXTREMES = Suite(
    "extremes",
    "hostile problems and scenes with a fixed outcome (solved, refused or stopped), checked by "
    "NumPy and SciPy; random problems by seed",
    "5 minutes",
    False,
    seeded=True,
)
