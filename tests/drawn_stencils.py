"""Random stencils, and their matrices assembled by NumPy from the definition.

The definition is that of `wl.Stencil`, cell by cell.
"""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

import warp_lcp as wl


@wp.func
def rising(j: int, i: int):
    return 40.0 + float(i) * 0.5 + float(j)


@wp.func
def falling(j: int, i: int):
    return -1.0 - float(j) * 0.25


@wp.func
def rising_in_space(k: int, j: int, i: int):
    return 80.0 + float(i) * 0.5 + float(k)


@wp.func
def falling_in_space(k: int, j: int, i: int):
    return -1.0 - float(j) * 0.25 - float(k)


FUNCTIONS = {  # for Warp and for NumPy: of the center, of a neighbor
    2: (rising, lambda j, i: 40 + 0.5 * i + j, falling, lambda j, i: -1 - 0.25 * j),
    3: (
        rising_in_space,
        lambda k, j, i: 80 + 0.5 * i + k,
        falling_in_space,
        lambda k, j, i: -1 - 0.25 * j - k,
    ),
}
KINDS = ("numbers", "arrays", "mirrored", "half mirrored", "functions")


@dataclass
class DrawnStencil:
    """Arguments of `wl.Stencil`.

    `plain` are the coefficients with Python functions in place of Warp's.
    """

    cells: np.ndarray
    given: dict[tuple[int, ...], Any]
    plain: dict[tuple[int, ...], Any]
    shift: Any
    periodic: tuple[bool, ...]
    outside: int

    def operator(self, device="cpu", dtype=wp.float64):
        return wl.Stencil(
            self.cells,
            self.given,
            shift=self.shift,
            periodic=self.periodic,
            outside=self.outside,
            device=device,
            dtype=dtype,
        )

    def matrix(self):
        return assembled(self.cells, self.plain, self.shift, self.periodic, self.outside)

    @property
    def inside(self):
        return self.cells == wl.FLUID


def neighbor(cells, cell, offset, periodic, outside):
    """Return the padded index of a cell's neighbor, and its type.

    Along a periodic axis, the index of the cell that it stands for.
    """
    n, neighbor_cell, kind = cells.ndim, list(np.add(cell, offset)), None
    for axis, count in enumerate(cells.shape):
        if periodic[n - 1 - axis]:
            neighbor_cell[axis] %= count
        elif not 0 <= neighbor_cell[axis] < count:
            kind = outside
    return tuple(i + 1 for i in neighbor_cell), cells[
        tuple(neighbor_cell)
    ] if kind is None else kind


def value_at(coefficient, cell, shape):
    """Return a coefficient of a cell."""
    return (
        coefficient(*cell) if callable(coefficient) else np.broadcast_to(coefficient, shape)[cell]
    )


def assembled(cells, coefficients, shift, periodic, outside):
    """Return the matrix on the FLUID cells, row by row from the definition."""
    number = {tuple(c): q for q, c in enumerate(np.argwhere(cells == wl.FLUID))}
    A = np.zeros((len(number), len(number)))
    for cell, q in number.items():
        for offset, a in coefficients.items():
            there, kind = neighbor(cells, cell, offset, periodic, outside)
            if kind == wl.FLUID:
                A[q, number[tuple(i - 1 for i in there)]] += value_at(a, cell, cells.shape)
            elif kind == wl.SOLID:
                A[q, q] += value_at(a, cell, cells.shape)
        A[q, q] += 0 if shift is None else np.broadcast_to(shift, cells.shape)[cell]
    return A


def border_sums(drawn, padded):
    """Return the contribution of values in AIR to each row; `padded` is their field."""
    cells = drawn.cells
    out = np.zeros(cells.shape)
    for cell in map(tuple, np.argwhere(cells == wl.FLUID)):
        for offset, a in drawn.plain.items():
            there, kind = neighbor(cells, cell, offset, drawn.periodic, drawn.outside)
            if kind == wl.AIR:
                out[cell] += value_at(a, cell, cells.shape) * padded[there]
    return out


def mirrored(coefficients, shape, cells, rng, *, broken):
    """Return arrays with a_o(i) = a_-o(i + o), on a torus.

    If `broken`, that holds between FLUID cells only.
    """
    mirrored_coefficients = {}
    for offset, a in coefficients.items():
        opposite = tuple(-s for s in offset)
        if not any(offset) or offset > opposite:
            mirrored_coefficients[offset] = np.array(np.broadcast_to(a, shape))
            if any(offset):
                mirrored_coefficients[opposite] = np.roll(
                    mirrored_coefficients[offset], offset, tuple(range(len(shape)))
                )
    if broken:
        for offset, a in mirrored_coefficients.items():
            if any(offset):
                toward = (
                    np.roll(cells, tuple(-s for s in offset), tuple(range(len(shape)))) != wl.FLUID
                )
                for axis, s in enumerate(offset):  # beyond the array, too
                    if s:
                        np.moveaxis(toward, axis, 0)[-1 if s > 0 else 0] = True
                a[toward] = -rng.random(np.count_nonzero(toward))
    return mirrored_coefficients


def drawn(seed, kind=None, *, thin=True):
    """Return a stencil of any shape, cells and boundaries with a dominant diagonal.

    Args:
        seed: seed of the draw.
        kind: kind of the coefficients, one of `KINDS`; random if None.
        thin: whether axes may have one or two cells.
    """
    rng = np.random.default_rng(seed)
    n, kind = int(rng.integers(2, 4)), kind or rng.choice(KINDS)
    shape = tuple(int(v) for v in rng.integers(1 if thin else 3, 7, n))
    cells = rng.choice([wl.AIR, wl.FLUID, wl.FLUID, wl.FLUID, wl.SOLID], shape)
    cells.flat[0] = wl.FLUID
    periodic = tuple(bool(p) for p in rng.random(3) < 0.3)
    # On a torus the sides beyond the array belong to other cells.
    if kind in ("mirrored", "half mirrored"):
        periodic = tuple(p and shape[n - 1 - a] > 2 if a < n else p for a, p in enumerate(periodic))
    coefficients = {(0,) * n: 60.0}
    # Few choices, since the kernels of each must be compiled: faces alone, all neighbors, some.
    chosen = int(rng.integers(3))
    for offset in itertools.product((-1, 0, 1), repeat=n):
        places = abs(np.array(offset)).sum(), sum((s + 1) * 3**a for a, s in enumerate(offset))
        if offset != (0,) * n and (places[0] == 1, True, places[1] % 3 != 1)[chosen]:
            coefficients[offset] = (
                -rng.random() if kind in ("numbers", "functions") else -rng.random(shape)
            )
    if kind in ("mirrored", "half mirrored"):
        coefficients = mirrored(
            coefficients, shape, cells, rng, broken=kind == "half mirrored" and not any(periodic)
        )
    elif kind == "numbers" and rng.random() < 0.5:
        coefficients = {
            o: coefficients.get(max(o, tuple(-s for s in o)), 0.0) for o in coefficients
        }
    plain = dict(coefficients)
    if kind == "functions":
        for offset in list(coefficients)[:3]:
            pick = 0 if offset == (0,) * n else 2
            coefficients[offset], plain[offset] = FUNCTIONS[n][pick : pick + 2]
    shift = rng.random(shape) if rng.random() < 0.5 else None
    return DrawnStencil(
        cells, coefficients, plain, shift, periodic, int(rng.choice([wl.AIR, wl.SOLID]))
    )


def beside(values, offset, periodic):
    """Return the values of each cell's neighbor, 0 beyond the array."""
    moved = np.roll(values, tuple(-s for s in offset), tuple(range(values.ndim)))
    for axis, step in enumerate(offset):
        if step and not periodic[values.ndim - 1 - axis]:
            np.moveaxis(moved, axis, 0)[-1 if step > 0 else 0] = 0
    return moved


def drawn_offsets(dimension, rng):
    """Return all neighbors, or those across faces."""
    offsets = [o for o in itertools.product((-1, 0, 1), repeat=dimension) if any(o)]
    return offsets if rng.random() < 0.5 else [o for o in offsets if sum(map(abs, o)) == 1]


# Sums that are 0; in the last kind both, without symmetry.
SINGULAR = ("symmetric", "numbers", "rows", "columns", "circulant")


def drawn_singular(seed, kind):
    """Return a stencil whose rows or columns sum to 0.

    It lies between closed sides and periodic ones.
    """
    rng = np.random.default_rng([seed, 21])
    shape = (16 + seed % 3, 16) if rng.random() < 0.7 else (6, 7, 6)
    n, decades = len(shape), int(rng.integers(3))
    periodic = [(False,) * 3, (True, False, False), (False, True, False), (True,) * 3][
        int(rng.integers(4))
    ]
    periodic = (True,) * 3 if kind == "circulant" else periodic
    offsets, cells = drawn_offsets(n, rng), np.ones(shape, dtype=int)
    if rng.random() < 0.5 and kind in ("symmetric", "numbers", "rows"):
        fluid = rng.random(shape) > 0.15
        cells = np.where(
            fluid & (sum(beside(fluid.astype(int), o, periodic) for o in offsets) > 0),
            wl.FLUID,
            wl.SOLID,
        )
    coefficients: dict[tuple[int, ...], Any] = {}
    for o in offsets:
        opposite = tuple(-s for s in o)
        if kind in ("numbers", "circulant"):
            coefficients[o] = (
                coefficients[opposite]
                if kind == "numbers" and opposite in coefficients
                else -rng.uniform(0.2, 1)
            )
        else:
            coefficients[o] = -(10 ** rng.uniform(-decades, 0, shape))
            if kind == "symmetric" and opposite in coefficients:
                coefficients[o] = beside(coefficients[opposite], o, periodic)
            elif kind == "columns":
                coefficients[o] = coefficients[o] * beside(np.ones(shape), o, periodic)
    across = [
        beside(coefficients[tuple(-s for s in o)], o, periodic)
        if kind == "columns"
        else coefficients[o]
        for o in offsets
    ]
    coefficients[(0,) * n] = -sum(across)
    return DrawnStencil(cells, coefficients, coefficients, None, periodic, wl.SOLID)


def drawn_dominant(seed, side=40, side_in_space=10):
    """Return an M-matrix that need not be symmetric, and its data.

    It has random coefficients, winds or anisotropy over up to four decades.
    """
    rng = np.random.default_rng([seed, 31])
    shape = (side_in_space, side_in_space, side_in_space + 3) if seed % 3 == 2 else (side, side + 7)
    n, decades, form = (
        len(shape),
        int(rng.integers(0, 5)),
        rng.choice(["random", "wind", "anisotropic"]),
    )
    periodic = [(False,) * 3, (False,) * 3, (True, False, False), (True,) * 3][int(rng.integers(4))]
    offsets = drawn_offsets(n, rng)
    cells = (
        np.ones(shape, dtype=int)
        if rng.random() < 0.6
        else rng.choice([wl.AIR, *[wl.FLUID] * 4, wl.SOLID], shape)
    )
    wind, strength = (
        rng.standard_normal(n) * 10 ** rng.uniform(0, decades),
        10 ** rng.uniform(-decades, 0, n),
    )
    turning = np.sin(3 * (np.indices(shape) / max(shape)).sum(0) + rng.uniform(0, 6))
    coefficients: dict[tuple[int, ...], Any] = {}
    for o in offsets:
        if form == "random":
            coefficients[o] = -(10 ** rng.uniform(-decades, 0, shape))
        elif form == "wind":
            coefficients[o] = -(
                1
                + np.maximum(
                    0,
                    -sum(o[a] * wind[a] * (turning if a % 2 else np.ones(shape)) for a in range(n)),
                )
            )
        else:
            coefficients[o] = -np.prod([strength[a] for a in range(n) if o[a]]) * rng.uniform(
                0.5, 1, shape
            )
    coefficients[(0,) * n] = -(1 + 10.0 ** rng.integers(-5, 0)) * sum(coefficients.values())
    bounded = rng.random() < 0.5
    upper = float(10 ** rng.uniform(-2, 0)) if bounded and rng.random() < 0.3 else np.inf
    b = rng.standard_normal(shape) * (cells == wl.FLUID)
    return (
        DrawnStencil(
            cells, coefficients, coefficients, None, periodic, int(rng.choice([wl.AIR, wl.SOLID]))
        ),
        b,
        0.0 if bounded else -np.inf,
        upper,
    )
