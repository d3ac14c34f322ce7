"""Black-box multigrid for compact stencils in 2-D (Dendy).

It serves stencils that point sweeps do not smooth, by operator-dependent transfers and line
relaxation. Coarse cells are every second one along an axis. A cell between two of them interpolates
from each by its row's weights: the prolongation by those of (A + A')/2, the restriction by those of
A' (as de Zeeuw has it), so that coarse matrices R A P of convection keep the wind's direction. They
are compact again. Rows of one color after those of the other are solved for as tridiagonal systems,
then columns; on the way up in the reverse order. With W-cycles a Krylov method takes about ten
iterations from 128 to 1024 cells a side, for winds at Peclet numbers up to 1e4 that turn, for
anisotropy of 1 : 100 at any angle, and for coefficients over seven decades.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TypeGuard

import warp as wp

from warp_lcp.kernels import BoundKernel, KernelFile, Rows
from warp_lcp.kernels.fields import Padding, zeros
from warp_lcp.kernels.launch_graph import CommandBuffer
from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.multigrid.cycle import Cycle, CycleStage, recorded
from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.multigrid.dense_inverse import DenseInverse
from warp_lcp.operators.grid_operator import GridOperator
from warp_lcp.operators.padded_stencil import PaddedStencil
from warp_lcp.operators.stencil import AROUND
from warp_lcp.problem.operator_protocol import HasStencil, Operator, has

KERNELS = KernelFile(Path(__file__).parent / "headers/lines.h")
FILL = KERNELS["lines.fill"]
EDGES = KERNELS["lines.edges"]
CORNERS = KERNELS["lines.corners"]
GALERKIN = KERNELS["lines.galerkin"]
FACTOR = KERNELS["lines.factor"]
ZEBRA_X = KERNELS["lines.zebra_x"]
ZEBRA_Y = KERNELS["lines.zebra_y"]
RESIDUAL = KERNELS["lines.residual"]
DOWN = KERNELS["lines.down"]
UP = KERNELS["lines.up"]
ZERO = KERNELS["lines.zero"]
SHORT = 3  # cells of an axis that is not coarsened further
# Columns that one thread of a CPU solves together: their cells of a row are vectors, and the rows
# stay in its cache.
COLUMNS = 256
EVEN = 0.5  # least ratio of weights along the two axes for point sweeps


@dataclass(frozen=True, slots=True)
class LineFields:
    """Fields of a level, as arguments of the kernels of line multigrid.

    Attributes:
        x: iterate.
        b: right-hand side.
        t: buffer.
        d: diagonal.
        weights: minus the coefficients, one field an offset, one after another.
        size: elements of a field.
        cells: of a row.
    """

    x: DeviceArray
    b: DeviceArray
    t: DeviceArray
    d: DeviceArray
    weights: DeviceArray
    size: int
    cells: int


class LineLevel:
    """One level, see `CycleLevel`: stencil, line factors and transfer weights.

    Args:
        padding: counts of cells and of stored cells.
        real: type of the fields.
        device: where they are.
        symmetric: whether the operator is.
        visits: cycles on this level in each of the next finer one.

    Attributes:
        x, b, t: iterate, right-hand side and residual.
    """

    def __init__(
        self,
        padding: Padding,
        real: DataType,
        device: wp.Device,
        *,
        symmetric: bool,
        visits: int = 1,
    ) -> None:
        self.padding, self.device, self.visits, n = padding, device, visits, padding.size
        self._legs: dict[tuple[str, bool], list[CycleStage]] = {}
        self.factors = 2 if padding.counts[2] > SHORT else 1, 2 if padding.counts[1] > SHORT else 1

        def make(count: int) -> DeviceArray:
            return zeros(count * n, real, device)

        self.weights, self.shares = make(8), make(4)
        self.restricts = self.shares if symmetric else make(4)
        self.x, self.b, self.t, self.d = (padding.zeros(real, device) for _ in range(4))
        self.fields = LineFields(self.x, self.b, self.t, self.d, self.weights, n, padding.counts[2])
        # Reciprocal pivots and multipliers of the tridiagonal systems along x and along y.
        self.lines = [(make(1), make(1)) for _ in range(2)]
        each = tuple(self.weights[i * n : (i + 1) * n] for i in range(8))
        self.stencil = PaddedStencil(padding, self.d, each, (), pattern=AROUND)
        self.rows = Rows.of(padding, device, whole=True)
        self.columns = Rows.strided(
            n,
            device,
            (self.rows.single.base, padding.plane, padding.row),
            (1, 1, padding.counts[2]),
            cells=COLUMNS if device.is_cpu else 2,
        )

    def transfer_kernels(self) -> list[BoundKernel]:
        """Return the kernels that compute the transfer weights."""
        fx, fy = self.factors
        same = int(self.restricts is self.shares)
        passes = []
        for restriction, shares in enumerate(
            [self.shares] if same else [self.shares, self.restricts]
        ):
            for kernel in (EDGES, CORNERS) if self.factors == (2, 2) else (EDGES,):
                passes.append(
                    kernel.bind(
                        self.rows,
                        self.fields,
                        shares=shares,
                        fx=fx,
                        fy=fy,
                        SAME=same,
                        RESTRICTION=restriction,
                    )
                )
        return passes

    def factor_kernels(self) -> list[BoundKernel]:
        """Return the kernels that factor the lines' tridiagonal systems."""
        _, ny, nx = self.padding.counts
        bound_kernels = []
        for rows, (pivots, multiples), step, count in zip(
            (self.rows, self.columns), self.lines, (1, self.padding.row), (nx, ny), strict=True
        ):
            bound_kernels.append(
                FACTOR.bind(
                    rows,
                    self.fields,
                    unused=self.d,
                    diagonals=self.d,
                    pivots=pivots,
                    multiples=multiples,
                    step=step,
                    count=count,
                )
            )
        return bound_kernels

    def coarsen_kernel(self, coarse: LineLevel) -> BoundKernel:
        """Return the kernel that computes the next level's matrix."""
        fx, fy = self.factors
        rows = coarse.rows.beside(self.rows, (*self.factors, 1))
        return GALERKIN.bind(
            rows,
            self.fields,
            unused=self.t,
            diagonals=self.d,
            shares=self.shares,
            restricts=self.restricts,
            coarse_weights=coarse.weights,
            coarse_d=coarse.d,
            coarse_size=coarse.padding.size,
            FX=fx,
            FY=fy,
        )

    @cached_property
    def _zebras(self) -> tuple[list[BoundKernel], list[BoundKernel]]:
        """Line relaxation: sweeps of rows and of columns, each of both colors."""
        (px, mx), (py, my) = self.lines
        fields, s, step, count = self.fields, self.stencil, self.padding.row, self.padding.counts[1]
        across = [
            ZEBRA_X.bind(self.rows, fields, stencil=s, pivots=px, multiples=mx, color=color)
            for color in (0, 1)
        ]
        along = [
            ZEBRA_Y.bind(
                self.columns,
                fields,
                stencil=s,
                pivots=py,
                multiples=my,
                color=color,
                step=step,
                count=count,
            )
            for color in (0, 1)
        ]
        return across, along

    def smooth_kernels(self, *, up: bool) -> list[BoundKernel]:
        """Return the sweeps on the way down, rows first, or on the way up."""
        sweeps = [sweep for axis in self._zebras for sweep in axis]
        return sweeps[::-1] if up else sweeps

    def descend(self, coarse: LineLevel, *, projected: bool, from_zero: bool) -> list[CycleStage]:
        """Return steps 1 and 2 of a cycle: line sweeps, and the restricted residual."""
        assert not projected, "sweeps of lines know no bounds"
        key = "down", from_zero
        if key not in self._legs:
            zero = [ZERO.bind(Rows.flat(self.x.size, self.device), x=self.x)] if from_zero else []
            self._legs[key] = [
                *zero,
                *self.smooth_kernels(up=False),
                *self.restrict_kernels(coarse),
            ]
        return self._legs[key]

    def restrict_kernels(self, coarse: LineLevel) -> list[BoundKernel]:
        """Return the kernel that restricts the residual."""
        return [
            RESIDUAL.bind(self.rows, self.fields, stencil=self.stencil),
            self.restrict_to_coarse_kernel(coarse),
        ]

    def coarsen_bounds(self, coarse: LineLevel) -> tuple[()]:
        """Return no stages: there are no bounds."""
        return ()

    def ascend(self, coarse: LineLevel, *, projected: bool) -> list[CycleStage]:
        """Return steps 5 and 6 of a cycle: the correction and line sweeps."""
        key = "up", projected
        if key not in self._legs:
            self._legs[key] = [self.correct_kernel(coarse), *self.smooth_kernels(up=True)]
        return self._legs[key]

    def restrict_to_coarse_kernel(self, coarse: LineLevel) -> BoundKernel:
        """Return the kernel that restricts the residual to the coarse right-hand side."""
        fx, fy = self.factors
        rows = coarse.rows.beside(self.rows, (*self.factors, 1))
        return DOWN.bind(
            rows,
            self.fields,
            shares=self.restricts[: self.padding.size],
            coarse=coarse.b,
            fx=fx,
            fy=fy,
        )

    def correct_kernel(self, coarse: LineLevel, *, add: bool = True) -> BoundKernel:
        """Return the kernel that adds the coarse correction, or sets x to it."""
        rows = self.rows.beside(coarse.rows, (-self.factors[0], -self.factors[1], -1))
        return UP.bind(rows, self.fields, coarse=coarse.x, shares=self.shares, add=add)


class BlackBoxMultigrid:
    """Multigrid for (P A P + P D P) e = r of a compact stencil in 2-D.

    `restrict` sets the free set and the shift, `cycle` computes the finest level's x from its b.

    Args:
        stencil: the operator's, with a pattern; no axis is periodic.
        real: type of the corrections.
        symmetric: whether A is.
        settings: of the cycles: `gamma`, and the size of the coarsest level.
    """

    def __init__(
        self,
        stencil: PaddedStencil,
        real: DataType,
        *,
        symmetric: bool,
        settings: CycleSettings | None = None,
    ) -> None:
        self._source, self.settings, self.device = (
            stencil,
            settings or CycleSettings(),
            stencil.device,
        )
        self.levels = [LineLevel(stencil.padding, real, self.device, symmetric=symmetric)]
        most = self.settings.coarsest_cuda if self.device.is_cuda else self.settings.coarsest_cpu
        while math.prod(self.levels[-1].padding.counts) > most and self.levels[-1].factors != (
            1,
            1,
        ):
            fine = self.levels[-1]
            _, ny, nx = fine.padding.counts
            padding = Padding((1, -(-ny // fine.factors[1]), -(-nx // fine.factors[0])))
            self.levels.append(
                LineLevel(
                    padding, real, self.device, symmetric=symmetric, visits=self.settings.gamma
                )
            )
        self._dense = DenseInverse(self.levels[-1])

    @property
    def finest(self) -> LineLevel:
        """The level of the operator itself."""
        return self.levels[0]

    def restrict(
        self, free: DeviceArray, shift: DeviceArray | None = None, weight: DeviceArray | None = None
    ) -> None:
        """Set the free set and the shift, and coarsen.

        The set is a stored uint8 field, the shift float64. One over the diagonal is written to
        `weight`.
        """
        self._fill(free, shift, weight)
        self._build_program.run()

    def take_all(self, free: DeviceArray) -> None:
        """Set a free set for transfers between the two finest levels only."""
        self._fill(free, None, None)
        for made in self.finest.transfer_kernels():
            made.launch()

    def _fill(
        self, free: DeviceArray, shift: DeviceArray | None, weight: DeviceArray | None
    ) -> None:
        finest = self.finest
        FILL.bind(
            finest.rows,
            finest.fields,
            stencil=self._source,
            free=free,
            shift=shift,
            weight=weight,
            made=finest.d,
        ).launch()

    @cached_property
    def _build_program(self) -> CommandBuffer:
        program = CommandBuffer(self.device)
        for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
            for made in (
                *fine.transfer_kernels(),
                *fine.factor_kernels(),
                fine.coarsen_kernel(coarse),
            ):
                made.launch(program.launch)
        self._dense.record(program, by_block=False)
        return program

    @cached_property
    def cycle(self) -> CommandBuffer:
        """Program of one cycle from x = 0."""
        return recorded(self.device, Cycle(self.levels, self._dense.solve).stages())


def takes_points(A: Operator) -> TypeGuard[HasStencil]:
    """Return whether a `Hierarchy` suits an operator.

    It must have a stencil, be symmetric, and need no line relaxation.
    """
    return has(A, HasStencil) and A.symmetric and not needs_lines(A)


def needs_lines(A: HasStencil) -> bool:
    """Return whether black-box multigrid suits an operator.

    Its stencil must be compact and in 2-D, and not of the kind that point sweeps on aggregates
    solve as fast: symmetric with weights >= 0, alike along both axes.
    """
    s = A.stencil
    if s.pattern is None or s.padding.counts[0] > 1 or any(s.periodic):
        return False
    along = sorted(s.mean_weights[:2])
    return not (
        A.symmetric and isinstance(A, GridOperator) and A.monotone and along[0] >= EVEN * along[1]
    )
