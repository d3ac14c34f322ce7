"""Seepage through a dam: interleaved comparison with PETSc's SNESVI, one core.

Run `python -m benchmarks.dam` in the source tree. Both solvers start cold: the time includes
problem, operator and multigrid. PETSc uses grid sequencing, each grid with half the spacing of the
last. On each it takes Newton steps on the free set (`vinewtonrsls`), solved by conjugate gradients
with its geometric multigrid.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

import warp_lcp as wl
from warp_lcp.benchmarks.peers.petsc import environment, interpreter, missing
from warp_lcp.files import Tables
from warp_lcp.gallery import dam

SIZES: Tables = {"width": 16.0, "high": 24.0, "low": 4.0}
COARSEST, RTOL, REPEAT = (5, 7), 1e-8, 2
OPTIONS = ("-ksp_type", "cg", "-pc_type", "mg")


def ours(nx: int, ny: int) -> tuple[float, str, int, float]:
    """Return seconds, status, steps and the norm of the solution."""
    begun = time.perf_counter()
    result = wl.solve(
        dam(nx, ny, **SIZES, device="cpu").lcp(), stopping=wl.StoppingCriteria(rtol=RTOL)
    )
    seconds, w = time.perf_counter() - begun, result.x.numpy()
    return seconds, result.status.name, result.iterations, float(np.linalg.norm(w))


def theirs(python: str, levels: int) -> dict[str, object]:
    """Return PETSc's answer on its finest grid, with the norm of the inner nodes."""
    request = {"coarsest": COARSEST, "levels": levels, "rtol": RTOL, "sizes": SIZES}
    command = [
        python,
        str(Path(__file__).parent / "peers" / "dam_petsc.py"),
        json.dumps(request),
        *OPTIONS,
    ]
    return dict(
        json.loads(
            subprocess.run(
                command, env=environment(), check=True, capture_output=True, text=True
            ).stdout
        )
    )


def main() -> None:
    """Print a line for each turn."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--levels",
        type=int,
        default=11,
        help="grids of PETSc, 5 x 7 nodes the coarsest: 11 are 4097 x 6145",
    )
    parser.add_argument("--repeat", type=int, default=REPEAT)
    arguments, python = parser.parse_args(), interpreter()
    nx, ny = ((n - 1) * 2 ** (arguments.levels - 1) + 1 for n in COARSEST)
    ours(65, 97)  # loads the kernels
    for _ in range(arguments.repeat):
        seconds, status, steps, norm = ours(nx, ny)
        line = (
            f"{nx} x {ny} nodes to {RTOL:g}: ours {seconds:.2f} s, {status}, {steps} steps, |w| "
            f"{norm:.9g}"
        )
        if python is None:
            sys.exit(f"{line}; {missing()}")
        peer = theirs(python, arguments.levels)
        last = peer["steps"][-1][2:4]  # type: ignore[index]
        line += f"; PETSc {peer['version']} {peer['seconds']:.2f} s, {last}, |w| {peer['norm']:.9g}"
        sys.stdout.write(f"{line}; ratio {peer['seconds'] / seconds:.1f}\n")  # type: ignore[operator]
        sys.stdout.flush()


if __name__ == "__main__":
    os.environ.setdefault("WARP_LCP_THREADS", "1")
    main()
