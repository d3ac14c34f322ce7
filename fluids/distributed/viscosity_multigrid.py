"""Multigrid for the viscous equations across ranks: fine levels are shared, each rank with its box; a small one is gathered on all.

Each face belongs to the rank whose box has the cell above it. A sweep takes the faces of one process in its order: a component has two
colors of rows, and ghost cells in so many layers as the second color needs are computed twice; then the component's ghost cells come from
their ranks. So the cycle is that of one process, on any number of ranks; where rows are not cut it has its bits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np
import warp as wp

from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.fluids.viscosity_multigrid import LEAST, LevelShift, VectorLevel, VectorMultigrid
from warp_lcp.grid.staggered import StaggeredGrid, Window, three_components
from warp_lcp.multigrid.halo_levels import GATHERED
from warp_lcp.rows.program import Launch, perform

KNOWN = 3  # layers of ghost cells that sweeps need: rows of the second color look at those of the first, where odd cells look at even ones


class SharedVectorLevel(VectorLevel):
    """A rank's part of a level.

    Args:
        part: of the level's grid.
        x: as of `VectorLevel`.
        b: as of `VectorLevel`.
        finer: the part of the finer level; None: this one is the finest.
    """

    def __init__(self, part: Subdomain, x: list[wp.array], b: list[wp.array], finer: Subdomain | None = None) -> None:
        super().__init__(part.grid, x, b)
        self.part, origin = part, part.grid.origin
        if finer is not None:
            self.shift = LevelShift(*[2 * own - fine for own, fine in zip(origin, finer.grid.origin, strict=True)])
        self.odd_row, self.odd_cell = (origin[1] + origin[2]) % 2, origin[0] % 2
        self._windows = [self._grown(width) for width in range(KNOWN + 1)]

    def _grown(self, width: int) -> Window:
        owned, domain = self.part.owned, self.grid.domain
        low = [max(n - width, least) for n, least in zip(owned.low, domain.low, strict=True)]
        return Window.of(low, [min(n + width, most) for n, most in zip(owned.high, domain.high, strict=True)], self.grid.device)

    def around(self, width: int) -> Window:
        """Return the cells of the box and so many around it."""
        return self._windows[width]

    def share(self, fields: Sequence[wp.array], launch: Launch | None = None) -> None:
        """Fill the ghost cells: all of the equations, `KNOWN` layers of what a sweep has changed."""
        if launch is None:
            self.part.fill(*fields)
        else:
            memory = fields if self.grid.device.is_cuda else [field.numpy() for field in fields]
            perform(partial(self.part.fill, *memory, width=KNOWN), launch)

    def halved(self, window: Window) -> Window:
        """Return the cells that this rank is the one to know."""
        known = self.part.known
        return Window.of(known.low[::-1], known.high[::-1], self.grid.device)

    def normalize(self, coarse: VectorLevel, window: Window) -> None:
        """Find the normalization of the interpolation where it is made."""
        super().normalize(coarse, self.around(KNOWN))

    def find_spans(self, window: Window) -> None:
        """Find where this part's unknowns lie, and the cores of the whole grid's rows."""
        super().find_spans(self.grid.domain)
        if 0 in self.part.decomposition.cut_axes:
            self._join_cores()

    def _join_cores(self) -> None:
        """Find cores that may reach over the boxes of several ranks."""
        grid, owned = self.grid, self.part.owned
        ranks = self.part.ranks.in_rows(self.part.decomposition.processes[0])  # that have parts of the same rows, in their order
        domain, device = grid.domain, grid.device
        mine = Window.of([*domain.low[:2], owned.low[2]], [*domain.high[:2], owned.high[2]], device)
        span, ends = (wp.zeros(n * grid.shape[0] * grid.shape[1], dtype=wp.int32, device=device) for n in (4, 2))
        dx, dy, dz = three_components(self.diagonal)
        mine.run(self.passes.span, whole=True, dx=dx, dy=dy, dz=dz, span=span, ends=ends)
        begin, end, offset = owned.low[2], owned.high[2], grid.origin[0]
        row = np.column_stack([span.numpy().reshape(-1, 4)[:, 2:], ends.numpy().reshape(-1, 2)]).astype(np.int32)
        none = row[:, 0] >= row[:, 1]
        row[none] = 0
        row[:, :2] += np.int32(offset) * ~none[:, None]
        every = ranks.gather(np.vstack([row, [[begin + offset, end + offset, 0, 0]]]).astype(np.int32))
        low, length, run = (np.zeros(len(row), dtype=np.int32) for _ in range(3))
        for found, (start, stop, _, _) in zip(every[:, :-1], every[:, -1], strict=True):
            first, last, head, tail = found.T
            for begins, size in ((start - run, np.where(head > 0, run + head, 0)), (first, last - first)):
                longer = size > length
                low, length = np.where(longer, begins, low), np.where(longer, size, length)
            run = np.where(tail == stop - start, run + tail, tail)
        host = self.span.numpy().reshape(-1, 4).copy()
        host[:, 2] = np.where(length > 0, low - offset, host[:, 1])
        host[:, 3] = np.where(length > 0, low + length - offset, host[:, 1])
        self.span.assign(host.ravel())


class SharedVectorMultigrid(VectorMultigrid):
    """What `VectorMultigrid` is, on a grid that ranks share; `set_up` and `apply` are collective.

    `r` is read, and `z` written, of this rank's own faces; of the others within `KNOWN` layers `z` is what their ranks find.

    Args:
        part: where this rank works.
    """

    levels: Sequence[SharedVectorLevel]

    def __init__(self, part: Subdomain) -> None:
        self.part = part
        self._b = wp.zeros(part.grid.dimension * part.grid.size, dtype=wp.float32, device=part.grid.device)
        super().__init__(part.grid)

    def _levels(self) -> list[SharedVectorLevel]:
        part, levels = self.part, [SharedVectorLevel(self.part, self.components(self.z), self.components(self._b))]
        while max(part.decomposition.counts) > LEAST and math.prod(part.decomposition.counts) > GATHERED:
            coarser = part.decomposition.coarser((2, 2, 2 if part.dimension == 3 else 1))
            if coarser is None or any(min(coarser.parts[axis]) <= KNOWN for axis in coarser.cut_axes):
                break
            finer, spacing = part, 2.0 * part.grid.spacing
            part = Subdomain(coarser, spacing=spacing, dimension=part.dimension, device=part.grid.device, layers=KNOWN + 1)
            levels.append(SharedVectorLevel(part, part.grid.faces(), part.grid.faces(), finer))
        grid = part.grid
        self._whole = VectorMultigrid(StaggeredGrid(part.decomposition.counts, grid.spacing, grid.dimension, grid.device))
        return levels

    def set_up(self) -> None:
        """Make the coarse levels from the finest, all of them anew."""
        super().set_up()
        last, first = self.levels[-1], self._whole.levels[0]
        last.part.collect(last.equations, first.equations)
        self._whole.move_to(first.grid.everywhere)
        self._whole.set_up()

    def _cycle(self, number: int, launch: Launch) -> None:
        level = self.levels[number]
        if number == 0:
            perform(partial(wp.copy, self._b, self.r), launch)
        if number == len(self.levels) - 1:
            perform(self._cycle_whole, launch)
        else:
            level.share(level.b, launch)
            super()._cycle(number, launch)

    def _cycle_whole(self) -> None:
        """Go on from the gathered level, as every rank does."""
        last, first = self.levels[-1], self._whole.levels[0]
        last.part.collect(last.b, first.b)
        self._whole.apply()
        for whole, x in zip(first.x, last.x, strict=True):
            last.part.take(whole, x)
