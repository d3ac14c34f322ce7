"""Digests of solver results on grids, for bit-by-bit comparison.

Run `python -m warp_lcp.benchmarks.bits --out before.txt`, and `diff` the file with that of another
version. There is one line per solve: the problem, the method, its status, steps, a digest of x and
one of the residuals of all iterates; or the message of a refusal.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import itertools
import math
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
import scipy.sparse
import warp as wp
from rich.console import Console

import warp_lcp as wl
from warp_lcp.benchmarks.problems import cut_cells, splash
from warp_lcp.files import Tables
from warp_lcp.problem.method_protocol import Solver
from warp_lcp.problem.operator_protocol import families
from warp_lcp.run.loop import RunRequest, run_scene
from warp_lcp.run.progress import ProgressLines
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.solvers.mprgp import MPRGP
from warp_lcp.solvers.registry import METHODS

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

SHAPES = {"2-D": (11, 38), "3-D": (9, 14, 21), "long rows": (4, 5, 300), "flat": (5, 1, 24)}
PARTS = ("small", "other", "methods", "frames")
PRECISIONS = ("mixed", "double", "single")
STOPPING = wl.StoppingCriteria(rtol=1e-7, max_iterations=12)
OTHER_SETTINGS: dict[str, tuple[Tables, ...]] = {  # settings that select other code paths
    "accelerated-projected-gradient": ({"lipschitz": 20.0},),
    "fischer-newton": (
        {"fischer_weight": 0.9},
        {"safeguard": False},
        {"kink": "zero"},
        {"kink": "random"},
        {"kink": "approximation"},
        {"warm_start": 2},
    ),
    "gradient-descent": ({"map": "penalized", "fischer_weight": 0.9}, {"map": "natural"}),
    "interior-point": ({"mehrotra": False}, {"monotone_cycles": 0}),
    "minimum-map-newton": ({"monotone_cycles": 0},),
    "mprgp": ({"monotone_cycles": 0}, {"gamma": 0.1}),
    "nncg": ({"direction": "forward"},),
    "projected-multigrid": ({"monotone_cycles": 3},),
    "psor": ({"direction": "forward"}, {"direction": "symmetric", "omega": 1.5}),
    "subspace-minimization": ({"sweeps": 1},),
}
# Resolution and simulated seconds of each scene.
SCENES = {"dam-break": (24, 0.1), "floating-bodies": (20, 0.1), "column-collapse": (16, 0.02)}


SEED = 0  # added to the seeds of all problems


MatrixOperator = wl.GridPoisson | wl.SparseOperator | wl.DenseOperator
Side = float | np.ndarray  # a bound
BitsSolve = tuple[str, wl.LCP, Solver, np.ndarray | None]  # name, problem, method, start


def generator(seed: int) -> np.random.Generator:
    """Return a random generator for a problem."""
    return np.random.default_rng(seed + SEED)


def bounds_of(shape: tuple[int, ...]) -> dict[str, tuple[Side, Side]]:
    """Return lower and upper bounds of each kind that the kernels distinguish."""
    rng = generator(2718)
    low, high, some = -rng.random(shape), rng.random(shape), rng.random(shape) < 0.3
    return {
        "none": (-np.inf, np.inf),
        "number": (0.0, np.inf),
        "numbers": (-0.2, 0.3),
        "coded": (np.where(some, 0.0, -np.inf), np.inf),
        "coded twice": (np.where(some, 0.0, -np.inf), np.where(some, np.inf, 0.4)),
        "field": (low, np.inf),
        "fields": (low, high),
        "field above": (-0.2, high),
        "only above": (-np.inf, np.where(some, high, np.inf)),
    }


def faces_of(shape: tuple[int, ...]) -> dict[str, Tables]:
    """Return face coefficients of each form: 1, one number per axis, arrays."""
    rng, names = generator(31), "xyz"[: len(shape)]
    axes = enumerate(reversed(names))
    arrays = {
        f"face_{a}": 0.2 + rng.random([n + (i == j) for j, n in enumerate(shape)]) for i, a in axes
    }
    return {"unit": {}, "number": {"face_y": 3.0}, "arrays": arrays}


def small_solves() -> Iterator[BitsSolve]:
    """Yield name, problem, method and start on small random sets of cells.

    They cover all forms of storage, sides and bounds.
    """
    for (name, shape), form, real in itertools.product(
        SHAPES.items(), ("unit", "number", "arrays"), (wp.float32, wp.float64)
    ):
        rng = generator(97)
        cells = rng.choice([wl.AIR, wl.FLUID, wl.SOLID], size=shape, p=[0.1, 0.8, 0.1])
        b, faces, bounds = rng.standard_normal(shape), faces_of(shape)[form], bounds_of(shape)
        start = rng.standard_normal(shape)
        for precision, (kind, sides) in itertools.product(PRECISIONS, bounds.items()):
            if name != "3-D" and kind not in ("number", "coded", "fields"):
                continue
            A = wl.GridPoisson(cells, device="cpu", dtype=real, **faces)
            for method in (wl.ProjectedMultigrid, wl.MinimumMapNewton):
                what = f"{name} {form} {real.__name__} {kind}"
                yield what, wl.LCP(A, b, *sides), method(precision=precision), None
                if kind in ("coded", "fields"):
                    yield f"{what} warm", wl.LCP(A, b, *sides), method(precision=precision), start
        for periodic in ((True,) * len(shape), (True,) + (False,) * (len(shape) - 1)):
            A = wl.GridPoisson(
                cells,
                device="cpu",
                dtype=real,
                periodic=periodic,
                **({} if form == "arrays" else faces),
            )
            for solver in (
                wl.ProjectedMultigrid(),
                wl.MinimumMapNewton(),
                wl.MinimumMapNewton(precision="single"),
            ):
                yield (
                    f"{name} {form} {real.__name__} periodic {periodic}",
                    wl.LCP(A, b, *bounds["coded twice"]),
                    solver,
                    None,
                )


def other_solves() -> Iterator[BitsSolve]:
    """Yield solves of splashes, closed boxes, low-rank terms and other methods."""
    box, shape = np.full((8, 9, 20), wl.FLUID), (8, 9, 20)
    b = generator(5).standard_normal(shape)
    columns = np.zeros((*shape, 2))
    columns[2, 2:5, 3:7] = generator(7).standard_normal((3, 4, 2))
    for precision in PRECISIONS[:2]:
        for method in (
            wl.ProjectedMultigrid,
            wl.MinimumMapNewton,
            MPRGP,
            wl.InteriorPoint,
            wl.FischerNewton,
        ):
            solver = method(precision=precision)
            for kind in ("walls", "everywhere", "linear"):
                yield f"splash 32 {kind}", splash(32).lcp(kind, device="cpu"), solver, None
            yield "cut splash 32", cut_cells(splash(32)).lcp("walls", device="cpu"), solver, None
            yield (
                "closed box",
                wl.LCP(wl.GridPoisson(box, device="cpu"), b - b.mean(), 0.0),
                solver,
                None,
            )
        low = wl.LowRankOperator(columns, [100.0, 100.0], device="cpu")
        A = wl.SumOperator(wl.GridPoisson(np.where(b > 1.5, wl.AIR, wl.FLUID), device="cpu"), low)
        for coupled in (
            wl.ProjectedMultigrid(precision=precision),
            wl.MinimumMapNewton(precision=precision),
        ):
            yield "low rank", wl.LCP(A, b, 0.0), coupled, None
    for sweeping in (wl.ProjectedSOR(), wl.NNCG()):
        yield "splash 32 walls", splash(32).lcp("walls", device="cpu"), sweeping, None


def method_solves() -> Iterator[BitsSolve]:
    """Yield every method on small grids, matrices and user-defined operators.

    The bounds are of each kind. A method is left out where the problem is too large for it.
    """
    for (what, make, shape), kind in itertools.product(
        _operators(), ("none", "number", "coded", "fields")
    ):
        rng = generator(577)
        b, start = rng.standard_normal(shape), rng.standard_normal(shape)
        sides = bounds_of(shape)[kind]
        for name, method in METHODS.items():
            if what.split()[0] not in families(method) or math.prod(shape) > getattr(
                method, "most_unknowns", math.inf
            ):
                continue
            for number, made in enumerate(_variants(name, method)):
                yield f"{what} {kind} {number}", wl.LCP(make(), b, *sides), made, None
                if kind == "fields":
                    yield f"{what} {kind} {number} warm", wl.LCP(make(), b, *sides), made, start


def _operators() -> Iterator[tuple[str, Callable[[], MatrixOperator], tuple[int, ...]]]:
    rng = generator(1618)
    factor = rng.standard_normal((40, 40))
    matrix = factor @ factor.T + 4 * np.eye(40)
    cells = rng.choice([wl.AIR, wl.FLUID, wl.SOLID], size=(7, 9, 13), p=[0.1, 0.8, 0.1])
    flat, arrays = (
        rng.choice([wl.AIR, wl.FLUID], size=(15, 22), p=[0.1, 0.9]),
        faces_of((7, 9, 13))["arrays"],
    )
    laplacian = scipy.sparse.diags_array(
        [-1.0, -1.0, 4.2, -1.0, -1.0], offsets=[-20, -1, 0, 1, 20], shape=(400, 400)
    ).tocsr()
    yield (
        "grid 3-D",
        lambda: wl.GridPoisson(cells, device="cpu", dtype=wp.float64, **arrays),
        (7, 9, 13),
    )
    yield "grid 2-D", lambda: wl.GridPoisson(flat, device="cpu"), (15, 22)
    yield (
        "grid periodic",
        lambda: wl.GridPoisson(flat, device="cpu", periodic=(True, False)),
        (15, 22),
    )
    yield "sparse", lambda: wl.SparseOperator(laplacian, device="cpu"), (400,)
    yield (
        "sparse float64",
        lambda: wl.SparseOperator(laplacian, device="cpu", dtype=wp.float64),
        (400,),
    )
    yield "dense", lambda: wl.DenseOperator(matrix, device="cpu"), (40,)
    yield "dense float64", lambda: wl.DenseOperator(matrix, device="cpu", dtype=wp.float64), (40,)
    yield "dense tiny", lambda: wl.DenseOperator(matrix[:3, :3], device="cpu"), (3,)


def _variants(name: str, method: Callable[..., Solver]) -> list[Solver]:
    """Return a method in each precision, and with its OTHER_SETTINGS."""
    chosen = any(
        field.name == "precision"
        for field in dataclasses.fields(cast("type[DataclassInstance]", method))
    )
    made = [method(precision=p) for p in PRECISIONS] if chosen else [method()]
    return made + [method(**settings) for settings in OTHER_SETTINGS.get(name, ())]


def line(what: str, problem: wl.LCP, method: Solver, start: np.ndarray | None) -> str:
    """Solve a problem and return its line."""
    called = f"{type(method).__name__} {getattr(method, 'precision', '')}".strip()
    try:
        result = wl.solve(problem, method, stopping=STOPPING, x0=start)
    except (ValueError, TypeError) as error:
        return f"{what}, {called}: {type(error).__name__}: {' '.join(str(error).split())}"
    steps = "".join(record.step[0] for record in result.history)
    norms = np.array([record.residual for record in result.history])
    return (
        f"{what}, {called}: {result.status.name} {steps} {_digest(result.x.numpy())} "
        f"{_digest(norms)}"
    )


def frames(name: str, resolution: int, duration: float) -> str:
    """Run a scene and return a line with a digest of its frames."""
    with tempfile.TemporaryDirectory() as out:
        scene = load_scene(name, [f"domain.resolution={resolution}", f"time.duration={duration}"])
        run_scene(
            RunRequest(scene=scene, out=Path(out) / "run", device="cpu"),
            observer=ProgressLines(Console(quiet=True)),
        )
        found = sorted(p for p in Path(out, "run", "frames").rglob("*") if p.is_file())
        return f"{name}: {len(found)} files {_digest(*(p.read_bytes() for p in found))}"


def _digest(*parts: bytes | np.ndarray) -> str:
    made = hashlib.sha256()
    for part in parts:
        made.update(part if isinstance(part, bytes) else np.ascontiguousarray(part).tobytes())
    return made.hexdigest()[:12]


def main() -> None:
    """Write all lines."""
    parser = argparse.ArgumentParser(prog="python -m warp_lcp.benchmarks.bits", description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--part", choices=PARTS, action="append")
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        help="seed of the random problems (scenes and splashes have none)",
    )
    args = parser.parse_args()
    globals()["SEED"] = args.seed
    parts, lines = args.part or PARTS, list[str]()
    for part, solves in (
        ("small", small_solves),
        ("other", other_solves),
        ("methods", method_solves),
    ):
        if part in parts:
            lines += [line(*solve) for solve in solves()]
    if "frames" in parts:
        lines += [frames(name, *of) for name, of in SCENES.items()]
    args.out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
