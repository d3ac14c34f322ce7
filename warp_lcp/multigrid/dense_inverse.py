"""Coarsest solver of a grid: a dense inverse, computed on the device.

With bounds it makes projected sweeps.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import warp as wp

from warp_lcp.kernels import BoundKernel, Rows
from warp_lcp.kernels.fields import zeros
from warp_lcp.kernels.launch_graph import CommandBuffer
from warp_lcp.kernels.persistent_kernel import CUDA_THREADS
from warp_lcp.multigrid.coarsest_kernels import PINNED, coarsest_kernels
from warp_lcp.multigrid.cycle import CycleStage
from warp_lcp.multigrid.cycle_passes import ASSEMBLE, ELIMINATE, INVERT, SOLVE
from warp_lcp.multigrid.stencil_level import StencilLevel

if TYPE_CHECKING:
    from warp_lcp.multigrid.black_box_multigrid import LineLevel


class DenseInverse:
    """Coarsest solver: x = A^-1 b by the dense inverse of the level's matrix.

    An unknown whose pivot is rounding error of a singular component is held at 0.

    Args:
        level: a `StencilLevel` or `LineLevel`.

    Attributes:
        matrix, inverse: float64, shape (m, m), m cells; the matrix is overwritten by its factors.
        product: the kernel x = inverse b.
    """

    def __init__(self, level: StencilLevel | LineLevel) -> None:
        self.level, self._counts, self._device = (
            level,
            level.stencil.padding.counts,
            level.stencil.device,
        )
        nz, ny, nx = self._counts
        m = math.prod(self._counts)
        self.matrix, self.inverse = (zeros((m, m), wp.float64, self._device) for _ in range(2))
        self._own = zeros(m, wp.float64, self._device)
        self.product: BoundKernel = SOLVE.bind(
            Rows.flat(m, self._device),
            inverse=self.inverse,
            b=level.b,
            x=level.x,
            nx=nx,
            ny=ny,
            nz=nz,
        )

    def record(self, program: CommandBuffer, *, by_block: bool) -> None:
        """Record the inversion of the matrix at the time of a run.

        Args:
            program: that records.
            by_block: whether one block of a GPU inverts a matrix of seven points; else one thread
                factors it.
        """
        if self.level.stencil.pattern is None:
            self._record_seven_points(program, by_block=by_block)
        else:
            self._record_compact(program)

    def _record_compact(self, program: CommandBuffer) -> None:
        """Record Gauss-Jordan elimination of the m x m matrix of all cells, m = nz ny nx.

        The matrix need not be symmetric.
        """
        s, (nz, ny, nx) = self.level.stencil, self._counts
        (px, py, pz), least = s.periodic, PINNED[self.level.x.dtype]
        matrix, inverse = self.matrix.flatten(), self.inverse.flatten()
        rows, one = (
            Rows.of(s.padding, self._device, whole=True),
            Rows.flat(1, self._device, serial=True),
        )
        ASSEMBLE.bind(
            rows,
            stencil=s,
            matrix=matrix,
            cells=nx,
            lines=ny,
            planes=nz,
            periodic_x=px,
            periodic_y=py,
            periodic_z=pz,
        ).launch(program.launch)
        ELIMINATE.bind(
            one, matrix=matrix, inverse=inverse, own=self._own, m=nz * ny * nx, least=least
        ).launch(program.launch)

    def _record_seven_points(self, program: CommandBuffer, *, by_block: bool) -> None:
        """Record the computation of the inverse.

        The CPU computes L D L' and the columns of the inverse; CUDA uses Gauss-Jordan elimination
        by one block.
        """
        assert isinstance(self.level, StencilLevel)
        s, changed, real, m = (
            self.level.stencil,
            self.level.changed,
            self.level.x.dtype,
            self.matrix.shape[0],
        )
        kernels = coarsest_kernels(s.weights is not None, s.d.dtype, real)
        inputs = [
            s.struct,
            s.rows.single,
            wp.vec3i(*map(int, s.periodic)),
            wp.float64(PINNED[real]),
        ]
        if by_block:
            inputs += [CUDA_THREADS, self.matrix, self.inverse]
            program.launch(
                kernels.invert, CUDA_THREADS, inputs, device=self._device, block_dim=CUDA_THREADS
            )
            return
        program.launch(kernels.factor, 1, [*inputs, changed, self.matrix], device=self._device)
        INVERT.bind(
            Rows.flat(m, self._device),
            changed=changed,
            matrix=self.matrix,
            inverse=self.inverse,
            m=m,
            flags=changed.size,
        ).launch(program.launch)

    def solve(self, visits: int, *, projected: bool, from_zero: bool) -> Iterable[CycleStage]:
        """Return the stages of a `CoarsestSolver`.

        They run once, whatever `visits` is, because the result is the exact solution.
        """
        return self._sweeps(from_zero=from_zero) if projected else [self.product]

    def _sweeps(self, *, from_zero: bool) -> Iterator[CycleStage]:
        """Yield projected pairs of sweeps, forward and backward: symmetric."""
        assert isinstance(self.level, StencilLevel)
        level, settings = self.level, self.level.settings
        on_cpu = self._device.is_cpu
        pairs = settings.projected_sweeps if on_cpu else settings.projected_sweeps_cuda
        for sweep in range(pairs):
            yield from level.pair(
                settings.weights, projected=True, from_zero=from_zero and sweep == 0
            )
            yield from level.pair(settings.weights[::-1], projected=True)
