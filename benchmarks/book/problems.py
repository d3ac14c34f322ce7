"""Problems of [Book] appendix C, by Num4LCP's recipes and with true solutions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_lcp.benchmarks.harness.timing import Options
from warp_lcp.gallery import PlantedSolution, Problem, contact, planted, poisson
from warp_lcp.gallery.matrices import banded_matrix, spectrum_matrix
from warp_lcp.host_problem import Matrix

BLOCK = 6  # unknowns of a contact: normal, four tangents, slip speed
ZEROS = 0.25  # share of zeros in x in all experiments of Num4LCP
SEED = 2015
SMALL = 32  # cells along the longest side; all experiments are small if no grid has more


@dataclass(frozen=True)
class ProblemScale:
    """Sizes of the experiments.

    Args:
        problems: number of random problems of each kind.
        side: a fluid problem has side^3 unknowns.
        contacts: a contact problem has six times as many unknowns.
        dense: unknowns of the dense problems.
        grids: cells along a side of the grids whose cost is measured.
        rows: numbers of contacts of the contact problems whose cost is measured.
        sweeps: limit of the sweeps on contact scenes, as in figure 2.12.
    """

    problems: int
    side: int
    contacts: int
    dense: int
    grids: tuple[int, ...]
    rows: tuple[int, ...]
    sweeps: int

    @staticmethod
    def of(options: Options) -> ProblemScale:
        """Return the book's sizes, or small ones if only small grids are requested."""
        grids = options.sizes or (16, 32, 64)
        if max(grids) < SMALL:
            return ProblemScale(2 * options.repeat, 4, 3, 12, grids, (2, 4), 40)
        return ProblemScale(20 * options.repeat, 10, 30, 100, grids, (10, 20, 40, 80), 5000)


def recipe(A: Matrix, rng: np.random.Generator, name: str) -> Problem:
    """Return the problem that Num4LCP's `make_lcp` makes of a matrix.

    Its `solution` is the planted x, uniform in (0, 1) with a quarter set to 0. b is -A x where x >
    0, and 0 elsewhere. The planted x is no solution where (A x)_i < 0 at a zero. With an M-matrix
    that holds at every zero.
    """
    x = rng.random(A.shape[0])
    x[x < ZEROS] = 0
    b = np.where(x > 0, -(A @ x), 0.0)
    return Problem(name, A, b, np.zeros(len(x)), np.full(len(x), np.inf), x, frozenset())


def complementary(A: Matrix, rng: np.random.Generator, name: str) -> Problem:
    """Return a problem with a complementary solution: b = y - A x.

    A quarter of x is 0, with y > 0 there.
    """
    return planted(A, rng, PlantedSolution(active=ZEROS), name=name, facts=frozenset())


RULES: dict[str, Callable[[Matrix, np.random.Generator, str], Problem]] = {
    "recipe": recipe,
    "planted": complementary,
}


def contact_matrix(contacts: int, rng: np.random.Generator, tangents: int = 4) -> np.ndarray:
    """Return the contact matrix of Num4LCP.

    No contact of rigid bodies has such a matrix. It consists of random symmetric 6 x 6 blocks, half
    of them zero, shifted to be positive definite. The pattern of Stewart and Trinkle is written
    over the nonzero blocks.

    Args:
        contacts: number of contacts, six unknowns each.
        rng: random numbers.
        tangents: number of a contact's tangents with the pattern: all 4 in Num4LCP's Matlab
            code, 3 in its Python code.
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
    last, among = BLOCK - 1, slice(1, 1 + tangents)
    # Rows and columns of a block: normal impulse, four tangents, slip speed.
    blocks[i, last, j, 0] = 0.5  # friction coefficient mu
    blocks[i, last, j, last] = blocks[i, 0, j, last] = 0.0
    blocks[i, last, j, among] = -1.0
    blocks[i, among, j, last] = 1.0
    return A


def dense(rule: str, scale: ProblemScale, number: int, zeros: float = 0.0) -> Problem:
    """Return a dense positive semi-definite problem with zero eigenvalues.

    The eigenvalues are 1/n, 2/n, ... 1; the smallest ones, a share `zeros`, are set to 0.
    """
    n, rng = scale.dense, np.random.default_rng([SEED + 2, number, int(1000 * zeros)])
    eigenvalues = np.arange(1, n + 1) / n
    eigenvalues[: int(n * zeros)] = 0
    return RULES[rule](spectrum_matrix(eigenvalues, rng), rng, f"{rule} {number}")


def kinds(scale: ProblemScale) -> dict[str, Callable[[int], Problem]]:
    """Return functions that make fluid and contact problems from a number, by kind."""
    n = scale.side**3

    def fluid(rule: str) -> Callable[[int], Problem]:
        def make(k: int) -> Problem:
            rng = np.random.default_rng([SEED, k])
            return RULES[rule](banded_matrix(n, 3, rng), rng, f"fluid {rule} {k}")

        return make

    def contacts(rule: str) -> Callable[[int], Problem]:
        def make(k: int) -> Problem:
            rng = np.random.default_rng([SEED + 1, k])
            return RULES[rule](contact_matrix(scale.contacts, rng), rng, f"contact {rule} {k}")

        return make

    def seven_point(k: int) -> Problem:
        return poisson(
            (scale.side,) * 3,
            plant=PlantedSolution(active=ZEROS),
            seed=SEED + k,
            device="cpu",
            dtype=wp.float64,
        ).sparse()

    return {
        "fluid, recipe": fluid("recipe"),
        "fluid, recipe's matrix, planted": fluid("planted"),
        "fluid, 7-point, planted": seven_point,
        "contact, recipe": contacts("recipe"),
        "contact, recipe's matrix, planted": contacts("planted"),
        "contact, rigid bodies": lambda k: contact(scale.contacts, seed=SEED + k),
    }
