"""Sand on the ranks of MPI: what `warp_lcp.distributed.particle_simulation` says of the particles, and one stress of all ranks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.distributed.balance import Balance
from warp_lcp.distributed.particle_simulation import SharedParticleSimulation
from warp_lcp.distributed.particles import SharedParticles
from warp_lcp.granular.scene import SandScene
from warp_lcp.granular.simulator import SandSimulation, percentile_place
from warp_lcp.grid.staggered import Window
from warp_lcp.material.particle_log import Row
from warp_lcp.material.particle_pieces import Piece
from warp_lcp.operators.grid_poisson import FLUID
from warp_lcp.simulation import Part, StepFailed

STEP = 1 << 9  # cells full of sand whose work is that which a step takes however little there is of it


class DistributedSand(SandSimulation, SharedParticleSimulation):
    """A rank's part of sand in progress, see `SharedParticleSimulation`; made of what `SandSimulation` and that take."""

    scene: SandScene
    particles: SharedParticles

    def __init__(self, *arguments: Any, **more: Any) -> None:
        """Allocate the fields and find the sand's cells."""
        super().__init__(*arguments, **more)
        self.balance = Balance(fixed=STEP)

    def mark(self) -> None:
        """Find the sand's cells, as frames show them before the first step."""
        with self.with_ghosts():
            super().mark()

    def step(self, dt: float) -> Row:
        """Advance by dt [s]; see the base class. What it raises is raised on all ranks."""
        with self.attempt(dt):
            try:
                return super().step(dt)
            except StepFailed:
                self.stress.roll_back()  # also where it is the velocity that ranks cannot follow
                raise

    def frame(self) -> list[Part]:
        """Return this rank's particles and cells, see the base class."""
        return self.in_box(super().frame())

    def _find_density(self, window: Window) -> None:
        super()._find_density(window)
        self.part.fill(self.density)

    def _front(self) -> tuple[float, float]:
        """Return the 99th percentile of x and of y of all ranks' particles [m], of which each tells those that may lie beyond it."""
        position, ranks = self.particles.position.numpy()[:, :2], self.part.ranks
        count = int(ranks.sum(len(position)))
        beyond = count - percentile_place(count)
        if count == 0:
            return 0.0, 0.0
        first = max(len(position) - beyond, 0)
        farthest = np.partition(position, first, axis=0)[first:] if len(position) else position
        everyone = np.concatenate(ranks.collect(farthest))
        x, y = np.partition(everyone, len(everyone) - beyond, axis=0)[len(everyone) - beyond]
        return float(x), float(y)

    def _sand_cells(self) -> np.ndarray:
        return np.argwhere(self.part.box_of(self.packing.kind.numpy()) == FLUID) + np.array(self.part.owned.low)

    def _own(self, field: wp.array) -> np.ndarray:
        return self.part.known_of(field.numpy())

    def _largest(self, values: list[float]) -> list[float]:
        return [float(value) for value in self.part.ranks.max(np.array(values))]

    def _sum(self, count: int) -> int:
        return int(self.part.ranks.sum(count))

    def _still_solids(self) -> wp.array:
        return self.solids.base

    def restore_own(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from the arrays of `own_state`, those of the ghost layers from other ranks."""
        super().restore_own(state)
        self.part.fill(self.stress.now)
        self.part.fill(self.packing.kind, self.packing.fraction, self.outcome.ratio)

    def _take_pieces(self, pieces: Sequence[Piece]) -> None:
        super()._take_pieces(pieces)
        self._place_solids()
