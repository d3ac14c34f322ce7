"""Nested iteration on banded matrices, by cyclic reduction.

Active sets are found from coarse to fine levels. The unknowns are divided into blocks of the
bandwidth k, so that A is block tridiagonal. The blocks with odd numbers, F, are coupled to those
with even numbers, C, alone: A_FF is block diagonal. With y_F = 0 they follow from their neighbors,

    x_F = -A_FF^-1 (A_FC x_C + b_F),

and the rest is the complementarity problem of the Schur complement S = A_CC - A_CF A_FF^-1 A_FC
with b_C - A_CF A_FF^-1 b_F and the bounds of C: block tridiagonal again, of half the size, and an
M-, P- or semi-definite matrix if A is. Only the bounds of F are omitted. A contact set of many
consecutive unknowns therefore has the right ends except for a block or two, for all coefficients.
Newton's steps on the finer level have only those to move, where from a cold start they move an end
by one block a step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_lcp.deadline import check_time
from warp_lcp.operators.banded_matrix import BandedMatrix

COARSEST = 8  # number of blocks up to which a cold start takes a few steps
STEPS = 30  # limit of Newton steps on a coarse level; M-matrices take 2 or 3


@dataclass(frozen=True)
class BlockTridiagonalProblem:
    """A boxed problem with a block tridiagonal matrix of m blocks of k unknowns.

    Args:
        left: couplings of each block to the one before it, shape (m, k, k).
        own: the diagonal blocks, shape (m, k, k).
        right: couplings of each block to the one after it, shape (m, k, k).
        b: shape (m, k).
        lower: l, shape (m, k).
        upper: u, shape (m, k).
    """

    left: np.ndarray
    own: np.ndarray
    right: np.ndarray
    b: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    @classmethod
    def of(
        cls, A: BandedMatrix, b: np.ndarray, lower: np.ndarray, upper: np.ndarray
    ) -> BlockTridiagonalProblem:
        """Divide a problem into blocks; equations x_i = 0 complete the last one."""
        k, n = max(A.width, 1), len(b)
        m = -(-n // k)
        place = np.arange(m * k)
        parts = []
        for block in (-1, 0, 1):
            row = place.reshape(m, k, 1)
            # Columns of the blocks before, at and after the diagonal; entries beyond the band or
            # the matrix are 0.
            column = row - row % k + block * k + np.arange(k)
            band = A.width + row - column
            inside = (band >= 0) & (band <= 2 * A.width) & (column >= 0) & (column < n) & (row < n)
            parts.append(
                np.where(
                    inside, A.bands[np.where(inside, band, 0), np.where(inside, column, 0)], 0.0
                )
            )
        # Equations x_i = 0 in the rows that complete the last block.
        parts[1][-1] += np.diag(place[-k:] >= n).astype(np.float64)
        fields = (
            np.r_[f, np.full(m * k - n, end)].reshape(m, k)
            for f, end in ((b, 0.0), (lower, -np.inf), (upper, np.inf))
        )
        return cls(*parts, *fields)

    def coarse(self) -> tuple[BlockTridiagonalProblem, np.ndarray]:
        """Return the problem of the even blocks, and A_FF^-1.

        The inverse has shape (m // 2, k, k).

        Raises:
            np.linalg.LinAlgError: A_FF is singular.
        """
        odd, even = slice(1, None, 2), slice(0, None, 2)
        inverse = _inverse(self.own[odd])
        diagonal, b = self.own[even].copy(), self.b[even].copy()
        left, right = np.zeros_like(diagonal), np.zeros_like(diagonal)
        # A_CF A_FF^-1 for the odd block before an even one.
        before = _times(self.left[2::2], inverse[: len(diagonal) - 1])
        after = _times(self.right[even][: len(inverse)], inverse)  # the same for the one after it
        count = len(before)
        # S = A_CC - A_CF A_FF^-1 A_FC is block tridiagonal: an even block is coupled to the even
        # blocks on either side through the odd block between.
        diagonal[1:] -= _times(before, self.right[odd][:count])
        diagonal[: len(after)] -= _times(after, self.left[odd])
        left[1:] = -_times(before, self.left[odd][:count])
        right[: len(after)] = -_times(after, self.right[odd])
        b[1:] -= _applied(before, self.b[odd][:count])
        b[: len(after)] -= _applied(after, self.b[odd])
        return BlockTridiagonalProblem(
            left, diagonal, right, b, self.lower[even], self.upper[even]
        ), inverse

    def interpolated(self, coarse: np.ndarray, inverse: np.ndarray) -> np.ndarray:
        """Return x, shape (m, k), from its even blocks: y = 0 on the odd ones."""
        x = np.zeros_like(self.b)
        x[::2] = coarse
        # r_F = b_F + A_FC x_C.
        r = self.b[1::2] + _applied(self.left[1::2], x[:-1:2])
        following = x[2::2]
        r[: len(following)] += _applied(self.right[1::2][: len(following)], following)
        x[1::2] = -_applied(inverse, r)
        return x

    def matrix(self) -> BandedMatrix:
        """Return the matrix in banded form."""
        m, k = self.b.shape
        width, n = 2 * k - 1, m * k
        bands = np.zeros((2 * width + 1, n))
        row = np.arange(n).reshape(m, k, 1)
        for block, part in ((-1, self.left), (0, self.own), (1, self.right)):
            column = row - row % k + block * k + np.arange(k)
            inside = (column >= 0) & (column < n)
            bands[(width + row - column)[inside], column[inside]] = part[inside]
        return BandedMatrix(bands)

    def solved(self, x: np.ndarray) -> np.ndarray:
        """Return x after whole Newton steps, until the active set stays or recurs.

        Held are the unknowns with x - y / d beyond a bound, d = diag A; the others solve
        A_FF e_F = -y_F (primal-dual active set).

        Raises:
            np.linalg.LinAlgError: a free block is singular, or the matrix has a diagonal entry that
            is not positive.
        """
        A, shape = self.matrix(), x.shape
        x, b, lower, upper = (field.ravel() for field in (x, self.b, self.lower, self.upper))
        if not (A.diagonal > 0).all():
            raise np.linalg.LinAlgError
        seen = set[bytes]()
        for _ in range(STEPS):
            check_time()
            target = x - (A.product(x) + b) / A.diagonal
            below, above = target < lower, target > upper
            key = below.tobytes() + above.tobytes()
            if key in seen:
                break
            seen.add(key)
            x = np.where(below, lower, np.where(above, upper, x))
            e = A.solve(~(below | above), -(A.product(x) + b))
            if e is None or not np.isfinite(e).all():
                raise np.linalg.LinAlgError
            x = x + e
        return x.reshape(shape)


def nested_iteration(
    A: BandedMatrix, b: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> np.ndarray | None:
    """Return x near the solution of a boxed problem, None if a block is singular.

    y = 0 on odd blocks. x may violate the bounds of odd blocks: Newton's next step holds such
    unknowns.

    Args:
        A: shape (n, n), whose blocks of odd numbers are regular, such as a P-matrix.
        b: shape (n,).
        lower: l, shape (n,).
        upper: u, shape (n,).
    """
    level = BlockTridiagonalProblem.of(A, b, lower, upper)
    finer: list[tuple[BlockTridiagonalProblem, np.ndarray]] = []
    try:
        while len(level.b) > COARSEST:
            coarse, inverse = level.coarse()
            finer.append((level, inverse))
            level = coarse
        x = level.solved(np.clip(0.0, level.lower, level.upper)) if finer else None
        for level, inverse in reversed(finer):
            assert x is not None
            x = level.interpolated(x, inverse)
            if level is not finer[0][0]:
                x = level.solved(x)
    except np.linalg.LinAlgError:
        return None
    if x is None or not np.isfinite(x).all():
        return None
    return x.ravel()[: len(b)]


def _inverse(blocks: np.ndarray) -> np.ndarray:
    """Return the inverses of blocks, shape (m, k, k)."""
    if blocks.shape[1] > 1:
        return np.linalg.inv(blocks)
    if not blocks.all():
        raise np.linalg.LinAlgError
    return 1 / blocks


def _times(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the products of blocks, shape (m, k, k)."""
    return np.asarray(left * right if left.shape[1] == 1 else left @ right)


def _applied(blocks: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the products of blocks with the parts of a field, shape (m, k)."""
    return np.asarray(blocks[:, :, 0] * x if x.shape[1] == 1 else (blocks @ x[:, :, None])[:, :, 0])
