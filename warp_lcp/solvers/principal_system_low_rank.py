"""A multigrid cycle for A made one for A + U W U': Woodbury's formula with the cycle in place of the inverse."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.operators.low_rank import LowRankOperator
from warp_lcp.program import Launch
from warp_lcp.solvers import principal_system_low_rank_kernels as kernels
from warp_lcp.vectors import Reduction

STRONG = 1.0  # added over own inertia from which a column is corrected for: others move eigenvalues by a factor of two at most
FELT = 0.3  # the same of a mode of the columns in slots
CHANGED = 2.0  # factor by which a column's square may change before it is looked at again
SKEW = 0.3  # the most that potentials may be unsymmetric
RENEWED = 2  # columns that a solve renews


class LowRankCorrection:
    """Make a linear cycle B ~ A^-1 a preconditioner M of A + U W U'.

    With Z = B U, S = U'Z and E = S + S W S,

        M = P B P' + Z E^-1 Z',   P = I - Z S^-1 U',

    is the inverse of B^-1 + U W U' (Woodbury): what the cycle leaves of the condition number of A it then leaves of that of A + U W U',
    whatever W is. Conjugate gradients without it meet an eigenvalue 1 + W_qq U_q' A^-1 U_q a column: the mass of liquid that a body
    moves with it over its own mass, 1000 for the lightest.

    In this form M is symmetric and positive definite for any Z with an S like that. So Z is kept from solve to solve, where bodies move
    by parts of a cell and the free set changes a little, and renewed a few columns at a time. Columns with a small ratio are left alone,
    they cost nothing. Columns in slots may depend on each other, where few cells touch a body: the inverses are those on the modes of
    W^(1/2) S W^(1/2) that are felt.

    Args:
        low: U W U'.
        hierarchy: of A on the free set.

    Attributes:
        slots: columns corrected for.
    """

    def __init__(self, low: LowRankOperator, hierarchy: Hierarchy) -> None:
        self._low, self._hierarchy, self._columns = low, hierarchy, low.columns
        n, device = low.rank, hierarchy.device
        self._G, self._S, self._E = (wp.zeros(n * n, dtype=wp.float64, device=device) for _ in range(3))
        self._sums, self._squares, self._kept, self._force, self._t = (wp.zeros(n, dtype=wp.float64, device=device) for _ in range(5))
        self._of_slot = wp.zeros(n, dtype=wp.int32, device=device)
        self._size = hierarchy.finest.x.size
        self._Z = wp.zeros(0, dtype=hierarchy.real, device=device)
        self._threads = math.prod(hierarchy.finest.stencil.threads)
        self._dots: Reduction | None = None
        self._slot_columns = list[int]()
        self._added = np.zeros(n)  # U_q' B U_q
        self._seen = np.zeros(n)  # U_q' U_q when that was computed
        self._age = np.zeros(n, dtype=np.int64)  # solves since then

    @property
    def slots(self) -> int:
        """Number of columns corrected for."""
        return len(self._slot_columns)

    @property
    def key(self) -> tuple[int, ...]:
        """What recorded launches depend on."""
        return self.slots, self._Z.ptr or 0, self._columns.rows.ptr

    def renew(self, *, begins: bool) -> bool:
        """Take the free set as it is now: choose the columns to correct for, and renew potentials, a cycle each.

        Args:
            begins: whether a solve begins, which renews the oldest potentials.

        Returns:
            Whether the finest right-hand side was lost.
        """
        low, finest = self._low, self._hierarchy.finest
        inputs = [*self._entries, low.rank, finest.stencil.d, self._squares]
        wp.launch(self._kernels.squares, 1, inputs, device=low.device)
        squares, W = self._squares.numpy().copy(), low.weights.numpy()
        changed = (squares > CHANGED * self._seen) | (squares < self._seen / CHANGED)
        self._age[changed] = np.iinfo(np.int32).max
        if begins:
            self._age[self._slot_columns] += 1
        lost = False
        for q in np.flatnonzero(changed):
            if int(q) not in self._slot_columns:
                self._potential(int(q), squares)
                lost = True
        strong = [int(q) for q in np.flatnonzero(np.diag(W) * self._added >= STRONG)]
        if strong != self._slot_columns:
            self._choose(strong)
        stale = [q for q in strong if self._age[q] > 0]
        if begins:
            oldest = sorted(stale, key=lambda q: -self._age[q])
            stale = [q for n, q in enumerate(oldest) if n < RENEWED or changed[q]]
        else:
            stale = [q for q in stale if self._age[q] > len(W) or changed[q]]
        lost = self._fill(stale, squares) or lost
        if strong and not self._invert(W):
            lost = self._fill([q for q in strong if self._age[q] > 0], squares) or lost
            self._invert(W)
        return lost

    def begin(self, *, launch: Launch = wp.launch) -> None:
        """Before a cycle: take U S'^-1 Z'r off the hierarchy's finest right-hand side r."""
        if self._dots is None:
            return
        low, finest, m, s = self._low, self._hierarchy.finest, self.slots, self._hierarchy.finest.stencil
        planes, rows, _ = s.threads
        fields = [self._Z, finest.b, m, wp.int64(self._size), self._threads, self._dots.partials]
        launch(self._kernels.dots, s.threads, [s.shape, planes, rows, s.grain, *fields], device=low.device)
        self._dots.add_up(0, columns=m, launch=launch)
        inputs = [self._S, self._E, self._of_slot, self._sums, m, self._force, self._kept]
        launch(kernels.split_kernel, m, inputs, device=low.device)
        self._spread(-1.0, launch)

    def end(self, *, launch: Launch = wp.launch) -> None:
        """After the cycle: correct the finest x, and put back what `begin` took."""
        if self._dots is None:
            return
        low, finest, m, s = self._low, self._hierarchy.finest, self.slots, self._hierarchy.finest.stencil
        self._spread(1.0, launch)
        u = self._columns.gather(finest.x, launch=launch)
        launch(kernels.join_kernel, m, [self._S, self._of_slot, u, m, self._kept, self._t], device=low.device)
        fields = [self._Z, self._t, finest.x, m, wp.int64(self._size)]
        launch(self._kernels.subtract, s.threads, [s.shape, s.d, s.grain, *fields], device=low.device)

    @property
    def _kernels(self) -> Any:
        finest = self._hierarchy.finest
        return kernels.kernels(self._columns.dtype, finest.stencil.d.dtype, finest.x.dtype)

    @property
    def _entries(self) -> list[Any]:
        u = self._columns
        return [u.rows, u.blocks, u.values, u.count, u.width]

    def _choose(self, strong: list[int]) -> None:
        """Give these columns slots; those that have one keep their potentials, the others' must be filled."""
        old, low = {q: slot for slot, q in enumerate(self._slot_columns)}, self._low
        before, n = wp.clone(self._Z), self._size
        if len(strong) * n > before.size:
            self._Z = wp.zeros(len(strong) * n, dtype=before.dtype, device=before.device)
        self._slot_columns = strong
        order = np.zeros(low.rank, dtype=np.int32)
        order[: len(strong)] = strong
        self._of_slot.assign(order)
        self._dots = Reduction(n, low.device, self._sums, columns=len(strong), threads=self._threads) if strong else None
        for slot, q in enumerate(strong):
            if q in old:
                wp.copy(self._Z, before, dest_offset=slot * n, src_offset=old[q] * n, count=n)
            else:
                self._age[q] = np.iinfo(np.int32).max

    def _fill(self, columns: list[int], squares: np.ndarray) -> bool:
        """Compute potentials of columns in slots; return whether there were any."""
        for q in columns:
            self._potential(q, squares)
            slot = self._slot_columns.index(q)
            wp.copy(self._Z, self._hierarchy.finest.x, dest_offset=slot * self._size, count=self._size)
        return bool(columns)

    def _potential(self, column: int, squares: np.ndarray) -> None:
        """Compute B U_q in the finest x, and what of it decides whether the column is strong."""
        finest = self._hierarchy.finest
        finest.b.zero_()
        unit = np.zeros(self._low.rank)
        unit[column] = 1.0
        self._force.assign(unit)
        self._spread(1.0, wp.launch)
        self._hierarchy.cycle.run()
        self._added[column] = self._columns.gather(finest.x).numpy()[column]
        self._seen[column], self._age[column] = squares[column], 0

    def _invert(self, W: np.ndarray) -> bool:
        """Write the inverses of S and E on the modes that are felt; return whether S is as symmetric as it should be."""
        low, finest, m = self._low, self._hierarchy.finest, self.slots
        inputs = [*self._entries, low.rank, finest.stencil.d, self._Z, wp.int64(self._size), m, self._G]
        wp.launch(self._kernels.reduce, m, inputs, device=low.device)
        G = self._G.numpy()[: low.rank * m].reshape(low.rank, m)
        S = G[self._slot_columns]
        even, odd = 0.5 * (S + S.T), 0.5 * (S - S.T)
        values, vectors = np.linalg.eigh(W[np.ix_(self._slot_columns, self._slot_columns)])
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        ratios, modes = np.linalg.eigh(root.T @ even @ root)
        felt = ratios > FELT
        V = root @ modes[:, felt]
        scale = 1.0 / np.sqrt(ratios[felt])
        skew = np.abs(scale[:, None] * (V.T @ odd @ V) * scale).max(initial=0.0)
        E = even + G.T @ W @ G
        for target, matrix in ((self._S, S), (self._E, E)):
            inverse = V @ np.linalg.solve(V.T @ matrix @ V, V.T)
            target[: m * m].assign(inverse.ravel())
        self._force.zero_()
        return bool(skew <= SKEW and ratios.min(initial=0.0) > -SKEW)

    def _spread(self, sign: float, launch: Launch) -> None:
        """Add U f to the finest right-hand side."""
        finest, threads = self._hierarchy.finest, self._columns.capacity if self._low.device.is_cuda else 1
        inputs = [*self._entries, finest.stencil.d, self._force, wp.float64(sign), finest.b, threads]
        launch(self._kernels.spread, threads, inputs, device=self._low.device)
