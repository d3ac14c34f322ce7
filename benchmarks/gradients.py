"""Cost of gradients through a solution.

Run `python -m benchmarks.gradients` in the source tree. Its CPU times are interleaved.

`wl.vjp` is compared with the solve itself and with the linear solve that it contains, on a membrane
over a ball. In that linear solve the active unknowns are AIR, the tolerance is the same, and the
operator is rebuilt each time. Memory is the peak above that before, after solves of few and of many
steps.
"""

import sys
import time
import tracemalloc

import numpy as np

import warp_lcp as wl
from warp_lcp.files import Tables

SHAPES, REPEAT, SEED = ((1024, 1024), (128, 128, 128)), 9, 2027
TOLERANCES = (1e-6, 1e-10)


def membrane(
    shape: tuple[int, ...], faces: bool
) -> tuple[wl.GridPoisson, np.ndarray, np.ndarray, np.ndarray, Tables]:
    """Return operator, cells, load, obstacle and coefficients of a clamped membrane."""
    cells, rng = np.full(shape, wl.AIR), np.random.default_rng(SEED)
    cells[(slice(1, -1),) * len(shape)] = wl.FLUID
    square = sum(
        ((q - n / 2) / (0.3 * n)) ** 2 for q, n in zip(np.indices(shape), shape, strict=True)
    )
    coefficients: Tables = {}
    for axis in range(len(shape) if faces else 0):
        face = list(shape)
        face[-1 - axis] += 1
        coefficients[f"face_{'xyz'[axis]}"] = rng.uniform(0.5, 2.0, face)
    obstacle = np.where(square < 1, 0.5 * np.sqrt(np.maximum(1 - square, 0.0)), -1.0)
    return (
        wl.GridPoisson(cells, device="cpu", **coefficients),
        cells,
        np.full(shape, 20.0 / shape[0] ** 2),
        obstacle,
        coefficients,
    )


def measure(shape: tuple[int, ...], faces: bool, rtol: float) -> None:
    """Print median times of a linear solve and of `wl.vjp`, and their median ratio."""
    A, cells, load, obstacle, coefficients = membrane(shape, faces)
    problem, tight, stopping = (
        wl.LCP(A, load, lower=obstacle),
        wl.StoppingCriteria(rtol=1e-10),
        wl.StoppingCriteria(rtol=rtol),
    )
    result = wl.solve(problem, stopping=tight)
    held = (result.x.numpy() <= obstacle) & (cells == wl.FLUID)
    open_cells, g = (
        np.where(held, wl.AIR, cells),
        np.random.default_rng(SEED).standard_normal(shape),
    )
    right = np.where(open_cells == wl.FLUID, g, 0.0)

    def linear() -> np.ndarray:
        block = wl.GridPoisson(open_cells, device="cpu", **coefficients)
        return wl.solve(wl.LCP(block, right, -np.inf), stopping=stopping).x.numpy()

    work = {
        "solve": lambda: wl.solve(problem, stopping=stopping),
        "linear": linear,
        "vjp": lambda: wl.vjp(result, g, stopping=stopping),
    }
    assert (
        np.abs(linear() - wl.vjp(result, g, stopping=stopping).b.numpy()).max()
        < 1e-4 * np.abs(linear()).max()
    )
    seconds: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(REPEAT):
        for name, run in work.items():
            begun = time.process_time()
            run()
            seconds[name].append(time.process_time() - begun)
    ratio = np.array(seconds["vjp"]) / np.array(seconds["linear"])
    medians = " ".join(f"{name} {1e3 * np.median(times):.0f}" for name, times in seconds.items())
    kind = "fields" if faces else "numbers"
    sys.stdout.write(
        f"{shape} {kind} {rtol:.0e}: [ms] {medians}; vjp / linear {np.median(ratio):.2f} "
        f"({ratio.min():.2f}-{ratio.max():.2f})\n"
    )


def remember(shape: tuple[int, ...]) -> None:
    """Print the additional memory of `wl.vjp` and of a linear solve.

    They are measured after solves of few and of many steps.
    """
    A, _, load, obstacle, _ = membrane(shape, False)
    problem = wl.LCP(A, load, lower=obstacle)
    for method in (wl.ProjectedMultigrid(), wl.ProjectedSOR(omega=1.95)):
        result = wl.solve(
            problem,
            method,
            stopping=wl.StoppingCriteria(rtol=1e-8, max_iterations=20_000, patience=5_000),
        )
        wl.vjp(result, load)
        tracemalloc.start()
        wl.vjp(result, load)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        sys.stdout.write(
            f"{shape} after {result.iterations} steps: {peak / load.size:.1f} bytes a cell\n"
        )


if __name__ == "__main__":
    for shape in SHAPES:
        for faces in (False, True):
            for rtol in TOLERANCES:
                measure(shape, faces, rtol)
    remember((128, 128))
