"""The problems of [Book] appendix C: by the recipes of its code, Num4LCP, and with a solution that is one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.benchmarks.timing import Options
from warp_lcp.gallery import Plant, Problem, contact, planted, poisson
from warp_lcp.gallery.banded import banded_matrix

BLOCK = 6  # unknowns of a contact: normal, four tangents, slip speed
ZEROS = 0.25  # share of zeros in x, of all experiments of Num4LCP
SEED = 2015
SIZES = (16, 32, 64, 128)  # cells along a side of the grids; 128^3 has 10^6 unknowns
REHEARSAL = 32  # cells along a side below which all experiments are small


@dataclass(frozen=True)
class Scale:
    """How large the experiments are.

    Args:
        problems: how many of each kind.
        side: a fluid problem has side^3 unknowns.
        contacts: a contact problem has six times as many unknowns.
        dense: unknowns of the dense problems.
        sizes: cells along a side of the grids whose cost is measured.
        rows: contacts of the dense problems whose cost is measured.
        repeat: samples of a timing.
    """

    problems: int
    side: int
    contacts: int
    dense: int
    sizes: tuple[int, ...]
    rows: tuple[int, ...]
    repeat: int

    @staticmethod
    def of(options: Options) -> Scale:
        """Return the book's numbers, 20 problems a sample; small ones where only small grids are asked for."""
        sizes, repeat = options.sizes or SIZES, options.repeat
        if max(sizes) < REHEARSAL:
            return Scale(2 * repeat, 4, 4, 12, sizes, (2, 4), repeat)
        return Scale(20 * repeat, 10, 30, 100, sizes, (10, 20, 40, 80), min(repeat, 3))


def recipe(A: Any, rng: np.random.Generator, name: str) -> Problem:
    """Return the problem that Num4LCP makes of a matrix: x in U(0, 1), a quarter of it set to 0, b = -A x where x > 0 and 0 elsewhere.

    That x is no solution where (A x)_i < 0 at a zero: with an M-matrix everywhere.
    """
    x = rng.random(A.shape[0])
    x[x < ZEROS] = 0
    return Problem(name, A, np.where(x > 0, -(A @ x), 0.0), np.zeros(len(x)), np.full(len(x), np.inf), None, frozenset())


def contact_matrix(contacts: int, rng: np.random.Generator) -> np.ndarray:
    """Return Num4LCP's contact matrix, which no contact of bodies has.

    Random symmetric 6 x 6 blocks, half of them zero, shifted to positive definite, with the pattern of Stewart and Trinkle written over
    those that are left.
    """
    n = BLOCK * contacts
    R = rng.random((n, n))
    A = 0.5 * (R + R.T)
    kept = A[BLOCK // 2 :: BLOCK, BLOCK // 2 :: BLOCK] <= 0.5
    A *= np.kron(kept, np.ones((BLOCK, BLOCK)))
    lowest = float(np.linalg.eigvalsh(A)[0])
    if lowest <= 0:
        A += (0.5 - lowest) * np.eye(n)
    blocks = A.reshape(contacts, BLOCK, contacts, BLOCK)
    i, j = np.nonzero(blocks[:, 0, :, 0])
    last, tangents = BLOCK - 1, slice(1, BLOCK - 1)
    blocks[i, last, j, 0] = 0.5
    blocks[i, last, j, last] = blocks[i, 0, j, last] = 0.0
    blocks[i, last, j, tangents] = -1.0
    blocks[i, tangents, j, last] = 1.0
    return A


def definite_matrix(n: int, rng: np.random.Generator, zeros: float = 0.0) -> np.ndarray:
    """Return a dense matrix with the eigenvalues 1/n, 2/n, ... 1, the smallest share `zeros` of them set to 0."""
    values = np.arange(1, n + 1) / n
    values[: int(n * zeros)] = 0
    Q = np.linalg.qr(rng.standard_normal((n, n)))[0]
    A = (Q * values) @ Q.T
    return 0.5 * (A + A.T)


def properly(A: Any, rng: np.random.Generator, name: str) -> Problem:
    """Return the problem with a complementary solution, a quarter of it at zero with y > 0: b = y - A x."""
    return planted(A, rng, Plant(active=ZEROS), name=name, facts=frozenset())


def fluids(scale: Scale) -> dict[str, Callable[[int], Problem]]:
    """Return the kinds of fluid problems by name, each a function of the problem's number."""
    n = scale.side**3

    def rng(k: int) -> np.random.Generator:
        return np.random.default_rng([SEED, k])

    def seven_point(k: int) -> Problem:
        return poisson((scale.side,) * 3, plant=Plant(active=ZEROS), seed=SEED + k, device="cpu", dtype=wp.float64).sparse()

    return {
        "fluid, recipe": lambda k: recipe(banded_matrix(n, 3, r := rng(k)), r, f"fluid recipe {k}"),
        "fluid, recipe's matrix, planted": lambda k: properly(banded_matrix(n, 3, r := rng(k)), r, f"fluid planted {k}"),
        "fluid, 7-point, planted": seven_point,
    }


def contacts(scale: Scale) -> dict[str, Callable[[int], Problem]]:
    """Return the kinds of contact problems by name, each a function of the problem's number."""

    def rng(k: int) -> np.random.Generator:
        return np.random.default_rng([SEED + 1, k])

    return {
        "contact, recipe": lambda k: recipe(contact_matrix(scale.contacts, r := rng(k)), r, f"contact recipe {k}"),
        "contact, recipe's matrix, planted": lambda k: properly(contact_matrix(scale.contacts, r := rng(k)), r, f"contact planted {k}"),
        "contact, rigid bodies": lambda k: contact(scale.contacts, seed=SEED + k),
    }
