"""Results that must be equal on every device, written to a file.

Run `python -m benchmarks.gpu_cases FILE [DEVICE]`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import scipy.sparse

import warp_lcp as wl
from warp_lcp.benchmarks.problems import splash
from warp_lcp.material.particle_simulation import ParticleSimulation
from warp_lcp.problem.operator_protocol import families
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.simulator import simulators
from warp_lcp.solvers.registry import METHODS

STOPPING = wl.StoppingCriteria(rtol=1e-8, max_iterations=20_000, patience=2000)
SHAPES = ((1, 1), (1, 31), (2, 3), (1, 1, 1), (3, 5, 7), (33, 17, 9), (1, 64, 65), (40, 31, 63))
SCENES = {"dam-break": 32, "dam-break-2d": 64, "column-collapse-2d": 32, "floating-bodies": 24}
STEPS, DT = 100, 0.004
Arrays = dict[str, np.ndarray]


def obstacle(shape: tuple[int, ...], device: str, *, periodic: bool = False) -> wl.LCP:
    """Return a problem with AIR, SOLID and bounds on a grid of any shape.

    It is the same on every device.
    """
    rng = np.random.default_rng(sum(shape))
    cells = rng.choice([wl.FLUID, wl.FLUID, wl.FLUID, wl.AIR, wl.SOLID], shape)
    cells.flat[0] = wl.FLUID
    flags = tuple(n > 2 for n in reversed(shape)) if periodic else (False,) * len(shape)
    A = wl.GridPoisson(cells, shift=0.1, periodic=(*flags, False)[:3], device=device)
    return wl.LCP(
        A,
        np.where(cells == wl.FLUID, rng.standard_normal(shape), 0.0),
        0.0,
        np.where(rng.random(shape) < 0.3, 0.5, np.inf),
    )


def methods(device: str) -> Arrays:
    """Return x of every method, on small grids and matrices."""
    rng = np.random.default_rng(3)
    solutions = {}
    B = rng.standard_normal((30, 30))
    dense = B @ B.T + np.eye(30)
    banded = scipy.sparse.diags_array(
        [-1.0, -1.0, 4.1, -1.0, -1.0], offsets=[-5, -1, 0, 1, 5], shape=(30, 30)
    ).tocsr()
    right, cells = rng.standard_normal(30), np.ones((6, 7), dtype=int)
    cells[0, 0], cells[2, 3] = wl.AIR, wl.SOLID
    field = np.where(cells == wl.FLUID, rng.standard_normal(cells.shape), 0.0)
    for name, cls in METHODS.items():
        if cls is wl.QuadraticProgram and find_spec("piqp") is None:  # the extra is not installed
            continue
        n = min(getattr(cls, "most_unknowns", 30), 30)
        for family in ("dense", "sparse", "grid") if n == 30 else ("dense",):
            if family not in families(cls):
                continue
            if family == "dense":
                problem = wl.LCP(wl.DenseOperator(dense[:n, :n], device=device), right[:n])
            elif family == "sparse":
                problem = wl.LCP(wl.SparseOperator(banded, device=device), right)
            else:
                problem = wl.LCP(wl.GridPoisson(cells, device=device), field)
            result = wl.solve(problem, cls(), stopping=STOPPING)
            solutions[f"{name}, {family}: {result.status.name}"] = result.x.numpy()
    return solutions


def shapes(device: str) -> Arrays:
    """Return x of the default method on odd, thin and periodic grids."""
    solutions = {}
    for periodic in (False, True):
        for shape in SHAPES:
            result = wl.solve(
                obstacle(shape, device, periodic=periodic),
                wl.ProjectedMultigrid(),
                stopping=STOPPING,
            )
            kind = "periodic " if periodic else ""
            solutions[f"{kind}{' x '.join(map(str, shape))}: {result.status.name}"] = (
                result.x.numpy()
            )
    return solutions


def large(device: str, n: int = 48) -> Arrays:
    """Return x of a splash, large enough for all paths of a device."""
    solutions = {}
    for method in (wl.ProjectedMultigrid(), wl.MinimumMapNewton(), wl.InteriorPoint(), wl.MPRGP()):
        result = wl.solve(
            splash(n).lcp("walls", device=device), method, stopping=wl.StoppingCriteria(rtol=1e-7)
        )
        solutions[f"{type(method).__name__}, {n}^3: {result.status.name}"] = result.x.numpy()
    return solutions


def simulation(name: str, device: str, cells: int = 0) -> ParticleSimulation:
    """Return a built-in scene's simulation, small, or of so many cells."""
    scene = load_scene(name, [f"domain.resolution={cells or SCENES[name]}"])
    made = simulators()[scene.scene.simulator].create(scene, device=device, folder=Path.cwd())
    assert isinstance(made, ParticleSimulation)
    return made


def states(name: str, device: str, steps: int = STEPS) -> Iterator[Arrays]:
    """Yield a scene's particles after each step."""
    made = simulation(name, device)
    for _ in range(steps):
        made.step(min(made.stable_dt(), DT))
        yield {key: np.asarray(made.state()[key]) for key in ("position", "velocity")}


def moments(device: str, steps: int = STEPS) -> Arrays:
    """Return number, center, spread and mean speed of scenes' particles.

    They are those after some steps.
    """
    values = {}
    for name in SCENES:
        *_, last = states(name, device, steps)
        x, v = last["position"].astype(np.float64), last["velocity"].astype(np.float64)
        values[f"{name}, {steps} steps"] = np.array(
            [len(x), *x.mean(axis=0), *x.std(axis=0), np.linalg.norm(v, axis=1).mean()]
        )
    return values


def everything(device: str, steps: int = STEPS) -> Arrays:
    """Return the results of all cases."""
    return methods(device) | shapes(device) | large(device) | moments(device, steps)


if __name__ == "__main__":
    np.savez(sys.argv[1], **everything(*(sys.argv[2:3] or ["cpu"]), *map(int, sys.argv[3:4])))  # type: ignore[arg-type]
