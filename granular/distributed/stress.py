"""The stress of sand that ranks share: one problem of all ranks a step, each of which has the cells of its box.

What a step does to a cell looks at the velocities of faces and the rates of strain of edges around it, these at faces a cell farther, and
those at the stresses of cells a cell farther still. So a step begins with the stresses of sand in `REACH` layers of ghost cells, and then
needs nobody: velocities and rates beside a cut are computed on both sides of it, from the same numbers in the same order. What momentum and
residual come from are sums of all ranks; the momentum changes by them once a period of steps alone, and so they are shared once a period.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.granular.packing import REACH, Packing
from warp_lcp.granular.solids import Walls
from warp_lcp.granular.stress import Stress
from warp_lcp.granular.stress_kernels import PERIOD
from warp_lcp.granular.yield_set import COLUMNS
from warp_lcp.rows.program import Launch, perform


class SharedStress(Stress):
    """Pressure and friction of the sand of all ranks; `begin`, `advance` and `residual` are collective.

    Args:
        part: where this rank works.
        packing: where sand is.
        walls: faces of the cells of this rank's box with solids.
        more: as of `Stress`.
    """

    shared = True

    def __init__(self, part: Subdomain, packing: Packing, walls: Walls, **more: Any) -> None:
        self._part = part
        super().__init__(packing, walls, **more)
        self.total, self._nothing = wp.zeros_like(self._sums), wp.zeros_like(self._sums)
        self._found = np.zeros((PERIOD, 2 * COLUMNS))  # by the steps of a period on this rank

    def begin(self, *arguments: Any) -> None:
        """Start from the last stresses, see the base class, of which cells without sand lose theirs in ghost layers, too."""
        super().begin(*arguments)
        self._part.fill(self.now, width=REACH)

    def _count(self) -> int:
        return int(self._part.ranks.sum(super()._count()))

    def _end_step(self, step: int, launch: Launch) -> None:
        if self._part.ranks.size == 1:
            super()._end_step(step, launch)
            return
        super()._add_up(launch)
        perform(partial(self._keep, step), launch)
        last = step == PERIOD - 1
        if last:
            perform(self._share_period, launch)
        self._choose_momentum(self.total if last else self._nothing, launch)

    def _keep(self, step: int) -> None:
        self._found[step] = self._sums.numpy()

    def _share_period(self) -> None:
        """Let the sums be those that a period's steps have found on all ranks, as the momentum would have added them up."""
        found = self._part.ranks.sum(self._found)
        found = found[:, :COLUMNS] + found[:, COLUMNS:]
        found[:, 6:] = np.sqrt(found[:, 6:])
        total = found.sum(axis=0)
        total[6:] **= 2  # of which the momentum takes the roots
        self.total.assign(np.concatenate([total, np.zeros(COLUMNS)]))

    def _add_up(self, launch: Launch) -> None:
        super()._add_up(launch)
        perform(self._share_sums, launch)

    def _share_sums(self) -> None:
        self.total.assign(self._part.ranks.sum(self._sums.numpy()))
