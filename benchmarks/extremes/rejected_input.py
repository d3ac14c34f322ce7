"""Hostile arguments: NaN and infinity, wrong shapes and signs.

Each must be refused with a message that names the argument.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import scipy.sparse
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.extremes.case import ExtremeCase, RefusalCase
from warp_lcp.files import TableValue

SHAPE = (4, 5)
CELLS = np.array([[1] * 5] * 3 + [[0] * 5])


def wrong_arguments() -> Iterator[ExtremeCase]:
    """Yield every argument with a value that no method can use."""
    for bad in (np.nan, np.inf, -np.inf):
        for name, call in NOT_FINITE.items():
            if not (name == "lower" and bad == -np.inf) and not (name == "upper" and bad == np.inf):
                yield RefusalCase(
                    "not finite",
                    f"{bad} in {name}",
                    partial(call, v=bad),
                    name.replace(",", "").split()[0],
                )
    for name, (names, simple) in WRONG.items():
        yield RefusalCase("wrong arguments", name, simple, names)


def spoiled(shape: tuple[int, ...], value: float) -> np.ndarray:
    """Return ones with one bad value."""
    field = np.ones(shape)
    field.flat[field.size // 2] = value
    return field


def grid(device: str, **options: TableValue) -> wl.GridPoisson:
    """Return a small grid."""
    return wl.GridPoisson(CELLS, device=device, **options)


def run(device: str, p: str, **options: TableValue) -> wl.SolveResult:
    """Solve a small problem."""
    fields = {key: options.pop(key) for key in ("b", "lower", "upper") if key in options}
    problem = wl.LCP(grid(device), **({"b": np.ones(SHAPE)} | fields))
    return wl.solve(problem, wl.ProjectedMultigrid(precision=p), **options)


def low_rank(device: str, columns: np.ndarray, weights: np.ndarray) -> wl.SumOperator:
    """Return a grid with a low-rank term."""
    return wl.SumOperator(grid(device), wl.LowRankOperator(columns, weights, device=device))


NOT_FINITE: dict[str, Callable[..., object]] = {
    "b": lambda device, p, v: run(device, p, b=spoiled(SHAPE, v)),
    "lower": lambda device, p, v: run(device, p, lower=spoiled(SHAPE, v)),
    "upper": lambda device, p, v: run(device, p, upper=spoiled(SHAPE, v)),
    "x0": lambda device, p, v: run(device, p, x0=spoiled(SHAPE, v)),
    "face_x": lambda device, p, v: grid(device, face_x=spoiled((4, 6), v)),
    "face_y": lambda device, p, v: grid(device, face_y=spoiled((5, 5), v)),
    "face_x, a number": lambda device, p, v: grid(device, face_x=v),
    "shift": lambda device, p, v: grid(device, shift=spoiled(SHAPE, v)),
    "shift, a number": lambda device, p, v: grid(device, shift=v),
    "matrix (dense)": lambda device, p, v: wl.DenseOperator(spoiled((3, 3), v), device=device),
    "matrix (sparse)": lambda device, p, v: wl.SparseOperator(
        scipy.sparse.csr_array(spoiled((3, 3), v)), device=device
    ),
    "columns": lambda device, p, v: low_rank(device, spoiled((*SHAPE, 2), v), np.ones(2)),
    "weights": lambda device, p, v: low_rank(device, np.ones((*SHAPE, 2)), spoiled((2,), v)),
    "rtol": lambda device, p, v: wl.StoppingCriteria(rtol=v),
    "atol": lambda device, p, v: wl.StoppingCriteria(atol=v),
    "cells": lambda device, p, v: wl.GridPoisson(spoiled(SHAPE, v), device=device),
}

WRONG: dict[str, tuple[str, Callable[[str, str], object]]] = {
    "l > u": ("lower > upper", lambda device, p: run(device, p, lower=1.0, upper=0.0)),
    "l = inf": ("lower", lambda device, p: run(device, p, lower=np.inf)),
    "u = -inf": ("upper", lambda device, p: run(device, p, lower=-np.inf, upper=-np.inf)),
    "b of another shape": ("b has shape", lambda device, p: run(device, p, b=np.ones((3, 3)))),
    "negative coefficients": ("face_x", lambda device, p: grid(device, face_x=-1.0)),
    "negative shift": ("shift", lambda device, p: grid(device, shift=-1e-30)),
    "cell types of 3": (
        "cells",
        lambda device, p: wl.GridPoisson(np.full(SHAPE, 3), device=device),
    ),
    "no cells": (
        "cells",
        lambda device, p: wl.GridPoisson(np.ones((0, 3), dtype=int), device=device),
    ),
    "no matrix": ("matrix", lambda device, p: wl.DenseOperator(np.ones((0, 0)), device=device)),
    "matrix not square": (
        "matrix",
        lambda device, p: wl.DenseOperator(np.ones((2, 3)), device=device),
    ),
    "complex matrix": ("matrix", lambda device, p: wl.DenseOperator(np.eye(2) * 1j, device=device)),
    "no column": ("columns", lambda device, p: low_rank(device, np.ones((*SHAPE, 0)), np.ones(0))),
    "weights of another size": (
        "weights",
        lambda device, p: low_rank(device, np.ones((*SHAPE, 2)), np.ones(3)),
    ),
    "rtol = 1": ("rtol", lambda device, p: wl.StoppingCriteria(rtol=1.0)),
    "max_iterations = -1": (
        "max_iterations",
        lambda device, p: wl.StoppingCriteria(max_iterations=-1),
    ),
    "patience = 0": ("patience", lambda device, p: wl.StoppingCriteria(patience=0)),
    "precision = half": (
        "precision",
        lambda device, p: wl.solve(
            wl.LCP(grid(device), np.ones(SHAPE)), wl.ProjectedMultigrid(precision="half")
        ),
    ),
    "entries beyond float32": (
        "matrix",
        lambda device, p: wl.DenseOperator(np.full((2, 2), 1e200), device=device, dtype=wp.float32),
    ),
}
