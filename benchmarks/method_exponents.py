"""How the cost of each method grows with n, and what methods do with matrices they are not for: the tables of docs/choosing-a-method.md.

python -m warp_lcp.benchmarks.method_exponents
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

import warp_lcp as wl
from warp_lcp import gallery
from warp_lcp.gallery import Plant, Problem, planted
from warp_lcp.gallery.psd import spectrum_matrix
from warp_lcp.protocol import families

SIZES = {"dense": (200, 400), "grid": (32, 64)}  # unknowns; cells along a side of a splash, half of them liquid
LIMITS = {"max_iterations": 400, "patience": 100}


def indefinite(n: int = 60, seed: int = 71) -> Problem:
    """Return a planted problem with a symmetric matrix of which a tenth of the eigenvalues is negative."""
    rng = np.random.default_rng(seed)
    values = np.where(np.arange(n) < n // 10, -0.3, np.geomspace(0.1, 1, n))
    return planted(spectrum_matrix(values, rng), rng, Plant(), name="indefinite", facts=frozenset({"symmetric"}))


MATRICES: dict[str, Callable[[], Problem]] = {
    "definite": lambda: gallery.definite(60, seed=71),
    "singular": lambda: gallery.semidefinite(60, seed=71),
    "unsymmetric, definite": lambda: gallery.skewed(60, seed=71),
    "friction cone": lambda: gallery.contact(10, seed=71),
    "indefinite": indefinite,
}


def outcome(name: str, problem: Problem) -> str:
    """Return how a method ends on a problem: "solved", "refuses" or a status."""
    method = wl.METHODS[name]
    try:
        result = wl.solve(problem.lcp(device="cpu"), method(), stopping=wl.StoppingCriteria(rtol=1e-6, **LIMITS))
    except ValueError:
        return "refuses"
    return "solved" if result else result.status.name


def cost(name: str, problem: Problem) -> tuple[float, int] | None:
    """Return CPU seconds and steps to 1e-4, the least of three; None where the method does not solve it."""
    stopping, least, steps = wl.StoppingCriteria(rtol=1e-4, max_iterations=1000, patience=500), float("inf"), 0
    for _ in range(4):
        begun = time.process_time()
        try:
            result = wl.solve(problem.lcp(device="cpu"), wl.METHODS[name](), stopping=stopping)
        except ValueError:
            return None
        if not result:
            return None
        least, steps = min(least, time.process_time() - begun), result.iterations
    return least, steps


def exponents(name: str, kind: str) -> str:
    """Return the exponents of n in the time and in the steps between the smallest and the largest size, and the time at the largest."""
    make = {
        "dense": lambda n: gallery.definite(n, seed=71),
        "grid": lambda n: gallery.splash(n).named("everywhere", device="cpu"),
    }[kind]
    found = [cost(name, make(n)) for n in SIZES[kind]]
    if None in found:
        return "-"
    unknowns = [n if kind == "dense" else int(np.count_nonzero(gallery.splash(n).cells == wl.FLUID)) for n in SIZES[kind]]
    (t0, s0), (t1, s1) = found  # type: ignore[misc]
    ratio = np.log(unknowns[-1] / unknowns[0])
    return f"{np.log(t1 / t0) / ratio:.1f}, {np.log(s1 / s0) / ratio:.1f} ({s1} steps, {1e3 * t1:.0f} ms)"


def main() -> None:
    """Print both tables."""
    print("| method | dense, 200 to 400 | grid, 32^3 to 64^3 |\n|---|---|---|")
    slow = ("projected-jacobi", "gradient-descent")  # thousands of steps on grids
    for name, method in wl.METHODS.items():
        if getattr(method, "most_unknowns", 400) >= 400:
            large = "grid" in families(method) and not hasattr(method, "most_unknowns") and name not in slow
            dense = exponents(name, "dense") if "dense" in families(method) else "-"
            print(f"| `{name}` | {dense} | {exponents(name, 'grid') if large else '-'} |", flush=True)
    print("\n| method | " + " | ".join(MATRICES) + " |\n|" + "---|" * (1 + len(MATRICES)))
    for name, method in wl.METHODS.items():
        if "dense" in families(method) and getattr(method, "most_unknowns", 60) >= 60:
            print(f"| `{name}` | " + " | ".join(outcome(name, make()) for make in MATRICES.values()) + " |", flush=True)


if __name__ == "__main__":
    main()
