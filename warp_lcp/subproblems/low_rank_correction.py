"""Woodbury preconditioner for a grid operator plus a term of low rank.

A multigrid cycle for A becomes one for A + U W U': Woodbury's formula with the cycle in place of
the inverse.
"""

from __future__ import annotations

from pathlib import Path
from typing import no_type_check

import numpy as np
import warp as wp

from warp_lcp.kernels import BoundKernel, KernelFile, Rows
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.host_array import HostArray
from warp_lcp.kernels.launch_graph import Launch, LaunchGraph, clear, copy, launch_now
from warp_lcp.kernels.launch_graph import launch as launch_recorded
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import Reduction
from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.operators.low_rank import LowRankOperator
from warp_lcp.subproblems.grid_step_kernels import ENERGY, ZAP, ZAZ

# Ratio of added to own inertia, as estimated, from which a column is corrected: the other columns
# move eigenvalues by a small factor.
STRONG = 2.0
# U_q' A^-1 U_q / (U_q' U_q) over rows^(1 / (dimension - 1)): of a disc and of a sphere.
SPREAD = 0.115
FELT = 0.3  # ratio of added to own inertia from which a mode of the corrected columns counts
CHANGED = 2.0  # factor by which a column's square may change before its potential is recomputed
MOST_READ = 1024  # largest number of products that are read together with other numbers
SKEW = 0.3  # largest relative skew part of the potentials
SPREADING, STRONGEST = wp.constant(wp.float64(SPREAD)), wp.constant(wp.float64(STRONG))
# Safety factor: the host recomputes the decision and must not decide otherwise.
SAFELY = wp.constant(wp.float64(1.0 + 1e-9))
I32, F64 = wp.array(dtype=wp.int32), wp.array(dtype=wp.float64)


@no_type_check
@forward_kernel(module="warp_lcp.low_rank_correction")
def split_kernel(S: F64, E: F64, columns: I32, sums: F64, m: int, force: F64, coarse: F64):
    """Split Z'r: e = E^-1 Z'r into `coarse`, f = S'^-1 Z'r into `force`.

    `force` has a factor for each column of U. S and E are the inverses, row by row.
    """
    i = wp.tid()
    f = wp.float64(0.0)
    e = wp.float64(0.0)
    for j in range(m):
        f += S[j * m + i] * sums[j]
        e += E[i * m + j] * sums[j]
    force[columns[i]] = f
    coarse[i] = e


@no_type_check
@forward_kernel(module="warp_lcp.low_rank_correction")
def join_kernel(S: F64, columns: I32, u: F64, m: int, coarse: F64, t: F64):
    """Compute t = S^-1 U'z - coarse, with `coarse` of `split_kernel`.

    S is the inverse, row by row.
    """
    i = wp.tid()
    a = -coarse[i]
    for j in range(m):
        a += S[i * m + j] * u[columns[j]]
    t[i] = a


@no_type_check
@forward_kernel(module="warp_lcp.low_rank_correction")
def add_products_kernel(W: F64, uz: F64, up: F64, n: int, scalars: F64):
    """Add z'(U W U')z to z'Az, and z'(U W U')p to z'Ap.

    The sums are then those of K = A + U W U'. Arguments: uz = U'z, up = U'p.
    """
    zz = wp.float64(0.0)
    zp = wp.float64(0.0)
    for i in range(n):
        for j in range(n):
            w = W[i * n + j]
            zz += uz[i] * w * uz[j]
            zp += uz[i] * w * up[j]
    scalars[ZAZ] += zz
    scalars[ZAP] += zp


@no_type_check
@forward_kernel(module="warp_lcp.low_rank_correction")
def subtract_energy_kernel(u: F64, weighed: F64, n: int, scalars: F64, products: F64):
    """Correct the energy by the term of low rank, from u = U'x and W u.

    x'(y + b + U W U' x) exceeds twice the energy by x'U W U' x, which is subtracted. u is stored as
    `products`.
    """
    beyond = wp.float64(0.0)
    for i in range(n):
        beyond += u[i] * weighed[i]
        products[i] = u[i]
    scalars[ENERGY] -= beyond


@no_type_check
@forward_kernel(module="warp_lcp.low_rank_correction")
def unit_kernel(columns: I32, slot: int, force: F64):
    """Write the unit force of a slot's column."""
    q = wp.tid()
    force[q] = wp.where(q == columns[slot], wp.float64(1.0), wp.float64(0.0))


@no_type_check
@forward_kernel(module="warp_lcp.low_rank_correction")
def calm_kernel(
    W: wp.array2d(dtype=wp.float64),
    squares: F64,
    rank: int,
    width: int,
    power: wp.float64,
    calm: I32,
):
    """Set `calm` to 1 if no column is strong, with a margin, else to 0; one thread.

    A column is strong if W_qq SPREAD rows^power U_q'U_q >= STRONG, its estimated ratio of added to
    own inertia.
    """
    calm[0] = 1
    for q in range(rank):
        rows = squares[rank + q // width]
        if not W[q, q] * SPREADING * wp.pow(rows, power) * squares[q] * SAFELY < STRONGEST:
            calm[0] = 0


KERNELS = KernelFile(Path(__file__).parent / "headers/reduced_systems.h")
SQUARES = KERNELS["low_rank_correction.squares"]
BY_TURNS = KERNELS["low_rank_correction.squares_by_turns"]
DOTS = KERNELS["low_rank_correction.dots"]
SUBTRACT = KERNELS["low_rank_correction.subtract"]


class WoodburyCorrection:
    """Make a linear cycle B ~ A^-1 a preconditioner M of A + U W U'.

    With Z = B U, S = U'Z and E = S + S W S,

        M = P B P' + Z E^-1 Z',   P = I - Z S^-1 U',

    is the inverse of B^-1 + U W U' (Woodbury). The condition number of the preconditioned A + U W
    U' is then that of the preconditioned A, for every W. Without it conjugate gradients meet an
    eigenvalue 1 + W_qq U_q' A^-1 U_q for each column: the ratio of the mass of liquid that a body
    moves with it to its own mass, 1000 for the lightest.

    In this form M is symmetric and positive definite for any Z with such an S. Z is computed when a
    solve begins, a cycle for each column, and again only where the free set has changed much.
    Columns with a small ratio are not corrected and cost nothing. The corrected columns may depend
    on each other, where few cells touch a body: the inverses are those on the modes of W^(1/2) S
    W^(1/2) with a ratio above FELT. Nothing is kept from one solve to the next, so that results do
    not depend on earlier solves.

    Args:
        low: U W U'.
        hierarchy: of A on the free set.

    Attributes:
        slots: number of corrected columns.
        noted: the sums by which `renew` decides.
        calm: on a GPU, int32 of shape (1,): whether they require no corrected column.
    """

    def __init__(self, low: LowRankOperator, hierarchy: Hierarchy) -> None:
        self._low, self._hierarchy, self._columns = low, hierarchy, low.columns
        n, device = low.rank, hierarchy.device
        self._inverses = HostArray((2, n * n), wp.float64, device)  # of S and E
        self._S, self._E = self._inverses.array[0], self._inverses.array[1]
        self._sums, self._kept, self._force, self._t = (
            wp.zeros(n, dtype=wp.float64, device=device) for _ in range(4)
        )
        self.noted = DeviceScalar(device, n + n // low.columns.width)
        self.calm = wp.zeros(1, dtype=wp.int32, device=device) if device.is_cuda else None
        self._power = wp.float64(
            1.0 / max(sum(n > 1 for n in hierarchy.finest.stencil.padding.counts) - 1, 1)
        )
        # The reduction of the sums on a GPU, with the memory of its entries.
        self._adding: tuple[BoundKernel, Reduction] | None = None
        self._columns_of_slots = HostArray(n, wp.int32, device)
        self._of_slot = self._columns_of_slots.array
        self._size = hierarchy.finest.x.size
        self._Z = wp.zeros(0, dtype=hierarchy.real, device=device)
        self._spare = self._Z  # memory for potentials that change slots
        self._bound: dict[
            int, tuple[Reduction, BoundKernel, BoundKernel]
        ] = {}  # by the number of slots
        self._dots: Reduction | None = None
        self._slot_columns = list[int]()
        self._seen = np.zeros(n)  # U_q' U_q when a potential was made
        few = n * n <= MOST_READ  # U'Z, a slot after another
        self._read_products = DeviceScalar(device, n * n) if few else None
        self._products = (
            self._read_products.array
            if self._read_products is not None
            else wp.zeros(0, dtype=wp.float64, device=device)
        )
        at_once = low.layout.comm is not None
        self._squaring, self._exciting, self._multiplying, self._filling = (
            LaunchGraph(device, record, at_once=at_once)
            for record in (
                self._launch_squares,
                self._launch_unit_force,
                self._launch_products,
                self._launch_potential,
            )
        )

    @property
    def slots(self) -> int:
        """Number of corrected columns."""
        return len(self._slot_columns)

    @property
    def is_calm(self) -> bool:
        """Whether no column is corrected.

        A GPU then continues without the host while `calm` is 1.
        """
        return self.calm is not None and self.slots == 0

    @property
    def is_made_on_gpu(self) -> bool:
        """Whether a GPU computes the potentials before the host's decision.

        They are those of the last solve's columns, at the start of the next solve.
        """
        return self.calm is not None and self.slots > 0

    @property
    def readings(self) -> tuple[DeviceScalar, ...]:
        """Arrays that `note`, `note_products` and `make_potentials` write."""
        return (self.noted,) if self._read_products is None else (self.noted, self._read_products)

    @property
    def key(self) -> tuple[int, ...]:
        """Key of recorded launches."""
        return self.slots, self._Z.ptr or 0

    def prepare(self) -> None:
        """Prepare the launches of `note` for the current memory of the entries."""
        found, key = self.noted.array, self._columns.rows.ptr
        if self.calm is not None and (self._adding is None or self._adding[0] != key):
            self._adding = key, self._columns.reduction(found, found.size)

    def note(self, launch: Launch) -> None:
        """Launch the sums by which `renew` decides.

        U_q' U_q over the free set, the number of rows that each body touches there and, on a GPU,
        `calm`.
        """
        columns, low, d = self._columns, self._low, self._hierarchy.finest.stencil.d
        if self.calm is None:
            one = Rows.flat(1, low.device)
            SQUARES.bind(
                one, columns.entry_fields, rank=low.rank, d=d, squares=self.noted.array
            ).launch(launch)
            return
        assert self._adding is not None, "prepare comes first"
        squares, adding = self.noted.array, self._adding[1]
        BY_TURNS.bind(
            columns.turns, columns.entry_fields, rank=low.rank, d=d, out=adding.partials
        ).launch(launch)
        adding.add_up(0, columns=squares.size, launch=launch)
        inputs = [low.weights, squares, low.rank, columns.width, self._power, self.calm]
        launch(calm_kernel, 1, inputs, device=low.device)

    def renew(self, *, begins: bool, noted: bool = False, has_potentials: bool = False) -> bool:
        """Choose the columns to correct for the current free set, and update potentials.

        A potential Z_q = B U_q costs a cycle.

        Args:
            begins: whether a solve begins.
            noted: whether `note` has been launched for this free set, `note_products` too, and
                their readings have changed since.
            has_potentials: whether `make_potentials` has been launched.

        Returns:
            Whether the finest right-hand side was overwritten.
        """
        low, W = self._low, self._low.host_weights
        if not noted:
            self.prepare()
            self._squaring.run(variant=self._columns.rows.ptr)
            self.noted.changed()
        reduced, width, comm = self.noted.numpy().copy(), self._columns.width, low.layout.comm
        reduced = reduced if comm is None else comm.sum(reduced)
        squares, rows = reduced[: low.rank], np.repeat(reduced[low.rank :], width)
        # Ratio of added to own inertia of column q: W_qq U_q'A^-1 U_q, estimated from the rows that
        # it touches.
        strong = np.flatnonzero(
            W.diagonal() * SPREAD * rows ** float(self._power.value) * squares >= STRONG
        ).tolist()
        if begins:
            self._seen[:] = 0.0
        slots_changed = strong != self._slot_columns
        if slots_changed:
            self._choose(strong)
        seen, now = self._seen.tolist(), squares.tolist()
        stale = [q for q in strong if not seen[q] / CHANGED <= now[q] <= seen[q] * CHANGED]
        has_potentials = has_potentials and begins and not slots_changed
        if has_potentials:
            self._seen[stale] = squares[stale]
        else:
            self._fill(stale, squares)
        overwritten, products_known = (
            bool(stale),
            self._read_products is not None
            and (has_potentials or (noted and not begins and not slots_changed and not stale)),
        )
        if strong and not self._invert(W, known=products_known) and len(stale) < len(strong):
            self._fill([q for q in strong if q not in stale], squares)
            self._invert(W)
            overwritten = True
        return overwritten

    def begin(self, *, launch: Launch = launch_now) -> None:
        """Subtract U S'^-1 Z'r from the finest right-hand side r, before a cycle.

        That is r <- P'r; the factors stay in `force`.
        """
        if self._dots is None:
            return
        low, m = self._low, self.slots
        self._multiply.launch(launch)
        self._dots.add_up(0, columns=m, launch=launch)
        inputs = [self._S, self._E, self._of_slot, self._sums, m, self._force, self._kept]
        launch(split_kernel, m, inputs, device=low.device)
        self._spread(-1.0, launch)

    def end(self, *, launch: Launch = launch_now) -> None:
        """Correct the finest x after the cycle, and restore r.

        x <- x - Z (S^-1 U'x - E^-1 Z'r), and the term that `begin` subtracted is added again.
        """
        if self._dots is None:
            return
        low, finest, m = self._low, self._hierarchy.finest, self.slots
        self._spread(1.0, launch)
        u = self._columns.gather(finest.x, launch=launch)
        launch(
            join_kernel, m, [self._S, self._of_slot, u, m, self._kept, self._t], device=low.device
        )
        self._subtract.launch(launch)

    def _choose(self, strong: list[int]) -> None:
        """Assign slots to these columns.

        Columns that have a slot keep their potentials; the others' must be computed.

        Slot s holds the n values Z[s n : (s + 1) n] of a potential. They are copied by way of
        `_spare`, because slots before and after overlap. A column with `_seen` = 0 has no potential
        yet.
        """
        old, low, n = {q: slot for slot, q in enumerate(self._slot_columns)}, self._low, self._size
        with_potentials = [q for q in strong if q in old and self._seen[q] > 0.0]
        before = self._Z
        if with_potentials:
            if self._spare.size < before.size:
                self._spare = wp.empty_like(before)
            wp.copy(self._spare, before, count=before.size)
            before = self._spare
        if len(strong) * n > self._Z.size:
            self._Z = wp.zeros(len(strong) * n, dtype=before.dtype, device=before.device)
            self._bound = {}
        order = np.zeros(low.rank, dtype=np.int32)
        order[: len(strong)] = strong
        self._columns_of_slots.host[:] = order
        self._columns_of_slots.send()
        self._slot_columns = strong
        self._dots = None
        if strong:
            if len(strong) not in self._bound:
                self._bound[len(strong)] = self._bind(len(strong))
            self._dots, self._multiply, self._subtract = self._bound[len(strong)]
        for q in with_potentials:
            wp.copy(
                self._Z, before, dest_offset=strong.index(q) * n, src_offset=old[q] * n, count=n
            )
        self._seen[[q for q in range(low.rank) if q not in with_potentials]] = 0.0

    def _bind(self, slots: int) -> tuple[Reduction, BoundKernel, BoundKernel]:
        """Return the launches for a number of slots: sums Z'r, products, z -= Z t."""
        finest, rows, n, comm = (
            self._hierarchy.finest,
            self._hierarchy.finest.stencil.rows,
            self._size,
            self._low.layout.comm,
        )
        dots = Reduction(
            n, self._low.device, self._sums, columns=slots, threads=rows.places, comm=comm
        )
        multiply = DOTS.bind(rows, r=finest.b, out=dots.partials, Z=self._Z, slots=slots, size=n)
        return (
            dots,
            multiply,
            SUBTRACT.bind(
                rows,
                factors=self._t,
                z=finest.x,
                d=finest.stencil.d,
                Z=self._Z,
                slots=slots,
                size=n,
            ),
        )

    def _fill(self, columns: list[int], squares: np.ndarray) -> None:
        """Compute the potentials B U_q of columns."""
        finest, n = self._hierarchy.finest, self._size
        if self.calm is not None and self._low.layout.comm is None:
            for q in columns:
                slot = self._slot_columns.index(q)
                self._filling.run(slot, variant=(*self.key, self._columns.rows.ptr))
            self._seen[columns] = squares[columns]
            return
        for q in columns:
            unit = np.zeros(self._low.rank)
            unit[q] = 1.0
            self._force.assign(unit)
            self._exciting.run(variant=self._columns.rows.ptr)
            self._hierarchy.cycle.run()
            wp.copy(self._Z, finest.x, dest_offset=self._slot_columns.index(q) * n, count=n)
            self._seen[q] = squares[q]

    def make_potentials(self) -> None:
        """Launch the potentials of all slots, and their products."""
        for slot in range(self.slots):
            self._launch_potential(slot)
        self.note_products()

    def note_products(self) -> None:
        """Launch the products of the potentials if `renew` can read them.

        They are on the free set, and are read together with other numbers.
        """
        if self._read_products is not None:
            self._launch_products(self._products)

    def _invert(self, W: np.ndarray, *, known: bool = False) -> bool:
        """Write the inverses of S and E on the modes that count.

        With V the modes of W^(1/2) S W^(1/2) whose ratio exceeds FELT, an inverse is V (V'M V)^-1
        V'. `known`: the products have been read. Returns whether S is sufficiently symmetric.
        """
        m = self.slots
        if self._products.size < m * self._low.rank:
            self._products = wp.zeros(m * self._low.rank, dtype=wp.float64, device=self._low.device)
        if not known:
            self._multiplying.run(self._products, variant=(*self.key, self._columns.rows.ptr))
            if self._read_products is not None:
                self._read_products.changed()
        products = self._products if self._read_products is None else self._read_products
        # G = U'Z, of which S has the rows of the corrected columns; its symmetric and skew parts.
        G = np.ascontiguousarray(products.numpy()[: m * self._low.rank].reshape(m, -1).T)
        S = G[self._slot_columns]
        even, odd = 0.5 * (S + S.T), 0.5 * (S - S.T)
        # W^(1/2) on the corrected columns, from the eigenvectors of W.
        values, vectors = np.linalg.eigh(W[np.ix_(self._slot_columns, self._slot_columns)])
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        ratios, modes = np.linalg.eigh(root.T @ even @ root)
        felt = ratios > FELT
        # V spans the modes with a ratio above FELT; V (V'M V)^-1 V' is the inverse of M on them.
        V = root @ modes[:, felt]
        scale = 1.0 / np.sqrt(ratios[felt])
        skew = np.abs(scale[:, None] * (V.T @ odd @ V) * scale).max(initial=0.0)
        E = even + G.T @ W @ G
        for target, matrix in zip(self._inverses.host, (S, E), strict=True):
            target[: m * m] = (V @ np.linalg.solve(V.T @ matrix @ V, V.T)).ravel()
        self._inverses.send()
        return bool(skew <= SKEW and ratios.min(initial=0.0) > -SKEW)

    def _launch_squares(self) -> None:
        """Launch `note`."""
        self.note(launch_recorded)

    def _launch_unit_force(self) -> None:
        """Set the finest right-hand side to U f."""
        clear(self._hierarchy.finest.b)
        self._spread(1.0, launch_recorded)

    def _launch_potential(self, slot: int) -> None:
        """Launch the potential of a slot's column on a GPU: one cycle."""
        launch_recorded(
            unit_kernel, self._low.rank, [self._of_slot, slot, self._force], device=self._low.device
        )
        self._launch_unit_force()
        self._hierarchy.cycle.run()
        copy(self._Z[slot * self._size : (slot + 1) * self._size], self._hierarchy.finest.x)

    def _launch_products(self, products: DeviceArray) -> None:
        """Launch U'Z, slot by slot; `force` is cleared."""
        clear(self._force)
        d, rank, n = self._hierarchy.finest.stencil.d, self._low.rank, self._size
        for s in range(self.slots):
            along = self._columns.gather(
                self._Z[s * n : (s + 1) * n], mask=d, fused=False, launch=launch_recorded
            )
            copy(products[s * rank : (s + 1) * rank], along)

    def _spread(self, sign: float, launch: Launch) -> None:
        """Add U f to the finest right-hand side."""
        finest = self._hierarchy.finest
        self._columns.scatter(
            self._force,
            finest.b,
            finest.b,
            mask=finest.stencil.d,
            sign=sign,
            fused=False,
            launch=launch,
        )
