"""Sand on the ranks of MPI: what `warp_lcp.distributed.particle_simulation` says of the particles, and one stress of all ranks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import warp as wp

from warp_lcp.distributed.balance import Balance
from warp_lcp.distributed.particle_simulation import SharedParticleSimulation
from warp_lcp.distributed.particles import SharedParticles
from warp_lcp.granular.scene import SandScene
from warp_lcp.granular.simulator import SandSimulation
from warp_lcp.material.particle_log import Row
from warp_lcp.material.particle_pieces import Piece
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

    def _still_solids(self) -> wp.array:
        return self.solids.base

    def _take_pieces(self, pieces: Sequence[Piece]) -> None:
        super()._take_pieces(pieces)
        self._place_solids()
