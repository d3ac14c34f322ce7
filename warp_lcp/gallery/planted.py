"""Problems with a known solution: x and y are chosen first, then b = y - A x."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.ndimage
import warp as wp

from warp_lcp.host_problem import M_MATRIX, Matrix, Problem
from warp_lcp.operators.grid_matrix import grid_matrix
from warp_lcp.operators.grid_poisson import AIR, FLUID, SOLID, GridPoisson
from warp_lcp.settings import Part, Positive, Settings, renamed_names


@dataclass(frozen=True, kw_only=True)
class PlantedSolution(Settings):
    """Settings of a planted solution.

    Args:
        active: share of the bounded unknowns that are at their bound.
        weak: share of those with y = 0 as well, so that strict complementarity fails.
        boxed: finite upper bounds too; active unknowns are at either bound with equal chance.
        mixed: share of the rows that are equations.
        size: nonzero x and y are uniform in [0.1, 1] times this; y also times the mean diagonal of
            A.

    Raises:
        ValueError: a share is outside [0, 1], or the size is not positive.
    """

    active: Part = 0.3
    weak: Part = 0.0
    boxed: bool = False
    mixed: Part = 0.0
    size: Positive = 1.0


def planted(
    A: Matrix, rng: np.random.Generator, plant: PlantedSolution, *, name: str, facts: frozenset[str]
) -> Problem:
    """Return a problem with a given matrix and a planted solution.

    l <= x <= u, y >= 0 where x = l, y <= 0 where x = u, y = 0 elsewhere and on equations; the lower
    bounds are 0, or in [-1, 0] times `plant.size` if there are upper ones.

    Args:
        A: numpy or scipy.sparse matrix, shape (n, n).
        rng: random generator.
        plant: settings of the solution.
        name: name of the problem.
        facts: properties of A; those of the plant are added.

    Raises:
        ValueError: A is empty or not square.
    """
    if A.shape[0] < 1 or A.shape != (A.shape[0],) * 2:
        raise ValueError(f"A has shape {A.shape}: expected (n, n) with n >= 1")
    n, S = A.shape[0], plant.size
    equation = rng.random(n) < plant.mixed
    at_bound = (rng.random(n) < plant.active) & ~equation
    at_upper = at_bound & (rng.random(n) < 0.5) & plant.boxed
    weak = at_bound & (rng.random(n) < plant.weak)
    lower = np.where(equation, -np.inf, -S * rng.random(n) if plant.boxed else 0.0)
    upper = np.where(
        equation | (not plant.boxed),
        np.inf,
        np.where(equation, 0.0, lower) + S * rng.uniform(1, 2, n),
    )
    inside = rng.uniform(0.1, 1.0, n) * S
    with np.errstate(invalid="ignore"):
        offset = np.where(
            equation,
            inside - 0.55 * S,
            lower + (0.9 * inside / S * (upper - lower) if plant.boxed else inside),
        )
    x = np.where(at_bound, np.where(at_upper, upper, lower), offset)
    push = rng.uniform(0.1, 1.0, n) * S * float(np.abs(A.diagonal()).mean() or 1.0)
    y = np.where(at_bound & ~weak, np.where(at_upper, -push, push), 0.0)
    added = (
        {"solvable"}
        | ({"boxed"} if plant.boxed else set())
        | ({"mixed"} if equation.any() else set())
    )
    if not weak.any():
        added.add("strict")
    if facts & {"p-matrix", "positive-definite"}:
        added.add("unique")
    return Problem(name, A, y - A @ x, lower, upper, x, facts | added)


def random_cells(
    shape: tuple[int, ...], rng: np.random.Generator, *, air: float, solid: float, ring: bool
) -> np.ndarray:
    """Return random cell types: fractions of AIR and SOLID.

    AIR all around if `ring`; FLUID without AIR in its component becomes SOLID.
    """
    cells = rng.choice(
        np.array([AIR, FLUID, SOLID], dtype=np.int8), shape, p=[air, 1 - air - solid, solid]
    )
    if ring:
        cells = np.pad(cells, 1, constant_values=AIR)
    open_parts, count = scipy.ndimage.label(cells != SOLID)
    with_air = np.zeros(count + 1, dtype=bool)
    with_air[np.unique(open_parts[cells == AIR])] = True
    if not (with_air[open_parts] & (cells == FLUID)).any():
        cells.ravel()[:2] = AIR, FLUID
        return np.where(
            (np.arange(cells.size).reshape(cells.shape) < 2) | with_air[open_parts], cells, SOLID
        ).astype(np.int8)
    return np.where(with_air[open_parts], cells, SOLID).astype(np.int8)


def poisson(
    shape: tuple[int, ...],
    *,
    plant: PlantedSolution | None = None,
    air: float = 0.0,
    solid: float = 0.0,
    ring: bool = True,
    coefficients: str = "uniform",
    seed: int = 2015,
    device: wp.DeviceLike = None,
    dtype: type = wp.float32,
) -> Problem:
    """Return a planted problem with the 5- or 7-point operator of a grid.

    Args:
        shape: cells (ny, nx) or (nz, ny, nx), without a ring of AIR.
        plant: settings of the solution; a share of 0.3 active, strictly complementary, if None.
        air: share of AIR cells among them.
        solid: share of SOLID cells.
        ring: surround them by AIR: x = 0 on the border, as in 'the 7-point matrix of 10^3
            unknowns'.
        coefficients: "uniform" (1) or "random" (in [0.2, 1], exact in float32).
        seed: seed of all random numbers.
        device: Warp device of the operator.
        dtype: storage type of the operator.

    Raises:
        ValueError: coefficients is invalid.
    """
    if coefficients not in ("uniform", "random"):
        raise ValueError(f"coefficients = {coefficients!r}: must be 'uniform' or 'random'")
    rng, plant = np.random.default_rng(seed), plant or PlantedSolution()
    cells = random_cells(shape, rng, air=air, solid=solid, ring=ring)
    faces: dict[str, np.ndarray] = {}
    for axis, face in enumerate(
        ("face_x", "face_y", "face_z")[: cells.ndim] if coefficients == "random" else ()
    ):
        counts = [n + (k == cells.ndim - 1 - axis) for k, n in enumerate(cells.shape)]
        faces[face] = rng.uniform(0.2, 1.0, counts).astype(np.float32).astype(np.float64)
    A = GridPoisson(cells, device=device, dtype=dtype, **faces)  # type: ignore[arg-type]
    flat = planted(
        grid_matrix(A),
        rng,
        plant,
        name=f"poisson {'x'.join(map(str, cells.shape))}",
        facts=M_MATRIX,
    )
    fluid = cells == FLUID

    def field(values: np.ndarray) -> np.ndarray:
        out = np.zeros(cells.shape)
        out[fluid] = values
        return out

    assert flat.solution is not None
    assert isinstance(flat.lower, np.ndarray) and isinstance(flat.upper, np.ndarray)
    x = field(flat.solution)
    return Problem(
        f"{flat.name}, {coefficients}",
        A,
        field(flat.b),
        field(flat.lower),
        field(flat.upper),
        x,
        flat.facts,
    )


__getattr__ = renamed_names(__name__, Plant="PlantedSolution")
