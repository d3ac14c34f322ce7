"""A suite as the command line sees it. It measures in a process of its own, whose libraries are told to use one thread first."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from warp_lcp.benchmarks.compare import comparison
from warp_lcp.distributed import launch
from warp_lcp.gallery import recorded
from warp_lcp.solvers.registry import METHODS

DISTRIBUTED = "distributed"  # group of --engine petsc
WRONG_INPUT = 2  # exit code of a suite that says what is wrong with its input
REPLAY = "replay"  # module and files of recorded problems
# before NumPy is imported: PyAMG's set-up takes 20 times as long when two BLAS threads fight over two cores
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}


@dataclass(frozen=True)
class Suite:
    """A set of measurements.

    Args:
        name: what the command line calls it; the files are NAME.json, NAME.md and NAME-*.png.
        summary: what it measures.
        resizable: whether it can be asked for other sizes.
        replays: whether it can be asked for recorded problems.
        scenes: whether it can be asked for a scene.
        seeded: whether it can be asked for seeds of random problems.
        groups: other cases of it by name, with what they are; their files are GROUP.json and so on.
    """

    name: str
    summary: str
    resizable: bool = True
    replays: bool = False
    scenes: bool = False
    seeded: bool = False
    groups: Mapping[str, str] = field(default_factory=dict)

    def run(
        self,
        *,
        device: str,
        out: Path,
        sizes: tuple[int, ...] = (),
        repeat: int = 5,
        problems: Path | None = None,
        methods: tuple[str, ...] = (),
        group: str = "",
        scene: str = "",
        seed: int | None = None,
    ) -> list[Path]:
        """Measure and write the files.

        Args:
            device: Warp device.
            out: folder of the files.
            sizes: cells along a side; the suite's own without any.
            repeat: samples of each timing.
            problems: folder of recorded problems to measure methods on instead; the files are then replay.json and so on.
            methods: names of those methods; the suite's choice without any.
            group: name of one of `groups`, to measure instead.
            scene: the only one to measure, its name or file.
            seed: first one of its random problems, >= 0; new ones without.

        Returns:
            The files.

        Raises:
            ValueError: a size, a seed or the number of samples is out of range, a method is unknown, or `problems` holds no problem.
            RuntimeError: a measurement or a check failed; what it said is on the error stream. A failed check leaves the files.
        """
        if sizes and not self.resizable:
            raise ValueError(f"size = {sizes[0]}: the suite {self.name} has its own resolutions")
        if repeat < 1:
            raise ValueError(f"repeat = {repeat}: must be >= 1")
        if min(sizes, default=8) < 8:
            raise ValueError(f"size = {min(sizes)}: must be >= 8 cells a side")
        name = self.name
        if group and group not in self.groups:
            known = f"choose from {', '.join(self.groups)}" if self.groups else "it has none; use solvers"
            raise ValueError(f"--group {group}: the suite {self.name} has no such group; {known}")
        if group and (problems is not None or methods):
            raise ValueError("--group: cannot be combined with --problems and --method")
        if scene and not self.scenes:
            raise ValueError(f"{scene}: the suite {self.name} has scenes of its own; use tradeoff")
        if seed is not None and not self.seeded:
            raise ValueError(f"--seed {seed}: the suite {self.name} draws no problems; use extremes")
        if seed is not None and seed < 0:
            raise ValueError(f"--seed {seed}: must be >= 0")
        name = group or name
        if problems is not None or methods:
            self._check_replay(problems, methods, sizes)
            name = REPLAY
        arguments = [name, "--device", device, "--out", str(out), "--repeat", str(repeat)]
        arguments += ["--scene", scene] if scene else []
        arguments += ["--seed", str(seed)] if seed is not None else []
        for size in sizes:
            arguments += ["--size", str(size)]
        arguments += [part for method in methods for part in ("--method", method)]
        arguments += ["--problems", str(problems)] if problems is not None else []
        process = subprocess.run([sys.executable, "-m", "warp_lcp.benchmarks", *arguments], env={**os.environ, **ONE_THREAD}, check=False)
        if name == DISTRIBUTED and launch.rank_here():  # the first of several ranks speaks for all
            raise SystemExit(process.returncode)
        if process.returncode == WRONG_INPUT:
            raise ValueError(f"the suite {name} refused its input")
        if process.returncode != 0:
            raise RuntimeError(f"the suite {name} ended with exit code {process.returncode}")
        return sorted(p for p in out.glob(f"{name}*") if p.suffix in (".json", ".md", ".csv", ".png", ".svg", ".html"))

    def _check_replay(self, problems: Path | None, methods: tuple[str, ...], sizes: tuple[int, ...]) -> None:
        """Refuse what cannot be replayed, before a process is started for it."""
        if not self.replays:
            raise ValueError(f"--problems and --method: the suite {self.name} replays no problems; use solvers")
        if problems is None:
            raise ValueError("--method: name the problems too, --problems DIR")
        if sizes:
            raise ValueError("--size: recorded problems have sizes of their own")
        unknown = sorted(set(methods) - METHODS.keys())
        if unknown:
            raise ValueError(f"--method {unknown[0]}: no such method; choose from {', '.join(sorted(METHODS))}")
        if not recorded.files(problems):
            raise ValueError(f"--problems {problems}: there is no problem_*.npz; `warp-lcp run SCENE --record-problems DIR` writes them")
        for path in recorded.files(problems):
            recorded.check(path)

    def compare(self, old: Path, new: Path) -> str:
        """Return a table of new figures over old ones with the bounds that their ranges give.

        Raises:
            ValueError: a file is no result of a suite.
        """
        return comparison(old, new)


KERNELS = Suite("kernels", "each hot kernel on the finest grid against this machine's copy bandwidth, Numba and a plain Warp kernel")
SOLVERS = Suite(
    "solvers",
    "linear and LCP solves: set-up, iterations, time to a tolerance, memory; against PyAMG and SciPy",
    replays=True,
    groups={"book": "the experiments of [Book] appendix C", "narrow": "small and narrow matrices against a plain active set in NumPy"},
)
SCALING = Suite(
    "scaling",
    "linear and LCP solves from 32^3 up to what memory holds: seconds to three tolerances, bytes a cell, exponents",
    groups={
        "floor": "the smallest residual that each precision reaches, up to 256^3",
        DISTRIBUTED: "the same solves on 1, 2 and 4 ranks of PETSc: strong and weak scaling, memory of a rank",
    },
)
PEERS = Suite("peers", "the same problems by PyAMG, AMGCL, SciPy, PETSc, OSQP, PIQP, Clarabel, Warp's CG, as far as they are there")
RUN = Suite(
    "run",
    "steps per second of built-in scenes, and what the particles cost",
    groups={"narrow_band": "memory and steps with particles in a narrow band, and with particles everywhere"},
)
SAND = Suite(
    "sand",
    "sand: the coupled methods at equal residual, the yield sets, steps of large scenes",
    groups={"implicit_mpm": "steps of a column collapse against newton's implicit material point method"},
)
CONTACTS = Suite("contacts", "rigid contacts: methods on the scenes of figures 2.9 and 2.11, NNCG against PGS at equal sweeps", False)
MODELS = Suite(
    "models",
    "what each model that a scene can turn on adds to a step and to memory: the prices that `warp-lcp check` tells",
    groups={"automatic_tolerance": "the tolerance that follows the time step against fixed ones, on five scenes"},
)
TRADEOFF = Suite(
    "tradeoff",
    "what accuracy costs: seconds, iterations and bytes of runs and solves against residuals, errors and what a user sees",
    scenes=True,
    groups={"tuning": "what `warp-lcp tune` finds against the best of all settings, on scenes that the presets were not made on"},
)
VALIDATION = Suite(
    "validation",
    "liquids, sand and bodies against known answers, with negative controls: rest, sloshing, ceiling, dam break, floating, piles and more",
    False,
    groups={"short_steps": "the energy that steps of any length make in the middle of every built-in scene"},
)
EXTREMES = Suite(
    "extremes",
    "hostile problems and scenes: solved, refused or stopped as is fixed beforehand, checked by NumPy and SciPy; random problems by seed",
    False,
    seeded=True,
)
