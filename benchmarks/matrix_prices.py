"""What methods cost on matrices: steps, iterations and seconds to 1e-8, and how each ends, on five problems of the gallery.

python -m warp_lcp.benchmarks.matrix_prices lemke fischer-newton
"""

from __future__ import annotations

import argparse
import time

import warp_lcp as wl
from warp_lcp import gallery

RTOL = 1e-8
NOT_FOR_THEM = ("direct-enumeration", "projected-multigrid")  # at most 4 unknowns; grids alone
PROBLEMS = {
    "dense, definite, 400": lambda: gallery.definite(400, seed=71),
    "dense, half of the eigenvalues zero, 400": lambda: gallery.semidefinite(400, seed=71),
    "dense, unsymmetric P-matrix, 400": lambda: gallery.skewed(400, seed=71),
    "contacts with friction, 180": lambda: gallery.contact(30, seed=71),
    "sparse, banded, 20000": lambda: gallery.banded(20000, seed=71),
}


def price(problem: gallery.Problem, name: str, device: str) -> str:
    """Return steps, iterations and seconds with set-up, or how the solve ended, or that the method does not take the matrix."""
    method, lcp = wl.METHODS[name], problem.lcp(device=device)
    stopping = wl.StoppingCriteria(rtol=RTOL, max_iterations=2000)
    try:
        wl.solve(lcp, method(), stopping=wl.StoppingCriteria(max_iterations=1))  # loads the kernels
        begun = time.perf_counter()
        result = wl.solve(lcp, method(), stopping=stopping)
        seconds = time.perf_counter() - begun
    except ValueError:
        return "refused"
    return f"{result.iterations} ({result.linear_iterations}, {1e3 * seconds:.0f} ms)" if result else result.status.name


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("methods", nargs="*", default=[name for name in wl.METHODS if name not in NOT_FOR_THEM])
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    problems = {title: make() for title, make in PROBLEMS.items()}
    print("| method | " + " | ".join(problems) + " |\n|" + "---|" * (1 + len(problems)))
    for name in arguments.methods:
        cells = (price(problem, name, arguments.device) for problem in problems.values())
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
