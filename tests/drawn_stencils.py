"""Stencils drawn at random, and the matrices that NumPy assembles from the definition of `wl.Stencil`, cell by cell."""

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


FUNCTIONS = {  # as Warp has them, and as NumPy does: of the center, of a neighbor
    2: (rising, lambda j, i: 40 + 0.5 * i + j, falling, lambda j, i: -1 - 0.25 * j),
    3: (rising_in_space, lambda k, j, i: 80 + 0.5 * i + k, falling_in_space, lambda k, j, i: -1 - 0.25 * j - k),
}
KINDS = ("numbers", "arrays", "mirrored", "half mirrored", "functions")


@dataclass
class DrawnStencil:
    """Arguments of `wl.Stencil`; `plain` are the coefficients with Python functions in place of Warp's."""

    cells: np.ndarray
    given: dict[tuple[int, ...], Any]
    plain: dict[tuple[int, ...], Any]
    shift: Any
    periodic: tuple[bool, ...]
    outside: int

    def operator(self, device="cpu", dtype=wp.float64):
        return wl.Stencil(
            self.cells, self.given, shift=self.shift, periodic=self.periodic, outside=self.outside, device=device, dtype=dtype
        )

    def matrix(self):
        return assembled(self.cells, self.plain, self.shift, self.periodic, self.outside)

    @property
    def inside(self):
        return self.cells == wl.FLUID


def neighbor(cells, cell, offset, periodic, outside):
    """The padded index of a cell's neighbor, where an axis is periodic the one that it stands for, and its type."""
    n, there, kind = cells.ndim, list(np.add(cell, offset)), None
    for axis, count in enumerate(cells.shape):
        if periodic[n - 1 - axis]:
            there[axis] %= count
        elif not 0 <= there[axis] < count:
            kind = outside
    return tuple(i + 1 for i in there), cells[tuple(there)] if kind is None else kind


def value_at(coefficient, cell, shape):
    """A coefficient of a cell."""
    return coefficient(*cell) if callable(coefficient) else np.broadcast_to(coefficient, shape)[cell]


def assembled(cells, coefficients, shift, periodic, outside):
    """The matrix on the FLUID cells, row by row from the definition."""
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
    """What values in AIR, a padded field, add to each row."""
    cells = drawn.cells
    out = np.zeros(cells.shape)
    for cell in map(tuple, np.argwhere(cells == wl.FLUID)):
        for offset, a in drawn.plain.items():
            there, kind = neighbor(cells, cell, offset, drawn.periodic, drawn.outside)
            if kind == wl.AIR:
                out[cell] += value_at(a, cell, cells.shape) * padded[there]
    return out


def mirrored(given, shape, cells, rng, *, broken):
    """Arrays with a_o(i) = a_-o(i + o), on a torus; if `broken`, between FLUID cells only."""
    made = {}
    for offset, a in given.items():
        opposite = tuple(-s for s in offset)
        if not any(offset) or offset > opposite:
            made[offset] = np.array(np.broadcast_to(a, shape))
            if any(offset):
                made[opposite] = np.roll(made[offset], offset, tuple(range(len(shape))))
    if broken:
        for offset, a in made.items():
            if any(offset):
                toward = np.roll(cells, tuple(-s for s in offset), tuple(range(len(shape)))) != wl.FLUID
                for axis, s in enumerate(offset):  # beyond the array, too
                    if s:
                        np.moveaxis(toward, axis, 0)[-1 if s > 0 else 0] = True
                a[toward] = -rng.random(np.count_nonzero(toward))
    return made


def drawn(seed, kind=None, *, thin=True):
    """A stencil of any shape, cells and boundaries; the diagonal dominates.

    Args:
        seed: of the draw.
        kind: of the coefficients, one of `KINDS`; drawn if None.
        thin: whether axes of one and two cells are drawn, too.
    """
    rng = np.random.default_rng(seed)
    n, kind = int(rng.integers(2, 4)), kind or rng.choice(KINDS)
    shape = tuple(int(v) for v in rng.integers(1 if thin else 3, 7, n))
    cells = rng.choice([wl.AIR, wl.FLUID, wl.FLUID, wl.FLUID, wl.SOLID], shape)
    cells.flat[0] = wl.FLUID
    periodic = tuple(bool(p) for p in rng.random(3) < 0.3)
    if kind in ("mirrored", "half mirrored"):  # on a torus the sides beyond the array are other cells'
        periodic = tuple(p and shape[n - 1 - a] > 2 if a < n else p for a, p in enumerate(periodic))
    given = {(0,) * n: 60.0}
    chosen = int(rng.integers(3))  # few, or the kernels of each would have to be compiled: faces alone, all neighbors, some
    for offset in itertools.product((-1, 0, 1), repeat=n):
        places = abs(np.array(offset)).sum(), sum((s + 1) * 3**a for a, s in enumerate(offset))
        if offset != (0,) * n and (places[0] == 1, True, places[1] % 3 != 1)[chosen]:
            given[offset] = -rng.random() if kind in ("numbers", "functions") else -rng.random(shape)
    if kind in ("mirrored", "half mirrored"):
        given = mirrored(given, shape, cells, rng, broken=kind == "half mirrored" and not any(periodic))
    elif kind == "numbers" and rng.random() < 0.5:
        given = {o: given.get(max(o, tuple(-s for s in o)), 0.0) for o in given}
    plain = dict(given)
    if kind == "functions":
        for offset in list(given)[:3]:
            pick = 0 if offset == (0,) * n else 2
            given[offset], plain[offset] = FUNCTIONS[n][pick : pick + 2]
    shift = rng.random(shape) if rng.random() < 0.5 else None
    return DrawnStencil(cells, given, plain, shift, periodic, int(rng.choice([wl.AIR, wl.SOLID])))
