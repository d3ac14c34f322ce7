"""Kinds 4, 5 and 12 of the hostile benchmark: stencils, grids and gradients.

Stencils and grids are beside SOLID, AIR and periodic sides.
"""

from __future__ import annotations

from typing import cast

import numpy as np
import scipy.sparse as sp
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.hostile import draw
from warp_lcp.benchmarks.hostile.case import (
    GRID_METHODS,
    ExpectedArrays,
    HostileAnswer,
    HostileBox,
    HostileCase,
    box_case,
)

Rng = np.random.Generator
# Of a stencil, by offset; a float is the same in all cells.
Coefficients = dict[tuple[int, ...], np.ndarray | float]


def _cells(rng: Rng, most: int = 14, solid: float = 0.2) -> np.ndarray:
    """Return 2-D or 3-D cells with random AIR and SOLID, at least one FLUID."""
    shape = tuple(
        int(k)
        for k in rng.integers(
            1, most if rng.random() < 0.7 else max(2, most // 2), rng.integers(2, 4)
        )
    )
    shape = shape if len(shape) == 2 else tuple(max(1, k // 2) for k in shape)
    air = rng.choice([0.0, 0.1, 0.3])
    cells = rng.choice(
        [draw.AIR, draw.FLUID, draw.SOLID], size=shape, p=[air, 1 - air - solid, solid]
    )
    cells.flat[rng.integers(cells.size)] = draw.FLUID
    return cells


def _coefficients(
    rng: Rng,
    cells: np.ndarray,
    *,
    symmetric: bool,
    spread: float,
    margin: float,
    periodic: tuple[bool, ...],
) -> Coefficients:
    """Return coefficients a_o <= 0 by offset, as arrays.

    The center makes every row dominant by `margin`, whatever its neighbors are. If symmetric,
    a_o(i) = a_-o(i + o) between cells; the coefficient of a closed or outer side is independent.
    """
    names = draw.offsets(cells.ndim, axes=bool(rng.random() < 0.4))
    a: dict[tuple[int, ...], np.ndarray] = {
        o: -(10 ** rng.uniform(-spread, 0, cells.shape)) for o in names
    }
    if symmetric:
        for o in names:
            if o > tuple(-k for k in o):
                for cell in np.ndindex(cells.shape):
                    there = draw.neighbor(cell, o, cells.shape, periodic)
                    if there is not None and cells[cell] == cells[there] == draw.FLUID:
                        a[tuple(-k for k in o)][there] = a[o][cell]
    center = np.add.reduce([-values for values in a.values()]) if a else np.ones(cells.shape)
    # A closed side adds a_o < 0 to the diagonal. So the row's sum is that of the center and all
    # sides.
    a[(0,) * cells.ndim] = center * (1 + margin)
    return {**a}


def solid(rng: Rng) -> HostileCase:
    """Draw a stencil with arrays beside SOLID, AIR and outer sides.

    The case compares its parts, or solves with it.
    """
    cells, symmetric = _cells(rng), bool(rng.random() < 0.6)
    periodic = tuple(bool(p) for p in rng.random(3) < 0.15)
    periodic = (periodic[0], periodic[1], periodic[2] and cells.ndim == 3)
    # A periodic axis of one or two cells couples a pair of cells twice. The symmetric drawing does
    # not handle that.
    symmetric &= not any(
        p and cells.shape[cells.ndim - 1 - axis] < 3 for axis, p in enumerate(periodic)
    )
    outside = int(rng.choice([draw.SOLID, draw.AIR]))
    a = _coefficients(
        rng,
        cells,
        symmetric=symmetric,
        spread=rng.choice([0.5, 2.0]),
        margin=rng.choice([0.01, 0.3]),
        periodic=periodic,
    )
    shift = rng.uniform(0, 2, cells.shape) if rng.random() < 0.5 else None
    name = (
        f"stencil {'x'.join(map(str, cells.shape))}, {'' if symmetric else 'un'}symmetric, "
        f"outside {outside}, periodic {periodic}"
    )
    matrix = draw.stencil_matrix(cells, a, shift, periodic, outside)

    def operator() -> wl.Stencil:
        return wl.Stencil(
            cells,
            a,
            shift=shift,
            periodic=periodic,
            outside=outside,
            device="cpu",
            dtype=wp.float64,
        )

    F = np.flatnonzero(cells.ravel() == draw.FLUID)
    if rng.random() < 0.4:
        x, border = (
            rng.standard_normal(cells.shape),
            rng.standard_normal([k + 2 for k in cells.shape]),
        )
        inside = tuple(slice(1, -1) for _ in cells.shape)
        fluid = (cells == draw.FLUID).astype(float)
        expected = {
            "A x": (matrix @ (x * fluid).ravel())[F],
            "diagonal": matrix.diagonal()[F],
            "boundary term": draw.boundary_term(cells, a, border, periodic, outside).ravel()[F],
        }

        def parts() -> HostileAnswer:
            A = operator()
            fields = {
                "A x": A.apply(wp.array(x * fluid, dtype=wp.float64, device="cpu")),
                "diagonal": A.diagonal(),
            }
            fields["boundary term"] = A.boundary_term(border)
            assert border[inside].shape == cells.shape
            return HostileAnswer(
                "CONVERGED",
                None,
                "",
                {k: v.numpy().ravel()[F].astype(float) for k, v in fields.items()},
            )

        return HostileCase(f"{name}, its parts", parts, ExpectedArrays(expected, 1e-12))
    A = matrix[F][:, F].tocsr()
    kind, low, high = draw.bounds(rng, len(F))
    x, b = draw.plant(rng, A, low, high)
    box = HostileBox(
        A=A,
        b=b,
        lower=low,
        upper=high,
        rtol=draw.tolerance(rng),
        solution=x,
        unique=True,
        solvable=True,
        grid=True,
    )
    return box_case(
        rng,
        f"{name}, {kind} bounds",
        box,
        operator=operator,
        shape=cells.shape,
        unknowns=F,
        named=GRID_METHODS,
        share=0.3,
    )


def periodic(rng: Rng) -> HostileCase:
    """Draw periodic stencils and grids.

    They are singular stencils, compatible or not, unsymmetric dominant M-matrices, and grids with
    face coefficients.
    """
    kind = str(rng.choice(["singular", "dominant", "faces"], p=[0.45, 0.35, 0.2]))
    if kind == "faces":
        return _faces(rng)
    if kind == "dominant":
        shape = (
            (draw.size(rng, 3, 70), draw.size(rng, 3, 70))
            if rng.random() < 0.8
            else tuple(draw.size(rng, 2, 12) for _ in range(3))
        )
        cells, sides = np.ones(shape, int), (False, False, False)
        spread = rng.uniform(1, 6)
        a: Coefficients = _coefficients(
            rng,
            cells,
            symmetric=False,
            spread=spread,
            margin=10 ** rng.uniform(-4, -1),
            periodic=sides,
        )
        A = draw.stencil_matrix(cells, a, None, sides, draw.AIR)
        bound, low, high = draw.bounds(rng, cells.size, str(rng.choice(["none", "lower", "box"])))
        x, b = draw.plant(rng, A, low, high)
        box = HostileBox(
            A=A,
            b=b,
            lower=low,
            upper=high,
            rtol=float(rng.choice([1e-6, 1e-8])),
            solution=x,
            unique=True,
            solvable=True,
            grid=True,
        )
        name = (
            f"dominant stencil {'x'.join(map(str, shape))} over {spread:.1f} decades, {bound} "
            "bounds"
        )
        return _stencil_case(rng, name, box, cells, a, sides, draw.AIR)
    three = rng.random() < 0.2
    shape = tuple(draw.size(rng, 3, 9 if three else 48) for _ in range(3 if three else 2))
    cells, sides = np.ones(shape, int), (True, True, three)
    a = {
        o: -float(rng.integers(1, 4))
        for o in draw.offsets(len(shape), axes=bool(rng.random() < 0.5))
        if o > (0,) * len(shape)
    }
    a |= {tuple(-k for k in o): value for o, value in list(a.items())}
    a[(0,) * len(shape)] = -sum(a.values())
    A = draw.stencil_matrix(cells, a, None, sides, draw.SOLID)
    bound = str(rng.choice(["none", "lower"], p=[0.7, 0.3]))
    _, low, high = draw.bounds(rng, cells.size, bound)
    x, b = draw.plant(rng, A, low, high)
    solvable = bool(rng.random() < 0.5)
    if not solvable:
        b = b - b.mean() - 10 ** rng.uniform(-3, 0)
    solution = x if solvable else None
    box = HostileBox(
        A=A,
        b=b,
        lower=low,
        upper=high,
        rtol=1e-6,
        solution=solution,
        solvable=solvable,
        definite=True,
        grid=True,
    )
    name = (
        f"periodic stencil {'x'.join(map(str, shape))}, {bound} bounds, "
        f"{'planted' if solvable else 'incompatible'}"
    )
    return _stencil_case(rng, name, box, cells, a, sides, draw.SOLID)


def _stencil_case(
    rng: Rng,
    name: str,
    box: HostileBox,
    cells: np.ndarray,
    a: Coefficients,
    sides: tuple[bool, ...],
    outside: int,
) -> HostileCase:
    """Return a case whose cells are all FLUID."""

    def operator() -> wl.Operator:
        return _stencil(cells, a, sides, outside)

    every = np.arange(cells.size)
    return box_case(
        rng,
        name,
        box,
        operator=operator,
        shape=cells.shape,
        unknowns=every,
        named=GRID_METHODS,
        share=0.2,
    )


def _stencil(
    cells: np.ndarray, a: Coefficients, sides: tuple[bool, ...], outside: int
) -> wl.Stencil:
    return wl.Stencil(cells, a, periodic=sides, outside=outside, device="cpu", dtype=wp.float64)


def _faces(rng: Rng) -> HostileCase:
    """Draw a GridPoisson with face arrays, in float64 or in its default storage.

    AIR surrounds it, or it is periodic.
    """
    shape = (draw.size(rng, 3, 40), draw.size(rng, 3, 40))
    cells = rng.choice([draw.AIR, draw.FLUID, draw.SOLID], size=shape, p=[0.05, 0.9, 0.05])
    cells[0] = draw.AIR
    cells[1, 0] = draw.FLUID
    fx, fy = (
        10 ** rng.uniform(-2, 0, (shape[0], shape[1] + 1)),
        10 ** rng.uniform(-2, 0, (shape[0] + 1, shape[1])),
    )
    double = bool(rng.random() < 0.5)
    pairs = []
    for j, i in np.ndindex(shape):
        for dj, di, c in ((0, 1, fx[j, i + 1]), (1, 0, fy[j + 1, i])):
            if (
                j + dj < shape[0]
                and i + di < shape[1]
                and draw.SOLID not in (cells[j, i], cells[j + dj, i + di])
            ):
                pairs.append((j * shape[1] + i, (j + dj) * shape[1] + i + di, c))
    tails, heads, weights = (np.array(column) for column in zip(*pairs, strict=True))
    F = np.flatnonzero(cells.ravel() == draw.FLUID)
    F = F[draw.graph_laplacian(cells.size, tails, heads, weights).diagonal()[F] > 0]
    lonely = np.setdiff1d(np.flatnonzero(cells.ravel() == draw.FLUID), F)
    cells.flat[lonely] = draw.SOLID
    A = draw.graph_laplacian(cells.size, tails, heads, weights)[F][:, F].tocsr()
    kind, low, high = draw.bounds(rng, len(F), str(rng.choice(["lower", "mixed", "box"])))
    x, b = draw.plant(rng, A, low, high)
    rtol = float(rng.choice([1e-6, 1e-8, 1e-10]))
    storage = 0.0 if double else 1.2e-7
    box = HostileBox(
        A=A,
        b=b,
        lower=low,
        upper=high,
        rtol=rtol,
        solution=x,
        solvable=True,
        definite=True,
        grid=True,
        storage=storage,
    )

    def operator() -> wl.Operator:
        return wl.GridPoisson(
            cells, face_x=fx, face_y=fy, device="cpu", **({"dtype": wp.float64} if double else {})
        )

    name = (
        f"grid {shape[0]}x{shape[1]}, {kind} bounds, {'float64' if double else 'default storage'}"
    )
    return box_case(
        rng, name, box, operator=operator, shape=shape, unknowns=F, named=GRID_METHODS, share=0.2
    )


def gradients(rng: Rng) -> HostileCase:
    """Draw a well-conditioned problem and a cotangent.

    The case compares `wl.vjp` with dense implicit differentiation.
    """
    kind = str(rng.choice(["dense", "sparse", "stencil", "stencil", "operator"]))
    if kind == "stencil":
        cells, sides = _cells(rng, 9, solid=0.25), (False, False, False)
        outside = int(rng.choice([draw.SOLID, draw.AIR]))
        a = _coefficients(
            rng, cells, symmetric=bool(rng.random() < 0.4), spread=1.0, margin=0.3, periodic=sides
        )
        F = np.flatnonzero(cells.ravel() == draw.FLUID)
        A = draw.stencil_matrix(cells, a, None, sides, outside)[F][:, F].tocsr()
    else:
        A = draw.positive(rng, draw.size(rng, 1, 60))[1]
        A = (
            A.toarray()
            if kind == "dense" and not isinstance(A, np.ndarray)
            else sp.csr_array(A)
            if kind == "sparse"
            else A
        )
        F, cells = np.arange(A.shape[0]), np.ones(A.shape[0], int)
    n = len(F)
    bound, low, high = draw.bounds(rng, n)
    high = np.where(high == low, low + 0.5, high)
    x, b = draw.plant(rng, A, low, high)
    free = (x > low) & (x < high)
    y = A @ x + b
    held_low, held_high = (x == low) & (low < high), (x == high) & (low < high)
    # Remove degenerate rows.
    b += np.where(held_low & (np.abs(y) < 1e-9), 0.5, 0.0) - np.where(
        held_high & (np.abs(y) < 1e-9), 0.5, 0.0
    )
    g = rng.standard_normal(n)
    D, mu = (A.toarray() if sp.issparse(A) else A), np.zeros(n)
    mu[free] = -np.linalg.solve(D[np.ix_(free, free)].T, g[free])  # A_FF' mu_F = -g_F
    slope = g + D.T @ mu
    expected = {
        "b": mu,
        "lower": np.where(held_low, slope, 0.0),
        "upper": np.where(held_high, slope, 0.0),
    }
    if kind == "dense":
        expected["matrix"] = np.outer(mu, x).ravel()
    if kind == "stencil":
        expected |= _by_offset(cells, a, F, mu, x, outside)
    condition = np.linalg.cond(D[np.ix_(free, free)]) if free.any() else 1.0

    def field_of(values: np.ndarray) -> np.ndarray:
        full = np.zeros(cells.size)
        full[F] = values
        return full.reshape(cells.shape)

    def solve() -> HostileAnswer:
        operator = A
        if kind == "stencil":
            operator = _stencil(cells, a, sides, outside)
        elif kind == "operator":
            operator = wl.LinearOperator(lambda v: D @ v, (n,), transpose=lambda v: D.T @ v)
        result = wl.solve(
            wl.LCP(operator, field_of(b), field_of(low), field_of(high)),
            stopping=wl.StoppingCriteria(rtol=1e-11),
        )
        if not result:
            return HostileAnswer(result.status.name, None, "the problem's own solve")
        try:
            gradient = wl.vjp(result, field_of(g), stopping=wl.StoppingCriteria(rtol=1e-10))
        except ArithmeticError as error:
            return HostileAnswer("NO GRADIENT", None, str(error)[:100])
        values = {
            name: cast(wp.array, field).numpy().ravel()[F]
            for name, field in (
                ("b", gradient.b),
                ("lower", gradient.lower),
                ("upper", gradient.upper),
            )
        }
        if kind == "dense":
            matrix = cast(wp.array, gradient.coefficients["matrix"])
            values["matrix"] = matrix.numpy().ravel()
        if kind == "stencil":
            by_offset = cast(dict[tuple[int, ...], wp.array], gradient.coefficients["coefficients"])
            values |= {f"coefficient {o}": v.numpy().ravel()[F] for o, v in by_offset.items()}
        return HostileAnswer("CONVERGED", result.x.numpy().ravel()[F], "", values)

    name = f"gradients of a {kind} problem, n={n}, {free.sum()} free, {bound} bounds"
    return HostileCase(name, solve, ExpectedArrays(expected, max(1e-6, 1e-8 * condition)))


def _by_offset(
    cells: np.ndarray, a: Coefficients, F: np.ndarray, mu: np.ndarray, x: np.ndarray, outside: int
) -> dict[str, np.ndarray]:
    """Return mu_i x_(i + o), or mu_i x_i where that neighbor is SOLID."""
    fields = np.zeros((2, cells.size))
    fields[:, F] = mu, x
    m, v = fields.reshape(2, *cells.shape)
    by_offset = {}
    for o in a:
        part = np.zeros(cells.shape)
        for cell in zip(*np.nonzero(cells == draw.FLUID), strict=True):
            there = draw.neighbor(cell, o, cells.shape, (False, False, False))
            kind = outside if there is None else cells[there]
            part[cell] = m[cell] * (
                v[cell] if kind == draw.SOLID else v[there] if kind == draw.FLUID else 0.0
            )
        by_offset[f"coefficient {o}"] = part.ravel()[F]
    return by_offset
