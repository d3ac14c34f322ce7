"""The stress of sand that ranks share: one problem of all ranks a step, each of which has the cells of its box.

What a step does to a cell looks at the velocities of faces and the rates of strain of edges around it, these at faces a cell farther, and
those at the stresses of cells a cell farther still. So a step begins with the stresses of sand in `REACH` layers of ghost cells, and then
needs nobody: velocities and rates beside a cut are computed on both sides of it, from the same numbers in the same order. What momentum and
residual come from are sums of all ranks; the momentum changes by them once a period of steps alone, and so they are shared once a period.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.distributed.halo import StarForest
from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.granular.packing import Packing
from warp_lcp.granular.report import SandReport
from warp_lcp.granular.solids import Walls
from warp_lcp.granular.stress import Stress
from warp_lcp.granular.stress_kernels import PERIOD
from warp_lcp.granular.yield_set import COLUMNS
from warp_lcp.grid.staggered import Window
from warp_lcp.rows.program import Launch, launch, perform

REACH = 2  # cells from the box whose stresses the velocities around it feel


class SharedPacking(Packing):
    """How densely sand lies on a rank's part, right in the box and `REACH` layers around it where the density is in all ghost layers.

    Args:
        part: where this rank works.
        base: as of `Packing`.
        capacity: likewise.
        more: likewise.
    """

    def __init__(self, part: Subdomain, base: wp.array, capacity: wp.array, **more: Any) -> None:
        self._part = part
        self._forest: StarForest | None = None  # of this step's sand
        slices = part.known.slices
        known = Window.of([axis.start for axis in slices], [axis.stop for axis in slices], part.grid.device)
        super().__init__(part.grid, base, capacity, counted=part.owned, known=known, **more)

    def update(self, *arguments: Any) -> None:
        """Take sand as it is now, see the base class."""
        super().update(*arguments)
        if self._forest is not None:
            self._forest.free()
            self._forest = None

    def join(self, stress: wp.array, *, launch: Launch = launch) -> None:
        """Fill the ghost cells of a field of stresses that hold sand; in others they are 0. Collective."""
        perform(partial(self._fill, stress), launch)
        super().join(stress, launch=launch)

    def _fill(self, stress: wp.array) -> None:
        part = self._part
        if self._forest is None and part.ranks.size > 1:
            self._forest = part.forest(stress.shape[0], REACH, which=self.flags.numpy() != 0)
        part.fill(stress, forest=self._forest)


class SharedStress(Stress):
    """Pressure and friction of the sand of all ranks; `begin`, `advance` and `residual` are collective.

    Args:
        part: where this rank works.
        packing: where sand is.
        walls: faces of the cells of this rank's box with solids.
        more: as of `Stress`.
    """

    shared = True

    def __init__(self, part: Subdomain, packing: SharedPacking, walls: Walls, **more: Any) -> None:
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


class SharedReport(SandReport):
    """Takes over what a solve of all ranks leaves; `take` and `report` are collective.

    Args:
        part: where this rank works.
        stress: the stresses.
    """

    def __init__(self, part: Subdomain, stress: SharedStress) -> None:
        self._part = part
        super().__init__(stress)

    def take(self, velocity: Sequence[wp.array]) -> None:
        """Give the faces of the part the velocity that the stresses leave, those of the ghost layers by other ranks."""
        super().take(velocity)
        self._part.fill(*velocity, *self.known, self.contact, self.stress.packing.kind, self.stress.now[0])

    def _found(self) -> list[float]:
        self._part.fill(self.ratio)
        every = self._part.ranks.gather(np.array(super()._found()))
        return [*every[:, :3].sum(axis=0).tolist(), float(every[:, 3].max())]
